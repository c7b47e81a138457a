"""Closed forms for the light between target and pixel: footprints, blur, distortion, radiometry."""
