"""Six joints, two of them with something added in MuJoCo under a sealed seed: is it named there, and nowhere else?

Run: python benchmarks/arm_proof.py [--draws 40] [--seed 1] [--processes 1] [--seconds 40]

Every fourth draw has a cause of the arm instead (payload, link mass, base orientation). The model is then improved and
run in closed loop in MuJoCo along the log that was not fitted, before and after.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from arm_in_mujoco import JOINTS, Machine, write_case

from frictid_hil.jobs.gap.from_model import ModelLogs, sets_from_model
from frictid_hil.jobs.gap.write_model import exports, nearer_only
from frictid_hil.jobs.gap_diagnose import diagnosed

DRY_NM = {"pan": 9.0, "lift": 9.0, "elbow": 6.0, "wrist_1": 1.8, "wrist_2": 1.8, "wrist_3": 1.8}
EFFECTS = {
    "friction_level_error": "friction",
    "viscous_error": "viscous",
    "torque_bias": "bias_nm",
    "direction_asymmetry": "asymmetry",
    "stribeck": "stribeck",
    "load_dependent_friction": "load",
}
ARM_EFFECTS = ("payload", "link_mass_error", "base_orientation_error")


@dataclass(frozen=True, slots=True)
class Draw:
    """What was sealed.

    Attributes:
        machine: to be recorded.
        effects: by joint.
        arm: cause of the arm; empty where there is none.
    """

    machine: Machine
    effects: Mapping[str, str]
    arm: str


def drawn(seed: int, number: int) -> Draw:
    """One machine."""
    random = np.random.default_rng((seed, number))
    if number % 4 == 3:
        return _arm_drawn(random)
    joints = random.choice(JOINTS, 2, replace=False)
    tables: dict[str, Any] = {}
    effects = {}
    for joint in map(str, joints):
        names = [name for name in EFFECTS if name != "load_dependent_friction" or joint in ("lift", "elbow")]
        effect = str(random.choice(names))
        effects[joint] = effect
        side = float(random.choice((-1.0, 1.0)))
        size: Any = {
            "friction_level_error": random.uniform(1.3, 1.6),
            "viscous_error": random.uniform(1.6, 2.2),
            "torque_bias": side * DRY_NM[joint] * random.uniform(0.25, 0.5),
            "direction_asymmetry": side * random.uniform(0.2, 0.35),
            "stribeck": (random.uniform(0.3, 0.5), random.uniform(0.05, 0.12)),
            "load_dependent_friction": random.uniform(0.05, 0.1),
        }[effect]
        tables.setdefault(EFFECTS[effect], {})[joint] = size
    return Draw(Machine(**tables), effects, "")


def _arm_drawn(random: np.random.Generator) -> Draw:
    effect = str(random.choice(ARM_EFFECTS))
    if effect == "payload":
        at = (float(random.uniform(-0.03, 0.03)), float(random.uniform(-0.03, 0.03)), float(random.uniform(0.05, 0.15)))
        return Draw(Machine(payload_kg=float(random.uniform(0.8, 3.0)), payload_at_m=at), {}, effect)
    if effect == "link_mass_error":
        side = float(random.choice((-1.0, 1.0)))
        factor = 1.0 + side * float(random.uniform(0.15, 0.35))
        return Draw(Machine(mass={str(random.choice(("upper", "fore"))): factor}), {}, effect)
    return Draw(Machine(tilt_rad=(float(random.uniform(0.02, 0.06)), float(random.uniform(-0.06, 0.06)))), {}, effect)


def judged(seed: int, number: int, seconds: float, executor: str | None = None) -> dict[str, Any]:
    """One draw, from the user's files to the closed loop; the seal is opened last."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sealed = drawn(seed, number)
        logs = write_case(folder, sealed.machine, seed=100 * seed + number, seconds=seconds)
        begin = time.perf_counter()
        arm = sets_from_model(ModelLogs(folder / "arm.xml", logs, columns=str(folder / "columns.yaml")))
        found = diagnosed(arm, executor)
        took_s = time.perf_counter() - begin
        made, gap = nearer_only(arm, exports(arm, found))
    right = {j: any(c.effect == e for c in found[j].causes) for j, e in sealed.effects.items()}
    first = {j: bool(found[j].causes) and found[j].causes[0].effect == e for j, e in sealed.effects.items()}
    named = {j: [c.effect for c in d.causes] for j, d in found.items() if d.verdict == "explained"}
    quiet = {j: j not in named for j in JOINTS if j not in sealed.effects}
    cause = arm.found.cause if arm.found is not None else None
    closed = {
        j: _closed(gap["before"][j]["torque_nm"], gap["after"][j]["torque_nm"], 0.04 * DRY_NM[j])
        for j in made
        if j in sealed.effects
    }
    return {
        "draw": number,
        "sealed": dict(sealed.effects) or sealed.arm,
        "verdicts": {j: d.verdict for j, d in found.items()},
        "named": named,
        "right": right,
        "first": first,
        "quiet": quiet,
        "arm": cause.effect if cause is not None else "",
        "arm_right": (cause.effect if cause is not None else "") == sealed.arm,
        "closed_percent": closed,
        "left_out": gap["left_out"],
        "seconds": round(took_s, 1),
    }


def _closed(before: float, after: float, floor: float) -> float:
    """Part of the closed-loop torque gap that is gone, noise taken off both."""
    left, was = max(after**2 - floor**2, 0.0), max(before**2 - floor**2, 1e-12)
    return float(100.0 * (1.0 - (left / was) ** 0.5))


def summary(results: list[dict[str, Any]]) -> list[str]:
    """The figures, each with its count."""

    def rate(name: str, flags: list[bool]) -> str:
        return f"{name}: {sum(flags)} of {len(flags)}" + (f" ({100 * sum(flags) / len(flags):.0f} %)" if flags else "")

    joints = [r for r in results if r["right"]]
    closed = [value for r in joints for value in r["closed_percent"].values()]
    lines = [
        rate("effect among the causes of its joint", [flag for r in joints for flag in r["right"].values()]),
        rate("effect first among them", [flag for r in joints for flag in r["first"].values()]),
        rate("other joints without a named cause", [flag for r in joints for flag in r["quiet"].values()]),
        rate("causes of the arm named", [r["arm_right"] for r in results if not r["right"]]),
        rate("no cause of the arm where there is none", [r["arm_right"] for r in joints]),
        rate(
            "joints quiet beside a cause of the arm",
            [f for r in results if not r["right"] for f in r["quiet"].values()],
        ),
    ]
    if closed:
        lines.append(f"closed-loop torque gap closed: median {np.median(closed):.0f} %, n = {len(closed)}")
    lines.append(f"seconds per arm: median {np.median([r['seconds'] for r in results]):.0f}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--processes", type=int, default=1)
    arguments = parser.parse_args()
    results = []
    for number in range(arguments.draws):
        executor = f"processes:{arguments.processes}"
        results.append(judged(arguments.seed, number, arguments.seconds, executor))
        print(json.dumps(results[-1]), flush=True)
    for line in summary(results):
        print(line)


if __name__ == "__main__":
    main()
