"""Faults by schedule: read from a robot file, the same every time, on the wire and in the drives."""

import json

import can
import pytest

from frictid_drivers.virtual.faults import Fault, faults_of, missing_objects, read_faults
from frictid_drivers.virtual.faulty_bus import FaultyBus
from frictid_drivers.virtual.faulty_rack import FaultyRack
from frictid_drivers.virtual.lock_step import LockStepBus
from frictid_drivers.virtual.rack import Rack
from frictid_drivers.virtual.wire_faults import WireFaults
from frictid_hil.errors import InvalidFields, UsageError

MS = 1_000_000
NODES = {"0": 1, "1": 2}
TPDO, OTHER = 0x181, 0x182


def passed(kind, frames=6, **fields):
    """Indices of the frames that come out, with the time each is due, for frames sent every millisecond."""
    line = WireFaults([Fault(kind, at_s=0.002, cob_ids=frozenset({TPDO}), **fields)])
    return [
        (due // MS, data[0]) for n in range(frames) for due, _, data in line.through(n * MS, n * MS, TPDO, bytes([n]))
    ]  # fmt: skip


def test_what_each_kind_does_to_frames():
    clean = [(n, n) for n in range(6)]
    assert passed("drop", count=2) == [(0, 0), (1, 1), (4, 4), (5, 5)]
    assert passed("drop", for_s=0.001) == [(0, 0), (1, 1), (3, 3), (4, 4), (5, 5)]
    assert passed("delay", count=1, delay_s=0.01) == [(0, 0), (1, 1), (12, 2), (3, 3), (4, 4), (5, 5)]
    assert passed("duplicate", count=1) == [*clean[:3], (2, 2), *clean[3:]]
    assert passed("reorder", count=1) == [(0, 0), (1, 1), (3, 3), (3, 2), (4, 4), (5, 5)]
    corrupted = passed("corrupt", count=2)
    assert corrupted[:2] == clean[:2] and corrupted[4:] == clean[4:]
    assert all(bin(was[1] ^ is_[1]).count("1") == 1 for was, is_ in zip(clean[2:4], corrupted[2:4], strict=True))


def test_other_frames_pass_untouched():
    line = WireFaults([Fault("drop", cob_ids=frozenset({TPDO}))])
    assert line.through(0, 0, OTHER, b"x") == [(0, OTHER, b"x")]


def test_reading_a_robot_file():
    rows = [
        {"kind": "drop", "frames": "tpdo1", "joint": "1", "at_s": 2, "count": 3},
        {"kind": "delay", "frames": "sync", "delay_s": 0.004},
        {"kind": "missing", "index": 0x1016},
    ]
    drop, delay, missing = read_faults(rows, NODES)
    assert drop.cob_ids == {0x182} and drop.at_s == 2.0 and drop.count == 3
    assert delay.cob_ids == {0x080}
    assert missing_objects([missing]) == {"0": {0x1016}, "1": {0x1016}}


@pytest.mark.parametrize(
    ("rows", "path"),
    [
        ("drop", ("options", "faults")),
        ([{"kind": "explode"}], ("options", "faults", 0, "kind")),
        ([{"kind": "drop"}], ("options", "faults", 0, "frames")),
        ([{"kind": "reset"}, {"kind": "reset", "joint": "9"}], ("options", "faults", 1, "joint")),
        ([{"kind": "reset", "at": 3}], ("options", "faults", 0, "at")),
        ([{"kind": "occupied"}], ("options", "faults", 0, "level")),
        ([{"kind": "reset", "at_s": -1}], ("options", "faults", 0, "at_s")),
        ([7], ("options", "faults", 0)),
    ],
)
def test_mistakes_are_named_by_their_place(rows, path):
    with pytest.raises(InvalidFields) as error:
        read_faults(rows, NODES)
    assert path in [problem.path for problem in error.value.problems]


def test_environment_adds_to_the_file(make_robot, monkeypatch):
    setup = make_robot(options={"faults": [{"kind": "reset"}]})
    monkeypatch.setenv("FRICTID_VIRTUAL_FAULTS", json.dumps([{"kind": "mute"}]))
    assert [fault.kind for fault in faults_of(setup)] == ["reset", "mute"]
    monkeypatch.setenv("FRICTID_VIRTUAL_FAULTS", "nonsense")
    with pytest.raises(UsageError, match="JSON"):
        faults_of(setup)


class Bench:
    def __init__(self, setup, faults):
        self.rack = Rack()
        self.rack.install(setup, missing=missing_objects(faults))
        self.drives = FaultyRack(self.rack, faults)
        self.heard = []
        self.drives.transmit = lambda can_id, data: self.heard.append((self.drives.now_ns // MS, can_id, data.hex()))
        self.drives.power_on()

    def run(self, milliseconds, sync=True):
        self.heard.clear()
        for _ in range(milliseconds):
            if sync:
                self.drives.process(0x080, b"")
            self.drives.advance(self.drives.now_ns + MS)
        return list(self.heard)

    def state(self, joint):
        return self.rack.servos[joint].state.value


@pytest.fixture
def make_bench(make_robot):
    return lambda *faults: Bench(make_robot(), faults)


def test_time_counts_from_the_first_sync(make_bench):
    bench = make_bench(Fault("fault", at_s=0.005, joints=("0",), code=0x7305))
    bench.run(50, sync=False)
    assert bench.state("0") == 0x40
    heard = bench.run(10)
    assert (55, 0x081, "0573210000000000") in heard
    assert bench.state("0") & 0x4F == 0x08 and bench.state("1") == 0x40


def test_drive_that_resets_says_boot_up(make_bench):
    bench = make_bench(Fault("reset", at_s=0.003, joints=("1",)))
    assert bench.run(10) == [(3, 0x702, "00")]


def test_mute_node_neither_hears_nor_speaks_for_a_while(make_bench):
    bench = make_bench(Fault("mute", at_s=0.002, for_s=0.004, joints=("0",)))
    said = []
    for _ in range(8):
        bench.run(1)
        for node in (1, 2):
            bench.drives.process(0x600 + node, bytes.fromhex("4000100000000000"))
        said.append([can_id & 0x7F for _, can_id, _ in bench.heard])
    assert said == [[1, 2]] + [[2]] * 4 + [[1, 2]] * 3


def test_late_frames_arrive_in_run_time(make_bench):
    bench = make_bench(Fault("delay", cob_ids=frozenset({0x601}), delay_s=0.0025))
    bench.run(1)
    bench.heard.clear()
    bench.drives.process(0x601, bytes.fromhex("4000100000000000"))
    assert bench.heard == []
    assert bench.run(5) == [(3, 0x581, "4300100092010200")]


def test_switches_of_a_drive(make_bench):
    bench = make_bench(
        Fault("interlock_open", at_s=0.001, for_s=0.002, joints=("0",)),
        Fault("stuck_encoder", at_s=0.001, joints=("0",)),
        Fault("emcy", at_s=0.001, joints=("0",), code=0x4210),
        Fault("blocked", at_s=0.001, joints=("0",)),
        Fault("missing", joints=("1",), index=0x1016),
    )
    servo = bench.rack.servos["0"]
    assert servo.power.interlock_closed
    assert (1, 0x081, "1042090000000000") in bench.run(2)
    assert not servo.power.interlock_closed and servo.axis.encoder_stuck
    bench.run(2)
    assert servo.power.interlock_closed
    bench.heard.clear()
    bench.drives.process(0x602, bytes.fromhex("4016100000000000"))
    assert bench.heard[0][2] == "8016100000000206"


def test_clocks_that_drift_apart(make_bench):
    bench = make_bench(Fault("drift", factor=1.01))
    bench.run(100)
    assert bench.drives.now_ns == pytest.approx(100 * MS, abs=MS)
    assert bench.rack.now_ns == pytest.approx(101 * MS, abs=MS)


def test_bad_cable_in_front_of_any_bus(make_robot):
    rack = Rack()
    rack.install(make_robot())
    now_ns = [0]
    faults = [
        Fault("drop", cob_ids=frozenset({0x581}), count=1),
        Fault("delay", cob_ids=frozenset({0x582}), count=1, delay_s=0.01),
        Fault("duplicate", cob_ids=frozenset({0x602}), at_s=0.05, count=1),
    ]
    with FaultyBus(LockStepBus(rack, "bad-cable"), faults, now_ns=lambda: now_ns[0]) as bus:
        rack.power_on()
        assert [bus.recv(0).arbitration_id for _ in range(2)] == [0x701, 0x702]

        def ask(node):
            request = can.Message(
                arbitration_id=0x600 + node, data=bytes.fromhex("4000100000000000"), is_extended_id=False
            )
            bus.send(request)
            answers = []
            while (answer := bus.recv(0)) is not None:
                answers.append(answer.arbitration_id)
            return answers

        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        assert ask(1) == [] and ask(1) == [0x581]
        assert ask(2) == []
        now_ns[0] = 10 * MS
        assert bus.recv(0).arbitration_id == 0x582
        now_ns[0] = 50 * MS
        assert ask(2) == [0x582, 0x582]
