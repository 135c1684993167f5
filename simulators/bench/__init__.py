"""The optical bench: scene, optics, what they do undeclared; angles in, counts out."""
