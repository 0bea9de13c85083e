"""The bus between processes: members hear each other, the interface is registered, slow readers do no harm."""

import contextlib
import itertools
import select
import threading
import time

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from frictid_drivers.virtual.rack_launcher import decode_setup, encode_setup
from frictid_drivers.virtual.rack_process import SyncTime
from frictid_drivers.virtual.socket_bus import EXTENDED, REMOTE, Hub, SocketBus, message_of, pack
from frictid_hil.protocol.driver import FD_FRAME

MS = 1_000_000


@pytest.fixture
def hub(runtime_folder):
    """A hub served by a thread; what it heard, and a way to speak."""
    hub, log = Hub(runtime_folder / "desk.sock"), []
    hub.heard = lambda can_id, data, stamp_ns: log.append((can_id, data))
    stop = threading.Event()

    def serve():
        while not stop.is_set():
            hub.wait(0.01)
            hub.serve()

    thread = threading.Thread(target=serve)
    thread.start()
    yield hub, log
    stop.set()
    thread.join()
    hub.close()


def connected(hub, count):
    buses = [can.Bus(interface="frictid", channel="desk") for _ in range(count)]
    deadline_s = time.monotonic() + 2
    while hub.members < count and time.monotonic() < deadline_s:
        time.sleep(0.001)
    return buses


def heard(log):
    """What the hub heard; its members have a frame a moment before it has."""
    deadline_s = time.monotonic() + 2
    while not log and time.monotonic() < deadline_s:
        time.sleep(0.001)
    return log


def test_registered_interface_joins_members(hub):
    hub, log = hub
    first, second, third = connected(hub, 3)
    first.send(can.Message(arbitration_id=0x123, data=b"\1\2\3", is_extended_id=False))
    for other in (second, third):
        message = other.recv(2)
        assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (0x123, b"\1\2\3", False)
        assert message.timestamp == pytest.approx(time.time(), abs=5)
    assert first.recv(0.02) is None, "nobody hears himself"
    assert heard(log) == [(0x123, b"\1\2\3")]
    hub.send(0x181, b"\7" * 8)
    assert all(bytes(bus.recv(2).data) == b"\7" * 8 for bus in (first, second, third))
    assert select.select([first.fileno()], [], [], 0)[0] == []
    for bus in (first, second, third):
        bus.shutdown()


@given(
    can_id=st.integers(0, 0x1FFFFFFF),
    data=st.binary(max_size=8) | st.binary(min_size=64, max_size=64),
    extended=st.booleans(),
    fd=st.booleans(),
    stamp=st.integers(0, 1 << 62),
)
def test_every_frame_survives_packing(can_id, data, extended, fd, stamp):
    can_id = can_id if extended else can_id & 0x7FF
    data = data if fd else data[:8]
    message = message_of(pack(can_id | (EXTENDED if extended else 0), data, stamp, fd=fd))
    assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (can_id, data, extended)
    assert (message.is_fd, message.bitrate_switch) == (fd, fd)
    assert message_of(pack(can_id & 0x7FF | REMOTE, b"", stamp)).is_remote_frame


def test_can_fd_frames_pass_between_members_and_drives(hub):
    wire, log = hub
    first, second = connected(wire, 2)
    assert first.protocol is can.CanProtocol.CAN_FD
    first.send(
        can.Message(arbitration_id=0x201, data=bytes(range(16)), is_extended_id=False, is_fd=True, bitrate_switch=True)
    )
    message = second.recv(2)
    assert (message.arbitration_id, bytes(message.data), message.is_fd) == (0x201, bytes(range(16)), True)
    assert heard(log) == [(0x201 | FD_FRAME, bytes(range(16)))]
    wire.send(0x181 | FD_FRAME, b"\7" * 12)
    for bus in (first, second):
        message = bus.recv(2)
        assert (message.arbitration_id, message.is_fd, message.is_error_frame, len(message.data)) == (
            0x181,
            True,
            False,
            12,
        )
        bus.shutdown()


def test_absent_bus_and_lost_bus_are_errors(runtime_folder):
    with pytest.raises(can.CanInitializationError, match="no simulated bus"):
        SocketBus("nobody")
    hub = Hub(runtime_folder / "gone.sock")
    bus = SocketBus("gone")
    hub.serve()
    assert [config["channel"] for config in SocketBus._detect_available_configs()] == ["gone"]
    hub.close()
    with pytest.raises(can.CanOperationError, match="gone"):
        bus.recv(1)
    with pytest.raises(can.CanOperationError, match="gone"):
        bus.send(can.Message(arbitration_id=1, is_extended_id=False))
    bus.shutdown()


def test_a_hub_that_ends_late_leaves_its_successor_alone(runtime_folder):
    old = Hub(runtime_folder / "heir.sock")
    new = Hub(runtime_folder / "heir.sock")
    old.close()
    bus = SocketBus("heir")
    bus.shutdown()
    new.close()
    assert not (runtime_folder / "heir.sock").exists()


@pytest.mark.slow
def test_slow_reader_loses_frames_and_holds_up_nobody(hub):
    hub, _ = hub
    slow, quick = connected(hub, 2)
    began_s = time.monotonic()
    for n in range(30_000):
        hub.send(0x181, n.to_bytes(4, "little"))
        if n % 100 == 0:
            with contextlib.suppress(can.CanError):
                while quick.recv(0) is not None:
                    pass
    assert time.monotonic() - began_s < 10
    received = 0
    while slow.recv(0) is not None:
        received += 1
    assert 0 < received < 30_000
    slow.shutdown()
    quick.shutdown()


class TestSyncTime:
    def test_every_sync_is_one_period_whenever_it_comes(self):
        clock = SyncTime(MS)
        jitter = [0, 300_000, -200_000, 900_000, -450_000, 12 * MS, 11 * MS + 900_000, 12 * MS] * 20
        times = [clock.sync_ns(n * MS + late) for n, late in enumerate(jitter)]
        assert [after - before for before, after in itertools.pairwise(times)] == [MS] * (len(times) - 1)

    def test_time_waits_for_a_late_sync_but_not_for_ever(self):
        clock = SyncTime(MS)
        assert clock.sync_ns(10 * MS) == 10 * MS
        assert [clock.time_ns(t * MS) for t in (10, 30, 60, 61, 200)] == [t * MS for t in (10, 10, 10, 11, 150)]
        assert clock.sync_ns(200 * MS) == 150 * MS
        assert clock.sync_ns(201 * MS) == 151 * MS

    def test_a_burst_does_not_run_ahead_of_the_wall_clock(self):
        clock = SyncTime(MS)
        assert [clock.sync_ns(5 * MS) // MS for _ in range(6)] == [5, 6, 7, 7, 7, 7]
        assert clock.sync_ns(8 * MS) == 8 * MS

    def test_without_a_period_the_wall_clock_rules(self):
        clock = SyncTime()
        assert [clock.sync_ns(t) for t in (7, 9, 1000)] == [7, 9, 1000]

    @given(st.lists(st.integers(0, 120 * MS), max_size=60), st.booleans())
    def test_never_backwards(self, gaps, mixed):
        clock, wall, highest = SyncTime(MS), 0, 0
        for n, gap in enumerate(gaps):
            wall += gap
            now = clock.time_ns(wall) if mixed and n % 2 else clock.sync_ns(wall)
            assert now >= highest and now <= wall + 2 * MS
            highest = now


def test_robot_crosses_the_process_border_unchanged(make_robot):
    setup = make_robot(options={"faults": [{"kind": "reset", "at_s": 0.1}]}, seed=7, realtime=True)
    assert decode_setup(encode_setup(setup)) == setup
