"""Cameras: one module for each family; the module's name is its kind in YAML."""
