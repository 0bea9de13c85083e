"""Companions of a compensation: the simulated hand that follows its phases, and the live figures of a service."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np

from frictid_hil.jobs.compensation.plan import Asked
from frictid_hil.jobs.watch import Watcher
from frictid_hil.protocol.driver import Driver
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.events import Event, Marked, PhaseStarted
from frictid_hil.runner.ring import Rows
from frictid_hil.runs.keeper import RowKeeper
from frictid_hil.units import degrees

_LIVE_NS = 500_000_000
_HELD_BACK_NS = 1_000_000_000
"""Of a service's figures: how it was ended is not counted."""


@runtime_checkable
class GuidedBySimulation(Protocol):
    """A driver whose robot has a simulated person."""

    def simulate_hand(self, joint: str, centre_rad: float, amplitude_rad: float, frequency_hz: float) -> None:
        """Guide the joint along centre + amplitude sin(2 pi f t) from now; frequency 0 lets go."""
        ...


Live = Callable[[str], None]
"""Told a line of figures twice a second while a service runs."""


class Hand:
    """The simulated person, following the phases; on a real robot the person reads what to do."""

    def __init__(self, asked: Asked, watcher: Watcher) -> None:
        self._joint = asked.joint
        self._centre_rad = asked.centre_rad
        names = {motion.name for motion in asked.plan.joints[0].motions}
        # A person who does not rest lets go at the end of the swing.
        self._last = {
            name if (rest := name.replace("hand ", "rest ")) not in names else rest
            for name in names
            if name[:5] == "hand "
        }
        self._wanted = asked.wanted
        self._watcher = watcher
        self._driver: GuidedBySimulation | None = None

    def take_driver(self, driver: Driver) -> None:
        """Remember a driver that has a simulated person (``run_plan``'s ``prepare``)."""
        if isinstance(driver, GuidedBySimulation):
            self._driver = driver

    def follow(self, event: Event) -> None:
        """Guide the joint, hold it at rest or let it go, as the phase needs it."""
        if self._wanted.task != "hand":
            return
        if isinstance(event, PhaseStarted):
            phase = event.phase.partition(" ")[0]
            if phase == "hand":
                self._guide(self._wanted.amplitude_rad)
            elif phase == "rest":
                self._guide(0.0)
        elif isinstance(event, Marked) and event.mark.name in self._last and self._driver is not None:
            self._driver.simulate_hand(self._joint, self._centre_rad, 0.0, 0.0)

    def _guide(self, amplitude_rad: float) -> None:
        if self._driver is not None:
            self._driver.simulate_hand(self._joint, self._centre_rad, amplitude_rad, 1.0 / self._wanted.period_s)
        elif amplitude_rad:
            self._watcher.note(
                f"move joint {self._joint} by hand, {degrees(amplitude_rad):.0f} deg to either side, "
                f"back and forth in {self._wanted.period_s:g} s"
            )
        else:
            self._watcher.note(f"bring joint {self._joint} back to {degrees(self._centre_rad):.0f} deg and hold it")


class LiveFigures:
    """Keeps rows as the keeper does, forgets them, and tells what they say."""

    def __init__(self, joint: str, live: Live | None) -> None:
        self._joint = joint
        self._live = live
        self._sums = np.zeros(3)
        self._recent: list[Rows] = []
        self._told_ns = 0
        self._seen_ns = 0
        self.counting = False

    def before(self, keeper: RowKeeper) -> LiveFigures:
        """Pass rows on to ``keeper`` from now on, after looking at them."""
        self._keeper = keeper
        return self

    def samples(self, rows: Rows) -> None:
        """Keep rows, add those of the joint to the figures, and tell the figures now and then."""
        self._keeper.samples(rows)
        now_ns = int(rows["t_ns"][-1]) + 1
        mine = self._keeper.taken(self._joint, self._seen_ns, now_ns)
        self._seen_ns = now_ns
        if not (mine.size and self.counting):
            return
        recent = np.concatenate([*self._recent, mine])
        old = recent["t_ns"] < now_ns - _HELD_BACK_NS
        counted, self._recent = recent[old], [recent[~old]]
        torque = np.nan_to_num(counted["external_torque_nm"])
        self._sums += (counted.size, float(np.sum(counted["velocity_rad_s"] ** 2)), float(np.sum(torque**2)))
        if self._live is not None and now_ns - self._told_ns >= _LIVE_NS:
            self._told_ns = now_ns
            self._live(_live_line(recent))

    def frames(self, rows: Rows) -> None:
        """Keep the frames of the bus."""
        self._keeper.frames(rows)

    def mark(self) -> Mark:
        """Return the sums over a service as a mark, so that they are kept with the recording."""
        return Mark("service", 0, self._seen_ns, {"count_v2_t2": self._sums.tolist()})


def _live_line(rows: Rows) -> str:
    last = rows[-1]
    external = rows["external_torque_nm"]
    hand = f"hand {np.sqrt(np.mean(external**2)):6.3f} N m rms" if np.isfinite(external).all() else "hand not measured"
    return (
        f"{last['t_ns'] * 1e-9:8.1f} s  {degrees(float(last['position_rad'])):8.2f} deg  "
        f"{degrees(float(last['velocity_rad_s'])):7.1f} deg/s  drive {float(last['torque_nm']):7.2f} N m  {hand}"
    )
