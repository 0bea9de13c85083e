"""What half and double of each constant of the diagnosis changes, on drawn joints and on recordings of real machines.

    python benchmarks/gap_sensitivity.py [--world wide] [--cases 40] [--seed 1] [--tables 10] [--jobs 2] [--write-docs]
        [--only verdict.DOUBTED ...]

``--world real`` takes the sets of ``gap_real`` instead of drawn joints, all of them or the first ``--cases``.

Every joint is diagnosed as it is, then once for each constant at half and at double its value. What a constant cannot
change is computed once: recordings, tables of the channels, simulations of the same joint. Constants that enter the
tables themselves need them anew and are varied on ``--tables`` of the joints alone. Counted are joints whose verdict
changes, joints whose first cause changes, and those answered rightly.
"""

from __future__ import annotations

import argparse
import copy
import itertools
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from gap_real import cases as real_cases
from gap_real import real_data

from frictid_hil.blind.check import draw_sealed
from frictid_hil.config.provenance import git_revision
from frictid_hil.errors import FrictidError
from frictid_hil.gap import (
    actuation_channel,
    borne_out,
    both_ways,
    command_timing,
    findings,
    forward,
    generic,
    how_far,
    kinematics,
    linear_loop,
    link_in_loop,
    loop_channel,
    noise,
    nuisances,
    plainest,
    plant_channel,
    position_noise,
    posterior,
    prepared,
    presliding,
    quiet,
    reading,
    residuals,
    rigid_column,
    smoothing,
    tick_timing,
    tracking_channel,
    verdict,
)
from frictid_hil.gap import diagnose as diagnosis
from frictid_hil.gap import told as telling
from frictid_hil.gap.channel import Channel
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.forward import Replay
from frictid_hil.gap.posterior import Posterior

