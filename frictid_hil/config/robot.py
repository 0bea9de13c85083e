"""The robot file: what the robot is, where it is reached, what may be done with it. ``schema: frictid.robot/1``.

A *site file* says only what differs on one machine and ``extends: hp3j.yaml``, the shipped file, or another one.
Mappings merge key by key, ``joints: {"3": null}`` leaves joint 3 out, everything else is replaced; errors point into
the file that holds the value. Numbers are in the unit that ends their key; ``position_max_rad: 150deg`` says another.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from frictid_hil.config.policy import Policy
from frictid_hil.config.schema import Pair, Strict, Triple, in_si, schema_version, validated
from frictid_hil.config.search import find
from frictid_hil.config.yaml import Document, KeyPath, merge, read
from frictid_hil.errors import ConfigError, FieldProblem, UsageError
from frictid_hil.files import PLAIN_NAME
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.kinematics import DhRow
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.plan.workspace import Workspace
from frictid_hil.protocol.driver import DriverKind, kind_of, line_of

KIND = "frictid.robot"
NEWEST = 1

MOST_TRAVEL_RAD = 4.001 * math.pi
"""Two turns. A longer travel, or a higher speed than the next, is taken for degrees unless the axis is continuous."""

FASTEST_RAD_S = 50.0  # 2865 deg/s: the last axes of fast SCARA arms turn at 2500 deg/s

Positive = Annotated[float, Field(gt=0)]
Share = Annotated[float, Field(gt=0, le=1)]


class ProcedureFile(Strict):
    """The motion of a calibration."""

    amplitude_rad: Positive = 0.3490658503988659  # travel A of a cycle, peak-to-peak; 20 deg unless given
    velocity_rad_s: Positive = 2.007128639793479  # peak speed V of the fastest cycle; 115 deg/s unless given
    cycles: int = Field(default=10, ge=2, le=1000)  # number of cycles N
    ratio: float = Field(default=0.8, ge=0, lt=1)  # share c of a cycle's peak speed, above which its samples count
    # measure the delay of the torque in every calibration, as ``calibrate --measure-skew`` does
    measure_skew: bool = False


class JointProcedureFile(Strict):
    """What differs for one joint."""

    amplitude_rad: Positive | None = None  # travel A of a cycle, peak-to-peak
    velocity_rad_s: Positive | None = None  # peak speed V of the fastest cycle
    cycles: int | None = Field(default=None, ge=2, le=1000)  # number of cycles N
    # share c of a cycle's peak speed, above which its samples count
    ratio: float | None = Field(default=None, ge=0, lt=1)


class ExpectedFile(Strict):
    """What is expected of a joint before it was measured; predicts the peak torque of a plan."""

    inertia_kg_m2: float = Field(ge=0)  # in the posture of the run
    gravity_nm: float = Field(ge=0)  # largest holding torque over the travel
    friction_nm: float = Field(ge=0)  # at the highest planned speed
    # the part of the inertia behind the gear; bounds what other joints' accelerations cost this one when all move
    # together. All of it where not given.
    link_inertia_kg_m2: float | None = Field(default=None, ge=0)


class DhFile(Strict):
    """Where the next joint is: the joint's Denavit-Hartenberg row, as the robot's manual prints it."""

    d_m: float = 0.0  # along this joint's axis
    a_m: float = 0.0  # along the common normal
    alpha_rad: float = 0.0  # twist to the next joint's axis
    theta_rad: float = 0.0  # angle at joint position 0


class JointFile(Strict):
    """One joint; torque and position on the joint side of the gear."""

    node: int | None = Field(default=None, ge=0)  # CANopen node id
    axis: int | None = Field(default=None, ge=0)  # number of the axis in a serial controller, from 0
    id: int | None = Field(default=None, ge=0)  # of an MIT-mode actuator or a servo on its bus
    gear_ratio: Positive  # motor revolutions per joint revolution
    max_velocity_rad_s: Positive  # highest speed that any plan may ask for
    max_torque_nm: Positive  # highest torque that any plan may ask for
    rated_torque_nm: Positive  # the motor's rated torque times the gear ratio; drives report torque in shares of it
    position_min_rad: float  # lower end of the free travel
    position_max_rad: float  # upper end of the free travel
    start_position_rad: float  # where the travel of the cycles begins; it runs to start + A
    locked_position_rad: float  # where the joint stands while others move
    continuous: bool = False  # the axis turns without end, or faster than any robot's joint, and that is meant
    direction: Literal[-1, 1] = 1  # -1 turns position, velocity and torque of a drive that counts the other way
    expected: ExpectedFile | None = None  # rough guess of the load, for the plan
    procedure: JointProcedureFile = JointProcedureFile()  # what differs from the robot's procedure
    # what a servo's own proportional position loop gives per rad of following error
    loop_stiffness_nm_per_rad: float = Field(default=0.0, ge=0)
    # settings of the driver for this joint; see the page of the driver
    options: dict[str, Any] = Field(default_factory=dict)
    simulated: dict[str, Any] = Field(default_factory=dict)  # the joint that simulated drives move
    dh: DhFile | None = None  # geometry, for the workspace and for an arm of rigid bodies


class WorkspaceFile(Strict):
    """A box in the robot's base frame that the arm may not leave; needs ``dh`` of every joint."""

    x_m: Pair  # from and to
    y_m: Pair  # from and to
    z_m: Pair  # from and to
    # kept from every face: as much as the links are thicker than lines from joint to joint
    clearance_m: float = Field(default=0.0, ge=0)
    tool_m: Triple = (0.0, 0.0, 0.0)  # tool point in the last joint's frame

    @field_validator("x_m", "y_m", "z_m")
    @classmethod
    def _ordered(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] >= value[1]:
            raise ValueError(f"the first number must be below the second, found {list(value)}")
        return value


