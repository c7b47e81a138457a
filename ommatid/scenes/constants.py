"""Constants of the whole package: the range of pixel values, the default wavelength, the Airy pattern.

Lengths are millimetres.
"""

from __future__ import annotations

WHITE = 255.0  # pixel value of a target that reflects all light; black is 0
GREEN = 550e-6  # mm, the wavelength of a scene that gives none
AIRY_FIRST_ZERO = 1.21967  # first zero of J1(pi x): radius of the Airy disk over wavelength times f-number
DEVIATIONS = 5.0  # of a Gaussian displacement on the target that are followed; 4e-6 of it is longer
MOST_DENSE = 4000  # pixels of the largest dense problem, exact and with every form, which takes seconds
