"""The driver protocol: the least that a bus or controller must bring so that the runner can move its joints.

A driver owns three things the runner must not guess: the wire, the units of the drive, and **time**. The runner asks
``capabilities`` what the hardware can do and never tries what it was not promised.

Life cycle::

    open -> identify -> check(plan) -> configure(rate) -> lock / enable -> start_cycling
                                                            exchange, exchange, ...      (once per cycle)
    stop_cycling -> unlock -> close                         quick_stop at any moment, close always

Positions, velocities and torques are on the joint side of the gear, in rad, rad/s and N m. A driver counts its own
raw units (encoder counts, pulses, per mille of rated torque) and keeps the conversion to itself.
"""

from __future__ import annotations

import difflib
import functools
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from importlib.metadata import entry_points
from typing import Any, Protocol, runtime_checkable

from frictid_hil.errors import FieldProblem, InvalidFields
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import JointPlan, Plan
from frictid_hil.plan.setup import RobotSetup

NAN = float("nan")


class JointState(Enum):
    """What a joint's power stage is doing, whatever the wire calls it."""

    UNKNOWN = "unknown"
    DISABLED = "disabled"
    ENABLED = "enabled"
    STOPPING = "stopping"
    FAULT = "fault"


@dataclass(frozen=True, slots=True)
class Timing:
    """When a row's figures were true, relative to the row's time stamp (declared by the drive or its robot file).

    A delay of 2 ms says that the value reported at t was true at t - 2 ms.
    """

    position_delay_s: float = 0.0  # of the reported position
    velocity_delay_s: float = 0.0  # of the reported velocity, filters included
    torque_delay_s: float = 0.0  # of the reported torque, filters and zero-order hold included
    # The part of it that is a first-order low-pass, which can be undone and not only shifted back.
    torque_lag_s: float = 0.0
    uncertainty_s: float = 0.0002  # one standard deviation of the torque-to-velocity skew that remains
    # The torque swings from set-point to set-point and is read once between two: at some speeds its readings are not
    # its mean.
    torque_beats: bool = False
    source: str = "assumed"  # where these figures come from (``drive``, ``robot file``, ``assumed``)


