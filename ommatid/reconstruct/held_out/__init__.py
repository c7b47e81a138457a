"""The held-out check: every sub-imager predicted from all others, which needs no truth."""
