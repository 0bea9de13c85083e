"""Layer B, batch: one job sent as one message, run and recorded by the controller, fetched in CRC-checked blocks.

Fits 9600 and 19200 baud: 4000 samples of 10 bytes are 40 kB, about half a minute at 19200. The data of a BSC block may
hold no control codes, so binary travels as base64 text.
"""

from __future__ import annotations

import base64
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from typing import Final

import numpy as np

from frictid_drivers.motoman.controller_errors import (
    BadReply,
    ControllerError,
    LinkError,
    ManipulatorOperating,
    NoSuchJob,
)
from frictid_drivers.motoman.host_control import HostControl
from frictid_drivers.motoman.joint_units import AxisUnits
from frictid_drivers.motoman.stream_frames import crc16
from frictid_hil.errors import FrictidError, HardwareError, Interrupted, SafetyAbort
from frictid_hil.friction.curve import FrictionCurve

TABLE_POINTS: Final = 21
_POLL_S: Final = 0.5

_FINISHED, _STOPPED = 3, 4
_STOP_REASONS: Final = {
    1: ("it heard nothing from the host for too long", "check the cable, then start again"),
    2: ("somebody pressed hold", "release it, then start again"),
    3: ("an alarm", "clear its cause, reset on the pendant, then start again"),
    4: ("a limit of position or step", "compare the limits of both sides with `check`"),
    5: ("torque above its limit", "look for a collision, a wrong travel, or a heavier load than planned"),
    6: ("the host asked it to", ""),
    7: ("servo power was lost", "look at the pendant, then start again"),
}


@dataclass(frozen=True, slots=True)
class BatchHello:
    """What the batch application says of itself."""

    tick_us: int  # interpolation clock
    axes: int  # how many it has
    most_ticks: int  # longest job
    torque_measured: bool  # feedback torque is measured, not commanded
    averaging_ms: int | None  # moving average on the command, None where it does not know
    table_points: int  # points of a friction table, 0 where it cannot compensate
    name: str  # of the application
    reads_while_running: bool = False  # it hands over what is recorded already while the job runs


@dataclass(frozen=True, slots=True)
class JobOrder:
    """One job of one axis; positions and bounds in pulses."""

    number: int  # 1..65535, to tell it from the job before
    axis: int
    start: int  # where it begins; the axis must stand there
    lowest: int
    highest: int
    step: int  # most pulses per tick
    torque_micro: int  # torque limit at the motor shaft, uN m
    watchdog_ticks: int  # ticks without a word from the host after which it stops
    segments: Sequence[str]  # see ``motion_segments``

    def text(self) -> str:
        """The FJOB command, with its CRC over everything up to and including the last comma."""
        *figures, segments = astuple(self)
        covered = f"FJOB 1,{','.join(map(str, [*figures, *segments]))},"
        return f"{covered}{crc16(covered.encode('ascii')):04X}"


@dataclass(frozen=True, slots=True)
class JobState:
    """The reply to FSTAT."""

    number: int
    state: int
    done_ticks: int
    total_ticks: int
    alarm: int
    reason: int
    velocity_shift: int
    torque_shift: int
    dropped_pulses: int


def friction_table(
    units: AxisUnits,
    curve: FrictionCurve,
    ratio: float,
    stiffness_nm_per_rad: float,
    gravity_cos_nm: float,
    gravity_sin_nm: float,
) -> str:
    """One axis's compensation, base64 with its CRC; see ``download_table``.

    The curve is given at 21 equal steps of speed from standstill to the fastest identified one, in the controller's
    units: torque in uN m at the motor shaft, positions in pulses, speed in 0.1 pulse/s, stiffness in nN m per pulse.
    """
    pulses_per_rad = abs(units.pulses_per_rad)
    fastest_rad_s = curve.measured_range_rad_s[1]
    step_tenths = max(1, round(fastest_rad_s / (TABLE_POINTS - 1) * pulses_per_rad * 10.0))
    speeds_rad_s = np.arange(TABLE_POINTS) * step_tenths * 0.1 / pulses_per_rad
    stiffness_nano = max(1, round(stiffness_nm_per_rad / units.gear_ratio / pulses_per_rad * 1e9))
    raw = struct.pack(
        f"<BBHIIIii{TABLE_POINTS}i",
        *(units.axis, TABLE_POINTS, round(ratio * 1e4), step_tenths, stiffness_nano),
        round(2 * math.pi * pulses_per_rad),
        # Where positive pulses turn the joint backwards, torque and angle change sign: cosine flips, sine stays.
        *(units.motor_micro(gravity_cos_nm) * units.direction, units.motor_micro(gravity_sin_nm)),
        *(units.motor_micro(float(torque)) for torque in curve.magnitude(speeds_rad_s)),
    )
    return base64.b64encode(raw + crc16(raw).to_bytes(2, "little")).decode("ascii")


