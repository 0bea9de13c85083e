"""From the bus to the cause and back: a virtual robot carries one effect that its nominal joint lacks.

Recorded by ``gap record --short``, diagnosed with ``--write-model``, and the validation recordings simulated again with
the robot file that was written. Each effect in turn, sizes drawn from a seed::

    python benchmarks/gap_end_to_end.py [--seed 20] [EFFECT ...]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy import signal

from frictid_hil.config.search import find
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet
from frictid_hil.jobs.gap_diagnose import diagnose
from frictid_hil.jobs.gap_record import GapRecordOptions, record
from frictid_hil.jobs.replay import ReplayOptions, replay
from frictid_hil.jobs.watch import Silent
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.replay import Controller, closed_loop

HP3J = find("hp3j.yaml").resolve()
SEED = 20
ALIKE = 1.1
"""Error of the nominal model over that of the true joint, below which there is nothing to close."""

SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "backlash": {"gap_rad": (1e-3, 4e-3)},
    "controller_gain_error": {"kp_error_share": (0.05, 0.15), "ki_error_share": (0.05, 0.15)},
    "direction_asymmetry": {"coulomb_share": (0.05, 0.15), "viscous_share": (0.05, 0.15)},
    "directional_efficiency": {"driving_share": (0.05, 0.15)},
    "electrical_lag": {"time_constant_s": (1.5e-3, 4e-3)},
    "encoder_offset": {"offset_rad": (0.04, 0.12)},
    "encoder_quantisation": {"step_rad": (1e-4, 3e-4)},
    "friction_level_error": {"error_share": (0.08, 0.2)},
    "gravity_error": {"error_share": (0.05, 0.15)},
    "inertia_error": {"error_share": (0.1, 0.3)},
    "joint_elasticity": {"compliance_rad_per_nm": (1e-4, 4e-4)},
    "load_dependent_friction": {"linear_share": (0.05, 0.15)},
    "presliding_hysteresis": {"share": (0.2, 0.5), "distance_rad": (5e-3, 1.5e-2)},
    "stiction_breakaway": {"share": (0.3, 0.8), "dwell_time_s": (0.3, 1.0), "travel_rad": (1e-3, 3e-3)},
    "stribeck": {"share": (0.15, 0.5), "stribeck_velocity_rad_s": (0.03, 0.1), "exponent": (1.0, 2.0)},
    "temperature_drift": {
        "coulomb_share": (0.15, 0.4),
        "viscous_share": (0.2, 0.5),
        "time_constant_s": (30.0, 90.0),
        "power_w": (3.0, 6.0),
    },
    "torque_bias": {"bias_nm": (0.5, 1.5)},
    "torque_constant_error": {"error_share": (0.03, 0.1)},
    "torque_delay": {"delay_s": (2e-3, 4e-3)},
    "torque_ripple": {"amplitude_nm": (0.2, 0.6), "phase_rad": (-3.0, 3.0)},
    "torque_saturation": {"limit_share": (0.335, 0.355)},
    "transmission_error": {"amplitude_rad": (3e-4, 8e-4), "phase_rad": (-3.0, 3.0)},
    "velocity_lag": {"time_constant_s": (3e-3, 8e-3)},
    "viscous_error": {"error_share": (0.1, 0.3)},
    "viscous_nonlinearity": {"share": (0.3, 0.8), "knee_rad_s": (0.2, 0.6)},
}


@dataclass(frozen=True)
class Outcome:
    """What came of one effect.

    Attributes:
        effect: that the joint carried.
        verdict: of the diagnosis.
        named: first cause; empty where there is none.
        flagged: what the first cause is said to be confusable with.
        confidence: of the first cause.
        left_of_gap: error of the written model over that of the nominal one, both above the true joint's; both
            validation recordings; None where the nominal joint's is within ``ALIKE`` of the true one's.
        left_of_replay: the same by ``replay`` of the unloaded validation recording.
    """

    effect: str
    verdict: str
    named: str
    flagged: tuple[str, ...]
    confidence: float
    left_of_gap: float | None
    left_of_replay: float | None = None

    @property
    def right(self) -> bool:
        """Named first, or its partner named and it flagged."""
        return self.named == self.effect or self.effect in self.flagged

    @property
    def closed(self) -> bool:
        """Whether a fifth of the error above the noise floor is left, or less, or there was nothing to close."""
        return self.left_of_gap is None or self.left_of_gap <= 0.2


def robot_with(effects: Mapping[str, Mapping[str, float]], folder: Path) -> Path:
    """The upper arm of the shipped robot, alone, under a position loop of ordinary stiffness."""
    values: dict[str, Any] = yaml.safe_load(HP3J.read_text())
    joint = {**values["joints"]["2"], "node": 1, "axis": 0}
    inertia = joint["simulated"]["inertia_kg_m2"]
    joint["simulated"] |= {
        "effects": {name: dict(parameters) for name, parameters in effects.items()},
        "servo": {
            "kp_nm_per_rad": inertia * 60.0**2,
            "ki_nm_per_rad_s": inertia * 60.0**3 / 5.0,
            "kd_nm_s_per_rad": inertia * 60.0 * 1.6,
        },
    }
    values.update(name="arm", bus=f"virtual:{folder.name}", joints={"0": joint})
    path = folder / "arm.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


def drawn(effect: str, seed: int = SEED) -> dict[str, float]:
    """Sizes of an effect, from the seed and its name."""
    rng = np.random.default_rng([seed, sorted(SIZES).index(effect)])
    return {name: float(rng.uniform(low, high)) for name, (low, high) in SIZES[effect].items()}


def joint_of(robot: Path) -> JointModel:
    """The simulated joint of a robot file of one joint."""
    (joint,) = yaml.safe_load(robot.read_text())["joints"].values()
    return JointModel.from_mapping(
        joint["simulated"],
        gear_ratio=joint["gear_ratio"],
        rated_torque_nm=joint["rated_torque_nm"],
        max_torque_nm=joint["max_torque_nm"],
    )


def torque_error_nm(model: JointModel, experiments: ExperimentSet) -> float:
    """RMS of recorded minus simulated torque, low-passed, over the validation recordings."""
    known = experiments.nominal.controller
    assert known is not None
    controller = Controller(
        known.kp_nm_per_rad,
        known.ki_nm_per_rad_s,
        known.kd_nm_s_per_rad,
        known.rate_hz,
        known.velocity_filter_s,
        known.torque_limit_nm,
        known.command_rate,
    )
    state, squares = None, []

    def error(log: Experiment) -> Any:
        nonlocal state
        assert log.position_command_rad is not None and log.torque_nm is not None
        rows = closed_loop(model, controller, log.time_s, log.position_command_rad, payload=log.payload, state=state)
        state = rows.state
        return signal.filtfilt(*signal.butter(2, 25.0 / (0.5 * known.rate_hz)), log.torque_nm - rows.torque_nm)

    for log in experiments.experiments:
        left = error(log)
        if log.validation:
            squares.append(np.square(left))
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def replayed_nm(robot: Path, folder: Path) -> float:
    """RMS of measured minus simulated torque that ``replay`` reports for the unloaded validation recording."""
    result = replay(ReplayOptions(folder / "set" / "sines_repeat.csv", str(robot), joints=("0",)))
    return float(result["torque_rms_nm"])


def outcome_of(effect: str, folder: Path, seed: int = SEED) -> Outcome:
    """Record, diagnose, write, simulate again."""
    folder.mkdir()
    robot = robot_with({effect: drawn(effect, seed)}, folder)
    recorded = record(GapRecordOptions(str(robot), "0", short=True, seed=seed, out=folder / "set"), Silent()).to_json()
    if recorded["outcome"] != "ok":
        return Outcome(effect, recorded["error"]["what"], "", (), 0.0, 1.0)
    improved = folder / "improved.yaml"
    found = diagnose(folder / "set", write_model=improved, apply=True)
    causes = found["causes"]
    experiments = ExperimentSet.load(folder / "set")
    bare = folder / "bare"
    bare.mkdir()
    bare_robot = robot_with({}, bare)
    floor, nominal, written = (torque_error_nm(joint_of(r), experiments) for r in (robot, bare_robot, improved))
    truth, believed, told = (replayed_nm(r, folder) for r in (robot, bare_robot, improved))
    return Outcome(
        effect,
        found["verdict"],
        causes[0]["effect"] if causes else "",
        tuple(causes[0]["confusable_with"]) if causes else (),
        causes[0]["confidence"] if causes else 0.0,
        _left(written, nominal, floor),
        _left(told, believed, truth),
    )


def _left(written_nm: float, nominal_nm: float, true_nm: float) -> float | None:
    """Share of the nominal model's error that the written one leaves, both above the true joint's."""
    if nominal_nm < ALIKE * true_nm:
        return None
    return max(0.0, written_nm - true_nm) / (nominal_nm - true_nm)


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f} %"


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("effects", nargs="*", default=list(SIZES))
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args()
    began, outcomes = time.process_time(), []
    headings = ("effect", "named first", "confidence", "verdict", "flagged", "error left", "by `replay`")
    print(f"| {' | '.join(headings)} |\n{'|---' * len(headings)}|")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for effect in options.effects:
            o = outcome_of(effect, Path(folder) / effect, options.seed)
            outcomes.append(o)
            print(
                f"| {o.effect} | {o.named or 'nothing'} | {o.confidence:.2f} | {o.verdict} | {', '.join(o.flagged)} "
                f"| {_percent(o.left_of_gap)} | {_percent(o.left_of_replay)} |",
                flush=True,
            )
    right = [o for o in outcomes if o.right]
    print(
        f"\n{len(right)} of {len(outcomes)} right, {sum(o.closed for o in right)} of these closed to a fifth; "
        f"{time.process_time() - began:.0f} s of processor time"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
