"""Answer of a diagnosis, for an instrument and a surface alike: result, checks, report."""
