"""Set-points, units, limits and supervision of one axis, with a joint that can be reasoned about by hand."""

import math
import struct

import pytest

TURN = 2 * math.pi
CONTROL, MODE = 0x60400010, 0x60600008
ENABLED, FAULT, REACTION = 0x27, 0x08, 0x0F


def cyclic(desk, mode, entry, kind="i"):
    """Enabled in a mode, one target in RPDO 1; returns a function that sends one cycle."""
    desk.map_pdo(True, 1, [CONTROL, entry], 1)
    desk.enable(mode)
    desk.send(0x000, "0105")

    def cycle(value, control=0x0F, milliseconds=1.0):
        desk.cycle(struct.pack("<H" + kind, control, value), milliseconds)
        return desk.read(0x6064, signed=True)

    return cycle


class TestPosition:
    def test_target_is_reached_one_interpolation_time_after_its_sync(self, desk):
        cycle = cyclic(desk, 8, 0x607A0020)
        assert cycle(500) == 500
        cycle(1000, milliseconds=0.25)
        assert desk.read(0x6064) == 625
        desk.wait(0.75)
        assert desk.read(0x6064) == 1000
        assert desk.read(0x6041) & 0x1000

    def test_longer_interpolation_time(self, desk):
        assert desk.write(0x60C2, 1, 4, 1) == 0
        cycle = cyclic(desk, 8, 0x607A0020)
        assert cycle(400) == 100
        desk.wait(10)
        assert desk.read(0x6064) == 400

    def test_position_and_torque_offset(self, desk):
        desk.write(0x60B0, 0, 7, 4)
        desk.write(0x6076, 0, 2000, 4)  # 2 N m, gear 1
        cycle = cyclic(desk, 8, 0x607A0020)
        desk.write(0x60B2, 0, -250, 2)
        assert cycle(100) == 107
        assert desk.plant.calls[-1]["torque_offset_nm"] == pytest.approx(-0.5)
        assert desk.read(0x6077, signed=True) == -250

    def test_software_limits_clamp_and_say_so(self, desk):
        desk.write(0x607D, 1, -100, 4)
        desk.write(0x607D, 2, 200, 4)
        cycle = cyclic(desk, 8, 0x607A0020)
        assert cycle(150) == 150 and not desk.read(0x6041) & 0x0800
        assert cycle(201) == 200 and desk.read(0x6041) & 0x0800
        assert cycle(-500) == -100
        assert cycle(0) == 0 and not desk.read(0x6041) & 0x0800

    def test_set_points_are_limited_to_the_motor_speed(self, desk):
        desk.write(0x6080, 0, 60, 4)  # one revolution per second: 1000 increments per ms
        cycle = cyclic(desk, 8, 0x607A0020)
        assert cycle(5000) == 1000 and desk.read(0x6041) & 0x0800

    def test_enabling_holds_the_target_that_stands_in_607a(self, desk):
        """The trap that a host must know: a stale target is gone to, as fast as the motor may."""
        desk.plant.measured_position_rad = 1.0
        here = desk.read(0x6064)
        desk.write(0x607A, 0, here, 4)
        desk.enable(8)
        desk.wait(50)
        assert desk.read(0x6064) == here
        desk.control(0x06)
        desk.write(0x607A, 0, 0, 4)
        desk.enable(8)
        desk.wait(50)
        assert desk.read(0x6064) == 0

    def test_demand_is_where_the_joint_is_while_off(self, desk):
        desk.plant.measured_position_rad = 0.5
        assert desk.read(0x6062) == desk.read(0x6064) == 79_577 and desk.read(0x60F4) == 0

    def test_following_error_after_its_timeout(self, desk):
        desk.write(0x6065, 0, 1000, 4)
        desk.write(0x6066, 0, 20, 2)
        cycle = cyclic(desk, 8, 0x607A0020)
        desk.plant.blocked = True
        for n in range(1, 6):
            cycle(200 * n)
        assert not desk.read(0x6041) & 0x2000 and desk.read(0x60F4) == 1000
        cycle(1200)
        assert desk.read(0x6041) & 0x2000
        for _ in range(18):
            cycle(1200)
        assert desk.state() == ENABLED
        for _ in range(3):
            cycle(1200)
        assert desk.state() in (REACTION, FAULT)
        desk.wait(1000)
        assert desk.state() == FAULT and desk.read(0x603F) == 0x8611

    def test_following_error_that_ends_in_time_is_forgiven(self, desk):
        desk.write(0x6065, 0, 1000, 4)
        desk.write(0x6066, 0, 20, 2)
        cycle = cyclic(desk, 8, 0x607A0020)
        for _ in range(3):
            desk.plant.blocked = True
            for _ in range(15):
                cycle(2000)
            desk.plant.blocked = False
            cycle(2000)
            desk.plant.measured_position_rad = 0.0
        assert desk.state() == ENABLED

    def test_following_error_is_found_without_sync(self, desk):
        desk.write(0x6065, 0, 1000, 4)
        cycle = cyclic(desk, 8, 0x607A0020)
        cycle(0)
        desk.plant.measured_position_rad = 0.5
        desk.plant.blocked = True
        desk.map_pdo(False, 1, [0x60410010], 255)
        desk.wait(40)
        assert desk.read(0x603F) == 0x8611


