"""Modes of commands that are worth a module of their own."""
