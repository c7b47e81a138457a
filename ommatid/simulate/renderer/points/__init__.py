"""Points over a sensor pixel and a pupil that Mitsuba has no sampler for."""
