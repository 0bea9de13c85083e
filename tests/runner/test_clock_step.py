"""The computer's clock is set while a joint moves: by hand, by NTP, at the end of summer time."""

from __future__ import annotations

import itertools
import time

import pytest

from frictid_hil.protocol.driver import WallClock


def test_run_time_goes_on_evenly_when_the_clock_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    jumps = itertools.cycle((0.0, -3600.0, 86_400.0))
    monkeypatch.setattr(time, "time", lambda: 1.8e9 + next(jumps))
    monkeypatch.setattr(time, "time_ns", lambda: int(1.8e18 + 1e9 * next(jumps)))
    clock = WallClock()
    seen = [clock.now_ns()]
    for cycle in range(1, 6):
        clock.wait_until(seen[0] + cycle * 2_000_000)
        seen.append(clock.now_ns())
    assert all(later >= seen[0] + cycle * 2_000_000 for cycle, later in enumerate(seen))
    assert seen == sorted(seen) and seen[-1] - seen[0] < 60e9
