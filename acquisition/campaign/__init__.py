"""Campaigns: many captures as one value, run unattended and resumed after an interruption."""
