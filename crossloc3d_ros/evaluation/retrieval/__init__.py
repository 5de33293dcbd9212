"""Place recognition: predictions of each query, recall, verification, tables and the page."""
