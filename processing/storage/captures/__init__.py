"""Capture files: layout, reader, segments, packing, splitting by colour."""
