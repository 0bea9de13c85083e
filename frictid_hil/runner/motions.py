"""Streams, supervises and marks the motions of the joints that move, and watches some of them more closely.

Joints that move together do so in step: their stretches end at the same cycle. Each joint is held to its own travel,
speed, torque and following error. A rehearsal judges the sign of friction under half the torque, a probe compares
friction with a profile, a warm-up ends when friction has settled, and control laws take a single joint out of position
control.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from frictid_hil.errors import ProfileMismatch
from frictid_hil.plan.control import Compensated, Probe
from frictid_hil.plan.plan import REHEARSAL, JointPlan, Motion, Move, WarmUp, stretch_name
from frictid_hil.plan.setup import JointSetup
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.cycle import CycleCount, CyclicLoop, SetPointSource, Stream
from frictid_hil.runner.events import Event, Marked, PhaseStarted, Warned
from frictid_hil.runner.law_runner import LawRunner
from frictid_hil.runner.probe import ProbeWatch
from frictid_hil.runner.sign_watch import SignWatch
from frictid_hil.runner.supervisor import JointLimits
from frictid_hil.runner.warm_up import WarmUpWatch

AT_RAD = 1e-4  # a joint this near to where it should be needs no approach
REHEARSAL_TORQUE = 0.5  # share of a joint's maximum torque that its rehearsal may take


def from_here(here_rad: float, motions: Sequence[Motion], approach_rad_s: float) -> list[Motion]:
    """The motions, after a small approach where the joint does not stand exactly at their beginning."""
    approach = _approach(here_rad, motions[0], approach_rad_s)
    return list(motions) if abs(approach.to_rad - here_rad) <= AT_RAD else [approach, *motions]


def stream(loop: CyclicLoop, index: int, motion: Motion) -> None:
    """Stream one motion of one joint, from its first set-point to its last."""
    loop.run({index: _set_points({index: motion}, loop.period_s)[index]})


@dataclass(frozen=True)
class Motions:
    """The motions of one joint, or of several in step."""

    loop: CyclicLoop  # of the stretch; these joints follow their set-points, all others are locked
    joints: Mapping[int, JointSetup]  # that move, by index
    limits: Sequence[JointLimits]  # of all joints while they are in position control
    approach_rad_s: float  # speed of small approaches
    notify: Callable[[Event], None]  # told what happens

    @cached_property
    def _laws(self) -> dict[int, LawRunner]:
        return {index: LawRunner(self.loop, joint, index, self.limits[index]) for index, joint in self.joints.items()}

    def run(self, plans: Mapping[int, JointPlan]) -> dict[int, list[Mark]]:
        """Run the motions in order; the marks of each joint (``SafetyAbort``, or ``Interrupted``: all at rest)."""
        loop, name = self.loop, stretch_name(list(plans.values()))
        marks: dict[int, list[Mark]] = {index: [] for index in plans}
        for motions in self._from_here({index: plan.motions for index, plan in plans.items()}):
            self._leave_laws(motions)
            first = next(iter(motions.values()))
            self.notify(PhaseStarted(name, first.name, first.duration_s))
            sources, ending = self._sources(motions)
            start_ns, before = loop.now_ns(), replace(loop.count, stops=list(loop.count.stops))
            loop.run(sources, ending=ending)
            end_ns = loop.now_ns()
            for index, motion in motions.items():
                details = {**motion.details(), **self._told(before), **self._judged(index, motion, sources[index])}
                marks[index].append(Mark(motion.name, start_ns, end_ns, details))
            for index in motions:
                self.notify(Marked(self.joints[index].name, marks[index][-1]))
        return marks

    def _from_here(self, motions: Mapping[int, Sequence[Motion]]) -> list[dict[int, Motion]]:
        """The stretches, after a small approach where a joint does not stand exactly at its beginning."""
        stretches = [dict(zip(motions, stretch, strict=True)) for stretch in zip(*motions.values(), strict=True)]
        approach = {
            index: _approach(self.loop.set_points[index].position_rad, own[0], self.approach_rad_s)
            for index, own in motions.items()
        }
        if not any(abs(move.to_rad - move.from_rad) > AT_RAD for move in approach.values()):
            return stretches
        longest_s = max(move.duration_s for move in approach.values())
        return [{index: replace(move, duration_s=longest_s) for index, move in approach.items()}, *stretches]

    def _leave_laws(self, motions: Mapping[int, Motion]) -> None:
        """Return to position control, and go to where the next motion begins."""
        for index, motion in motions.items():
            if not isinstance(motion, Compensated) and self._laws[index].leave():
                for back in self._from_here({index: [motion]})[:-1]:
                    stream(self.loop, index, back[index])

    def _sources(self, motions: Mapping[int, Motion]) -> tuple[Mapping[int, SetPointSource], SetPointSource | None]:
        """The set-points of every joint, watched as its motion asks, and the source that ends a control law."""
        ((index, motion), *others) = motions.items()
        if isinstance(motion, Compensated) and not others:
            law = self._laws[index].source(motion)
            return {index: law}, self._laws[index].fade_out(law)
        streams = _set_points(motions, self.loop.period_s)
        return {index: self._watched(index, motions[index], stream) for index, stream in streams.items()}, None

    def _watched(self, index: int, motion: Motion, points: Stream) -> SetPointSource:
        joint, alone = self.joints[index], len(self.joints) == 1
        if isinstance(motion, Probe) and alone:
            return ProbeWatch(points, motion, joint.name)
        if isinstance(motion, WarmUp) and alone:  # of several, one that settles must not end the others' motion
            return WarmUpWatch(points, motion, self.loop.period_s)
        if motion.name != REHEARSAL:
            return points
        # The full travel, slowly, with the torque bound at half; the sign of friction must be right.
        slow = replace(self.limits[index], torque_nm=REHEARSAL_TORQUE * joint.max_torque_nm)
        self.loop.supervisor.set_limits(index, slow)
        return SignWatch(points, joint.name, self.loop.period_s)

    def _judged(self, index: int, motion: Motion, source: SetPointSource) -> dict[str, Any]:
        """Judge a watched motion; returns what its mark tells besides."""
        if isinstance(source, SignWatch):
            self.loop.supervisor.set_limits(index, self.limits[index])
            source.judge()
        elif isinstance(source, ProbeWatch) and isinstance(motion, Probe):
            try:
                source.judge()
            except ProfileMismatch as mismatch:
                if motion.enforced:
                    raise
                self.notify(Warned(f"forced in spite of: {mismatch}"))
        elif isinstance(source, WarmUpWatch):
            rate = source.percent_per_min
            if source.settled is False:
                changing = "could not be told" if rate is None else f"still changed by {rate:.2g} % per minute"
                name, lasted_s = self.joints[index].name, motion.duration_s
                self.notify(Warned(f"joint {name}: friction {changing} after {lasted_s:.0f} s of warm-up"))
            return {"settled": source.settled, "percent_per_min": rate, "cycles": source.cycles}
        return {}

    def _told(self, before: CycleCount) -> dict[str, Any]:
        """Of the cycles since: where set-points stood still, how many were limited by the drive, who moved together."""
        count, told = self.loop.count, dict[str, Any]()
        if not self.loop.driver.clock.lock_step:
            told["stops_ns"] = [list(stop) for stop in count.stops[len(before.stops) :]]
        if len(self.joints) > 1:
            return {**told, "together": [joint.name for joint in self.joints.values()]}
        limited = count.limited - before.limited
        return {**told, "limited_share": limited / (count.streamed - before.streamed)} if limited else told


def _approach(here_rad: float, motion: Motion, speed_rad_s: float) -> Move:
    return Move.within(here_rad, float(motion.position_rad(np.zeros(1))[0]), speed_rad_s, name="approach")


def _set_points(motions: Mapping[int, Motion], period_s: float) -> dict[int, Stream]:
    """The set-points of one stretch, equally many for every joint."""
    steps = max(1, math.ceil(max(motion.duration_s for motion in motions.values()) / period_s - 1e-9))
    times_s = np.arange(steps) * period_s
    return {index: Stream(motion.position_rad(times_s).tolist(), period_s) for index, motion in motions.items()}
