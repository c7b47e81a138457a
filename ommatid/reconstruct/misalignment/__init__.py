"""Reconstruction with misaligned sub-imagers: as noise, fitted to the stack, or ignored at a known cost."""
