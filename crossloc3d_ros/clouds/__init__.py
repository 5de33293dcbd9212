"""Points in, points out: filters, ground, rasters, patches. NumPy and Numba only."""
