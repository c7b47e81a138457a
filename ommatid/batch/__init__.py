"""Many scenes at once: batches, sweeps, and their distribution over processes and machines."""
