"""Light to sub-images: the camera in Mitsuba, its ideal model, its calibration and its noise."""
