"""Files of Zemax: lenses, glass catalogues, and the formulas of these."""
