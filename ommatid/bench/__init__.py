"""Error against run time of every stage, measured, written and drawn."""
