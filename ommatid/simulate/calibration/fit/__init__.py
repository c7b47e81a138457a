"""H by few numbers instead of its noisy entries: `calibration.fit`."""
