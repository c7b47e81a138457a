"""Simulation, calibration and reconstruction in sequence, and runs within a given time."""
