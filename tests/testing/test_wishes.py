"""What a joint is told after a stop: to brake, and to give up its power where it does not come to rest."""

from __future__ import annotations

import pytest

from frictid_hil.config.robot import load_robot
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint
from frictid_hil.protocol.wishes import Do, Wish

CYCLE_NS = 5_000_000


@pytest.fixture
def wish() -> Wish:
    joint = load_robot("mit-bench.yaml").to_setup().joints[0]
    wish = Wish(joint, Feedback())
    wish.feedback.state, wish.feedback.valid, wish.feedback.position_rad = JointState.ENABLED, True, 0.0
    wish.enable(Mode.POSITION)
    return wish


def told_s(wish: Wish, speeds_rad_s: list[float]) -> float:
    """How long it is told to brake while it reports these speeds, one a cycle."""
    cycles = 0
    for speed in speeds_rad_s:
        wish.feedback.velocity_rad_s = speed
        wish.feedback.t_ns += CYCLE_NS
        if wish.order(SetPoint()).do is not Do.BRAKE:
            break
        cycles += 1
    return cycles * CYCLE_NS * 1e-9


def test_a_joint_that_another_sender_moves_after_a_stop_loses_its_power(wish: Wish) -> None:
    """1.4 s were measured beside a Damiao motor: the brake began anew when its power was to be taken."""
    wish.stop()
    assert told_s(wish, [2.0] * 60) == pytest.approx(0.3)
    wish.disable()
    wish.disable()
    assert told_s(wish, [2.0] * 400) == pytest.approx(0.1, abs=0.01)
    assert wish.order(SetPoint()).do is Do.REST


def test_a_joint_that_was_not_stopped_may_brake_for_a_second(wish: Wish) -> None:
    wish.disable()
    assert told_s(wish, [2.0] * 400) == pytest.approx(1.0, abs=0.01)


def test_a_joint_at_rest_loses_its_power_at_once(wish: Wish) -> None:
    wish.stop()
    wish.feedback.velocity_rad_s = 0.0
    wish.disable()
    assert wish.order(SetPoint()).do is Do.REST
