"""Steps of the site's build that are not MkDocs's own.

The notebooks of docs/notebooks are executed, each in a kernel and a folder of its own, and become pages with their
output and a notebook to download. A site that would load something from the network is refused.
"""

from __future__ import annotations

import base64
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jupytext
import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient

FOLDER = "notebooks"
TIME_LIMIT = 600  # seconds, of a cell
# What a browser loads without being asked: scripts, styles, fonts, pictures and frames.
_ELSEWHERE = r"""["']?(?:https?:)?//[^>]*>"""
_LOADED = re.compile(rf"<(?:script|img|iframe|source)\b[^>]*\bsrc={_ELSEWHERE}|<link\b[^>]*\bhref={_ELSEWHERE}")
_STYLE = re.compile(r"""(?:url\(|@import\s+)["']?(?:https?:)?//[^)"';]+""")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages, pictures and downloads of the executed notebooks."""
    paths = sorted((Path(config.docs_dir) / FOLDER).glob("*.py"))
    with ThreadPoolExecutor(2) as pool:
        for path, notebook in zip(paths, pool.map(executed, paths), strict=True):
            page, pictures = as_page(notebook, path.stem)
            made: dict[str, str | bytes] = {f"{path.stem}.md": page, f"{path.stem}.ipynb": nbformat.writes(notebook)}
            for name, content in (made | pictures).items():
                files.append(File.generated(config, f"{FOLDER}/{name}", content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Let the links of the list of notebooks lead to their pages, not to their sources."""
    return re.sub(r"\((\w+)\.py\)", r"(\1.md)", markdown) if page.file.src_uri.startswith(FOLDER) else markdown


def executed(path: Path) -> Any:
    """Return a text notebook with the output of its cells. Raises an exception of nbclient if a cell fails."""
    notebook = jupytext.read(path)
    notebook.cells.insert(0, nbformat.v4.new_code_cell("%config InlineBackend.figure_formats = ['retina']"))
    with TemporaryDirectory(prefix="ommatid-notebook-") as folder:
        resources = {"metadata": {"path": folder}}
        client = NotebookClient(
            notebook, timeout=TIME_LIMIT, resources=resources, extra_arguments=["--log-level=ERROR"]
        )
        client.execute()
    del notebook.cells[0]
    return notebook


def as_page(notebook: Any, name: str) -> tuple[str, dict[str, str | bytes]]:
    """Return an executed notebook as Markdown, and its pictures by their file names."""
    parts: list[str] = []
    pictures: dict[str, str | bytes] = {}
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        parts.append(f"```python\n{cell.source}\n```")
        for output in cell.outputs:
            data = {"text/plain": output.text} if output.output_type == "stream" else output.data
            if "image/png" in data:
                picture = f"{name}-{len(pictures) + 1}.png"
                pictures[picture] = base64.b64decode(data["image/png"])
                width = output.metadata["image/png"]["width"]
                parts.append(f'![Output of the cell]({picture}){{ width="{width}" }}')
            elif "text/html" in data:
                parts.append(f'<div class="output">{" ".join(data["text/html"].split())}</div>')
            else:
                parts.append(f"```text\n{data['text/plain'].rstrip()}\n```")
    parts.append(f"[Download this notebook with its output]({name}.ipynb)")
    return "\n\n".join(parts) + "\n", pictures


def on_post_build(config: MkDocsConfig) -> None:
    """Refuse a site that would load something from the network."""
    for path in Path(config.site_dir).rglob("*"):
        pattern = {".html": _LOADED, ".css": _STYLE}.get(path.suffix)
        found = pattern.search(path.read_text(encoding="utf-8")) if pattern else None
        if found:
            raise PluginError(f"{path}: the site must not load anything from the network, got {found[0]}")
