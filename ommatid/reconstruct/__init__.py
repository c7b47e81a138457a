"""Sub-images to the image and its error, from files alone and without Mitsuba."""
