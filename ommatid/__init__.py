"""Simulate, calibrate and reconstruct the images of flat compound-eye cameras, with error bars."""
