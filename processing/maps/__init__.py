"""Product in, product out: quantities, xi0, tables, material constants, extrapolation."""
