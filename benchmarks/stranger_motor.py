"""What is behind a stranger's CANopen: the simulated servo's motor and state machine, reached by objects alone.

An independent CiA-402 axis was not found. Time goes on by one period per SYNC, so that a loaded machine delays frames
and bends no physics.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from frictid_drivers.virtual.devices import plant_for
from frictid_drivers.virtual.joint_drive import servo_for
from frictid_drivers.virtual.object_dictionary import SdoAbort, encode
from frictid_drivers.virtual.objects import Entry, Value
from frictid_drivers.virtual.personality import personality_of
from frictid_hil.config.robot import load_robot


class Motor:
    """The only drive of a robot file, as a drive family ships it.

    Args:
        robot: file.
        family: in `personalities.yaml`.
        send: takes the drive's emergencies.

    Attributes:
        node: its id.
        period_s: of SYNC.
        entries: of the family, by (index, subindex).
        values: current ones, by index << 8 | subindex.
    """

    def __init__(self, robot: str, family: str, send: Callable[[int, bytes], None]) -> None:
        setup = load_robot(robot).to_setup()
        (joint,) = setup.joints
        joint = replace(joint, options={**joint.options, "personality": family})
        personality = personality_of(joint)
        assert personality is not None
        self._servo = servo_for(setup, joint, plant_for(setup, joint), send)
        self._servo.dictionary.reset()
        self._servo.power.boot()
        self._now_ns = 0
        self.node, self.period_s = joint.address, 1.0 / setup.cycle_hz
        self.values: dict[int, Value] = self._servo.dictionary.values
        self.entries: dict[tuple[int, int], Entry] = {
            (record.index, entry.key & 0xFF): entry
            for record in personality.records
            for entry in record.entries
            if entry.key not in personality.manner.absent
        }

    def settle(self) -> None:
        """Bring the values up to this moment."""
        self._servo.power.run_to(self._now_ns)
        self._servo.power.latch(remote=True)

    def advance(self) -> None:
        """Let one period pass."""
        self._now_ns += round(self.period_s * 1e9)
        self.settle()

    def write(self, entry: Entry, value: Value) -> None:
        """Give an object its value.

        Raises:
            SdoAbort: refused, as the family refuses it.
        """
        self.write_bytes(entry.key, encode(entry, value))

    def write_bytes(self, key: int, data: bytes) -> None:
        """The same as bytes; see ``write``."""
        self.settle()
        self._servo.dictionary.download(key, data)


__all__ = ["Motor", "SdoAbort"]
