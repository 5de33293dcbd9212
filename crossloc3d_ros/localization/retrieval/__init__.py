"""From a patch to candidate submaps, and the place that they speak for."""
