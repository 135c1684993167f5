"""Quantities that are one number of a Mueller matrix, one file each; `scalar_files` beside this folder finds them."""
