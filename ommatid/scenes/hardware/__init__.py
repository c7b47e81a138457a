"""Recordings of real cameras: frames, point sources, and the noise of both."""
