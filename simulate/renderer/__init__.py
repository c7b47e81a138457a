"""The camera and its scene in Mitsuba; the only folder that imports it."""
