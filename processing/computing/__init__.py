"""How numbers are computed, whatever they mean: threads, chunks, compiled loops."""
