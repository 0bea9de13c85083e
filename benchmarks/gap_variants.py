"""Real recordings made into others whose right answer is known, or must not change: does the diagnosis keep its word?

The same recordings seen otherwise (mirrored, in another unit, every second row, in another order, half of the logs, a
log at rest beside them) must have the same first cause. Recordings with something added that has a name (a torque
constant, a load, cogging, a level of friction, a delay, play) must have that name, or ``unknown``; with pushes,
``unknown``. A cause of ``BESIDE`` times the gap that was there must be named or ``unknown``, and how often it is named
is counted. Prints one line per answer that is not so, and the counts. ``--only WORD`` takes variants or sets with
that word in their name; ``--every K`` takes one set in K.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from gap_real import Known, cases, diagnosed, real_data, swings, two_link

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.diagnosis import Diagnosis
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet
from frictid_hil.gap.residuals import LowPass, recordings, rms
from frictid_hil.gap.sanity import completed

LINKS_M = (0.3, 0.2)  # lengths of the double pendulum's links
PLAIN = 2.0
"""Size of what is added over the gap that was there, from which on it must be named."""
BESIDE = 1.3  # size of a cause over the gap of the machine's own that it stands beside: it is 63 % of the power
SURE, FALSE_CLEAR = 0.9, 3.0
TORQUE = ("torque_nm", "rigid_body_torque_nm", "torque_demand_nm")
Change = Callable[[ExperimentSet], ExperimentSet | None]
Added = Callable[[Experiment, Array, Array], Array]
"""A torque by log, velocity and acceleration, both low-passed."""


@dataclass(frozen=True, slots=True)
class Variant:
    """A change of a set; ``causes`` is what it adds, empty where nothing may change, None for what has no name."""

    change: Change
    causes: tuple[str, ...] | None = ()


def each(change: Callable[[Experiment], Experiment]) -> Change:
    """A change of every log."""
    return lambda s: replace(s, experiments=tuple(change(e) for e in s.experiments))


def columns(e: Experiment, change: Callable[[str, Array], Array]) -> Experiment:
    """All columns of a log but its time through a function of (name, column)."""
    names = ("position_rad", "velocity_rad_s", "position_command_rad", *TORQUE)
    changed: dict[str, Any] = {n: change(n, c) for n in names if (c := getattr(e, n)) is not None}
    return replace(e, **changed)


def _scaled(factor: float) -> Change:
    """Another unit of torque: columns and belief alike."""

    def change(s: ExperimentSet) -> ExperimentSet | None:
        n = s.nominal
        if all(e.torque_nm is None for e in s.experiments) or n.controller is not None:
            return None
        stiffness = n.presliding_stiffness_nm_per_rad
        belief = replace(
            n,
            curve=None if n.curve is None else replace(n.curve, torque_nm=tuple(factor * t for t in n.curve.torque_nm)),
            inertia_kg_m2=None if n.inertia_kg_m2 is None else factor * n.inertia_kg_m2,
            presliding_stiffness_nm_per_rad=None if stiffness is None else factor * stiffness,
        )
        logs = each(lambda e: columns(e, lambda name, c: factor * c if name in TORQUE else c))(s)
        return None if logs is None else replace(logs, nominal=belief)

    return change


def _thinned(e: Experiment) -> Experiment:
    return columns(replace(e, time_s=e.time_s[::2]), lambda _, c: c[::2])


def _thin(s: ExperimentSet) -> ExperimentSet | None:
    steps = [float(np.median(np.diff(e.time_s))) for e in s.experiments]
    return each(_thinned)(s) if max(steps) < 0.006 and s.nominal.controller is None else None


def _half(s: ExperimentSet) -> ExperimentSet | None:
    """Half of the logs of each role."""
    kept = [e for role in (True, False) for e in [x for x in s.experiments if x.validation == role][::2]]
    if len(kept) == len(s.experiments):
        return None
    return replace(s, experiments=tuple(sorted(kept, key=lambda e: e.run_order)))


def _reordered(s: ExperimentSet) -> ExperimentSet:
    logs = list(reversed(s.experiments))
    return replace(s, experiments=tuple(replace(e, name=f"take {k}", run_order=k) for k, e in enumerate(logs)))


def _at_rest(s: ExperimentSet) -> ExperimentSet | None:
    """A log beside the others in which the joint hardly moves: the longest still stretch of its own noise."""
    e = s.experiments[0]
    if e.torque_nm is None:
        return None
    rng = np.random.default_rng(3)
    rows = 1000
    still = e.position_rad[0] + 1e-6 * rng.standard_normal(rows)
    torque = float(e.torque_nm[0]) + 1e-3 * rms(e.torque_nm) * rng.standard_normal(rows)
    step = float(np.median(np.diff(e.time_s)))
    rigid = None if e.rigid_body_torque_nm is None else np.full(rows, float(e.rigid_body_torque_nm[0]))
    log = Experiment("rest", False, False, 99, step * np.arange(rows), still, torque_nm=torque,
                     rigid_body_torque_nm=rigid)  # fmt: skip
    return replace(s, experiments=(*s.experiments, log))


def _torque(added: Added, only: Callable[[Experiment], bool] | None = None) -> Change:
    """A torque added along the motion, to all logs or some."""

    def change(s: ExperimentSet) -> ExperimentSet | None:
        if any(e.torque_nm is None for e in s.experiments):
            return None
        return each(lambda e: e if only is not None and not only(e) else _with_torque(e, added))(s)

    return change


def _with_torque(e: Experiment, added: Added) -> Experiment:
    step = float(np.median(np.diff(e.time_s)))
    velocity = LowPass.at(1.0 / step)(np.gradient(e.position_rad, step))
    assert e.torque_nm is not None
    return replace(e, torque_nm=e.torque_nm + added(e, velocity, np.gradient(velocity, step)))


def _beside(added: Added) -> Change:
    """A cause as large as ``BESIDE`` of the gap that is there."""

    def change(s: ExperimentSet) -> ExperimentSet | None:
        one = _torque(added)(s)
        if one is None or not (size := added_over_gap(s, one)) > 0.0:
            return None
        return _torque(lambda e, velocity, acceleration: BESIDE / size * added(e, velocity, acceleration))(s)

    return change


def _with_the_load(e: Experiment, velocity: Array, acceleration: Array) -> Array:
    load = e.rigid_body_torque_nm if e.rigid_body_torque_nm is not None else e.torque_nm
    assert load is not None
    torque: Array = _direction(velocity) * np.abs(load)
    return torque


def _harder_one_way(e: Experiment, velocity: Array, acceleration: Array) -> Array:
    torque: Array = np.abs(_direction(velocity)) + np.abs(velocity) / rms(velocity)
    return torque


def _direction(velocity: Array) -> Array:
    """Of the motion; through 0 within a twentieth of its usual speed."""
    direction: Array = np.tanh(velocity / (0.05 * rms(velocity)))
    return direction


def _level(share: float) -> Change:
    """Friction that is believed too low or too high as a whole."""

    def change(s: ExperimentSet) -> ExperimentSet | None:
        curve, stiffness = s.nominal.curve, s.nominal.presliding_stiffness_nm_per_rad
        if curve is None:
            return None
        believed = replace(curve, torque_nm=tuple(t / (1.0 + share) for t in curve.torque_nm))
        spring = None if stiffness is None else stiffness / (1.0 + share)
        return replace(s, nominal=replace(s.nominal, curve=believed, presliding_stiffness_nm_per_rad=spring))

    return change


def _rigid(factor: float) -> Change:
    """A rigid-body column that is off as a whole: by a torque constant, or by inertia and gravity alike."""

    def change(s: ExperimentSet) -> ExperimentSet | None:
        if any(e.rigid_body_torque_nm is None for e in s.experiments):
            return None
        return each(lambda e: columns(e, lambda n, c: factor * c if n == "rigid_body_torque_nm" else c))(s)

    return change


def _inertia(factor: float, *, filtered: bool = False) -> Change:
    """A rigid-body column whose inertia is another than the joint's: what of it goes with the joint's acceleration."""

    def change(s: ExperimentSet) -> ExperimentSet | None:
        if any(e.rigid_body_torque_nm is None for e in s.experiments):
            return None
        tables, accelerations = [], []
        for e in s.experiments:
            assert e.rigid_body_torque_nm is not None
            step, q = float(np.median(np.diff(e.time_s))), e.position_rad
            low_pass = LowPass.at(1.0 / step)
            accelerations.append(np.gradient(np.gradient(low_pass(q) if filtered else q, step), step))
            own = [accelerations[-1], np.cos(q), np.sin(q), np.ones_like(q), e.rigid_body_torque_nm]
            tables.append(low_pass(np.stack(own, axis=1))[10:-10])
        table = np.concatenate(tables)
        inertia = float(np.linalg.lstsq(table[:, :-1], table[:, -1], rcond=None)[0][0])
        if inertia <= 0.0:
            return None
        more = [(factor - 1.0) * inertia * a for a in accelerations]
        pairs = zip(s.experiments, more, strict=True)
        return replace(s, experiments=tuple(_with_column(e, "rigid_body_torque_nm", m) for e, m in pairs))

    return change


def _with_column(e: Experiment, changed: str, more_nm: Array) -> Experiment:
    return columns(e, lambda name, column: column + more_nm if name == changed else column)


def _load(mass_share: float) -> Added:
    """A payload at the end of the link: gravity and inertia of a size that the joint's torque knows."""

    def added(e: Experiment, velocity: Array, acceleration: Array) -> Array:
        assert e.torque_nm is not None
        nm = mass_share * float(np.std(e.torque_nm))
        torque: Array = nm * (np.cos(e.position_rad) + 0.04 * acceleration)
        return torque

    return added


