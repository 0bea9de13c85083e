"""A watcher of a job shows the plan, asks the person and follows the phases. The command line is one watcher."""

from __future__ import annotations

from typing import Any, Protocol

from frictid_hil.plan.plan import Plan
from frictid_hil.runner.events import Preflight
from frictid_hil.runs.life import Follower


class Watcher(Follower, Protocol):
    """Everything a job says while it works; nothing here decides a result except ``confirm`` and ``ask``."""

    def ask(self, question: str) -> bool:
        """Ask whether a person has done what the question says; False where nobody can be asked."""

    def joint(self, joint: str, summary: str, ok: bool) -> None:
        """A joint's result in a line."""

    def note(self, message: str) -> None:
        """A line a person should see."""


class Silent:
    """Watches nothing and says yes; for scheduled jobs and tests."""

    def confirm(self, plan: Plan, preflight: Preflight) -> bool:
        """Answer yes."""
        return True

    def ask(self, question: str) -> bool:
        """Answer no, because nobody is there."""
        return False

    def note(self, *_: Any, **__: Any) -> None:
        """Ignore it."""

    plan = event = rows = joint = note