class TestVelocityAndTorque:
    def test_velocity_with_offset_in_drive_units(self, desk):
        assert desk.write(0x60A9, 0, 0xFDB44700, 4) == 0
        desk.write(0x60B1, 0, 20_000, 4)
        cycle = cyclic(desk, 9, 0x60FF0020)
        cycle(40_000)  # 60 rpm together: 1 revolution per second
        assert cycle(40_000) == pytest.approx(2000, abs=1)
        assert desk.read(0x606C) == 60_000

    def test_torque_with_offset_clamped_by_6072(self, desk):
        desk.write(0x6076, 0, 4000, 4)
        desk.write(0x60B2, 0, 100, 2)
        cycle = cyclic(desk, 10, 0x60710010, "h")
        cycle(150)
        assert desk.plant.calls[-1]["torque_nm"] == pytest.approx(1.0)
        assert desk.plant.calls[-1]["torque_offset_nm"] == 0.0, "added to the target, not beside it"
        assert desk.read(0x6077) == 250 and desk.read(0x6074) == 250
        desk.write(0x6072, 0, 200, 2)
        assert desk.plant.torque_limit_nm == pytest.approx(0.8)
        cycle(150)
        assert desk.plant.calls[-1]["torque_nm"] == pytest.approx(0.8) and desk.read(0x6041) & 0x0800

    def test_torque_limit_may_come_by_pdo(self, desk):
        desk.write(0x6076, 0, 4000, 4)
        desk.map_pdo(True, 1, [CONTROL, 0x60720010], 1)
        desk.enable(10)
        desk.send(0x000, "0105")
        desk.cycle(struct.pack("<HH", 0x0F, 150))
        assert desk.plant.torque_limit_nm == pytest.approx(0.6)

    def test_overspeed_is_a_fault(self, desk):
        desk.write(0x6080, 0, 60, 4)
        cycle = cyclic(desk, 10, 0x60710010, "h")
        for _ in range(30):
            desk.plant.velocity_rad_s += 0.3
            cycle(0)
        desk.wait(1000)
        assert desk.state() == FAULT and desk.read(0x603F) == 0x8400

    def test_leaving_the_software_limits_is_a_fault_only_outwards(self, desk):
        desk.write(0x607D, 1, -1000, 4)
        desk.write(0x607D, 2, 1000, 4)
        cycle = cyclic(desk, 10, 0x60710010, "h")
        desk.plant.measured_position_rad, desk.plant.velocity_rad_s = 0.1, -0.2
        cycle(0)
        assert desk.state() == ENABLED
        desk.plant.velocity_rad_s = 0.2
        cycle(0)
        cycle(0)
        desk.wait(1000)
        assert desk.state() == FAULT and desk.read(0x603F) == 0x8612

    def test_quick_stop_from_torque_mode_brakes_by_position(self, desk):
        desk.write(0x605A, 0, 6, 2)
        cycle = cyclic(desk, 10, 0x60710010, "h")
        desk.plant.velocity_rad_s = 1.0
        cycle(0)
        cycle(0, control=0x02)
        desk.wait(2000)
        assert desk.state() == 0x07
        assert desk.plant.mode == 8 and desk.servo.axis.at_rest

    def test_changing_mode_under_way_starts_from_here(self, desk):
        desk.map_pdo(True, 1, [CONTROL, MODE, 0x607A0020], 1)
        desk.enable(10)
        desk.send(0x000, "0105")
        desk.plant.measured_position_rad = 0.02
        desk.cycle(struct.pack("<Hbi", 0x0F, 8, 3183))
        desk.cycle(struct.pack("<Hbi", 0x0F, 8, 3183))
        assert desk.read(0x6061) == 8 and desk.read(0x6064) == 3183


