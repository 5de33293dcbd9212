"""What training and evaluation are made of: places, raw scans and drives with ground truth, benchmarks."""
