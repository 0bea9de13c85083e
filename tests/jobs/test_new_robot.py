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
    dry = CliRunner().invoke(app, ["check", "--robot", str(path), "--dry"])
    assert dry.exit_code == 0 and "ready for a check of the drives" in dry.output, "opens no bus: there is no can0 here"
    checked = CliRunner().invoke(app, ["check", "--robot", str(path), "--bus", "virtual:new-bench"])
    assert checked.exit_code == 0, "its simulated drives stand for the real ones"


def test_on_a_terminal_a_mistyped_answer_is_asked_for_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("frictid_hil.cli.new._on_a_terminal", lambda: True)
    path = tmp_path / "bench.yaml"
    answers = [
        "elbow",
        "elbow=2",
        "can0",
        "socketcan:can0",
        "-90..90",
        "-90deg..90deg",
        "115deg/s",
        "60Nm",
        "100",
        "24Nm",
    ]
    asked = CliRunner().invoke(app, ["new", "robot", str(path)], input="\n".join(answers) + "\n")
    assert asked.exit_code == 0, asked.output
    assert asked.output.count("Error:") == 3 and "'-90' has no unit" in asked.output
    assert load_robot(path).file.joints["elbow"].rated_torque_nm == 24.0
    given_up = CliRunner().invoke(app, ["new", "robot", str(tmp_path / "b.yaml")], input="elbow=2\n")
    assert given_up.exit_code == 130 and "no file was written" in given_up.output


def test_a_dry_check_refuses_a_plan_beyond_the_limits(tmp_path: Path) -> None:
    path = new_robot(tmp_path / "bench.yaml", driver="cia402", bus="socketcan:can0", joints=[ELBOW]).path
    path.write_text(path.read_text().replace("velocity_rad_s: 57.2958deg/s", "velocity_rad_s: 150deg/s"))
    dry = CliRunner().invoke(app, ["check", "--robot", str(path), "--dry", "--json"])
    said = json.loads(dry.stdout)
    assert dry.exit_code == 2 and said["dry"] and not said["ok"]
    assert [finding["subject"] for finding in said["findings"] if finding["severity"] == "error"] == ["plan"]
