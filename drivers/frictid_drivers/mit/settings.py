"""Options of the robot file for MIT-mode actuators.

::

    driver: mit
    options: {watchdog_ms: 100}        # of the whole bus; also bitrate, fd, data_bitrate and what else python-can takes
    joints:
      "0":
        id: 1                          # the motor's own (Damiao: ESC_ID)
        options: {model: DM-J4310, kp: 100, kd: 2}
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from frictid_drivers.mit.families import FAMILIES, Damiao, Family, Motor
from frictid_drivers.mit.models import MODELS
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.can_bus import DEFAULT_DATA_BITRATE
from frictid_hil.protocol.can_load import BitRates
from frictid_hil.protocol.driver import FD_FRAME, number_option, unknown_options

BUS_OPTIONS = frozenset(
    {"bitrate", "tty_baudrate", "sleep_after_open", "port", "app_name", "serial", "index", "host", "tcp_tune"}
    | {"watchdog_ms", "allow_torque_without_watchdog", "reply_window", "fd", "data_bitrate"}
)
JOINT_OPTIONS = frozenset({"model", "protocol", "kp", "kd", "brake_kd", "reply_id", "torque_delay_s"})

_PROTOCOLS = {
    "damiao": ("damiao",),
    "robstride": ("robstride", "robstride-mit", "cybergear"),
    "cubemars": ("cubemars",),
}


@dataclass(frozen=True, slots=True)
class BusSettings:
    """Of the whole bus."""

    rates: BitRates
    watchdog_s: float
    allow_torque_without_watchdog: bool  # torque mode also where nothing stops the motor when the host dies
    reply_window: float  # share of a cycle that answers are waited for
    tty_baudrate: int  # of a serial adapter's real UART; 0 where there is none


@dataclass(frozen=True, slots=True)
class JointSettings:
    """Of one joint."""

    model: str  # as the catalogue has it
    family: Family
    motor: Motor
    kp: float  # stiffness of position control, N m/rad
    kd: float  # damping of position and velocity control, N m s/rad
    brake_kd: float  # damping of a quick stop
    torque_delay_s: float  # by how much the reported torque is late, where somebody measured it


def read_settings(setup: RobotSetup) -> tuple[BusSettings, dict[str, JointSettings]]:
    """All options, checked; ``InvalidFields`` with every one that is unknown or impossible."""
    problems = unknown_options(setup.options, BUS_OPTIONS, ("options",), "mit")
    data_bitrate = _data_bitrate(setup.options, problems)
    joints: dict[str, JointSettings] = {}
    for joint in setup.joints:
        problems += unknown_options(joint.options, JOINT_OPTIONS, ("joints", joint.name, "options"), "mit")
        if (settings := _joint(joint, problems, fd=data_bitrate is not None)) is not None:
            joints[joint.name] = settings
    number = partial(number_option, setup.options, path=("options",), problems=problems)
    bus = BusSettings(
        rates=BitRates(int(number("bitrate", 1_000_000, 10_000, 1_000_000)), data_bitrate),
        watchdog_s=number("watchdog_ms", 100.0, 5.0, 10_000.0) / 1000.0,
        allow_torque_without_watchdog=setup.options.get("allow_torque_without_watchdog") is True,
        reply_window=number("reply_window", 0.8, 0.1, 0.95),
        tty_baudrate=int(number("tty_baudrate", 0, 0, 10_000_000)),
    )
    if problems:
        raise InvalidFields(problems)
    return bus, joints


def _data_bitrate(options: Mapping[str, Any], problems: list[FieldProblem]) -> int | None:
    """Of CAN FD frames, where the robot file wants them."""
    wanted = options.get("data_bitrate", DEFAULT_DATA_BITRATE)
    if options.get("fd") is True:
        if wanted not in (fast := [rate for rate in Damiao.RATES if rate > 1_000_000]):
            known = ", ".join(map(str, fast))
            problems.append(FieldProblem(("options", "data_bitrate"), f"expected one of {known}, found {wanted!r}"))
        return int(wanted) if isinstance(wanted, int) else DEFAULT_DATA_BITRATE
    if options.get("fd", False) is not False:
        problems.append(FieldProblem(("options", "fd"), f"expected true or false, found {options['fd']!r}"))
    elif "data_bitrate" in options:
        problems.append(FieldProblem(("options", "data_bitrate"), "means nothing without `fd: true`"))
    return None


def _joint(joint: JointSetup, problems: list[FieldProblem], *, fd: bool) -> JointSettings | None:
    at, options = ("joints", joint.name, "options"), joint.options
    model = MODELS.get(str(options.get("model")))
    if model is None:
        known = ", ".join(MODELS)
        problems.append(FieldProblem((*at, "model"), f"expected the model written on the motor, one of {known}"))
        return None
    usual = "cybergear" if options["model"] == "CyberGear" else _PROTOCOLS[model.maker][0]
    protocol = options.get("protocol", usual)
    if protocol not in _PROTOCOLS[model.maker]:
        known = " or ".join(_PROTOCOLS[model.maker])
        problems.append(FieldProblem((*at, "protocol"), f"a {options['model']} speaks {known}, found {protocol!r}"))
        return None
    family, ranges = FAMILIES[protocol], model.ranges
    if fd and not isinstance(family, Damiao):
        problems.append(FieldProblem(("options", "fd"), f"a {options['model']} speaks classical CAN ({protocol})"))
    number = partial(number_option, options, path=at, problems=problems)
    reply_id = int(number("reply_id", joint.address + 0x10 if family.reply_id is None else family.reply_id, 0, 0x7FF))
    if reply_id == joint.address:
        problems.append(FieldProblem((*at, "reply_id"), "must differ from the motor's own id"))
    if joint.max_torque_nm > ranges.torque_nm:
        where = ("joints", joint.name, "max_torque_nm")
        problems.append(FieldProblem(where, f"a {options['model']} tells {ranges.torque_nm:g} N m"))
    kd = number("kd", min(1.0, ranges.kd_nm_s_per_rad), 0.0, ranges.kd_nm_s_per_rad)
    return JointSettings(
        model=str(options["model"]),
        family=family,
        motor=Motor(joint.address, reply_id, ranges, FD_FRAME if fd else 0),
        kp=number("kp", 50.0, 0.0, ranges.kp_nm_per_rad) or math.nan,
        kd=kd,
        brake_kd=number("brake_kd", kd, 0.0, ranges.kd_nm_s_per_rad),
        torque_delay_s=number("torque_delay_s", 0.0, 0.0, 0.1),
    )
