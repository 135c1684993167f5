"""Measured intensities against the model of an instrument, the sample unknown or known."""
