"""Calibration of an instrument, and the design of its states, before it measures."""
