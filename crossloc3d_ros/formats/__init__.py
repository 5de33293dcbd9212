"""Formats of others to our types and back: PointCloud2, LAS, bags, published datasets."""
