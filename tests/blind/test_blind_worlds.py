"""The wide world and the zoo: what they draw is repeatable and legal, what truth says is so, and scores count right."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from frictid_hil.blind import judged, plant, spoilt, wide, zoo
from frictid_hil.blind.figures import low_pass, rms
from frictid_hil.blind.worlds import WORLDS, write_rows
from frictid_hil.errors import UsageError
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.sanity import checked
from frictid_hil.jobs.gap_check import run_gap_check

BARE = plant.Physics(0.1, 0.3, 4.0, 3.0, 0.5, 0.5, 1.0, 2e-4, 100.0, 1e-7, 50.0)


@pytest.fixture(scope="module")
def drawn() -> tuple[dict[str, Any], tuple[wide.Row, ...], dict[str, Any]]:
    return wide.draw_wide(1, 7, "single")


@pytest.mark.slow
def test_a_case_is_drawn_from_its_numbers_alone(drawn: tuple[Any, Any, dict[str, Any]]) -> None:
    assert wide.draw_wide(1, 7, "single")[2] == drawn[2]


@pytest.mark.slow
def test_a_case_is_a_legal_set(drawn: tuple[Any, Any, dict[str, Any]], tmp_path: Path) -> None:
    nominal, rows, _ = drawn
    write_rows(tmp_path, nominal, rows)
    read = ExperimentSet.load(tmp_path)
    checked(read)
    assert {e.validation for e in read.experiments} == {True, False}
    assert read.nominal.tolerances.inertia_kg_m2.source == "stated"


@pytest.mark.slow
def test_what_is_withheld_is_there_and_the_largest(drawn: tuple[Any, Any, dict[str, Any]]) -> None:
    truth = drawn[2]
    sizes = {one["name"]: one["size_alone"] for one in truth["contributors"]}
    (withheld,) = [one for one in truth["contributors"] if one["role"] == "withheld"]
    assert withheld["name"] in truth["main"] and withheld["name"] in truth["present"]
    assert withheld["size_alone"] >= wide.WITHHELD and withheld["size_alone"] == max(sizes.values())
    for name in truth["neutral"]:
        assert name in wide.FORMS or wide.NOTHING <= sizes[name] < wide.PRESENT


@pytest.mark.slow
def test_recorded_again_a_joint_has_other_noise_and_lacks_what_is_left_out(
    drawn: tuple[Any, tuple[wide.Row, ...], dict[str, Any]],
) -> None:
    def slow_torque(rows: tuple[wide.Row, ...]) -> np.ndarray:
        seconds, torque = (rows[-1].columns[name] for name in ("time_s", "torque_nm"))
        even = np.arange(0.5, 10.0, 0.002)
        return low_pass(np.interp(even, seconds, torque), 500.0)

    again, healthy = wide.recorded_again(1, 7, "single", (), [one["name"] for one in drawn[2]["contributors"]])
    noise, changed = (rms(slow_torque(rows) - slow_torque(again)) for rows in (drawn[1], healthy))
    assert 0.0 < noise < 0.7 * changed


@pytest.mark.slow
def test_a_softer_presliding_shows_along_the_motion_and_hardly_in_the_loop() -> None:
    made = (wide._setting(np.random.default_rng([3, n])) for n in range(50))
    setting = next(s for s in made if s.controller == "known" and s.physics.gear_ratio > 50.0)
    base = wide._runs(setting, setting.physics, setting.control)
    assert base is not None
    floors = wide._floors(setting, base)
    assert floors is not None and floors["inverse"] >= floors["actuation"]
    softer = wide.Contributor("presliding_hysteresis", "tolerance", {}, wide._scaling({"slip_length": 1.1}))
    sizes = wide._size(setting, base, [softer], floors)
    assert sizes is not None and sizes["inverse"] > 3.0 * sizes["torque"]
    # Where nobody knows the controller, nobody can simulate its loop.
    assert set(wide._floors(replace(setting, controller="unknown"), base) or {}) == {"inverse"}


@pytest.mark.slow
def test_floors_are_what_the_rows_of_a_log_show_of_a_joint_that_is_as_believed() -> None:
    made = (wide._setting(np.random.default_rng([5, n])) for n in range(200))
    wanted = (s for s in made if s.controller == "known" and s.thin == 5 and not s.filter_order and not s.gaps)
    setting = next(s for s in wanted if s.jitter == 0.0 and s.size in ("hobby", "direct"))
    base = wide._runs(setting, setting.physics, setting.control)
    assert base is not None
    floors = wide._floors(setting, base)
    assert floors is not None
    # What the controller asked for between the rows nobody knows.
    assert set(floors) == {"inverse", "torque"}
    simulated = []
    recorded = wide._recorded(np.random.default_rng(0), setting, setting.physics, setting.control)
    for row, (_, torque, _) in zip(recorded, base, strict=True):
        # The torque of a joint whose encoder has no steps.
        simulated.append(low_pass(row.columns["torque_nm"] - torque[:: setting.thin], 1.0 / setting.step_s))
    assert 0.7 < rms(np.concatenate(simulated)) / floors["torque"] < 1.4
    assert floors["torque"] > 1.5 * rms(
        low_pass(wide._noise(np.random.default_rng(1), setting, 20_000), 1.0 / setting.step_s)
    )


@pytest.mark.slow
@pytest.mark.parametrize("family", range(4))
def test_every_presliding_family_is_a_loop_that_saturates(family: int) -> None:
    p = BARE._replace(slip_family=family)
    state = np.zeros(3)
    forth = [plant._slipped(p, state, 2e-6, 5e-5) for _ in range(2000)][-1]
    back = [plant._slipped(p, state, -2e-6, 5e-5) for _ in range(2000)]
    assert forth == pytest.approx(1.0, abs=0.02) and back[-1] == pytest.approx(-1.0, abs=0.02)
    assert back[10] > 0.5  # it remembers where it came from


@pytest.mark.parametrize("family", range(4))
def test_every_rate_family_rises_from_nothing(family: int) -> None:
    p = BARE._replace(rate_family=family)
    torque = [float(plant.rate_part(p, speed)) for speed in (0.0, 0.05, 0.3, 1.0)]
    assert torque[0] == pytest.approx(0.0, abs=1e-3) and torque == sorted(torque)
    assert torque[-1] == pytest.approx(0.5, rel=0.1)


def test_a_kinematic_error_does_no_work_of_its_own_at_creep() -> None:
    """At rest without load it asks for nothing; with load, for its slope times the load."""
    p = BARE._replace(kinematic=1e-4)
    assert plant._kinematic(p, 0.3, 0.0, 0.0, 0.0, 0.3) == 0.0
    slope = 1e-4 * 200.0 * math.cos(200.0 * 0.3)
    assert plant._kinematic(p, 0.3, 0.0, 0.0, 5.0, 0.3) == pytest.approx(5.0 * slope)


def test_torque_beyond_the_ceiling_is_bent_by_a_formula_of_its_own() -> None:
    p = BARE._replace(ceiling=10.0, ceiling_knee=20.0)
    assert plant._amplified(p, 5.0) == 5.0 and plant._amplified(p, -8.9) == -8.9
    assert 9.9 < plant._amplified(p, 20.0) <= 10.0 and plant._amplified(p, 10.0) < 10.0


def _truth(kind: str, main: list[str], size: float = 5.0, **more: Any) -> dict[str, Any]:
    return {"case": "c", "kind": kind, "main": main, "present": main, "neutral": [], "controller": "known",
            "size_ratio": size, "contributors": [], "true_parameters": [], **more}  # fmt: skip


def _line(verdict: str, *causes: tuple[str, float], **parameters: Any) -> dict[str, Any]:
    named = [{"effect": e, "confidence": c, "parameters": parameters} for e, c in causes]
    return {"diagnosis": {"verdict": verdict, "causes": named}, "seconds": 1.0}


def test_scores_count_what_they_say() -> None:
    known = [{"effect": "stribeck", "parameter": "s", "value": 2.0}]
    truths = {
        "right": _truth("single", ["stribeck"], true_parameters=known),
        "wrong": _truth("single", ["stribeck"]),
        "cleared": _truth("tolerance", ["friction_level_error"]),
        "neutral": _truth("none", [], 0.3, neutral=["torque_bias"]),
        "healthy": _truth("none", [], 0.3),
        "stranger": _truth("outside", ["unknown"], present=[]),
        "tied": _truth("single", ["torque_bias"], contributors=[
            {"name": "torque_bias", "indistinguishable": ["gravity_error"]}]),
    }  # fmt: skip
    lines = {
        "right": _line("explained", ("stribeck", 0.95), s={"value": 2.1, "interval_95": [1.9, 2.2]}),
        "wrong": _line("explained", ("backlash", 0.95)),
        "cleared": _line("none"),
        "neutral": _line("explained", ("torque_bias", 0.99)),
        "healthy": _line("none"),
        "stranger": _line("unknown"),
        "tied": _line("ambiguous", ("gravity_error", 0.55)),
    }
    scores = judged.judged(truths, lines)
    assert (scores["first"]["right"], scores["first"]["of"]) == (1, 4)
    assert scores["first_or_tied"]["right"] == 2
    assert (scores["false_none"]["right"], scores["false_none"]["of"]) == (1, 5)
    assert (scores["sure_and_wrong"]["right"], scores["sure_and_wrong"]["of"]) == (1, 7)
    assert scores["none"]["right"] == 1 and scores["outside"]["rate"] == 1.0
    assert (scores["parameters"]["right"], scores["parameters"]["of"]) == (1, 1)
    # Named: 0.95 right, 0.95 wrong, 0.99 neither (neutral), 0.55 tied.
    assert scores["causes"] == {"judged": 3, "neutral": 1}
    assert scores["brier"] == pytest.approx((0.05**2 + 0.95**2 + 0.45**2) / 3)
    assert scores["calibration_error"] == pytest.approx((abs(0.95 + 0.95 - 1.0) + abs(0.55 - 1.0)) / 3)
    as_wrong = scores["calibration_error_neutral_as_wrong"]
    assert as_wrong == pytest.approx((abs(0.95 + 0.95 + 0.99 - 1.0) + abs(0.55 - 1.0)) / 4)
    assert "| wrong | stribeck | backlash |" in judged.page(
        {"world": "wide", "cases": 7, "seed": 1, "truth_sha256": "", "code_sha256": "",
         "scores": {**scores, "misses": [dict(m, case="wrong") for m in scores["misses"][:1]]}}
    )  # fmt: skip


def test_a_level_that_is_told_behind_another_cause_is_taken_for_it_and_told() -> None:
    level = "friction_level_error"
    truths = {name: _truth("tolerance", [level]) for name in ("behind", "hardly", "instead", "first")}
    lines = {
        "behind": _line("explained", ("inertia_error", 0.9), (level, 0.7)),
        "hardly": _line("explained", ("inertia_error", 0.9), (level, 0.3)),
        "instead": _line("explained", ("inertia_error", 0.6)),
        "first": _line("explained", (level, 0.9)),
    }
    scores = judged.judged(truths, lines)
    taken, not_told = scores["friction_level_taken_for_another"], scores["friction_level_not_told"]
    assert (taken["right"], taken["of"], not_told["right"], not_told["of"]) == (3, 4, 2, 4)


def test_a_case_without_an_answer_is_an_error_and_wrong() -> None:
    scores = judged.judged({"c": _truth("single", ["stribeck"])}, {})
    assert scores["errors"] and scores["first"]["right"] == 0


def test_an_unknown_world_is_refused() -> None:
    with pytest.raises(UsageError, match="no world is called 'flat'"):
        run_gap_check(2, worlds=("wide", "flat"))
    assert list(WORLDS) == ["narrow", "wide", "zoo"]


# -- the zoo ------------------------------------------------------------------------------------------------------


def _mujoco_has_the_motor() -> bool:
    mujoco = pytest.importorskip("mujoco")
    return int(mujoco.__version__.split(".")[0]) >= 4


def test_a_joint_of_mujoco_follows_its_controller_and_feels_what_is_withheld() -> None:
    if not _mujoco_has_the_motor():
        pytest.skip("MuJoCo without dcmotor")
    belief = zoo.Model(0.3, 0.1, 4.0, 2.0, 2.0002, 0.05, 4000.0, 0.5)
    gains = zoo.Gains(200.0, 600.0, 14.0)
    time_s = zoo.TICK_S * np.arange(1500)
    command = 0.4 * (1.0 - np.cos(2.0 * time_s))
    position, torque = zoo.run(belief, gains, command)
    assert np.abs(position - command).max() < 0.05
    # The equation of the belief, far from reversals.
    v, a = 0.8 * np.sin(2.0 * time_s), 1.6 * np.cos(2.0 * time_s)
    asked = 0.4 * a + 4.0 * np.cos(position) + 2.0 * np.sign(v) + 0.5 * v
    sliding = np.abs(v) > 0.4
    assert np.abs(torque - asked)[sliding][100:].mean() < 0.1
    weak = zoo.run(zoo.Model(0.3, 0.1, 4.0, 2.0, 2.0002, 0.05, 4000.0, 0.5, gain=0.8), gains, command)[1]
    assert np.abs(weak - torque / 0.8)[sliding][200:].mean() < 0.15


def test_an_effect_is_added_to_a_recording_as_large_as_told(tmp_path: Path) -> None:
    time_s = 0.004 * np.arange(3000)
    q = 0.5 * np.sin(1.5 * time_s)
    torque = np.sign(np.cos(1.5 * time_s)) + 0.05 * np.random.default_rng(1).standard_normal(q.size)
    rows = [wide.Row(n, {"time_s": time_s, "position_rad": q, "torque_nm": torque}) for n in ("a", "b")]
    nominal = {
        "joint": {"gear_ratio": 100, "friction": {"velocity_rad_s": [0.2, 0.8], "torque_nm": [1.0, 1.0]}},
        "experiments": [{"name": "a", "file": "a.csv.gz"}, {"name": "b", "file": "b.csv.gz", "role": "validation"}],
    }
    write_rows(tmp_path, nominal, rows)
    names = set()
    for index in range(6):
        _, spoilt_rows, truth = spoilt.draw_spoilt(index, 1, tmp_path)
        added = spoilt_rows[0].columns["torque_nm"] - torque
        there = float(np.sqrt(np.mean(spoilt._missing(rows[0].columns, nominal) ** 2)))
        times = truth["size_ratio"]
        assert spoilt.TIMES[0] <= times <= spoilt.TIMES[1]
        assert np.sqrt(np.mean(added**2)) == pytest.approx(times * there, rel=0.2)
        names.add(truth["main"][0])
    assert len(names) > 1
    assert yaml.safe_load((tmp_path / "nominal.yaml").read_text())["experiments"]
