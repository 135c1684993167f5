"""Close the loop: find the effect that a model lacks, add it, report the error before and after."""
