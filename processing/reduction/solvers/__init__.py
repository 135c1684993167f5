"""Inversion of intensities into Mueller elements: plain, weighted, with a matrix that varies over the image."""
