"""One joint's plan as one job: checked, sent, started, watched, fetched, and turned into columns."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from frictid_drivers.motoman.batch import BatchClient, JobOrder
from frictid_drivers.motoman.batch_record import JobRecord
from frictid_drivers.motoman.controller_errors import BadReply, ControllerError, LinkError
from frictid_drivers.motoman.joint_units import AxisUnits, Limits
from frictid_drivers.motoman.segments import JobMotion, motion_segments
from frictid_hil.errors import FrictidError, HardwareError, Interrupted, PlanRefused, SafetyAbort
from frictid_hil.plan.plan import JointPlan
from frictid_hil.plan.setup import JointSetup
from frictid_hil.units import degrees

_AT_START_RAD = 0.005
_ANSWERS_WITHIN_S = 2.0
_COMES_BACK_S = 10.0  # how long after the job's watchdog a lost port may be there again; the record is fetched then


@dataclass
class BatchRun:
    """Runs one job; ``columns`` are filled in also where it was stopped, or its transfer broke."""

    batch: BatchClient  # the controller application
    joint: JointSetup
    units: AxisUnits
    limits: Limits
    watchdog_s: float  # the job stops when the controller hears nothing for so long
    tick_s: float  # interpolation clock
    number: int
    now_ns: Callable[[], int]  # of run time
    while_running: bool  # the controller application hands samples over while the job runs
    stop: Callable[[], bool]  # see ``MotomanDriver.run_batch``; so are ``progress`` and ``arrived``
    progress: Callable[[str, float], None]
    look: Callable[[float], None]  # asked once per question about the running job, told how long it may take
    arrived: Callable[[Mapping[str, Any]], None]
    running: bool = False  # the controller may be moving the arm for this job
    columns: dict[str, Any] = field(default_factory=dict)
    _started_ns: int = 0

    def run(self, plan: JointPlan, power_on: Callable[[], None]) -> None:
        """The whole job."""
        motion = motion_segments(plan.motions, self.units, self.tick_s)
        self.batch.send(self._order(motion))
        self._stand_at(motion.start)
        power_on()
        self.running = True

        def pass_on(first: int, last: int) -> None:
            self.arrived(self._samples(motion, record, first, last))

        record = JobRecord(self.batch.host, self.number, while_running=self.while_running, arrived=pass_on)
        try:
            self._run(record, len(motion.command) * self.tick_s)
        finally:
            if record.count:
                tick_ns = round(self.tick_s * 1e9)
                starts_ns = self._started_ns + np.array(motion.motion_ticks, dtype=np.int64) * tick_ns
                self.columns = {
                    **self._samples(motion, record, 0, record.count),
                    "motion_starts_ns": starts_ns,
                    "dropped_pulses": record.dropped_pulses,
                }

    def _run(self, record: JobRecord, duration_s: float) -> None:
        """Start it, see it end, and have its record, also where it was stopped."""
        try:
            self.batch.start(self.number)
            self._started_ns = self.now_ns()
            self.batch.watch(
                *(self.number, duration_s, self.stop, lambda share: self.progress("motion", share)),
                *(self.look, record.follow),
                watchdog_s=self.watchdog_s,
            )
        except HardwareError:
            # The controller stops by its watchdog, and keeps what it recorded.
            with contextlib.suppress(FrictidError):
                self._come_back(record)
            raise
        except FrictidError:
            self.running = False
            with contextlib.suppress(FrictidError):
                self._fetch(record)
            raise
        self.running = False
        self._fetch(record)

    def _come_back(self, record: JobRecord) -> None:
        """After a lost port: if it is there again soon, see that the joint stands, and fetch its record."""
        self._reconnect(self.stop)
        with contextlib.suppress(Interrupted, SafetyAbort):
            self.batch.watch(self.number, 0.0, lambda: True, lambda share: None)
        self.running = False
        self._fetch(record)

    def _reconnect(self, stop: Callable[[], bool]) -> None:
        host = self.batch.host
        until_s = host.port.now_s() + self.watchdog_s + _COMES_BACK_S
        while True:
            try:
                host.reconnect()
                self.batch.state(self.number, within_s=_ANSWERS_WITHIN_S)
                return
            except FrictidError:
                if stop() or host.port.now_s() > until_s:
                    raise

    def _order(self, motion: JobMotion) -> JobOrder:
        units, where = self.units, f"joint {self.joint.name}"
        lowest, highest = units.travel(self.limits)
        step = int(abs(self.joint.max_velocity_rad_s * self.tick_s * units.pulses_per_rad)) + 1
        if int(motion.command.min()) < lowest or int(motion.command.max()) > highest:
            raise PlanRefused("the job leaves the joint's travel", where=where)
        if int(np.abs(np.diff(motion.command)).max(initial=0)) > step:
            raise PlanRefused("the job exceeds the joint's velocity", where=where)
        return JobOrder(
            number=self.number,
            axis=units.axis,
            start=motion.start,
            lowest=lowest,
            highest=highest,
            step=step,
            torque_micro=units.motor_micro(self.limits.torque_nm),
            watchdog_ticks=round(self.watchdog_s / self.tick_s),
            segments=motion.segments,
        )

    def _stand_at(self, start: int) -> None:
        units = self.units
        here = self.batch.host.pulses()[units.axis]
        if abs(here - start) > abs(_AT_START_RAD * units.pulses_per_rad):
            raise HardwareError(
                f"stands at {degrees(units.position_rad(here)):.2f} deg, "
                f"the job starts at {degrees(units.position_rad(start)):.2f} deg",
                where=f"joint {self.joint.name}",
                next_step="bring it there first, or let the plan begin with a move from where it stands",
            )

    def _fetch(self, record: JobRecord) -> None:
        def fetch() -> None:
            record.complete(self.batch.state(self.number), lambda share: self.progress("transfer", share))

        try:
            fetch()
        except (LinkError, BadReply, ControllerError):
            raise
        except HardwareError:
            self._reconnect(lambda: False)
            fetch()  # from the first sample that is missing

    def _samples(self, motion: JobMotion, record: JobRecord, first: int, last: int) -> dict[str, Any]:
        """Columns of the samples [first, last), joint side."""
        units = self.units
        pulses, speed_tenths, torque_micro = record.samples(first, last).T
        numbers = np.arange(first, last, dtype=np.int64)
        # A job that was stopped early goes on recording while it decelerates: its command ends before its samples.
        command = motion.command[np.minimum(numbers, len(motion.command) - 1)]
        return {
            "time_ns": self._started_ns + numbers * round(self.tick_s * 1e9),
            "position_rad": pulses / units.pulses_per_rad,
            "velocity_rad_s": speed_tenths * 0.1 / units.pulses_per_rad,
            "torque_nm": torque_micro * (1e-6 * units.gear_ratio * units.direction),
            "position_command_rad": command / units.pulses_per_rad,
        }
