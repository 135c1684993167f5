"""A tiny package outside umov that brings an axis, a camera, an effect and a reflectance model."""
