"""Data of training and evaluation: places, raw scans and drives with ground truth, benchmarks."""
