"""Damaged files of every type that is read: each must be refused with a short message or read for what it holds."""
