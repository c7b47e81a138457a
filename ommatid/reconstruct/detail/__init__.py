"""Estimation of f where the world has detail finer than f's pixels."""
