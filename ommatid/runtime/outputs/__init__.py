"""Places of results: their names, their kinds, and folders that one run uses at a time."""
