"""Estimation methods: one dense problem, tile by tile, and their common interface."""