class BatchClient:
    """Talks to the batch application, beside the stock commands of ``host``."""

    def __init__(self, host: HostControl) -> None:
        self.host = host

    def hello(self) -> BatchHello:
        """FHELLO, and whether FREAD 2 is known; ``UnknownCommand`` where there is no such application."""
        reply = self.host.ask("FHELLO 1")
        try:
            version, *figures, name = reply.split(",", 7)
            if int(version) != 1:
                raise BadReply(f"the batch application speaks version {version}, we speak 1", where="FHELLO")
            tick_us, axes, most_ticks, source, averaging, table_points = map(int, figures)
            averaging_ms, more = None if averaging < 0 else averaging, self._reads_while_running()
            return BatchHello(tick_us, axes, most_ticks, source == 1, averaging_ms, table_points, name, more)
        except ValueError:
            raise self.host.bad_reply(f"{reply!r} instead of a greeting", "FHELLO") from None

    def _reads_while_running(self) -> bool:
        """Asked for a job that cannot be: who knows the command finds the job missing, anybody else the command."""
        try:
            reply = self.host.ask("FREAD 2,0,0,1")
        except NoSuchJob:
            return True
        except ControllerError:
            return False
        raise self.host.bad_reply(f"{reply!r} instead of a refusal", "FREAD 2,0,0,1")

    def send(self, order: JobOrder) -> None:
        """FJOB. ``ControllerError`` where the controller refuses it."""
        self.host.order(order.text())

    def start(self, number: int) -> None:
        """FRUN; the arm moves."""
        try:
            self.host.order(f"FRUN 1,{number}")
        except ManipulatorOperating:
            # Asked twice because an acknowledgement was lost: the first one was heard.
            if self.state(number).state != 2:
                raise

    def state(self, number: int, *, within_s: float | None = None) -> JobState:
        """FSTAT."""
        reply = self.host.ask(f"FSTAT 1,{number}", within_s=within_s)
        try:
            state = JobState(*map(int, reply.split(",")))
        except (ValueError, TypeError):
            raise self.host.bad_reply(f"{reply!r} instead of a job's state", "FSTAT") from None
        if state.number != number:
            raise BadReply(f"state of job {state.number} instead of {number}", where="FSTAT")
        return state

    def stop(self, number: int, *, within_s: float | None = None) -> None:
        """FSTOP: decelerate."""
        self.host.order(f"FSTOP 1,{number}", within_s=within_s)

    def watch(
        self,
        number: int,
        duration_s: float,
        stop: Callable[[], bool],
        progress: Callable[[float], None],
        look: Callable[[float], None] = lambda within_s: None,
        follow: Callable[[JobState, float], bool] = lambda state, within_s: False,
        *,
        watchdog_s: float = 5.0,
    ) -> JobState:
        """Wait for the end of a running job; asking is also what keeps its watchdog quiet.

        Our own timers are shorter meanwhile, and what was not answered is asked again: a byte that the line damages
        must not cost the time after which the watchdog stops the job. No answer is taken for that of another question,
        since each names itself (a job's state by its number, the others by how many figures they have).

        ``stop`` is asked often. ``look`` is called once per question with how long it may take; its ``SafetyAbort``
        ends the job and is raised once the joint stands. ``follow`` is called between two rounds of questions, when
        the line is free, with the state and how long it may take, for as long as it says that it did something.

        ``Interrupted`` where ``stop`` asked for it, ``SafetyAbort`` where the controller stopped, ``HardwareError``
        where it does not come to an end, or the line is dead.
        """
        now_s = self.host.port.now_s
        within_s, patience_s = watchdog_s / 3, duration_s * 1.2 + 10.0
        until_s = now_s() + patience_s
        answered_s, stopping, told = now_s(), False, False
        wrong: SafetyAbort | None = None
        with self.host.impatient(watchdog_s / 6):
            while True:
                stopping = stopping or stop()
                try:
                    if stopping and not told:
                        self.stop(number, within_s=within_s)
                        told = True
                    state = self.state(number, within_s=within_s)
                    if not stopping and state.state not in (_FINISHED, _STOPPED):
                        look(within_s)
                    answered_s = now_s()
                except SafetyAbort as seen:
                    wrong, stopping = seen, True
                    continue
                except (LinkError, BadReply):
                    if now_s() > answered_s + self.host.patience_s:
                        raise
                    continue
                progress(state.done_ticks / max(1, state.total_ticks))
                if state.state == _FINISHED:
                    return state
                if state.state == _STOPPED:
                    raise wrong or _why_stopped(state, number, asked=stopping)
                if now_s() > until_s:
                    self.stop(number)
                    raise _not_over(number, patience_s, duration_s)
                pause_until_s = now_s() + min(_POLL_S, watchdog_s / 10)
                while now_s() < pause_until_s and (stopping or not stop()):
                    if not follow(state, within_s):
                        self.host.listen(min(0.05, pause_until_s - now_s()))

    def download(self, axis: int, coded: str) -> None:
        """FTABLE, read back and compared; ``BadReply`` where what comes back is not what was sent."""
        self.host.order(f"FTABLE 1,{coded}")
        if self.host.ask(f"FTREAD 1,{axis}") != coded:
            raise BadReply("the friction table reads back differently", where=f"axis {axis}")

    def compensate(self, axis_mask: int) -> None:
        """FCOMP: apply the tables of these axes from now on; 0 ends it."""
        self.host.order(f"FCOMP 1,{axis_mask}")


def _not_over(number: int, patience_s: float, planned_s: float) -> HardwareError:
    return HardwareError(
        f"not over after {patience_s:.0f} s, planned {planned_s:.0f} s",
        where=f"job {number}",
        cause="the controller ticks more slowly than it says, or the job hangs",
        next_step="look at the pendant; compare `check` with the controller's interpolation clock",
    )


def _why_stopped(state: JobState, number: int, *, asked: bool) -> FrictidError:
    """What a job that ended before its end is told as."""
    if asked:
        return Interrupted("stopped on request; the joint was brought to rest")
    why, next_step = _STOP_REASONS.get(state.reason, (f"reason {state.reason}", ""))
    alarm = f", alarm {state.alarm}" if state.alarm else ""
    return SafetyAbort(
        f"the controller stopped the job at tick {state.done_ticks} of {state.total_ticks}: {why}{alarm}",
        where=f"job {number}",
        next_step=next_step,
    )
