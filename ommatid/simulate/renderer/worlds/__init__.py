"""Where a Mitsuba scene stands before the camera, and what the camera sees of it."""
