"""Watching a run: one row per joint with phase and ETA on a terminal, plain lines without one."""

from __future__ import annotations

import contextlib
import math
import select
import sys
import termios
from collections.abc import Callable, Iterator

import typer
from rich.console import Console

from frictid_hil.cli.joint_view import JointView
from frictid_hil.cli.output import Output, Result, folding
from frictid_hil.errors import Interrupted, UsageError
from frictid_hil.jobs.live import DEFAULT_ADDRESS
from frictid_hil.jobs.live import live as live_watcher
from frictid_hil.jobs.watch import Watcher
from frictid_hil.plan.plan import Plan, described, stretch_name
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import Severity
from frictid_hil.runner.events import Event, JobProgress, JointRun, PhaseStarted, Preflight, Warned
from frictid_hil.runner.ring import Rows
from frictid_hil.runner.stop_signals import handling_signals
from frictid_hil.units import degrees, format_duration

_ANSWERS = {"y": True, "yes": True, "n": False, "no": False, "": False}
_HEAR_SIGNALS_EVERY_S = 0.2


def shown_plan(output: Output, plan: Plan, setup: RobotSetup) -> Result:
    """What ``--dry-run`` tells; no bus is opened."""
    print_plan(output.out, plan, setup)
    return {"outcome": "ok", "dry_run": True, "plan": described(plan)}


def print_plan(console: Console, plan: Plan, setup: RobotSetup) -> None:
    """Whether it is real, joint order, travel, peaks, limits, locked joints, duration, as a technician reads them."""
    how = ", all joints together" if plan.together else ""
    console.print(_which(setup), style="bold", soft_wrap=True)
    limited = ("travel (limits), deg", "speed of limit, deg/s", "torque of limit, N m")
    headings = ("joint", *limited, "time", "others locked, deg")
    title = f"Plan for {plan.robot}: {format_duration(plan.duration_s)} at {plan.cycle_hz:g} Hz{how}"
    table = folding(*headings, whole=("joint",), title=title)
    for entry in plan.joints:
        joint = setup.joint(entry.joint)
        locked = " ".join(f"{name}:{degrees(at):.0f}" for name, at in entry.locked.items())
        predicted = f"{entry.predicted_torque_nm:.1f}" if entry.predicted_torque_nm else "unknown"
        limits = _range_deg(joint.position_min_rad, joint.position_max_rad)
        table.add_row(
            entry.joint,
            f"{_range_deg(*entry.travel_rad)} ({limits})",
            f"{degrees(entry.peak_velocity_rad_s):.1f} of {degrees(joint.max_velocity_rad_s):.0f}",
            f"{predicted} of {joint.max_torque_nm:.1f}",
            format_duration(entry.duration_s),
            locked or "none: all move",
        )
    console.print(table)
    for note in plan.notes:
        console.print(f"note: {note}")


def _which(setup: RobotSetup) -> str:
    """In capitals, because a person must not miss it."""
    if setup.simulated:
        return f"SIMULATED: no real robot moves (bus {setup.bus})"
    return f"REAL: the robot on {setup.bus} moves"


def _range_deg(low_rad: float, high_rad: float) -> str:
    return f"{degrees(low_rad):.4g} .. {degrees(high_rad):.4g}"


def answer(question: str) -> bool:
    """A person's yes or no, typed after the question was shown (``Interrupted``: Ctrl-C, Ctrl-D or SIGTERM)."""

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    try:
        with handling_signals(stop):
            with contextlib.suppress(termios.error, OSError, ValueError):  # no terminal
                termios.tcflush(sys.stdin, termios.TCIFLUSH)
            while (said := _line_typed_after(f"{question} [y/N]: ")) not in _ANSWERS:
                typer.echo("Please type y or n.", err=True)
            return _ANSWERS[said]
    except (EOFError, KeyboardInterrupt):
        typer.echo(err=True)
        raise Interrupted("interrupted at the question; nothing moves", next_step="start again") from None


def _line_typed_after(prompt: str) -> str:
    """The next line, in lower case (``EOFError``: Ctrl-D).

    A signal that comes just before a blocking read is heard by Python only after it. So nothing is read before a
    line is there, and signals are heard every so often until then.
    """
    typer.echo(prompt, nl=False, err=True)
    while not select.select([sys.stdin], [], [], _HEAR_SIGNALS_EVERY_S)[0]:
        pass
    line = sys.stdin.readline()
    if not line:
        raise EOFError
    return line.strip().lower()


