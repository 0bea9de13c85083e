"""Samples of one joint: columns of equal length on one clock, with the marks that say what the joint was doing.

Every figure is on the joint side of the gear in rad, rad/s, N m; a prismatic axis uses the same fields for m, m/s, N
and says so by ``prismatic``, which decides the names that files and people see.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from frictid_hil.errors import InputFileError
from frictid_hil.friction.trajectory import Array

Nanoseconds = NDArray[np.int64]
MAY_BE_MISSING = ("external_torque_nm", "temperature_c")


@dataclass(frozen=True, slots=True)
class Mark:
    """A named stretch of run time, half-open: ``[start_ns, end_ns)``."""

    name: str  # ``rehearsal``, ``move``, ``hold``, ``cycles``, ``drift``, ``coupling``, an experiment's name, ...
    start_ns: int
    end_ns: int
    details: Mapping[str, Any] = field(default_factory=dict)  # plain parameters


@dataclass(frozen=True, slots=True)
class Samples:
    """One joint's recording; every column has shape (n,), absent optional columns are None."""

    joint: str
    time_ns: Nanoseconds  # run time, integer nanoseconds, strictly increasing
    position_rad: Array
    velocity_rad_s: Array | None = None  # the drive's own velocity
    torque_nm: Array | None = None  # the drive's own torque, or None (position-only recordings)
    position_command_rad: Array | None = None
    external_torque_nm: Array | None = None  # force sensor
    temperature_c: Array | None = None  # motor or gear
    rigid_body_torque_nm: Array | None = None  # the part of the torque that the user's own rigid-body model explains
    torque_demand_nm: Array | None = None  # the controller's own demand
    marks: tuple[Mark, ...] = ()
    prismatic: bool = False  # the axis is linear: m, m/s, N instead of rad, rad/s, N m
    # Provenance that travels with the columns (torque_source, timing, robot, ...); plain values only.
    meta: Mapping[str, Any] = field(default_factory=dict)

    COLUMNS = (
        "position_rad",
        "velocity_rad_s",
        "torque_nm",
        "position_command_rad",
        "external_torque_nm",
        "temperature_c",
        "rigid_body_torque_nm",
        "torque_demand_nm",
    )

    def __len__(self) -> int:
        return int(self.time_ns.size)

    @property
    def time_s(self) -> Array:
        """Run time in seconds, shape (n,)."""
        return self.time_ns * 1e-9

    @property
    def step_s(self) -> float:
        """Median sampling step."""
        return float(np.median(np.diff(self.time_ns))) * 1e-9

    def columns(self) -> dict[str, Array]:
        """The columns that are present, by name."""
        return {name: column for name in self.COLUMNS if (column := getattr(self, name)) is not None}

    def select(self, keep: NDArray[np.bool_] | slice) -> Samples:
        """The rows chosen by a mask or slice; marks are kept as they are."""
        chosen: dict[str, Any] = {name: column[keep] for name, column in self.columns().items()}
        return replace(self, time_ns=self.time_ns[keep], **chosen)

    def during(self, mark: Mark) -> Samples:
        """The rows inside one mark."""
        return self.select((self.time_ns >= mark.start_ns) & (self.time_ns < mark.end_ns))

    def marked(self, name: str) -> list[Mark]:
        """All marks of that name, in order of time."""
        return [mark for mark in self.marks if mark.name == name]


def checked(samples: Samples, *, where: str = "") -> Samples:
    """The same samples, after the checks every reader owes its user.

    ``InputFileError`` with column and row: no rows, unequal lengths, time not strictly increasing, a value not finite.
    """
    n = len(samples)
    if n < 2:
        raise InputFileError(f"{n} rows of samples; at least 2 are needed", where=where)
    backwards = np.flatnonzero(np.diff(samples.time_ns) <= 0)
    if backwards.size:
        row = int(backwards[0]) + 1
        raise InputFileError(
            f"time does not increase at row {row} ({backwards.size} such rows)",
            where=where,
            cause="rows reordered, or two recordings joined",
        )
    for name, column in samples.columns().items():
        if column.shape != (n,):
            raise InputFileError(f"column {name} has {column.size} values for {n} times", where=where)
        bad = np.flatnonzero(~np.isfinite(column))
        if bad.size and name not in MAY_BE_MISSING:
            raise InputFileError(
                f"column {name} has {bad.size} values that are not finite, the first at row {int(bad[0])}",
                where=where,
            )
    return samples
