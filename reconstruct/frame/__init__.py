"""Whole frames by preconditioned conjugate gradients."""
