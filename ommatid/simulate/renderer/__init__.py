"""The camera and its target in Mitsuba; the only package that imports it."""
