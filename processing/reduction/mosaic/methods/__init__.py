"""Demosaicing methods, one file each; docs/adding-a-demosaicing-method.md says what a file holds."""
