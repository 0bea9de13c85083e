"""A model file as its user wrote it, includes too, edited in place: what is not changed stays byte for byte."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from frictid_hil.errors import InputFileError

_START_TAG = re.compile(rb"""<(?:[^"'>]|"[^"]*"|'[^']*')*>""")  # a ``>`` within quotes is no end
_NOT_JOINTS = ("equality", "fixed", "default", "sensor", "actuator")


@dataclass(eq=False, slots=True)
class Element:
    """One element."""

    tag: str  # its name
    attributes: dict[str, str]  # as written, defaults not resolved
    start: int  # first byte
    inside: int  # first byte after its start tag
    end: int  # first byte of its end tag; ``inside`` for an empty element
    empty: bool  # it has no end tag
    parent: Element | None  # None for the root
    file: XmlFile  # that holds it


@dataclass(eq=False, slots=True)
class XmlFile:
    """One file: its bytes, its elements in the order of their start, and the changes collected so far."""

    path: Path
    content: bytes
    elements: list[Element] = field(default_factory=list)
    changes: list[tuple[int, int, bytes]] = field(default_factory=list)

    @staticmethod
    def read(path: Path) -> XmlFile:
        """Parse a file; ``InputFileError`` where it is unreadable, or no XML."""
        try:
            file = XmlFile(path, path.read_bytes())
            _parse(file)
        except (OSError, expat.ExpatError) as error:
            raise InputFileError(f"cannot be read: {error}", where=str(path)) from None
        return file

    @property
    def root(self) -> Element:
        """The outermost element."""
        return self.elements[0]

    def changed(self) -> bytes:
        """The content with all changes."""
        text = self.content
        for start, end, new in sorted(self.changes, key=lambda change: -change[0]):
            text = text[:start] + new + text[end:]
        return text


def _parse(file: XmlFile) -> None:
    parser = expat.ParserCreate()
    parser.buffer_text = True
    open_ones: list[Element] = []

    def started(tag: str, attributes: dict[str, str]) -> None:
        start = parser.CurrentByteIndex
        match = _START_TAG.match(file.content, start)
        assert match is not None  # expat has read it
        inside = match.end()
        empty = file.content[inside - 2 : inside] == b"/>"
        parent = open_ones[-1] if open_ones else None
        element = Element(tag, dict(attributes), start, inside, inside, empty, parent, file)
        file.elements.append(element)
        open_ones.append(element)

    def ended(tag: str) -> None:
        element = open_ones.pop()
        if not element.empty:
            element.end = parser.CurrentByteIndex

    parser.StartElementHandler = started
    parser.EndElementHandler = ended
    parser.Parse(file.content, True)


class ModelText:
    """The files of a model; ``InputFileError`` where one of them cannot be read."""

    def __init__(self, path: Path) -> None:
        self.main = XmlFile.read(path)
        self.files = {path.resolve(): self.main}
        self._elements = list(self._all(self.main))

    def _all(self, file: XmlFile) -> Iterator[Element]:
        for element in file.elements:
            yield element
            if element.tag == "include" and "file" in element.attributes:
                path = (self.main.path.parent / element.attributes["file"]).resolve()
                if path not in self.files:
                    self.files[path] = XmlFile.read(path)
                    yield from self._all(self.files[path])

    def joint(self, name: str) -> Element:
        """The element of a joint; ``InputFileError`` where it does not stand in the files by this name."""
        for element in self._elements:
            inside = element.parent.tag if element.parent is not None else ""
            if element.tag == "joint" and element.attributes.get("name") == name and inside not in _NOT_JOINTS:
                return element
        raise InputFileError(
            f"joint {name} does not stand in the file by this name",
            where=str(self.main.path),
            cause="it is made by <replicate> or <attach>",
            next_step="write the model out whole (mujoco.MjSpec.to_xml) and give that file",
        )

    def actuators(self, joint: str) -> list[Element]:
        """The elements that drive a joint, in order."""
        return [
            e
            for e in self._elements
            if e.parent is not None and e.parent.tag in ("actuator", "mujocoinclude")
            and e.attributes.get("joint", e.attributes.get("jointinparent")) == joint
            and e.tag != "joint"
        ]  # fmt: skip

    def section(self, tag: str) -> Element | None:
        """The last section of a name below a root: what is added there moves no index of what stands before."""
        below = (e for e in reversed(self._elements) if e.tag == tag and e.parent is not None)
        return next((e for e in below if e.parent and e.parent.tag in ("mujoco", "mujocoinclude")), None)

    def children(self, element: Element, tag: str) -> list[Element]:
        """The direct children of a name."""
        return [e for e in element.file.elements if e.tag == tag and e.parent is element]

    def set(self, element: Element, attributes: Mapping[str, str | None], *, tag: str | None = None) -> None:
        """Set attributes of an element, and its tag if it is empty; None takes an attribute away."""
        content = element.file.content[element.start : element.inside].decode()
        for name, value in attributes.items():
            element.attributes.pop(name, None)
            found = re.search(rf"""\s+{re.escape(name)}\s*=\s*("[^"]*"|'[^']*')""", content)
            if value is not None:
                element.attributes[name] = value
            if found:
                new = "" if value is None else f' {name}="{value}"'
                content = content[: found.start()] + new + content[found.end() :]
            elif value is not None:
                at = len(content) - (2 if element.empty else 1)
                gap = content[:at].rstrip()
                content = f'{gap} {name}="{value}"{content[at:]}'
        if tag is not None and element.empty:
            content = f"<{tag}{content[len(element.tag) + 1 :]}"
        changes = element.file.changes
        changes[:] = [c for c in changes if c[:2] != (element.start, element.inside)]
        changes.append((element.start, element.inside, content.encode()))

    def add_after(self, element: Element, text: str) -> None:
        """Put text on a line of its own after an element."""
        file = element.file
        at = element.inside if element.empty else file.content.index(b">", element.end) + 1
        indent = _indent(file.content, element.start)
        lines = "".join(f"\n{indent}{line}" for line in text.splitlines())
        file.changes.append((at, at, lines.encode()))

    def add_inside(self, element: Element, text: str) -> None:
        """Put text as the last child of an element, which is given an end tag if it has none."""
        file = element.file
        indent = _indent(file.content, element.start)
        lines = "".join(f"{indent}  {line}\n" for line in text.splitlines())
        if element.empty:
            slash = file.content.rindex(b"/", element.start, element.inside)
            new = f">\n{lines}{indent}</{element.tag}>".encode()
            file.changes.append((slash, element.inside, new))
            return
        line_start = file.content.rfind(b"\n", 0, element.end) + 1
        blank = not file.content[line_start : element.end].strip()
        at = line_start if blank and line_start > element.inside else element.end
        file.changes.append((at, at, lines.encode() if at == line_start else f"\n{lines}{indent}".encode()))

    def written(self, out: Path) -> dict[Path, bytes]:
        """What to write so that ``out`` is the changed model: it, and changed copies of what it includes.

        An included file that changes is written beside ``out`` under the name ``OUT_INCLUDED.xml`` unless ``out`` is
        the user's own file; paths of what stays where it is are made to lead there.
        """
        here, there = self.main.path.resolve().parent, out.resolve().parent
        same = out.resolve() == self.main.path.resolve()
        made: dict[Path, bytes] = {}
        moved: dict[Path, str] = {}
        for path, file in self.files.items():
            if file is not self.main and file.changes:
                name = path.name if same else f"{out.stem}_{path.name}"
                target = path if same else there / name
                moved[path] = os.path.relpath(target, there)
                made[target] = file.changed()
        for element in self.main.elements:
            if element.tag == "include" and "file" in element.attributes:
                path = (here / element.attributes["file"]).resolve()
                to = moved.get(path, os.path.relpath(path, there))
                if to != element.attributes["file"] and not same:
                    self.set(element, {"file": to})
        if here != there:
            self._lead_to_assets(os.path.relpath(here, there))
        made[out] = self.main.changed()
        return made

    def _lead_to_assets(self, back: str) -> None:
        """Meshes and textures stay where they are."""
        compiler = self.section("compiler")
        with_files = any(
            "file" in e.attributes for e in self._elements if e.tag in ("mesh", "texture", "hfield", "skin")
        )
        if not with_files:
            return
        if compiler is None:
            self.add_inside(self.main.root, f'<compiler meshdir="{back}" texturedir="{back}"/>')
            return
        both = compiler.attributes.get("assetdir", "")
        self.set(
            compiler,
            {
                name: os.path.join(back, compiler.attributes.get(name, both))  # noqa: PTH118 - a text of the file
                for name in ("meshdir", "texturedir")
            },
        )


def _indent(content: bytes, start: int) -> str:
    line = content[content.rfind(b"\n", 0, start) + 1 : start].decode()
    return line if not line.strip() else line[: len(line) - len(line.lstrip())]