class TestUnits:
    def test_gear_and_direction(self, make_desk):
        """131072 counts per motor turn, gear 81.5, mounted backwards: what the host must compute."""
        desk = make_desk(
            {0x608F01: 131_072, 0x609101: 163, 0x609102: 2, 0x609201: 131_072 * 163, 0x609202: 2, 0x6076_00: 1000},
            gear_ratio=81.5, increments_per_revolution=131_072 * 81.5, direction=-1,
        )  # fmt: skip
        desk.write(0x60A9, 0, 0xFDB44700, 4)
        desk.plant.velocity_rad_s = TURN / 60  # one rpm of the joint
        desk.plant.torque_nm = 8.15
        assert desk.read(0x606C, signed=True) == -1000
        assert desk.read(0x6077, signed=True) == -100

    def test_position_sign_follows_direction(self, make_desk):
        for direction in (1, -1):
            desk = make_desk(direction=direction)
            desk.plant.measured_position_rad = TURN / 4
            assert desk.read(0x6064, signed=True) == direction * 250_000

    def test_motor_side_where_the_drive_knows_no_gear(self, make_desk):
        desk = make_desk(gear_ratio=100.0, increments_per_revolution=13_107_200.0)
        desk.write(0x60A9, 0, 0x00B44700, 4)
        desk.plant.velocity_rad_s = TURN / 60
        assert desk.read(0x606C) == 100, "6091 is 1:1: motor rpm"

    def test_feed_constant_scales_position(self, desk):
        desk.write(0x6092, 1, 13_107, 4)
        desk.plant.measured_position_rad = TURN / 4
        assert desk.read(0x6064) == pytest.approx(25_000, abs=1)

    def test_units_cannot_change_under_power(self, desk):
        desk.enable()
        for index, sub in ((0x60A9, 0), (0x6091, 1), (0x608F, 1), (0x6092, 1), (0x6076, 0), (0x60C2, 1)):
            value, size = (0xFDB44700, 4) if index == 0x60A9 else (2, 1 if index == 0x60C2 else 4)
            assert desk.write(index, sub, value, size) == 0x08000022, hex(index)

    def test_only_revolutions_per_minute(self, desk):
        assert desk.read(0x60A9) == 0x00B44700
        for unit in (0x00B40300, 0xF9B44700, 0x01B44700, 0):
            assert desk.write(0x60A9, 0, unit, 4) == 0x06090030

    def test_coarse_and_fine_velocity(self, desk):
        desk.plant.velocity_rad_s = 0.31416
        assert desk.read(0x606C) == 3
        desk.write(0x60A9, 0, 0xFDB44700, 4)
        assert desk.read(0x606C) == 3000

    def test_torque_is_clipped_to_16_bits(self, desk):
        desk.plant.torque_nm = 1e9
        assert desk.read(0x6077) == 0x7FFF
        desk.plant.torque_nm = float("nan")
        assert desk.read(0x6077) == 0

    def test_torque_step(self, make_desk):
        desk = make_desk(torque_step=5)
        desk.plant.torque_nm = 0.0124
        assert desk.read(0x6077) == 10
        desk.plant.torque_nm = -0.013
        assert desk.read(0x6077, signed=True) == -15

    def test_position_wraps_at_32_bits(self, desk):
        desk.plant.measured_position_rad = TURN * 2147.483648
        assert desk.read(0x6064, signed=True) == -(1 << 31)

    def test_external_torque_and_temperature(self, desk):
        desk.plant.external_torque_nm, desk.plant.temperature_c = -1.2345, 31.26
        assert desk.read(0x2030, signed=True) == -1234 or desk.read(0x2030, signed=True) == -1235
        assert desk.read(0x2031, signed=True) == 313


