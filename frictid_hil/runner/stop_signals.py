"""Ctrl-C, SIGTERM and SIGHUP as stop levels: the first decelerates, the second stops quickly.

A signal reaches the cyclic loop from its handler, whatever this process is busy with: in lock-step the handler raises
the level that the loop reads, and where the loop is a process of its own, the interpreter's C handler writes the
signal's number into the pipe that the loop reads.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import FrameType
from typing import TypeVar

from frictid_hil.errors import Interrupted
from frictid_hil.runner.cycle import DECELERATE, NOTHING_ASKED, QUICK_STOP

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # a closed terminal hangs up

Answer = TypeVar("Answer")


@contextlib.contextmanager
def handling_signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """SIGINT and SIGTERM go to a handler of one's own for a while; in the main thread, elsewhere nothing is changed."""
    ours = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM) if ours}
    try:
        yield
    finally:
        for number, usual in before.items():
            signal.signal(number, usual)


class StopSignals:
    """The level that signals have asked for; handlers hold inside of ``with``, in the main thread, if not ignored."""

    def __init__(self) -> None:
        self.level = NOTHING_ASKED
        self._asking = False
        self._previous: dict[int, object] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            for number in STOP_SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._raise)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # exactly what signal.signal returned
        self._previous.clear()

    def while_asking(self, question: Callable[[], Answer]) -> Answer:
        """The answer to a question, which a signal ends at once, because nothing moves yet (``Interrupted``)."""
        self._asking = True
        try:
            return question()
        finally:
            self._asking = False

    @contextlib.contextmanager
    def written_to(self, pipe: int) -> Iterator[None]:
        """Let the handler of the interpreter write the number of every signal into this pipe as well."""
        if not self._previous:
            yield
            return
        os.set_blocking(pipe, False)
        before = signal.set_wakeup_fd(pipe, warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(before)

    def _raise(self, _signal: int, _frame: FrameType | None) -> None:
        self.level = min(QUICK_STOP, self.level + 1)
        if self._asking:
            raise Interrupted("stopped by a signal; nothing has moved")


@dataclass
class HeardStop:
    """The other end of that pipe, in the loop's process; the level also rises when the parent is gone or stands."""

    pipe: int  # to read signal numbers from
    parent_pid: int  # who writes them
    behind: Callable[[], bool] = lambda: False  # the parent has taken no rows for so long that they would soon be lost
    terminated: bool = False  # this process itself was asked to end
    left_alone: bool = False  # the parent was behind
    _level: int = NOTHING_ASKED

    def __post_init__(self) -> None:
        os.set_blocking(self.pipe, False)

    @property
    def level(self) -> int:
        """The highest level asked for so far."""
        with contextlib.suppress(BlockingIOError):
            asked = sum(number in STOP_SIGNALS for number in os.read(self.pipe, 64))
            self._level = min(QUICK_STOP, self._level + asked)
        self.left_alone = self.left_alone or self.behind()
        if self.terminated or self.left_alone or os.getppid() != self.parent_pid:
            return max(DECELERATE, self._level)
        return self._level
