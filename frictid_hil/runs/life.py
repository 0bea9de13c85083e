"""The life of a run: planned -> preflight -> measuring -> ended.

::

    planned      checked and shown; nothing is opened, nothing is written
    preflight    the files are open, the hardware is read, a person is asked; an error here leaves no trace
    measuring    joints may have moved; whatever happens, what was measured stays
    ended        the manifest says how

A run that is refused in its preflight removes the files that it made for it and nothing else. From `measuring` on
nothing is removed, and an error is a way to end: ``move`` returns it, and a result is formed of what was measured.
A run neither chooses what moves (a job plans that) nor moves it (the runner does).
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from frictid_hil.config.robot import Robot
from frictid_hil.errors import Defect, FrictidError, GateFailed, Interrupted, UsageError
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import Driver
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.care import Care
from frictid_hil.runner.events import Event, JointRun, Marked, PhaseStarted, Preflight
from frictid_hil.runner.ring import Rows
from frictid_hil.runs.folder import RunFolder
from frictid_hil.runs.keeper import RowKeeper
from frictid_hil.runs.rehearsals import Rehearsals
from frictid_hil.runs.run import Keeper, run_plan


class State(Enum):
    """Where a run stands."""

    PLANNED = "planned"
    PREFLIGHT = "preflight"
    MEASURING = "measuring"
    ENDED = "ended"


class Follower(Protocol):
    """Who follows a run and is asked before anything moves."""

    def plan(self, plan: Plan, setup: RobotSetup) -> None:
        """The plan, before anything is opened."""

    def confirm(self, plan: Plan, preflight: Preflight) -> bool:
        """Ask the person, with the hardware read and the plan shown."""

    def event(self, event: Event) -> None:
        """Something happened on the hardware."""

    def rows(self, rows: Rows) -> None:
        """What was measured since the last call, rows of ``ring.SAMPLE_ROW``; as it is written to disk."""


@dataclass(frozen=True, slots=True)
class Order:
    """What shall be run, and where it is kept."""

    verb: str
    robot: Robot
    setup: RobotSetup
    bus: str | None = None  # ``interface:channel`` as typed; None for the robot file's own
    options: Mapping[str, Any] = field(default_factory=dict)  # what was asked for, plain values, for the manifest
    out: Path | None = None  # folder to use; None for a new one below ``runs/``
    resume: Path | None = None  # folder of an earlier run to go on with instead
    # Further folders that a result will be written to; seen to take files before anything moves.
    outputs: tuple[Path, ...] = ()
    continued_by: str = ""  # command that goes on with an interrupted run, without its folder; "" where none does

    @property
    def driver(self) -> str:
        """Entry-point name of the driver."""
        return self.robot.driver(self.bus)


@dataclass(frozen=True, slots=True)
class Ended:
    """How a run ended; every verb's result holds one. An error ended it early, or its result is not good enough."""

    robot: str
    run: Path
    error: FrictidError | None = None

    @property
    def outcome(self) -> str:
        """``ok``, or the outcome of the error."""
        return self.error.outcome if self.error else "ok"

    def to_json(self) -> dict[str, Any]:
        """What every verb that moves tells."""
        return {
            "outcome": self.outcome,
            "exit_code": self.error.exit_code if self.error else 0,
            "robot": self.robot,
            "run": str(self.run.resolve()),
            **({"error": self.error.to_json()} if self.error else {}),
        }


