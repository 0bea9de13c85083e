"""What a host and simulated drives do on a real SocketCAN link; runs inside ``kernel_with_can``, as root, on ``vcan0``.

Host and drives are processes of their own, as on a machine. Written to ``found.json`` in the folder: what each step
gave. Steps: check; a short calibration with error frames on the bus that mean nothing; a calibration that meets
bus-off; one whose link is taken down in motion; what check and reset say when it is up again; CAN FD on a link that is
classical and on one that is not.

    python benchmarks/kernel_with_can.py benchmarks/socketcan_guest.py FOLDER
"""

from __future__ import annotations

import contextlib
import functools
import json
import multiprocessing
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import yaml

from frictid_hil.errors import FrictidError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.check import check
from frictid_hil.jobs.emulate import emulate
from frictid_hil.jobs.reset import reset
from frictid_hil.jobs.watch import Silent
from frictid_hil.runner.events import Event, PhaseStarted

LINK, BUS = "vcan0", "socketcan:vcan0"
COULOMB_NM = 5.0
PASSIVE = can.Message(arbitration_id=0x04, data=bytes([0, 0x30, 0, 0, 0, 0, 0, 0]), is_error_frame=True)
BUS_OFF = can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True)
READY_S = 60.0
TRIES = 3


def robot_file(folder: Path, *, fd: bool = False) -> Path:
    """One joint at 50 Hz; watchdogs as long as a kernel without real time needs them."""
    joint = {
        "node": 3, "gear_ratio": 100, "max_velocity_rad_s": 3.0, "max_torque_nm": 60.0, "rated_torque_nm": 40.0,
        "position_min_rad": -2.0, "position_max_rad": 2.0, "start_position_rad": 0.0, "locked_position_rad": 0.0,
        "expected": {"inertia_kg_m2": 0.3, "gravity_nm": 0, "friction_nm": 6.0},
        "simulated": {"inertia_kg_m2": 0.3, "friction": {"coulomb_nm": COULOMB_NM, "viscous_nm_s_per_rad": 1.5}},
    }  # fmt: skip
    values = {
        "schema": "frictid.robot/1", "name": "bench", "driver": "cia402", "bus": BUS, "cycle_hz": 50,
        "options": {"watchdog_ms": 1000, "drive_heartbeat_ms": 500, "sdo_timeout_s": 5.0, "fd": fd},
        "procedure": {"amplitude_rad": 0.1, "velocity_rad_s": 0.3, "cycles": 3, "ratio": 0.8},
        "gates": {"late_cycles": 0.5},
        "care": {"silence_s": 0.5, "following_error_rad": 0.3, "velocity_slack_rad_s": 1.0},
        "joints": {"0": joint},
    }  # fmt: skip
    path = folder / ("fd.yaml" if fd else "bench.yaml")
    path.write_text(yaml.safe_dump(values, sort_keys=False))
    return path


def link(*settings: str) -> None:
    """``ip link set vcan0 ...``, as the administrator does."""
    subprocess.run(["busybox", "ip", "link", "set", LINK, *settings], check=True)


@contextlib.contextmanager
def drives(robot: Path) -> Iterator[None]:
    """The drives, in a process of their own."""
    context = multiprocessing.get_context("fork")
    ready = context.Event()
    process = context.Process(
        target=emulate,
        args=("cia402",),
        kwargs={"announce": lambda _: ready.set(), "robot_name": str(robot), "bus": BUS},
    )
    process.start()
    try:
        assert ready.wait(READY_S), "the drives did not come up"
        yield
    finally:
        process.terminate()
        process.join()


class At(Silent):
    """Does something when a phase begins.

    Args:
        phase: name.
        action: done once.
    """

    def __init__(self, phase: str, action: Callable[[], None]) -> None:
        self._phase, self._action = phase, action

    def event(self, event: Event) -> None:
        """A phase that begins."""
        if isinstance(event, PhaseStarted) and event.phase == self._phase:
            self._action()


def send(message: can.Message) -> None:
    """From a third member of the bus."""
    with can.Bus(interface="socketcan", channel=LINK) as bus:
        bus.send(message)


def at_last(attempt: Callable[[], Any]) -> dict[str, Any]:
    """What is told once drives on a busy computer have come to themselves: the first of four attempts that is ok."""
    found = told(attempt)
    for _ in range(3):
        if found.get("ok"):
            break
        time.sleep(3.0)
        found = told(attempt)
    return found


def told(action: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """The result, or the error that ended it, and how long it took."""
    began = time.monotonic()
    try:
        result = action()
    except FrictidError as error:
        result = {"outcome": error.outcome, "exit_code": error.exit_code, "error": str(error), "next": error.next_step}
    return {**result, "took_s": time.monotonic() - began}


def calibrated_at_last(
    robot: str, place: Path, action: Callable[[], None], ends_with: tuple[int, ...]
) -> dict[str, Any]:
    """A run with the action when its cycles begin; once more where a stall of this kernel ended it in another way."""

    def attempt(number: int) -> dict[str, Any]:
        return calibrate(CalibrateOptions(robot, out=place / str(number)), At("cycles", action)).to_json()

    for number in range(1, TRIES + 1):
        run = told(functools.partial(attempt, number))
        if run["exit_code"] in ends_with:
            break
        print(f"{place.name}, try {number}: {run['outcome']}: {run['error']}", flush=True)
        link("up")
        told(lambda: reset(robot, ask=lambda faults: True))
    return run | {"tries": number}


def main(folder: Path) -> dict[str, Any]:
    """All steps."""
    robot, fd = str(robot_file(folder)), str(robot_file(folder, fd=True))

    def calibrated(name: str, action: Callable[[], None], ends_with: tuple[int, ...]) -> dict[str, Any]:
        return calibrated_at_last(robot, folder / name, action, ends_with)

    found = {}
    with drives(Path(robot)):
        found["check"] = told(lambda: check(robot))
        found["calibrated"] = calibrated("calibrated", lambda: send(PASSIVE), (0, 5))
        found["bus off"] = calibrated("bus off", lambda: send(BUS_OFF), (3,))
        found["link down"] = calibrated("link down", lambda: link("down"), (3,))
        found["check while down"] = told(lambda: check(robot))
        link("up")
        found["reset"] = told(lambda: reset(robot, ask=lambda faults: True))
        found["check after"] = at_last(lambda: check(robot))
        found["fd"] = at_last(lambda: check(fd))
        link("down")
        link("mtu", "16")
        link("up")
        found["fd on a classical link"] = told(lambda: check(fd))
    return found


if __name__ == "__main__":
    place = Path(sys.argv[1])
    (place / "found.json").write_text(json.dumps(main(place), indent=1))
