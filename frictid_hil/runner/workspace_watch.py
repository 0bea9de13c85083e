"""Watches that the arm stays in its workspace box while it moves, every few cycles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.errors import SafetyAbort
from frictid_hil.plan.workspace import Workspace
from frictid_hil.protocol.driver import Feedback

INTERVAL_S = 0.02  # at 1 m/s the arm moves 2 cm in between
SLACK_M = 0.01  # how far beyond the box a joint that lags or overshoots its command may carry the arm


class WorkspaceWatch:
    """Compares the place of every joint with the box, given that ``check`` is called at ``cycle_hz``."""

    def __init__(self, workspace: Workspace, names: Sequence[str], cycle_hz: float) -> None:
        faces = tuple((low - SLACK_M, high + SLACK_M) for low, high in workspace.box_m)
        self._workspace = replace(workspace, box_m=(faces[0], faces[1], faces[2]))
        self._names = tuple(names)
        self._every = max(1, round(INTERVAL_S * cycle_hz))
        self._cycle = 0

    def check(self, feedback: Sequence[Feedback]) -> None:
        """Judge the reports of one cycle; ``SafetyAbort`` where a joint or the tool is outside of the box."""
        self._cycle += 1
        if self._cycle % self._every:
            return
        posture = np.array([[report.position_rad for report in feedback]])
        if not np.all(np.isfinite(posture)):
            return  # a joint that does not report is another check's to judge
        found = self._workspace.outside(posture)
        if found is not None:
            raise SafetyAbort(
                found.described(self._names),
                cause="the arm is not where the plan has it, or it overshoots",
                next_step="bring the arm back inside by hand; widen `workspace`, or shift the start positions",
            )
