"""Every way a night can end: its exit code, its one line, its next step, its journal, and the profile in force."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import filelock
import pytest
from typer.testing import CliRunner

from frictid_drivers.virtual.channel import runtime_folder
from frictid_hil.cli.app import app
from frictid_hil.config.attempts import attempts
from frictid_hil.config.robot import load_robot
from frictid_hil.config.store import ProfileStore
from frictid_hil.config.write import dump

ROBOT = "endings"
UNATTENDED = {
    "allowed_by": "Iwatani",
    "date": "2026-11-21",
    "interlock_input": {"joint": "5", "bit": 3, "closed_when": 1},
}


def robot_file(place: Path, *, friction: float = 1.0, faults: list[Any] | None = None, **policy: Any) -> str:
    """The smallest joint of the shipped robot alone, with a short procedure."""
    values = load_robot("hp3j").values()
    values |= {"name": ROBOT, "bus": "virtual:endings", "joints": {"5": values["joints"]["5"]}}
    values["procedure"] |= {"amplitude_rad": 0.2, "velocity_rad_s": 1.5, "cycles": 3}
    values["policy"] = {"warm_up": {"fixed_s": 0.0}} | policy
    values["joints"]["5"]["simulated"]["friction"]["coulomb_nm"] *= friction
    values["joints"]["5"]["simulated"]["friction"]["viscous_nm_s_per_rad"] *= friction
    if faults:
        values["options"] = {"faults": faults}
    path = place / "endings.yaml"
    path.write_text(dump(values))
    return str(path)


def arguments(place: Path, robot: str) -> list[str]:
    store, out = str(place / "store"), str(place / "run")
    return ["recalibrate", "--robot", robot, "--store", store, "--out", out, "--json"]


@pytest.fixture(scope="module")
def first_night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with one promoted profile, as a night leaves it."""
    place = tmp_path_factory.mktemp("first")
    ended = CliRunner().invoke(app, arguments(place, robot_file(place)))
    assert ended.exit_code == 0, ended.stderr
    return place / "store"


@contextmanager
def held_by_another_recalibration(place: Path) -> Iterator[None]:
    with filelock.FileLock(place / "store" / ROBOT / ".recalibrate.lock"):
        yield


@contextmanager
def bus_held(_: Path) -> Iterator[None]:
    with filelock.FileLock(runtime_folder() / "endings.lock"):
        yield


@contextmanager
def another_drive_in_force(place: Path) -> Iterator[None]:
    store = ProfileStore(place / "store")
    active = store.active_profile(ROBOT)
    assert active is not None
    joint = active.joints["5"]
    drive = joint.drive.model_copy(update={"serial": "1234"})
    joints = {"5": joint.model_copy(update={"drive": drive})}
    store.promote(ROBOT, store.add(active.model_copy(update={"joints": joints})))
    yield


OPEN = [{"kind": "interlock_open", "joint": "5", "at_s": 0.0}]
STUCK = [{"kind": "stuck_encoder", "joint": "5", "at_s": 6.0}]
OFF = [{"kind": "mute", "joint": "5", "at_s": 3.0}]

ENDINGS = {
    "within the policy": ({}, nullcontext, [], 0, "ok", "within every limit", "nothing to do"),
    "left to a person": ({"promotion": "by_person"}, nullcontext, [], 0, "ok", "to a person", "profile promote"),
    "no permission": ({}, nullcontext, ["--bus", "socketcan:no0"], 2, "refused", "unattended", "add policy.unattended"),
    "not reachable": (
        {"unattended": UNATTENDED},
        nullcontext,
        ["--bus", "socketcan:no0"],
        3,
        "aborted",
        "cannot open the bus",
        "ip link set no0 up",
    ),
    "power lost": ({"faults": OFF}, nullcontext, [], 4, "aborted", "", ""),
    "bus held": ({}, bus_held, [], 3, "aborted", "in use", "wait for it"),
    "another at work": ({}, held_by_another_recalibration, [], 3, "aborted", "another recalibration", "wait for it"),
    "interlock open": ({"unattended": UNATTENDED, "faults": OPEN}, nullcontext, [], 4, "aborted", "interlock", ""),
    "encoder lost": ({"faults": STUCK}, nullcontext, [], 4, "aborted", "", ""),
    "changed too much": ({"friction": 0.6}, nullcontext, [], 5, "gate_failed", "changed since", "look at joints 5"),
    "drive exchanged": ({}, another_drive_in_force, [], 5, "gate_failed", "drive serial 1234", "--baseline"),
}


