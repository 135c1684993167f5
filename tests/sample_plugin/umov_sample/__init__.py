"""A tiny package outside umov that brings an axis, a camera, a source, an effect and a reflectance model."""