class CareFile(Strict):
    """Bounds of the supervisor where this robot needs others than usual. A plan prints them beside the usual ones."""

    # a joint further than this from its planned locked position is refused; usually 10 deg
    reference_tolerance_rad: Positive | None = None
    approach_rad_s: Positive | None = None  # speed of moves to locked and start positions; usually 20 deg/s
    still_rad: Positive | None = None  # how far a joint may move from where it was locked; usually 0.25 deg
    still_rad_s: Positive | None = None  # speed below which a joint stands; usually 0.5 deg/s
    # largest following error, beyond what the driver's own delay makes; usually 5 deg, and no more than the joint
    # covers in 15 ms at its highest speed
    following_error_rad: Positive | None = None
    # measured speed may exceed the planned peak by this factor; usually 1.25 ...
    velocity_margin: float | None = Field(default=None, ge=1)
    velocity_slack_rad_s: Positive | None = None  # ... plus this; usually 10 deg/s.
    travel_slack_rad: Positive | None = None  # measured position may leave the planned travel by this; usually 2 deg
    # how long the moving joint may go without a report, never less than three cycles; usually 0.02 s
    silence_s: Positive | None = None


class GatesFile(Strict):
    """What quality gates allow where this robot needs other limits than usual; plan and profile name them."""

    # least peak speed of a cycle over the commanded one; usually 0.95
    tracking_least: float | None = Field(default=None, gt=0, le=1)
    tracking_most: float | None = Field(default=None, ge=1)  # the same, at most; usually 1.3
    high_frequency_torque: Share | None = None  # jitter of the torque over the friction; usually 0.25
    # fewest samples that a pair may be the mean of; usually 8
    samples_per_window: int | None = Field(default=None, ge=1)
    late_cycles: Share | None = None  # share of control cycles that were late or missed; usually 0.02
    # how far either direction may lie from the mean of both, over that mean; usually 0.3
    direction_asymmetry: Share | None = None
    # how far a pair may leave the line through its neighbours, over the mean friction; usually 0.1
    straightness: Share | None = None
    saturation: Share | None = None  # share of the samples with torque at its limit; usually 0.005
    drift: Share | None = None  # change of the friction over the run; usually 0.05
    link_resonance: Share | None = None  # frequency of the fastest cycle over the link's resonance; usually 0.2
    # change of the friction in other stretches of the run, or of the repeated cycle; usually 0.15
    other_stretches: Share | None = None


