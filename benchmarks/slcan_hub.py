"""A CAN bus on a pseudo terminal, with one drive whose CANopen is the npm package `canopen` (node.js).

    python benchmarks/slcan_hub.py ROBOT FAMILY FOLDER

The host reaches the bus as python-can's `slcan` interface on the channel that the robot file names; that is a link to
the terminal. ``FOLDER`` holds what `npm ci` installed, and `drive.js`. SDO, NMT, heartbeat and PDO are the package's;
motor and state machine are the simulated servo's (``stranger_motor``), joined object by object: what the host writes is
written there, and what changes there is shown to the package before the next frame. The package stores a value before
the motor is asked; a refusal shows to the host as another value read back.

Lines between hub and package: ``t...``, a frame as slcan has it; ``=``, an object's address and bytes in hex; ``+``,
milliseconds that have passed; ``.``, all is done that the frame made it do.
"""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path

from stranger_motor import Motor, SdoAbort
from stranger_wire import DONE

from frictid_drivers.virtual.object_dictionary import encode
from frictid_drivers.virtual.objects import DataType
from frictid_hil.config.robot import load_robot

_DONE = f"T{DONE.arbitration_id:08X}0\r".encode()
_OF_THE_STACK = 0x2000
"""Communication objects, below this index, are the package's own once it runs."""


class Drive:
    """The package in a process of its own, and the motor behind it.

    Args:
        motor: behind.
        folder: where the package is installed.
        answer: takes what it sends, as slcan.
    """

    def __init__(self, motor: Motor, folder: str) -> None:
        self._motor = motor
        self._process = subprocess.Popen(
            ["node", "drive.js"], cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )
        self._shown = {entry.key: self._bytes(entry.key) for entry in motor.entries.values()}
        objects = [
            {
                "index": index,
                "sub": sub,
                "name": f"{entry.name} {index:04X}:{sub:02X}",
                "type": int(entry.kind),
                "access": entry.access,
                "mappable": entry.receive or entry.transmit,
                "limits": None if entry.kind is DataType.STRING or entry.access != "rw" else entry.limits,
                "bytes": self._shown[entry.key].hex(),
            }
            for (index, sub), entry in motor.entries.items()
        ]
        self._tell(json.dumps({"node": motor.node, "objects": objects}))
        assert self._line() == "."

    def take(self, frame: str) -> Iterator[str]:
        """Frames that it sends because of this one."""
        if frame.startswith("t080"):
            self._motor.advance()
            self._tell(f"+{1e3 * self._motor.period_s:g}")
        self._show()
        self._tell(frame)
        while (line := self._line()) != ".":
            if line.startswith("="):
                key, data = int(line[1:7], 16), bytes.fromhex(line[7:])
                self._shown[key] = data
                try:
                    self._motor.write_bytes(key, data)
                except SdoAbort:
                    continue  # the old value is shown again
            else:
                yield line

    def _show(self) -> None:
        """What has changed behind the package's back."""
        self._motor.settle()
        for key, shown in self._shown.items():
            if key >> 8 >= _OF_THE_STACK and (now := self._bytes(key)) != shown:
                self._shown[key] = now
                self._tell(f"={key:06X}{now.hex()}")

    def _bytes(self, key: int) -> bytes:
        return encode(self._motor.entries[key >> 8, key & 0xFF], self._motor.values[key])

    def _tell(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("the package has ended")
        return line.strip()


def main() -> None:
    """Play bus and drive until the process is ended."""
    robot, family, folder = sys.argv[1:]
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    emergencies: list[str] = []
    motor = Motor(
        robot, family, lambda cob_id, data: emergencies.append(f"t{cob_id:03X}{len(data)}{data.hex().upper()}")
    )
    drive = Drive(motor, folder)
    link = Path(load_robot(robot).file.bus.partition(":")[2])
    link.symlink_to(os.ttyname(theirs))
    print("ready", flush=True)
    left = b""
    while True:
        *lines, left = (left + os.read(ours, 4096)).split(b"\r")
        for line in lines:
            if line.startswith(b"t"):  # the rest opens and closes an adapter
                sent = [*drive.take(line.decode()), *emergencies]
                emergencies.clear()
                os.write(ours, b"".join(frame.encode() + b"\r" for frame in sent) + _DONE)


if __name__ == "__main__":
    main()
