"""Measured intensities against the model of a surface, the instrument known."""