class RobotFile(Strict):
    """What the robot is, where it is reached, and what may be done with it."""

    schema_: str = Field(alias="schema")  # ``frictid.robot/1``
    extends: str | None = None  # another robot file; this one says only what differs
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")  # of the robot, and of its folder in the profile store
    driver: str  # ``cia402``, ``mit``, ``motoman``, ``servos``, ``virtual``, or one that is installed
    bus: str  # ``interface:channel``, such as ``socketcan:can0``, ``serial:/dev/ttyUSB0``, ``virtual:NAME``
    cycle_hz: float = Field(gt=0, le=20_000)  # set-points a second
    # settings of the driver for the whole bus; see the page of the driver
    options: dict[str, Any] = Field(default_factory=dict)
    procedure: ProcedureFile = ProcedureFile()  # the motion of a calibration
    policy: Policy = Policy()  # what may happen with nobody there
    care: CareFile = CareFile()  # bounds of the supervisor
    gates: GatesFile = GatesFile()  # limits of the quality gates
    workspace: WorkspaceFile | None = None  # a box that the arm may not leave
    # masses of the links, for simulated drives that move one arm
    simulated_arm: dict[str, Any] = Field(default_factory=dict)
    joints: dict[str, JointFile] = Field(min_length=1)  # by name

    @field_validator("bus")
    @classmethod
    def _has_interface(cls, value: str) -> str:
        interface_of(value)
        return value


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot file (a site file, where there is one), read and checked, and where its values stand."""

    path: Path
    file: RobotFile
    document: Document

    @property
    def name(self) -> str:
        """The robot's name."""
        return self.file.name

    @property
    def joint_names(self) -> tuple[str, ...]:
        """In the order of the file."""
        return tuple(self.file.joints)

    @property
    def policy(self) -> Policy:
        """What may happen without a person."""
        return self.file.policy

    def values(self) -> dict[str, Any]:
        """The values as they are in force, in one mapping: a site file merged with what it extends."""
        return {key: value for key, value in self.document.data.items() if key != "extends"}

    @property
    def digest(self) -> str:
        """SHA-256 of the values (comments and layout do not count), hexadecimal."""
        canonical = json.dumps(self.values(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()

    def driver(self, bus: str | None = None) -> str:
        """The driver for a bus: the file's own, unless that needs another (``UsageError``: it has none)."""
        own = self.file.driver
        if bus is None or interface_of(bus) == interface_of(self.file.bus):
            return own
        with self.document.locating():
            kind = kind_of(own)
        line = line_of(interface_of(bus))
        if line == kind.line:
            return own
        if line not in kind.elsewhere:
            raise UsageError(
                f"driver {own} speaks on a {kind.line} bus and has no counterpart on a {line} bus",
                where=bus,
                next_step=f"give a {kind.line} bus, or name another `driver` in the robot file",
            )
        return kind.elsewhere[line]

    def kind(self, bus: str | None = None) -> DriverKind:
        """What the driver for this bus is; see ``driver``."""
        with self.document.locating():
            return kind_of(self.driver(bus))

    def procedure(
        self,
        joint: str,
        *,
        amplitude_rad: float | None = None,
        velocity_rad_s: float | None = None,
        cycles: int | None = None,
        ratio: float | None = None,
        shares: tuple[float, ...] = (),  # peak speeds of a short programme as shares of V; their number is then N
    ) -> Procedure:
        """What is given, else the joint's own, else the robot's (``UsageError``: no such joint, or no procedure)."""
        self.check_joints([joint])
        own, common = self.file.joints[joint].procedure, self.file.procedure
        asked = {"amplitude_rad": amplitude_rad, "velocity_rad_s": velocity_rad_s, "ratio": ratio}
        asked["cycles"] = len(shares) or cycles
        known: dict[str, Any] = common.model_dump(exclude={"measure_skew"})
        for part in (own.model_dump(), asked):
            known |= {name: value for name, value in part.items() if value is not None}
        try:
            return Procedure(**known, shares=shares)
        except ValueError as error:
            raise UsageError(str(error), where=f"joint {joint}") from None

    def check_joints(self, names: Sequence[str]) -> None:
        """Raise ``UsageError`` for a joint that this robot has not."""
        for name in names:
            if name not in self.file.joints:
                raise UsageError(
                    f"no joint named {name!r}; {self.name} has {', '.join(self.joint_names)}", where=str(self.path)
                )

    def to_setup(self, bus: str | None = None, *, realtime: bool = False, seed: int = 0) -> RobotSetup:
        """The robot as a driver knows it, on the file's bus unless told (``ConfigError``: a joint without address)."""
        driver, kind = self.driver(bus), self.kind(bus)
        gates = {**kind.gates, **self.file.gates.model_dump(exclude_none=True)}
        key, (lowest, highest) = kind.addressed_by, kind.addresses
        addresses: dict[str, int | None] = {name: getattr(joint, key) for name, joint in self.file.joints.items()}
        missing = [
            FieldProblem(("joints", name), f"has no `{key}`, by which driver {driver} finds its joints")
            for name, address in addresses.items()
            if address is None
        ]
        beyond = [
            FieldProblem(("joints", name, key), f"driver {driver} has {key}s {lowest} to {highest}, found {address}")
            for name, address in addresses.items()
            if address is not None and not lowest <= address <= highest
        ]
        unknown = [
            FieldProblem(("driver",), f"driver {driver} sets {name} under {key}, which is not among its keys")
            for key, bounds, model in (("care", kind.care, CareFile), ("gates", kind.gates, GatesFile))
            for name in bounds
            if name not in model.model_fields
        ]
        if missing or beyond or unknown:
            raise self.document.error([*missing, *beyond, *unknown], at_key=[problem.path for problem in missing])
        return RobotSetup(
            name=self.name,
            bus=bus or self.file.bus,
            cycle_hz=self.file.cycle_hz,
            joints=tuple(
                _joint_setup(name, self.file.joints[name], address, gates)
                for name, address in addresses.items()
                if address is not None
            ),
            options=self.file.options,
            realtime=realtime,
            seed=seed,
            simulated_arm=self.file.simulated_arm,
            simulated=kind.simulated,
            workspace=_workspace(self.file),
            care={**kind.care, **self.file.care.model_dump(exclude_none=True)},
            folder=self.path.resolve().parent,
        )


def load_robot(name: str | Path) -> Robot:
    """Read and check a robot file: a path, or a name (``hp3j``) to search for (``ConfigError``: all problems)."""
    path = find(name)
    document = in_si(_extended(path, ()))
    file = validated(document, RobotFile)
    problems = _contradictions(file)
    if problems:
        raise document.error(problems, at_key=[("joints", name) for name in file.joints])
    return Robot(path, file, document)


def interface_of(bus: str) -> str:
    """The interface part of ``interface:channel`` (``BusSyntaxError``, fit for a validator too: it has none)."""
    interface, colon, channel = bus.partition(":")
    if not (interface and colon and channel):
        raise BusSyntaxError(f"expected interface:channel (socketcan:can0, serial:/dev/ttyUSB0), found {bus!r}")
    return interface


class BusSyntaxError(UsageError, ValueError):
    """A bus that is not ``interface:channel``; a ValueError too, so that validators can let it through."""


def _extended(path: Path, seen: tuple[Path, ...]) -> Document:
    if path.resolve() in seen:
        raise ConfigError("extends itself, directly or through others", where=str(path))
    document = read(path)
    schema_version(document, KIND, NEWEST)
    base = document.root.content.get("extends")
    if base is None or not isinstance(base.content, str):
        return document
    try:
        base_path = find(base.content, beside=path.parent)
    except ConfigError as error:
        raise ConfigError(
            f"extends: {error.what}", where=str(base.place), cause=error.cause, next_step=error.next_step
        ) from None
    below = _extended(base_path, (*seen, path.resolve()))
    return Document(path, merge(below.root, document.root))


def _contradictions(file: RobotFile) -> list[FieldProblem]:
    """What is wrong between fields that are each right by themselves."""
    problems = []
    taken: dict[tuple[str, int], str] = {}
    for name, joint in file.joints.items():
        at = ("joints", name)
        if re.fullmatch(PLAIN_NAME, name) is None:
            problems.append(FieldProblem(at, "a joint's name becomes a file's: letters, digits, '_', '-', '.', spaces"))
        low, high = joint.position_min_rad, joint.position_max_rad
        if low >= high:
            problems.append(FieldProblem((*at, "position_max_rad"), f"must be above position_min_rad = {low}"))
        if not joint.continuous:
            problems += _in_degrees(joint, at) + _in_degrees(joint.procedure, (*at, "procedure"))
        for key in ("start_position_rad", "locked_position_rad"):
            value = getattr(joint, key)
            if low < high and not low <= value <= high:
                problems.append(FieldProblem((*at, key), f"{value} lies outside the limits [{low}, {high}]"))
        if joint.node is None and joint.axis is None and joint.id is None:
            problems.append(FieldProblem(at, "has no `node` (CANopen), `axis` (a controller's) or `id` (actuators)"))
        for kind, address in (("node", joint.node), ("axis", joint.axis), ("id", joint.id)):
            if address is None:
                continue
            first = taken.setdefault((kind, address), name)
            if first != name:
                problems.append(FieldProblem((*at, kind), f"{kind} {address} is already that of joint {first}"))
    if not any(joint.continuous for joint in file.joints.values()):
        problems += _in_degrees(file.procedure, ("procedure",))
    if file.workspace is not None:
        problems += _workspace_problems(file, file.workspace)
    interlock = file.policy.unattended.interlock_input if file.policy.unattended else None
    if interlock and interlock.joint not in file.joints:
        at_joint = ("policy", "unattended", "interlock_input", "joint")
        problems.append(FieldProblem(at_joint, f"no such joint; this robot has {', '.join(file.joints)}"))
    return problems


def _in_degrees(holder: Strict, at: KeyPath) -> list[FieldProblem]:
    """Travels of more than two turns and speeds of no joint."""
    values = {name: value for name, value in holder.model_dump().items() if isinstance(value, float | int)}
    travel = values.get("position_max_rad", 0.0) - values.get("position_min_rad", 0.0)
    problems = []
    for name, value in values.items():
        fast = name.endswith("velocity_rad_s") and value > FASTEST_RAD_S
        far = name in ("position_min_rad", "position_max_rad", "amplitude_rad") and abs(value) > MOST_TRAVEL_RAD
        far |= name == "position_max_rad" and travel > MOST_TRAVEL_RAD
        if fast or far:
            why = "/s is faster than any robot's joint" if fast else ": over two turns of travel"
            hint = f"{value:g}{'deg/s' if fast else 'deg'}; an endless axis says `continuous: true`"
            problems.append(FieldProblem((*at, name), f"{value:g} rad{why}; in degrees? write {hint}"))
    return problems


def _workspace_problems(file: RobotFile, box: WorkspaceFile) -> list[FieldProblem]:
    problems = [
        FieldProblem(("joints", name), "has no `dh`, without which `workspace` cannot be checked")
        for name, joint in file.joints.items()
        if joint.dh is None
    ]
    for axis in ("x_m", "y_m", "z_m"):
        low, high = getattr(box, axis)
        if high - low <= 2 * box.clearance_m:
            at = ("workspace", axis)
            problems.append(FieldProblem(at, f"leaves no room between faces of {box.clearance_m:g} m clearance"))
    return problems


def _workspace(file: RobotFile) -> Workspace | None:
    box = file.workspace
    if box is None:
        return None
    rows = tuple(DhRow(**joint.dh.model_dump()) for joint in file.joints.values() if joint.dh)
    return Workspace(rows, (box.x_m, box.y_m, box.z_m), box.clearance_m, box.tool_m)


_NOT_OF_SETUP = {"node", "axis", "id", "continuous", "procedure", "expected", "options", "simulated", "dh"}


def _joint_setup(name: str, joint: JointFile, address: int, gates: Mapping[str, float]) -> JointSetup:
    values = joint.model_dump(exclude=_NOT_OF_SETUP)
    return JointSetup(
        name=name,
        address=address,
        options=joint.options,
        simulated=joint.simulated,
        expected_inertia_kg_m2=joint.expected.inertia_kg_m2 if joint.expected else 0.0,
        dh=joint.dh.model_dump() if joint.dh else {},
        gates=gates,
        **values,
    )
