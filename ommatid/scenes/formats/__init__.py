"""File formats: OpenEXR, NumPy archives, TIFF and pictures."""
