"""From a robot file to the controller that a supplier would have set up; ``options.emulator`` says which kind it is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from frictid_drivers.motoman.emulator.axis import Axis, Plate
from frictid_drivers.motoman.emulator.faults import FaultPlan
from frictid_drivers.motoman.emulator.machine import Emulator
from frictid_drivers.motoman.emulator.panel import Settings
from frictid_drivers.virtual.devices import plant_for
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import JointSetup, RobotSetup

_SPEED_MARGIN = 1.1

_DEFAULTS: Mapping[str, float | bool] = {
    "averaging_ms": 0,  # moving average on the command
    "batch": True,  # the batch application is installed
    "stream": True,  # the streaming application is installed
    "thinking_ms": 12,  # between a command and the bid to reply
    "table_delay_ms": 0,  # by which the torque of a friction table comes late, whole ticks
    "reads_while_running": True,  # the batch application hands samples over while a job runs
    "hand_amplitude_rad": 0.349,  # a person guides a floating joint by this much, about where it stands
    "hand_frequency_hz": 0.5,  # so many times a second
}


def build(setup: RobotSetup, faults: FaultPlan | None = None) -> Emulator:
    """This robot's controller, arm at its locked positions, servo power off; ``InvalidFields`` where there is none."""
    options = _options(setup.options.get("emulator", {}))
    settings = _settings(setup, options)
    joints = [joint for _, joint in sorted({joint.address: joint for joint in setup.joints}.items())]
    for number, joint in enumerate(joints):
        if joint.address != number:
            path = ("joints", setup.joints[0].name, "axis")
            raise InvalidFields([FieldProblem(path, f"axes must be numbered without gaps; no joint has axis {number}")])
    loops = [plant_for(setup, joint) for joint in joints]
    plates = [_plate(joint, settings.tick_s) for joint in joints]
    axes = [Axis(plate, loop, settings.averaging_ticks) for plate, loop in zip(plates, loops, strict=True)]

    def on_guided(number: int, guided: bool) -> None:
        loop = loops[number]
        loop.hold_hand(
            loop.model.hand if guided else None,
            centre_rad=loop.measured_position_rad,
            amplitude_rad=float(options["hand_amplitude_rad"]),
            frequency_hz=float(options["hand_frequency_hz"]),
        )

    return Emulator(axes, settings, faults, on_guided=on_guided)


def _options(given: Any) -> dict[str, float | bool]:
    if not isinstance(given, Mapping):
        raise InvalidFields([FieldProblem(("options", "emulator"), "must be a mapping")])
    problems = []
    for name, value in given.items():
        path = ("options", "emulator", str(name))
        if name not in _DEFAULTS:
            problems.append(FieldProblem(path, f"is no option of the emulator; there are {', '.join(_DEFAULTS)}"))
        elif isinstance(_DEFAULTS[name], bool) != isinstance(value, bool):
            problems.append(FieldProblem(path, f"found {value!r}"))
        elif not isinstance(value, (int, float)) or not 0 <= value < 10_000:
            problems.append(FieldProblem(path, f"must be a number from 0 to 10000, found {value!r}"))
    if problems:
        raise InvalidFields(problems)
    return {**_DEFAULTS, **given}


def _settings(setup: RobotSetup, options: Mapping[str, float | bool]) -> Settings:
    tick_s = 1.0 / setup.cycle_hz
    stream_baud = int(setup.options.get("stream_baud", 0))
    of_line = ("baud", "parity", "timer_a_s", "timer_b_s", "retry_1", "retry_2")
    return Settings(
        **{name: setup.options[name] for name in of_line if name in setup.options},
        generation=str(setup.options.get("controller", "nx")),
        stream_bauds=(stream_baud,) if options["stream"] and stream_baud else (),
        batch=bool(options["batch"]),
        tick_s=tick_s,
        averaging_ticks=max(1, round(options["averaging_ms"] * 1e-3 / tick_s)),
        thinking_s=options["thinking_ms"] * 1e-3,
        table_delay_ticks=round(options["table_delay_ms"] * 1e-3 / tick_s),
        reads_while_running=bool(options["reads_while_running"]),
    )


def _plate(joint: JointSetup, tick_s: float) -> Plate:
    per_degree = joint.options.get("pulses_per_degree")
    if isinstance(per_degree, bool) or not isinstance(per_degree, (int, float)) or not 0 < per_degree < math.inf:
        path = ("joints", joint.name, "options", "pulses_per_degree")
        raise InvalidFields([FieldProblem(path, f"must be a positive number, found {per_degree!r}")])
    per_rad = joint.direction * per_degree * 180.0 / math.pi
    ends = sorted((joint.position_min_rad * per_rad, joint.position_max_rad * per_rad))
    return Plate(
        pulses_per_rad=per_rad,
        gear_ratio=joint.gear_ratio,
        rated_torque_nm=joint.rated_torque_nm,
        lowest=math.floor(ends[0]),
        highest=math.ceil(ends[1]),
        step=math.ceil(_SPEED_MARGIN * joint.max_velocity_rad_s * abs(per_rad) * tick_s),
    )
