"""Many scenes at once: batches, sweeps, and how they are shared among processes."""
