"""A travel is rehearsed before it is driven fast, on every bus, and again when anything that matters has changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import UsageError
from frictid_hil.plan.plan import REHEARSAL, Hold, JointPlan, Plan, Sine
from frictid_hil.protocol.driver import Capabilities, JointIdentity
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.events import JointRun, Preflight
from frictid_hil.runs.rehearsals import Rehearsals

CAN = "socketcan:can0"


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Robot:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return load_robot("hp3j.yaml")


def plan(*, low: float = -0.4, high: float = 0.0, rehearse: bool = True, together: bool = False) -> Plan:
    motion = Sine(low, high - low, 0.3, name=REHEARSAL if rehearse else "sine")
    entries = tuple(JointPlan(joint, (motion, Hold(low, 0.1)), {}) for joint in (("0", "1") if together else ("0",)))
    return Plan("hp3j", 1000.0, entries, together=together)


def preflight(serial: str = "A1") -> Preflight:
    capabilities = Capabilities(max_cycle_hz=1000.0, modes=frozenset())
    return Preflight({joint: JointIdentity(joint, serial=serial) for joint in ("0", "1")}, capabilities, ())


def finished(joint: str = "0", name: str = REHEARSAL) -> JointRun:
    return JointRun(joint, 0, (Mark(name, 0, 1, {}),), 1000.0, 1, 0, 0, 0.0, 1.0)


def rehearsed(robot: Robot, bus: str | None, done: Plan, serial: str = "A1") -> Rehearsals:
    seen = Rehearsals(robot, bus)
    seen.heed(preflight(serial), done)
    for entry in done.joints:
        seen.heed(finished(entry.joint), done)
    return seen


def test_a_travel_seen_once_is_known_also_tomorrow(robot: Robot) -> None:
    assert not Rehearsals(robot, CAN).covers("0", -0.4, 0.0)
    rehearsed(robot, CAN, plan())
    tomorrow = Rehearsals(robot, CAN)
    assert tomorrow.covers("0", -0.4, 0.0) and tomorrow.covers("0", -0.3, -0.1)
    assert not tomorrow.covers("0", -0.4, 0.1), "a longer travel is a new one"
    assert not tomorrow.covers("1", -0.4, 0.0), "another joint"


def test_what_simulated_drives_rehearsed_proves_nothing_of_a_machine(robot: Robot) -> None:
    assert not rehearsed(robot, None, plan()).covers("0", -0.4, 0.0), "simulated drives rehearse every time"
    assert not Rehearsals(robot, CAN).covers("0", -0.4, 0.0)
    rehearsed(robot, CAN, plan())
    assert not Rehearsals(robot, "socketcan:can1").covers("0", -0.4, 0.0), "another bus may be another robot"


def test_a_changed_robot_file_rehearses_again(robot: Robot, tmp_path: Path) -> None:
    rehearsed(robot, CAN, plan())
    site = tmp_path / "hp3j.yaml"
    site.write_text(robot.path.read_text().replace("direction: 1", "direction: -1", 1))
    changed = load_robot(site)
    assert changed.name == robot.name
    assert not Rehearsals(changed, CAN).covers("0", -0.4, 0.0)


def test_joints_that_move_together_rehearse_together(robot: Robot) -> None:
    rehearsed(robot, CAN, plan())
    assert not Rehearsals(robot, CAN).covers("0", -0.4, 0.0, ("0", "1"))
    rehearsed(robot, CAN, plan(together=True))
    assert Rehearsals(robot, CAN).covers("0", -0.4, 0.0, ("1", "0"))


def test_an_exchanged_drive_is_refused_and_rehearses_next_time(robot: Robot) -> None:
    rehearsed(robot, CAN, plan())
    fast = plan(rehearse=False)
    Rehearsals(robot, CAN).heed(preflight("A1"), fast)
    with pytest.raises(UsageError, match="serial number B2, the joint was rehearsed with A1"):
        Rehearsals(robot, CAN).heed(preflight("B2"), fast)
    assert not Rehearsals(robot, CAN).covers("0", -0.4, 0.0)


def test_a_run_that_ended_before_its_rehearsal_counts_for_nothing(robot: Robot) -> None:
    seen = Rehearsals(robot, CAN)
    seen.heed(preflight(), plan())
    seen.heed(replace(finished(), marks=()), plan())
    assert not seen.covers("0", -0.4, 0.0)


@pytest.mark.parametrize("content", ["", "[]", "{", '{"schema": "frictid.rehearsals/1", "seen": [{"bus": 1}]}', "\xff"])
def test_a_spoilt_record_means_rehearsing_again(robot: Robot, tmp_path: Path, content: str) -> None:
    rehearsed(robot, CAN, plan())
    (record,) = tmp_path.rglob("hp3j.json")
    record.write_bytes(content.encode("latin1"))
    assert not Rehearsals(robot, CAN).covers("0", -0.4, 0.0)
    assert rehearsed(robot, CAN, plan()).covers("0", -0.4, 0.0)
