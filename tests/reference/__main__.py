"""Run the same scenes with two checkouts, and say of each whether a number moved.

    python -m tests.reference BEFORE AFTER
    python -m tests.reference main . --cases tile19,photo --keep kept
    python -m tests.reference main . --within estimate=0.01 deviation=0.01 H=1e-3 numbers=0.01 interval=0.01 record=inf
    python -m tests.reference main . --statistical

BEFORE and AFTER are folders with a checkout, or revisions of this repository. Quantities without a tolerance have to be
the same bit for bit. Keys of run.json that one side does not know are not compared. In one run of 10, one ray of
`corridor` meets the other of two walls at the same distance, so that both differ without a cause.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from .cases import Case, all_cases
from .checkout import MATRIX, Checkout, Done, NoCheckoutError, found
from .comparison import LIMITS, UNITS, Difference, deviations, differences, read


def tolerance(text: str) -> tuple[str, float]:
    """NAME=VALUE of a quantity."""
    name, _, value = text.partition("=")
    limit = float(value)
    if name not in UNITS or not limit >= 0:
        raise argparse.ArgumentTypeError(f"{text}: expected NAME=VALUE of {', '.join(UNITS)}")
    return name, limit


def chosen(names: str | None) -> list[Case]:
    """Cases of these names, in their order, or all."""
    known = all_cases()
    words = names.split(",") if names else list(known)
    unknown = [name for name in words if name not in known]
    if unknown:
        raise SystemExit(f"{unknown[0]!r} is not a case: {', '.join(known)}")
    return [known[name] for name in words]


def judgement(case: Case, before: Done, after: Done, limits: dict[str, float], statistical: bool) -> tuple[bool, str]:
    """Whether a case is the same, and what differs."""
    if before.code or after.code:
        sides = (("before", before), ("after", after))
        ends = [f"{name} fails ({done.code}): {done.message}" for name, done in sides if done.code]
        return False, "; ".join(ends)
    try:
        old, new = (read(done.folder / case.result, done.folder / MATRIX) for done in (before, after))
        every = (deviations if statistical else differences)(old, new)
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        return False, f"results that cannot be read or compared: {error!r}"
    beyond = [item for item in every if not item.size <= limits.get(item.quantity, 0.0)]
    if beyond:
        return False, "; ".join(map(described if statistical else str, beyond))
    within = [item for item in every if item.size]
    if not within:
        return True, "bit for bit"
    nearest = max(within, key=lambda item: item.size / limits[item.quantity] if limits[item.quantity] else 0.0)
    return True, f"within limits, nearest: {described(nearest) if statistical else nearest}"


def described(item: Difference) -> str:
    """A deviation between two draws, with its limit."""
    return f"{item.quantity} {item.size:.2g} (limit {LIMITS[item.quantity]:g}) at {item.where}"


def main() -> None:
    """Run the cases side by side, one process of each checkout at a time, and print one line a case."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m tests.reference", description=__doc__, formatter_class=form)
    parser.add_argument("before")
    parser.add_argument("after")
    parser.add_argument("--cases", metavar="NAME,...", help="only these")
    names = ", ".join(f"{name} {unit}" for name, unit in UNITS.items())
    parser.add_argument("--within", nargs="+", type=tolerance, default=[], metavar="NAME=VALUE", help=names)
    parser.add_argument("--statistical", action="store_true", help="two draws with other seeds, of the same statistics")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="keep results; finished cases are not run again")
    parser.add_argument("--python", help="interpreter of both, in place of CHECKOUT/.venv/bin/python")
    parser.add_argument(
        "--change", nargs="+", default=[], metavar="KEY=VALUE", help="settings of the runs of AFTER alone, as a trial"
    )
    options = parser.parse_args()
    cases = chosen(options.cases)
    limits = (LIMITS if options.statistical else {}) | dict(options.within)
    with tempfile.TemporaryDirectory(prefix="ommatid-reference-") as scratch:
        store = options.keep.resolve() if options.keep else Path(scratch, "results")
        sides: list[Checkout] = []
        try:
            for side, name, settings in (("before", options.before, ()), ("after", options.after, options.change)):
                folder, python = found(name, options.python, Path(scratch).resolve())
                sides.append(Checkout(folder, python, store / side, tuple(settings)))
                print(f"{side}: {folder}, {python}, identity {sides[-1].identity}", flush=True)
        except NoCheckoutError as error:
            raise SystemExit(str(error)) from None
        wrong = compared(cases, sides[0], sides[1], limits, options.statistical)
    print(f"{len(cases) - wrong} of {len(cases)} cases are the same")
    sys.exit(bool(wrong))


def compared(cases: list[Case], before: Checkout, after: Checkout, limits: dict[str, float], statistical: bool) -> int:
    """Print one line a case; the number of those that differ."""
    wrong = 0
    spent = [0.0, 0.0]
    with ThreadPoolExecutor(1) as first, ThreadPoolExecutor(1) as second:
        runs = [(case, first.submit(before.run, case), second.submit(after.run, case)) for case in cases]
        for case, *futures in runs:
            done = [future.result() for future in futures]
            same, words = judgement(case, done[0], done[1], limits, statistical)
            wrong += not same
            seconds = "  ".join(f"{side.seconds:6.1f} s{' (kept)' if side.reused else ''}" for side in done)
            spent = [total + (0 if side.reused else side.seconds) for total, side in zip(spent, done, strict=True)]
            print(f"{case.name:12} {'same   ' if same else 'DIFFERS'}  {seconds}  {words}", flush=True)
    print(f"processor seconds: before {math.ceil(spent[0])}, after {math.ceil(spent[1])}")
    return wrong


if __name__ == "__main__":
    main()
