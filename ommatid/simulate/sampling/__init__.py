"""Samplers, passes and checkpoints of renderings."""
