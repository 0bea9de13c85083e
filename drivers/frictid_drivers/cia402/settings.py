"""The settings of a robot file that this driver reads, checked before anything is opened.

docs/reference/canopen-settings.md has the usual values.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from frictid_drivers.cia402.objects import Entry, Object
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.can_bus import DEFAULT_BITRATE, DEFAULT_DATA_BITRATE, FORWARDED
from frictid_hil.protocol.can_load import BitRates
from frictid_hil.protocol.driver import Timing, unknown_options


@dataclass(frozen=True, slots=True)
class BusSettings:
    """Of the whole bus."""

    bitrate: int  # bit/s
    data_bitrate: int | None  # bit/s of the data of CAN FD frames; None on a classical bus
    pdo_bytes: int  # how long the drives' PDOs may be
    sdo_timeout_s: float  # how long a drive may take to answer
    watchdog_ms: int  # the drive stops when our heartbeat is missing for this long (1016)
    drive_heartbeat_ms: int  # heartbeat period of the drives (1017)
    host_node: int  # our own node id
    reply_window: float  # share of the cycle in which reports must have come
    allow_torque_without_watchdog: bool  # torque modes on drives without 1016 and 6007
    quick_stop_option: int  # 605A: 5, 6 or 7 (stop and hold)
    abort_option: int  # 6007: 2 (disable voltage) or 3 (quick stop)

    @property
    def rates(self) -> BitRates:
        """Of the bus; its data rate only where PDOs are CAN FD frames."""
        return BitRates(self.bitrate, self.data_bitrate)

    @property
    def host_heartbeat_s(self) -> float:
        """Three of our heartbeats fit into the drives' patience."""
        return self.watchdog_ms / 3000.0

    @property
    def drive_timeout_s(self) -> float:
        """Our own patience."""
        return self.drive_heartbeat_ms * 2.5e-3


@dataclass(frozen=True, slots=True)
class JointSettings:
    """Of one joint."""

    following_window_rad: float  # 6065 of the joint that moves
    locked_window_rad: float  # 6065 of joints that stand locked
    following_timeout_ms: int  # 6066
    standstill_rad_s: float  # speed below which the joint stands
    external_torque_object: Entry | None  # force sensor, e.g. ``"2030:00 i32"``
    external_torque_nm_per_unit: float  # what its unit is worth, joint side
    temperature_object: Entry | None  # e.g. ``"2031:00 i16"``
    temperature_c_per_unit: float  # what its unit is worth
    digital_inputs: bool  # 60FD is reported at least every 10 ms (an interlock hangs there)
    torque_source: str  # what the reported torque is, for the profile
    timing: Timing | None
    fd_object: Object | None  # 1 makes the drive's PDOs CAN FD frames, 0 not
    eds: Path | None = None  # the maker's EDS file: what can be written and mapped (check)
    raise_torque_limit: bool = False  # 6072 may be raised to the robot file's ``max_torque_nm``
    widen_position_limits: bool = False  # 607D may be widened to the robot file's limits


BUS_OPTIONS = frozenset({one.name for one in fields(BusSettings)} | {"fd", "faults", *FORWARDED})
_OVERRIDES = ("position_units_per_revolution", "velocity_unit_rad_s")
JOINT_OPTIONS = frozenset({one.name for one in fields(JointSettings)} | {*_OVERRIDES, "rated_torque_side"})
_DELAYS = ("position_delay_s", "velocity_delay_s", "torque_delay_s", "torque_lag_s", "uncertainty_s")


def read_settings(setup: RobotSetup) -> tuple[BusSettings, dict[str, JointSettings]]:
    """Check and read all options; ``InvalidFields`` with every option or node id that is wrong."""
    problems: list[FieldProblem] = []
    bus = _bus(_Options(setup.options, BUS_OPTIONS, ("options",), problems))
    joints = {
        joint.name: _joint(
            _Options(joint.options, JOINT_OPTIONS, ("joints", joint.name, "options"), problems), setup.folder
        )
        for joint in setup.joints
    }
    problems += _node_problems(setup.joints, bus.host_node)
    if problems:
        raise InvalidFields(problems)
    return bus, joints


