"""What a diagnosis says, of an instrument and of a surface alike: result, checks, report."""
