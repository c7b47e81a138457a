"""Reconstruction with misaligned sub-imagers: fitted to the stack, or ignored at a known cost."""
