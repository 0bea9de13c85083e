"""A robot file from a few answers: it loads, its plan can be printed, and what is missing is asked for by name."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from typer.testing import CliRunner

from frictid_hil.cli.app import app
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import ConfigError, UsageError
from frictid_hil.jobs.new_robot import JointAnswers, new_robot

ELBOW = JointAnswers("elbow", 2, (-1.5, 1.0), 2.0, 30.0, 100.0, 12.0)


def test_the_file_holds_what_was_answered(tmp_path: Path) -> None:
    path = new_robot(tmp_path / "bench.yaml", driver="cia402", bus="socketcan:can0", joints=[ELBOW]).path
    robot = load_robot(path)
    joint = robot.file.joints["elbow"]
    assert (robot.name, robot.file.bus, joint.node, joint.gear_ratio) == ("bench", "socketcan:can0", 2, 100)
    assert (joint.position_min_rad, joint.position_max_rad) == pytest.approx((-1.5, 1.0), rel=1e-5)
    procedure = robot.procedure("elbow")
    assert joint.start_position_rad + procedure.amplitude_rad / 2 == pytest.approx(-0.25, abs=1e-5)
    assert procedure.velocity_rad_s == pytest.approx(1.0, rel=1e-5)


def test_nothing_is_replaced_unless_told(tmp_path: Path) -> None:
    path = tmp_path / "bench.yaml"
    path.write_text("mine")
    with pytest.raises(UsageError, match="exists"):
        new_robot(path, driver="cia402", bus="socketcan:can0", joints=[ELBOW])
    assert path.read_text() == "mine"
    new_robot(path, driver="cia402", bus="socketcan:can0", joints=[ELBOW], force=True)
    assert load_robot(path).joint_names == ("elbow",)


def test_answers_that_make_no_robot_leave_no_file(tmp_path: Path) -> None:
    twice = JointAnswers("wrist", 2, (-1.0, 1.0), 2.0, 30.0, 100.0, 12.0)
    with pytest.raises(ConfigError, match="already that of joint elbow"):
        new_robot(tmp_path / "bench.yaml", driver="cia402", bus="socketcan:can0", joints=[ELBOW, twice])
    with pytest.raises(UsageError, match="no gear_ratio"):
        new_robot(
            tmp_path / "bench.yaml",
            driver="cia402",
            bus="socketcan:can0",
            joints=[JointAnswers("elbow", 2, (-1.5, 1.0), 2.0, 30.0)],
        )
    assert list(tmp_path.iterdir()) == []


def test_the_verb_names_what_is_missing_and_writes_what_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "bench.yaml"
    given = ["new", "robot", str(path), "--json", "-j", "a=1", "-j", "b=2", "--bus", "socketcan:can0"]
    missing = CliRunner().invoke(app, given)
    assert missing.exit_code == 2
    assert "--travel" in json.loads(missing.stdout)["error"]["next_step"]
    limits = ["--travel=-90deg..90deg", "--max-velocity", "115deg/s", "--max-torque", "60Nm"]
    done = CliRunner().invoke(app, [*given, *limits, "--gear-ratio", "100", "--rated-torque", "24Nm"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["robot_file"] == str(path)
    assert load_robot(path).file.joints["b"].max_velocity_rad_s == pytest.approx(math.radians(115))
    dry = CliRunner().invoke(app, ["calibrate", "--robot", str(path), "--dry-run"])
    assert dry.exit_code == 0, dry.output
