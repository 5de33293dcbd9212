"""One replayed drive: estimates on disk, scores along the track, the page."""
