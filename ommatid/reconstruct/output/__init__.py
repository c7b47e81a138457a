"""The files of a reconstruction."""
