"""Several joints in step: the same stretches at the same time, each joint supervised, each with a mark of its own.

Nothing is locked then: the supervisor holds every joint to its own travel, speed, torque and following error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.plan.plan import Motion, Move
from frictid_hil.plan.setup import JointSetup
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.cycle import CyclicLoop, SetPointSource, Stream
from frictid_hil.runner.motions import AT_RAD, REHEARSAL_TORQUE
from frictid_hil.runner.sign_watch import SignWatch
from frictid_hil.runner.supervisor import JointLimits, Supervisor


class InStep:
    """The joints that move together.

    Args:
        loop: cycling, these joints enabled and not locked.
        supervisor: of the loop.
        joints: by index.
    """

    def __init__(self, loop: CyclicLoop, supervisor: Supervisor, joints: Mapping[int, JointSetup]) -> None:
        self._loop = loop
        self._supervisor = supervisor
        self._joints = dict(joints)

    def stretches(self, motions: Mapping[int, Sequence[Motion]], approach_rad_s: float) -> Iterator[dict[int, Motion]]:
        """The planned stretches, after a small approach where a joint does not stand exactly at its beginning."""
        here_rad = {index: self._loop.set_points[index].position_rad for index in motions}
        first_rad = {index: float(own[0].position_rad(np.zeros(1))[0]) for index, own in motions.items()}
        approach = {
            index: Move.within(here_rad[index], first_rad[index], approach_rad_s, name="approach") for index in motions
        }
        if any(abs(move.to_rad - move.from_rad) > AT_RAD for move in approach.values()):
            longest_s = max(move.duration_s for move in approach.values())
            yield {index: replace(move, duration_s=longest_s) for index, move in approach.items()}
        for stretch in zip(*motions.values(), strict=True):
            yield dict(zip(motions, stretch, strict=True))

    def stream(self, motions: Mapping[int, Motion]) -> dict[int, Mark]:
        """One motion of every joint, all over at the same cycle.

        Raises:
            SafetyAbort: by the supervisor.
            Interrupted: asked to stop; all joints were brought to rest.
        """
        return self._run(
            motions, {index: Stream(points, self._loop.period_s) for index, points in self._points(motions).items()}
        )

    def rehearse(self, motions: Mapping[int, Motion], limits: Mapping[int, JointLimits]) -> dict[int, Mark]:
        """The full travels, slowly, with the torque bounds at half; the sign of every joint's friction must be right.

        Args:
            motions: by index.
            limits: that hold again afterwards, by index.

        Raises:
            SafetyAbort: by the supervisor, or where friction helps motion.
            Interrupted: asked to stop.
        """
        for index, normal in limits.items():
            self._supervisor.set_limits(
                index, replace(normal, torque_nm=REHEARSAL_TORQUE * self._joints[index].max_torque_nm)
            )
        watches = {
            index: SignWatch(Stream(points, self._loop.period_s), self._joints[index].name)
            for index, points in self._points(motions).items()
        }
        marks = self._run(motions, watches)
        for index, normal in limits.items():
            self._supervisor.set_limits(index, normal)
        for watch in watches.values():
            watch.judge()
        return marks

    def _points(self, motions: Mapping[int, Motion]) -> dict[int, list[float]]:
        """Set-points of one stretch: as many for every joint."""
        period_s = self._loop.period_s
        steps = max(1, math.ceil(max(motion.duration_s for motion in motions.values()) / period_s - 1e-9))
        times_s = np.arange(steps) * period_s
        return {index: motion.position_rad(times_s).tolist() for index, motion in motions.items()}

    def _run(self, motions: Mapping[int, Motion], sources: Mapping[int, SetPointSource]) -> dict[int, Mark]:
        loop = self._loop
        start_ns = loop.now_ns()
        loop.run_together(sources)
        end_ns = loop.now_ns()
        company = [joint.name for joint in self._joints.values()]
        return {
            index: Mark(motion.name, start_ns, end_ns, {**motion.details(), "together": company})
            for index, motion in motions.items()
        }
