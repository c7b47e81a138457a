"""Simulation of sub-images: the camera in Mitsuba, its ideal model, its calibration and its sensor."""
