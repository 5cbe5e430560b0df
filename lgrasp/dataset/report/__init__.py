"""``lgrasp dataset report``: the contents of a data set, as one HTML page and as numbers."""
