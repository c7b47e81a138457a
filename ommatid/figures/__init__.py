"""Figures that several commands draw, and their files."""
