"""The held-out check in words and tables."""
