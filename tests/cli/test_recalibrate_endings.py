"""Every way a night can end: its exit code, its one line, its next step, its journal, and the profile in force."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import filelock
import pytest
from typer.testing import CliRunner

from frictid_drivers.cia402.fleet import Fleet
from frictid_hil.cli.app import app
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.protocol.can_bus import BusLock

ROBOT = "endings"
UNATTENDED = {
    "allowed_by": "Iwatani",
    "date": "2026-11-21",
    "interlock_input": {"joint": "5", "bit": 3, "closed_when": 1},
}


def robot_file(place: Path, *, friction: float = 1.0, faults: list[Any] | None = None, **policy: Any) -> str:
    """The smallest joint of the shipped robot alone, with a short procedure."""
    values = load_robot("hp3j").values()
    values |= {"name": ROBOT, "bus": "virtual:endings", "cycle_hz": 500, "joints": {"5": values["joints"]["5"]}}
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
    lock = BusLock("socketcan:held0")
    lock.acquire()
    try:
        yield
    finally:
        lock.release()


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


@contextmanager
def no_watchdog(_: Path) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Fleet, "watchdog", False)
        yield


def nothing_special(_: Path) -> AbstractContextManager[None]:
    return nullcontext()


@dataclass(frozen=True)
class Ending:
    """How a night is made to end, and what must be told of it.

    Attributes:
        code: exit code.
        outcome: word of the JSON.
        says: part of the reason.
        next_step: part of it.
        changes: of the robot file.
        more: arguments.
        meanwhile: what is the case while the night is tried.
    """

    code: int
    outcome: str
    says: str = ""
    next_step: str = ""
    changes: Mapping[str, Any] = field(default_factory=dict)
    more: tuple[str, ...] = ()
    meanwhile: Callable[[Path], AbstractContextManager[None]] = nothing_special


def fault(kind: str, at_s: float) -> dict[str, Any]:
    return {"faults": [{"kind": kind, "joint": "5", "at_s": at_s}]}


ALLOWED = {"unattended": UNATTENDED}
NO_CAN = ("--bus", "socketcan:no0")
ALARM = {"friction": 1.15, "on_drift": "alarm"}
ENDINGS = {
    "within the policy": Ending(0, "ok", "within every limit", "nothing to do"),
    "left to a person": Ending(0, "ok", "to a person", "profile promote", {"promotion": "by_person"}),
    "drifted": Ending(0, "ok", "has drifted", "look at joint 5:", {"friction": 1.15}),
    "drifted, with an alarm": Ending(
        6, "ok", "has drifted", "look at joint 5:", {"friction": 1.15, "on_drift": "alarm"}
    ),
    "no watchdog": Ending(2, "refused", "no watchdog of their own", "person present", ALLOWED, meanwhile=no_watchdog),
    "no permission": Ending(2, "refused", "unattended", "add policy.unattended", more=NO_CAN),
    "not reachable": Ending(3, "aborted", "cannot open the bus", "ip link set no0 up", ALLOWED, NO_CAN),
    "bus held": Ending(
        3, "aborted", "held by another", "wait for it", ALLOWED, ("--bus", "socketcan:held0"), meanwhile=bus_held
    ),
    "another at work": Ending(
        3, "aborted", "another recalibration", "wait for it", meanwhile=held_by_another_recalibration
    ),
    "power lost": Ending(4, "aborted", changes=fault("mute", 3.0)),
    "encoder lost": Ending(4, "aborted", "following error", "look at the joint", fault("stuck_encoder", 6.0)),
    "interlock open": Ending(4, "aborted", "interlock", "close the cell", {**ALLOWED, **fault("interlock_open", 0.0)}),
    "changed too much": Ending(5, "gate_failed", "changed since", "look at joint 5:", {"friction": 0.6}),
    "drive exchanged": Ending(5, "gate_failed", "drive serial 1234", "--baseline", meanwhile=another_drive_in_force),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ENDINGS)
def test_every_ending(name: str, first_night: Path, tmp_path: Path) -> None:
    wanted = ENDINGS[name]
    shutil.copytree(first_night, tmp_path / "store")
    store = ProfileStore(tmp_path / "store")
    robot = robot_file(tmp_path, **wanted.changes)
    with wanted.meanwhile(tmp_path):
        before = store.active(ROBOT)
        ended = CliRunner().invoke(app, [*arguments(tmp_path, robot), *wanted.more])
    assert ended.exit_code == wanted.code, ended.stderr
    (line,) = ended.stdout.splitlines()
    result = json.loads(line)
    assert (result["schema"], result["outcome"]) == ("frictid.recalibrate/1", wanted.outcome)
    told = result["error"] if "error" in result else {"what": result["reason"], "next_step": result["next_step"]}
    assert wanted.says in told["what"] and told["next_step"] and wanted.next_step in told["next_step"], told
    last = store.attempts(ROBOT)[-1]
    assert (last.exit_code, last.outcome, last.next_step) == (wanted.code, wanted.outcome, told["next_step"])
    assert last.promoted is (name in ("within the policy", "drifted", "drifted, with an alarm"))
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


@pytest.mark.slow
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
    last = ProfileStore(tmp_path / "store").attempts(ROBOT)[-1]
    assert (last.exit_code, last.promoted) == (1, False) and "ZeroDivisionError" in last.reason and last.next_step


@pytest.mark.slow
def test_a_night_that_could_not_begin_is_notified_too(tmp_path: Path) -> None:
    told = tmp_path / "told.json"
    command = [sys.executable, "-m", "frictid_hil.cli.app", *arguments(tmp_path, robot_file(tmp_path))]
    command += ["--bus", "socketcan:no0", "--notify", f"tee '{told}'"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert ended.returncode == 2
    assert json.loads(told.read_text()) == json.loads(ended.stdout)


@pytest.mark.slow
@pytest.mark.wall_clock
def test_a_signal_during_motion_is_told_like_every_other_ending(first_night: Path, tmp_path: Path) -> None:
    shutil.copytree(first_night, tmp_path / "store")
    command = [sys.executable, "-m", "frictid_hil.cli.app", *arguments(tmp_path, robot_file(tmp_path)), "--realtime"]
    night = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    samples = tmp_path / "run" / "samples.mcap"
    until = time.monotonic() + 60.0
    while not (samples.exists() and samples.stat().st_size > 100_000) and time.monotonic() < until:
        assert night.poll() is None, "".join(night.communicate())
        time.sleep(0.05)
    night.send_signal(signal.SIGTERM)
    said, complained = night.communicate(timeout=60)
    assert night.returncode == 130, said + complained
    (line,) = said.splitlines()
    result = json.loads(line)
    assert (result["outcome"], result["promoted"]) == ("interrupted", False) and result["next_step"]
    last = ProfileStore(tmp_path / "store").attempts(ROBOT)[-1]
    assert (last.exit_code, last.outcome) == (130, "interrupted")