def _at_the_tip(kilograms: float) -> Change:
    """A point mass at the end of the double pendulum's second link, which moves as both joints do."""

    def change(s: ExperimentSet) -> ExperimentSet | None:
        folder = real_data()
        if folder is None or not s.name.startswith("double_pendulum"):
            return None
        _, prefix, _, joint = s.name.split()
        number, g, (first, second) = int(joint), 9.81, LINKS_M
        mass = kilograms * np.array([first**2 + second**2, second**2, first * second, g * first, g * second])
        logs = {log.name: log for log in swings(folder, prefix)}
        more = [two_link(logs[e.name], number) @ mass for e in s.experiments]
        pairs = zip(s.experiments, more, strict=True)
        return replace(s, experiments=tuple(_with_column(e, "torque_nm", m) for e, m in pairs))

    return change


def _cogging(cycles: float, share: float) -> Added:
    def added(e: Experiment, velocity: Array, acceleration: Array) -> Array:
        assert e.torque_nm is not None
        torque: Array = share * float(np.std(e.torque_nm)) * np.cos(cycles * e.position_rad + 0.7)
        return torque

    return added


def _pushed(e: Experiment, velocity: Array, acceleration: Array) -> Array:
    """Three pushes of half a second by hand, at random."""
    assert e.torque_nm is not None
    rng = np.random.default_rng(zlib.crc32(e.name.encode()))
    t = e.time_s - e.time_s[0]
    height = 1.5 * float(np.std(e.torque_nm))
    pushes = [rng.choice([-1.0, 1.0]) * np.exp(-0.5 * ((t - rng.uniform(0.1, 0.9) * t[-1]) / 0.15) ** 2) for _ in "123"]
    torque: Array = height * np.sum(pushes, axis=0)
    return torque


