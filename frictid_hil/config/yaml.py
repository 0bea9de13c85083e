"""YAML in, with every value remembering its place: what a person sees in an error is ``hp3j.yaml:8:14: joints.1...``.

Scalars follow YAML 1.2's core schema (yamlcore): ``1e-3`` is a number, ``off`` and ``12:30`` are text. Keys are
always text, so ``1:`` and ``"1":`` name the same joint, and a repeated key is an error. Hostile files (huge, deeply
nested, aliases of aliases) are refused before they cost memory.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml
import yamlcore

from frictid_hil.errors import ConfigError, FieldProblem, InvalidFields

Key = str | int
KeyPath = tuple[Key, ...]

MAX_BYTES = 16_000_000
MAX_DEPTH = 40
MAX_NODES = 500_000
_TEXT = "tag:yaml.org,2002:str"
_SCALARS = {
    f"tag:yaml.org,2002:{kind}": yamlcore.CCoreLoader.yaml_constructors[f"tag:yaml.org,2002:{kind}"]
    for kind in ("bool", "int", "float", "null")
}


class Place(NamedTuple):
    """Where in a file; line and column count from 1."""

    path: Path
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.path.name}:{self.line}:{self.column}"


class Node(NamedTuple):
    """One value of the file with its place, and that of the key that names it (its own in a list and at the root)."""

    place: Place
    key_place: Place
    content: Any  # a scalar, or the children by key or index
    is_list: bool = False  # tells lists from mappings; both keep their children in ``content``
    size: int = 1  # number of nodes, aliases counted as often as they are used

    @property
    def is_mapping(self) -> bool:
        """Whether the children are named."""
        return isinstance(self.content, dict) and not self.is_list

    def plain(self) -> Any:
        """The value as plain dicts, lists and scalars."""
        if not isinstance(self.content, dict):
            return self.content
        if self.is_list:
            return [child.plain() for child in self.content.values()]
        return {key: child.plain() for key, child in self.content.items()}


@dataclass(frozen=True, slots=True)
class Document:
    """A file read: its values, and where each stands."""

    path: Path
    root: Node  # its values; always a mapping
    # from a path of ``root`` to the keys as the file spells them, where the loader renamed some
    spelled: Callable[[KeyPath], KeyPath] = tuple

    @property
    def data(self) -> dict[str, Any]:
        """The values alone, in a fresh mapping."""
        return dict(self.root.plain())

    def deepest(self, path: KeyPath) -> tuple[Node, KeyPath]:
        """The node at ``path``, or the deepest that exists on the way there, and the path to it."""
        node = self.root
        for depth, key in enumerate(path):
            children = node.content if isinstance(node.content, dict) else {}
            if key not in children:
                return node, path[:depth]
            node = children[key]
        return node, path

    def place(self, path: KeyPath, *, of_key: bool = False) -> Place:
        """Where ``path`` stands; for a path that does not exist, the key of what should hold it."""
        node, found = self.deepest(path)
        return node.key_place if of_key or found != path else node.place

    def error(self, problems: Iterable[FieldProblem], *, at_key: Collection[KeyPath] = ()) -> ConfigError:
        """Problems, one a line in the order of the file, each with its place, or with its key's (``at_key``)."""
        placed = [(self.place(p.path, of_key=p.path in at_key), p) for p in problems]
        placed.sort(key=lambda one: (one[0].path.name, one[0].line, one[0].column))
        lines = [
            (str(place), f"{'.'.join(map(str, self.spelled(p.path)))}: {p.message}" if p.path else p.message)
            for place, p in placed
        ]
        (where, what), *others = lines
        return ConfigError("\n".join([what, *(f"{w}: {m}" for w, m in others)]), where=where)

    @contextmanager
    def locating(self, under: KeyPath = ()) -> Iterator[None]:
        """Give ``InvalidFields`` raised inside, with paths relative to ``under``, their places as a ``ConfigError``."""
        try:
            yield
        except InvalidFields as invalid:
            raise self.error([FieldProblem(under + p.path, p.message) for p in invalid.problems]) from invalid


def read(path: Path) -> Document:
    """Read one YAML file (``ConfigError``: unreadable, not UTF-8, not YAML, a key twice, or not a mapping)."""
    return parse(_text(path), path)


def parse(text: str, path: Path) -> Document:
    """Read YAML from text; ``path`` names it in errors, which are those of ``read``."""
    if len(text) > MAX_BYTES:
        raise _too_large(path)
    try:
        root = _Builder(text, path).document()
    except yaml.YAMLError as error:
        raise _syntax_error(error, text, path) from None
    if not root.is_mapping:
        found = "empty" if root.content is None else "a list" if root.is_list else f"just {root.content!r}"
        raise ConfigError(f"expected keys and values at the top of the file; it is {found}", where=str(root.place))
    return Document(path, root)


def merge(base: Node, over: Node) -> Node:
    """``base`` with the values of ``over``: mappings merge key by key, null removes, everything else is replaced."""
    if not (base.is_mapping and over.is_mapping):
        return over
    children = dict(base.content)
    for key, child in over.content.items():
        if key in children and child.content is None:
            del children[key]
        else:
            children[key] = merge(children[key], child) if key in children else child
    return Node(over.place, over.key_place, children, size=1 + sum(c.size for c in children.values()))


