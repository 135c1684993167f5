"""Captures as `diagnose` sees them: counts, what is clipped or dark, and the noise."""
