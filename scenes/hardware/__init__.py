"""Recordings of real cameras: frames, point sources and where they belong."""
