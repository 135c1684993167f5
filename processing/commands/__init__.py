"""The commands of `process`, one module for each group; each has `register(app)` and imports its work late."""
