"""Benchmarks run seldom; what they build on must not leave them behind unseen."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.friction import trajectory
from frictid_hil.friction.regression import hat_functions
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.simulation.joint import JointModel

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def benchmark_named(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Any]:
    monkeypatch.syspath_prepend(str(FOLDER))
    monkeypatch.setattr(sys, "path", list(sys.path))  # one of them adds the folder of the tests' own plant
    return importlib.import_module


@pytest.mark.parametrize("name", sorted(path.stem for path in FOLDER.glob("*.py")))
def test_every_benchmark_can_be_imported(benchmark_named: Callable[[str], Any], name: str) -> None:
    assert benchmark_named(name).__doc__


def joints_of(path: Path) -> dict[str, JointModel]:
    """The simulated joints of a robot file, as its simulated drives would build them."""
    return {
        joint.name: JointModel.from_mapping(
            joint.simulated,
            gear_ratio=joint.gear_ratio,
            rated_torque_nm=joint.rated_torque_nm,
            max_torque_nm=joint.max_torque_nm,
        )
        for joint in load_robot(path).to_setup("virtual:loaded").joints
    }


def test_robots_changed_for_the_accuracy_table_load(benchmark_named: Callable[[str], Any], tmp_path: Path) -> None:
    accuracy = benchmark_named("accuracy")
    shipped = accuracy.shipped()
    for values in (shipped, accuracy.scaled(shipped, 1), accuracy.flexible(shipped, 30.0)):
        path = tmp_path / f"{values['name']}.yaml"
        path.write_text(dump(values))
        joints = joints_of(path)
        assert ("joint_elasticity" in joints["1"].effects) == ("flexible" in values["name"])
        assert len(joints) == 6


@pytest.mark.parametrize("kind", ["rigid", "flexible", "load"])
def test_robots_of_the_calibrations_on_the_bus_load(
    benchmark_named: Callable[[str], Any], tmp_path: Path, kind: str
) -> None:
    on_the_bus = benchmark_named("on_the_bus")
    joints = joints_of(on_the_bus.variant(tmp_path, kind, on_the_bus.plant(kind)).path)
    assert ("joint_elasticity" in joints["0"].effects) == (kind == "flexible")
    assert ("load_dependent_friction" in joints["0"].effects) == (kind == "load")


def test_robots_of_the_compensation_benchmarks_load(benchmark_named: Callable[[str], Any], tmp_path: Path) -> None:
    path = benchmark_named("compensation_robots").variant(tmp_path / "robot.yaml", elastic_hz=30.0, delay_cycles=5)
    assert all("joint_elasticity" in joint.effects for joint in joints_of(path).values())


@pytest.mark.parametrize("batch", [False, True])
def test_robots_of_the_serial_benchmarks_load(
    benchmark_named: Callable[[str], Any], tmp_path: Path, batch: bool
) -> None:
    path = benchmark_named("serial_pty").robot_file(tmp_path, batch=batch, averaging_ms=0)
    assert len(joints_of(path)) == 6
    path.write_text(benchmark_named("serial_faults").ROBOT.format(layer="batch" if batch else "stream"))
    assert len(joints_of(path)) == 6


@pytest.mark.slow
def test_joints_of_the_diagnosis_end_to_end_load(benchmark_named: Callable[[str], Any], tmp_path: Path) -> None:
    end_to_end = benchmark_named("gap_end_to_end")
    for effect in end_to_end.SIZES:
        joints = joints_of(end_to_end.robot_with({effect: end_to_end.drawn(effect)}, tmp_path))
        assert set(joints["0"].effects) == {effect}


def test_what_is_of_the_way_is_told_from_noise(benchmark_named: Callable[[str], Any]) -> None:
    two_ways = benchmark_named("two_ways")
    rng = np.random.default_rng(4)
    curve, noise = 10 + np.linspace(0.0, 4.0, 50), rng.normal(scale=0.06, size=(2, 40, 50))
    alike = two_ways.compare(curve + noise[0], curve + noise[1])
    apart = two_ways.compare(curve + 0.03 + noise[0], curve + noise[1])
    assert alike.methodical < 0.08 and alike.methodical_below < 0.1
    assert alike.ratio == pytest.approx(1.0, abs=0.05)
    assert apart.methodical == pytest.approx(100 * 0.03 / 12, abs=0.05) and apart.methodical_below > apart.methodical
    assert apart.means_apart > apart.noise_of_means == pytest.approx(100 * 0.06 / 12 * np.sqrt(2 / 40), rel=0.1)
    assert apart.single > apart.alone == pytest.approx(100 * 0.06 / 12 * np.sqrt(2), rel=0.05)


def test_no_unbiased_curve_scatters_less_than_its_samples_allow(benchmark_named: Callable[[str], Any]) -> None:
    """Least squares on the same knots, tried with noise, reaches the bound and does not fall below it."""
    two_ways = benchmark_named("two_ways")
    procedure, step_s = Procedure(0.35, 2.0), 0.004
    knots = 0.932 * np.linspace(0.1, 1.0, 10) * 2.0
    bound = two_ways.least_apart(procedure, step_s, knots, 0.5)
    assert bound == pytest.approx(two_ways.least_apart(procedure, step_s / 4, knots, 1.0), rel=0.02), "s / sqrt(n)"
    velocity = trajectory.velocity(procedure, trajectory.sample_times(procedure, step_s))
    moving = velocity[np.abs(velocity) >= knots[0] / 2]
    model = np.sign(moving)[:, None] * hat_functions(np.clip(np.abs(moving), knots[0], knots[-1]), knots)
    noise = np.random.default_rng(5).normal(scale=0.5, size=(moving.size, 400))
    runs = hat_functions(np.linspace(knots[0], knots[-1], 100), knots) @ np.linalg.lstsq(model, noise, rcond=None)[0]
    gaps = np.sqrt(np.mean((runs[:, ::2] - runs[:, 1::2]) ** 2))
    assert gaps == pytest.approx(bound, rel=0.05)


def test_a_stop_is_judged_by_what_the_joint_reports(benchmark_named: Callable[[str], Any]) -> None:
    stops = benchmark_named("stop_on_the_wall_clock")
    times = np.arange(0.0, 3.0, 0.001)
    speed = np.interp(times, [0.0, 1.0, 1.2], [1.0, 1.0, 0.0])
    went = np.cumsum(speed) * 0.001
    stopped = stops.judged(times.tolist(), went.tolist(), 1.0, (0.0, 1.05), 130)
    assert stopped.stop_s == pytest.approx(0.2, abs=0.025) and stopped.speed_rad_s == pytest.approx(1.0)
    assert stopped.beyond_rad == pytest.approx(0.05, abs=0.002)
    stood = stops.judged(times.tolist(), [0.3] * times.size, 1.0, (0.0, 1.05), 130)
    assert (stood.stop_s, stood.speed_rad_s, stood.beyond_rad) == (0.0, 0.0, 0.0)


def test_no_wire_carries_six_joints_at_one_kilohertz(benchmark_named: Callable[[str], Any]) -> None:
    cycle = benchmark_named("cycle")
    assert 35 < cycle.layout_of(1, 1000.0).load().average_percent < 50
    assert 55 < cycle.layout_of(6, 250.0).load().average_percent < 80
    assert cycle.layout_of(6, 1000.0).load().average_percent > 150


@pytest.mark.slow
def test_the_loop_is_timed_beside_stock_canopen_and_beside_an_empty_one(benchmark_named: Callable[[str], Any]) -> None:
    cycle = benchmark_named("cycle")
    ours, stock, on_one_core, wire = cycle.alone(cycle.compared_us, 2, 3, 100)
    assert 0 < min(wire) < min(ours) < min(stock) and min(ours) < min(on_one_core)
    before, loop, after = cycle.alone(cycle.timed, 2, 100.0, 0.3)
    assert loop.cycles == 30 and before.cycles == after.cycles == 15
    assert loop.late_us[0] <= loop.late_us[1] <= loop.late_us[2] <= loop.late_us[3]
    assert loop.share > 0.0


def test_missed_deadlines_and_lateness_are_figured_from_the_waits(benchmark_named: Callable[[str], Any]) -> None:
    kept = benchmark_named("cycle").judged([50_000] * 998 + [900_000, 5_000_000], 4, 0.25, 1.0)
    assert (kept.late_us[0], kept.late_us[3], kept.missed, kept.share) == (50.0, 5000.0, 4, 0.25)
    assert "4 of 1004" in str(kept)


@pytest.mark.slow
def test_a_round_of_the_soak_keeps_nothing(benchmark_named: Callable[[str], Any], tmp_path: Path) -> None:
    soak = benchmark_named("soak")
    robot = soak.robot_file(tmp_path)
    assert soak.one_round(robot, tmp_path, 0) == ["ok"] * 4
    before = soak.held()
    assert soak.one_round(robot, tmp_path, 1) == ["ok"] * 4
    assert soak.held() == before
    with (tmp_path / "kept").open("w"):
        assert soak.held() != before


def test_memory_is_compared_from_early_to_late(benchmark_named: Callable[[str], Any]) -> None:
    soak = benchmark_named("soak")
    held = soak.held()
    rounds = np.array([200.0] * 7 + [250.0] * 17 + [255.0] * 3)
    soaked = soak.Soaked(rounds, np.full(27, 300.0), np.array([90.0] * 24 + [99.0] * 3), 7, held, held, {}, 1.0)
    assert (soaked.growth, soaked.growth_with_freed, soaked.growth_in_use) == pytest.approx((0.02, 0.0, 0.1))


def test_what_is_in_use_is_counted(benchmark_named: Callable[[str], Any]) -> None:
    soak = benchmark_named("soak")
    before_mb, block = soak.in_use_mb(), bytearray(50_000_000)
    assert soak.in_use_mb() - before_mb == pytest.approx(50.0, abs=1.0) and block


def test_calibration_is_pooled_over_checks(benchmark_named: Callable[[str], Any], tmp_path: Path) -> None:
    for folder, there in (("first", ["stribeck"]), ("second", [])):
        (tmp_path / folder / "truth").mkdir(parents=True)
        truth = {"present": there, "main": there, "neutral": ["backlash"], "contributors": []}
        (tmp_path / folder / "truth" / "case_000.yaml").write_text(yaml.safe_dump(truth))
        causes = [{"effect": "stribeck", "confidence": 0.75}, {"effect": "backlash", "confidence": 0.9}]
        answer = {"case": "case_000", "diagnosis": {"verdict": "explained", "causes": causes}}
        (tmp_path / folder / "answers.json").write_text(json.dumps([answer]))
    pooled = benchmark_named("gap_pooled")
    causes = pooled.named_causes(*pooled.pooled([tmp_path / "first", tmp_path / "second"]))
    assert [(cause.confidence, cause.there) for cause in causes] == [(0.75, True), (0.75, False)]
    told = pooled.calibration(causes)
    assert told[0].startswith("calibration error 0.250 over 2 causes") and told[1:] == ["told 0.75: there 1 of 2"]


@pytest.mark.parametrize(("added", "just"), [({"stribeck"}, True), ({"stribeck", "backlash"}, False), (set(), False)])
def test_true_numbers_are_asked_where_the_answer_names_just_what_is_there(
    benchmark_named: Callable[[str], Any], added: set[str], just: bool
) -> None:
    sizes = {"stribeck": 3.0, "torque_bias": 0.1}
    truth = {"contributors": [{"name": name, "size_alone": size} for name, size in sizes.items()]}
    assert benchmark_named("gap_how_far")._just(truth, added) is just


def test_a_level_is_taken_for_what_is_told_first(benchmark_named: Callable[[str], Any], tmp_path: Path) -> None:
    level = benchmark_named("gap_level")
    (tmp_path / "truth").mkdir()
    for name, kind in (("case_000", "none"), ("case_001", "single")):
        truth = {"case": name, "kind": kind, "present": ["inertia_error"], "neutral": ["stribeck"]}
        (tmp_path / "truth" / f"{name}.yaml").write_text(yaml.safe_dump(truth))
    asked, there = level.healthy(tmp_path), frozenset({"inertia_error", "stribeck"})
    assert asked == [level.Asked(tmp_path / "cases" / "case_000", off, there) for off in level.OFF]

    def answer(verdict: str, *causes: tuple[str, float]) -> SimpleNamespace:
        return SimpleNamespace(verdict=verdict, causes=[SimpleNamespace(effect=n, confidence=c) for n, c in causes])

    other = answer("explained", ("inertia_error", 0.7), ("friction_level_error", 0.6))
    assert level.taken(other) and level.told_with(other, "friction_level_error") == 0.6
    assert not level.taken(answer("explained", ("friction_level_error", 0.9)))
    assert not level.taken(answer("explained", ("inertia_error", 0.4)))
    assert not level.taken(answer("unknown", ("inertia_error", 0.9))) and not level.taken(answer("none"))
