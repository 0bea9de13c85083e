"""Cases for the blind check: a joint, the effects it carries, its recordings, and the sealed truth about them.

A case is drawn from (seed, index) alone. Its truth compares the joint with the same joint and the same noise without
the effects: the *gap* of the belief, and the *floor* that an ideal explanation would reach.

``python -m frictid_hil.blind.generator --out DIR --cases N --seed S`` writes ``DIR/cases`` and ``DIR/truth``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_hil.blind.effects import LIBRARY, OUTSIDERS, changed
from frictid_hil.blind.figures import Log, believed_motion, figures, record, together
from frictid_hil.blind.joints import Joint, draw_joint, nominal_mapping
from frictid_hil.blind.plant import TICK_S
from frictid_hil.blind.score import PRACTICAL
from frictid_hil.plan.experiments import FULL

ALIASES = (  # pairs that these columns can hardly separate
    ("torque_bias", "direction_asymmetry"),
    ("torque_delay", "electrical_lag"),
    ("stribeck", "stiction_breakaway"),
    ("encoder_offset", "gravity_error"),
)

VISIBLE = 1.5  # gap over floor from which an effect counts as visible
SMALL, MEDIUM = 4.0, 12.0
SIZED_BY = ("inverse_nm", "actuation_nm", "forward_torque_nm")
_COLUMNS = "time_s,position_rad,velocity_rad_s,torque_nm,position_command_rad"
# Out of 20 cases: 3 healthy, 10 with one effect, 3 with two, 4 from outside.
_KINDS = ("none",) * 3 + ("single",) * 10 + ("double",) * 3 + ("outside",) * 4


@dataclass(frozen=True, slots=True)
class Case:
    """One drawn case."""

    name: str  # ``case_000``
    nominal: dict[str, Any]  # ``nominal.yaml``
    logs: tuple[Log, ...]  # recordings with the effects on
    truth: dict[str, Any]  # what is sealed


@dataclass(frozen=True, slots=True)
class Assignment:
    """What a case shall carry: names of effects, and the kind that scoring goes by."""

    kind: str
    effects: tuple[str, ...]


def assignments(cases: int, seed: int) -> tuple[Assignment, ...]:
    """Kinds and effects of all cases: every effect and every outsider comes up before any comes up again."""
    rng = np.random.default_rng([seed, 101])
    kinds, names = dealt(rng, _KINDS, cases), list(LIBRARY)
    singles, outside = iter(dealt(rng, names, cases)), iter(dealt(rng, list(OUTSIDERS), cases))
    carried: dict[str, Callable[[], tuple[str, ...]]] = {
        "none": lambda: (),
        "single": lambda: (next(singles),),
        "double": lambda: _two(rng, names),
        "outside": lambda: (next(outside),),
    }
    return tuple(Assignment(kind, carried[kind]()) for kind in kinds)


def draw_case(index: int, seed: int, assignment: Assignment, experiments: tuple[str, ...] = FULL) -> Case:
    """One case, the same from the same arguments; the joint is drawn anew where its controller cannot hold it."""
    for attempt in range(50):
        rng = np.random.default_rng([seed, 202, index, attempt])
        noise_seed = [seed, 303, index, attempt]
        joint = draw_joint(rng, experiments)
        ideal = record(joint, joint.physics, noise_seed)
        if not _held(ideal):
            continue
        peak_nm = max(float(np.abs(log.torque_nm).max()) for log in ideal)
        alone = [changed(effect, rng, joint, peak_nm) for effect in assignment.effects]
        physics = joint.physics
        for one in alone:
            physics = physics._replace(**one)
        logs = record(joint, physics, noise_seed) if alone else ideal
        if not _held(logs):
            continue
        believed = believed_motion(joint)
        floors = _figures(joint, ideal, believed)
        name = f"case_{index:03d}"
        truth = _truth(name, joint, assignment, logs, _figures(joint, logs, believed), floors)
        for effect, one in zip(assignment.effects, alone, strict=True):
            told = {
                "name": effect,
                "in_library": effect in LIBRARY,
                "parameters": {n: float(v) for n, v in one.items()},
            }
            if len(alone) > 1:
                lone = record(joint, joint.physics._replace(**one), noise_seed)
                told["size_ratio_alone"] = _ratio(
                    together(_figures(joint, lone, believed), ideal), together(floors, ideal)
                )
            truth["effects"].append(told)
        return Case(name, rounded(nominal_mapping(joint, name)), logs, rounded(truth))
    raise RuntimeError(f"no joint that its controller can hold came up for {assignment}")


def write_case(case: Case, folder: Path) -> None:
    """The case as an experiment set: ``nominal.yaml`` and one CSV per experiment, in ``folder``."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "nominal.yaml").write_text(yaml.safe_dump(case.nominal, sort_keys=False))
    for log in case.logs:
        times_s = np.arange(log.position_rad.size) * TICK_S
        rows = np.column_stack((times_s, log.position_rad, log.velocity_rad_s, log.torque_nm, log.command_rad))
        # Positions to 1e-8 rad: finer than the finest encoder here.
        np.savetxt(
            folder / f"{log.experiment.name}.csv",
            rows,
            fmt=("%.4f", "%.8f", "%.6f", "%.5f", "%.8f"),
            delimiter=",",
            header=_COLUMNS,
            comments="",
        )


