"""A drive that is a dictionary and a bus that is a list: frames in, frames out, nothing simulated.

``WireBus`` answers inside ``send``, as a lock-step bus does; ``ScriptedDrive`` knows just enough CANopen to be
configured and cycled, and does as it is told: refuse an object, read back another value, fall silent.
"""

from __future__ import annotations

import struct
from collections import deque
from typing import Any

import can

from frictid_hil.plan.setup import JointSetup, RobotSetup

OBJECTS = {
    # address: (format, value)
    (0x1000, 0): ("<I", 0x00020192),
    (0x1001, 0): ("<B", 0),
    (0x1005, 0): ("<I", 0x80),
    (0x1006, 0): ("<I", 0),
    (0x1008, 0): ("s", b"Scripted drive 402"),
    (0x100A, 0): ("s", b"7.1"),
    (0x1016, 0): ("<B", 1),
    (0x1016, 1): ("<I", 0),
    (0x1017, 0): ("<H", 0),
    (0x1018, 1): ("<I", 0x123),
    (0x1018, 2): ("<I", 0x456),
    (0x1018, 3): ("<I", 0x1),
    (0x1018, 4): ("<I", 99),
    (0x1019, 0): ("<B", 0),
    (0x6007, 0): ("<h", 0),
    (0x603F, 0): ("<H", 0),
    (0x6040, 0): ("<H", 0),
    (0x6041, 0): ("<H", 0x0250),
    (0x605A, 0): ("<h", 2),
    (0x6060, 0): ("<b", 0),
    (0x6061, 0): ("<b", 0),
    (0x6064, 0): ("<i", 0),
    (0x6065, 0): ("<I", 1000),
    (0x6066, 0): ("<H", 0),
    (0x606C, 0): ("<i", 0),
    (0x6071, 0): ("<h", 0),
    (0x6072, 0): ("<H", 3000),
    (0x6076, 0): ("<I", 1000),
    (0x6077, 0): ("<h", 0),
    (0x607A, 0): ("<i", 0),
    (0x607D, 1): ("<i", -(1 << 31)),
    (0x607D, 2): ("<i", (1 << 31) - 1),
    (0x6084, 0): ("<I", 100),
    (0x6085, 0): ("<I", 200),
    (0x608F, 1): ("<I", 4096),
    (0x608F, 2): ("<I", 1),
    (0x6091, 1): ("<I", 50),
    (0x6091, 2): ("<I", 1),
    (0x60A9, 0): ("<I", 0x00B44700),
    (0x60B2, 0): ("<h", 0),
    (0x60C2, 1): ("<B", 1),
    (0x60C2, 2): ("<b", -3),
    (0x60FF, 0): ("<i", 0),
    (0x6502, 0): ("<I", 0x380),
}
for _number in range(4):
    OBJECTS[0x1400 + _number, 1] = ("<I", 1 << 31 | 0x200 + 0x100 * _number)
    OBJECTS[0x1400 + _number, 2] = ("<B", 255)
    OBJECTS[0x1800 + _number, 1] = ("<I", 1 << 31 | 0x180 + 0x100 * _number)
    OBJECTS[0x1800 + _number, 2] = ("<B", 255)
    OBJECTS[0x1800 + _number, 6] = ("<B", 0)
    for _mapping in (0x1600 + _number, 0x1A00 + _number):
        OBJECTS[_mapping, 0] = ("<B", 0)
        for _sub in range(1, 9):
            OBJECTS[_mapping, _sub] = ("<I", 0)

READ_ONLY = {0x1000, 0x1001, 0x1008, 0x100A, 0x1018, 0x6041, 0x6064, 0x606C, 0x6077, 0x6502}

NEXT = {
    # statusword bits: {controlword: statusword bits}, the good road and the stops
    0x0250: {0x06: 0x0231},
    0x0231: {0x07: 0x0233, 0x00: 0x0250, 0x02: 0x0250},
    0x0233: {0x0F: 0x0237, 0x06: 0x0231, 0x00: 0x0250, 0x02: 0x0250},
    0x0237: {0x07: 0x0233, 0x06: 0x0231, 0x00: 0x0250, 0x02: 0x0217},
    0x0217: {0x00: 0x0250},
    0x0218: {},
}


