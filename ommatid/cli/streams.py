"""Standard streams that are open and print every character in some way, and names of files in UTF-8, on any machine."""

from __future__ import annotations

import codecs
import io
import os
import sys

ERRORS = "ommatid.ascii"
# what a terminal without Unicode shows in place of the characters that this program prints
ALTERNATIVES = {
    "±": "+-", "×": "x", "·": "*", "÷": "/", "°": " deg", "µ": "u", "μ": "u", "σ": "sigma", "λ": "lambda", "²": "^2",
    "³": "^3", "√": "sqrt", "≤": "<=", "≥": ">=", "≈": "~", "→": "->", "…": "...", "–": "-", "—": "-", "−": "-",
    "’": "'", "‘": "'", "“": '"', "”": '"', "Ω": "Ohm", "∞": "inf", "é": "e", "\N{NO-BREAK SPACE}": " ",
}  # fmt: skip


def prepare_streams() -> None:
    """Open closed standard streams on the null device, and let every character be printed.

    A file that the program opens would otherwise take the number of a closed stream, and libraries would write into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # takes the lowest free number
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8", closefd=False))
    codecs.register_error(ERRORS, _alternative)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=ERRORS)


def _alternative(error: UnicodeError) -> tuple[str, int]:
    """Return what is printed in place of characters that an encoding lacks: a word in ASCII, or an escape."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    missing = error.object[error.start : error.end]
    words = (ALTERNATIVES.get(character) or character.encode("unicode_escape").decode("ascii") for character in missing)
    return "".join(words), error.end


def use_utf8_names() -> None:
    """Start this program again with names of files in UTF-8, where the locale has another encoding.

    OpenEXR and Mitsuba take UTF-8 in every locale, so that they would open another file. Output keeps the encoding of
    the locale.
    """
    if sys.getfilesystemencoding().lower() in ("utf-8", "utf8") or sys.flags.utf8_mode:
        return
    os.environ.setdefault("PYTHONIOENCODING", f"{sys.stdout.encoding}:backslashreplace")
    executable = sys.executable
    os.execv(executable, [executable, "-P", "-X", "utf8", *sys.orig_argv[1:]])
