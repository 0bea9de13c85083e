"""The settings of a robot file that this driver reads, checked before anything is opened.

======================================  ========  =====================================================================
options (robot)                         default   meaning
======================================  ========  =====================================================================
bitrate                                 1000000   bit/s; also the base of the bus load
fd                                      false     PDOs are CAN FD frames with bit-rate switch, all else classical
data_bitrate                            2000000   bit/s of the data of CAN FD frames
pdo_bytes                               64        how long the drives' PDOs may be where they are CAN FD frames
sdo_timeout_s                           0.5       how long a drive may take to answer
watchdog_ms                             150       the drive stops when our heartbeat is missing for this long (1016)
drive_heartbeat_ms                      100       heartbeat period of the drives (1017); 2.5 of it missing is a stop
host_node                               127       our own node id
reply_window                            0.7       share of the cycle in which reports must have come
allow_torque_without_watchdog           false     torque modes on drives without 1016 and 6007
quick_stop_option                       6         605A: 5, 6 or 7 (stop and hold)
abort_option                            3         6007: 2 (disable voltage) or 3 (quick stop)
faults                                  -         on a bus ``faulty:INTERFACE:CHANNEL``: what goes wrong on it
tty_baudrate, port, host, tcp_tune, ... -         handed to the python-can interface as they are (``network.FORWARDED``)
======================================  ========  =====================================================================

======================================  ========  =====================================================================
options (joint)                         default   meaning
======================================  ========  =====================================================================
following_window_rad                    0.12      6065 of the joint that moves
locked_window_rad                       0.009     6065 of joints that stand locked
following_timeout_ms                    20        6066
standstill_rad_s                        0.02      speed below which the joint stands
external_torque_object                  -         force sensor, e.g. ``"2030:00 i32"``
external_torque_nm_per_unit             -         what its unit is worth, joint side
temperature_object                      -         e.g. ``"2031:00 i16"``
temperature_c_per_unit                  -         what its unit is worth
digital_inputs                          false     60FD is reported at least every 10 ms (an interlock hangs there)
position_units_per_revolution           -         of the joint; where 6092 and 608F do not tell
velocity_unit_rad_s                     -         joint side; where 60A9 does not tell
rated_torque_side                       motor     6076 is ``motor`` or ``joint`` side
torque_source                           -         what the reported torque is, for the profile
timing                                  -         position_delay_s, velocity_delay_s, torque_delay_s, uncertainty_s;
                                                  torque_lag_s: what of torque_delay_s is a low-pass
eds                                     -         the maker's EDS file: what can be written and mapped (check)
raise_torque_limit                      false     6072 may be raised to the robot file's ``max_torque_nm``
widen_position_limits                   false     607D may be widened to the robot file's limits
fd_object                               -         e.g. ``"2023:00 u8"``: 1 makes the drive's PDOs CAN FD frames, 0 not
======================================  ========  =====================================================================
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictid_drivers.cia402.entry import Entry
from frictid_drivers.cia402.objects import Object
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.can_bus import DEFAULT_BITRATE, DEFAULT_DATA_BITRATE, FORWARDED
from frictid_hil.protocol.can_load import BitRates
from frictid_hil.protocol.driver import Timing, unknown_options

BUS_OPTIONS = frozenset(
    {
        "bitrate",
        "fd",
        "data_bitrate",
        "pdo_bytes",
        "sdo_timeout_s",
        "watchdog_ms",
        "drive_heartbeat_ms",
        "host_node",
        "reply_window",
        "allow_torque_without_watchdog",
        "quick_stop_option",
        "abort_option",
        "faults",
        *FORWARDED,
    }
)
JOINT_OPTIONS = frozenset(
    {
        "following_window_rad",
        "locked_window_rad",
        "following_timeout_ms",
        "standstill_rad_s",
        "external_torque_object",
        "external_torque_nm_per_unit",
        "temperature_object",
        "temperature_c_per_unit",
        "digital_inputs",
        "position_units_per_revolution",
        "velocity_unit_rad_s",
        "rated_torque_side",
        "torque_source",
        "timing",
        "fd_object",
        "eds",
        "raise_torque_limit",
        "widen_position_limits",
    }
)


@dataclass(frozen=True, slots=True)
class BusSettings:
    """Robot-wide settings; see the module's table."""

    bitrate: int
    data_bitrate: int | None
    pdo_bytes: int
    sdo_timeout_s: float
    watchdog_ms: int
    drive_heartbeat_ms: int
    host_node: int
    reply_window: float
    allow_torque_without_watchdog: bool
    quick_stop_option: int
    abort_option: int

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
    """Settings of one joint; see the module's table."""

    following_window_rad: float
    locked_window_rad: float
    following_timeout_ms: int
    standstill_rad_s: float
    external_torque: Entry | None
    external_torque_nm_per_unit: float
    temperature: Entry | None
    temperature_c_per_unit: float
    digital_inputs: bool
    torque_source: str
    timing: Timing | None
    fd_object: Object | None
    eds: Path | None = None
    raise_torque_limit: bool = False
    widen_position_limits: bool = False