class Run:
    """The one owner of folder, manifest, stop, rehearsals and ending of a run; a context manager."""

    def __init__(self, order: Order, follower: Follower) -> None:
        self.state = State.PLANNED
        self._order = order
        self._follower = follower
        self._rehearsals = Rehearsals(order.robot, order.bus)
        self._folder: RunFolder | None = None
        self._identities: Mapping[str, Any] = {}
        self._marks: dict[str, list[Mark]] = {}

    def __enter__(self) -> Run:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        """Write into the manifest what ended the job between motion and result."""
        if self.state is State.MEASURING and error is not None:
            interrupted = isinstance(error, KeyboardInterrupt)
            told = Interrupted("interrupted after the motion had ended") if interrupted else Defect.of(error)
            self.end(error if isinstance(error, FrictidError) else told)
            if interrupted:
                raise self._with_next_step(told) from error

    @property
    def folder(self) -> RunFolder:
        """Where everything is kept; from the preflight on."""
        if self._folder is None:
            raise self._wrong("folder")
        return self._folder

    def move(
        self,
        plan: Plan,  # to be shown and done
        *,
        each: Callable[[JointRun], None],  # given every joint's run when it is over, before the next one begins
        # Told the preflight before the person is asked; refuses by raising.
        asked: Callable[[Preflight], None] = lambda _: None,
        noticed: Callable[[Event], None] = lambda _: None,  # told everything that happens
        through: Callable[[RowKeeper], Keeper] = lambda keeper: keeper,  # what stands between the rows and their keeper
        prepare: Callable[[Driver], None] | None = None,  # see ``run_plan``
        care: Care | None = None,  # bounds
    ) -> FrictidError | None:
        """Show a plan within every limit, open files, read the hardware, ask, and move; returns what ended it early.

        ``FrictidError``: before anything could move; nothing of it is left.
        """
        before = self._in(State.PLANNED, State.MEASURING)
        order = self._order
        self._follower.plan(plan, order.setup)
        self.state = State.PREFLIGHT
        keeper: RowKeeper | None = None
        ended: FrictidError | None = None

        def proceed(preflight: Preflight) -> bool:
            asked(preflight)
            return self._follower.confirm(plan, preflight)

        def notice(event: Event) -> None:
            self._notice(event, plan)
            noticed(event)
            if isinstance(event, JointRun):
                each(event)

        try:
            keeper = self._opened()
            with order.robot.document.locating():
                lost = run_plan(
                    order.driver,
                    order.setup,
                    plan,
                    through(keeper),
                    notify=notice,
                    proceed=proceed,
                    care=care,
                    prepare=prepare,
                )
            if lost:
                cause = "a slow disk or an overloaded computer"
                ended = GateFailed(f"{lost} rows were lost because files were written too slowly", cause=cause)
        except BaseException as error:
            if self.state is State.PREFLIGHT:
                self.state = before
                _closed(keeper)
                if self._folder is not None:
                    self._folder.withdraw()
                if before is State.PLANNED:
                    self._folder = None
                raise
            if not isinstance(error, FrictidError):
                _closed(keeper)
                raise
            ended = self._with_next_step(error)
        unwritten = _closed(keeper)
        return ended or unwritten

    def reopen(self) -> None:
        """Continue an earlier run that lacks nothing but its result; nothing moves."""
        self._in(State.PLANNED)
        assert self._order.resume is not None, "an earlier run"
        self._folder = RunFolder.resume(self._order.resume, self._order.robot)
        self._folder.begin()
        self.state = State.MEASURING

    def so_far(self, joint: str) -> JointRun | None:
        """The finished part of a joint's plan in a run that ended early; None where nothing was finished."""
        marks = tuple(self._marks.get(joint, ()))
        return JointRun(joint, 0, marks, 0.0, 0, 0, 0, 0.0, 0.0) if marks else None

    def rehearsed(self, run: JointRun, plan: Plan) -> None:
        """Count a rehearsal that was seen whole although its run was ended early."""
        self._rehearsals.heed(run, plan)

    def end(self, error: FrictidError | None = None) -> Ended:
        """Write into the manifest how the run ended. What was measured is on the disk already."""
        self._in(State.MEASURING)
        self.state = State.ENDED
        ended = Ended(self._order.robot.name, self.folder.path, error)
        try:
            self.folder.finish(ended.outcome, error.to_json() if error else None)
        except FrictidError:
            if error is None:
                raise
        return ended

    def _in(self, *states: State) -> State:
        if self.state not in states:
            raise self._wrong(" or ".join(state.value for state in states))
        return self.state

    def _wrong(self, needed: str) -> RuntimeError:
        return RuntimeError(f"run of {self._order.verb} is {self.state.value}, this needs {needed}")

    def _opened(self) -> RowKeeper:
        order = self._order
        if self._folder is None:
            if order.resume is None:
                self._folder = RunFolder.create(order.robot, order.verb, order.options, order.out)
            else:
                self._folder = RunFolder.resume(order.resume, order.robot)
            self._identities = dict(self._folder.manifest["identities"])
            for output in order.outputs:
                self._folder.claim_output(output)
        return self._folder.add_part([joint.name for joint in order.setup.joints], self._follower.rows)

    def _notice(self, event: Event, plan: Plan) -> None:
        self._follower.event(event)
        if isinstance(event, Preflight):
            self._refuse_other_drives(event)
        elif isinstance(event, PhaseStarted) and event.phase != "configure" and self.state is State.PREFLIGHT:
            # Drives are configured, and the cyclic traffic that can move them begins.
            self.folder.begin()
            self.state = State.MEASURING
        elif isinstance(event, Marked):
            self._marks.setdefault(event.joint, []).append(event.mark)
        self.folder.note(event)
        self._rehearsals.heed(event, plan)

    def _refuse_other_drives(self, preflight: Preflight) -> None:
        """Refuse, by a ``UsageError``, to continue a run with drives of other serial numbers than it began with."""
        for name, identity in preflight.identities.items():
            was = self._identities.get(name, {}).get("serial", identity.serial)
            if was != identity.serial:
                raise UsageError(
                    f"the drive has serial number {identity.serial or 'none'}, this run began with {was or 'none'}",
                    where=f"joint {name}",
                    cause="a drive was exchanged, or this is another robot",
                    next_step=f"start a new run; what was measured before is in {self.folder.path}",
                )

    def _with_next_step(self, error: FrictidError) -> FrictidError:
        """Add to an interruption the command that continues the run."""
        if isinstance(error, Interrupted):
            command = self._order.continued_by
            error.next_step = f"continue with `{command} {shlex.quote(str(self.folder.path))}`" if command else ""
        return error


def _closed(keeper: RowKeeper | None) -> FrictidError | None:
    """Close the files; returns the error where the last rows could not be written."""
    try:
        if keeper is not None:
            keeper.close()
    except FrictidError as error:
        return error
    return None
