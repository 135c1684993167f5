"""Captures with undeclared faults, their truth apart, and the judge of what `diagnose` says of them."""
