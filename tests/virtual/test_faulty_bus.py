"""The interface ``faulty``: any bus with wrong reports, refusals, foreign senders and an interface that fails."""

import math
import struct
from functools import partial

import can
import pytest

from frictid_drivers.cia402 import Cia402Driver
from frictid_drivers.virtual import VirtualDriver
from frictid_drivers.virtual.faults import KINDS, Fault, read_faults
from frictid_drivers.virtual.faulty_bus import FaultyBus
from frictid_drivers.virtual.lock_step import LockStepBus, LockStepClock
from frictid_drivers.virtual.rack import Rack
from frictid_drivers.virtual.wire_faults import OccupiedWire, WireFaults
from frictid_hil.errors import FrictidError, HardwareError, UsageError
from frictid_hil.protocol.driver import SetPoint

MS = 1_000_000
MAPPED = (0x60410010, 0x60640020, 0x60770010)


def sdo(index: int, subindex: int, value: int) -> bytes:
    return struct.pack("<BHBI", 0x23, index, subindex, value)


def reported(kind: str, quantity: str = "torque", **fields) -> list[tuple[int, int, int]]:
    """(status, position, torque) of eight reports, one a millisecond, the fault from the third on."""
    (fault,) = read_faults([{"kind": kind, "at_s": 0.002, "quantity": quantity, **fields}], {"0": 1})
    wire = WireFaults([fault])
    wire.hear(0x601, sdo(0x1800, 1, 0x181))
    for subindex, entry in enumerate(MAPPED, 1):
        wire.hear(0x601, sdo(0x1A00, subindex, entry))
    wire.hear(0x601, sdo(0x1A00, 0, len(MAPPED)))
    reports = []
    for n in range(8):
        data = struct.pack("<Hih", 0x1627, 1000 * n, -10 * n)
        ((due_ns, can_id, out),) = wire.through(n * MS, n * MS, 0x181, data)
        assert (due_ns, can_id, len(out)) == (n * MS, 0x181, 8)
        reports.append(struct.unpack("<Hih", out))
    return reports


def test_what_drives_report_goes_wrong_where_it_stands_in_the_frame():
    clean = [(0x1627, 1000 * n, -10 * n) for n in range(8)]
    for kind, fields, torques in (
        ("freeze", {}, [0, -10, -20, -20, -20, -20, -20, -20]),
        ("invert", {}, [0, -10, 20, 30, 40, 50, 60, 70]),
        ("scale", {"factor": 1.5}, [0, -10, -30, -45, -60, -75, -90, -105]),
        ("clip", {"level": 45}, [0, -10, -20, -30, -40, -45, -45, -45]),
        ("jump", {"level": 5, "for_s": 0.002}, [0, -10, -15, -25, -40, -50, -60, -70]),
        ("lag", {"delay_s": 0.002}, [0, -10, 0, -10, -20, -30, -40, -50]),
    ):
        found = reported(kind, **fields)
        assert [torque for _, _, torque in found] == torques, kind
        assert [row[:2] for row in found] == [row[:2] for row in clean], kind
    assert [p for _, p, _ in reported("jump", "position", level=4096)][1:4] == [1000, 6096, 7096]
    assert [s & 0x6F for s, _, _ in reported("flap")] == [0x27, 0x27, 0x21, 0x27] + [0x21, 0x27] * 2


def on_a_bus(make_robot, *faults: dict) -> FaultyBus:
    rack = Rack()
    rack.install(make_robot(joints=1))
    bus = FaultyBus(LockStepBus(rack, "faulty-bench"), list(faults), now_ns=lambda: rack.now_ns)
    rack.power_on()
    while bus.recv(0) is not None:
        pass
    return bus


def ask(bus: can.BusABC) -> list[str]:
    bus.send(can.Message(arbitration_id=0x601, data=bytes.fromhex("4000100000000000"), is_extended_id=False))
    answers = []
    while (answer := bus.recv(0)) is not None:
        answers.append(f"{answer.arbitration_id:03x} {bytes(answer.data).hex()}")
    return answers


TYPE = "4300100092010200"


