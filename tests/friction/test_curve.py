import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.curve import FrictionCurve

V = np.array([0.2, 0.4, 0.8, 1.6])
F = np.array([5.0, 5.4, 5.9, 6.3])


def curve():
    return FrictionCurve.through(V, F)


def test_passes_through_its_pairs_and_extends_with_the_end_slopes():
    c = curve()
    assert np.allclose(c.torque(V), F)
    assert c.coulomb_nm == pytest.approx(4.6)
    assert c.torque(np.array([0.1]))[0] == pytest.approx(4.8)
    assert c.torque(np.array([3.2]))[0] == pytest.approx(6.3 + 1.6 * 0.5)


def test_is_odd_and_uses_the_speed_to_find_its_section():
    # (9g) as printed has no section for v < 0.
    v = np.linspace(-2, 2, 401)
    c = curve()
    assert np.array_equal(c.torque(v), -c.torque(-v))
    assert c.torque(np.array([-0.4]))[0] == -5.4


def test_rate_part_is_continuous_through_zero():
    c = curve()
    assert np.allclose(c.rate_part(np.array([-1e-9, 0.0, 1e-9])), 0.0, atol=1e-8)


def test_pairs_may_come_in_any_order():
    order = [2, 0, 3, 1]
    assert FrictionCurve.through(V[order], F[order]) == curve()


@pytest.mark.parametrize(
    ("velocity", "torque", "says"),
    [
        ([0.2], [1.0], "at least 2 pairs"),
        ([0.2, 0.2, 0.4], [1.0, 1.1, 1.2], "same mean velocity"),
        ([0.1, 1.0], [-1.0, 1.0], "F_0"),
        ([0.1, np.nan], [1.0, 1.0], "not finite"),
        ([-0.1, 0.2], [1.0, 1.0], "not positive"),
        ([0.1, 0.2], [1.0, 1.0, 1.0], "equal 1-D shapes"),
    ],
)
def test_pairs_that_make_no_curve_are_rejected(velocity, torque, says):
    with pytest.raises(IdentificationError, match=says) as error:
        FrictionCurve.through(np.array(velocity), np.array(torque), where="joint 1")
    assert error.value.where == "joint 1"


@given(
    steps=st.lists(st.floats(0.01, 1.0), min_size=2, max_size=12),
    levels=st.lists(st.floats(3.0, 3.1), min_size=12, max_size=12),
)
def test_every_curve_is_continuous(steps, levels):
    v = np.cumsum(steps)
    try:
        c = FrictionCurve.through(v, np.array(levels[: v.size]))
    except IdentificationError:
        return
    assert np.allclose(c.magnitude(v * (1 - 1e-12)), c.magnitude(v * (1 + 1e-12)), atol=1e-6)
