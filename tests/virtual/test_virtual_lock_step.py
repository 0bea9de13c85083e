"""Lock-step: replies there when send returns, the same bits from run to run, and safe whatever arrives."""

import hashlib
import math
import struct
from typing import Any

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_drivers.virtual.lock_step import LockStepBus, LockStepClock
from frictid_drivers.virtual.objects import OBJECTS, SIZE_BYTES, DataType
from frictid_drivers.virtual.power_stage import PowerState
from frictid_drivers.virtual.rack import Rack

MS = 1_000_000
UNITS_PER_RAD = 131_072 * 100 / (2 * math.pi)


class Host:
    """The least of a host: raw frames on a lock-step bus."""

    def __init__(self, setup):
        self.setup = setup
        self.rack = Rack()
        self.rack.install(setup)
        self.bus = LockStepBus(self.rack, setup.name)
        self.clock = LockStepClock(self.rack)
        self.rack.power_on()
        self.log = hashlib.sha256()
        self.received = []
        self.drain()

    def close(self):
        self.bus.shutdown()

    def drain(self):
        self.received = []
        while (message := self.bus.recv(0)) is not None:
            self.received.append((message.arbitration_id, bytes(message.data)))
            self.log.update(struct.pack("<dI", message.timestamp, message.arbitration_id) + bytes(message.data))
        return self.received

    def send(self, can_id, data):
        self.bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
        return self.drain()

    def write(self, node, index, subindex, value, size):
        request = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, subindex)
        ((_, reply),) = self.send(0x600 + node, request + (value & 0xFFFFFFFF).to_bytes(4, "little"))
        assert reply[0] == 0x60, f"{index:04X}:{subindex:02X} {reply.hex()}"

    def map_pdo(self, node, index, cob_id, entries, kind):
        mapping = index + 0x200
        for step in ((index, 1, 1 << 31 | cob_id + node, 4), (index, 2, kind, 1), (mapping, 0, 0, 1)):
            self.write(node, *step)
        for sub, entry in enumerate(entries, 1):
            self.write(node, mapping, sub, entry, 4)
        self.write(node, mapping, 0, len(entries), 1)
        self.write(node, index, 1, cob_id + node, 4)

    def start(self, mode=8):
        """Every joint active: controlword and target in, statusword, position and torque out; then enabled."""
        self.mode = mode
        target = {8: 0x607A0020, 10: 0x60710010}[mode]
        for joint in self.setup.joints:
            node = joint.address
            self.write(node, 0x60A9, 0, 0xFDB44700, 4)
            self.write(node, 0x6085, 0, 100_000, 4)  # in the units just set: 10 rad/s2
            self.map_pdo(node, 0x1400, 0x200, [0x60400010, target], 1)
            self.map_pdo(node, 0x1800, 0x180, [0x60410010, 0x60640020, 0x60770010], 1)
            self.write(node, 0x1016, 1, 0x7F << 16 | 150, 4)
            self.write(node, 0x6007, 0, 3, 2)
            self.write(node, 0x605A, 0, 6, 2)
            self.write(node, 0x6060, 0, mode, 1)
        self.send(0x000, b"\x01\x00")
        self.at = {}
        for word in (6, 6, 7, 0x0F):
            self.cycle(word, {})

    def cycle(self, control, targets, *, heartbeat=True, sync=True):
        """One millisecond: commands, SYNC, reports."""
        for joint in self.setup.joints:
            node = joint.address
            if self.mode == 8:
                command = struct.pack("<Hi", control, targets.get(node, self.at.get(node, 0)))
            else:
                command = struct.pack("<Hh", control, targets.get(node, 0))
            self.send(0x200 + node, command)
        if sync:
            for can_id, data in self.send(0x080, b""):
                if can_id & 0x780 == 0x180:
                    status, position, torque = struct.unpack("<HiH", data)
                    self.at.setdefault(can_id & 0x7F, position)
                    self.last = status, position, torque
        if heartbeat:
            self.send(0x77F, b"\x05")
        self.clock.wait_until(self.clock.now_ns() + MS)
        self.drain()


@pytest.fixture(scope="module")
def make_host(make_robot):
    hosts = []

    def make(name="bench", joints=2):
        hosts.append(Host(make_robot(joints=joints, name=name)))
        return hosts[-1]

    yield make
    for host in hosts:
        host.close()


def sweep(host, cycles=400):
    start = dict(host.at)
    for n in range(cycles):
        swing = round(0.05 * UNITS_PER_RAD * (1 - math.cos(2 * math.pi * n / 1000)))
        host.cycle(0x0F, {1: start[1] + swing})
    return host


def test_replies_are_there_when_send_returns(make_host):
    host = make_host()
    host.bus.send(can.Message(arbitration_id=0x601, data=b"\x40\0\x10\0\0\0\0\0", is_extended_id=False))
    assert bytes(host.bus.recv(0).data).hex() == "4300100092010200"
    assert host.bus.recv(0) is None


def test_joint_follows_and_reports(make_host):
    host = make_host()
    host.start()
    sweep(host, 501)
    plant = host.rack.servos["0"].axis._plant
    assert plant.position_rad == pytest.approx(0.1, abs=1e-3), "half a period after the start: the far end"
    assert host.rack.servos["1"].state is PowerState.ENABLED


def test_bit_identical_from_run_to_run(make_host):
    digests = set()
    for _ in range(2):
        host = make_host()
        host.start()
        digests.add(sweep(host).log.hexdigest())
        host.close()
    assert len(digests) == 1


