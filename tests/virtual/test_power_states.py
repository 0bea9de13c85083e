"""CiA 402's state machine at the wire: every transition by its number, and that no other exists."""

import itertools

import pytest

from frictid_drivers.virtual.power_stage import PowerState

MS = 1_000_000
DISABLED, READY, ON, ENABLED, QUICK, REACTION, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08
SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE, STOP, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80


def bring(desk, state):
    """From boot to a state, held there."""
    desk.write(0x605A, 0, 6, 2)
    desk.write(0x6060, 0, 8, 1)
    words = {
        DISABLED: [], READY: [SHUTDOWN], ON: [SHUTDOWN, SWITCH_ON], ENABLED: [SHUTDOWN, SWITCH_ON, ENABLE],
        QUICK: [SHUTDOWN, SWITCH_ON, ENABLE, STOP], FAULT: [],
    }  # fmt: skip
    for word in words[state]:
        desk.control(word)
    if state == FAULT:
        desk.servo.fail(0x5000, desk.rack.now_ns)
    assert desk.state() == state


def test_boot_ends_in_switch_on_disabled_by_transitions_0_and_1(desk):
    assert desk.heard[0] == (0x705, "00")
    assert desk.state() == DISABLED
    assert desk.plant.braked and not desk.plant.powered


TRANSITIONS = {
    # (state, controlword): (transition, next state)
    (DISABLED, SHUTDOWN): (2, READY),
    (READY, SWITCH_ON): (3, ON),
    (READY, ENABLE): (34, ENABLED),
    (ON, ENABLE): (4, ENABLED),
    (ENABLED, SWITCH_ON): (5, ON),
    (ON, SHUTDOWN): (6, READY),
    (READY, VOLTAGE): (7, DISABLED),
    (READY, STOP): (7, DISABLED),
    (ENABLED, SHUTDOWN): (8, READY),
    (ENABLED, VOLTAGE): (9, DISABLED),
    (ON, VOLTAGE): (10, DISABLED),
    (ON, STOP): (10, DISABLED),
    (ENABLED, STOP): (11, QUICK),
    (QUICK, VOLTAGE): (12, DISABLED),
    (QUICK, ENABLE): (16, ENABLED),
    (FAULT, RESET): (15, DISABLED),
}


@pytest.mark.parametrize(
    ("state", "word"),
    list(itertools.product((DISABLED, READY, ON, ENABLED, QUICK, FAULT), (SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE, STOP))),
)
def test_every_pair_of_state_and_command(desk, state, word):
    bring(desk, state)
    expected = TRANSITIONS.get((state, word), (0, state))[1]
    assert desk.control(word) == expected
    assert desk.plant.powered == (expected in (ENABLED, QUICK))
    assert desk.plant.braked == (not desk.plant.powered)


@pytest.mark.parametrize("state", [DISABLED, READY, ON, ENABLED, QUICK])
def test_fault_is_transition_13_then_14_then_reset_15(desk, state):
    bring(desk, state)
    desk.plant.velocity_rad_s = 0.5 if state == ENABLED else 0.0
    desk.servo.fail(0x5000, desk.rack.now_ns)
    if state in (ENABLED, QUICK):
        assert desk.state() == REACTION
        assert desk.plant.powered, "power stays on for the ramp"
        desk.wait(3000)
    assert desk.state() == FAULT
    assert not desk.plant.powered and desk.plant.braked
    assert desk.read(0x603F) == 0x5000 and desk.read(0x1001) == 0x21
    for word in (SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE):
        assert desk.control(word) == FAULT
    assert desk.control(RESET) == DISABLED
    assert desk.read(0x603F) == 0 and desk.read(0x1001) == 0


def test_fault_reset_needs_a_rising_edge(desk):
    desk.control(RESET)
    desk.servo.fail(0x5000, desk.rack.now_ns)
    assert desk.control(RESET) == FAULT
    assert desk.control(0) == FAULT
    assert desk.control(RESET) == DISABLED


def moving(desk, units_per_ms=100):
    """Enabled in CSP, moving at a constant speed of 100 000 increments/s by RPDO 1."""
    desk.map_pdo(True, 1, [0x60400010, 0x607A0020], 1)
    desk.enable(8)
    desk.send(0x000, "0105")
    target = 0
    for _ in range(20):
        target += units_per_ms
        desk.cycle(b"\x0f\x00" + target.to_bytes(4, "little"))
    assert desk.servo.axis.powered
    return target


