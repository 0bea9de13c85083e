"""The question before motion, asked on a real terminal."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump

pytestmark = pytest.mark.slow

QUESTION = "Is the cell clear?"


def _at_a_terminal() -> None:
    """In the child: the terminal is its own, and Ctrl-C is heard even where the tests run in a shell's background."""
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    signal.signal(signal.SIGINT, signal.default_int_handler)


class Terminal:
    """A process on a pseudo terminal."""

    def __init__(self, *arguments: str, cwd: Path) -> None:
        self._ours, theirs = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "frictid_hil.cli.app", *arguments],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            cwd=cwd,
            env={**os.environ, "TERM": "dumb", "COLUMNS": "150"},
            start_new_session=True,
            preexec_fn=_at_a_terminal,
        )
        os.close(theirs)
        self.said = ""

    def type(self, keys: str) -> None:
        os.write(self._ours, keys.encode())

    def until(self, done: Callable[[], bool], seconds: float = 100.0) -> None:
        """Read what it says until something is true of it."""
        end = time.monotonic() + seconds
        while not done() and time.monotonic() < end:
            if select.select([self._ours], [], [], 0.1)[0]:
                with contextlib.suppress(OSError):  # it has ended
                    self.said += os.read(self._ours, 65536).decode(errors="replace")
        assert done(), self.said

    def ended(self) -> int:
        self.until(lambda: self.process.poll() is not None)
        return int(self.process.returncode)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._ours)


@pytest.fixture
def asked(tmp_path: Path) -> Iterator[Terminal]:
    """A calibration at its question; a `y` was typed long before."""
    values = load_robot("hp3j").values()
    values |= {"name": "one", "bus": "virtual:one", "joints": {"5": values["joints"]["5"]}}
    (tmp_path / "one.yaml").write_text(dump(values))
    terminal = Terminal(
        "calibrate", "--robot", "one.yaml", "--cycles", "3", "--amplitude", "8deg", "--velocity", "60deg/s", "--out",
        "run", cwd=tmp_path,
    )  # fmt: skip
    terminal.type("y\n")
    try:
        terminal.until(lambda: QUESTION in terminal.said)
        yield terminal
    finally:
        terminal.close()


def test_a_yes_typed_before_the_question_answers_nothing(asked: Terminal, tmp_path: Path) -> None:
    told = asked.said.index("SIMULATED: no real robot moves (bus virtual:one)")
    assert told < asked.said.index("Plan for one") < asked.said.index(QUESTION)
    assert "SIMULATED" in asked.said[asked.said.index("Plan for one") :], "the question says it once more"
    with pytest.raises(AssertionError):
        asked.until(lambda: asked.process.poll() is not None or "rehearsal" in asked.said, seconds=2.0)
    asked.type("n\n")
    assert asked.ended() == 2
    assert "nothing has moved" in asked.said and not (tmp_path / "run").exists()


def test_what_is_neither_yes_nor_no_is_asked_again(asked: Terminal, tmp_path: Path) -> None:
    asked.type("maybe\n")
    asked.until(lambda: "Please type y or n." in asked.said and asked.said.count(QUESTION) == 2)
    asked.type("n\n")
    assert asked.ended() == 2
    assert "nothing has moved" in asked.said and not (tmp_path / "run").exists()


@pytest.mark.parametrize("how", ["Ctrl-D", "Ctrl-C", "SIGTERM"])
def test_whoever_leaves_the_question_leaves_it_at_once_and_nothing_moves(
    asked: Terminal, tmp_path: Path, how: str
) -> None:
    if how == "SIGTERM":
        asked.process.send_signal(signal.SIGTERM)
    else:
        asked.type("\x04" if how == "Ctrl-D" else "\x03")
    assert asked.ended() == 130, asked.said
    assert "interrupted at the question; nothing moves" in asked.said and "Traceback" not in asked.said
    assert not (tmp_path / "run").exists()