@pytest.mark.parametrize(
    ("fault", "answers"),
    [
        ({"kind": "abort", "after": 1, "count": 1}, [f"581 {TYPE}", "581 8000100020000008", f"581 {TYPE}"]),
        ({"kind": "truncate", "frames": "sdo", "node": 1, "level": 3, "after": 2}, [f"581 {TYPE}"] * 2 + [None]),
        ({"kind": "misaddress", "frames": "sdo", "node": 1, "after": 1, "count": 1}, [f"581 {TYPE}", None]),
        ({"kind": "mute", "node": 1}, [None]),
    ],
)
def test_refusals_and_wrong_senders(make_robot, fault, answers):
    with on_a_bus(make_robot, fault) as bus:
        for answer in answers:
            found = ask(bus)
            assert found == [answer] if answer else f"581 {TYPE}" not in found


def test_a_foreign_sender_repeats_an_old_frame(make_robot):
    wire = WireFaults([Fault("foreign", cob_ids=frozenset({0x201}), after=1)])
    assert wire.through(0, 0, 0x201, b"a") == [(0, 0x201, b"a")]
    assert wire.through(1, 1, 0x201, b"b") == [(1, 0x201, b"b"), (1, 0x201, b"b")]
    assert wire.through(2, 2, 0x201, b"c") == [(2, 0x201, b"c"), (2, 0x201, b"b")]


@pytest.mark.parametrize(
    ("name", "kind"),
    [("can", can.CanOperationError), ("os", OSError), ("runtime", RuntimeError), ("value", ValueError)],
)
def test_the_interface_raises_what_vendors_libraries_raise(make_robot, name, kind):
    faults = [{"kind": way, "error": name, "after": 5, "count": 1} for way in ("send_error", "receive_error")]
    with on_a_bus(make_robot, *faults) as bus:
        raised = []
        for _ in range(12):
            try:
                ask(bus)
            except Exception as error:
                raised.append(type(error))
        assert raised == [kind, kind]


def test_a_bus_that_goes_off_says_so_once_and_carries_nothing(make_robot):
    with on_a_bus(make_robot, {"kind": "bus_off", "at_s": 0.0}) as bus:
        assert ask(bus)
        with pytest.raises(can.CanOperationError, match="off"):
            bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        first, then = bus.recv(0), bus.recv(0)
        assert first.is_error_frame and first.arbitration_id & 0x40 and then is None


def test_frames_take_their_time_on_an_occupied_wire_and_the_lowest_goes_first():
    wire, passed = OccupiedWire(1e6), list[int]()
    for can_id in (0x183, 0x182, 0x181):
        wire.put(0, can_id, bytes(8), partial(passed.append, can_id))
    wire.put(50_000, 0x080, b"", partial(passed.append, 0x080))
    assert wire.next_ns == 135_000  # with the most stuff bits, 8 bytes are 135 bits
    wire.run(134_999)
    assert passed == []
    wire.run(135_000)
    assert passed == [0x181]
    wire.run(1_000_000)
    assert passed == [0x181, 0x080, 0x182, 0x183] and wire.next_ns == math.inf


def test_a_host_that_stands_still_sends_later(make_robot):
    rack = Rack()
    rack.install(make_robot())
    stall = [{"kind": "stall", "delay_s": 0.02, "at_s": 0.0}]
    stood = []
    with FaultyBus(LockStepBus(rack, "stalls"), stall, lambda: rack.now_ns, stand_still=stood.append) as bus:
        for _ in range(3):
            bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    assert stood == [0.02]


def test_injected_warnings_and_resets_reach_both_ends(make_robot):
    faults = [{"kind": "emcy", "node": 1, "count": 3, "at_s": 0.0}, {"kind": "reset", "node": 1, "at_s": 0.0}]
    with on_a_bus(make_robot, *faults) as bus:
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        heard = []
        while (message := bus.recv(0)) is not None:
            heard.append(message.arbitration_id)
    assert heard.count(0x081) == 3 and 0x701 in heard


