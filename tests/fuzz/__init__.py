"""Damaged files of every kind that is read: each is refused in a sentence or read for what it holds, never worse."""
