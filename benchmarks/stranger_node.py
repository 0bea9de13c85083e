"""A drive whose CANopen is not ours: `durand` speaks SDO, NMT, PDO, SYNC and heartbeat in front of the simulated joint.

    python benchmarks/stranger_node.py ROBOT FAMILY

The object list, access, ranges and defaults are the family's (`personalities.yaml`). The node is strict beyond what the
library is: a PDO is mapped only while it is invalid, and only with what is mappable; values are refused as the family
refuses them. Motor and state machine are the simulated servo's: an independent CiA-402 axis was not found. The joint's
time goes on by one period per SYNC, so that a loaded machine delays frames and bends no physics.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import can
from durand import Node
from durand.datatypes import DatatypeEnum
from durand.network import NetworkABC
from durand.node import MinimalNodeCapabilities
from durand.object_dictionary import Record, Variable
from durand.scheduler import VirtualScheduler, set_scheduler
from stranger_wire import DONE

from frictid_drivers.virtual.joint_drive import plant_for, servo_for
from frictid_drivers.virtual.object_dictionary import encode
from frictid_drivers.virtual.objects import DataType, Entry
from frictid_drivers.virtual.personality import personality_of
from frictid_drivers.virtual.servo import Servo
from frictid_hil.config.robot import load_robot

NOT_VALID = 1 << 31
OF_THE_STACK = {0x1001, 0x1005, 0x1014, 0x1015, 0x1017}
"""Objects that the library brings along and reacts to."""


class Line(NetworkABC):  # type: ignore[misc]  # the library has no types
    """The library's way to the bus.

    Args:
        bus: to the host.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._subscriptions: dict[int, Callable[[int, bytes], None]] = {}
        self._own: set[int] = set()

    def add_subscription(self, cob_id: int, callback: Callable[[int, bytes], None]) -> None:
        """Who wants to hear of an identifier."""
        self._subscriptions[cob_id] = callback

    def remove_subscription(self, cob_id: int) -> None:
        """No longer."""
        self._subscriptions.pop(cob_id)

    def send(self, cob_id: int, msg: bytes) -> None:
        """One frame of the node."""
        self._own.add(cob_id)
        self._bus.send(can.Message(arbitration_id=cob_id, data=msg, is_extended_id=False))

    def serve(self) -> None:
        """Deal with every frame of the host, one after the other, and say so."""
        for message in self._bus:
            if message.is_extended_id or message.arbitration_id in self._own:
                continue  # a multicast group hears itself
            heard = self._subscriptions.get(message.arbitration_id)
            if heard is not None:
                heard(message.arbitration_id, bytes(message.data))
            self._bus.send(DONE)


class Stranger:
    """One node.

    Args:
        node: of the library, fresh.
        servo: the motor behind it, with the family's values after power-on.
        entries: of the family, by (index, subindex).
        scheduler: the library's time.
        period_s: of SYNC.
    """

    def __init__(
        self,
        node: Node,
        servo: Servo,
        entries: dict[tuple[int, int], Entry],
        scheduler: VirtualScheduler,
        period_s: float,
    ) -> None:
        self._node, self._servo, self._entries = node, servo, entries
        self._scheduler, self._period_s = scheduler, period_s
        self._period_ns = round(period_s * 1e9)
        self._now_ns = 0
        od = node.object_dictionary
        for (index, sub), entry in entries.items():
            if index not in OF_THE_STACK and not 0x1400 <= index < 0x1C00 and not (sub == 0 and (index, 1) in entries):
                self._add(index, sub, entry)
        for base in (0x1600, 0x1A00):
            for number in range(4):
                for sub in range(9):
                    guard = partial(self._mapping, base + number, sub)
                    od.validate_callbacks[base + number, sub].add(guard)
        # Before every PDO of this SYNC, which are registered when they become valid.
        node.sync.callbacks.add(self._on_sync)

    def _add(self, index: int, sub: int, entry: Entry) -> None:
        od, values = self._node.object_dictionary, self._servo.dictionary.values
        low, high = (None, None) if entry.kind is DataType.STRING else entry.limits
        kind = DatatypeEnum(int(entry.kind))
        variable = Variable(kind, entry.access, minimum=low, maximum=high, name=entry.name)
        if (index, 1) in self._entries:
            if index not in od or not isinstance(od[index], Record):
                od[index] = Record(entry.name)
            od[index][sub] = variable
        else:
            od[index] = variable

        def read() -> Any:
            self._run()
            value = values[entry.key]
            return value.encode() if isinstance(value, str) else value

        od.set_read_callback(index, sub, read)
        if entry.access in ("rw", "wo"):
            od.validate_callbacks[index, sub].add(partial(self._write, entry))

    def _write(self, entry: Entry, value: Any) -> None:
        self._run()
        self._servo.dictionary.download(entry.key, encode(entry, value))

    def _mapping(self, index: int, sub: int, value: int) -> None:
        """Refuse what a strict drive refuses; the library asks before it stores."""
        pdo = self._node.object_dictionary.read(index - 0x200, 1)
        if not pdo & NOT_VALID:
            raise ValueError("mapped while valid")
        if sub:
            entry = self._entries[value >> 16, value >> 8 & 0xFF]
            if not (entry.receive if index < 0x1A00 else entry.transmit):
                raise ValueError("not mappable")

    def _run(self) -> None:
        self._servo.power.run_to(self._now_ns)
        self._servo.power.latch(remote=True)

    def _on_sync(self) -> None:
        self._now_ns += self._period_ns
        self._scheduler.run(self._period_s)
        self._run()
        od, values = self._node.object_dictionary, self._servo.dictionary.values
        for pdo in self._node.tpdo:
            for index, sub in pdo.mapping if pdo.enable else ():
                od.write(index, sub, values[index << 8 | sub])


def build(robot: str, family: str, line: Line) -> Stranger:
    """The only drive of this robot file, as this family."""
    setup = load_robot(robot).to_setup()
    (joint,) = setup.joints
    joint = replace(joint, options={**joint.options, "personality": family})
    personality = personality_of(joint)
    assert personality is not None
    servo = servo_for(setup, joint, plant_for(setup, joint), line.send)
    servo.dictionary.reset()
    servo.power.boot()
    absent = personality.manner.absent
    entries = {
        (record.index, entry.key & 0xFF): entry
        for record in personality.records
        for entry in record.entries
        if entry.key not in absent
    }
    scheduler = VirtualScheduler()
    set_scheduler(scheduler)
    node = Node(line, joint.address, capabilities=MinimalNodeCapabilities)
    return Stranger(node, servo, entries, scheduler, 1.0 / setup.cycle_hz)


def main() -> None:
    """Play it until the process is ended."""
    robot, family = sys.argv[1:]
    file = load_robot(robot).file
    interface, _, channel = file.bus.partition(":")
    line = Line(can.Bus(interface=interface, channel=channel, port=file.options["port"]))
    stranger = build(robot, family, line)
    print("ready", flush=True)
    assert stranger
    line.serve()


if __name__ == "__main__":
    main()
