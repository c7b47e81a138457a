"""Steps of the site's build that are not MkDocs's own: nothing of the site may be loaded from the network."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError

# What a browser loads without being asked: scripts, styles, fonts, pictures and frames.
_ELSEWHERE = r"""["']?(?:https?:)?//[^>]*>"""
_LOADED = re.compile(rf"<(?:script|img|iframe|source)\b[^>]*\bsrc={_ELSEWHERE}|<link\b[^>]*\bhref={_ELSEWHERE}")
_STYLE = re.compile(r"""(?:url\(|@import\s+)["']?(?:https?:)?//[^)"';]+""")


def on_post_build(config: MkDocsConfig) -> None:
    """Refuse a site that would load something from the network."""
    for path in Path(config.site_dir).rglob("*"):
        pattern = {".html": _LOADED, ".css": _STYLE}.get(path.suffix)
        found = pattern.search(path.read_text(encoding="utf-8")) if pattern else None
        if found:
            raise PluginError(f"{path}: the site must not load anything from the network, got {found[0]}")
