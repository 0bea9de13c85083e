"""A seed of the campaign of faults (`benchmarks/faults.py`): judged by the servos and the withheld truth."""

import importlib.util
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

CASES = [
    ("calibrate", "configure", "SDO refused"),
    ("calibrate", "configure", "interface fails in set-up"),
    ("calibrate", "enable", "node silent"),
    ("calibrate", "move", "position jumps a turn"),
    ("calibrate", "rehearsal", "drive faults"),
    ("calibrate", "rehearsal", "send os"),
    ("calibrate", "cycles", "torque late 20 ms"),
    ("calibrate", "cycles", "torque times 1.5"),
    ("calibrate", "cycles", "torque clipped 6 N m"),
    ("calibrate", "cycles", "node reboots"),
    ("calibrate", "cycles", "bus off"),
    ("together", "coupling", "encoder stands"),
    ("compensate", "track mop", "position jumps a turn"),
    ("recalibrate", "cycles", "torque clipped 6 N m"),
    ("gap record", "breakaway/breakaway", "every command lost"),
]
WITHOUT_POWER = [
    (verb, name)
    for verb in ("check", "reset")
    for name in ("SDO answer short", "interface fails in set-up", "interface deaf in set-up", "node silent in set-up")
]
OUT_OF_REACH = [
    pytest.param("dynamixel recalibrate", "rehearsal", "every write lost", marks=pytest.mark.slow),
    ("feetech calibrate", "hold", "send value"),
    ("feetech calibrate", "hold again", "send runtime"),
    ("feetech calibrate", "rehearsal", "every write lost"),
    pytest.param("feetech compensate", "track mop", "servo silent", marks=pytest.mark.slow),
]


@pytest.fixture(scope="module")
def faults() -> ModuleType:
    path = Path(__file__).parents[1] / "benchmarks" / "faults.py"
    spec = importlib.util.spec_from_file_location("faults", path)
    assert spec is not None and spec.loader is not None
    module = sys.modules["faults"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def bench(faults: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Iterator[object]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", faults.ENVIRONMENT):
            patch.setenv(name, "")  # the bench sets them; this puts them back
        yield faults.Bench(tmp_path_factory.mktemp("faults"))


@pytest.mark.slow
@pytest.mark.parametrize(("verb", "phase", "name"), CASES)
def test_a_fault_leaves_nothing_moving_nothing_lost_and_no_wrong_curve(faults, bench, verb, phase, name):
    verdict = bench.struck(faults.Case(verb, phase, name, 1))
    assert verdict.failures == []
    assert verdict.noticed, verdict


@pytest.mark.parametrize(("verb", "name"), WITHOUT_POWER)
def test_a_verb_without_power_ends_in_one_of_our_errors(faults, bench, verb, name):
    verdict = bench.struck(faults.Case(verb, "preflight", name, 6))
    assert verdict.failures == []
    assert verdict.exit_code in (2, 3), verdict


@pytest.mark.parametrize("verb", ["dynamixel calibrate", "feetech calibrate"])
def test_a_healthy_servo_of_two_speeds_is_within_its_interval(faults, bench, verb):
    """It was 1.7 % outside: its current beats with its speed, and 2 % outside is what a fault needed."""
    verdict = faults.Verdict(verb, "clean", "nothing", 0)
    bench._run(faults.Watched(), verdict, [], 200.0)
    assert (verdict.ended, verdict.failures) == ("ok", [])
    assert verdict.off_percent < 0.5


def test_the_judge_sees_a_wrong_curve(faults, bench):
    verdict = faults.Verdict("calibrate", "cycles", "nothing", 0)
    robot = bench.robot("two joints")
    truth = faults.true_curve(robot, faults.JOINT, 2.0).magnitude(np.array([0.5, 1.0]))
    wrong = {"outcome": "ok", "velocity_rad_s": [0.5, 1.0], "torque_interval_nm": [(t * 1.1, t * 1.2) for t in truth]}
    faults._judge_curves({faults.JOINT: wrong}, verdict, robot)
    assert "called ok" in verdict.failures[0]


def test_injections_are_drawn_evenly_over_the_verbs(faults):
    every = [faults.Case(verb, "cycles", str(n), 0) for verb in ("calibrate", "together") for n in range(20)]
    every += [faults.Case("check", "preflight", "SDO refused", 0)]
    drawn = faults.drawn(every, 11, 3)
    assert sorted(case.verb for case in drawn) == ["calibrate"] * 5 + ["check"] + ["together"] * 5
    assert drawn == faults.drawn(every, 11, 3) != faults.drawn(every, 11, 4)


@pytest.mark.parametrize(("verb", "phase", "name"), OUT_OF_REACH)
def test_a_servo_that_no_word_reaches_is_judged_by_where_it_is(faults, bench, verb, phase, name):
    """They held their place within 0.03 deg; an edge of the encoder made their own estimate of speed 0.4 rad/s."""
    verdict = bench.struck(faults.Case(verb, phase, name, 81000))
    assert verdict.failures == []
    assert verdict.noticed and verdict.rest_s < 0.5


@pytest.fixture
def judged(faults):
    """A joint, and a judge that looks at it every 2.5 ms where it is told to be."""
    at_rad = [0.0]
    axle = faults.Axle("3", lambda: True, lambda: at_rad[0], lambda: 1.0, (-1.0, 1.0), 4.5)
    watched, now_ns = faults.Watched(), [0]
    watched.now, watched.axles = lambda: now_ns[0], [axle]

    def look(*places_rad: float) -> float:
        """When it moved last, in seconds."""
        for place_rad in places_rad:
            now_ns[0], at_rad[0] = now_ns[0] + 2_500_000, place_rad
            watched._advanced()
        return watched.moved_ns * 1e-9

    return look


def test_who_goes_nowhere_is_at_rest_whatever_its_speed(judged):
    assert judged(*[0.1, 0.1003] * 40) <= 0.025


def test_who_creeps_is_not_at_rest(judged):
    assert judged(*np.arange(80) * 0.0025 * 0.03) == pytest.approx(0.2)


def test_who_swings_is_not_at_rest(judged):
    """At the same place whenever twenty milliseconds have passed."""
    assert judged(*0.001 * np.sin(np.arange(80) * 2 * np.pi / 8)) == pytest.approx(0.2)


def test_only_a_servo_without_a_watchdog_that_is_named_may_hold_its_goal_under_power(faults):
    verdict = faults.Verdict("feetech calibrate", "hold", "servo silent", 0, said="joint 3 may still have power: ...")
    axle = faults.Axle("3", lambda: True, lambda: 0.0, lambda: 0.0, (-1.0, 1.0), 4.5, watchdog=False)
    assert faults._holds(axle, verdict)
    assert not faults._holds(replace(axle, name="4"), verdict)
    assert not faults._holds(replace(axle, watchdog=True), verdict)
    assert not faults._holds(axle, replace(verdict, said="look at the wiring"))
    assert not faults._holds(axle, replace(verdict, name="writes lost 100"))
