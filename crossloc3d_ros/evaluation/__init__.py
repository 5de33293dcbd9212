"""Replay of bags, recall, and the page that shows both."""
