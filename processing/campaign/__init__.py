"""Whole campaigns: which captures belong together, what is done with each, and where it runs."""
