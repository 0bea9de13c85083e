"""The emulator on a pseudo terminal, in real time: any program that opens a serial port can talk to it.

A pseudo terminal ignores speed and parity, so the emulator paces the bytes itself. It also delivers late on a busy
machine, by tens of milliseconds, and this process may not be given the processor for as long; a real controller on a
real line knows neither, and its watchdog must not punish the host for them. So the controller's time slips: it never
catches up, and it waits a moment for set-points that are late before it lets its queue run dry. Every such wait is
counted, and told at the end: with a real controller the arm might have stopped there.
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

from frictid_drivers.motoman.emulator.build import build
from frictid_drivers.motoman.emulator.faults import Fault, FaultPlan
from frictid_drivers.motoman.emulator.machine import Emulator
from frictid_hil.driver import RobotSetup

_CHUNK = 4096
_LONGEST_WAIT_S = 0.05
_PATIENCE_S = 0.2
"""How long time stands still for late set-points; after that the host counts as gone, and the watchdog decides."""


@dataclass(slots=True)
class Waits:
    """How often time stood still for set-points that were late.

    Attributes:
        count: stretches of waiting.
        longest_s: the longest of them.
    """

    count: int = 0
    longest_s: float = 0.0
    _now_s: float = 0.0

    def begin(self) -> None:
        """A stretch begins, unless one is under way."""
        self.count += self._now_s == 0.0

    def last(self, passed_s: float) -> None:
        """It has gone on."""
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


def serve(
    setup: RobotSetup,
    *,
    announce: Callable[[str], None],
    faults: Sequence[str] = (),
    stop: Callable[[], bool] = lambda: False,
    tell: Callable[[str], None] = lambda text: print(text, file=sys.stderr, flush=True),
) -> None:
    """Run until told to stop, or until a fault takes the port away.

    Args:
        setup: the robot whose joints are behind the controller; its ``options.emulator`` says what kind it is.
        announce: told the name of the port once it can be opened.
        faults: ``kind@n`` and so on.
        stop: asked several times a second.
        tell: given, at the end, how often it waited for the host, where it did.

    Raises:
        InvalidFields: the robot file has no such controller in it.
        UsageError: a fault that is none.
    """
    plan = FaultPlan(Fault.parse(text) for text in faults)
    # A pseudo terminal carries no parity bit; bytes are paced as without one.
    emulator = build(replace(setup, options={**setup.options, "parity": "N"}), plan)
    ours, theirs = os.openpty()
    try:
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        announce(os.ttyname(theirs))
        waits = Waits()
        try:
            _run(emulator, ours, stop, waits)
        finally:
            if waits.count:
                tell(str(waits))
    finally:
        os.close(ours)
        os.close(theirs)


def _run(emulator: Emulator, ours: int, stop: Callable[[], bool], waits: Waits) -> None:
    tick_s = emulator.settings.tick_s
    last_s = heard_s = time.monotonic()
    while not (emulator.gone or stop()):
        wait_s = min(_LONGEST_WAIT_S, emulator.next_event_s() - emulator.now_s)
        starving = emulator.starving
        # A writer that fills the terminal's buffer must not make us spin.
        ready, _, _ = select.select([ours], [], [], max(0.0, wait_s))
        now_s = time.monotonic()
        passed_s, last_s = now_s - last_s, now_s
        if starving and not ready and now_s - heard_s < _PATIENCE_S:
            waits.begin()
            select.select([ours], [], [], tick_s)
            last_s = time.monotonic()
            waits.last(last_s - now_s)
            continue
        waits.end()
        slack_s = tick_s if wait_s < tick_s else wait_s + tick_s
        emulator.advance(emulator.now_s + min(passed_s, slack_s))
        if ready:
            with contextlib.suppress(BlockingIOError):
                emulator.hear(os.read(ours, _CHUNK))
                heard_s = now_s
        _write(ours, emulator.take())


def _write(ours: int, data: bytes) -> None:
    """As a UART does: what nobody reads in time is lost."""
    with contextlib.suppress(BlockingIOError):
        os.write(ours, data)
