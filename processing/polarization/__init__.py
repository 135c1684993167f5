"""The algebra of polarized light, free of files and instruments: Mueller, Jones and coherency matrices."""
