"""H that follows from a few fitted numbers, applied without being stored."""