def read_settings(setup: RobotSetup) -> tuple[BusSettings, dict[str, JointSettings]]:
    """Check and read all options.

    Raises:
        InvalidFields: every option or node id that is wrong.
    """
    reader = _Reader(setup.folder)
    bus = reader.bus(setup.options)
    joints = {joint.name: reader.joint(joint) for joint in setup.joints}
    reader.nodes(setup, bus.host_node)
    if reader.problems:
        raise InvalidFields(reader.problems)
    return bus, joints


class _Reader:
    def __init__(self, folder: Path | None) -> None:
        self.problems: list[FieldProblem] = []
        self._folder = folder

    def bus(self, options: Mapping[str, Any]) -> BusSettings:
        at: tuple[str, ...] = ("options",)
        self.problems += unknown_options(options, BUS_OPTIONS, at, "cia402")
        bitrate = self._whole(at, options, "bitrate", DEFAULT_BITRATE, 10_000, 1_000_000)
        data_bitrate, pdo_bytes = self._fd(at, options, bitrate)
        return BusSettings(
            bitrate=bitrate,
            data_bitrate=data_bitrate,
            pdo_bytes=pdo_bytes,
            sdo_timeout_s=self._number(at, options, "sdo_timeout_s", 0.5, 0.01, 60.0),
            watchdog_ms=self._whole(at, options, "watchdog_ms", 150, 20, 1000),
            drive_heartbeat_ms=self._whole(at, options, "drive_heartbeat_ms", 100, 10, 1000),
            host_node=self._whole(at, options, "host_node", 127, 1, 127),
            reply_window=self._number(at, options, "reply_window", 0.7, 0.1, 0.95),
            allow_torque_without_watchdog=self._flag(at, options, "allow_torque_without_watchdog"),
            quick_stop_option=self._whole(at, options, "quick_stop_option", 6, 5, 7),
            abort_option=self._whole(at, options, "abort_option", 3, 2, 3),
        )

    def _fd(self, at: tuple[str, ...], options: Mapping[str, Any], bitrate: int) -> tuple[int | None, int]:
        """Data bit rate and length of PDOs: None and 8 on a classical bus."""
        if self._flag(at, options, "fd"):
            default = max(DEFAULT_DATA_BITRATE, bitrate)
            data_bitrate = self._whole(at, options, "data_bitrate", default, 10_000, 8_000_000)
            if data_bitrate < bitrate:
                self._problem((*at, "data_bitrate"), f"{data_bitrate} is below the bitrate of arbitration, {bitrate}")
            return data_bitrate, self._whole(at, options, "pdo_bytes", 64, 8, 64)
        for key in ("data_bitrate", "pdo_bytes"):
            if key in options:
                self._problem(
                    (*at, key), "means nothing without `fd: true`: classical CAN has one bit rate and 8 bytes"
                )
        return None, 8

    def joint(self, joint: JointSetup) -> JointSettings:
        options = joint.options
        at = ("joints", joint.name, "options")
        self.problems += unknown_options(options, JOINT_OPTIONS, at, "cia402")
        self._overrides(at, options)
        external, external_unit = self._object(at, options, "external_torque", "nm_per_unit")
        temperature, temperature_unit = self._object(at, options, "temperature", "c_per_unit")
        return JointSettings(
            following_window_rad=self._number(at, options, "following_window_rad", 0.12, 1e-4, math.pi),
            locked_window_rad=self._number(at, options, "locked_window_rad", 0.009, 1e-5, 0.5),
            following_timeout_ms=self._whole(at, options, "following_timeout_ms", 20, 0, 10_000),
            standstill_rad_s=self._number(at, options, "standstill_rad_s", 0.02, 1e-4, 1.0),
            external_torque=external,
            external_torque_nm_per_unit=external_unit,
            temperature=temperature,
            temperature_c_per_unit=temperature_unit,
            digital_inputs=self._flag(at, options, "digital_inputs"),
            torque_source=str(options.get("torque_source", "6077 actual torque")),
            timing=self._timing(at, options),
            fd_object=self._fd_object(at, options),
            eds=self._file(at, options, "eds"),
            raise_torque_limit=self._flag(at, options, "raise_torque_limit"),
            widen_position_limits=self._flag(at, options, "widen_position_limits"),
        )

    def nodes(self, setup: RobotSetup, host_node: int) -> None:
        seen = {host_node: "the host itself (options.host_node)"}
        for joint in setup.joints:
            if not 1 <= joint.address <= 127:
                self._problem(("joints", joint.name, "node"), f"expected a node id 1..127, found {joint.address}")
            elif joint.address in seen:
                self._problem(
                    ("joints", joint.name, "node"), f"node {joint.address} is already used by {seen[joint.address]}"
                )
            seen.setdefault(joint.address, f"joint {joint.name}")

    def _overrides(self, at: tuple[str, ...], options: Mapping[str, Any]) -> None:
        """What ``facts.scale_of`` takes instead of the drive's own word."""
        for key in ("position_units_per_revolution", "velocity_unit_rad_s"):
            if key in options:
                self._number(at, options, key, None, 1e-12, 1e15)
        side = options.get("rated_torque_side", "motor")
        if side not in ("motor", "joint"):
            self._problem((*at, "rated_torque_side"), f"expected motor or joint, found {side!r}")

    def _timing(self, at: tuple[str, ...], options: Mapping[str, Any]) -> Timing | None:
        given = options.get("timing")
        if given is None:
            return None
        known = ("position_delay_s", "velocity_delay_s", "torque_delay_s", "torque_lag_s", "uncertainty_s")
        if not isinstance(given, Mapping) or not set(given) <= set(known):
            self._problem((*at, "timing"), f"expected a mapping of {', '.join(known)}")
            return None
        here = (*at, "timing")
        values = {key: self._number(here, given, key, 0.0, -1.0, 1.0) for key in known if key in given}
        if not 0.0 <= values.get("torque_lag_s", 0.0) <= max(values.get("torque_delay_s", 0.0), 0.0):
            self._problem((*here, "torque_lag_s"), "is the part of torque_delay_s that is a low-pass, 0 or more")
        return Timing(**values, source="robot file")

    def _fd_object(self, at: tuple[str, ...], options: Mapping[str, Any]) -> Object | None:
        text = options.get("fd_object")
        if text is None:
            return None
        try:
            entry = Entry.parse(str(text))
        except ValueError:
            self._problem((*at, "fd_object"), f"expected an object such as '2023:00 u8', found {text!r}")
            return None
        return Object(entry.index, entry.sub, entry.type, "frames of its PDOs: 0 classical, 1 CAN FD")

    def _object(
        self, at: tuple[str, ...], options: Mapping[str, Any], meaning: str, unit: str
    ) -> tuple[Entry | None, float]:
        text = options.get(f"{meaning}_object")
        if text is None:
            return None, math.nan
        try:
            entry = Entry.parse(f"{text} {meaning}")
        except ValueError as error:
            self._problem((*at, f"{meaning}_object"), str(error))
            return None, math.nan
        if entry.type.bits not in (8, 16, 32):
            self._problem((*at, f"{meaning}_object"), f"expected 8, 16 or 32 bits, found {entry.type}")
        return entry, self._number(at, options, f"{meaning}_{unit}", None, -1e9, 1e9)

    def _number(
        self, at: tuple[str, ...], options: Mapping[str, Any], key: str, default: float | None, low: float, high: float
    ) -> float:
        value = options.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            self._problem((*at, key), f"expected a number {low:g}..{high:g}, found {value!r}")
            return low
        return float(value)

    def _whole(
        self, at: tuple[str, ...], options: Mapping[str, Any], key: str, default: int, low: int, high: int
    ) -> int:
        value = options.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self._problem((*at, key), f"expected a whole number {low}..{high}, found {value!r}")
            return default
        return value

    def _file(self, at: tuple[str, ...], options: Mapping[str, Any], key: str) -> Path | None:
        text = options.get(key)
        if text is None:
            return None
        path = (self._folder or Path()) / str(text)
        if not path.is_file():
            self._problem((*at, key), f"no such file: {path}")
            return None
        return path

    def _flag(self, at: tuple[str, ...], options: Mapping[str, Any], key: str) -> bool:
        value = options.get(key, False)
        if not isinstance(value, bool):
            self._problem((*at, key), f"expected true or false, found {value!r}")
            return False
        return value

    def _problem(self, path: tuple[str | int, ...], message: str) -> None:
        self.problems.append(FieldProblem(path, message))
