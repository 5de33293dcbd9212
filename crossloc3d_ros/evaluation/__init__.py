"""Retrieval, poses and drives scored against ground truth, with intervals, and their pages."""
