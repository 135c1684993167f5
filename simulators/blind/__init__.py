"""Captures with undeclared faults, their truth in another folder, and the judge of the answers of `diagnose`."""
