import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from frictid_hil.errors import UsageError
from frictid_hil.units import format_duration, parse_quantity


@pytest.mark.parametrize(
    ("text", "dimension", "expected"),
    [
        ("20deg", "angle", math.radians(20)),
        ("115 deg/s", "angular velocity", math.radians(115)),
        ("2rad/s", "angular velocity", 2.0),
        ("1e-3rad", "angle", 1e-3),
        ("500ms", "duration", 0.5),
        ("175Nm/deg", "stiffness", 175 * 180 / math.pi),
        ("-.5N m", "torque", -0.5),
    ],
)
def test_typed_quantities(text: str, dimension: str, expected: float) -> None:
    assert parse_quantity(text, dimension) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("text", ["20", "20 deg/s", "deg", "", "nan deg", "1e999deg", "20degs", "２０deg"])
def test_an_angle_without_its_own_unit_is_refused(text: str) -> None:
    with pytest.raises(UsageError):
        parse_quantity(text, "angle")


def test_the_refusal_lists_the_units_there_are() -> None:
    with pytest.raises(UsageError, match="has no unit; angle takes deg, rad, mrad"):
        parse_quantity("20", "angle")


@pytest.mark.slow
@given(st.text(max_size=20))
def test_any_text_gives_a_finite_number_or_a_usage_error(text: str) -> None:
    with contextlib.suppress(UsageError):
        assert math.isfinite(parse_quantity(text, "angle"))


def test_durations_read_well() -> None:
    assert format_duration(96.04) == "96.0 s"
    assert format_duration(125) == "2 min 05 s"
