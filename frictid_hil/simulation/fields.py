"""Reading a nested mapping from a file field by field, so that every mistake in it is found at once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from frictid_hil.errors import FieldProblem, InvalidFields


class Fields:
    """One mapping being read; problems are shared with its parts and raised together by ``finish``."""

    def __init__(
        self, mapping: Any, path: tuple[str | int, ...] = (), problems: list[FieldProblem] | None = None
    ) -> None:
        self.path = path
        self.problems: list[FieldProblem] = [] if problems is None else problems
        self._read: list[str] = []
        self._mapping: Mapping[str, Any] = {}
        if isinstance(mapping, Mapping):
            self._mapping = mapping
        else:
            self.problem("", f"expected a mapping, found {mapping!r}")

    def __contains__(self, key: str) -> bool:
        return self._mapping.get(key) is not None

    def keys(self) -> list[str]:
        """Keys as written."""
        return [str(key) for key in self._mapping]

    def problem(self, key: str, message: str) -> None:
        """Note what is wrong with one field."""
        self.problems.append(FieldProblem((*self.path, key) if key else self.path, message))

    def part(self, key: str) -> Fields:
        """The mapping under a key; empty where the key is absent."""
        self._read.append(key)
        value = self._mapping.get(key)
        return Fields({} if value is None else value, (*self.path, key), self.problems)

    def number(
        self, key: str, default: float | None = None, *, low: float = -math.inf, high: float = math.inf
    ) -> float:
        """A finite number within [low, high]; required where there is no default."""
        self._read.append(key)
        value = self._mapping.get(key)
        if value is None:
            if default is None:
                self.problem(key, "is required")
            return low if default is None and math.isfinite(low) else (default or 0.0)
        if not _is_number(value):
            self.problem(key, f"expected a number, found {value!r}")
        elif not math.isfinite(value) or not low <= value <= high:
            self.problem(key, f"expected a number {_range(low, high)}, found {value!r}")
        else:
            return float(value)
        return low if math.isfinite(low) else 0.0

    def numbers(self, key: str) -> list[float]:
        """A list of finite numbers, not empty."""
        self._read.append(key)
        value = self._mapping.get(key)
        items = list(value) if isinstance(value, list | tuple) else []
        if items and all(_is_number(item) and math.isfinite(item) for item in items):
            return [float(item) for item in items]
        self.problem(key, f"expected a list of numbers, found {value!r}")
        return []

    def choice(self, key: str, default: str, allowed: tuple[str, ...]) -> str:
        """One of a few words."""
        self._read.append(key)
        value = self._mapping.get(key, default)
        if value not in allowed:
            self.problem(key, f"expected one of {', '.join(allowed)}, found {value!r}")
            return default
        return str(value)

    def no_others(self) -> None:
        """Every key that was not read is unknown."""
        for key in self._mapping:
            if key not in self._read:
                known = ", ".join(dict.fromkeys(self._read))
                self.problem(str(key), f"is unknown; known keys are {known or 'none'}")

    def finish(self) -> None:
        """Raise everything found as an ``InvalidFields``."""
        if self.problems:
            raise InvalidFields(self.problems)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _range(low: float, high: float) -> str:
    if math.isfinite(low) and math.isfinite(high):
        return f"from {low:g} to {high:g}"
    if math.isfinite(low):
        return f"of at least {low:g}"
    return f"of at most {high:g}" if math.isfinite(high) else "that is finite"
