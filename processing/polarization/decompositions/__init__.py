"""Decompositions of Mueller matrices: Lu-Chipman, symmetric, differential. Cloude's is `polarization.cloude`."""
