"""Every fault at every phase of a run, in virtual time: the arm stops or the transfer recovers, nothing is invented.

Each run is judged alike: it ends within the timers, by success or by an error of ours that names a cause; what was
recorded is what happened; and two seconds later nothing moves.
"""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from serial_bench import START_RAD, Streamed, make_bench, stream_motion

from frictid_hil.errors import FrictidError
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.plan.plan import Hold, JointPlan, Move

LONGEST_S = 120.0

LINK = "no answer|rejected|unreadable|silent|no reply|ended|never acknowledged|no HELLO|in the middle|instead of"
CAUSES = {
    "close": "port is gone",
    "unplug": "port is gone",
    "alarm": "alarm 4107",
    "hold": "pendant hold|pressed hold",
    "late": "watchdog|no feedback",
    "bad_crc": "watchdog|no HELLO",
    "lost_frame": "watchdog|no HELLO",
    "deaf": "watchdog|no HELLO",
    "noise": "watchdog|no HELLO",
    "silence": LINK + "|watchdog|no feedback|heard nothing",
    "enq": "bid for the line|" + LINK,
}


def spread(kinds: list[str], occasions: int, step: int = 1) -> list[str]:
    return [kind.replace("@", f"@{n}") for kind in kinds for n in range(0, occasions, step)]


STREAM_FAULTS = [
    *spread(["lost_ack@", "wrong_ack@"], 18),
    *spread(["nak@", "nak@x3", "nak@x5", "bad_bcc@", "bad_bcc@x4", "lost_block@"], 9, 2),
    *spread(["garble@"], 44),
    *spread(["silence@:4", "silence@:25"], 44, 6),
    *spread(["enq@", "enq@:1"], 9),
    *spread(["split@", "merge@:0.02"], 44, 15),
    *spread(["close@"], 44, 3),
    *spread(
        ["bad_crc@", "bad_crc@x7", "lost_frame@x2", "lost_frame@x9", "deaf@", "deaf@x7", "noise@x2", "noise@x7"], 70, 9
    ),
    *spread(["late@", "late@:0.008", "alarm@:4107", "hold@", "drop@:30", "unplug@"], 70, 7),
]
BATCH_FAULTS = [
    *spread(["lost_ack@", "wrong_ack@"], 40, 3),
    *spread(["nak@", "nak@x5", "bad_bcc@", "bad_bcc@x6", "lost_block@"], 36, 5),
    *spread(["garble@"], 120, 4),
    *spread(["silence@:4", "silence@:25"], 100, 20),
    *spread(["enq@:1"], 16, 3),
    *spread(["split@", "merge@:0.02"], 100, 40),
    *spread(["close@"], 120, 12),
    *spread(["alarm@:4107", "hold@", "drop@:30", "unplug@"], 190, 30),
]


def test_there_are_at_least_three_hundred_injections() -> None:
    assert len(STREAM_FAULTS) + len(BATCH_FAULTS) >= 300


def check_cause(fault: str, error: FrictidError) -> None:
    told = f"{error} {error.cause}"
    kind = fault.partition("@")[0]
    assert re.search(CAUSES.get(kind, LINK), told), f"{fault}: {type(error).__name__}: {told}"


@pytest.mark.slow
@pytest.mark.parametrize("fault", STREAM_FAULTS)
def test_streaming(fault: str) -> None:
    bench = make_bench(faults=[fault])
    driver, streamed, error = bench.driver(), Streamed(), None
    try:
        driver.open()
        stream_motion(driver, into=streamed)
    except FrictidError as caught:
        error = caught
    finally:
        driver.close()
    assert bench.emulator.now_s < LONGEST_S
    assert not bench.still_moving()
    if error is not None:
        check_cause(fault, error)
    else:
        assert len(streamed.rows) >= 60
    for tick, row in zip(streamed.ticks(), streamed.rows, strict=True):
        assert row[1] == pytest.approx(bench.truth_rad[tick], abs=1e-9), f"tick {tick} was recorded wrongly"


def test_a_healthy_stream_follows_its_set_points() -> None:
    bench = make_bench()
    driver = bench.driver()
    driver.open()
    streamed = stream_motion(driver, ticks=50, travel_rad=0.05)
    driver.close()
    assert max(row[1] for row in streamed.rows) == pytest.approx(START_RAD + 0.05, abs=2e-5)
    assert np.all(np.diff(streamed.ticks()) == 1)


