"""The emulator on a pseudo terminal, in real time: any program that opens a serial port can talk to it.

A pseudo terminal ignores speed and parity, so the emulator paces the bytes itself. It also delivers late on a busy
machine, by tens of milliseconds, and this process may not be given the processor for as long; a real controller on a
real line knows neither, and its watchdog must not punish the host for them. So the controller's time slips: it never
catches up, and it waits a moment for set-points that are late before it lets its queue run dry. Every such wait is
counted, and told at the end: with a real controller the arm might have stopped there.

A terminal that is closed and opened again has another number, so a port that a fault takes away for a while can only
come back under a link.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import time
import tty
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from frictid_drivers.motoman.emulator.build import build
from frictid_drivers.motoman.emulator.faults import Fault, FaultPlan
from frictid_drivers.motoman.emulator.machine import Emulator
from frictid_hil.errors import UsageError
from frictid_hil.plan.setup import RobotSetup

_CHUNK = 4096
_LONGEST_WAIT_S = 0.05
_PATIENCE_S = 0.2
"""How long time stands still for late set-points; after that the host counts as gone, and the watchdog decides."""


@dataclass(slots=True)
class Waits:
    """How often time stood still for set-points that were late, and for how long at most."""

    count: int = 0
    longest_s: float = 0.0
    _now_s: float = 0.0

    def last(self, passed_s: float) -> None:
        """A stretch begins, or has gone on."""
        self.count += self._now_s == 0.0
        self._now_s += passed_s
        self.longest_s = max(self.longest_s, self._now_s)

    def end(self) -> None:
        """Time goes on."""
        self._now_s = 0.0

    def __str__(self) -> str:
        return (
            f"emulator: waited {self.count} times, {self.longest_s * 1e3:.0f} ms at most, for set-points that were "
            "late; a real controller waits for nobody, and stops at the third missed tick"
        )


class Terminal:
    """The controller's end of a pseudo terminal that can be pulled out and plugged in again.

    While it is there it is found under the name ``link``, or its own; ``UsageError`` where something else has that.
    """

    def __init__(self, link: Path | None = None) -> None:
        if link is not None and link.exists() and not link.is_symlink():
            raise UsageError("exists already, and is no link", where=str(link), next_step="choose another --link")
        self.link = link
        self._ends: tuple[int, int] | None = None

    def plug_in(self) -> str:
        """Be there; the name to open it by."""
        ours, theirs = self._ends = os.openpty()
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        name = os.ttyname(theirs)
        if self.link is None:
            return name
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(name)
        return str(self.link)

    def pull_out(self) -> None:
        """Be gone; whoever has it open reads an error from here on."""
        if self._ends is None:
            return
        if self.link is not None:
            self.link.unlink(missing_ok=True)
        for end in self._ends:
            os.close(end)
        self._ends = None

    def wait(self, timeout_s: float) -> bool:
        """Whether there is something to read, at the latest after this time."""
        if self._ends is None:
            time.sleep(max(0.0, timeout_s))
            return False
        ready, _, _ = select.select([self._ends[0]], [], [], max(0.0, timeout_s))
        return bool(ready)

    def read(self) -> bytes:
        """What has arrived."""
        with contextlib.suppress(BlockingIOError):
            if self._ends is not None:
                return os.read(self._ends[0], _CHUNK)
        return b""

    def write(self, data: bytes) -> None:
        """As a UART does: what nobody reads in time is lost."""
        with contextlib.suppress(BlockingIOError):
            if self._ends is not None:
                os.write(self._ends[0], data)


def serve(
    setup: RobotSetup,  # the robot; its ``options.emulator`` says what kind of controller it is
    *,
    announce: Callable[[str], None],  # told the name of the port once it can be opened
    link: Path | None = None,  # name for the port; without one, a port that a fault takes away stays away
    faults: Sequence[str] = (),  # ``kind@n`` and so on
    stop: Callable[[], bool] = lambda: False,  # asked several times a second
    # Given, at the end, how often it waited for the host, where it did.
    tell: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True),
) -> None:
    """Run until told to stop, or until a fault takes the port away.

    Raises:
        InvalidFields: the robot file has no such controller in it.
        UsageError: a fault that is none, or a link that cannot be.
    """
    plan = FaultPlan(Fault.parse(text) for text in faults)
    # A pseudo terminal carries no parity bit; bytes are paced as without one.
    emulator = build(replace(setup, options={**setup.options, "parity": "N"}), plan)
    terminal, waits = Terminal(link), Waits()
    try:
        announce(terminal.plug_in())
        _run(emulator, terminal, stop, waits)
    finally:
        terminal.pull_out()
        if waits.count:
            tell(str(waits))


def _run(emulator: Emulator, terminal: Terminal, stop: Callable[[], bool], waits: Waits) -> None:
    tick_s = emulator.settings.tick_s
    last_s = heard_s = time.monotonic()
    gone = False
    while not stop():
        if emulator.gone and (terminal.link is None or emulator.gone_for_good):
            return
        if emulator.gone != gone:
            gone = emulator.gone
            (terminal.pull_out if gone else terminal.plug_in)()
        wait_s = min(_LONGEST_WAIT_S, emulator.next_event_s() - emulator.now_s)
        starving = emulator.starving and not gone
        # A writer that fills the terminal's buffer must not make us spin.
        ready = terminal.wait(wait_s)
        now_s = time.monotonic()
        passed_s, last_s = now_s - last_s, now_s
        if starving and not ready and now_s - heard_s < _PATIENCE_S:
            terminal.wait(tick_s)
            last_s = time.monotonic()
            waits.last(last_s - now_s)
            continue
        waits.end()
        slack_s = tick_s if wait_s < tick_s else wait_s + tick_s
        emulator.advance(emulator.now_s + min(passed_s, slack_s))
        if ready:
            emulator.hear(terminal.read())
            heard_s = now_s
        terminal.write(emulator.take())
