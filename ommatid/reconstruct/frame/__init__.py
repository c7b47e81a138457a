"""Estimates of whole frames by preconditioned conjugate gradients."""
