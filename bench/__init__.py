"""How fast and how large: `make bench`, figures beside what the machine can do."""
