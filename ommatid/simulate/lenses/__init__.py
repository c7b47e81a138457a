"""Ray optics of lenses, without Mitsuba."""
