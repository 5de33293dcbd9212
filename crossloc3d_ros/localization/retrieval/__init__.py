"""From a patch to candidate submaps, and the place that is probable by them."""
