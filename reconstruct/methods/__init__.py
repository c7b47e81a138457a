"""Methods of reconstruction: dense, by tiles, and what all methods share."""
