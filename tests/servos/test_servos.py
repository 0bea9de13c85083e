"""Servos on a serial line: packets, and the driver against simulated servos byte by byte."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from servo_bench import Bench, setup_of

from frictid_drivers.servos.logs import decoder, number, to_bytes
from frictid_drivers.servos.models import MODELS
from frictid_drivers.servos.packets import WIRES, Feetech
from frictid_drivers.servos.simulated import VirtualServoDriver
from frictid_hil.errors import HardwareError, InvalidFields, PlanRefused, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import JointState, Severity

KINDS = ("STS3215", "SCS15", "XL330-M288", "XL430-W250")


# -- packets -----------------------------------------------------------------------------------------------------------


def test_packets_of_the_manuals() -> None:
    feetech, dynamixel = WIRES["feetech"], WIRES["dynamixel"]
    assert feetech.read(1, 56, 8) == bytes.fromhex("FFFF0104023808B8")
    assert dynamixel.read(1, 132, 4) == bytes.fromhex("FFFFFD00010700028400 04001D15".replace(" ", ""))


def test_a_peer_agrees_byte_by_byte() -> None:
    sdk = pytest.importorskip("dynamixel_sdk")

    class Port:
        is_using = False
        written = b""

        def clearPort(self) -> None: ...

        def writePort(self, data: list[int]) -> int:
            self.written = bytes(data)
            return len(data)

    port = Port()
    params = [0xFF, 0x0F, 0xFD, 0x01]
    packet = [0, 0, 0, 0, 1, 2 + 1 + 2 + 4, 0, 3, 116, 0, *params, 0, 0]
    sdk.PacketHandler(2.0).txPacket(port, packet)
    assert port.written == WIRES["dynamixel"].write(1, 116, bytes(params))


@pytest.mark.parametrize("name", sorted(WIRES))
@given(st.lists(st.tuples(st.integers(0, 252), st.binary(max_size=40)), max_size=5), st.binary(max_size=20))
def test_answers_come_through_garbage_and_in_pieces(name: str, told: list[tuple[int, bytes]], noise: bytes) -> None:
    wire = WIRES[name]
    noise = noise.replace(b"\xff", b"\xfe")
    stream = noise + b"".join(wire.answer(servo, 0, data) for servo, data in told)
    buffer, found = bytearray(), []
    for k in range(0, len(stream), 7):
        buffer += stream[k : k + 7]
        found += [(packet.id, packet.data) for packet in wire.parse(buffer, answers=True)]
    assert found == told


@pytest.mark.parametrize("name", sorted(WIRES))
@given(st.binary(max_size=200))
def test_no_bytes_whatever_raise(name: str, data: bytes) -> None:
    for answers in (True, False):
        list(WIRES[name].parse(bytearray(data), answers=answers))


@given(st.sampled_from(sorted(MODELS)), st.integers(-32767, 32767))
def test_numbers_of_every_model_both_ways(name: str, value: int) -> None:
    assert number(to_bytes(value, 2, MODELS[name]), MODELS[name], 15) == value


def test_load_has_its_sign_in_bit_ten() -> None:
    assert number((0x0400 | 250).to_bytes(2, "little"), MODELS["STS3215"], 10) == -250


# -- the driver --------------------------------------------------------------------------------------------------------


@pytest.fixture(params=KINDS)
def bench(request: pytest.FixtureRequest) -> Bench:
    return Bench(setup_of(request.param))


def test_a_joint_follows_and_reports_in_its_own_units(bench: Bench) -> None:
    bench.begin()
    bench.enabled()
    for k in range(200):
        bench.set_points[0].position_rad = 0.5 * (1 - math.cos(math.pi * k / 200))
        (report, other) = bench.cycles(1)
        if k == 100:
            assert report.velocity_rad_s == pytest.approx(bench.servo(0).plant.velocity_rad_s, abs=0.35)
            assert report.torque_nm > 0.1
    (report, other) = bench.cycles(60)
    assert report.position_rad == pytest.approx(1.0, abs=0.05)
    assert report.position_rad == pytest.approx(bench.servo(0).plant.position_rad, abs=0.005)
    assert abs(other.position_rad) < 0.05
    bench.driver.close()
    assert not bench.servo(0).on


def test_what_torque_means_is_said_with_its_uncertainty(bench: Bench) -> None:
    bench.driver.open()
    findings = bench.driver.check(None)
    assert any("scale error of up to" in f.message and f.severity is Severity.WARNING for f in findings)
    identity = next(iter(bench.driver.identify().values()))
    assert "N m/A" in identity.torque_source or "PWM duty" in identity.torque_source
    assert identity.torque_resolution_nm > 0


@pytest.mark.parametrize("model", ["STS3215", "SCS15", "XL430-W250"])
def test_servos_without_a_goal_current_have_no_torque_mode(model: str) -> None:
    bench = Bench(setup_of(model))
    bench.driver.open()
    assert bench.driver.capabilities().modes == {Mode.POSITION}
    bench.driver.configure(100.0, [])
    with pytest.raises(HardwareError, match="TORQUE refused") as caught:
        bench.driver.enable("shoulder_pan", Mode.TORQUE)
    assert "--drive-mode position" in caught.value.next_step


def test_a_rate_that_the_line_cannot_carry_is_refused(bench: Bench) -> None:
    bench.driver.open()
    most_hz = bench.driver.capabilities().max_cycle_hz
    with pytest.raises(PlanRefused, match=f"at most {most_hz:g} Hz"):
        bench.driver.configure(1000.0 + most_hz, [])
    bench.driver.configure(most_hz, [])


@pytest.mark.parametrize(("cycle_hz", "refused"), [(100.0, True), (199.0, True), (200.0, False)])
def test_a_rate_at_which_curves_are_wrong_is_refused_before_anything_moves(cycle_hz: float, refused: bool) -> None:
    setup = replace(setup_of("STS3215"), cycle_hz=cycle_hz)
    bench = Bench(setup)
    bench.driver.open()
    errors = [f for f in bench.driver.check(None) if f.severity is Severity.ERROR]
    assert [f.subject for f in errors] == (["rate"] if refused else [])


@pytest.mark.parametrize(
    ("model", "joints", "most_hz"), [("STS3215", 1, 1500), ("STS3215", 6, 321), ("XL330-M288", 6, 284)]
)
def test_the_rate_that_a_line_carries_is_counted_in_bytes(model: str, joints: int, most_hz: float) -> None:
    # At 1 Mbit/s a byte takes 10 us. Goals go out in one half of the cycle, the reading comes in the other:
    # Feetech asks with 8 + n bytes and is answered with 21 each, Dynamixel with 14 + n and 23 each.
    bench = Bench(setup_of(model, joints))
    bench.driver.open()
    read_bytes = 8 + joints + 21 * joints if model == "STS3215" else 14 + joints + 23 * joints
    delays_s = sum(told.delay_s for told in bench.driver._told.values())
    assert bench.driver.capabilities().max_cycle_hz == most_hz == int(0.45 / (read_bytes * 10e-6 + delays_s))
    with pytest.raises(PlanRefused, match=f"at most {most_hz} Hz"):
        bench.driver.configure(2000.0, [])


def test_a_log_decodes_to_what_was_live(bench: Bench) -> None:
    bench.begin()
    bench.enabled()
    live = []
    for _ in range(40):
        bench.set_points[0].position_rad += 0.004
        live.append([str(report) for report in bench.cycles(1)])
    rows = decoder(bench.driver.frame_map_values()).rows(bench.frames)
    decoded = [[str(report) for report in row.feedback] for row in rows]
    assert decoded[-40:] == live


def test_every_goal_is_logged_before_the_reading_that_sees_it() -> None:
    bench = Bench(setup_of("STS3215", 1))
    bench.begin()
    bench.enabled()
    bench.set_points[0].position_rad = 0.3
    (report,) = bench.cycles(1)
    assert report.position_command_rad == pytest.approx(0.3, abs=0.001)


def test_silence_counts_and_closing_lets_go(bench: Bench) -> None:
    bench.begin()
    bench.enabled()
    bench.chain.fault = lambda data, to_host: b"" if to_host else data
    assert [report.age_cycles for report in bench.cycles(5)] == [5, 5]
    bench.driver.close()
    assert not bench.servo(0).on and not bench.servo(1).on


def test_damaged_bytes_cost_a_cycle_and_change_nothing(bench: Bench) -> None:
    bench.begin()
    bench.enabled()
    before = [report.position_rad for report in bench.cycles(1)]
    bench.chain.fault = lambda data, to_host: bytes([*data[:-1], data[-1] ^ 0x55]) if to_host else data
    after = bench.cycles(1)
    assert [report.age_cycles for report in after] == [1, 1] and [r.position_rad for r in after] == before
    bench.chain.fault = None
    assert [report.age_cycles for report in bench.cycles(2)] == [0, 0]


def test_an_unplugged_adapter_is_told() -> None:
    bench = Bench(setup_of("STS3215"))
    bench.begin()
    bench.enabled()

    def gone(data: bytes, to_host: bool) -> bytes:
        raise OSError("Input/output error")

    bench.chain.fault = gone
    with pytest.raises(HardwareError, match="the port is gone"):
        bench.cycles(1)
    bench.driver.quick_stop()
    bench.driver.close()


def test_a_bus_watchdog_where_there_is_one() -> None:
    bench = Bench(setup_of("XL330-M288"))
    bench.begin()
    bench.enabled()
    assert bench.driver.capabilities().drive_watchdog
    bench.clock.wait_until(bench.clock.now_ns() + 300_000_000)
    assert not bench.servo(0).on
    assert not Bench(setup_of("STS3215")).servo(0).mine.model.registers.watchdog


def test_status_errors_are_faults() -> None:
    bench = Bench(setup_of("STS3215"))
    bench.begin()
    bench.enabled()
    bench.servo(1).error = 0x20
    first, second = bench.cycles(1)
    assert first.state is JointState.ENABLED
    assert (second.state, second.error_code) == (JointState.FAULT, 0x20)


def test_a_set_point_that_is_no_number_holds_every_joint(bench: Bench) -> None:
    bench.begin()
    bench.enabled()
    bench.set_points[0].position_rad = math.nan
    with pytest.raises(SafetyAbort, match="no number"):
        bench.cycles(1)
    bench.set_points[0].position_rad = 1.0
    reports = bench.cycles(40)
    assert all(abs(report.position_rad) < 0.05 for report in reports)


@pytest.mark.parametrize(
    "options", [{"model": "STS"}, {"model": "STS3215", "zero_counts": 4096}, {"model": "STS3215", "kt": 1}]
)
def test_impossible_options_are_refused_by_name(options: dict[str, object]) -> None:
    setup = setup_of("STS3215")
    with pytest.raises(InvalidFields, match="options"):
        VirtualServoDriver(replace(setup, joints=(replace(setup.joints[0], options=options),)))


def test_a_checksum_that_is_wrong_is_no_packet() -> None:
    assert not list(Feetech().parse(bytearray.fromhex("FFFF010400380800"), answers=True))
