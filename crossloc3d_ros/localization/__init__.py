"""Scan in, estimate out."""