def _later(seconds: float) -> Change:
    """The joint follows its command later than it did."""

    def change(s: ExperimentSet) -> ExperimentSet | None:
        if any(e.position_command_rad is None or e.torque_nm is not None for e in s.experiments):
            return None
        return each(lambda e: replace(e, position_rad=np.interp(e.time_s - seconds, e.time_s, e.position_rad)))(s)

    return change


def _with_play(s: ExperimentSet) -> ExperimentSet | None:
    if any(e.position_command_rad is None or e.torque_nm is not None for e in s.experiments):
        return None

    def play(e: Experiment) -> Experiment:
        half, link = 0.03, np.array(e.position_rad)
        for k in range(1, link.size):
            link[k] = np.clip(link[k - 1], e.position_rad[k] - half, e.position_rad[k] + half)
        return replace(e, position_rad=link)

    return each(play)(s)


def _mirrored(e: Experiment) -> Experiment:
    return columns(e, lambda _, c: -c)


LOADS = ("gravity_error", "inertia_error", "torque_constant_error")
CURVES = ("friction_level_error",)
VARIANTS: dict[str, Variant] = {
    "mirrored": Variant(each(_mirrored)),
    "in another unit": Variant(_scaled(37.0)),
    "every second row": Variant(_thin),
    "later by the clock": Variant(each(lambda e: replace(e, time_s=e.time_s + 1e4))),
    "in reverse order, renamed": Variant(_reordered),
    "half of the logs": Variant(_half),
    "a log at rest": Variant(_at_rest),
    **{
        f"torque reported x {f:g}": Variant(
            _torque(lambda e, v, a, f=f: (f - 1.0) * e.torque_nm),  # type: ignore[misc]
            ("torque_constant_error",),
        )
        for f in (0.92, 1.04, 1.08, 1.15)
    },
    **{f"rigid body x {f:g}": Variant(_rigid(f), LOADS) for f in (0.9, 1.1, 1.2)},
    **{f"inertia believed x {f:g}": Variant(_inertia(f), ("inertia_error",)) for f in (0.5, 2.0)},
    "inertia believed x 2, filtered": Variant(_inertia(2.0, filtered=True), ("inertia_error",)),
    "a payload": Variant(_torque(_load(0.5)), LOADS),
    "a payload at the tip": Variant(_at_the_tip(0.5), LOADS),
    "a payload in judged logs": Variant(_torque(_load(0.5), lambda e: e.validation), None),
    "pushes": Variant(_torque(_pushed), None),
    "pushes in judged logs": Variant(_torque(_pushed, lambda e: e.validation), None),
    **{f"cogging, {c} a turn": Variant(_torque(_cogging(c, 0.3)), ("torque_ripple",)) for c in (12, 37, 72, 90)},
    **{f"friction {100 * s:+.0f} %": Variant(_level(s), CURVES) for s in (-0.2, -0.1, 0.1, 0.2)},
    **{f"later by {1e3 * s:g} ms": Variant(_later(s), ("torque_delay", "electrical_lag")) for s in (0.02, 0.06)},
    "friction with the load beside the gap": Variant(
        _beside(_with_the_load), ("load_dependent_friction", "directional_efficiency")
    ),
    "asymmetry beside the gap": Variant(_beside(_harder_one_way), ("direction_asymmetry",)),
    "inertia beside the gap": Variant(_beside(lambda e, v, a: a), ("inertia_error",)),
    "play": Variant(_with_play, ("backlash", "torque_delay")),
}