@pytest.mark.parametrize("name", ENDINGS)
def test_every_ending(name: str, first_night: Path, tmp_path: Path) -> None:
    changes, circumstances, more, code, outcome, says, next_step = ENDINGS[name]
    shutil.copytree(first_night, tmp_path / "store")
    store = ProfileStore(tmp_path / "store")
    robot = robot_file(tmp_path, **changes)
    with nullcontext() if circumstances is nullcontext else circumstances(tmp_path):
        before = store.active(ROBOT)
        ended = CliRunner().invoke(app, [*arguments(tmp_path, robot), *more])
    assert ended.exit_code == code, ended.stderr
    (line,) = ended.stdout.splitlines()
    result = json.loads(line)
    assert (result["schema"], result["outcome"]) == ("frictid.recalibrate/1", outcome)
    told = result["error"] if "error" in result else {"what": result["reason"], "next_step": result["next_step"]}
    assert says in told["what"] and told["next_step"] and next_step in told["next_step"], told
    last = attempts(store.root, ROBOT)[-1]
    assert (last.exit_code, last.outcome, last.next_step) == (code, outcome, told["next_step"])
    assert last.promoted is (name == "within the policy")
    assert store.active_profile(ROBOT) is not None
    assert (store.active(ROBOT) != before) is last.promoted


def test_a_robot_file_that_is_wrong_has_its_line_as_well(tmp_path: Path) -> None:
    robot = Path(robot_file(tmp_path))
    robot.write_text(robot.read_text().replace("cycle_hz:", "cycle_hertz:"))
    ended = CliRunner().invoke(app, arguments(tmp_path, str(robot)))
    assert ended.exit_code == 2
    (line,) = ended.stdout.splitlines()
    error = json.loads(line)["error"]
    assert "endings.yaml:" in error["where"] + error["what"] and "cycle_hz" in error["what"]


def test_a_defect_of_the_program_is_an_ending_too(
    first_night: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(first_night, tmp_path / "store")

    def broken(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("frictid_hil.jobs.recalibrate.calibrate", broken)
    ended = CliRunner().invoke(app, arguments(tmp_path, robot_file(tmp_path)))
    assert ended.exit_code == 1
    (line,) = ended.stdout.splitlines()
    result = json.loads(line)
    assert result["outcome"] == "aborted" and "ZeroDivisionError" in result["error"]["what"]
    assert "report" in result["error"]["next_step"] and "Traceback" in ended.stderr
    last = attempts(tmp_path / "store", ROBOT)[-1]
    assert (last.exit_code, last.promoted) == (1, False) and "ZeroDivisionError" in last.reason and last.next_step


def test_a_night_that_could_not_begin_is_notified_too(tmp_path: Path) -> None:
    told = tmp_path / "told.json"
    command = [sys.executable, "-m", "frictid_hil.cli.app", *arguments(tmp_path, robot_file(tmp_path))]
    command += ["--bus", "socketcan:no0", "--notify", f"tee '{told}'"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert ended.returncode == 2
    assert json.loads(told.read_text()) == json.loads(ended.stdout)


def test_a_signal_during_motion_is_told_like_every_other_ending(first_night: Path, tmp_path: Path) -> None:
    shutil.copytree(first_night, tmp_path / "store")
    command = [sys.executable, "-m", "frictid_hil.cli.app", *arguments(tmp_path, robot_file(tmp_path)), "--realtime"]
    night = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    samples = tmp_path / "run" / "samples.mcap"
    until = time.monotonic() + 60.0
    while not (samples.exists() and samples.stat().st_size > 100_000) and time.monotonic() < until:
        time.sleep(0.05)
    night.send_signal(signal.SIGTERM)
    said, complained = night.communicate(timeout=60)
    assert night.returncode == 130, complained
    (line,) = said.splitlines()
    result = json.loads(line)
    assert (result["outcome"], result["promoted"]) == ("interrupted", False) and result["next_step"]
    last = attempts(tmp_path / "store", ROBOT)[-1]
    assert (last.exit_code, last.outcome) == (130, "interrupted")
