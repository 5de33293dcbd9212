"""The aerial map: its submaps, their descriptors, the folder on disk and the builder."""
