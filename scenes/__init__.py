"""Descriptions of a camera and what it looks at, and the files the two halves exchange."""