def batch_plan() -> JointPlan:
    travel = Procedure(0.05, 0.3, cycles=2)
    out = Move(START_RAD, START_RAD + travel.amplitude_rad, 0.3)
    back = Move(START_RAD + travel.amplitude_rad, START_RAD, 0.3)
    return JointPlan("0", (Hold(START_RAD, 0.04), out, back, Hold(START_RAD, 0.1)), {})


@pytest.mark.slow
@pytest.mark.parametrize("fault", BATCH_FAULTS)
def test_batch(fault: str) -> None:
    bench = make_bench(faults=[fault], layer="batch")
    driver, error, columns = bench.driver(), None, {}
    try:
        driver.open()
        columns = dict(driver.run_batch(batch_plan()))
    except FrictidError as caught:
        error = caught
        columns = driver.batch_columns
    finally:
        driver.close()
    assert bench.emulator.now_s < LONGEST_S
    bench.emulator.advance(bench.emulator.now_s + 6.0)  # the job's own watchdog takes 5 s
    assert not bench.still_moving()
    job = bench.emulator.batch._job
    if error is not None:
        check_cause(fault, error)
    else:
        assert job is not None
        assert len(columns["time_ns"]) == len(job.path) == 1 + 10 + 75 + 75 + 25
    if columns:
        assert job is not None
        true_pulses = [sample[0] for sample in job.samples][: len(columns["time_ns"])]
        assert np.allclose(columns["position_rad"] * math.degrees(1000.0), true_pulses, atol=1e-6)


def test_a_stopped_job_keeps_what_it_recorded() -> None:
    bench = make_bench(faults=["hold@60"], layer="batch")
    driver = bench.driver()
    driver.open()
    with pytest.raises(FrictidError, match="pressed hold"):
        driver.run_batch(batch_plan())
    driver.close()
    assert 60 <= len(driver.batch_columns["time_ns"]) < 100
    assert driver.batch_columns["position_rad"].max() > START_RAD


def test_a_dead_host_is_noticed_by_the_job() -> None:
    bench = make_bench(layer="batch", watchdog_s=0.5)
    driver = bench.driver()
    driver.open()
    plan = JointPlan("0", (Hold(START_RAD, 30.0),), {})

    class Killed(BaseException):
        pass

    def die() -> bool:
        raise Killed

    with pytest.raises(Killed):
        driver.run_batch(plan, stop=die)
    # Nothing is closed, nothing is said: as after kill -9.
    bench.emulator.advance(bench.emulator.now_s + 1.5)
    assert not bench.still_moving()
    job = bench.emulator.batch._job
    assert job is not None
    assert job.reason == "watchdog"


def test_a_dead_host_is_noticed_by_the_stream_within_its_watchdog() -> None:
    bench = make_bench()
    driver = bench.driver()
    driver.open()
    cycles = 0

    class Killed(BaseException):
        pass

    class Dying(Streamed):
        pass

    exchange = driver.exchange

    def until_killed(set_points):
        nonlocal cycles
        cycles += 1
        if cycles == 30:
            raise Killed
        return exchange(set_points)

    driver.exchange = until_killed
    with pytest.raises(Killed):
        stream_motion(driver, into=Dying())
    emulator = bench.emulator
    assert emulator.stream is not None
    assert emulator.stream.moving
    # Lead 4 ticks, watchdog 3 ticks, deceleration 25 ticks.
    emulator.advance(emulator.now_s + (4 + 3 + 25 + 1) * 0.004)
    assert not emulator.stream.moving
    assert "command" in emulator.panel.holds


@pytest.mark.parametrize("at", [12, 30, 55])
def test_unplugging_stops_the_arm_within_the_watchdogs_time(at: int) -> None:
    bench = make_bench(faults=[f"unplug@{at}"])
    emulator, driver = bench.emulator, bench.driver()
    driver.open()
    with pytest.raises(FrictidError, match="port is gone"):
        stream_motion(driver, ticks=50, travel_rad=0.05)
    driver.close()
    assert emulator.stream is not None
    unplugged_s = emulator.now_s
    while emulator.stream.moving:
        emulator.advance(emulator.now_s + 0.004)
    # Lead 4 ticks, watchdog 3 ticks, deceleration 25 ticks.
    assert emulator.now_s - unplugged_s <= (4 + 3 + 25 + 1) * 0.004
    assert "command" in emulator.panel.holds
