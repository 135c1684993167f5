"""Campaigns: many captures as one value, run unattended and gone on with after an interruption."""
