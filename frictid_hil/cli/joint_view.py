"""One row per joint on a terminal: phase, bar, following error, torque against its limit, temperature, lateness."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from frictid_hil.driver import RobotSetup
from frictid_hil.runner.ring import Rows
from frictid_hil.units import degrees

_REDRAW_S = 0.1
_BAR_CELLS = 10


@dataclass(frozen=True, slots=True)
class Figures:
    """What a row says of the newest rows of a joint; "" where it is not measured.

    Attributes:
        error: largest following error among them.
        torque: highest torque among them as a bar of its limit, with its value.
        temperature: of the newest.
    """

    error: str = ""
    torque: str = ""
    temperature: str = ""


def figures_of(rows: Rows, max_torque_nm: float) -> Figures:
    """Figures of some rows of one joint (``ring.SAMPLE_ROW``)."""
    error = np.abs(rows["position_command_rad"] - rows["position_rad"])
    torque = np.abs(rows["torque_nm"])
    temperature = float(rows["temperature_c"][-1])
    largest, peak_nm = (float(np.nanmax(one)) if np.isfinite(one).any() else math.nan for one in (error, torque))
    return Figures(
        f"{degrees(largest):.3f} deg" if math.isfinite(largest) else "",
        torque_bar(peak_nm, max_torque_nm) if math.isfinite(peak_nm) else "",
        f"{temperature:.1f} C" if math.isfinite(temperature) else "",
    )


def torque_bar(torque_nm: float, max_torque_nm: float) -> str:
    """A bar of ten cells, full at the limit, and the figure."""
    cells = min(_BAR_CELLS, round(_BAR_CELLS * torque_nm / max_torque_nm)) if max_torque_nm > 0 else 0
    return f"{'█' * cells}{'·' * (_BAR_CELLS - cells)} {torque_nm:5.1f} N m"


class JointView:
    """The rows of one run.

    Args:
        console: a terminal.
        setup: names, torque limits.
        planned: how long each stretch of the plan takes, s, by its name (a joint's, or of several that move together).
        members: the joints of each stretch.
    """

    def __init__(
        self, console: Console, setup: RobotSetup, planned: Mapping[str, float], members: Mapping[str, Sequence[str]]
    ) -> None:
        self._setup = setup
        self._names = [joint.name for joint in setup.joints]
        self._planned = planned
        self._members = members
        self._stretch = ""
        self._drawn_at = 0.0
        fields = ("phase:<11", "error:>10", "torque:<20", "temperature:>7", "late:>9")
        texts = [TextColumn(f"{{task.fields[{name}]:{form}}}") for name, form in (one.split(":") for one in fields)]
        self._progress = Progress(
            TextColumn("joint {task.description}"),
            BarColumn(20),
            *texts,
            TimeRemainingColumn(),
            console=console,
        )
        self._tasks: dict[str, TaskID] = {
            name: self._progress.add_task(
                name, total=total_s if math.isfinite(total_s) else None, phase="waiting", error="", torque="",
                temperature="", late="", start=False,
            )
            for name, total_s in planned.items()
        }  # fmt: skip
        self._progress.start()

    @property
    def console(self) -> Console:
        """Prints above the rows."""
        return self._progress.console

    def phase(self, stretch: str, phase: str, completed_s: float) -> None:
        """A stretch of the plan goes into another phase."""
        self._stretch = stretch
        if stretch in self._tasks:
            self._progress.start_task(self._tasks[stretch])
            self._progress.update(self._tasks[stretch], completed=completed_s, phase=phase)

    def rows(self, rows: Rows, completed_s: float) -> None:
        """New rows of all joints; drawn a few times a second."""
        now = time.monotonic()
        if self._stretch not in self._tasks or now - self._drawn_at < _REDRAW_S:
            return
        self._drawn_at = now
        self._progress.update(self._tasks[self._stretch], completed=completed_s)
        for name in self._members[self._stretch]:
            mine = rows[rows["joint"] == self._names.index(name)]
            if mine.size:
                figures = figures_of(mine, self._setup.joint(name).max_torque_nm)
                # Joints that move together share a row: it tells of the last of them.
                self._progress.update(
                    self._tasks[self._stretch],
                    error=figures.error,
                    torque=figures.torque,
                    temperature=figures.temperature,
                )

    def done(self, stretch: str, late_cycles: int) -> None:
        """A stretch is over."""
        if stretch in self._tasks:
            total = self._planned[stretch]
            late = f"{late_cycles} late"
            self._progress.update(self._tasks[stretch], completed=total, phase="done", error="", torque="", late=late)

    def close(self) -> None:
        """Leave the rows as they are."""
        self._progress.stop()
