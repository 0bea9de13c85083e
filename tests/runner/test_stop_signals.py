"""Signals as stop levels, from their handler to the loop."""

from __future__ import annotations

import os
import signal
import time

import pytest

from frictid_hil.config.robot import load_robot
from frictid_hil.errors import Interrupted
from frictid_hil.runner.cycle import DECELERATE, NOTHING_ASKED, QUICK_STOP
from frictid_hil.runner.process import _Life, _lost, _unattended
from frictid_hil.runner.ring import SAMPLE_ROW, sample_ring
from frictid_hil.runner.stop_signals import STOP_SIGNALS, HeardStop, StopSignals


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_reaches_the_loop_from_its_handler(number: int) -> None:
    """Nobody forwards anything here: the process is as busy as it may be."""
    heard, wire = os.pipe()
    loop = HeardStop(heard, os.getppid())
    with StopSignals() as stop, stop.written_to(wire):
        assert loop.level == NOTHING_ASKED
        os.kill(os.getpid(), number)
        assert (loop.level, stop.level) == (DECELERATE, 1)
        os.kill(os.getpid(), signal.SIGTERM)
        assert (loop.level, stop.level) == (QUICK_STOP, 2)
        os.kill(os.getpid(), signal.SIGTERM)
        assert loop.level == QUICK_STOP
    os.close(wire)
    os.close(heard)


def test_handlers_are_restored_and_an_ignored_hang_up_stays_so() -> None:
    before = [signal.getsignal(number) for number in STOP_SIGNALS]
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with StopSignals() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert stop.level == 0
    finally:
        signal.signal(signal.SIGHUP, before[2])
    assert [signal.getsignal(number) for number in STOP_SIGNALS] == before


def test_the_loop_stops_when_its_parent_is_gone() -> None:
    heard, wire = os.pipe()
    assert HeardStop(heard, os.getppid()).level == NOTHING_ASKED
    assert HeardStop(heard, os.getppid() + 1).level == DECELERATE
    os.close(wire)
    os.close(heard)


def test_the_loop_stops_when_nobody_takes_what_it_measures() -> None:
    heard, wire = os.pipe()
    ring = sample_ring(8)
    loop = HeardStop(heard, os.getppid(), lambda: ring.half_full)
    row = [0] * len(SAMPLE_ROW.names or ())
    for count in range(1, 9):
        ring.append(*row)
        assert loop.level == (DECELERATE if count > 4 else NOTHING_ASKED) and loop.left_alone is (count > 4)
    ring.drain()
    assert loop.level == DECELERATE, "once is enough"
    assert _unattended().exit_code == 4 and "Ctrl-Z" in _unattended().cause
    os.close(wire)
    os.close(heard)


def test_a_signal_ends_a_question() -> None:
    def asks() -> bool:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)
        return True

    with StopSignals() as stop, pytest.raises(Interrupted, match="nothing has moved"):
        stop.while_asking(asks)
    assert stop.level == 1


def test_a_silent_child_is_given_up_after_a_bounded_time_and_sooner_once_a_stop_was_asked_for(monkeypatch) -> None:
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)

    def lives_s(*, rows: int, stop_asked: bool) -> float:
        nonlocal now_s
        life, begun_s = _Life(), now_s
        while now_s - begun_s < 100.0:
            now_s += 0.05
            if not life.look(rows * round(now_s * 20), heard=False, stop_asked=stop_asked):
                break
        return now_s - begun_s

    assert lives_s(rows=0, stop_asked=False) == pytest.approx(30.0, abs=0.2)
    assert lives_s(rows=0, stop_asked=True) == pytest.approx(5.0, abs=0.2)
    assert lives_s(rows=1, stop_asked=False) == pytest.approx(100.0, abs=0.2)
    assert lives_s(rows=1, stop_asked=True) == pytest.approx(15.0, abs=0.2), "it moves on, and does not stop"


def test_time_in_which_the_parent_was_busy_does_not_count_against_the_child(monkeypatch) -> None:
    now_s = 0.0
    monkeypatch.setattr(time, "monotonic", lambda: now_s)
    life = _Life()
    now_s = 60.0
    assert life.look(0, heard=False, stop_asked=True)


def test_a_lost_loop_says_what_may_still_have_power() -> None:
    setup = load_robot("hp3j.yaml").to_setup()
    assert "0, 1, 2, 3, 4, 5 may still have power" in _lost(None, setup, hangs=True, powered=True).next_step
    assert "nothing had power" in _lost(-9, setup, hangs=False, powered=False).next_step