def added_over_gap(before: ExperimentSet, after: ExperimentSet) -> float:
    """RMS of what a variant adds to the torque missing along the motion over that which was; nan where none is."""
    if any(e.torque_nm is None for e in before.experiments):
        return float("nan")
    gaps = []
    for s in (before, after):
        logs = recordings(completed(s)[0])
        parts = [LowPass.at(1.0 / r.step_s)(r.plant_nm)[10:-10] for r in logs if r.plant_nm is not None]
        gaps.append(parts)
    if [p.size for p in gaps[0]] != [p.size for p in gaps[1]]:
        return float("nan")
    change = np.concatenate(gaps[1]) - np.concatenate(gaps[0])
    return rms(change) / max(rms(np.concatenate(gaps[0])), 1e-300)


@dataclass(frozen=True, slots=True)
class Answered:
    """One variant of one set: what was said before and after, and by how much what was added stands out."""

    name: str
    variant: Variant
    known: Known
    before: Diagnosis | None
    after: Diagnosis | None
    stands_out: float

    @property
    def told(self) -> list[tuple[str, float]]:
        """Causes that the verdict names, with their confidence."""
        d = self.after
        named = d is not None and d.verdict in ("explained", "ambiguous")
        return [(c.effect, c.confidence) for c in d.causes] if named and d is not None else []

    @property
    def accepted(self) -> tuple[str, ...]:
        """Names that are right first: of what was added, and of what was there."""
        return (*(self.variant.causes or ()), *self.known.accept)

    @property
    def false_clear(self) -> bool:
        """``none`` beside a gap of three floors, by the diagnosis' own figures."""
        d = self.after
        if d is None or d.verdict != "none":
            return False
        gap, floor = d.before.inverse_nm, d.noise_floor.inverse_nm
        return gap is not None and floor is not None and gap > FALSE_CLEAR * floor

    @property
    def sure_and_wrong(self) -> bool:
        """A first cause of 0.9 that was neither added nor there."""
        return bool(self.told) and self.told[0][1] >= SURE and self.told[0][0] not in self.accepted

    @property
    def missed(self) -> bool:
        """What must be named is not, or a name comes up where nothing has changed."""
        if self.variant.causes == ():
            return self.before is not None and _first(self.before) != _first(self.after)
        if self.variant.causes is None:
            return _first(self.after) not in ("unknown", *self.known.accept)
        first = _first(self.after)
        plain = self.stands_out > PLAIN and self.before is not None and self.before.verdict in ("none", "unknown")
        return first not in self.variant.causes if plain else first not in ("unknown", *self.accepted)