def truth_text(truth: dict[str, Any]) -> str:
    """The sealed file of one case."""
    text: str = yaml.safe_dump(truth, sort_keys=False)
    return text


def main() -> None:
    """Write cases and their truth, side by side."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--experiments", nargs="+", default=FULL, help="names of the catalogue")
    arguments = parser.parse_args()
    (arguments.out / "truth").mkdir(parents=True, exist_ok=True)
    for index, assignment in enumerate(assignments(arguments.cases, arguments.seed)):
        case = draw_case(index, arguments.seed, assignment, tuple(arguments.experiments))
        write_case(case, arguments.out / "cases" / case.name)
        (arguments.out / "truth" / f"{case.name}.yaml").write_text(truth_text(case.truth))
        print(case.name, flush=True)


def dealt(rng: np.random.Generator, deck: Sequence[str], count: int) -> list[str]:
    """``count`` cards from shuffled copies of a deck."""
    cards: list[str] = []
    while len(cards) < count:
        cards += [str(card) for card in rng.permutation(list(deck))]
    return cards[:count]


def _two(rng: np.random.Generator, names: list[str]) -> tuple[str, str]:
    """Two effects that are no alias pair, and that the plant can carry at once."""
    apart = [set(pair) for pair in (*ALIASES, ("backlash", "joint_elasticity"))]
    while True:
        first, second = (str(name) for name in rng.choice(names, size=2, replace=False))
        if {first, second} not in apart:
            return first, second


def _held(logs: tuple[Log, ...]) -> bool:
    """The controller follows its commands, and is quiet at the end of every experiment."""
    for log in logs:
        error = log.command_rad - log.position_rad
        if not np.all(np.isfinite(error)) or np.abs(error).max() > 0.25 or np.ptp(error[-100:]) > 0.02:
            return False
    return True


def _figures(joint: Joint, logs: tuple[Log, ...], believed: Any) -> list[dict[str, float]]:
    return [figures(joint, log, run) for log, run in zip(logs, believed, strict=True)]


def _ratio(gap: dict[str, float], floor: dict[str, float]) -> float:
    return max(gap[name] / floor[name] for name in SIZED_BY)


def _truth(
    name: str,
    joint: Joint,
    assignment: Assignment,
    logs: tuple[Log, ...],
    gaps: list[dict[str, float]],
    floors: list[dict[str, float]],
) -> dict[str, Any]:
    gap, floor = together(gaps, logs), together(floors, logs)
    ratio = _ratio(gap, floor) if assignment.effects else 1.0
    size = "small" if ratio < SMALL else "medium" if ratio < MEDIUM else "large"
    validation = [k for k, log in enumerate(logs) if log.experiment.role == "validation"]
    held_out = tuple(logs[k] for k in validation)
    return {
        "case": name,
        "kind": assignment.kind,
        "effects": [],
        "visible": ratio >= VISIBLE or not assignment.effects,
        "size_ratio": ratio,
        "size_class": size if assignment.effects else "none",
        "gap_over_floor": {figure.removesuffix("_nm"): gap[figure] / floor[figure] for figure in SIZED_BY},
        "practical_over_floor": PRACTICAL * joint.belief.coulomb / max(floor[figure] for figure in SIZED_BY),
        "torque_noise_floor_nm": joint.torque_noise_nm,
        "gap": gap,
        "ideal_residual": floor,
        "validation": {
            "gap": together([gaps[k] for k in validation], held_out),
            "ideal_residual": together([floors[k] for k in validation], held_out),
        },
        "aliases": [list(pair) for pair in ALIASES],
        "per_experiment": [
            {"experiment": log.experiment.name}
            | {f"gap_{figure}": value for figure, value in one.items()}
            | {f"floor_{figure}": value for figure, value in ideal.items()}
            for log, one, ideal in zip(logs, gaps, floors, strict=True)
        ],
    }


def rounded(value: Any) -> Any:
    """Numbers to eight significant digits, everything plain."""
    if isinstance(value, dict):
        return {key: rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if isinstance(value, bool | int | str):
        return value
    return float(f"{float(value):.8g}")


if __name__ == "__main__":
    main()
