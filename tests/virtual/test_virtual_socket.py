"""The bus between processes: members hear each other, the interface is registered, slow readers do no harm."""

import contextlib
import select
import threading
import time

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from frictid_drivers.virtual.rack_launcher import decode_setup, encode_setup
from frictid_drivers.virtual.rack_process import SyncGrid
from frictid_drivers.virtual.socket_bus import EXTENDED, REMOTE, Hub, SocketBus, message_of, pack

MS = 1_000_000


@pytest.fixture
def hub(runtime_folder):
    """A hub served by a thread; what it heard, and a way to speak."""
    hub = Hub(runtime_folder / "desk.sock")
    hub.log = []
    hub.heard = lambda can_id, data, stamp_ns: hub.log.append((can_id, data))
    stop = threading.Event()

    def serve():
        while not stop.is_set():
            hub.wait(0.01)
            hub.serve()

    thread = threading.Thread(target=serve)
    thread.start()
    yield hub
    stop.set()
    thread.join()
    hub.close()


def connected(hub, count):
    buses = [can.Bus(interface="frictid", channel="desk") for _ in range(count)]
    deadline_s = time.monotonic() + 2
    while hub.members < count and time.monotonic() < deadline_s:
        time.sleep(0.001)
    return buses


def test_registered_interface_joins_members(hub):
    first, second, third = connected(hub, 3)
    first.send(can.Message(arbitration_id=0x123, data=b"\1\2\3", is_extended_id=False))
    for other in (second, third):
        message = other.recv(2)
        assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (0x123, b"\1\2\3", False)
        assert message.timestamp == pytest.approx(time.time(), abs=5)
    assert first.recv(0.02) is None, "nobody hears himself"
    assert hub.log == [(0x123, b"\1\2\3")]
    hub.send(0x181, b"\7" * 8)
    assert all(bytes(bus.recv(2).data) == b"\7" * 8 for bus in (first, second, third))
    assert select.select([first.fileno()], [], [], 0)[0] == []
    for bus in (first, second, third):
        bus.shutdown()


@given(
    can_id=st.integers(0, 0x1FFFFFFF), data=st.binary(max_size=8), extended=st.booleans(), stamp=st.integers(0, 1 << 62)
)
def test_every_frame_survives_packing(can_id, data, extended, stamp):
    can_id = can_id if extended else can_id & 0x7FF
    message = message_of(pack(can_id | (EXTENDED if extended else 0), data, stamp))
    assert (message.arbitration_id, bytes(message.data), message.is_extended_id) == (can_id, data, extended)
    assert message_of(pack(can_id & 0x7FF | REMOTE, b"", stamp)).is_remote_frame


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


def test_slow_reader_loses_frames_and_holds_up_nobody(hub):
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


class TestSyncGrid:
    def test_jitter_does_not_reach_run_time(self):
        grid = SyncGrid(MS)
        jitter = [0, 300_000, -100_000, 600_000, -100_000, 100_000] * 200
        times = [grid.sync_ns(n * MS + late) for n, late in enumerate(jitter)]
        assert times == [n * MS for n in range(len(jitter))]

    def test_a_late_first_sync_is_forgotten_soon(self):
        grid = SyncGrid(MS)
        times = [grid.sync_ns(n * MS + (500_000 if n == 0 else 0)) for n in range(60)]
        assert all(after - before == MS for before, after in zip(times[20:], times[21:], strict=False))
        assert grid.sync_ns(60 * MS + 700_000) == times[-1] + MS, "late ones are tolerated as from a good start"

    def test_time_stands_on_the_grid_between_syncs(self):
        grid = SyncGrid(MS)
        grid.sync_ns(0)
        assert [grid.time_ns(t) for t in (100, MS, MS + 790_000, MS + 810_000, 3 * MS)] == [0, 0, 0, MS, 2 * MS]
        assert grid.sync_ns(3 * MS + 750_000) == 3 * MS, "late, but in time for its own point"

    def test_missed_syncs_are_skipped_not_squeezed(self):
        grid = SyncGrid(MS)
        assert [grid.sync_ns(t * MS) for t in (0, 1, 4, 5)] == [0, MS, 4 * MS, 5 * MS]

    def test_two_syncs_in_one_period_are_one_moment(self):
        grid = SyncGrid(MS)
        assert [grid.sync_ns(t) for t in (0, MS + 900_000, 2 * MS)] == [0, 2 * MS, 2 * MS]

    def test_pause_starts_a_new_grid(self):
        grid = SyncGrid(MS)
        grid.sync_ns(0)
        assert grid.sync_ns(500 * MS + 400_000) == 500 * MS + 400_000
        assert grid.sync_ns(501 * MS + 300_000) == 501 * MS + 400_000

    def test_slow_drift_is_followed(self):
        grid = SyncGrid(MS)
        for n in range(20_000):
            time_ns = grid.sync_ns(round(n * MS * 1.0002))
        assert time_ns == 19_999 * MS

    @given(st.lists(st.integers(0, 40 * MS), max_size=60), st.booleans())
    def test_never_backwards_by_more_than_half_a_period(self, gaps, mixed):
        grid, wall, highest = SyncGrid(MS), 0, 0
        for n, gap in enumerate(gaps):
            wall += gap
            now = grid.time_ns(wall) if mixed and n % 2 else grid.sync_ns(wall)
            assert now >= highest - MS
            highest = max(highest, now)


def test_robot_crosses_the_process_border_unchanged(make_robot):
    setup = make_robot(options={"faults": [{"kind": "reset", "at_s": 0.1}]}, seed=7, realtime=True)
    assert decode_setup(encode_setup(setup)) == setup
