"""Polarization mosaics (division of focal plane): layout, demosaicing, propagated noise."""
