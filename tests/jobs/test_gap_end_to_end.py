"""From the bus to the cause and back: a virtual robot carries one effect that its nominal joint lacks.

Recorded by ``gap record --short``, diagnosed, the improved joint written as a robot file, and the validation recordings
simulated again with it. Each of the twenty effects in turn, sizes drawn from a seed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy import signal

from frictid_hil.config.search import find
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet
from frictid_hil.jobs.gap_diagnose import diagnose
from frictid_hil.jobs.gap_record import GapRecordOptions, record
from frictid_hil.jobs.watch import Silent
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.replay import Controller, closed_loop

HP3J = find("hp3j.yaml").resolve()
SEED = 20

SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "backlash": {"gap_rad": (1e-3, 4e-3)},
    "direction_asymmetry": {"coulomb_share": (0.05, 0.15), "viscous_share": (0.05, 0.15)},
    "electrical_lag": {"time_constant_s": (1.5e-3, 4e-3)},
    "encoder_offset": {"offset_rad": (0.04, 0.12)},
    "encoder_quantisation": {"step_rad": (1e-4, 3e-4)},
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
    "velocity_lag": {"time_constant_s": (3e-3, 8e-3)},
    "viscous_nonlinearity": {"share": (0.3, 0.8), "knee_rad_s": (0.2, 0.6)},
}


@dataclass(frozen=True)
class Outcome:
    """What came of one effect."""

    effect: str
    verdict: str
    named: str
    flagged: tuple[str, ...]
    confidence: float
    left_of_gap: float

    @property
    def right(self) -> bool:
        """Named first, or its partner named and it flagged."""
        return self.named == self.effect or self.effect in self.flagged

    @property
    def closed(self) -> bool:
        """A fifth of the nominal model's error above the noise floor is left, or less."""
        return self.left_of_gap <= 0.2


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


def drawn(effect: str) -> dict[str, float]:
    """Sizes of an effect, from the seed and its name."""
    rng = np.random.default_rng([SEED, sorted(SIZES).index(effect)])
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


def outcome_of(effect: str, folder: Path) -> Outcome:
    """Record, diagnose, write, simulate again."""
    folder.mkdir()
    robot = robot_with({effect: drawn(effect)}, folder)
    recorded = record(GapRecordOptions(str(robot), "0", short=True, out=folder / "set"), Silent())
    if recorded["outcome"] != "ok":
        return Outcome(effect, recorded["error"]["what"], "", (), 0.0, 1.0)
    improved = folder / "improved.yaml"
    found = diagnose(folder / "set", write_model=improved, apply=True)
    causes = found["causes"]
    experiments = ExperimentSet.load(folder / "set")
    floor = torque_error_nm(joint_of(robot), experiments)
    nominal = torque_error_nm(joint_of(robot_with({}, folder)), experiments)
    written = torque_error_nm(joint_of(improved), experiments)
    return Outcome(
        effect,
        found["verdict"],
        causes[0]["effect"] if causes else "",
        tuple(causes[0]["confusable_with"]) if causes else (),
        causes[0]["confidence"] if causes else 0.0,
        max(0.0, written - floor) / max(nominal - floor, 1e-9),
    )


def test_sizes_are_given_for_every_effect_and_lie_in_its_bounds(tmp_path: Path) -> None:
    assert set(SIZES) == set(all_effects())
    bare = joint_of(robot_with({}, tmp_path))
    for name in SIZES:
        assert bare.with_effects({name: drawn(name)}).effects[name] != all_effects()[name].off


@pytest.fixture(autouse=True)
def _runs_stay_in_the_test_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_at_least_seventeen_of_twenty_effects_are_named_and_closed(tmp_path: Path) -> None:
    outcomes = [outcome_of(effect, tmp_path / effect) for effect in SIZES]
    for outcome in outcomes:
        print(outcome)
    right = [outcome for outcome in outcomes if outcome.right]
    assert len(right) >= 17, [outcome for outcome in outcomes if not outcome.right]
    assert not [outcome for outcome in right if not outcome.closed]
