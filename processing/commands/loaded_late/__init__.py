"""Modules that a command loads when it runs and not for its help: they import large packages at their top."""
