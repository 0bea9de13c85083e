import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint
from frictid_hil.runner.interlock import Interlock
from frictid_hil.runner.supervisor import JointLimits, Supervisor

LIMITS = JointLimits(-0.1, 0.5, 2.5, 100.0, following_error_rad=0.05, power_w=150.0, torque_s=0.003)


def healthy(**changes: object) -> Feedback:
    report = Feedback(
        position_rad=0.2,
        velocity_rad_s=1.0,
        torque_nm=20.0,
        state=JointState.ENABLED,
        mode=Mode.POSITION,
        status_raw=0x1637,
        valid=True,
    )
    for name, value in changes.items():
        setattr(report, name, value)
    return report


def supervisor() -> Supervisor:
    watching = Supervisor(["0", "1"], [LIMITS, LIMITS], 1000.0)
    watching.watch(0, Mode.POSITION, {1: 0.0})
    return watching


def check(moving: Feedback, locked: Feedback | None = None, command: float = 0.21, times: int = 1) -> None:
    watching = supervisor()
    standing = locked or healthy(position_rad=0.0, velocity_rad_s=0.0)
    for _ in range(times):
        watching.check([SetPoint(command), SetPoint()], [moving, standing])


def test_a_healthy_cycle_passes() -> None:
    check(healthy())


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"position_rad": 0.6}, "outside"),
        ({"position_rad": math.nan}, "outside"),
        ({"velocity_rad_s": -2.6}, "speed"),
        ({"velocity_rad_s": math.nan}, "speed"),
        ({"torque_nm": math.nan}, "torque"),
        ({"torque_nm": 90.0, "velocity_rad_s": 2.0}, "power"),
        ({"error_code": 0x8611}, "0x8611"),
        ({"state": JointState.FAULT}, "fault"),
        ({"state": JointState.DISABLED}, "expected enabled"),
        ({"mode": Mode.TORQUE}, "mode TORQUE"),
        ({"age_cycles": 21}, "no report for 21 cycles"),
        ({"valid": False}, "could not be decoded"),
        ({"position_rad": 0.1}, "following error"),
    ],
)
def test_each_quantity_out_of_bounds_ends_the_motion(changes: dict[str, object], reason: str) -> None:
    with pytest.raises(SafetyAbort, match=reason) as caught:
        check(healthy(**changes))
    assert caught.value.where == "joint 0"


def test_the_following_error_is_judged_against_the_command_in_force() -> None:
    # The set-point is due many ticks later; the controller tells what it follows now.
    check(healthy(position_rad=0.2, position_command_rad=0.21), command=0.4)
    with pytest.raises(SafetyAbort, match="following error"):
        check(healthy(position_rad=0.2, position_command_rad=0.28), command=0.21)


def test_torque_may_spike_but_not_stay() -> None:
    check(healthy(torque_nm=101.0), times=3)
    with pytest.raises(SafetyAbort, match="torque"):
        check(healthy(torque_nm=101.0), times=4)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"position_rad": math.radians(0.3)}, "while locked"),
        ({"position_rad": math.nan}, "while locked"),
        ({"error_code": 1}, "0x0001"),
        ({"age_cycles": 21}, "no report"),
    ],
)
def test_a_locked_joint_that_moves_or_fails_ends_the_motion(changes: dict[str, object], reason: str) -> None:
    standing = replace(healthy(position_rad=0.0, velocity_rad_s=0.0), **changes)  # type: ignore[arg-type]
    with pytest.raises(SafetyAbort, match=reason) as caught:
        check(healthy(), standing)
    assert caught.value.where == "joint 1"


def test_a_decimated_joint_may_be_older() -> None:
    watching = supervisor()
    watching.set_report_interval(1, 10)
    watching.check([SetPoint(0.21), SetPoint()], [healthy(), healthy(position_rad=0.0, age_cycles=30)])
    with pytest.raises(SafetyAbort):
        watching.check([SetPoint(0.21), SetPoint()], [healthy(), healthy(position_rad=0.0, age_cycles=31)])


@pytest.mark.parametrize("cycle_hz", [250.0, 1000.0, 4000.0])
def test_a_bound_lasts_as_long_at_every_rate(cycle_hz: float) -> None:
    limits = replace(LIMITS, torque_s=0.02, silence_s=0.02)
    interlock = Interlock("0", 0)

    def lasting_s(spoil: Callable[[int], Feedback]) -> float:
        watching = Supervisor(["0", "1"], [limits, limits], cycle_hz, interlock)
        watching.watch(0, Mode.POSITION, {1: 0.0})
        still = healthy(position_rad=0.0, velocity_rad_s=0.0)
        watching.arm_interlock([healthy(digital_inputs=1), still])
        for cycle in range(1, 10_000):
            try:
                watching.check([SetPoint(0.21), SetPoint()], [spoil(cycle), still])
            except SafetyAbort:
                return cycle / cycle_hz
        return math.inf

    period_s = 1.0 / cycle_hz
    for allowed_s, spoil in (
        (0.02, lambda _: healthy(torque_nm=101.0, digital_inputs=1)),
        (0.02, lambda cycle: healthy(age_cycles=cycle, digital_inputs=1)),
        (0.1, lambda cycle: healthy(digital_inputs=1, digital_inputs_age_cycles=cycle)),
    ):
        assert lasting_s(spoil) == pytest.approx(allowed_s + period_s)