@dataclass(frozen=True, slots=True)
class JointIdentity:
    """What a drive says of itself; recorded in every profile as provenance."""

    joint: str  # name
    serial: str = ""  # the drive's serial number ("" where it has none)
    firmware: str = ""  # its version
    product: str = ""  # vendor and product codes or names
    rated_torque_nm: float = NAN  # joint side, as read back from the drive (object 6076 times gear ratio)
    gear_ratio: float = NAN  # as read back, or as configured where the drive does not know it
    position_resolution_rad: float = NAN  # one count
    torque_resolution_nm: float = NAN  # one step of the reported torque
    torque_source: str = ""  # what the reported torque is (``6077 actual torque``, ``mpSvsGetVelTrqFb``, ``simulated``)
    timing: Timing = Timing()  # when reported figures were true
    # Friction compensation, feed-forward, filters, as far as objects are known; values as read.
    settings: Mapping[str, str | float | int | bool] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What this driver can do with this hardware; the runner asks rather than tries."""

    max_cycle_hz: float  # highest cycle rate of the configured layout
    modes: frozenset[Mode]  # set-point modes that every joint supports
    # A torque can be added on top of position or velocity control (60B2, or a goal that moves).
    torque_offset: bool = False
    drive_watchdog: bool = False  # the drive stops by itself when the host dies
    batch_only: bool = False  # no cyclic exchange; the driver is ``Batched`` instead
    lock_step: bool = False  # virtual time: cycles run as fast as the processor allows and never late
    # Durations of motions are rounded to multiples of this (0: no rounding); 4 ms ticks on serial.
    cycle_quantum_s: float = 0.0
    external_torque: bool = False  # feedback carries a force sensor's torque
    temperature: bool = False  # feedback carries a motor or gear temperature
    table_download: bool = False  # a friction table can be compensated on the controller's own tick
    # Delay from the set-point in force (``Feedback.position_command_rad``) to motion that is normal here; following
    # errors are judged with it.
    command_delay_s: float = 0.0
    # A joint with the option ``digital_inputs: true`` reports its inputs in the feedback, so that an interlock can be
    # watched.
    digital_inputs: bool = False
    # How far a joint may stand beside its set-point because its position loop has no integral part, by joint; following
    # error and standstill are judged with it.
    droop_rad: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class DriverKind:
    """What a driver is, known before anything is opened: its class attribute ``kind``."""

    simulated: bool = False  # nothing real moves, so nobody is asked and no payload has to be mounted by hand
    line: str = "can"  # what it speaks on: ``can`` (any python-can interface), ``serial``, or ``virtual``
    # Key of a joint in the robot file that says where it is found: ``node``, ``axis`` or ``id``.
    addressed_by: str = "id"
    addresses: tuple[int, int] = (0, 0x7FF)  # lowest and highest address there is
    # Names of the drivers that reach the same robot on another line, by line.
    elsewhere: Mapping[str, str] = field(default_factory=dict)
    # Bounds of the supervisor that suit these devices, where other than usual, by name (``runner.care.Care``); a robot
    # file overrides them.
    care: Mapping[str, float] = field(default_factory=dict)
    # The same of what quality gates allow (``friction.gate.GateLimits``).
    gates: Mapping[str, float] = field(default_factory=dict)


@dataclass(slots=True)
class SetPoint:
    """What one joint shall do in the coming cycle; reused from cycle to cycle, never reallocated."""

    position_rad: float = 0.0  # target in position mode; beside the measured position in the recording in other modes
    # Target in velocity mode; in position mode how fast ``position_rad`` moves (feed-forward).
    velocity_rad_s: float = 0.0
    torque_nm: float = 0.0  # target in torque mode
    torque_offset_nm: float = 0.0  # added in every mode


@dataclass(slots=True)
class Feedback:
    """What one joint reported last; reused from cycle to cycle, never reallocated."""

    t_ns: int = 0  # run time of the sample (the SYNC that latched it), integer nanoseconds
    position_rad: float = NAN  # actual position
    velocity_rad_s: float = NAN  # the drive's own velocity
    torque_nm: float = NAN  # the drive's own torque
    external_torque_nm: float = NAN  # force sensor, NaN where there is none
    temperature_c: float = NAN  # NaN where unknown
    # The set-point in force at ``t_ns`` as it went out, rounded to the drive's counts; NaN where the driver does not
    # tell, none was sent yet, or the mode follows none.
    position_command_rad: float = NAN
    # Bits of the drive's inputs (60FD), None before their first report or where none is configured.
    digital_inputs: int | None = None
    digital_inputs_age_cycles: int = 0  # cycles since they were reported
    state: JointState = JointState.UNKNOWN  # of the power stage
    mode: Mode = Mode.NONE  # as displayed by the drive (6061), NONE where not yet reported
    status_raw: int = 0  # statusword or controller status as sent
    error_code: int = 0  # 603F or alarm number; 0 when healthy
    age_cycles: int = 0  # cycles since this joint last reported; 0 = this cycle
    valid: bool = False  # False until the first report, and when the report could not be decoded
    limited: bool = False  # the drive says that one of its limits cuts the set-point or the torque (statusword bit 11)


class Severity(Enum):
    """How bad a finding of ``check`` is."""

    OK = "ok"
    WARNING = "warning"
    ERROR = "error"


OWN_FRICTION_COMPENSATION = "own friction compensation"
"""Topic of the finding that a drive compensates friction by itself."""


POSITION_GAIN = "position_p_gain"
"""Setting in the identity of a drive whose position loop is proportional alone: its gain, in the drive's own steps.
A calibration then measures the stiffness of that loop."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of ``frictid-hil check``."""

    severity: Severity  # an ``error`` forbids motion
    subject: str  # joint, object or setting (``joint 1``, ``bus``)
    message: str  # what was found, with numbers and units
    next_step: str = ""  # what to do about it ("" when nothing)
    topic: str = ""  # by which a job recognises what it judges by itself; "" for most


EXTENDED = 1 << 31
"""Bit of an identifier, here and in bus logs, that says: 29 bits."""
FD_FRAME = 1 << 29
"""Bit of an identifier, here and in bus logs, that says: a CAN FD frame, its data at the higher bit rate."""

FrameSink = Callable[[int, int, bytes, bool], None]
"""Called for every frame on the wire: run time in ns, CAN id (bit 31 set: extended, bit 29: CAN FD), data, True when we
sent it."""
FramesSink = Callable[[int, Sequence[tuple[int, bytes]], bool], None]
"""The same for all frames of one moment: run time in ns, identifiers and data, True when we sent them."""


def by_the_batch(sink: FrameSink | None) -> FramesSink:
    """A sink's own way to take the frames of one moment together, its attribute ``batch``; else one by one."""
    if sink is None:
        return lambda t_ns, frames, sent: None
    one = sink

    def each(t_ns: int, frames: Sequence[tuple[int, bytes]], sent: bool) -> None:
        for can_id, data in frames:
            one(t_ns, can_id, data, sent)

    own: FramesSink | None = getattr(sink, "batch", None)
    return own or each


