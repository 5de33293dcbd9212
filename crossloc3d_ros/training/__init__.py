"""Places to learn from, the loss and the loop."""