class TestOwnHelpers:
    def test_friction_compensation_acts_when_switched_on(self, desk):
        desk.write(0x6076, 0, 1000, 4)
        desk.write(0x2020, 1, 100, 2)
        cycle = cyclic(desk, 8, 0x607A0020)
        cycle(200)
        assert desk.plant.calls[-1]["torque_offset_nm"] == pytest.approx(0.1)
        cycle(0)
        assert desk.plant.calls[-1]["torque_offset_nm"] == pytest.approx(-0.1)
        cycle(0)
        assert desk.plant.calls[-1]["torque_offset_nm"] == 0.0

    def test_inertia_feed_forward(self, desk):
        desk.write(0x2021, 2, 50_000, 4)  # 0.05 kg m2 at the motor, gear 1
        cycle = cyclic(desk, 8, 0x607A0020)
        cycle(1000)  # from rest to 2 pi rad/s within 1 ms
        assert desk.plant.calls[-1]["torque_offset_nm"] == pytest.approx(0.05 * TURN / 1e-3, rel=1e-6)

    def test_off_unless_asked(self, desk):
        assert [desk.read(0x2020, 1), desk.read(0x2020, 2), desk.read(0x2021, 2), desk.read(0x2022, 2)] == [0] * 4

    def test_torque_filter_smooths_the_report(self, desk):
        desk.write(0x2022, 2, 10_000, 4)
        desk.read(0x6077)
        desk.plant.powered = True
        desk.plant.torque_nm = 0.1
        # Means of 1 - exp(-t / T) over the first and the second time constant: what is reported is a mean, filtered.
        for expected in (37, 77):
            desk.servo.axis.now_ns += 10_000_000
            assert desk.read(0x6077) == pytest.approx(expected, abs=1)


def test_payload_and_hand_objects_reach_the_joint(make_desk):
    held = []
    desk = make_desk(hold_hand=lambda *figures: held.append(figures))
    desk.write(0x2041, 0, 1, 1)
    assert desk.plant.payload
    desk.write(0x2040, 2, -500_000, 4)
    desk.write(0x2040, 3, 349_066, 4)
    desk.write(0x2040, 4, 500, 4)
    desk.write(0x2040, 1, 1, 1)
    assert held[-1] == (True, -0.5, pytest.approx(0.349066), 0.5)


def test_missing_objects_act_by_their_defaults(make_desk):
    desk = make_desk(missing=(0x60B2, 0x6072, 0x605A, 0x6007, 0x60A9, 0x1019))
    assert desk.abort_of_read(0x60B2) == 0x06020000
    assert desk.write(0x1600, 1, 0x60B20010, 4) == 0x06020000
    cycle = cyclic(desk, 8, 0x607A0020)
    assert cycle(50) == 50


def test_stuck_encoder_reports_one_position_for_ever(desk):
    cycle = cyclic(desk, 8, 0x607A0020)
    cycle(100)
    desk.servo.axis.encoder_stuck = True
    assert cycle(200) == 100 and cycle(300) == 100
    assert desk.read(0x606C) == 0
    desk.servo.boot(desk.rack.now_ns)
    assert desk.read(0x6064) == 300