class Clock(Protocol):
    """Run time: integer nanoseconds since ``start_cycling``. Wall clock or lock-step, the loop cannot tell."""

    lock_step: bool  # time is virtual. Where it is not, the loop gets a process of its own

    def now_ns(self) -> int:
        """Run time now."""

    def wait_until(self, deadline_ns: int) -> None:
        """Return at the deadline (or at once if it has passed)."""


class WallClock:
    """Run time on the machine's monotonic clock, by absolute deadlines."""

    lock_step = False

    def __init__(self) -> None:
        self._origin_ns = time.monotonic_ns()

    def restart(self) -> None:
        """Make now the zero of run time."""
        self._origin_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Run time now."""
        return time.monotonic_ns() - self._origin_ns

    def wait_until(self, deadline_ns: int) -> None:
        """Sleep to the deadline; returns at once if it has passed."""
        remaining_ns = deadline_ns - self.now_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns * 1e-9)


@runtime_checkable
class Driver(Protocol):
    """See the module's first page. Constructed as ``DriverClass(setup: RobotSetup)``; construction touches nothing.

    Every method raises ``HardwareError`` when the hardware does not answer, naming node, object and what was expected.
    A class attribute ``kind`` says what the driver is; see ``DriverKind``.
    """

    @property
    def clock(self) -> Clock:
        """Whose time everything runs on."""

    def open(self, frame_sink: FrameSink | None = None) -> None:
        """Take the bus exclusively and reach every joint; nothing is enabled. ``HardwareBusy`` when held by another."""

    def identify(self) -> dict[str, JointIdentity]:
        """Read what every drive says of itself; reads only."""

    def capabilities(self) -> Capabilities:
        """What this hardware can do; after ``open``."""

    def check(self, plan: Plan | None) -> list[Finding]:
        """Everything that can be said without moving or writing: drives, modes, limits, bus load at the plan's rate."""

    def configure(self, cycle_hz: float, active: Sequence[str]) -> None:
        """Write and read back mapping, timing, watchdogs and limits for this rate; ``active`` report every cycle."""

    def set_limits(self, joint: str, *, torque_nm: float, position_min_rad: float, position_max_rad: float) -> None:
        """Set and read back the drive's own limits (6072, 607D); before cycling."""

    def start_cycling(self) -> None:
        """Begin cyclic traffic; run time starts at zero. From here until ``stop_cycling`` no SDO is sent."""

    def enable(self, joint: str, mode: Mode) -> None:
        """Ask for power in ``mode`` with a bumpless set-point; progress is seen in the feedback of later exchanges."""

    def disable(self, joint: str) -> None:
        """Ask for power off (after standstill); progress is seen in the feedback."""

    def lock(self, joint: str) -> None:
        """Hold the joint where it stands, tightly; it is watched on every report."""

    def unlock(self, joint: str) -> None:
        """End ``lock``; the joint stays enabled and follows its set-point again."""

    def exchange(self, set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        """Send one cycle's set-points (order of ``setup.joints``) and return all joints' feedback.

        The returned objects are the driver's own and change with the next call. A joint that did not report this
        cycle keeps its last figures with ``age_cycles`` counted up.
        """

    def quick_stop(self) -> None:
        """Stop every joint by the fastest safe way, from any state; never raises, never waits for an answer."""

    def stop_cycling(self) -> None:
        """End cyclic traffic after standstill; SDO is possible again."""

    def close(self) -> None:
        """Bring everything to rest and release the bus; safe to call twice and after errors.

        Joints whose power was not seen to go off are named afterwards by ``may_be_powered``, where a driver can tell.
        """


@runtime_checkable
class FrameMapped(Protocol):
    """A driver whose frames can be decoded again from a log (see ``frictid_hil.protocol.frames``)."""

    def frame_map_values(self) -> Mapping[str, Any]:
        """Which frame carries what, as configured, as plain values that name their ``schema``; after ``configure``."""


@runtime_checkable
class Remarking(Protocol):
    """A driver that goes on without settings which hardware does not take, and says so."""

    def remarks(self) -> list[Finding]:
        """What could not be set, and what that means; after ``configure``."""


@runtime_checkable
class Resettable(Protocol):
    """A driver that can bring drives back after a fault, or after a run that was cut off."""

    def faults(self) -> list[Finding]:
        """What keeps drives from running again; after ``open``, reads only."""

    def reset_faults(self) -> None:
        """Bring those drives back; nothing gets power. ``HardwareError`` where one stays in fault."""


@runtime_checkable
class Batched(Protocol):
    """A driver whose controller runs whole motions by itself and hands over what it recorded (``batch_only``).

    Its ``start_cycling`` and ``stop_cycling`` begin and end a stretch under power; in between there are ``standing``
    and ``run_batch`` instead of ``exchange``, and all joints but the one that runs are held by the controller.
    """

    batch_columns: Mapping[str, Any]  # what was fetched of the last job; after an error, as far as the transfer came

    def standing(self) -> Sequence[Feedback]:
        """Position and state of every joint, slowly read; without velocity and torque."""

    def run_batch(
        self,
        plan: JointPlan,  # the joint stands where its first motion begins
        *,
        stop: Callable[[], bool],  # asked often; True brings the joint to rest and raises ``Interrupted``
        progress: Callable[[str, float], None],  # told ``motion`` or ``transfer`` and the share that is done
        # Given ``standing`` several times while the joint moves; its ``SafetyAbort`` brings the joint to rest.
        look: Callable[[Sequence[Feedback]], None],
        # Given every portion of samples as it comes (the first five columns below), in order and without a gap.
        arrived: Callable[[Mapping[str, Any]], None],
    ) -> Mapping[str, Any]:
        """One joint's motions as one job; blocks until the joint stands again and its recording is here.

        Returns:
            Columns of shape (n,): ``time_ns`` (run time), ``position_rad``, ``velocity_rad_s``, ``torque_nm``,
            ``position_command_rad``; ``motion_starts_ns``, shape (motions + 1,), the last one the end; and
            ``dropped_pulses``, how much of the command the controller left out.

        Raises:
            FrictidError: whatever ended it; ``batch_columns`` keep what was measured.
        """


@runtime_checkable
class Ticked(Protocol):
    """A driver whose controller interpolates on a clock of its own, which its robot file names."""

    def cycle_quantum_s(self) -> float:
        """As in ``Capabilities``; before ``open``, so that a plan can be made and shown without any hardware."""


def known_drivers() -> list[str]:
    """Names of the installed drivers, sorted."""
    return sorted(point.name for point in entry_points(group="frictid_hil.drivers"))


@functools.cache  # looking through every installed package takes its time
def load_driver(name: str) -> type[Driver]:
    """The driver class registered under ``name``.

    Raises:
        InvalidFields: no such driver; the message lists the installed ones.
    """
    for point in entry_points(group="frictid_hil.drivers", name=name):
        loaded: type[Driver] = point.load()
        return loaded
    raise InvalidFields(
        [FieldProblem(("driver",), f"no driver named {name!r}; installed: {', '.join(known_drivers())}")]
    )


def new_driver(name: str, setup: RobotSetup) -> Driver:
    """A driver of this kind for this robot, not yet opened.

    Raises:
        InvalidFields: no such driver, or options that it does not take.
    """
    driver: Driver = load_driver(name)(setup)  # type: ignore[call-arg]  # protocols carry no constructor
    return driver


def kind_of(name: str) -> DriverKind:
    """What the driver registered under ``name`` is; that of a plain CAN driver where it does not say.

    Raises:
        InvalidFields: no such driver.
    """
    kind: DriverKind = getattr(load_driver(name), "kind", DriverKind())
    return kind


def line_of(interface: str) -> str:
    """The line that an interface of ``interface:channel`` is: whatever is neither serial nor virtual is CAN."""
    return interface if interface in ("serial", "virtual") else "can"


def unknown_options(
    given: Mapping[str, Any], known: Collection[str], path: tuple[str | int, ...], driver: str
) -> list[FieldProblem]:
    """A problem for every option that the driver does not take, with the option that was probably meant.

    ``given`` are the options of the robot file, or those of one joint, and ``path`` says where they stand in it.
    """
    problems = []
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(str(name), known, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]}?" if near else f"known here: {', '.join(sorted(known)) or 'none'}"
            problems.append(FieldProblem((*path, name), f"is no option of the {driver} driver; {hint}"))
    return problems


def number_option(
    given: Mapping[str, Any],
    name: str,
    usual: float,
    low: float,
    high: float,
    path: tuple[str, ...],
    problems: list[FieldProblem],
) -> float:
    """A number among the options, ``usual`` where it is not given; not from ``low`` to ``high``, it is a problem more.

    ``given`` are the options of the robot file, or those of one joint, and ``path`` says where they stand in it.
    """
    value = given.get(name, usual)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        problems.append(FieldProblem((*path, name), f"expected a number from {low:g} to {high:g}, found {value!r}"))
        return usual
    return float(value)


def planned_quantum_s(name: str, setup: RobotSetup) -> float:
    """What cycle lengths are rounded to multiples of under this driver; 0 where they are not.

    Raises:
        InvalidFields: no such driver, or options that it does not take.
    """
    driver_class = load_driver(name)
    if not issubclass(driver_class, Ticked):
        return 0.0
    driver: Ticked = driver_class(setup)  # type: ignore[call-arg]  # protocols carry no constructor
    return driver.cycle_quantum_s()
