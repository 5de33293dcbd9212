"""Poses: single scans and drives of the pose benchmark, predicted, scored, shown."""