def test_by_name_in_front_of_any_interface(monkeypatch):
    # As the entry point does, also where the package was installed before there was one.
    monkeypatch.setitem(can.interfaces.BACKENDS, "faulty", ("frictid_drivers.virtual.faulty_bus", "FaultyBus"))
    monkeypatch.setattr("can.util.VALID_INTERFACES", {*can.VALID_INTERFACES, "faulty"})
    spoilt = [{"kind": "drop", "frames": "heartbeat", "node": 1, "count": 1}]
    with (
        can.Bus(interface="faulty", channel="virtual:by-name", faults=spoilt) as bus,
        can.Bus(interface="virtual", channel="by-name") as other,
    ):
        for _ in range(2):
            other.send(can.Message(arbitration_id=0x701, is_extended_id=False))
        assert bus.recv(0.1) is not None and bus.recv(0.01) is None
    with pytest.raises(can.CanInitializationError, match="explode"):
        can.Bus(interface="faulty", channel="virtual:by-name", faults=[{"kind": "explode"}])


def test_faults_for_a_bus_that_injects_none_are_refused(make_robot, runtime_folder):
    setup = make_robot(options={"faults": []})
    with pytest.raises(UsageError, match="faults` spoil a bus") as refused:
        Cia402Driver(setup).open()
    assert "faulty:virtual:bench" in refused.value.next_step


def row_of(kind: str) -> dict:
    fields: dict = {
        "kind": kind,
        "quantity": "torque",
        "frames": "tpdo1",
        "delay_s": 0.003,
        "index": 0x2031,
        "level": 1e6,
    }
    fields["level"] = 1e6
    return {**fields, "at_s": 0.12} if kind not in ("missing", "left_in_fault", "abort") else fields


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_passes_through_the_driver_without_a_traceback(make_robot, runtime_folder, kind):
    driver = VirtualDriver(make_robot(options={"faults": [row_of(kind)]}))
    try:
        driver.open()
        driver.configure(1000.0, ["0"])
        driver.start_cycling()
        set_points = [SetPoint(), SetPoint()]
        for _ in range(150):
            driver.clock.wait_until(driver.clock.now_ns() + MS)
            driver.exchange(set_points)
    except FrictidError as error:
        assert error.what and error.next_step
    finally:
        driver.close()


def test_wrong_answers_in_front_of_the_real_driver_name_the_object(make_robot):
    rack = Rack()
    setup = make_robot(joints=1)
    rack.install(setup)
    clock = LockStepClock(rack)

    def bus() -> FaultyBus:
        opened = FaultyBus(LockStepBus(rack, "refusing"), [{"kind": "abort", "after": 40}], lambda: rack.now_ns)
        rack.power_on()
        return opened

    driver = Cia402Driver(setup, bus_factory=bus, clock=clock)
    with pytest.raises(HardwareError, match=r"0x08000020|refus|abort"):
        driver.open()
        driver.configure(1000.0, ["0"])
    driver.close()


def set_up(setup, after):
    """Open and configure a drive whose SDO answer after so many is an abort: answers that passed, and the error."""
    rack = Rack()
    rack.install(setup)
    buses = []

    def bus() -> FaultyBus:
        row = {"kind": "abort", "after": after, "count": 1}
        buses.append(FaultyBus(LockStepBus(rack, "step"), [row], lambda: rack.now_ns))
        rack.power_on()
        return buses[-1]

    driver, ended = Cia402Driver(setup, bus_factory=bus, clock=LockStepClock(rack)), None
    try:
        driver.open()
        driver.check(None)
        driver.configure(1000.0, ["0"])
        driver.set_limits("0", torque_nm=10.0, position_min_rad=-1.0, position_max_rad=1.0)
    except FrictidError as error:
        ended = error
    finally:
        driver.close()
    assert not any(servo.axis.powered for servo in rack.servos.values())
    return buses[0]._incoming._frames[0][0]._passed, ended


@pytest.mark.slow
def test_an_abort_at_any_step_of_setting_a_drive_up_is_taken_or_told(make_robot):
    setup = make_robot(joints=1)
    steps, ended = set_up(setup, 10**6)
    assert steps > 50 and ended is None
    told = [set_up(setup, step)[1] for step in range(steps)]
    assert all(error.next_step and "0" in error.where for error in told if error is not None)
    assert sum(error is not None for error in told) > 10
