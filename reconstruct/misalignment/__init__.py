"""Cameras whose sub-imagers stand beside their places."""
