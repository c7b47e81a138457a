"""Mitsuba scene files, checked without Mitsuba: their XML, plugins, and the files that they name.

XML is read with limits; document types, and thus entities, are refused, so that a file cannot grow or name other files
while it is parsed. `check_world_files` writes one text out of a file and those that it includes: variables are
replaced, paths are absolute, and no element is left that names further XML. This text, and nothing else, is what
Mitsuba parses.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import cache
from itertools import count
from pathlib import Path
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import LARGEST_TEXT, check_regular, read_bytes
from ommatid.runtime.printable import printable

from ..variant import mitsuba_folder

SHOWN = 80  # characters of a name in messages
DEEPEST_INCLUDE, MOST_INCLUDES = 15, 1000  # the former as in Mitsuba
LONGEST_REASON = 180  # characters
DEEPEST = 64  # levels of nested elements; Mitsuba and its plugins recurse into them
MOST_ELEMENTS = 300_000  # of a world, those of included files counted as often as they are included
LIBRARIES = (".so", ".dylib", ".dll")


@dataclass(frozen=True)
class CheckedWorld:
    """A Mitsuba file whose XML, plugins and named files were checked.

    text : one element per line, of the file and those that it includes
    lines : the file and line from which each line of the text comes
    files : the file, and those that it names, as it names them
    checked : files that plugins read, other than XML, with the name of the plugin
    """

    text: str
    lines: list[tuple[Path, int]]
    files: list[Path]
    checked: dict[Path, str]

    def place(self, line: int) -> str:
        """Return the name and line in a file of a line of the text, from 1, for messages."""
        path, number = self.lines[min(max(line, 1), len(self.lines)) - 1]
        return f"{printable(path.name, SHOWN)} (line {number})"


def reason_of(error: str, world: CheckedWorld) -> str:
    """Return why Mitsuba refuses a world, in one short sentence that names the place in its files."""

    def place(match: re.Match[str]) -> str:
        return f"in {world.place(int(match[1]))}"

    reason = re.sub(r"\[[\w.]+(:\d+)?\] ", "", " ".join(error.split()))
    reason = re.sub(r'^At dictionary node "root": failed to instantiate \w+ plugin of type "\w+": ', "", reason)
    reason = re.sub(r"(?:(?:At|While loading|Error while loading) )?string \(line (\d+), col \d+\)", place, reason)
    return printable(reason, LONGEST_REASON)


_known: dict[tuple[Path, bool], tuple[list[tuple[int, ...]], CheckedWorld]] = {}


def check_world_files(path: Path, where: str, allow_outside: bool = False) -> CheckedWorld:
    """Check a Mitsuba file and all that it names, without Mitsuba; once for files that do not change.

    where : start of messages, such as "scene.toml: world.file"
    allow_outside : True if files may be outside the folder of `path`
    Raises InputError.
    """
    known = _known.get((path, allow_outside))
    if known is not None and [signature(each) for each in known[1].files] == known[0]:
        return known[1]
    expansion = _Expansion(path, allow_outside)
    try:
        expansion.include(path, [])
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    except FileNotFoundError as error:
        message = f"{where}: there is no Mitsuba scene {printable(path)}; name one, beside the scene file"
        raise InputError(message) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{where}: {printable(path)} could not be read ({printable(error, SHOWN)})") from error
    world = CheckedWorld("\n".join(expansion.text), expansion.lines, list(expansion.files), expansion.checked)
    _known[path, allow_outside] = [signature(each) for each in world.files], world
    return world


def signature(path: Path) -> tuple[int, ...]:
    """Return numbers that differ if a file has changed, none of a file that is missing."""
    try:
        status = path.stat()
    except OSError:
        return ()
    return status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino, status.st_dev


class _Expansion:
    """The text of a world in the making."""

    def __init__(self, path: Path, allow_outside: bool) -> None:
        self.text: list[str] = []
        self.lines: list[tuple[Path, int]] = []
        self.files: dict[Path, None] = {}
        self.checked: dict[Path, str] = {}
        self._folder = path.parent
        self._within = None if allow_outside else path.parent.resolve()
        self._searched = [path.parent]
        self._variables: dict[str, str] = {}
        self._size = self._includes = 0
        self._elements: dict[Path, WorldElement] = {}

    def include(self, path: Path, including: list[Path], name: str | None = None) -> None:
        """Write the elements of a file. Raises InputError, and OSError for a first file that cannot be read."""
        shown = printable(path)
        self.files[path] = None
        try:
            if path not in self._elements:
                self._elements[path] = read_xml(path)
        except InputError as error:
            raise InputError(str(error) if str(path) in str(error) else f"{shown}: {error}") from error
        root, depth = self._elements[path], len(including)
        if not including and root.tag != "scene":
            raise InputError(f"{shown} holds a single {printable(root.tag, SHOWN)}; expected a whole <scene>")
        levels = depth + 1
        if root.tag == "scene" and including:
            for child in root.children:
                self._write(child, root, [*including, path], levels)
            return
        if including:
            kept = {key: value for key, value in root.attributes.items() if key not in ("version", "name")}
            root = WorldElement(root.tag, kept | ({} if name is None else {"name": name}), root.line, root.children)
        self._write(root, None, [*including, path], levels)

    def _write(self, element: WorldElement, parent: WorldElement | None, files: list[Path], levels: int) -> None:
        path, place = files[-1], f"{printable(files[-1])} (line {element.line})"
        attributes = {key: self._replaced(value, place) for key, value in element.attributes.items()}
        if levels > DEEPEST:
            raise InputError(f"{place}: elements are nested in more than {DEEPEST} levels; expected at most {DEEPEST}")
        if element.tag == "default":
            self._variables.setdefault(f"${attributes.get('name', '')}", attributes.get("value", ""))
        elif element.tag == "include":
            self._include(attributes, files, place)
        elif element.tag == "path":
            self._searched.insert(0, self._found(attributes.get("value", ""), place, is_folder=True))
        else:
            _check_type(attributes, place)
            self._check_files(element.tag, attributes, parent, place)
            replaced = WorldElement(element.tag, attributes, element.line)
            self._append(f"<{element.tag}{_words(attributes)}{'' if element.children else '/'}>", path, element.line)
            for child in element.children:
                self._write(child, replaced, files, levels + 1)
            if element.children:
                self._append(f"</{element.tag}>", path, element.line)

    def _append(self, line: str, path: Path, number: int) -> None:
        self._size += len(line)
        if self._size > LARGEST_TEXT or len(self.text) >= 2 * MOST_ELEMENTS:
            raise InputError(
                f"{printable(path)}: grows by its variables and included files beyond {MOST_ELEMENTS} elements or"
                f" {LARGEST_TEXT / 1e6:g} MB; expected less"
            )
        self.text.append(line)
        self.lines.append((path, number))

    def _include(self, attributes: dict[str, str], files: list[Path], place: str) -> None:
        self._includes += 1
        if self._includes > MOST_INCLUDES:
            raise InputError(f"{place}: expected at most {MOST_INCLUDES} times <include> in all, got more; remove some")
        included = self._found(attributes.get("filename", ""), place)
        if len(files) >= DEEPEST_INCLUDE or included in files:
            raise InputError(
                f"{place}: {printable(included.name, SHOWN)} includes itself, or more than {DEEPEST_INCLUDE} files"
                " include one another; remove an <include>"
            )
        try:
            self.include(included, files, attributes.get("name"))
        except OSError as error:
            raise InputError(f"{place}: {printable(included)} could not be read ({error.strerror})") from error

    def _replaced(self, value: str, place: str) -> str:
        """Return a value with its variables replaced, longest names first, as Mitsuba does."""
        if "$" not in value:
            return value
        for name in sorted(self._variables, key=len, reverse=True):
            if name in value:
                times, new = value.count(name), self._variables[name]
                if len(value) + times * len(new) > LARGEST_TEXT // 64:
                    raise InputError(f"{place}: a value grows by its variables beyond 1 MB; shorten it")
                value = re.sub(rf"(?<!\\){re.escape(name)}", lambda _, new=new: new, value)
        unknown = re.search(r"(?<!\\)\$\w*", value)
        if unknown:
            raise InputError(f"{place}: expected a <default> of {printable(unknown[0], SHOWN)}, got none; add it")
        return value.replace("\\$", "$")

    def _check_files(self, tag: str, attributes: dict[str, str], parent: WorldElement | None, place: str) -> None:
        """Make a named file absolute, and check it. Raises InputError."""
        key = None
        plugin = "" if parent is None else parent.attributes.get("type", "")
        name, value = attributes.get("name"), attributes.get("value", "")
        if tag == "string" and name == "filename":
            key = "value"
        elif tag == "spectrum" and "filename" in attributes:
            key, plugin = "filename", "spectrum"
        elif tag == "string" and ("/" in value or "\\" in value):
            named = printable(f"{name} = {value}", SHOWN)
            raise InputError(f"{place}: expected files in 'filename' alone, got the path {named}")
        if key is not None:
            path = self._found(attributes[key], place)
            self.files[path] = None
            self.checked[path] = plugin
            attributes[key] = str(path.resolve())

    def _found(self, name: str, place: str, is_folder: bool = False) -> Path:
        """Return the path of a file that a world names. Raises InputError unless it is regular and may be read."""
        what, shown = "folder" if is_folder else "file", printable(name, SHOWN)
        try:
            found = next((at for base in self._searched if name and (at := base / name).exists()), None)
            if found is None:
                raise InputError(f"expected a {what} beside the world's, found no '{shown}'; add or remove it")
            whole = found.resolve(strict=True)
            if self._within is not None and not whole.is_relative_to(self._within):
                raise InputError(
                    f"expected a {what} in the folder of the world's file, got '{shown}' outside it; move it there, or"
                    " add --allow-outside"
                )
            if is_folder != whole.is_dir():
                raise InputError(f"expected a {what}, got '{shown}'")
            if not is_folder:
                check_regular(whole)
        except InputError as error:
            raise InputError(f"{place}: {error}") from error
        except (OSError, RuntimeError, ValueError) as error:  # a circle of links, a name that is too long
            raise InputError(f"{place}: '{shown}' could not be opened; correct it") from error
        return found


def _check_type(attributes: dict[str, str], place: str) -> None:
    plugin = attributes.get("type")
    if plugin is not None and plugin not in plugin_names():
        raise InputError(f"{place}: expected a plugin that Mitsuba ships, got type '{printable(plugin, SHOWN)}'")


def _words(attributes: dict[str, str]) -> str:
    escaped = {key: value.replace("$", "\\$") for key, value in attributes.items()}
    return "".join(f" {key}={quoteattr(value)}" for key, value in escaped.items())


@dataclass
class WorldElement:
    """An element of a Mitsuba file and the line of its start."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[WorldElement] = field(default_factory=lambda: list[WorldElement]())


