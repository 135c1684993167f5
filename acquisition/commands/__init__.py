"""The commands of `acquire`, one module for each group."""
