"""One row per joint on a terminal: phase, bar, following error, torque against its limit, temperature, lateness."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Column

from frictid_hil.plan.setup import RobotSetup
from frictid_hil.runner.ring import Rows
from frictid_hil.units import degrees

_REDRAW_S = 0.1
_BAR_CELLS = 10
_ROOM_FOR_BARS = 100  # columns of a terminal; on a narrower one the torque is a figure without its bar


def figures_of(rows: Rows, max_torque_nm: float | None) -> dict[str, str]:
    """What rows of one joint tell: largest error, torque (a bar with its limit), newest temperature; or ""."""
    error_rad = _largest(rows["position_command_rad"] - rows["position_rad"])
    torque_nm = _largest(rows["torque_nm"])
    temperature_c = float(rows["temperature_c"][-1])
    return {
        "error": f"{degrees(error_rad):.3f} deg" if math.isfinite(error_rad) else "",
        "torque": torque_bar(torque_nm, max_torque_nm) if math.isfinite(torque_nm) else "",
        "temperature": f"{temperature_c:.1f} C" if math.isfinite(temperature_c) else "",
    }


def torque_bar(torque_nm: float, max_torque_nm: float | None) -> str:
    """A bar of ten cells, full at the limit, and the figure; the figure alone without a limit."""
    if max_torque_nm is None:
        return f"{torque_nm:5.1f} N m"
    cells = min(_BAR_CELLS, round(_BAR_CELLS * torque_nm / max_torque_nm)) if max_torque_nm > 0 else 0
    return f"{'█' * cells}{'·' * (_BAR_CELLS - cells)} {torque_nm:5.1f} N m"


class Lateness:
    """Counts late cycles from the rows alone, while the loop's own count is still in its process."""

    def __init__(self, period_s: float) -> None:
        self._most_ns = 1.5e9 * period_s
        self._newest_ns: int | None = None
        self.late = 0

    def take(self, t_ns: np.ndarray[tuple[int], np.dtype[np.int64]]) -> int:
        """Late cycles so far: rows, with these times since the last call, over 1.5 periods after the one before."""
        if self._newest_ns is not None:
            t_ns = np.concatenate([[self._newest_ns], t_ns])
        self.late += int(np.count_nonzero(np.diff(t_ns) > self._most_ns))
        self._newest_ns = int(t_ns[-1])
        return self.late

    def pause(self) -> None:
        """Cycles end here, and go on after a while."""
        self._newest_ns = None


class JointView:
    """The rows of one run, by joint."""

    def __init__(
        self,
        console: Console,
        setup: RobotSetup,
        period_s: float,  # of a cycle; infinite where a controller cycles by itself and sends its recording afterwards
        planned: Mapping[str, float],  # s, by stretch: the name of its joint, or of joints that move together
        members: Mapping[str, Sequence[str]],
    ) -> None:
        self._setup = setup
        self._lateness = {joint.name: Lateness(period_s) for joint in setup.joints}
        self._index = {joint.name: index for index, joint in enumerate(setup.joints)}
        self._planned = planned
        self._members = members
        self._stretch = ""
        self._drawn_at = -math.inf
        self._bars = console.width >= _ROOM_FOR_BARS
        torque = "torque:<20" if self._bars else "torque:>9"
        fields = ("phase:<11", "error:>10", torque, "temperature:>7", "late:>7")
        texts = [TextColumn(f"{{task.fields[{name}]:{form}}}") for name, form in (one.split(":") for one in fields)]
        self._progress = Progress(
            TextColumn("joint {task.description}"),
            BarColumn(20 if self._bars else 8),
            *texts,
            TimeRemainingColumn(table_column=Column(no_wrap=True)),
            console=console,
        )
        self._tasks: dict[str, TaskID] = {}
        for stretch, joints in members.items():
            for name in joints:
                total = planned[stretch] if math.isfinite(planned[stretch]) else None
                self._tasks[name] = self._progress.add_task(
                    name, total=total, start=False, phase="waiting", error="", torque="", temperature="", late=""
                )
        self._progress.start()

    @property
    def console(self) -> Console:
        """Prints above the rows."""
        return self._progress.console

    def phase(self, stretch: str, phase: str, completed_s: float) -> None:
        """A stretch of the plan goes into another phase."""
        if phase == "configure" or stretch != self._stretch:
            for lateness in self._lateness.values():
                lateness.pause()  # no cycles in between
        self._stretch = stretch
        for name in self._members.get(stretch, ()):
            self._progress.start_task(self._tasks[name])
            self._progress.update(self._tasks[name], completed=completed_s, phase=phase)

    def rows(self, rows: Rows, completed_s: float) -> None:
        """New rows of all joints; every one is counted, a few times a second they are drawn."""
        now = time.monotonic()
        drawn = now - self._drawn_at >= _REDRAW_S
        for name in self._members.get(self._stretch, ()):
            mine = rows[rows["joint"] == self._index[name]]
            if not mine.size:
                continue
            late = self._lateness[name].take(mine["t_ns"])
            if drawn:
                figures: dict[str, Any] = figures_of(
                    mine, self._setup.joint(name).max_torque_nm if self._bars else None
                )
                self._progress.update(self._tasks[name], completed=completed_s, late=f"{late} late", **figures)
        if drawn:
            self._drawn_at = now

    def done(self, joint: str, late_cycles: int) -> None:
        """A joint's motions are over; ``late_cycles`` as the loop itself counted them."""
        if joint in self._tasks:
            (total,) = (self._planned[stretch] for stretch, names in self._members.items() if joint in names)
            late = f"{late_cycles} late"
            self._progress.update(self._tasks[joint], completed=total, phase="done", error="", torque="", late=late)

    def close(self) -> None:
        """Leave the rows as they are."""
        self._progress.stop()


def _largest(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    """Largest magnitude of the finite values; NaN where there is none."""
    finite = np.abs(values[np.isfinite(values)])
    return float(finite.max()) if finite.size else math.nan
