"""The story of one small joint, verb by verb, in lock-step: the fast loop's real run of everything that moves.

Longer tests beside this one hold each verb to its promises. Here each runs once, on what the one before left.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from called import run

from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump

Told = dict[str, Any]
Verb = Callable[..., Told]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the file of a robot that has the shipped robot's smallest joint alone, and a short procedure."""
    values = load_robot("hp3j").values()
    values |= {"name": "smoke", "bus": "virtual:smoke", "joints": {"5": values["joints"]["5"]}}
    values["procedure"] |= {"amplitude_rad": 0.2, "velocity_rad_s": 1.5, "cycles": 3}
    values["policy"] = {"warm_up": {"fixed_s": 0.0}}
    folder = tmp_path_factory.mktemp("smoke")
    (folder / "smoke.yaml").write_text(dump(values))
    return folder


@pytest.fixture(scope="module")
def verb(place: Path) -> Verb:
    """Call a verb in the folder, with ``--json``; what it told."""

    def call(*words: str, ends: int = 0) -> Told:
        ended = run(*words, "--json", cwd=place)
        assert ended.returncode == ends, ended.stderr or ended.stdout
        told: Told = json.loads(ended.stdout)
        return told

    return call


@pytest.fixture(scope="module")
def calibrated(verb: Verb) -> Told:
    return verb("calibrate", "--robot", "smoke.yaml", "--yes", "--out", "run")


@pytest.fixture(scope="module")
def promoted(verb: Verb, calibrated: Told) -> Told:
    return verb("profile", "promote", "run", "--store", "store")


def test_check_finds_a_robot_that_can_be_calibrated(verb: Verb) -> None:
    assert verb("check", "--robot", "smoke.yaml")["outcome"] == "ok"


def test_a_calibration_gives_the_joints_curve(calibrated: Told, verb: Verb) -> None:
    assert calibrated["outcome"] == "ok" and Path(calibrated["report"]).exists()
    compared = verb("compare", "run", "--truth", "smoke.yaml")
    assert compared["joints"]["5"]["e_percent_measured_range"] < 3.0


def test_identified_again_the_run_gives_the_same_curve(calibrated: Told, verb: Verb) -> None:
    again = verb("identify", "run", "--robot", "smoke.yaml", "--out", "again")
    first = calibrated["joints"]["5"]["torque_nm"]
    assert again["joints"]["5"]["torque_nm"] == pytest.approx(first, rel=1e-4)


def test_a_run_is_reported_and_replayed(calibrated: Told, verb: Verb) -> None:
    assert Path(verb("report", "run")["report"]).exists()
    assert verb("replay", "run", "--robot", "smoke.yaml", "--out", "replayed")["outcome"] == "ok"


def test_the_profile_in_force_compensates(promoted: Told, verb: Verb) -> None:
    asked = ("compensate", "--robot", "smoke.yaml", "--joint", "5", "--task", "hand", "--mode", "nc,mop")
    told = verb(*asked, "--duration", "2s", "--store", "store", "--yes", "--out", "guided")
    assert told["modes"]["mop"]["torque_rms_nm"] < 0.5 * told["modes"]["nc"]["torque_rms_nm"]


@pytest.mark.slow
def test_a_night_finds_the_joint_as_it_was(promoted: Told, verb: Verb) -> None:
    night = verb("recalibrate", "--robot", "smoke.yaml", "--store", "store", "--out", "night")
    assert night["outcome"] == "ok" and night["promoted"] is True
    assert len(verb("profile", "history", "smoke", "--store", "store")["profiles"]) == 2
