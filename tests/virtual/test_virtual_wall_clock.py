"""The wall clock's drives move as lock-step's do: scheduling jitter of two processes does not become motion."""

import math
import random
import struct
from collections.abc import Callable

from frictid_drivers.virtual.rack import Rack
from frictid_drivers.virtual.rack_process import RackProcess

MS = 1_000_000
START_NS = 123_456_789_000
UNITS_PER_RAD = 131_072 * 100 / (2 * math.pi)


class Line:
    """A hub without processes: frames lie here until the drives serve, each with the time it was sent."""

    members = 1
    heard: Callable[[int, bytes, int], None]

    def __init__(self):
        self.waiting = []
        self.said = []

    def send(self, can_id, data):
        self.said.append((can_id, data))

    def wait(self, longest_s):
        raise AssertionError("the test keeps the time")

    def serve(self):
        waiting, self.waiting = self.waiting, []
        for can_id, data, stamp_ns in waiting:
            self.heard(can_id, data, stamp_ns)


def configured(rack, send):
    """One joint in CSP, commanded and reporting every millisecond."""

    def write(index, subindex, value, size):
        request = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, subindex)
        send(0x601, request + (value & 0xFFFFFFFF).to_bytes(4, "little"))

    for com, mapping, cob_id, entries in (
        (0x1400, 0x1600, 0x201, (0x60400010, 0x607A0020)),
        (0x1800, 0x1A00, 0x181, (0x60640020, 0x60770010)),
    ):
        write(com, 1, 1 << 31 | cob_id, 4)
        write(com, 2, 1, 1)
        for sub, entry in enumerate(entries, 1):
            write(mapping, sub, entry, 4)
        write(mapping, 0, len(entries), 1)
        write(com, 1, cob_id, 4)
    write(0x1006, 0, 1000, 4)
    write(0x6060, 0, 8, 1)
    send(0x000, b"\x01\x01")


def commands(cycles):
    for n in range(cycles):
        control = (6, 7, 0x0F)[min(n, 2)]
        swing = 0.0 if n < 3 else 0.1 * (1 - math.cos(2 * math.pi * (n - 3) / 300))
        yield struct.pack("<Hi", control, round(swing * UNITS_PER_RAD))


def lock_step(setup, cycles):
    rack, said = Rack(), []
    rack.install(setup)
    rack.transmit = lambda can_id, data: said.append((can_id, data))
    rack.power_on()
    configured(rack, rack.process)
    for command in commands(cycles):
        rack.advance(rack.now_ns + MS)
        rack.process(0x201, command)
        rack.process(0x080, b"")
    return [data for can_id, data in said if can_id == 0x181]


def wall_clock(setup, cycles, late):
    """``late(n)`` is by how much SYNC n is off its time; the drives look at their socket when they like."""
    rack, line = Rack(), Line()
    rack.install(setup, sync_gap_tenths=500)
    process = RackProcess(rack, line, now_ns=START_NS)
    rack.power_on()
    line.waiting = []
    configured(rack, lambda can_id, data: line.waiting.append((can_id, data, START_NS)))
    process.serve_until(START_NS)
    chance = random.Random(4)
    for n, command in enumerate(commands(cycles), 1):
        sent_ns = START_NS + n * MS + late(n)
        line.waiting += [(0x201, command, sent_ns - 20_000), (0x080, b"", sent_ns)]
        # Looks before and after, or is kept from looking for a few periods.
        if chance.random() < 0.7:
            process.serve_until(sent_ns + chance.randrange(10_000, 300_000))
    process.serve_until(START_NS + (cycles + 1) * MS)
    return [data for can_id, data in line.said if can_id == 0x181]


def test_jitter_of_both_processes_gives_the_same_bits(make_robot):
    setup = make_robot(joints=1)
    chance = random.Random(1)
    jitter = [0, *(chance.choice((0, 0, 0, 50_000, -100_000, 700_000, 1_900_000, 12_000_000)) for _ in range(500))]
    reference = lock_step(setup, 500)
    assert len(reference) == 500 and len(set(reference)) > 400
    assert wall_clock(setup, 500, lambda n: 0) == reference
    assert wall_clock(setup, 500, lambda n: jitter[n - 1]) == reference


def test_run_time_waits_for_a_host_that_pauses_but_not_long(make_robot):
    """Missed cycles: the set-points go on one by one, later; past the patience the joint is held meanwhile."""
    setup = make_robot(joints=1)
    reference = lock_step(setup, 400)
    for pause_ms in (3, 40, 140):
        delayed = wall_clock(setup, 400, lambda n, pause_ms=pause_ms: pause_ms * MS if n >= 200 else 0)
        assert (delayed == reference) == (pause_ms < 50)
