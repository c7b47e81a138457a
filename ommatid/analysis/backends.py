"""The rendering backends of this machine: which of them work, how fast, and how to repair them."""

from __future__ import annotations

import os
from typing import Any

from ommatid.runtime.versions import versions
from ommatid.simulate.renderer.variant import PREFERENCE, diagnosis, probe


def describe_backends() -> dict[str, Any]:
    """Render a little on each backend, in a process of its own, and describe them in JSON's types."""
    probes = [probe(variant) for variant in PREFERENCE]
    return {
        "backends": [
            {"variant": status.variant, "reason": status.reason, "samples_per_second": status.speed}
            for status in probes
        ],
        "advice": diagnosis(probes),
        "versions": versions("mitsuba", "drjit", "OpenEXR", "scipy", "scikit-image"),
        "cores": os.cpu_count(),
    }


def sections(description: dict[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """Tabulate the backends and the versions of the libraries."""
    backends = [
        (backend["variant"], backend["reason"] or f"works, {backend['samples_per_second'] / 1e6:.0f} million samples/s")
        for backend in description["backends"]
    ]
    return [("Backends", backends), ("Versions", list(description["versions"].items()))]
