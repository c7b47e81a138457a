"""Descriptions of cameras and targets, and the files that simulation and reconstruction exchange."""