DOCS_PAGE = Path(__file__).parents[1] / "docs" / "evidence" / "gap-sensitivity.md"
BEGIN, END = "<!-- written by benchmarks/gap_sensitivity.py -->", "<!-- end of what it wrote -->"
FACTORS = (0.5, 2.0)
LATE: tuple[tuple[ModuleType, str], ...] = (
    (findings, "ABSENT"), (findings, "ALIKE"), (findings, "SIDED"), (findings, "UNTOLD"), (findings, "EITHER"),
    (verdict, "FLOORS"), (verdict, "AS_STATED"), (verdict, "MOST_EXPECTED"), (verdict, "FLOORS_AS_STATED"),
    (verdict, "STANDS_OUT"), (verdict, "REMAINS"), (verdict, "DOUBTED"), (verdict, "HALF"),
    (verdict, "LISTED"), (verdict, "NEEDED"), (verdict, "CERTAIN"), (verdict, "EVEN"), (verdict, "LEADS"),
    (verdict, "FORMS_OFF"), (verdict, "VARIES"), (verdict, "HELPS"),
    (both_ways, "FAIR_SHARE"), (both_ways, "TIE"), (both_ways, "LIKELY"), (reading, "READ"),
    (borne_out, "BOUNCED"), (borne_out, "REFUTED"), (borne_out, "FAR"), (link_in_loop, "LOGS"),
    (link_in_loop, "SPREAD"),
    (how_far, "COLOUR"), (how_far, "APPEARED"), (how_far, "WINDOW_S"),
    (quiet, "NEGLIGIBLE"), (quiet, "LOUD"), (telling, "PARTLY"), (diagnosis, "UNDECIDED"),
)  # fmt: skip
"""What is said of a posterior."""
SEARCHED: tuple[tuple[ModuleType, str], ...] = (
    (posterior, "EXPECTED"), (posterior, "WORTH"), (posterior, "FORM"), (posterior, "EXACT_FORM"),
    (posterior, "MOST_DOUBT"), (posterior, "VISIBLE"), (posterior, "MOST"), (posterior, "TRIED"), (posterior, "POINTS"),
    (posterior, "STRETCHES"), (plainest, "CANCELS"), (plainest, "CLEAR"), (plainest, "ONE_PART"),
)  # fmt: skip
"""The search over models."""
TABLES: tuple[tuple[ModuleType, str], ...] = (
    (noise, "LOCAL_S"), (noise, "ORDER"), (posterior, "SLOW"), (posterior, "MEMORY_S"), (posterior, "CARE"),
    (plant_channel, "BEYOND"), (plant_channel, "SIZES"), (plant_channel, "SWAMPED"), (plant_channel, "UNTOLD"),
    (plant_channel, "LINE_SHARE"), (generic, "WAYS_RAD"), (generic, "REST_S"), (generic, "STILL_S"),
    (generic, "REACHES"), (nuisances, "FREE"), (nuisances, "STIFFER"), (actuation_channel, "WITHIN_ROWS"),
    (reading, "COARSE"), (linear_loop, "CREEP"), (loop_channel, "STANDS_S"),
    (loop_channel, "COUNTS"), (presliding, "CLEARLY"), (residuals, "LEAST_SHARE"),
    (command_timing, "HALVED"), (command_timing, "ALIKE"),
    (presliding, "TRAVELS"), (presliding, "SLOW_RAD_S"), (presliding, "BEGINS_RAD_S"), (presliding, "WRONG"),
    (rigid_column, "APART"), (rigid_column, "FILTERS_HZ"), (rigid_column, "ON_AND_ON_RAD"),
    (smoothing, "CLIFF_DB"), (smoothing, "SILENT_DB"), (smoothing, "BELOW_DB"), (smoothing, "OWN_DB"),
    (smoothing, "LEAST_HZ"), (smoothing, "MOST_HZ"), (smoothing, "KEPT"), (smoothing, "PART_S"),
    (plant_channel, "SEVERAL"), (nuisances, "ANYWHERE"), (nuisances, "REVERSING"),
    (residuals, "TICKS"), (residuals, "LEAST_STEPS"), (residuals, "BRIEF"),
    (tick_timing, "CLEARLY"), (position_noise, "NOISE_SHARE"), (tracking_channel, "SPREAD"),
)  # fmt: skip
"""The tables of the channels."""
SIMULATED: tuple[tuple[ModuleType, str], ...] = ((forward, "RIGID_SUBSTEP_S"),)
"""The joint under its controller."""
CHANCES = (
    "SIDED", "DOUBTED", "NEEDED", "CERTAIN", "LEADS", "EVEN", "UNTOLD", "REFUTED", "UNDECIDED", "LISTED", "CLEARLY",
    "EITHER", "PARTLY", "HELPS", "FAIR_SHARE", "TIE", "LIKELY", "READ", "ONE_PART", "KEPT",
)  # fmt: skip