def read_xml(path: Path) -> WorldElement:
    """Read the elements of a Mitsuba file. Raises InputError that does not name the file, OSError if it is missing."""
    parser, within, root, elements = expat.ParserCreate(), list[WorldElement](), list[WorldElement](), count(1)

    def start(tag: str, attributes: dict[str, str]) -> None:
        if next(elements) > MOST_ELEMENTS:
            raise InputError(f"there are more than {MOST_ELEMENTS} elements; expected fewer")
        element = WorldElement(tag, attributes, parser.CurrentLineNumber)
        (within[-1].children if within else root).append(element)
        within.append(element)

    def end(_: str) -> None:
        within.pop()

    def refuse(*_: object) -> None:
        raise InputError("has a document type or entities (<!DOCTYPE>); remove them")

    parser.StartElementHandler, parser.EndElementHandler, parser.StartDoctypeDeclHandler = start, end, refuse
    try:
        parser.Parse(read_bytes(path, LARGEST_TEXT), True)
    except InputError:
        raise
    except (expat.ExpatError, ValueError, LookupError) as error:  # the latter for unknown encodings
        raise InputError(f"is not valid XML: {printable(error, SHOWN)}; correct it there") from error
    return root[0]


@cache
def plugin_names() -> frozenset[str]:
    """Return the names of Mitsuba's plugins."""
    return frozenset(path.stem for path in (mitsuba_folder() / "plugins").iterdir() if path.suffix in LIBRARIES)
