"""The held-out check in words: the table that `check` prints, sentences and maps of the sub-imagers for the page."""

from __future__ import annotations

from dataclasses import dataclass

from ommatid.reconstruct.output.run_json import HeldOutEntry, HeldOutPrior, HeldOutReport

Row = tuple[str, str]

LEAST = 1e-300  # probability that is printed
MOST_ROWS = 5  # sub-imagers in the table, unless more are named


def rows(report: HeldOutReport) -> list[Row]:
    """Return names and values, the verdict first."""
    pixels = sum(entry.pixels for entry in report.sub_imagers)
    lines = [("verdict", verdict(report)), ("prior", prior_words(report.prior))]
    if not report.judged:
        return lines
    where = ""
    if report.windows.total > 1:
        where = f", in {report.windows.checked} of {report.windows.total} windows of the target"
    lines += [
        ("sub-imagers predicted", f"{report.judged} of {len(report.sub_imagers)}, {pixels} pixels{where}"),
        ("largest deviation", f"{_probability(report.p_value)}, among all sub-imagers"),
    ]
    worst = report.worst()
    shown = worst[: max(MOST_ROWS, sum(entry.named for entry in worst))]
    return lines + [(f"  {entry.name}", entry_words(entry)) for entry in shown]


def verdict(report: HeldOutReport) -> str:
    """Return the verdict as a sentence."""
    trusted, reasons = report.verdict.trusted, "; ".join(report.verdict.reasons)
    if trusted is None:
        return reasons
    if not trusted:
        return f"not to be trusted: {reasons}"
    return f"all {report.judged} sub-imagers agree with their predictions from the others"


def entry_words(entry: HeldOutEntry) -> str:
    """Return z, probability and size of a sub-imager's error."""
    words = (
        f"z = {entry.z:.1f}, {_probability(entry.p_value)}, errs by {entry.rms_error:.3g} grey levels,"
        f" expected {entry.expected_rms:.3g}"
    )
    return f"{words}; contradicts the others" if entry.named else words


def prior_words(prior: HeldOutPrior) -> str:
    """Return the prior that the predictions assumed, and where it came from."""
    length = "" if prior.correlation_length is None else f", correlation length {prior.correlation_length:.3g} mm"
    words = f"{prior.kind}, variance {prior.variance:.4g}{length}"
    if prior.fitted:
        return f"{words}, fitted to the stack"
    return f"{words}, as the scene says; a photograph is no draw of it"


def _probability(p_value: float | None) -> str:
    """Return a probability, also one that float64 takes for 0."""
    if p_value is None:
        return "p unknown"
    return f"p = {p_value:.2g}" if p_value >= LEAST else f"p < {LEAST:g}"


LARGEST = 24  # rows and columns of an array that a map shows
FAINT, FULL = 1.5, 8.0  # z from which a cell is coloured, and of the strongest colour
STRONGEST = 0.7  # so that the text stays legible


@dataclass(frozen=True)
class SubImagerCell:
    """A cell of a map: z as text, the strength of its colour (0 to 1), whether it is named, and all in words."""

    text: str
    strength: float
    named: bool
    words: str


@dataclass(frozen=True)
class LensTypeMap:
    """The cells of a lens type, by rows k and columns l; no rows where the array is too large for a map."""

    name: str
    rows: tuple[tuple[SubImagerCell, ...], ...]


def lens_type_maps(report: HeldOutReport) -> list[LensTypeMap]:
    """Return a map for every lens type, in their order."""
    maps: list[LensTypeMap] = []
    for name in dict.fromkeys(entry.type for entry in report.sub_imagers):
        entries = [entry for entry in report.sub_imagers if entry.type == name]
        lines = max(entry.k for entry in entries) + 1
        columns = len(entries) // lines
        shown = range(lines) if max(lines, columns) <= LARGEST else range(0)
        rows = tuple(tuple(_cell(entry) for entry in entries[k * columns : (k + 1) * columns]) for k in shown)
        maps.append(LensTypeMap(name, rows))
    return maps


def _cell(entry: HeldOutEntry) -> SubImagerCell:
    if entry.z is None:
        return SubImagerCell("\N{EN DASH}", 0.0, False, f"{entry.name}: not predicted")
    z = "0.0" if -0.05 < entry.z < 0 else f"{entry.z:.1f}".replace("-", "\N{MINUS SIGN}")
    strength = STRONGEST * min(max(entry.z - FAINT, 0.0) / (FULL - FAINT), 1.0)
    return SubImagerCell(z, strength, entry.named, f"{entry.name}: {entry_words(entry)}")
