"""A watcher of a job shows the plan, asks the person and follows the phases. The command line is one watcher."""

from __future__ import annotations

from typing import Protocol

from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.runner.events import Event, Preflight
from frictid_hil.runner.ring import Rows


class Watcher(Protocol):
    """Everything a job says while it works; nothing here decides a result except ``confirm`` and ``ask``."""

    def plan(self, plan: Plan, setup: RobotSetup) -> None:
        """The plan, before anything is opened."""
        ...

    def confirm(self, plan: Plan, preflight: Preflight) -> bool:
        """Ask the person, with the hardware read and the plan shown."""
        ...

    def ask(self, question: str) -> bool:
        """Ask whether a person has done what the question says; False where nobody can be asked."""
        ...

    def event(self, event: Event) -> None:
        """Something happened on the hardware."""
        ...

    def rows(self, rows: Rows) -> None:
        """What was measured since the last call, rows of ``ring.SAMPLE_ROW``; as it is written to disk."""
        ...

    def joint(self, joint: str, summary: str, ok: bool) -> None:
        """A joint's result in a line."""
        ...

    def note(self, message: str) -> None:
        """A line a person should see."""
        ...


class Silent:
    """Watches nothing and says yes; for scheduled jobs and tests."""

    def plan(self, plan: Plan, setup: RobotSetup) -> None:
        """Ignore it."""

    def confirm(self, plan: Plan, preflight: Preflight) -> bool:
        """Answer yes."""
        return True

    def ask(self, question: str) -> bool:
        """Answer no, because nobody is there."""
        return False

    def event(self, event: Event) -> None:
        """Ignore it."""

    def rows(self, rows: Rows) -> None:
        """Ignore it."""

    def joint(self, joint: str, summary: str, ok: bool) -> None:
        """Ignore it."""

    def note(self, message: str) -> None:
        """Ignore it."""
