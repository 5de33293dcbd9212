"""Points in, points out: filters, ground, rasters, the one patch normalisation. NumPy and Numba only."""
