"""Long campaign: `python -m tests.kills --kills 200 --seed 1`; or the commands of one name."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from .campaign import COMMANDS, campaign, prepared


def main() -> None:
    """Run the campaign over all commands, or over one."""
    parser = argparse.ArgumentParser(prog="python -m tests.kills", description=__doc__)
    parser.add_argument("--kills", type=int, default=200, help="number of kills of all commands together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--commands", choices=sorted(COMMANDS), help="only these")
    options = parser.parse_args()
    names = [options.commands] if options.commands else list(COMMANDS)
    wrong: list[str] = []
    print(f"{'commands':24}{'kills':>6}{'folders':>8}{'waits':>6}{'wrong':>6}  by signal")
    with tempfile.TemporaryDirectory() as folder, prepared(Path(folder)) as starter:
        for name in names:
            tally = campaign(starter, Path(folder), name, -(-options.kills // len(names)), options.seed)
            signals = ", ".join(f"{count} {number}" for number, count in sorted(tally.killed.items()))
            counts = f"{tally.kills:6}{tally.folders:8}{tally.waits:6}{len(tally.wrong):6}"
            print(f"{name:24}{counts}  {signals}", flush=True)
            wrong += tally.wrong
    print(*wrong, sep="\n")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