def test_seed_changes_noise_only(make_robot):
    reports = []
    for seed in (0, 1):
        host = Host(make_robot(seed=seed))
        host.start()
        sweep(host, 50)
        reports.append(host.last)
        host.close()
    assert reports[0][1] == reports[1][1] and reports[0][2] != reports[1][2]


def test_held_joints_do_not_depend_on_when_they_are_looked_at(make_robot):
    """Physics is lazy: a joint that stands commanded still must not care how often somebody asks."""
    positions = []
    for every in (1, 10):
        host = Host(make_robot())
        host.start()
        axis = host.rack.servos["1"].axis
        plant: Any = axis._plant
        for n in range(200):
            host.clock.wait_until(host.clock.now_ns() + MS)
            if n % every == every - 1:
                axis.catch_up(host.rack.now_ns)
        positions.append(plant.position_rad)
        host.close()
    assert positions[0] == pytest.approx(positions[1], abs=1e-12)


def test_host_silence_stops_a_moving_joint(make_host):
    """Torque mode: heartbeat and SYNC end, the joint is brought to rest by its own watchdog."""
    host = make_host("torque")
    host.start(mode=10)
    for _ in range(100):
        host.cycle(0x0F, {1: 400})
    servo = host.rack.servos["0"]
    assert servo.axis._plant.velocity_rad_s > 0.3
    host.clock.wait_until(host.clock.now_ns() + 148 * MS)
    assert servo.state is PowerState.ENABLED and servo.axis._plant.velocity_rad_s > 0.5
    host.clock.wait_until(host.clock.now_ns() + 500 * MS)
    assert servo.state is PowerState.QUICK_STOP_ACTIVE
    assert abs(servo.axis._plant.velocity_rad_s) < 0.005


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(
    frames=st.lists(
        st.tuples(
            st.one_of(st.integers(0, 0x7FF), st.sampled_from([0x000, 0x080, 0x181, 0x201, 0x601, 0x602, 0x77F])),
            st.binary(max_size=8),
            st.integers(0, 30),
        ),
        max_size=40,
    )
)
def test_no_frame_breaks_a_drive_or_leaves_it_powered_without_its_watchdog(frames):
    host = ENABLED_HOST[0]
    host.fresh()
    for can_id, data, wait_ms in frames:
        host.send(can_id, data)
        host.clock.wait_until(host.clock.now_ns() + wait_ms * MS)
    host.clock.wait_until(host.clock.now_ns() + 3000 * MS)
    for servo in host.rack.servos.values():
        # Only an SDO of the garbage itself may have told the drive not to mind its host.
        number = servo.dictionary.number
        minds = number(0x101601) == 0x7F << 16 | 150 and number(0x600700) != 0
        assert not (minds and servo.state is PowerState.ENABLED)


NUMBERS = [
    entry
    for record in OBJECTS
    for entry in record.entries
    if entry.access == "rw" and entry.kind is not DataType.STRING
]
EDGES = st.sampled_from([0, 1, 2, 7, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF])
MAPPINGS = st.sampled_from([0x60400010, 0x60410010, 0x60640020, 0x607A0020, 0x60600008, 0x00050008, 0x60FE0120])


@pytest.mark.slow
@settings(max_examples=80, deadline=None)
@given(
    writes=st.lists(
        st.tuples(st.sampled_from(NUMBERS), st.one_of(EDGES, MAPPINGS, st.integers(0, 0xFFFFFFFF)), st.integers(0, 12)),
        max_size=40,
    )
)
def test_any_value_in_any_object_is_taken_or_refused(writes):
    """Every download is answered, what was taken is read back, and time and SYNC go on."""
    host = ENABLED_HOST[0]
    host.fresh()
    for entry, value, wait_ms in writes:
        index, subindex, size = entry.key >> 8, entry.key & 0xFF, SIZE_BYTES[entry.kind]
        value &= (1 << 8 * size) - 1
        header = struct.pack("<BHB", 0x23 | (4 - size) << 2, index, subindex)
        replies = [data for can_id, data in host.send(0x601, header + value.to_bytes(4, "little")) if can_id == 0x581]
        assert len(replies) == 1 and replies[0][0] in (0x60, 0x80)
        if replies[0][0] == 0x60 and index not in (0x1010, 0x1011, 0x6040):
            answers = dict(host.send(0x601, b"\x40" + header[1:] + bytes(4)))
            reply = answers[0x581]
            assert int.from_bytes(reply[4 : 4 + size], "little") == value
        host.send(0x080, b"")
        host.send(0x77F, b"\x05")
        host.clock.wait_until(host.clock.now_ns() + wait_ms * MS)


class FuzzHost(Host):
    """Two drives, enabled and watched, brought back to that before every example."""

    def fresh(self):
        self.rack.now_ns += MS
        for node in (1, 2):
            self.send(0x600 + node, bytes.fromhex("23111001") + b"load")
        self.send(0x000, b"\x81\x00")
        self.at = {}
        self.start()
        assert all(servo.state is PowerState.ENABLED for servo in self.rack.servos.values())


ENABLED_HOST = []


@pytest.fixture(autouse=True, scope="module")
def fuzz_host(make_robot):
    ENABLED_HOST.append(FuzzHost(make_robot(name="fuzz")))
    yield
    ENABLED_HOST.pop().close()
