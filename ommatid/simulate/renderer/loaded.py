"""Mitsuba and Dr.Jit, for the modules that render: they are used once a variant is active."""

# pyright: basic
from __future__ import annotations

from .variant import without_complaints

with without_complaints():
    import drjit as dr
    import mitsuba as mi

__all__ = ["dr", "mi"]
