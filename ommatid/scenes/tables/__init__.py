"""The tables of a scene file: their keys, units, checks and messages."""
