"""How good an estimate is, and what would improve it: resolution, correlation of errors, spectra, next steps."""
