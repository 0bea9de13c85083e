"""A drive whose CANopen is not ours: `durand` speaks SDO, NMT, PDO, SYNC and heartbeat in front of the simulated joint.

    python benchmarks/stranger_node.py ROBOT FAMILY

The object list, access, ranges and defaults are the family's (`personalities.yaml`). The node is strict beyond what the
library is: a PDO is mapped only while it is invalid, and only with what is mappable; values are refused as the family
refuses them. Motor and state machine are the simulated servo's (``stranger_motor``).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import can
from durand import Node
from durand.datatypes import DatatypeEnum
from durand.network import NetworkABC
from durand.node import MinimalNodeCapabilities
from durand.object_dictionary import Record, Variable
from durand.scheduler import VirtualScheduler, set_scheduler
from socketcand_gateway import Gateway
from stranger_motor import Motor
from stranger_wire import DONE

from frictid_drivers.virtual.objects import DataType, Entry
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
        motor: behind it, with the family's values after power-on.
        scheduler: the library's time.
    """

    def __init__(self, node: Node, motor: Motor, scheduler: VirtualScheduler) -> None:
        self._node, self._motor, self._scheduler = node, motor, scheduler
        od = node.object_dictionary
        for (index, sub), entry in motor.entries.items():
            counts = sub == 0 and (index, 1) in motor.entries
            if index not in OF_THE_STACK and not 0x1400 <= index < 0x1C00 and not counts:
                self._add(index, sub, entry)
        for base in (0x1600, 0x1A00):
            for number in range(4):
                for sub in range(9):
                    guard = partial(self._mapping, base + number, sub)
                    od.validate_callbacks[base + number, sub].add(guard)
        # Before every PDO of this SYNC, which are registered when they become valid.
        node.sync.callbacks.add(self._on_sync)

    def _add(self, index: int, sub: int, entry: Entry) -> None:
        od, values = self._node.object_dictionary, self._motor.values
        low, high = (None, None) if entry.kind is DataType.STRING else entry.limits
        kind = DatatypeEnum(int(entry.kind))
        variable = Variable(kind, entry.access, minimum=low, maximum=high, name=entry.name)
        if (index, 1) in self._motor.entries:
            if index not in od or not isinstance(od[index], Record):
                od[index] = Record(entry.name)
            od[index][sub] = variable
        else:
            od[index] = variable

        def read() -> Any:
            self._motor.settle()
            value = values[entry.key]
            return value.encode() if isinstance(value, str) else value

        od.set_read_callback(index, sub, read)
        if entry.access in ("rw", "wo"):
            od.validate_callbacks[index, sub].add(partial(self._motor.write, entry))

    def _mapping(self, index: int, sub: int, value: int) -> None:
        """Refuse what a strict drive refuses; the library asks before it stores."""
        pdo = self._node.object_dictionary.read(index - 0x200, 1)
        if not pdo & NOT_VALID:
            raise ValueError("mapped while valid")
        if sub:
            entry = self._motor.entries[value >> 16, value >> 8 & 0xFF]
            if not (entry.receive if index < 0x1A00 else entry.transmit):
                raise ValueError("not mappable")

    def _on_sync(self) -> None:
        self._scheduler.run(self._motor.period_s)
        self._motor.advance()
        od, values = self._node.object_dictionary, self._motor.values
        for pdo in self._node.tpdo:
            for index, sub in pdo.mapping if pdo.enable else ():
                od.write(index, sub, values[index << 8 | sub])


def build(robot: str, family: str, line: Line) -> Stranger:
    """The only drive of this robot file, as this family."""
    motor = Motor(robot, family, line.send)
    scheduler = VirtualScheduler()
    set_scheduler(scheduler)
    return Stranger(Node(line, motor.node, capabilities=MinimalNodeCapabilities), motor, scheduler)


def main() -> None:
    """Play it until the process is ended."""
    robot, family = sys.argv[1:]
    file = load_robot(robot).file
    interface, _, channel = file.bus.partition(":")
    group = {name: file.options[name] for name in ("port",) if name in file.options}
    gateway = interface == "socketcand"
    line = Line(Gateway(group["port"]) if gateway else can.Bus(interface=interface, channel=channel, **group))
    stranger = build(robot, family, line)
    print("ready", flush=True)
    assert stranger
    line.serve()


if __name__ == "__main__":
    main()
