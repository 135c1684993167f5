"""Files in and out: captures, products, and the formats of other programs."""
