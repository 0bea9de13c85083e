"""Which column of a foreign file is which: the column map as a value.

People log with what they have: other names, other units, a voltage that a gain turns into a force, six joints in one
cell. A map says so once, and the same file then serves every recording of that logger.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from frictid_hil.units import parse_quantity

QUANTITIES: dict[str, tuple[str, str]] = {
    "position_rad": ("angle", "length"),
    "velocity_rad_s": ("angular velocity", "speed"),
    "torque_nm": ("torque", "force"),
    "position_command_rad": ("angle", "length"),
    "external_torque_nm": ("torque", "force"),
    "rigid_body_torque_nm": ("torque", "force"),
    "torque_demand_nm": ("torque", "force"),
}
"""Dimension of each column of ``Samples``, on a rotary joint and on a linear axis."""

JOINT = "{joint}"  # stands in a column map for the name of any joint

TIME_UNITS_NS: dict[str, float] = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}


@dataclass(frozen=True, slots=True)
class Source:
    """Where one column comes from: the product of some columns of the file, times a scale."""

    # Names in the file; more than one are multiplied (a constant counts as a column of equal values).
    columns: tuple[str, ...]
    scale: float = 1.0  # factor to the product's SI value, unit and sign included
    offset: float = 0.0  # added after scaling, SI
    index: int | None = None  # for cells that hold a list, which of its values
    # For recordings spread over files, the name of the other file, beside the first and with equal rows.
    file: str | None = None


@dataclass(frozen=True, slots=True)
class JointColumns:
    """The columns of one joint."""

    sources: Mapping[str, Source]  # by the names of ``Samples`` (``position_rad``, ...)
    prismatic: bool = False  # the values are m, m/s, N
    meta: Mapping[str, str | float] = field(default_factory=dict)  # travels with the samples (torque_source, ...)
    command_shift_s: float = 0.0  # later, where the log stamps it too early


@dataclass(frozen=True, slots=True)
class ColumnMap:
    """A foreign file's columns."""

    name: str  # of the map
    # Source of the time; its scale is to nanoseconds. Without a column rows are equally spaced by the scale.
    time: Source
    # By name, in order; ``{joint}`` in a name and its columns stands for every joint that the file has.
    joints: Mapping[str, JointColumns]
    topic: str | None = None  # of a ROS bag that has several


def si_factor(unit: str, column: str, *, prismatic: bool) -> float:
    """What a value in ``unit`` is multiplied by to become the SI value of ``column``.

    Raises:
        UsageError: not a unit of that column's dimension; the message lists those there are.
    """
    return parse_quantity(f"1 {unit}", QUANTITIES[column][prismatic])
