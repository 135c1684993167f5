"""Reflectance models: one file a kind, found by folder (`base.kinds`)."""
