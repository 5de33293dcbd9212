"""Belief: whether the localizer's probabilities hold, on the map under many conditions, and off it on every map."""
