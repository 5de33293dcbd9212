"""How well a map can be localized in: simulated drives through it, the offset of its belief, its page."""
