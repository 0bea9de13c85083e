"""The generator of the blind check: independent, repeatable, laid out as an experiment set, right in its physics."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from frictid_hil.blind.effects import LIBRARY, OUTSIDERS
from frictid_hil.blind.figures import believed_motion, figures, record, together
from frictid_hil.blind.generator import Assignment, Case, assignments, draw_case, write_case
from frictid_hil.blind.joints import Joint, base_friction, draw_joint, nominal_mapping
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.forward import Replay, pooled

pytestmark = pytest.mark.slow

PRACTICE = Path(
    os.environ.get("FRICTID_PRACTICE_DATA", Path(__file__).resolve().parents[3] / "shared" / "data" / "gap-practice")
)

DESIGNED = [
    "stribeck",
    "viscous_nonlinearity",
    "direction_asymmetry",
    "load_dependent_friction",
    "torque_ripple",
    "presliding_hysteresis",
    "stiction_breakaway",
    "backlash",
    "joint_elasticity",
    "torque_delay",
    "torque_constant_error",
    "torque_saturation",
    "velocity_lag",
    "encoder_quantisation",
    "encoder_offset",
    "gravity_error",
    "inertia_error",
    "temperature_drift",
    "torque_bias",
    "electrical_lag",
]


def without_traces(joint: Joint) -> Joint:
    """The joint that its belief describes exactly."""
    return replace(joint, physics=joint.belief, payload=joint.believed_payload)


@pytest.fixture(scope="module")
def joint() -> Joint:
    return without_traces(draw_joint(np.random.default_rng([4, 2])))


@pytest.mark.slow
def test_the_generator_never_loads_the_effect_library() -> None:
    script = (
        "import sys, frictid_hil.blind.generator\n"
        "print([m for m in sys.modules if m.startswith(('frictid_hil.simulation', 'frictid_hil.gap.posterior'))])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_effect_of_the_design_is_drawn_and_no_outsider_shares_a_name() -> None:
    assert list(LIBRARY) == DESIGNED
    assert len(OUTSIDERS) >= 8
    assert not set(LIBRARY) & set(OUTSIDERS)


def test_kinds_are_dealt_so_that_every_single_effect_comes_up() -> None:
    dealt = assignments(200, 3)
    singles = [entry.effects[0] for entry in dealt if entry.kind == "single"]
    assert {singles.count(name) for name in LIBRARY} == {5}
    assert sum(entry.kind == "none" for entry in dealt) == 30
    assert all(len(set(entry.effects)) == 2 for entry in dealt if entry.kind == "double")
    assert {entry.effects[0] for entry in dealt if entry.kind == "outside"} == set(OUTSIDERS)


@pytest.mark.slow
def test_a_case_depends_on_seed_and_index_alone() -> None:
    once = draw_case(3, 11, Assignment("single", ("stribeck",)))
    again = draw_case(3, 11, Assignment("single", ("stribeck",)))
    other = draw_case(4, 11, Assignment("single", ("stribeck",)))
    assert once.truth == again.truth
    assert all(np.array_equal(a.torque_nm, b.torque_nm) for a, b in zip(once.logs, again.logs, strict=True))
    assert other.nominal["joint"]["inertia_kg_m2"] != once.nominal["joint"]["inertia_kg_m2"]


@pytest.mark.slow
def test_a_joint_that_is_as_believed_leaves_noise_only(joint: Joint) -> None:
    logs = record(joint, joint.physics, [1])
    believed = believed_motion(joint)
    all_figures = together([figures(joint, log, run) for log, run in zip(logs, believed, strict=True)], logs)
    assert all_figures["actuation_nm"] == pytest.approx(joint.floor_nm, rel=0.15)
    assert all_figures["forward_torque_nm"] == pytest.approx(joint.floor_nm, rel=0.15)
    assert all_figures["inverse_nm"] < 2.0 * joint.floor_nm
    assert all_figures["forward_position_rad"] == 0.0


def test_the_gap_of_the_truth_is_that_of_the_nominal_file(tmp_path: Path) -> None:
    healthy = draw_joint(np.random.default_rng([4, 12]), ("sines_repeat",))
    log = record(healthy, healthy.physics, [1])[0]
    believed = believed_motion(healthy)
    write_case(Case("one", nominal_mapping(healthy, "one"), (log,), {}), tmp_path)
    differences = Replay(ExperimentSet.load(tmp_path))({})
    reported = pooled(differences, "position_rad")
    # Believed and nominal joint move alike, so that neither is charged with what the file cannot tell.
    assert reported == pytest.approx(figures(healthy, log, believed[0])["forward_position_rad"], rel=0.03)


def test_at_constant_speed_the_torque_is_gravity_and_the_friction_of_the_curve(joint: Joint) -> None:
    log = record(replace(joint, torque_noise_nm=0.0), joint.physics, [1])[2]
    assert log.experiment.name == "triangle_slow"
    speed = joint.envelope.triangle_velocity_rad_s
    velocity = np.gradient(log.command_rad, 0.002)
    steady = np.convolve(np.abs(np.gradient(velocity)) > 1e-9, np.ones(801), mode="same") == 0
    forward = steady & (velocity > 0)
    left = log.torque_nm[forward] - joint.physics.gravity * np.cos(log.position_rad[forward])
    assert np.median(left) == pytest.approx(base_friction(joint.physics, speed), rel=2e-3)


def test_a_delay_shows_in_the_actuation_and_a_wrong_inertia_does_not(joint: Joint) -> None:
    believed = believed_motion(joint)
    late = joint.physics._replace(delay=0.006)
    heavy = joint.physics._replace(link_inertia=1.3 * joint.physics.link_inertia)
    chirp = 4
    healthy, delayed, heavier = (
        figures(joint, record(joint, physics, [1])[chirp], believed[chirp]) for physics in (joint.physics, late, heavy)
    )
    assert delayed["actuation_nm"] > 3.0 * healthy["actuation_nm"]
    assert heavier["actuation_nm"] < 1.2 * healthy["actuation_nm"]
    assert heavier["inverse_nm"] > 1.5 * healthy["inverse_nm"]


def test_truth_compares_with_the_same_joint_and_noise() -> None:
    case = draw_case(0, 5, Assignment("single", ("torque_bias",)))
    truth = case.truth
    assert truth["effects"][0]["name"] == "torque_bias"
    assert truth["size_ratio"] == pytest.approx(max(truth["gap_over_floor"].values()), rel=1e-6)
    assert truth["gap"]["actuation_nm"] == pytest.approx(truth["ideal_residual"]["actuation_nm"], rel=0.1)
    weights = np.array([log.position_rad.size for log in case.logs])
    squares = np.array([entry["gap_inverse_nm"] ** 2 for entry in truth["per_experiment"]])
    assert truth["gap"]["inverse_nm"] == pytest.approx(np.sqrt(weights @ squares / weights.sum()), rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["none", "double", "outside"])
def test_every_kind_is_drawn(kind: str) -> None:
    effects = {"none": (), "double": ("gravity_error", "torque_delay"), "outside": ("friction_patch",)}[kind]
    truth = draw_case(1, 8, Assignment(kind, effects)).truth
    assert [effect["name"] for effect in truth["effects"]] == list(effects)
    assert (truth["size_class"] == "none") == (kind == "none")
    if kind == "double":
        assert all(effect["size_ratio_alone"] >= 0.9 for effect in truth["effects"])


def test_a_written_case_has_the_layout_of_the_practice_cases(tmp_path: Path) -> None:
    case = draw_case(0, 5, Assignment("none", ()))
    write_case(case, tmp_path)
    nominal = yaml.safe_load((tmp_path / "nominal.yaml").read_text())
    practice_file = PRACTICE / "cases" / "case_000" / "nominal.yaml"
    if not practice_file.exists():
        pytest.skip("practice cases are not at hand")
    practice = yaml.safe_load(practice_file.read_text())

    def shape(value: object) -> object:
        if isinstance(value, dict):
            return {key: shape(item) for key, item in value.items()}
        if isinstance(value, list):
            return [shape(value[0])]
        return float if isinstance(value, int | float) and not isinstance(value, bool) else type(value)

    assert shape(nominal) == shape(practice)
    assert [e["name"] for e in nominal["experiments"]] == [e["name"] for e in practice["experiments"]]
    for experiment in nominal["experiments"]:
        header, first, *rest = (tmp_path / experiment["file"]).read_text().splitlines()
        assert header == "time_s,position_rad,velocity_rad_s,torque_nm,position_command_rad"
        assert float(first.split(",")[0]) == 0.0
        assert (len(rest) + 1) * 0.002 == pytest.approx(experiment["duration_s"])


@pytest.mark.slow
def test_truth_speaks_as_the_practice_truth_does() -> None:
    truth_file = PRACTICE / "truth" / "case_000.yaml"
    if not truth_file.exists():
        pytest.skip("practice cases are not at hand")
    practice = yaml.safe_load(truth_file.read_text())
    truth = draw_case(0, 5, Assignment("outside", ("frictional_memory",))).truth
    assert set(practice) <= set(truth)
    assert set(practice["gap"]) == set(truth["gap"])
    assert set(practice["per_experiment"][0]) <= set(truth["per_experiment"][0])
    assert practice["aliases"] == truth["aliases"]