def _first(d: Diagnosis | None) -> str:
    if d is None:
        return "refused"
    return d.causes[0].effect if d.causes and d.verdict in ("explained", "ambiguous") else d.verdict


def answers(only: Sequence[str], every: int) -> Iterator[Answered]:
    """Every variant of every set that it makes sense for."""
    more = real_data("FRICTID_REAL_MORE_DATA", "real-more")
    for k, (_, name, known, make) in enumerate(cases(real_data(), more)):
        if k % every:
            continue
        chosen = {n: v for n, v in VARIANTS.items() if all(w in f"{name}: {n}" for w in only)}
        if not chosen:
            continue
        experiments = make()
        before = diagnosed(name, known, lambda e=experiments: e).diagnosis  # type: ignore[misc]
        for title, variant in chosen.items():
            changed = variant.change(experiments)
            if changed is None:
                continue
            after = diagnosed(name, known, lambda e=changed: e)  # type: ignore[misc]
            size = added_over_gap(experiments, changed) if variant.causes else float("nan")
            yield Answered(f"{name}: {title}", variant, known, before, after.diagnosis, size)


def wanted(words: Sequence[str]) -> tuple[list[str], int]:
    """(Words that a variant's name must hold, one set in so many) as the command line asks for."""
    every = int(words[words.index("--every") + 1]) if "--every" in words else 1
    return [words[k + 1] for k, word in enumerate(words) if word == "--only"], every


def main() -> int:
    """Print what is not as it must be, and the counts."""
    words = sys.argv[1:]
    found = []
    for a in answers(*wanted(words)):
        found.append(a)
        judged = {"FALSE NONE": a.false_clear, "SURE AND WRONG": a.sure_and_wrong, "missed": a.missed}
        marks = [mark for mark, bad in judged.items() if bad]
        if marks or "--all" in words:
            before, after = ("refused" if d is None else d.verdict for d in (a.before, a.after))
            size = f"added {a.stands_out:.2g}"
            print(a.name, size, f"{before} -> {after}", a.told[:3], *marks, sep=" | ", flush=True)
    counts = [sum(getattr(a, what) for a in found) for what in ("false_clear", "sure_and_wrong", "missed")]
    beside = [a for a in found if "beside the gap" in a.name]
    named = sum(_first(a.after) in (a.variant.causes or ()) for a in beside)
    print(f"{named} of {len(beside)} causes named that stand beside a gap")
    print(f"{len(found)} answers: {counts[0]} false none, {counts[1]} sure and wrong, {counts[2]} missed")
    return 0


if __name__ == "__main__":
    sys.exit(main())
