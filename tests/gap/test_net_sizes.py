"""What counts of causes that take one another back."""

from __future__ import annotations

import numpy as np
import pytest

from frictid_hil.gap.findings import _forms, _net


def net(parts: list[list[float]], beliefs: list[bool]) -> np.ndarray:
    """RMS that counts of each part, (n,), where parts are what causes make at some moments; the first scales all."""
    made = np.array(parts)
    wholes = np.arange(len(parts)) == 0
    sizes, _ = _net(made @ made.T / made.shape[1], np.full(len(parts), 0.1), np.array(beliefs), wholes)
    return sizes


def test_errors_that_only_all_together_cancel_count_for_what_they_leave() -> None:
    scale, gravity, friction = [-1.0, -1.0, 0.1, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]
    assert net([scale, gravity, friction], [True] * 3) == pytest.approx([0.0, 0.0, 0.0], abs=0.02)
    # No pair of them cancels by half, so that as causes of other kinds they count in full.
    assert net([scale, gravity, friction], [False] * 3) == pytest.approx([0.71, 0.5, 0.5], abs=0.02)


def test_what_a_torque_constant_makes_of_friction_no_gravity_takes_back() -> None:
    scale, gravity, friction = [-1.0, -1.0, 0.0, 0.0], [3.0, 0.0, 0.0, 0.0], [0.0, 0.02, 0.0, 0.0]
    # Along the torque constant as a whole, the gravity takes all of it back.
    assert net([scale, gravity, friction], [True] * 3) == pytest.approx([0.5, 1.0, 0.0], abs=0.02)


def test_an_error_of_the_belief_takes_nothing_back_from_a_cause() -> None:
    cause, error = [1.0, 0.0, 0.0, 0.0], [-1.0, 1.0, 0.0, 0.0]
    assert net([cause, error], [False, True]) == pytest.approx([0.5, 0.71], abs=0.01)


def test_errors_that_add_count_for_their_own_size() -> None:
    assert net([[1.0, 0.0], [1.0, 1.0]], [True, True]) == pytest.approx([0.71, 1.0], abs=0.01)


def test_only_lines_over_position_are_taken_for_lines_over_position() -> None:
    forms = _forms(["direction_asymmetry", "torque_ripple", "stribeck"])
    assert forms[1] == pytest.approx([0.02, 0.1, 0.02]), "what the others, and itself, may put on a ripple"
    assert forms[0] == pytest.approx([0.1, 0.1, 0.1])
