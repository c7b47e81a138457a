"""Figures that are kept for a test to look at, as they are written."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ommatid.figures.saving import FigureFiles


@dataclass(frozen=True)
class KeptFigures(FigureFiles):
    """Files of figures that keeps each figure by the name of its file; `write` False writes nothing."""

    write: bool = False
    kept: dict[str, Any] = field(default_factory=dict[str, Any])

    def replace(self, figure: Any, path: Path) -> None:
        self.kept[path.stem] = figure
        if self.write:
            super().replace(figure, path)