class ScriptedDrive:
    """One node.

    Args:
        node: id.
        without: indices it does not have.
        refuses: SDO abort code by (index, sub) for downloads.
        reads_back: value that a download of (index, sub) turns into.
        silent: it answers nothing at all.
    """

    def __init__(self, node, *, without=(), refuses=None, reads_back=None, silent=False):
        self.node = node
        self.values = {key: value for key, (_, value) in OBJECTS.items() if key[0] not in without}
        for index in range(0x1800, 0x1804):
            if 0x1806 in without:  # stands for sub-index 6
                self.values.pop((index, 6), None)
        self.refuses = refuses or {}
        self.reads_back = reads_back or {}
        self.silent = silent
        self.operational = False
        self.mute = False
        self.resets = True
        self.shows_mode = True
        self.controlwords = []
        self.commands = []
        self.pending = []
        self.syncs = 0
        self.text: Any = b""

    def receive(self, can_id, data):
        if self.silent:
            return
        if can_id == 0x600 + self.node:
            yield 0x580 + self.node, self.sdo(data)
        elif can_id == 0 and data[1] in (0, self.node):
            self.operational = data[0] == 1
            self.syncs = 0
        elif can_id == 0x80 and self.operational:
            yield from self.sync(data)
        elif self.operational:
            for number in range(4):
                if self.values[0x1400 + number, 1] & 0x800007FF == can_id:
                    self.pending.append((number, bytes(data)))

    # -- SDO -----------------------------------------------------------------------------------------------------

    def sdo(self, request):
        command, index, sub = struct.unpack_from("<BHB", request)
        if command >> 5 == 3:  # next segment of a text
            piece, self.text = self.text[:7], self.text[7:]
            toggle = command & 0x10
            return bytes([toggle | (7 - len(piece)) << 1 | (not self.text)]) + piece.ljust(7, b"\0")
        key = (index, sub)
        if key not in self.values:
            return self.abort(index, sub, 0x06090011 if any(k[0] == index for k in self.values) else 0x06020000)
        form = OBJECTS[key][0]
        if command >> 5 == 2:
            if form == "s":
                self.text = self.values[key]
                return struct.pack("<BHBI", 0x41, index, sub, len(self.text))
            data = struct.pack(form, self.values[key])
            return struct.pack("<BHB", 0x43 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0")
        if index in READ_ONLY:
            return self.abort(index, sub, 0x06010002)
        if key in self.refuses:
            return self.abort(index, sub, self.refuses[key])
        value = struct.unpack_from(form, request, 4)[0]
        if index in range(0x1A00, 0x1A04) and sub == 0 and not self.values[index - 0x200, 1] >> 31:
            return self.abort(index, sub, 0x08000022)
        self.values[key] = self.reads_back.get(key, value)
        if key == (0x6060, 0) and self.shows_mode:
            self.values[0x6061, 0] = value
        if key == (0x6040, 0):
            self.follow(value)
        return struct.pack("<BHBI", 0x60, index, sub, 0)

    @staticmethod
    def abort(index, sub, code):
        return struct.pack("<BHBI", 0x80, index, sub, code)

    # -- PDO -----------------------------------------------------------------------------------------------------

    def entries(self, mapping):
        for sub in range(1, self.values[mapping, 0] + 1):
            word = self.values[mapping, sub]
            yield word >> 16, word >> 8 & 0xFF

    def sync(self, data):
        self.syncs += 1
        for number in range(4):
            if self.values[0x1800 + number, 1] >> 31 or self.mute:
                continue
            every, start = self.values[0x1800 + number, 2], self.values.get((0x1800 + number, 6), 0)
            offset = start if data and start else every
            if self.syncs >= offset and (self.syncs - offset) % every == 0:
                entries = list(self.entries(0x1A00 + number))
                payload = b"".join(struct.pack(OBJECTS[key][0], self.values[key]) for key in entries)
                yield self.values[0x1800 + number, 1] & 0x7FF, payload
        pending, self.pending = self.pending, []
        for number, payload in pending:
            offset = 0
            for key in self.entries(0x1600 + number):
                form = OBJECTS[key][0]
                self.values[key] = struct.unpack_from(form, payload, offset)[0]
                offset += struct.calcsize(form)
                if key == (0x6060, 0) and self.shows_mode:
                    self.values[0x6061, 0] = self.values[key]
            if number == 0:
                self.follow(self.values[0x6040, 0])
            self.commands.append((number, payload))

    def follow(self, controlword):
        before = self.controlwords[-1] if self.controlwords else 0
        self.controlwords.append(controlword)
        status = self.values[0x6041, 0]
        if status == 0x0218 and controlword & 0x80 and not before & 0x80 and self.resets:
            self.values[0x6041, 0] = 0x0250
            self.values[0x603F, 0] = 0
        else:
            self.values[0x6041, 0] = NEXT[status & 0xF7FF].get(controlword & ~0x10, status)
        if self.values[0x6041, 0] == 0x0237 and self.values[0x6060, 0] == 8:
            self.values[0x6064, 0] = self.values[0x607A, 0]


class WireBus(can.BusABC):
    """Every frame that the host sends reaches all drives; what they answer waits in a list."""

    def __init__(self, *drives):
        super().__init__(channel="wire")
        self.channel_info = "wire"
        self.drives = drives
        self.sent = []
        self.waiting = deque()
        self.fail = 0
        self.closed = False

    def send(self, msg, timeout=None):
        if self.fail:
            self.fail -= 1
            raise can.CanOperationError("No buffer space available")
        data = bytes(msg.data)
        self.sent.append((msg.arbitration_id, data))
        for drive in self.drives:
            for can_id, answer in drive.receive(msg.arbitration_id, data):
                self.put(can_id, answer)

    def put(self, can_id, data, **flags):
        self.waiting.append(can.Message(arbitration_id=can_id, data=data, is_extended_id=False, **flags))

    def _recv_internal(self, timeout):
        return (self.waiting.popleft() if self.waiting else None), False

    def shutdown(self):
        self.closed = True
        super().shutdown()


class HandClock:
    """Run time that a test turns by hand; drives' heartbeats come with it."""

    lock_step = True

    def __init__(self, bus, heartbeat_ns=100_000_000):
        self.bus = bus
        self.time_ns = 0
        self.heartbeat_ns = heartbeat_ns
        self.dead = set()

    def restart(self):
        self.time_ns = 0

    def now_ns(self):
        return self.time_ns

    def wait_until(self, deadline_ns):
        while self.time_ns < deadline_ns:
            self.time_ns = min(deadline_ns, self.time_ns - self.time_ns % 1_000_000 + 1_000_000)
            if self.heartbeat_ns and self.time_ns % self.heartbeat_ns == 0:
                for drive in self.bus.drives:
                    if drive.node not in self.dead and not drive.silent:
                        self.bus.put(0x700 + drive.node, b"\x05" if drive.operational else b"\x7f")


def robot(*nodes, options=None, joint_options=None, **changes):
    """Joints "0".. with a gear of 50 and 50 N m rated, one per node."""
    joint: dict[str, Any] = {
        "gear_ratio": 50.0,
        "direction": 1,
        "max_velocity_rad_s": 2.0,
        "max_torque_nm": 60.0,
        "rated_torque_nm": 50.0,
        "position_min_rad": -2.0,
        "position_max_rad": 2.0,
        "start_position_rad": 0.0,
        "locked_position_rad": 0.0,
        "options": joint_options or {},
    } | changes
    joints = tuple(JointSetup(name=str(at), address=node, **joint) for at, node in enumerate(nodes))
    return RobotSetup("scripted", "wire:test", 1000.0, joints, options or {})