@pytest.mark.parametrize(
    ("option", "ends", "deceleration"),
    [(0, DISABLED, None), (1, DISABLED, 6084), (2, DISABLED, 6085), (3, DISABLED, 0), (4, DISABLED, 0),
     (5, QUICK, 6084), (6, QUICK, 6085), (7, QUICK, 0)],
)  # fmt: skip
def test_quick_stop_options(make_desk, option, ends, deceleration):
    # 60A9 at 0.001 rpm of a shaft with 1e6 increments: 100 000 increments/s are 6000 units.
    desk = make_desk()
    assert desk.write(0x60A9, 0, 0xFDB44700, 4) == 0
    assert desk.write(0x6084, 0, 6000, 4) == 0  # to rest in 1 s
    assert desk.write(0x6085, 0, 60_000, 4) == 0  # in 0.1 s
    desk.write(0x605A, 0, option, 2)
    start = moving(desk)
    desk.control(STOP)
    if option == 0:
        assert desk.state() == DISABLED and not desk.plant.powered
        return
    assert desk.state() == QUICK
    took_ms = 0
    while desk.servo.axis.ramping and took_ms < 3000:
        desk.wait(1)
        took_ms += 1
    travel = desk.plant.position_counts - start
    if deceleration == 6084:
        assert took_ms == pytest.approx(1000, abs=4) and travel == pytest.approx(50_000, abs=400)
    elif deceleration == 6085:
        assert took_ms == pytest.approx(100, abs=4) and travel == pytest.approx(5_000, abs=200)
    else:
        assert took_ms <= 2
        assert any(call["mode"] == 9 and call["velocity_rad_s"] == 0.0 for call in desk.plant.calls)
    assert desk.state() == ends
    assert desk.plant.powered == (ends == QUICK)
    if ends == QUICK:
        held = desk.plant.position_counts
        desk.wait(100)
        assert desk.read(0x6064) == held
        assert desk.control(ENABLE) == ENABLED, "transition 16"


def test_transition_16_only_where_605a_holds(desk):
    desk.write(0x605A, 0, 2, 2)
    moving(desk)
    assert desk.control(STOP) == QUICK
    assert desk.control(ENABLE) == QUICK


def test_option_codes_of_shutdown_and_disable_operation_ramp_down_first(desk):
    desk.write(0x60A9, 0, 0xFDB44700, 4)
    desk.write(0x6084, 0, 60_000, 4)
    desk.write(0x605B, 0, 1, 2)
    moving(desk)
    assert desk.control(SHUTDOWN) == ENABLED, "still braking"
    desk.wait(150)
    assert desk.state() == READY and not desk.plant.powered


def test_shutdown_without_a_ramp_takes_power_at_once(desk):
    moving(desk)
    assert desk.control(SHUTDOWN) == READY and not desk.plant.powered


def test_halt_stops_and_holds_and_is_released(desk):
    desk.write(0x60A9, 0, 0xFDB44700, 4)
    desk.write(0x6084, 0, 60_000, 4)
    target = moving(desk)
    desk.cycle(b"\x0f\x01" + target.to_bytes(4, "little"))
    desk.wait(200)
    assert desk.state() == ENABLED and desk.read(0x6041) & 0x1400 == 0x0400
    held = desk.plant.position_counts
    desk.cycle(b"\x0f\x01" + (target + 9999).to_bytes(4, "little"))
    assert desk.read(0x6064) == held
    desk.cycle(b"\x0f\x00" + held.to_bytes(4, "little"))
    desk.cycle(b"\x0f\x00" + (held + 50).to_bytes(4, "little"))
    assert desk.read(0x6064) == held + 50 and desk.read(0x6041) & 0x1400 == 0x1000


def test_brake_can_be_worked_by_the_host(desk):
    assert desk.read(0x60FD) & 1 << 16
    desk.enable()
    assert not desk.read(0x60FD) & 1 << 16 and not desk.plant.braked
    desk.write(0x60FE, 1, 1, 4)
    assert not desk.plant.braked, "not masked: the drive works its brake"
    desk.write(0x60FE, 2, 1, 4)
    assert desk.plant.braked and desk.read(0x60FD) & 1 << 16
    desk.write(0x60FE, 1, 0, 4)
    assert not desk.plant.braked


def test_supported_modes_and_display(desk):
    assert desk.read(0x6502) == 0x380
    for mode in (8, 9, 10, 0):
        assert desk.write(0x6060, 0, mode, 1) == 0
        assert desk.read(0x6061) == mode
    for mode in (1, 3, 6, 7, 11, -1):
        assert desk.write(0x6060, 0, mode & 0xFF, 1) == 0x06090030
    desk.enable(0)
    assert desk.plant.mode == 8, "enabled without a mode: held where it is"


def test_reset_node_takes_power_away_and_boots(desk):
    desk.enable()
    assert (0x705, "00") in desk.send(0x000, "8105")
    assert not desk.plant.powered and desk.plant.braked and desk.state() == DISABLED
    assert desk.servo.state is PowerState.SWITCH_ON_DISABLED
