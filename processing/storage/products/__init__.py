"""Product files: planes, masks, images read back, provenance."""
