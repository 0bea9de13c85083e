"""The worlds that a diagnosis is checked in: how each deals, draws and scores its joints.

``narrow``: close to their beliefs, eight experiments. ``wide``: as they come in practice. ``zoo``: of MuJoCo, and real.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_hil.blind import judged, score, spoilt, wide, zoo
from frictid_hil.blind import page as narrow_page
from frictid_hil.blind.generator import assignments, dealt, draw_case, rounded, write_case
from frictid_hil.blind.score import Answer
from frictid_hil.files import write_whole

_Plain = dict[str, Any]
Documents = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class World:
    """One world."""

    # (cases, seed) -> what each case shall be; plain and small, they go to other processes.
    cards: Callable[[int, int], Sequence[Any]]
    # (index, seed, card, folder) -> truth; the set is written to ``folder``.
    draw: Callable[[int, int, Any, Path], dict[str, Any]]
    # (truths, lines of the diagnosing process), both by case -> scores.
    score: Callable[[Mapping[str, Mapping[str, Any]], Documents], dict[str, Any]]
    headline: Callable[[Mapping[str, Any]], dict[str, Mapping[str, Any]]]  # scores -> rates by name
    page: Callable[[Mapping[str, Any]], str]  # result -> Markdown


def write_rows(folder: Path, nominal: Mapping[str, Any], rows: Sequence[wide.Row]) -> None:
    """A set: ``nominal.yaml`` and one gzipped CSV per recording."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "nominal.yaml", yaml.safe_dump(rounded(dict(nominal)), sort_keys=False))
    for row in rows:
        table = np.column_stack(list(row.columns.values()))
        header = ",".join(row.columns)
        np.savetxt(folder / f"{row.name}.csv.gz", table, fmt="%.10g", delimiter=",", header=header, comments="")


def _draw_narrow(index: int, seed: int, card: Any, folder: Path) -> dict[str, Any]:
    case = draw_case(index, seed, card)
    write_case(case, folder / case.name)
    return case.truth


def _written(draw: Callable[[int, int, Any], wide.Drawn], index: int, seed: int, card: Any, folder: Path) -> _Plain:
    nominal, rows, truth = draw(index, seed, card)
    write_rows(folder / truth["case"], nominal, rows)
    plain: _Plain = rounded(truth)
    return plain


def _draw_zoo(index: int, seed: int, card: Any) -> wide.Drawn:
    return spoilt.draw_spoilt(index, seed, card) if isinstance(card, Path) else zoo.draw_zoo(index, seed, card)


def _dealt(kinds: Sequence[str], cases: int, seed: int) -> list[str]:
    return dealt(np.random.default_rng([seed, 707]), kinds, cases)


def _zoo_cards(cases: int, seed: int) -> list[Any]:
    """Every third case a real recording, where there are any."""
    real = spoilt.recorded_sets()
    cards: list[Any] = list(_dealt(zoo.KINDS, cases, seed))
    for k in range(2, cases, 3):
        if real:
            cards[k] = real[(seed + k // 3) % len(real)]
    return cards


_JUDGED = judged.judged, judged.headline, judged.page
WORLDS: dict[str, World] = {
    "narrow": World(
        assignments,
        _draw_narrow,
        lambda truths, lines: score.score(truths, {name: Answer.from_json(line) for name, line in lines.items()}),
        narrow_page.headline,
        narrow_page.page,
    ),
    "wide": World(partial(_dealt, wide.KINDS), partial(_written, wide.draw_wide), *_JUDGED),
    "zoo": World(_zoo_cards, partial(_written, _draw_zoo), *_JUDGED),
}
