"""Remembers which travels of a robot were rehearsed slowly, with the torque watched, and may be driven fast.

A rehearsal counts for the robot file, the bus and the joints that moved together as they were then, and for the travel
that was seen. Anything else - another bus, a longer travel, a changed file, an exchanged drive - is rehearsed anew.
A rehearsal of simulated drives proves nothing about a machine and is not kept.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from platformdirs import user_state_path

from frictid_hil.config.robot import Robot
from frictid_hil.errors import UsageError
from frictid_hil.files import could_not_write, write_whole
from frictid_hil.plan.plan import REHEARSAL, JointPlan, Plan
from frictid_hil.runner.events import Event, JointRun, Preflight

_SCHEMA = "frictid.rehearsals/1"
_SLACK_RAD = 1e-3
_KEPT = 200


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """One joint's travel, seen slowly."""

    config_sha256: str  # of the robot file
    bus: str
    joint: str
    moving: tuple[str, ...]  # joints that moved with it, itself included, sorted
    low_rad: float
    high_rad: float
    serial: str = ""  # of the drive


class Rehearsals:
    """The rehearsals of one robot on one bus, the file's own unless told."""

    def __init__(self, robot: Robot, bus: str | None = None) -> None:
        self._robot = robot
        self._bus = bus or robot.file.bus
        self._simulated = robot.kind(bus).simulated
        self._serials: dict[str, str] = {}

    def covers(self, joint: str, low_rad: float, high_rad: float, moving: Sequence[str] = ()) -> bool:
        """This travel was seen, with the same joints moving (the joint alone unless told)."""
        return any(
            seen.low_rad <= low_rad + _SLACK_RAD and high_rad <= seen.high_rad + _SLACK_RAD
            for seen in self._seen(joint)
            if seen.moving == _together(joint, moving)
        )

    def heed(self, event: Event, plan: Plan) -> None:
        """Keep what a finished run rehearsed; refuse an exchanged drive if its joint is not going to rehearse.

        ``UsageError``: exchanged; what it rehearsed is forgotten. ``FrictidError``: what was rehearsed cannot be
        written.
        """
        if self._simulated:
            return
        if isinstance(event, Preflight):
            self._serials = {name: identity.serial for name, identity in event.identities.items()}
            for entry in plan.joints:
                if not any(motion.name == REHEARSAL for motion in entry.motions):
                    self._refuse_exchanged(entry.joint)
        elif isinstance(event, JointRun) and any(mark.name == REHEARSAL for mark in event.marks):
            self._keep(next(entry for entry in plan.joints if entry.joint == event.joint), plan)

    def _refuse_exchanged(self, joint: str) -> None:
        serial = self._serials.get(joint, "")
        before = {seen.serial for seen in self._seen(joint)}
        if before and serial not in before:
            self._write([seen for seen in self._all() if seen not in self._seen(joint)])
            raise UsageError(
                f"its drive has serial number {serial or 'none'}, the joint was rehearsed with "
                f"{', '.join(sorted(before)) or 'none'}",
                where=f"joint {joint}",
                cause="the drive was exchanged, or this is another robot",
                next_step="start again: the joint will first rehearse its whole travel slowly",
            )

    def _keep(self, entry: JointPlan, plan: Plan) -> None:
        (motion,) = (motion for motion in entry.motions if motion.name == REHEARSAL)
        positions = motion.position_rad(np.linspace(0.0, motion.duration_s, 2001))
        moving = _together(entry.joint, [one.joint for one in plan.joints] if plan.together else [])
        travel, serial = (float(positions.min()), float(positions.max())), self._serials.get(entry.joint, "")
        seen = Rehearsal(self._robot.digest, self._bus, entry.joint, moving, *travel, serial)
        self._write([*self._all(), seen])

    def _seen(self, joint: str) -> list[Rehearsal]:
        if self._simulated:
            return []
        mine = (self._robot.digest, self._bus, joint)
        return [seen for seen in self._all() if (seen.config_sha256, seen.bus, seen.joint) == mine]

    def _all(self) -> list[Rehearsal]:
        try:
            known = json.loads(self._path.read_text())
            if known["schema"] != _SCHEMA:
                return []
            return [Rehearsal(**{**one, "moving": tuple(one["moving"])}) for one in known["seen"]]
        except (OSError, ValueError, KeyError, TypeError):
            return []  # never rehearsed, or a file that cannot be trusted: rehearse again

    def _write(self, seen: Sequence[Rehearsal]) -> None:
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise could_not_write(self._path.parent, error) from error
        kept = [asdict(one) for one in seen[-_KEPT:]]
        write_whole(self._path, json.dumps({"schema": _SCHEMA, "seen": kept}, indent=1))

    @property
    def _path(self) -> Path:
        return user_state_path("frictid-hil") / "rehearsed" / f"{self._robot.name}.json"


def _together(joint: str, moving: Sequence[str]) -> tuple[str, ...]:
    return tuple(sorted({joint, *moving}))