def _text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        raise ConfigError("no such file", where=str(path)) from None
    except IsADirectoryError:
        raise ConfigError("this is a folder, not a file", where=str(path)) from None
    except PermissionError:
        raise ConfigError(
            "no permission to read the file", where=str(path), next_step=f"try `ls -l {path}` and `chmod u+r`"
        ) from None
    except (OSError, ValueError) as error:
        raise ConfigError(f"cannot be read: {error}", where=str(path)) from None
    if len(raw) > MAX_BYTES:
        raise _too_large(path)
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        column = error.start - raw.rfind(b"\n", 0, error.start)
        raise ConfigError(
            f"not UTF-8: byte 0x{raw[error.start]:02x}",
            where=f"{path.name}:{line}:{column}",
            cause="a binary file, or text saved in another encoding (Latin-1, UTF-16)",
            next_step="save it as UTF-8",
        ) from None


def _too_large(path: Path) -> ConfigError:
    return ConfigError(f"larger than {MAX_BYTES // 1_000_000} MB; this is no configuration file", where=str(path))


def _syntax_error(error: yaml.YAMLError, text: str, path: Path) -> ConfigError:
    if isinstance(error, yaml.MarkedYAMLError) and (mark := error.problem_mark or error.context_mark):
        where = Place(path, mark.line + 1, mark.column + 1)
        source = text.splitlines()
        line = source[mark.line] if mark.line < len(source) else ""
        if line[: mark.column + 1].strip(" ").startswith("\t") or line[mark.column : mark.column + 1] == "\t":
            return ConfigError("a tab where YAML wants spaces", where=str(where), next_step="indent with spaces")
        if "nesting depth" in str(error.problem):  # libyaml 0.2.6 and later has a bound of its own, and meets it first
            return ConfigError(f"nested deeper than {MAX_DEPTH} levels", where=str(where))
        context = f" ({error.context})" if error.context else ""
        return ConfigError(f"not valid YAML: {error.problem}{context}", where=str(where))
    if isinstance(error, yaml.reader.ReaderError):
        before = text[: error.position]
        where = Place(path, before.count("\n") + 1, error.position - before.rfind("\n"))
        return ConfigError(f"not valid YAML: {error.reason}", where=str(where), cause="a binary file?")
    return ConfigError(f"not valid YAML: {error}", where=path.name)


class _Builder:
    """From libyaml's events to nodes; recursion is bounded here, before any of it reaches the C composer."""

    def __init__(self, text: str, path: Path) -> None:
        self._events = yamlcore.CCoreLoader(text)
        self._next: Callable[[], Any] = self._events.get_event
        self._path = path
        self._anchors: dict[str, Node] = {}
        self._nodes = 0

    def document(self) -> Node:
        self._next()  # stream start
        event = self._next()  # document start
        if isinstance(event, yaml.StreamEndEvent):
            start = Place(self._path, 1, 1)
            return Node(start, start, None)
        root = self._node(self._next(), None, 0)
        self._next()  # document end
        event = self._next()
        if not isinstance(event, yaml.StreamEndEvent):
            raise self._refused("a second document starts here; one file holds one", self._place(event))
        return root

    def _node(self, event: Any, key_place: Place | None, depth: int) -> Node:
        place = self._place(event)
        if depth > MAX_DEPTH:
            raise self._refused(f"nested deeper than {MAX_DEPTH} levels", place)
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self._anchors:
                raise self._refused(f"*{event.anchor} refers to nothing (or to what contains it)", place)
            target = self._anchors[event.anchor]
            self._count(target.size, place)
            return Node(target.place, key_place or place, target.content, target.is_list, target.size)
        self._count(1, place)
        if event.tag is not None and event.tag != "!" and not event.tag.startswith("tag:yaml.org,2002:"):
            raise self._refused(f"tags like {event.tag} are not read", place)
        if isinstance(event, yaml.ScalarEvent):
            node = Node(place, key_place or place, self._scalar(event, place))
        else:
            is_list = isinstance(event, yaml.SequenceStartEvent)
            children = self._sequence(depth) if is_list else self._mapping(depth)
            size = 1 + sum(child.size for child in children.values())
            node = Node(place, key_place or place, children, is_list, size)
        if event.anchor:
            self._anchors[event.anchor] = node
        return node

    def _mapping(self, depth: int) -> dict[Key, Node]:
        children: dict[Key, Node] = {}
        while not isinstance(event := self._next(), yaml.MappingEndEvent):
            place = self._place(event)
            if not isinstance(event, yaml.ScalarEvent):
                raise self._refused("a key must be plain text", place)
            key = event.value
            if key in children:
                first = children[key].key_place
                raise self._refused(f"key {key!r} appears twice; first on line {first.line}", place)
            children[key] = self._node(self._next(), place, depth + 1)
        return children

    def _sequence(self, depth: int) -> dict[Key, Node]:
        children: dict[Key, Node] = {}
        while not isinstance(event := self._next(), yaml.SequenceEndEvent):
            children[len(children)] = self._node(event, None, depth + 1)
        return children

    def _scalar(self, event: Any, place: Place) -> Any:
        tag, events = event.tag, self._events
        if tag is None or tag == "!":
            tag = events.resolve(yaml.ScalarNode, event.value, event.implicit if tag is None else (False, True))
        if tag == _TEXT:
            return event.value
        try:
            return _SCALARS[tag](events, yaml.ScalarNode(tag, event.value))
        except (ValueError, KeyError, yaml.constructor.ConstructorError):
            raise self._refused(f"{event.value[:40]!r} is not a valid {tag.rpartition(':')[2]}", place) from None

    def _count(self, nodes: int, place: Place) -> None:
        self._nodes += nodes
        if self._nodes > MAX_NODES:
            raise self._refused(f"more than {MAX_NODES} values", place)

    def _place(self, event: Any) -> Place:
        mark = event.start_mark
        return Place(self._path, mark.line + 1, mark.column + 1)

    @staticmethod
    def _refused(what: str, place: Place) -> ConfigError:
        return ConfigError(what, where=str(place))
