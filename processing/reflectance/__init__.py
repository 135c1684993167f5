"""Reflectance models: one module for each; the module's name is its kind in YAML."""
