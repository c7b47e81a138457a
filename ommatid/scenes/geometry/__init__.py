"""The geometry of a camera in the terms of optics: what follows from given quantities, and whether it can be built."""
