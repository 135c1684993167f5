"""Whole and undamaged HDF5 files: looked at before reading, checksums, packed rows."""