Answer = tuple[str, str]
"""Verdict and first cause; the verdict again where none is named."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", choices=("narrow", "wide", "zoo", "real"), default="wide")
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--tables", type=int, default=10, help="joints on which constants of the tables are varied")
    parser.add_argument("--jobs", type=int, default=1)
    known = [_named(*one) for one in (*LATE, *SEARCHED, *TABLES, *SIMULATED)]
    parser.add_argument("--only", nargs="+", choices=known, default=known, metavar="CONSTANT", help="vary these alone")
    parser.add_argument("--write-docs", action="store_true")
    arguments = parser.parse_args()
    only = frozenset(arguments.only)
    if arguments.write_docs and only != frozenset(known):
        parser.error("--write-docs writes the whole table: leave --only out")
    rows = measured(arguments.world, arguments.cases, arguments.seed, arguments.tables, arguments.jobs, only)
    told = table(rows)
    print(told)
    if arguments.write_docs:
        head, rest = DOCS_PAGE.read_text(encoding="utf-8").split(BEGIN)
        command = (
            f"--world {arguments.world} --cases {arguments.cases} --seed {arguments.seed} --tables {arguments.tables}"
        )
        source = f"`python benchmarks/gap_sensitivity.py {command}`, commit {git_revision()}:"
        DOCS_PAGE.write_text(f"{head}{BEGIN}\n\n{source}\n\n{told}\n\n{END}{rest.split(END)[1]}", encoding="utf-8")


Row = list[int]
"""Joints, verdicts changed, first causes changed, right answers; of the same joints as it is: right answers."""


@dataclass(frozen=True, slots=True)
class Case:
    """One joint, and the first answers that are right."""

    load: Callable[[], ExperimentSet]
    right: tuple[str, ...]


def measured(world: str, cases: int, seed: int, tables: int, jobs: int, only: frozenset[str]) -> dict[str, Row]:
    """What was counted, by what was varied."""
    with tempfile.TemporaryDirectory(prefix="frictid-sensitivity-") as folder:
        joints = real()[:cases] if world == "real" else drawn(world, cases, seed, Path(folder), jobs)
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
            whole = [k < tables for k in range(len(joints))]
            answers = list(pool.map(all_answers, [one.load for one in joints], whole, itertools.repeat(only)))
    rows: dict[str, Row] = {}
    for joint, answer in zip(joints, answers, strict=True):
        plain = answer["as it is"]
        for what, one in answer.items():
            row = rows.setdefault(what, [0, 0, 0, 0, 0])
            was, is_now = plain[1] in joint.right, one[1] in joint.right
            changes = (1, one[0] != plain[0], one[1] != plain[1], is_now, was)
            rows[what] = [a + int(b) for a, b in zip(row, changes, strict=True)]
    return rows


def drawn(world: str, cases: int, seed: int, folder: Path, jobs: int) -> list[Case]:
    """Joints of a world of the blind check."""
    sealed = draw_sealed(world, cases, seed, folder, jobs, lambda *_: None)
    load = ExperimentSet.load
    return [Case(partial(load, sealed.folder / name), right(truth)) for name, truth in sorted(sealed.truths.items())]


def real() -> list[Case]:
    """Recordings of real machines, every fifth of a kind first, so that a few of them are of many machines."""
    known = list(real_cases(real_data(), real_data("FRICTID_REAL_MORE_DATA", "real-more")))
    mixed = [one for first in range(5) for one in known[first::5]]
    return [Case(load, truth.accept) for _, _, truth, load in mixed]


def right(truth: Mapping[str, Any]) -> tuple[str, ...]:
    """The first cause: one that acts; ``none`` of a healthy joint, ``unknown`` of what has no name."""
    if truth["kind"] in ("none", "outside"):
        return ({"none": "none", "outside": "unknown"}[truth["kind"]],)
    return tuple(truth.get("main") or [effect["name"] for effect in truth["effects"]])


def all_answers(load: Callable[[], ExperimentSet], tables: bool, only: frozenset[str]) -> dict[str, Answer]:
    """The answer as it is, and with each of the given constants at half and at double."""
    experiments = load()
    answers: dict[str, Answer] = {}

    def vary(constants: Sequence[tuple[ModuleType, str]]) -> None:
        for what, module, name, factor in _variations([one for one in constants if _named(*one) in only]):
            with changed(module, name, factor):
                answers[what] = _answer(experiments)

    answers["as it is"] = _answer(experiments)
    if tables:
        vary(SIMULATED)
    with ExitStack() as held:
        held.enter_context(put(prepared, "fit_kinematics", once(kinematics.fit_kinematics)))
        held.enter_context(put(prepared, "believed_joint", once(prepared.believed_joint, as_recorded)))
        held.enter_context(put(prepared, "Replay", once(Replay, as_recorded)))
        if tables:
            vary(TABLES)
        for name in ("plant_channel", "actuation_channel", "tracking_channel"):
            held.enter_context(put(reading, name, once(getattr(reading, name), library)))
        held.enter_context(put(reading, "Posterior", same_tables()))
        vary(SEARCHED)
        held.enter_context(put(reading, "sampled", once(findings.sampled, lambda one: columns(one.channel))))
        vary(LATE)
    return answers


def once(function: Any, key: Callable[..., object] = lambda *told: len(told)) -> Any:
    """A function that is asked once for each key, and answers the same ever after."""
    known: dict[object, Any] = {}

    def same(*told: Any, **named: Any) -> Any:
        asked = key(*told), tuple(sorted(named.items()))
        if asked not in known:
            known[asked] = function(*told, **named)
        return known[asked]

    return same


def as_recorded(experiments: ExperimentSet, *_: object) -> tuple[str, float]:
    """What tells one set of a joint from another: its beliefs, and when its commands came into force."""
    commands = (e.position_command_rad for e in experiments.experiments)
    return repr(experiments.nominal), float(sum(np.abs(c).sum() for c in commands if c is not None))


def library(*told: Any) -> tuple[str, ...]:
    """The effects that a channel may use: of its arguments, the one that holds names alone."""
    names = (one for one in told if isinstance(one, (list, tuple)) and one and isinstance(one[0], str))
    return tuple(next(names, ()))


def columns(channel: Channel) -> tuple[str, int, float]:
    """What tells a channel from another one of the same joint."""
    return channel.name, len(channel.candidates), float(sum(np.abs(log.y).sum() for log in channel.logs))


def same_tables() -> Callable[[Channel, int], Posterior]:
    """A posterior as new, whose tables are those of the first one of the same channel."""
    known: dict[tuple[str, int, float], Posterior] = {}

    def anew(channel: Channel, library: int) -> Posterior:
        if columns(channel) not in known:
            known[columns(channel)] = Posterior(channel, library)
        again = copy.copy(known[columns(channel)])
        again.begin(library)
        return again

    return anew


def _answer(experiments: ExperimentSet) -> Answer:
    try:
        told = diagnosis.diagnose(experiments, negligible=quiet.NEGLIGIBLE)
    except FrictidError:
        return "refused", "refused"
    named = told.causes and told.verdict in ("explained", "ambiguous")
    return told.verdict, told.causes[0].effect if named else told.verdict


def _variations(constants: Sequence[tuple[ModuleType, str]]) -> Iterator[tuple[str, ModuleType, str, float]]:
    for module, name in constants:
        for factor in FACTORS:
            yield f"{_named(module, name)} x {factor:g}", module, name, factor


def _named(module: ModuleType, name: str) -> str:
    return f"{module.__name__.rpartition('.')[2]}.{name}"


@contextmanager
def changed(module: ModuleType, name: str, factor: float, *, odds: bool | None = None) -> Iterator[None]:
    """A constant times a factor wherever it is used, whole where it is a number of things; of a chance, its odds."""
    of_a_chance = name in CHANCES and (module, name) != (plant_channel, "UNTOLD") if odds is None else odds
    value = getattr(module, name)
    if isinstance(value, tuple):
        other: Any = tuple(one * factor for one in value)
    else:
        other = type(value)(value * factor)
    if of_a_chance:
        changed_odds = factor * value / (1.0 - value)
        other = changed_odds / (1.0 + changed_odds)
    users = [m for n, m in sys.modules.items() if n.startswith("frictid_hil.gap.") and m.__dict__.get(name) is value]
    with ExitStack() as held:
        for user in users:
            held.enter_context(put(user, name, other))
        yield


@contextmanager
def put(module: ModuleType, name: str, other: Any) -> Iterator[None]:
    """Something else in the place of what a module calls by a name."""
    value = getattr(module, name)
    setattr(module, name, other)
    try:
        yield
    finally:
        setattr(module, name, value)


def table(rows: Mapping[str, Row]) -> str:
    """One row for each variation that changes an answer, the most telling first, and the other constants by name."""
    lines = [
        "| constant | joints | verdict changes | first cause changes | right | as it is |",
        "|---|---|---|---|---|---|",
    ]
    others = {what: row for what, row in rows.items() if what != "as it is"}
    loud = sorted((one for one in others.items() if any(one[1][1:3])), key=lambda one: -one[1][1] / one[1][0])
    for what, (joints, verdicts, causes, good, was) in loud:
        lines.append(f"| {what} | {joints} | {verdicts} | {causes} | {good} | {was} |")
    heard = {what.partition(" x ")[0] for what, _ in loud}
    still = dict.fromkeys(name for what in others if (name := what.partition(" x ")[0]) not in heard)
    within = sum(row[1] <= 0.02 * row[0] for row in others.values())
    lines += [
        "",
        f"{within} of {len(others)} variations change at most 2 % of the verdicts. Neither half nor double of these "
        f"changes any answer: {', '.join(still)}.",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
