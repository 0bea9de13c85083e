"""The owner's end of the drives' own process: start it, wait until it is ready, let it go."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import select
import subprocess
import sys
from pathlib import Path
from typing import Any

from frictid_hil.errors import HardwareError
from frictid_hil.plan.setup import JointSetup, RobotSetup

READY = "ready"  # what the process says once its drives are on the bus

DISMISSAL = "end"  # what the owner says when it needs the drives no longer

_START_S = 120.0
_END_S = 5.0


class RunningRack:
    """The drives' process, running."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.pid = process.pid

    def stop(self) -> None:
        """Dismiss it; insist after a while."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.write(f"{DISMISSAL}\n")
                self._process.stdin.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()


def start_rack(setup: RobotSetup) -> RunningRack:
    """Start a robot's drives in a process of their own; ``HardwareError`` says why it did not come up."""
    process = subprocess.Popen(
        [sys.executable, "-m", "frictid_drivers.virtual.rack_process"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        # A terminal's Ctrl-C reaches the owner, not the drives.
        start_new_session=True,
    )
    rack = RunningRack(process)
    assert process.stdin is not None and process.stdout is not None
    try:
        process.stdin.write(encode_setup(setup) + "\n")
        process.stdin.flush()
        readable, _, _ = select.select([process.stdout], [], [], _START_S)
        answer = process.stdout.readline().strip() if readable else "no answer"
    except OSError as error:
        answer = str(error)
    if answer != READY:
        rack.stop()
        raise HardwareError(f"the simulated drives did not start: {answer or 'their process ended'}", where=setup.bus)
    return rack


def encode_setup(setup: RobotSetup) -> str:
    """The robot as one line of JSON."""
    plain = dataclasses.asdict(setup)
    plain["folder"] = None if setup.folder is None else str(setup.folder)
    return json.dumps(plain, default=dict)


def decode_setup(line: str) -> RobotSetup:
    """The robot of ``encode_setup``."""
    mapping: dict[str, Any] = json.loads(line)
    joints = tuple(JointSetup(**joint) for joint in mapping.pop("joints"))
    folder = mapping.pop("folder")
    return RobotSetup(joints=joints, folder=None if folder is None else Path(folder), **mapping)
