"""Jobs that share a batch: each runs its share into one folder, and the last one describes the whole."""
