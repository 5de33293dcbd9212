"""A simulated town, an airborne survey of it, and a robot with a VLP-16 that drives through it."""