class TerminalWatcher:
    """The watcher of the command line."""

    def __init__(self, output: Output, *, yes: bool) -> None:
        self._console = output.err
        self._silent = output.as_json or output.quiet
        self._yes = yes
        self._which = ""
        self._view: JointView | None = None
        self._period_s = math.inf
        self._make_view: Callable[[], JointView] | None = None
        self._done_s = 0.0
        self._phase = ""
        self._phase_s = 0.0
        self._joint = ""
        self._stretch_began_s: float | None = None

    def plan(self, plan: Plan, setup: RobotSetup) -> None:
        """Print it, remember the durations; refuse at once where nobody could be asked."""
        if not self._yes and not sys.stdin.isatty():
            raise UsageError(
                "motion needs a yes, and there is no terminal to ask on",
                next_step="add --yes once the plan is right (see --dry-run)",
            )
        self._which = _which(setup)
        self._period_s = 1.0 / plan.cycle_hz
        members = {stretch_name(stretch): [entry.joint for entry in stretch] for stretch in plan.stretches}
        planned = {stretch_name(stretch): max(entry.duration_s for entry in stretch) for stretch in plan.stretches}
        self._make_view = lambda: JointView(self._console, setup, self._period_s, planned, members)
        if not self._silent:
            print_plan(self._console, plan, setup)

    def confirm(self, plan: Plan, preflight: Preflight) -> bool:
        """Ask, unless the person said yes beforehand."""
        if preflight.capabilities.batch_only:
            self._period_s = math.inf  # its cycles are the controller's own
        for finding in preflight.findings:
            if finding.severity is not Severity.OK:
                self.note(f"{finding.severity.value}: {finding.subject}: {finding.message}")
        if self._yes:
            return True
        joints = stretch_name(plan.joints)
        how = "ALL AT ONCE" if plan.together else "one at a time, all others locked"
        return answer(f"{self._which}. {plan.robot}: joints {joints} will move, {how}. Is the cell clear?")

    def ask(self, question: str) -> bool:
        """Ask; with ``--yes``, or without a terminal, nobody is there to have done anything."""
        if self._yes or not sys.stdin.isatty():
            return False
        self.close()
        return answer(question)

    def event(self, event: Event) -> None:
        """Follow the phases."""
        if isinstance(event, PhaseStarted):
            self._start_phase(event)
        elif isinstance(event, JobProgress):
            self._show_job(event)
        elif isinstance(event, JointRun) and self._view is not None:
            self._view.done(event.joint, event.late_cycles + event.missed_cycles)
        elif isinstance(event, Warned):
            self.note(f"warning: {event.message}")

    def rows(self, rows: Rows) -> None:
        """Move the bar of the current joint, and tell its figures."""
        if self._view is None:
            return
        now_s = float(rows["t_ns"][-1]) * 1e-9
        if self._stretch_began_s is None:
            self._stretch_began_s = float(rows["t_ns"][0]) * 1e-9
        # Run time goes on from joint to joint; a planned phase is never shown further than its end.
        self._view.rows(rows, min(now_s - self._stretch_began_s, self._done_s + self._phase_s))

    def joint(self, joint: str, summary: str, ok: bool) -> None:
        """A line per finished joint."""
        self.note(f"joint {joint}: {summary}")

    def note(self, message: str) -> None:
        """A line above the bars."""
        if not self._silent:
            (self._view.console if self._view else self._console).print(message)

    def close(self) -> None:
        """End the bars."""
        if self._view is not None:
            self._view.close()
            self._view = None

    def _start_phase(self, event: PhaseStarted) -> None:
        if self._silent:
            return
        if event.joint != self._joint:
            self._joint = event.joint
            self._done_s = 0.0
            self._stretch_began_s = None
        else:
            self._done_s += self._phase_s
        self._phase_s = event.duration_s
        self._phase = event.phase
        if not self._console.is_terminal:
            if event.duration_s >= 1.0 or event.phase == "configure":
                self._console.print(f"joint {event.joint}: {event.phase} {format_duration(event.duration_s)}")
            return
        if self._view is None and self._make_view is not None:
            self._view = self._make_view()
        if self._view is not None:
            self._view.phase(event.joint, event.phase, self._done_s)

    def _show_job(self, event: JobProgress) -> None:
        """A job moves the bar; the transfer of its recording shows its own share."""
        if self._silent:
            return
        if self._view is not None:
            if event.stage == "motion":
                self._view.phase(event.joint, self._phase, self._done_s + event.share * self._phase_s)
            else:
                self._view.phase(event.joint, f"{event.stage} {event.share:.0%}", self._done_s)
        elif event.stage == "transfer" and event.share >= 1.0:
            self._console.print(f"joint {event.joint}: recording fetched")


@contextlib.contextmanager
def watching(output: Output, *, yes: bool, live: bool = False, live_at: str | None = None) -> Iterator[Watcher]:
    """The terminal's watcher while a job lasts, which streams as well where ``--live`` or ``--live-at`` asks for it."""
    watcher = TerminalWatcher(output, yes=yes)
    try:
        with live_watcher(watcher, live_at or (DEFAULT_ADDRESS if live else None)) as streamed:
            yield streamed
    finally:
        watcher.close()
