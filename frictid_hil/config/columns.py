"""Column maps: the file that says which column of a foreign recording is which. ``schema: frictid.columns/1``.

A joint named ``{joint}`` stands for all of a file whose columns follow one form: ``{column: "q_{joint}", unit: rad}``.
A torque of ``unit: A`` is a motor current: ``torque_constant_nm_per_a`` (times ``gear_ratio``) makes it a torque, and
``torque_constant_sigma`` says how sure that is, relative.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from frictid_hil.columns import QUANTITIES, TIME_UNITS_NS, ColumnMap, JointColumns, Source, si_factor
from frictid_hil.config.schema import Names, Strict, schema_version, validated
from frictid_hil.config.search import find
from frictid_hil.config.yaml import read
from frictid_hil.errors import FieldProblem, UsageError

CURRENTS_A = {"A": 1.0, "mA": 1e-3}
KIND = "frictid.columns"
NEWEST = 1


class TimeFile(Strict):
    """The column of time, or the rate at which rows were taken where there is none."""

    column: str | None = None  # its name
    unit: Literal["s", "ms", "us", "ns"] = "s"  # of the column
    rate_hz: float | None = Field(default=None, gt=0)  # rows a second, in place of a column

    @model_validator(mode="after")
    def _one_way(self) -> TimeFile:
        if (self.column is None) == (self.rate_hz is None):
            raise ValueError("give either `column` with its `unit`, or `rate_hz`")
        return self

    @property
    def source(self) -> Source:
        """The source as a plain value."""
        if self.column is None:
            return Source((), 1e9 / (self.rate_hz or 1.0))
        return Source((self.column,), TIME_UNITS_NS[self.unit])


class SourceFile(Strict):
    """Where one quantity comes from."""

    column: str | None = None  # name of the only column
    product: Names | None = Field(default=None, min_length=2)  # names of columns (or constants) to be multiplied
    unit: str  # of the column or product, before ``scale``
    scale: float = 1.0  # further factor; -1 turns the sign
    offset: float = 0.0  # added last, in the SI unit
    index: int | None = Field(default=None, ge=0)  # for cells that hold a list, which of its values, from 0
    # name of the file beside the first that has this column; at other times, its last value before each counts
    file: str | None = Field(default=None, pattern=r"^[^/\\]+$")
    shift_s: float = 0.0  # of a command that is stamped too early, how much later it was
    torque_constant_nm_per_a: float | None = Field(default=None, gt=0)  # of the motor, for a torque in A
    torque_constant_sigma: float | None = Field(default=None, gt=0, lt=1)  # one standard deviation of it, relative
    gear_ratio: float = Field(default=1.0, gt=0)  # between that motor and the joint

    @model_validator(mode="after")
    def _one_way(self) -> SourceFile:
        if (self.column is None) == (self.product is None):
            raise ValueError("give either `column` or `product`")
        if self.index is not None and self.product is not None:
            raise ValueError("`index` is for a single `column`")
        if (self.unit in CURRENTS_A) != (self.torque_constant_nm_per_a is not None):
            raise ValueError("a torque in A (mA) needs `torque_constant_nm_per_a`, and nothing else does")
        if self.scale == 0:
            raise ValueError("`scale: 0` leaves nothing of the column")
        return self


class JointFile(Strict):
    """One joint's columns. Each says its own unit. ``torque`` or ``position_command`` is required."""

    prismatic: bool = False  # a linear axis, in m and N
    meta: dict[str, str | float] = Field(default_factory=dict)  # remarks for the profile, such as ``torque_source``
    position: SourceFile  # measured
    velocity: SourceFile | None = None  # measured; without it the position is differenced
    torque: SourceFile | None = None  # measured or commanded, or a motor current
    position_command: SourceFile | None = None  # what the position loop was told
    external_torque: SourceFile | None = None  # of a force sensor
    rigid_body_torque: SourceFile | None = None  # what your own model of the rigid bodies explains
    torque_demand: SourceFile | None = None  # what the controller demanded, for the diagnosis

    @model_validator(mode="after")
    def _something_to_explain(self) -> JointFile:
        if self.torque is None and self.position_command is None:
            raise ValueError("give at least one of `torque` and `position_command`")
        return self


class ColumnsFile(Strict):
    """Which column of a foreign recording is which."""

    schema_: str = Field(alias="schema")  # ``frictid.columns/1``
    name: str  # of the map
    topic: str | None = None  # of a bag in which several hold joint states
    time: TimeFile  # the column of time, or the rate
    # by name; ``"{joint}"`` stands for all whose columns follow one form
    joints: dict[str, JointFile] = Field(min_length=1)


_QUANTITY_OF = {re.sub("_(rad|rad_s|nm)$", "", quantity): quantity for quantity in QUANTITIES}
"""By the name in the file, which leaves out the unit."""


def load_columns(name: str | Path) -> ColumnMap:
    """Read and check a column map: a path, or one on the search path (``ConfigError``: all problems, their places)."""
    document = read(find(name, folder="columns", what="column map"))
    schema_version(document, KIND, NEWEST)
    file = validated(document, ColumnsFile)
    joints: dict[str, JointColumns] = {}
    problems: list[FieldProblem] = []
    for joint, columns in file.joints.items():
        sources: dict[str, Source] = {}
        for name_here, quantity in _QUANTITY_OF.items():
            source: SourceFile | None = getattr(columns, name_here)
            if source is None:
                continue
            try:
                sources[quantity] = _source(source, quantity, prismatic=columns.prismatic)
            except UsageError as error:
                problems.append(FieldProblem(("joints", joint, name_here, "unit"), error.what))
        command, torque = columns.position_command, columns.torque
        meta = dict(columns.meta)
        if torque is not None and torque.torque_constant_sigma is not None:
            meta["torque_constant_sigma"] = torque.torque_constant_sigma
        joints[joint] = JointColumns(sources, columns.prismatic, meta, command.shift_s if command else 0.0)
    if problems:
        raise document.error(problems)
    return ColumnMap(file.name, file.time.source, joints, file.topic)


def _source(source: SourceFile, quantity: str, *, prismatic: bool) -> Source:
    if source.torque_constant_nm_per_a is not None and quantity == "torque_nm":
        unit = CURRENTS_A[source.unit] * source.torque_constant_nm_per_a * source.gear_ratio
    else:
        unit = si_factor(source.unit, quantity, prismatic=prismatic)
    return Source(
        columns=source.product or (str(source.column),),
        scale=unit * source.scale,
        offset=source.offset,
        index=source.index,
        file=source.file,
    )
