"""The two ways in which a command can fail that are not the program's fault."""

from __future__ import annotations


class InputError(ValueError):
    """A scene, option or file that the user can mend; the command line answers with exit code 2."""


class DeniedError(OSError):
    """What the machine refuses, such as space on the disk; the command line answers with exit code 1."""
