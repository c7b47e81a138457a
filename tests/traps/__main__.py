"""Every command in a folder of traps, each in a process of its own: `python -m tests.traps`."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from .commands import COMMANDS, SLOW, ended, executed, trapped_folder


def main() -> None:
    """Run every command and print what it executed, how it ended, and how long it took."""
    failures = 0
    chosen = sys.argv[1:] or [*COMMANDS, *SLOW]
    with tempfile.TemporaryDirectory() as parent:
        folder, marks, count = trapped_folder(Path(parent))
        print(f"{count} traps")
        for name in chosen:
            for words in {**COMMANDS, **SLOW}[name]:
                try:
                    code, messages, seconds = ended((name, *words), folder)
                except subprocess.TimeoutExpired:
                    code, messages, seconds = -1, "hangs", -1.0
                found = executed(marks)
                wrong = code != 0 or bool(found)
                failures += wrong
                line = f"{'WRONG' if wrong else 'right'}  {code:3}  {seconds:6.1f} s  {' '.join((name, *words))}"
                print(line, *found, *([messages[-400:]] if code else []), flush=True)
    sys.exit(failures > 0)


if __name__ == "__main__":
    main()
