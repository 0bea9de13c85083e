"""A robot as plans and drivers need to know it: values of the robot file, joint side of the gear."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.workspace import Workspace


@dataclass(frozen=True, slots=True)
class JointSetup:
    """One joint as a driver needs to know it; values of the robot file, joint side of the gear."""

    name: str
    address: int  # node id, axis index or id, as the driver's ``kind`` says
    gear_ratio: float
    direction: int  # +1 or -1, sign of joint motion for positive motor motion
    max_velocity_rad_s: float
    max_torque_nm: float
    # Joint-side torque that the drive calls 1000 per mille (motor rated torque times gear ratio).
    rated_torque_nm: float
    position_min_rad: float
    position_max_rad: float
    start_position_rad: float  # where its identification starts; the travel goes to start + A
    locked_position_rad: float
    # Driver-specific settings of the robot file (``pulses_per_degree``, ``parity``, object overrides, ...).
    options: Mapping[str, Any] = field(default_factory=dict)
    # The robot file's ``simulated`` mapping, unread; only simulated hardware looks at it.
    simulated: Mapping[str, Any] = field(default_factory=dict)
    expected_inertia_kg_m2: float = 0.0  # of the whole joint, as the robot file expects it; 0 where it does not say
    # What quality gates allow here, where other than usual; see ``friction.gate.GateLimits``.
    gates: Mapping[str, float] = field(default_factory=dict)
    # Torque that the drive's own position loop gives per rad of following error, where that loop is proportional alone;
    # 0 where it is not known.
    loop_stiffness_nm_per_rad: float = 0.0
    # The joint's Denavit-Hartenberg row (``kinematics.DhRow``) as plain values; empty where not given.
    dh: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RobotSetup:
    """A robot as a driver needs to know it."""

    name: str
    bus: str  # ``interface:channel`` as typed (``socketcan:can0``, ``virtual:hp3j``, ``serial:/dev/ttyUSB0``)
    cycle_hz: float  # requested cycle rate
    joints: tuple[JointSetup, ...]
    # Driver-specific settings of the robot file (``bitrate``, ``baud``, ``heartbeat_ms``, ...).
    options: Mapping[str, Any] = field(default_factory=dict)
    realtime: bool = False  # run on the wall clock even where lock-step is possible
    seed: int = 0  # seed of every simulated noise; ignored by real hardware
    # The robot file's ``simulated_arm`` mapping, unread; only simulated hardware looks at it.
    simulated_arm: Mapping[str, Any] = field(default_factory=dict)
    simulated: bool = False  # nothing real moves; a setup that says nothing of it is taken for a real robot's
    workspace: Workspace | None = None
    # Bounds of the supervisor that robot file or driver set, by name; see ``runner.care.Care``.
    care: Mapping[str, float] = field(default_factory=dict)
    folder: Path | None = None  # of the robot file; file names in options count from there

    @property
    def lock_step(self) -> bool:
        """Time is virtual: cycles run as fast as the processor allows, in the process that started them."""
        return self.simulated and not self.realtime

    def joint(self, name: str) -> JointSetup:
        """The joint of that name; ``InvalidFields`` with the joints there are where there is none."""
        for joint in self.joints:
            if joint.name == name:
                return joint
        known = ", ".join(j.name for j in self.joints)
        raise InvalidFields([FieldProblem(("joints", name), f"no such joint; this robot has {known}")])

    def with_joint(self, name: str, **changes: Any) -> RobotSetup:
        """The same robot, but for some values of one joint."""
        return replace(self, joints=tuple(replace(j, **changes) if j.name == name else j for j in self.joints))
