"""The serial driver: streaming as the cyclic exchange, batch as ``run_batch``, and stock controllers to look at."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from frictid_drivers.motoman import inspection
from frictid_drivers.motoman.batch import friction_table
from frictid_drivers.motoman.batch_run import BatchRun
from frictid_drivers.motoman.cycle import StreamCycle, TickClock
from frictid_drivers.motoman.joint_units import Limits, axis_units
from frictid_drivers.motoman.layers import Line, Reach, find_layer, streamed_mask
from frictid_drivers.motoman.port import BytePort, SerialPort
from frictid_drivers.motoman.settings import serial_options
from frictid_hil.errors import ConfigError, FrictidError, HardwareError, PlanRefused
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import JointPlan, Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import (
    Capabilities,
    DriverKind,
    Feedback,
    Finding,
    FrameSink,
    JointIdentity,
    JointState,
    SetPoint,
)

PortFactory = Callable[[str, int, str], BytePort]  # opens a port: path, baud, parity

_SERIAL_BYTES_ID = 0x8000_0000 | 0x1FFF_FF00
"""Marks portions of serial bytes in a bus log; no CAN drive uses this identifier."""
_LOGGED_LENGTHS = (64, 48, 32, 24, 20, 16, 12, *range(8, 0, -1))
"""Lengths that a bus log can hold (those of CAN FD); bytes on the wire are cut into the longest of them."""

_URGENT_S = 0.5


class MotomanDriver:
    """A MOTOMAN-class controller on a serial port; an emulator brings its own ``port_factory``, on virtual time.

    ``InvalidFields`` where an option is unknown or impossible, or pulses per degree are missing; ``ConfigError`` where
    the bus is no serial port.
    """

    kind = DriverKind(
        line="serial", addressed_by="axis", addresses=(0, 63), elsewhere={"virtual": "virtual", "can": "cia402"}
    )

    def __init__(self, setup: RobotSetup, *, port_factory: PortFactory | None = None) -> None:
        interface, _, self._path = setup.bus.partition(":")
        if interface != "serial" or not self._path:
            raise ConfigError(
                f"the bus of a serial controller is serial:PORT, found {setup.bus!r}",
                next_step="`--bus serial:/dev/ttyUSB0`, or the port that `emulate motoman --pty` prints",
            )
        self._setup = setup
        self._options = serial_options(setup.options)
        self._units = axis_units(setup.joints)
        self._port_factory = port_factory or SerialPort
        self._tick_us = round(1e6 / setup.cycle_hz)
        self._line: Line | None = None
        self._reach = Reach()
        self._cycle: StreamCycle | None = None
        self._sink: FrameSink | None = None
        self._active: list[str] = []
        self._job: BatchRun | None = None
        self._job_number = 0
        self._limits = {
            joint.name: Limits(joint.position_min_rad, joint.position_max_rad, joint.max_torque_nm)
            for joint in setup.joints
        }
        self._batching = False
        self.clock = TickClock(lock_step=port_factory is not None)
        self.batch_columns: dict[str, Any] = {}

    def open(self, frame_sink: FrameSink | None = None) -> None:
        """Take the port exclusively, reach the controller, find out which layer it can do. Nothing moves."""
        self._sink = frame_sink
        options = self._options
        parity = options.parity_on(self._path)
        port = self._port_factory(self._path, options.baud, parity)
        try:
            self._line = Line(port, options, parity, self._tick_us, self._log)
            self._line.host.status()
            self._reach = find_layer(self._line, options, self._mask(self._units))
        except BaseException:
            self._line = None
            port.close()
            raise

    def identify(self) -> dict[str, JointIdentity]:
        """What controller and robot file say of every joint."""
        return {
            joint.name: inspection.identity(joint, self._units[joint.name], self._options, self._reach)
            for joint in self._setup.joints
        }

    def capabilities(self) -> Capabilities:
        """What the layer that was found can do."""
        return inspection.capabilities(self._reach, self._options, self._tick_us, lock_step=self.clock.lock_step)

    def cycle_quantum_s(self) -> float:
        """The interpolation clock that the robot file names; ``check`` compares it with the controller's."""
        return self._tick_us * 1e-6

    def check(self, plan: Plan | None) -> list[Finding]:
        """Status, alarms, layers, limits of both sides, line load; reads only."""
        return inspection.findings(self._setup, self._units, self._options, self._reach, self._open_line().host, plan)

    def configure(self, cycle_hz: float, active: Sequence[str]) -> None:
        """Choose the axes of the stream; ``PlanRefused`` where the controller cannot do this, or not at this rate."""
        if self._reach.layer == "host":
            raise PlanRefused(
                "this controller offers no torque: " + "; ".join(self._reach.reasons.values()),
                next_step="install the controller application (docs/reference/motoman-controller-application.md)",
            )
        if round(1e6 / cycle_hz) != self._tick_us:
            raise PlanRefused(f"the controller ticks every {self._tick_us} us, not at {cycle_hz:g} Hz")
        for name in active:
            self._setup.joint(name)
        self._active = list(active)

    def set_limits(self, joint: str, *, torque_nm: float, position_min_rad: float, position_max_rad: float) -> None:
        """Kept on every target, and sent along with every job; ``HardwareError`` beyond the controller's own travel."""
        limits = self._limits[joint] = Limits(position_min_rad, position_max_rad, torque_nm)
        welcome = self._reach.welcome
        if welcome is None:
            return
        units = self._units[joint]
        bound = welcome.limits[(welcome.axis_mask & ((1 << units.axis) - 1)).bit_count()]
        low, high = units.travel(limits)
        if low < bound.lowest or high > bound.highest:
            raise HardwareError(
                f"the controller allows {bound.lowest}..{bound.highest} pulses, the robot file {low}..{high}",
                where=f"joint {joint}",
                next_step="narrow `position_min_rad` and `position_max_rad` in the robot file",
            )

    def start_cycling(self) -> None:
        """Servo power on (the arm holds where it stands), then streaming; run time starts at the first tick."""
        line = self._open_line()
        if self._reach.layer == "batch":  # power stays on, between the jobs as well, and run time starts now
            line.power.on()
            self._batching = True
            self.clock.start(line.port.now_s)
            return
        welcome = self._reach.welcome
        if welcome is None:
            raise HardwareError("this controller does not stream", next_step="see `frictid-hil check`")
        active = self._mask(self._active or self._units)
        mask = streamed_mask(self._mask(self._units), active, self._options.stream_baud, welcome.tick_us)
        line.power.on()
        pulses = line.host.pulses()
        session = line.begin_stream(mask)
        self._cycle = StreamCycle(session, self._setup.joints, self._units, self._limits, pulses, self.clock)

    def enable(self, joint: str, mode: Mode) -> None:
        """Let the joint follow its set-points from here on; ``HardwareError`` for a mode other than position."""
        if mode is not Mode.POSITION:
            raise HardwareError(f"a serial controller cannot do mode {mode.name}", where=f"joint {joint}")
        self._cycling().wanted.add(self._setup.joint(joint).name)

    def disable(self, joint: str) -> None:
        """Hold the joint and no longer follow its set-points; servo power goes off with ``stop_cycling``."""
        self._cycling().wanted.discard(self._setup.joint(joint).name)

    def lock(self, joint: str) -> None:
        """Hold the joint where it stands, whatever its set-point."""
        self._cycling().locked.add(self._setup.joint(joint).name)

    def unlock(self, joint: str) -> None:
        """Follow the set-point again."""
        self._cycling().locked.discard(self._setup.joint(joint).name)

    def exchange(self, set_points: Sequence[SetPoint]) -> Sequence[Feedback]:
        """Targets out, newest report in; ``SafetyAbort`` where the controller stopped, or a target is out of bounds."""
        return self._cycling().exchange(set_points)

    def stop_cycling(self) -> None:
        """Back to host control, servo power off."""
        cycle, self._cycle = self._cycle, None
        if cycle is None and not self._batching:
            return
        line, self._batching = self._open_line(), False
        self.clock.release()
        if cycle is not None:
            line.end_stream(cycle.session)
        line.power.off()

    def quick_stop(self) -> None:
        """Tell a stream at once, a job within half a second; our silence lets the controller's watchdog act too."""
        with contextlib.suppress(FrictidError):
            if self._cycle is not None:
                self._cycle.session.halt()
            elif self._job is not None and self._job.running:
                self._job.batch.stop(self._job.number, within_s=_URGENT_S)

    def close(self) -> None:
        """Everything to rest, servo power off, port released; safe to call twice and after errors."""
        line, self._line = self._line, None
        if line is None:
            return
        cycle, self._cycle = self._cycle, None
        job, self._job = self._job, None
        self._batching = False
        self.clock.release()
        try:
            if cycle is not None:
                line.end_stream(cycle.session)
            if job is not None and job.running:
                job.batch.stop(job.number, within_s=_URGENT_S)
            if line.power.ours:
                line.power.off(urgent=True)
        except FrictidError:
            # The line itself failed; the controller's watchdog stops the arm.
            return
        finally:
            line.port.close()

    def run_batch(
        self,
        plan: JointPlan,
        *,
        stop: Callable[[], bool] = lambda: False,
        progress: Callable[[str, float], None] = lambda phase, share: None,
        look: Callable[[Sequence[Feedback]], None] | None = None,
        arrived: Callable[[Mapping[str, Any]], None] = lambda samples: None,
    ) -> Mapping[str, Any]:
        """One joint's motions as one job on the controller; see ``Batched.run_batch``, also for what it raises.

        ``look`` is given what ``standing`` says about twice a second. Times are run time, from the controller's answer
        to the start on.
        """
        line, hello = self._open_line(), self._reach.batch
        if hello is None:
            raise HardwareError("this controller has no batch application", next_step="see `frictid-hil check`")
        if hello.tick_us != self._tick_us:
            raise PlanRefused(f"the controller ticks every {hello.tick_us} us, the plan every {self._tick_us} us")
        self._job_number = self._job_number % 65535 + 1
        self._job = BatchRun(
            batch=line.batch,
            joint=self._setup.joint(plan.joint),
            units=self._units[plan.joint],
            limits=self._limits[plan.joint],
            watchdog_s=self._options.watchdog_s,
            tick_s=self._tick_us * 1e-6,
            number=self._job_number,
            now_ns=self.clock.now_ns,
            while_running=hello.reads_while_running,
            stop=stop,
            progress=progress,
            look=lambda within_s: look(self.standing(within_s=within_s)) if look else None,
            arrived=arrived,
        )
        self.batch_columns = {}
        try:
            self._job.run(plan, line.power.on)
        finally:
            self.batch_columns = self._job.columns
        if not self._batching:
            line.power.off()
        return self.batch_columns

    def standing(self, *, within_s: float | None = None) -> Sequence[Feedback]:
        """Every joint as host control sees it, position and state alone, each asked ``within_s``; about 0.1 s."""
        host = self._open_line().host
        status, pulses = host.status(within_s=within_s), host.pulses(within_s=within_s)
        state = JointState.ENABLED if status.servo_on else JointState.DISABLED
        return [
            Feedback(
                t_ns=self.clock.now_ns(),
                position_rad=self._units[joint.name].position_rad(pulses[self._units[joint.name].axis]),
                state=JointState.FAULT if status.faulty else state,
                mode=Mode.POSITION,
                status_raw=status.data_1 | status.data_2 << 8,
                valid=True,
            )
            for joint in self._setup.joints
        ]

    def download_table(
        self,
        joint: str,
        curve: FrictionCurve,
        *,
        ratio: float,
        stiffness_nm_per_rad: float,
        gravity_cos_nm: float = 0.0,
        gravity_sin_nm: float = 0.0,
    ) -> None:
        """Give the controller one joint's friction curve, to be compensated on its own tick.

        The ratio is R of (24c), the stiffness K of (24a); while the joint floats, gravity_cos cos(q) + gravity_sin
        sin(q) holds it. ``HardwareError`` without such an application, or where the table reads back differently.
        """
        if not self.capabilities().table_download:
            raise HardwareError("this controller takes no friction table", where=f"joint {joint}")
        units = self._units[joint]
        table = friction_table(units, curve, ratio, stiffness_nm_per_rad, gravity_cos_nm, gravity_sin_nm)
        self._open_line().batch.download(units.axis, table)

    def compensate_by_table(self, joints: Sequence[str]) -> None:
        """Apply the downloaded tables of these joints from now on; none ends it."""
        self._open_line().batch.compensate(self._mask(joints))

    def _mask(self, joints: Iterable[str]) -> int:
        return sum(1 << self._units[name].axis for name in joints)

    def _open_line(self) -> Line:
        if self._line is None:
            raise HardwareError("the port is not open", where=self._path)
        return self._line

    def _cycling(self) -> StreamCycle:
        if self._cycle is None:
            raise HardwareError("nothing is streaming", where=self._path)
        return self._cycle

    def _log(self, data: bytes, sent: bool) -> None:
        if self._sink is None:
            return
        now_ns = self.clock.now_ns()
        while data:
            size = next(length for length in _LOGGED_LENGTHS if length <= len(data))
            self._sink(now_ns, _SERIAL_BYTES_ID, data[:size], sent)
            data = data[size:]
