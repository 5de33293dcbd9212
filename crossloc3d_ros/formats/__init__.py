"""The outside world to our types and back: PointCloud2, LAS, bags."""
