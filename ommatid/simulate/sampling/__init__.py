"""Samplers, passes, seeds and checkpoints of renderings."""
