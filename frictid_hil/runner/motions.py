"""The motions of one joint, each streamed, supervised and marked; some of them watched more closely than that.

A rehearsal judges the sign of friction under half the torque, a probe compares friction with a profile, a warm-up ends
when friction has settled, and control laws take the joint out of position control.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.errors import ProfileMismatch
from frictid_hil.plan.control import Compensated, Probe
from frictid_hil.plan.plan import REHEARSAL, JointPlan, Motion, Move, WarmUp
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Driver
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.cycle import CyclicLoop, SetPointSource, Stream
from frictid_hil.runner.events import Event, Marked, PhaseStarted, Warned
from frictid_hil.runner.law_runner import LawRunner
from frictid_hil.runner.probe import ProbeWatch
from frictid_hil.runner.sign_watch import SignWatch
from frictid_hil.runner.supervisor import JointLimits, Supervisor
from frictid_hil.runner.warm_up import WarmUpWatch

AT_RAD = 1e-4
"""A joint this near to where it should be needs no approach."""
REHEARSAL_TORQUE = 0.5
"""Share of a joint's maximum torque that its rehearsal may take."""


def from_here(here_rad: float, motions: Sequence[Motion], approach_rad_s: float) -> list[Motion]:
    """The motions, after a small approach where the joint does not stand exactly at their beginning."""
    first_rad = float(motions[0].position_rad(np.zeros(1))[0])
    if abs(first_rad - here_rad) <= AT_RAD:
        return list(motions)
    return [Move.within(here_rad, first_rad, approach_rad_s, name="approach"), *motions]


def stream(loop: CyclicLoop, index: int, motion: Motion) -> Mark:
    """One motion of one joint, from its first set-point to its last."""
    return _streamed(loop, index, motion, _set_points(motion, loop.period_s))


class Motions:
    """One joint's motions.

    Args:
        driver: cycling.
        loop: of the stretch; the joint follows its set-points, all others are locked.
        supervisor: of the loop.
        joint: that moves.
        index: of it.
        limits: of the joint while it is in position control.
        approach_rad_s: speed of small approaches.
        notify: told what happens.
    """

    def __init__(
        self,
        driver: Driver,
        loop: CyclicLoop,
        supervisor: Supervisor,
        joint: JointSetup,
        index: int,
        limits: JointLimits,
        *,
        approach_rad_s: float,
        notify: Callable[[Event], None],
    ) -> None:
        self._loop = loop
        self._supervisor = supervisor
        self._joint = joint
        self._index = index
        self._limits = limits
        self._approach_rad_s = approach_rad_s
        self._notify = notify
        self._laws = LawRunner(driver, loop, supervisor, joint, index, limits)

    def run(self, plan: JointPlan) -> list[Mark]:
        """All motions of the plan, in order.

        Raises:
            SafetyAbort: by the supervisor, or friction is not what it must be.
            Interrupted: asked to stop; the joint was brought to rest.
        """
        marks: list[Mark] = []
        for motion in self._from_here(plan.motions):
            if not isinstance(motion, Compensated) and self._laws.leave():
                for back in self._from_here([motion])[:-1]:
                    stream(self._loop, self._index, back)
            self._notify(PhaseStarted(plan.joint, motion.name, motion.duration_s))
            mark = self._one(motion)
            self._notify(Marked(plan.joint, mark))
            marks.append(mark)
        return marks

    def _one(self, motion: Motion) -> Mark:
        if isinstance(motion, Compensated):
            return self._laws.run(motion)
        if isinstance(motion, Probe):
            return self._probe(motion)
        if isinstance(motion, WarmUp):
            return self._warm_up(motion)
        if motion.name == REHEARSAL:
            return self._rehearse(motion)
        return stream(self._loop, self._index, motion)

    def _rehearse(self, motion: Motion) -> Mark:
        """The full travel, slowly, with the torque bound at half; the sign of friction must be right."""
        slow = replace(self._limits, torque_nm=REHEARSAL_TORQUE * self._joint.max_torque_nm)
        self._supervisor.set_limits(self._index, slow)
        watch = SignWatch(self._set_points(motion), self._joint.name)
        mark = _streamed(self._loop, self._index, motion, watch)
        self._supervisor.set_limits(self._index, self._limits)
        watch.judge()
        return mark

    def _probe(self, probe: Probe) -> Mark:
        """A slow sine whose torque must be what the profile says."""
        watch = ProbeWatch(self._set_points(probe), probe, self._joint.name)
        mark = _streamed(self._loop, self._index, probe, watch)
        try:
            watch.judge()
        except ProfileMismatch as mismatch:
            if probe.enforced:
                raise
            self._notify(Warned(f"forced in spite of: {mismatch}"))
        return mark

    def _warm_up(self, motion: WarmUp) -> Mark:
        """Repeated cycles until friction settles, or the time is over."""
        watch = WarmUpWatch(self._set_points(motion), motion, self._loop.period_s)
        mark = _streamed(self._loop, self._index, motion, watch)
        if watch.settled is False:
            rate = watch.percent_per_min
            changing = "could not be told" if rate is None else f"still changed by {rate:.2g} % per minute"
            self._notify(
                Warned(f"joint {self._joint.name}: friction {changing} after {motion.duration_s:.0f} s of warm-up")
            )
        ended = {"settled": watch.settled, "percent_per_min": watch.percent_per_min, "cycles": watch.cycles}
        return replace(mark, details={**mark.details, **ended})

    def _from_here(self, motions: Sequence[Motion]) -> list[Motion]:
        return from_here(self._loop.set_points[self._index].position_rad, motions, self._approach_rad_s)

    def _set_points(self, motion: Motion) -> Stream:
        return _set_points(motion, self._loop.period_s)


def _set_points(motion: Motion, period_s: float) -> Stream:
    steps = max(1, math.ceil(motion.duration_s / period_s))
    return Stream(motion.position_rad(np.arange(steps) * period_s).tolist(), period_s)


def _streamed(loop: CyclicLoop, index: int, motion: Motion, source: SetPointSource) -> Mark:
    start_ns, streamed, limited = loop.now_ns(), loop.count.streamed, loop.count.limited
    loop.run(source, index)
    details = motion.details()
    if loop.count.limited > limited:
        details = {**details, "limited_share": (loop.count.limited - limited) / (loop.count.streamed - streamed)}
    return Mark(motion.name, start_ns, loop.now_ns(), details)
