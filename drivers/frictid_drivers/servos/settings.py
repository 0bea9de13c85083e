"""Options of the robot file for servos on a serial line.

::

    driver: servos
    bus: serial:/dev/ttyACM0
    options: {baud: 1000000}
    joints:
      shoulder_pan:
        id: 1
        options: {model: STS3215, zero_counts: 2048, torque_constant_nm_per_a: 0.8}
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from frictid_drivers.servos.models import MODELS, Model
from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import number_option, unknown_options

BUS_OPTIONS = frozenset({"baud", "watchdog_ms", "answer_ms", "allow_torque_without_watchdog"})
JOINT_OPTIONS = frozenset(
    {"model", "zero_counts", "torque_constant_nm_per_a", "stall_nm", "torque_uncertainty_percent"}
)
MOST_SERVOS = 10  # on one line; one packet must fit a row of the bus log


@dataclass(frozen=True, slots=True)
class LineSettings:
    """Of the whole line."""

    baud: int  # bit/s
    watchdog_s: float
    answer_s: float  # how long an answer may take outside the cycle
    allow_torque_without_watchdog: bool  # a person takes the place of a bus watchdog that is not there


@dataclass(frozen=True, slots=True)
class JointSettings:
    """Of one joint."""

    name: str  # of the model
    model: Model  # with the torque constants of the robot file
    id: int
    zero_counts: int  # position 0 of the joint
    direction: int

    @property
    def torque_nm_per_unit(self) -> float:
        """One step of current, or of load where there is no current (0.1 % of the duty at stall)."""
        model = self.model
        return model.current_a * model.torque_constant_nm_per_a if model.current_a else model.stall_nm / 1000.0

    def position_rad(self, counts: float) -> float:
        """Of the joint."""
        return self.direction * (counts - self.zero_counts) * self.model.count_rad

    def counts(self, position_rad: float) -> int:
        """The nearest."""
        return round(self.direction * position_rad / self.model.count_rad) + self.zero_counts


def read_settings(setup: RobotSetup) -> tuple[LineSettings, list[JointSettings]]:
    """All options, checked.

    Raises:
        InvalidFields: every option that is unknown or impossible; two makers on one line; too many servos.
    """
    problems = unknown_options(setup.options, BUS_OPTIONS, ("options",), "servos")
    number = partial(number_option, setup.options, path=("options",), problems=problems)
    line = LineSettings(
        baud=int(number("baud", 1_000_000, 9600, 4_500_000)),
        watchdog_s=number("watchdog_ms", 200, 20, 2540) / 1000.0,
        answer_s=number("answer_ms", 20, 1, 1000) / 1000.0,
        allow_torque_without_watchdog=setup.options.get("allow_torque_without_watchdog") is True,
    )
    joints = [settings for joint in setup.joints if (settings := _joint(joint, problems)) is not None]
    if len({settings.model.wire for settings in joints}) > 1:
        problems.append(FieldProblem(("joints",), "servos of two makers do not share a line"))
    if len(joints) > MOST_SERVOS:
        problems.append(FieldProblem(("joints",), f"at most {MOST_SERVOS} servos on one line"))
    if problems:
        raise InvalidFields(problems)
    return line, joints


def _joint(joint: JointSetup, problems: list[FieldProblem]) -> JointSettings | None:
    at, options = ("joints", joint.name, "options"), joint.options
    problems += unknown_options(options, JOINT_OPTIONS, at, "servos")
    model = MODELS.get(str(options.get("model")))
    if model is None:
        problems.append(FieldProblem((*at, "model"), f"expected one of {', '.join(MODELS)}"))
        return None
    most, number = model.counts_per_turn - 1, partial(number_option, options, path=at, problems=problems)
    settings = JointSettings(
        name=str(options["model"]),
        model=replace(
            model,
            torque_constant_nm_per_a=number("torque_constant_nm_per_a", model.torque_constant_nm_per_a, 0, 100),
            stall_nm=number("stall_nm", model.stall_nm, 0, 100),
            uncertainty_percent=number("torque_uncertainty_percent", model.uncertainty_percent, 0, 100),
        ),
        id=joint.address,
        zero_counts=int(number("zero_counts", model.counts_per_turn // 2, 0, most)),
        direction=joint.direction,
    )
    for name in ("position_min_rad", "position_max_rad"):
        limit = getattr(joint, name)
        if not 0 <= settings.counts(limit) <= most:
            where = ("joints", joint.name, name)
            problems.append(FieldProblem(where, f"{limit:g} rad is step {settings.counts(limit)}; there are 0..{most}"))
    return settings