class _Options:
    """Options of the robot or of one joint; what is wrong with them is gathered."""

    def __init__(
        self, given: Mapping[str, Any], known: Collection[str], at: tuple[str, ...], problems: list[FieldProblem]
    ) -> None:
        self.given, self._at, self._problems = given, at, problems
        problems += unknown_options(given, known, at, "cia402")

    def problem(self, key: str, message: str) -> None:
        self._problems.append(FieldProblem((*self._at, key), message))

    def number(self, key: str, default: float | None, low: float, high: float) -> float:
        value = self.given.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            self.problem(key, f"expected a number {low:g}..{high:g}, found {value!r}")
            return low
        return float(value)

    def whole(self, key: str, default: int, low: int, high: int) -> int:
        value = self.given.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self.problem(key, f"expected a whole number {low}..{high}, found {value!r}")
            return default
        return value

    def flag(self, key: str) -> bool:
        value = self.given.get(key, False)
        if not isinstance(value, bool):
            self.problem(key, f"expected true or false, found {value!r}")
        return value is True

    def file(self, key: str, folder: Path | None) -> Path | None:
        if (text := self.given.get(key)) is None:
            return None
        path = (folder or Path()) / str(text)
        if not path.is_file():
            self.problem(key, f"no such file: {path}")
            return None
        return path

    def reported(self, meaning: str, unit: str) -> tuple[Entry | None, float]:
        """An object that drives report, and what its unit is worth."""
        key = f"{meaning}_object"
        if (text := self.given.get(key)) is None:
            return None, math.nan
        try:
            entry = Entry.parse(f"{text} {meaning}")
        except ValueError as error:
            self.problem(key, str(error))
            return None, math.nan
        if entry.type.bits not in (8, 16, 32):
            self.problem(key, f"expected 8, 16 or 32 bits, found {entry.type}")
        return entry, self.number(f"{meaning}_{unit}", None, -1e9, 1e9)

    def fd_object(self) -> Object | None:
        if (text := self.given.get("fd_object")) is None:
            return None
        try:
            entry = Entry.parse(str(text))
        except ValueError:
            self.problem("fd_object", f"expected an object such as '2023:00 u8', found {text!r}")
            return None
        return Object(entry.index, entry.sub, entry.type, "frames of its PDOs: 0 classical, 1 CAN FD")

    def timing(self) -> Timing | None:
        if (given := self.given.get("timing")) is None:
            return None
        if not isinstance(given, Mapping) or not set(given) <= set(_DELAYS):
            self.problem("timing", f"expected a mapping of {', '.join(_DELAYS)}")
            return None
        inner = _Options(given, _DELAYS, (*self._at, "timing"), self._problems)
        values = {key: inner.number(key, 0.0, -1.0, 1.0) for key in _DELAYS if key in given}
        if not 0.0 <= values.get("torque_lag_s", 0.0) <= max(values.get("torque_delay_s", 0.0), 0.0):
            inner.problem("torque_lag_s", "is the part of torque_delay_s that is a low-pass, 0 or more")
        return Timing(**values, torque_beats=False, source="robot file")

    def fd(self, bitrate: int) -> tuple[int | None, int]:
        """Data bit rate and length of PDOs: None and 8 on a classical bus."""
        if self.flag("fd"):
            data_bitrate = self.whole("data_bitrate", max(DEFAULT_DATA_BITRATE, bitrate), 10_000, 8_000_000)
            if data_bitrate < bitrate:
                self.problem("data_bitrate", f"{data_bitrate} is below the bitrate of arbitration, {bitrate}")
            return data_bitrate, self.whole("pdo_bytes", 64, 8, 64)
        for key in ("data_bitrate", "pdo_bytes"):
            if key in self.given:
                self.problem(key, "means nothing without `fd: true`: classical CAN has one bit rate and 8 bytes")
        return None, 8


def _bus(options: _Options) -> BusSettings:
    bitrate = options.whole("bitrate", DEFAULT_BITRATE, 10_000, 1_000_000)
    data_bitrate, pdo_bytes = options.fd(bitrate)
    return BusSettings(
        bitrate=bitrate,
        data_bitrate=data_bitrate,
        pdo_bytes=pdo_bytes,
        sdo_timeout_s=options.number("sdo_timeout_s", 0.5, 0.01, 60.0),
        watchdog_ms=options.whole("watchdog_ms", 150, 20, 1000),
        drive_heartbeat_ms=options.whole("drive_heartbeat_ms", 100, 10, 1000),
        host_node=options.whole("host_node", 127, 1, 127),
        reply_window=options.number("reply_window", 0.7, 0.1, 0.95),
        allow_torque_without_watchdog=options.flag("allow_torque_without_watchdog"),
        quick_stop_option=options.whole("quick_stop_option", 6, 5, 7),
        abort_option=options.whole("abort_option", 3, 2, 3),
    )


def _joint(options: _Options, folder: Path | None) -> JointSettings:
    for key in _OVERRIDES:  # what ``scale_of`` takes instead of the drive's own word
        if key in options.given:
            options.number(key, None, 1e-12, 1e15)
    side = options.given.get("rated_torque_side", "motor")
    if side not in ("motor", "joint"):
        options.problem("rated_torque_side", f"expected motor or joint, found {side!r}")
    external, external_unit = options.reported("external_torque", "nm_per_unit")
    temperature, temperature_unit = options.reported("temperature", "c_per_unit")
    return JointSettings(
        following_window_rad=options.number("following_window_rad", 0.12, 1e-4, math.pi),
        locked_window_rad=options.number("locked_window_rad", 0.009, 1e-5, 0.5),
        following_timeout_ms=options.whole("following_timeout_ms", 20, 0, 10_000),
        standstill_rad_s=options.number("standstill_rad_s", 0.02, 1e-4, 1.0),
        external_torque_object=external,
        external_torque_nm_per_unit=external_unit,
        temperature_object=temperature,
        temperature_c_per_unit=temperature_unit,
        digital_inputs=options.flag("digital_inputs"),
        torque_source=str(options.given.get("torque_source", "6077 actual torque")),
        timing=options.timing(),
        fd_object=options.fd_object(),
        eds=options.file("eds", folder),
        raise_torque_limit=options.flag("raise_torque_limit"),
        widen_position_limits=options.flag("widen_position_limits"),
    )


def _node_problems(joints: Collection[JointSetup], host_node: int) -> list[FieldProblem]:
    seen, problems = {host_node: "the host itself (options.host_node)"}, []
    for joint in joints:
        at = ("joints", joint.name, "node")
        if not 1 <= joint.address <= 127:
            problems.append(FieldProblem(at, f"expected a node id 1..127, found {joint.address}"))
        elif joint.address in seen:
            problems.append(FieldProblem(at, f"node {joint.address} is already used by {seen[joint.address]}"))
        seen.setdefault(joint.address, f"joint {joint.name}")
    return problems
