"""A drive whose CANopen is not ours: `durand` speaks SDO, NMT, PDO, SYNC and heartbeat in front of the simulated joint.

    python benchmarks/stranger_node.py ROBOT FAMILY

The object list, access, ranges and defaults are the family's (`personalities.yaml`). The node is strict beyond what the
library is: a PDO is mapped only while it is invalid, and only with what is mappable; values are refused as the family
refuses them. Motor and state machine are the simulated servo's: an independent CiA-402 axis was not found. The joint's
time goes on by one period per SYNC, so that a loaded machine delays frames and bends no physics.
"""

from __future__ import annotations

import asyncio
import sys
from dataclasses import replace
from functools import partial
from typing import Any

import can
from durand import Node
from durand.datatypes import DatatypeEnum
from durand.network import CANBusNetwork
from durand.node import MinimalNodeCapabilities
from durand.object_dictionary import Record, Variable
from durand.scheduler import AsyncScheduler, set_scheduler

from frictid_drivers.virtual.joint_drive import plant_for, servo_for
from frictid_drivers.virtual.object_dictionary import encode
from frictid_drivers.virtual.objects import DataType, Entry
from frictid_drivers.virtual.personality import personality_of
from frictid_drivers.virtual.servo import Servo
from frictid_hil.config.robot import load_robot

NOT_VALID = 1 << 31
OF_THE_STACK = {0x1001, 0x1005, 0x1014, 0x1015, 0x1017}
"""Objects that the library brings along and reacts to."""


class Stranger:
    """One node.

    Args:
        node: of the library, fresh.
        servo: the motor behind it, with the family's values after power-on.
        entries: of the family, by (index, subindex).
        period_s: of SYNC.
    """

    def __init__(self, node: Node, servo: Servo, entries: dict[tuple[int, int], Entry], period_s: float) -> None:
        self._node, self._servo, self._entries = node, servo, entries
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
        self._run()
        od, values = self._node.object_dictionary, self._servo.dictionary.values
        for pdo in self._node.tpdo:
            for index, sub in pdo.mapping if pdo.enable else ():
                od.write(index, sub, values[index << 8 | sub])


def build(robot: str, family: str, network: CANBusNetwork) -> Stranger:
    """The only drive of this robot file, as this family."""
    setup = load_robot(robot).to_setup()
    (joint,) = setup.joints
    joint = replace(joint, options={**joint.options, "personality": family})
    personality = personality_of(joint)
    assert personality is not None
    servo = servo_for(setup, joint, plant_for(setup, joint), network.send)
    servo.dictionary.reset()
    servo.power.boot()
    absent = personality.manner.absent
    entries = {
        (record.index, entry.key & 0xFF): entry
        for record in personality.records
        for entry in record.entries
        if entry.key not in absent
    }
    return Stranger(
        Node(network, joint.address, capabilities=MinimalNodeCapabilities), servo, entries, 1.0 / setup.cycle_hz
    )


def main() -> None:
    """Play it until the process is ended."""
    robot, family = sys.argv[1:]
    file = load_robot(robot).file
    interface, _, channel = file.bus.partition(":")
    loop = asyncio.new_event_loop()
    set_scheduler(AsyncScheduler(loop))
    network = CANBusNetwork(can.Bus(interface=interface, channel=channel, port=file.options["port"]), loop)
    stranger = build(robot, family, network)
    print("ready", flush=True)
    assert stranger
    loop.run_forever()


if __name__ == "__main__":
    main()
