"""Both halves in their order: what joins rendering, calibration and reconstruction, for the command line."""
