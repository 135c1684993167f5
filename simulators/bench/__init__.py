"""The optical bench: scene, optics and undeclared effects; angles in, counts out."""
