"""Layer B: the job message, its segments, the transfer and its resumption, the friction table."""

from __future__ import annotations

import base64
import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from serial_bench import START_RAD, make_bench

from frictid_drivers.motoman import MotomanDriver
from frictid_drivers.motoman.batch import BatchClient, JobOrder, friction_table
from frictid_drivers.motoman.batch_record import BlockCollector, JobRecord
from frictid_drivers.motoman.controller_errors import FormatMistake, OperandOutOfRange, PendantHold, WrongMode
from frictid_drivers.motoman.emulator import jobs
from frictid_drivers.motoman.emulator.jobs import Compensator, Table
from frictid_drivers.motoman.emulator.loopback import LoopbackPort
from frictid_drivers.motoman.emulator.machine import Emulator
from frictid_drivers.motoman.joint_units import AxisUnits
from frictid_drivers.motoman.segments import motion_segments
from frictid_drivers.motoman.stream_frames import crc16
from frictid_hil.errors import HardwareError, Interrupted, PlanRefused
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Procedure, in_whole_ticks
from frictid_hil.plan.plan import Corners, Cycles, Hold, JointPlan, Motion, Move, Sine

UNITS = AxisUnits(axis=0, pulses_per_rad=math.degrees(1000.0), gear_ratio=100.0, rated_torque_nm=20.0, direction=1)
TICK_S = 0.004


PROCEDURE = in_whole_ticks(Procedure(math.radians(20), math.radians(115), 10), TICK_S)


def test_the_papers_cycles_become_the_published_tick_counts() -> None:
    made = motion_segments([Cycles(START_RAD, PROCEDURE)], UNITS, TICK_S)
    assert made.segments == ("C:20000:1364:684:456:340:272:228:196:172:152:136",)
    assert made.motion_ticks == (0, 4000)


def test_cycles_that_are_no_whole_ticks_are_refused() -> None:
    with pytest.raises(PlanRefused, match="4 ms ticks"):
        motion_segments([Cycles(START_RAD, Procedure(0.3, 2.0))], UNITS, TICK_S)


MOTIONS = st.lists(
    st.one_of(
        st.builds(Hold, st.just(START_RAD), st.floats(0.01, 0.2)),
        st.builds(Move, st.just(START_RAD), st.floats(-0.5, 0.5), st.floats(0.1, 0.5)),
        st.builds(Sine, st.just(START_RAD), st.floats(0.01, 0.3), st.floats(0.5, 2.0), st.integers(1, 3)),
        st.builds(
            lambda a, b: Corners("reversal", (0.0, 0.1, 0.25), (START_RAD, a, b)),
            st.floats(-0.5, 0.5),
            st.floats(-0.5, 0.5),
        ),
    ),
    min_size=1,
    max_size=6,
)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(MOTIONS)
def test_both_sides_make_the_same_command_of_the_same_segments(motions: list[Motion]) -> None:
    made = motion_segments(motions, UNITS, TICK_S)
    path, floating = [made.start], [False]
    for segment in made.segments:
        jobs._append_segment(segment, path, floating)
    assert len(path) == len(made.command)
    # Half pulses may round either way.
    assert np.abs(np.array(path) - made.command).max() <= 1


@pytest.mark.parametrize(
    "motion", [Hold(START_RAD, 0.1), Move(START_RAD, 0.4, 0.4), Sine(START_RAD, 0.1, 0.785398163, 1)]
)
def test_the_command_is_the_plans_own_path(motion: Motion) -> None:
    made = motion_segments([motion], UNITS, TICK_S)
    planned = motion.position_rad(np.arange(len(made.command)) * TICK_S)
    assert np.abs(made.command / UNITS.pulses_per_rad - planned).max() < 1e-4


def order(**changes: object) -> JobOrder:
    figures = {
        **{"number": 7, "axis": 0, "start": 11459, "lowest": 0, "highest": 40000, "step": 700},
        **{"torque_micro": 500_000, "watchdog_ticks": 1250, "segments": ["H:50", "C:20000:1364:684", "H:50"]},
        **changes,
    }
    return JobOrder(**figures)  # type: ignore[arg-type]


def test_the_job_is_one_message_closed_by_its_crc() -> None:
    text = order().text()
    covered, _, check = text.rpartition(",")
    assert text.startswith("FJOB 1,7,0,11459,0,40000,700,500000,1250,H:50,C:20000:1364:684,H:50,")
    assert int(check, 16) == crc16((covered + ",").encode())


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({}, None),
        ({"highest": 20000}, OperandOutOfRange),
        ({"step": 10}, OperandOutOfRange),
        ({"axis": 3}, OperandOutOfRange),
        ({"segments": ["X:4"]}, OperandOutOfRange),
        ({"segments": ["H:0"]}, OperandOutOfRange),
    ],
)
def test_the_controller_checks_the_job_as_well(changes: dict[str, object], error: type[Exception] | None) -> None:
    bench = make_bench()
    client = BatchClient(bench.host())
    if error is None:
        client.send(order(**changes))
    else:
        with pytest.raises(error):
            client.send(order(**changes))


def test_a_job_with_one_wrong_character_is_refused() -> None:
    bench = make_bench()
    with pytest.raises(FormatMistake):
        bench.host().order(order().text().replace("20000", "20001"))


def plan(*motions: Motion) -> JointPlan:
    return JointPlan("0", motions or (Hold(START_RAD, 0.1), Sine(START_RAD, 0.2, 1.0), Hold(START_RAD, 0.1)), {})


@pytest.mark.parametrize("direction", [1, -1])
def test_a_job_comes_back_in_joint_units(direction: int) -> None:
    bench = make_bench(layer="batch", direction=direction)
    driver = bench.driver()
    driver.open()
    told: list[str] = []
    columns = driver.run_batch(plan(), progress=lambda phase, share: told.append(f"{phase} {share:.1f}"))
    driver.close()
    assert columns["position_rad"].max() == pytest.approx(START_RAD + 0.2, abs=1e-3)
    assert columns["velocity_rad_s"].max() == pytest.approx(1.0, rel=0.02)
    moving = np.abs(columns["velocity_rad_s"]) > 0.1
    velocity = columns["velocity_rad_s"][moving]
    assert columns["torque_nm"][moving] == pytest.approx(10 * np.tanh(velocity / 0.01) + 3 * velocity, abs=2e-3)
    assert np.all(np.diff(columns["time_ns"]) == 4_000_000)
    assert np.abs(columns["position_rad"] - columns["position_command_rad"]).max() < 1e-2
    assert list(columns["motion_starts_ns"]) == [0, 25 * 4e6, (25 + 157) * 4e6, (25 + 157 + 25) * 4e6]
    assert told[-1] == "transfer 1.0"


def test_a_broken_transfer_goes_on_where_it_broke() -> None:
    healthy = make_bench(layer="batch")
    driver = healthy.driver()
    driver.open()
    whole = driver.run_batch(plan(Sine(START_RAD, 0.3, 0.4)))
    driver.close()
    assert len(whole["time_ns"]) > 32 * 18
    blocks = healthy.emulator.faults.counted["block"]
    # Four lost blocks in a row exhaust the retries of one message; the message before and after it are whole.
    broken = make_bench(layer="batch", retry_1=2, faults=[f"lost_block@{blocks - 12}x4"], timer_a_s=0.5)
    driver = broken.driver()
    driver.open()
    resumed = driver.run_batch(plan(Sine(START_RAD, 0.3, 0.4)))
    driver.close()
    assert broken.emulator.faults.counted["block heard"] > healthy.emulator.faults.counted["block heard"]
    assert np.array_equal(resumed["position_rad"], whole["position_rad"])


@given(st.binary(max_size=60), st.integers(0, 200), st.integers(0, 255), st.booleans())
def test_damaged_blocks_never_become_samples(garbage: bytes, position: int, replaced: int, shifted: bool) -> None:
    head = (7).to_bytes(2, "little") + (0).to_bytes(4, "little") + b"\x02" + (b"\x03\x01" if shifted else b"")
    raw = head + bytes(range(20))
    coded = bytearray(base64.b64encode(raw + crc16(raw).to_bytes(2, "little")))
    clean = bytes(coded)
    coded[position % len(coded)] = replaced
    rows: dict[int, tuple[int, int, int]] = {}
    collector = BlockCollector(7, rows, None if shifted else (3, 1))
    collector.take(coded.decode("latin-1") + ",", 0)
    collector.take(base64.b64encode(garbage).decode(), 1)
    collector.finish()
    assert bool(rows) == (bytes(coded) == clean)
    if rows:
        assert rows[0] == (0x03020100, 0x060504 << 3, 0x090807 << 1)


@settings(max_examples=30, deadline=None)
@given(st.data())
def test_a_reply_cut_anywhere_gives_the_same_samples(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 60))
    figure = st.integers(-(2**31), 2**31 - 1)
    samples = data.draw(st.lists(st.tuples(figure, figure, figure), min_size=count, max_size=count))
    bench = make_bench()
    bench.emulator.batch._job = jobs.Job(9, 0, [0], [False], 0, 1, state=jobs.RUNNING, samples=samples)
    _, text = bench.emulator.batch.obey(f"FREAD 2,9,0,{count}")
    cuts = sorted(data.draw(st.lists(st.integers(0, len(text)), max_size=5)))
    rows: dict[int, tuple[int, int, int]] = {}
    collector = BlockCollector(9, rows, None)
    for index, (begin, end) in enumerate(zip([0, *cuts], [*cuts, len(text)], strict=True)):
        collector.take(text[begin:end], index)
    collector.finish()
    assert sorted(rows) == list(range(count))
    for k, (pulses, speed, torque) in enumerate(samples):
        assert rows[k][0] == pulses
        assert 0 <= speed - rows[k][1] < 2**9
        assert 0 <= torque - rows[k][2] < 2**9


@pytest.mark.parametrize("while_running", [False, True])
@pytest.mark.parametrize(("speed", "torque"), [(1_000, 500_000), (90_000_000, -12_000_000)])
def test_figures_beyond_24_bits_are_shifted_and_come_back(speed: int, torque: int, while_running: bool) -> None:
    job = jobs.Job(1, 0, [0], [False], 0, 1, samples=[(-5, speed, torque), (2**31 - 1, -speed, -torque)])
    velocity_shift, torque_shift = job.shifts()
    assert abs(speed) >> velocity_shift < 2**23
    bench = make_bench()
    job.state, job.done = jobs.FINISHED, 2
    bench.emulator.batch._job = job
    host = bench.host()
    record = JobRecord(host, 1, while_running=while_running)
    record.complete(BatchClient(host).state(1), lambda share: None)
    kept = record.samples(0, record.count)
    assert list(kept[:, 0]) == [-5, 2**31 - 1]
    assert kept[1, 1] == pytest.approx(-speed, abs=2**velocity_shift)
    assert kept[0, 2] == pytest.approx(torque, abs=2**torque_shift)


# -- the record, while the job runs ----------------------------------------------------------------------------------


def test_samples_arrive_in_order_while_the_job_runs_and_their_end_afterwards() -> None:
    bench = make_bench(layer="batch", stream_baud=0)
    driver = bench.driver()
    driver.open()
    driver.start_cycling()
    portions: list[tuple[bool, dict[str, np.ndarray]]] = []
    whole = driver.run_batch(
        plan(Sine(START_RAD, 0.3, 1.0, 8)),
        look=lambda reports: None,
        arrived=lambda samples: portions.append((bench.emulator.batch.moving, dict(samples))),
    )
    driver.close()
    for name in ("time_ns", "position_rad", "velocity_rad_s", "torque_nm", "position_command_rad"):
        assert np.array_equal(np.concatenate([portion[name] for _, portion in portions]), whole[name])
    early = sum(len(portion["time_ns"]) for moving, portion in portions if moving)
    # The line carries some 70 samples a second beside the questions; the job makes 250.
    assert 0.2 < early / len(whole["time_ns"]) < 0.3


def fetched_of(*, knows: bool) -> dict[str, np.ndarray]:
    """A job on a controller that knows FREAD 2, or does not: what its driver says of it must be what happens."""
    bench = make_bench(layer="batch", stream_baud=0, settings={"reads_while_running": knows})
    driver = bench.driver()
    driver.open()
    (told,) = (finding.message for finding in driver.check(None) if finding.subject == "transfer")
    assert ("while the job runs" in told) == knows
    moving: list[bool] = []
    columns = driver.run_batch(
        plan(Sine(START_RAD, 0.3, 1.0, 4)), arrived=lambda samples: moving.append(bench.emulator.batch.moving)
    )
    driver.close()
    assert any(moving) == knows
    return dict(columns)


def test_a_controller_that_hands_nothing_over_while_it_runs_is_asked_afterwards() -> None:
    old, new = fetched_of(knows=False), fetched_of(knows=True)
    for name in ("position_rad", "velocity_rad_s", "torque_nm"):
        assert np.array_equal(old[name], new[name])


def test_a_portion_that_cannot_be_had_while_the_job_runs_is_fetched_afterwards() -> None:
    bench = make_bench(layer="batch", stream_baud=0)
    obey, asked = bench.emulator.batch._read_so_far, []

    def refuse_at_first(text: str, operands: list[str]) -> tuple[str, str]:
        asked.append(bench.emulator.now_s)
        return ("90,000", "2080") if len(asked) < 12 else obey(text, operands)

    driver = bench.driver()
    driver.open()
    bench.emulator.batch._read_so_far = refuse_at_first
    with pytest.raises(WrongMode):
        # Five refusals end the asking while it runs; afterwards a refusal is the run's end.
        driver.run_batch(plan(Sine(START_RAD, 0.3, 1.0, 4)))
    assert len(asked) == 6
    assert not bench.emulator.batch.moving
    asked.extend([0.0] * 2)  # eight asked: three more refusals: the job runs on
    assert len(driver.run_batch(plan(Sine(START_RAD, 0.3, 1.0, 4)))["time_ns"]) > 500
    driver.close()


def test_a_stop_is_heard_within_one_block_of_the_record() -> None:
    bench = make_bench(layer="batch", stream_baud=0)
    driver, stopped_s = bench.driver(), []
    driver.open()
    stop_at_s = bench.emulator.now_s + 4.0
    stop = bench.emulator.batch.stop
    bench.emulator.batch.stop = lambda reason: (stopped_s.append(bench.emulator.now_s), stop(reason))
    with pytest.raises(Interrupted):
        driver.run_batch(plan(Sine(START_RAD, 0.3, 1.0, 8)), stop=lambda: bench.emulator.now_s > stop_at_s)
    # A block of the record takes 0.2 s, FSTOP itself less than 0.1 s.
    assert stopped_s[0] - stop_at_s < 0.35
    driver.close()


def test_a_long_job_runs_on_a_controller_that_could_stream_as_well() -> None:
    bench = make_bench()
    driver = bench.driver()
    driver.open()
    assert not driver.capabilities().batch_only
    columns = driver.run_batch(plan(Hold(START_RAD, 4.0)))
    assert len(columns["time_ns"]) == 1001
    driver.close()


def test_a_stop_on_request_brings_the_joint_to_rest_and_keeps_the_record() -> None:
    bench = make_bench(layer="batch")
    driver = bench.driver()
    driver.open()
    asked = iter([False] * 30 + [True] * 1000)
    with pytest.raises(Interrupted):
        driver.run_batch(plan(Sine(START_RAD, 0.3, 0.1)), stop=lambda: next(asked))
    assert len(driver.batch_columns["time_ns"]) > 100
    driver.close()
    assert not bench.still_moving()


def test_a_job_does_not_start_from_elsewhere_or_against_a_hold() -> None:
    bench = make_bench(layer="batch")
    driver = bench.driver()
    driver.open()
    with pytest.raises(HardwareError, match=re.escape("stands at 11.46 deg, the job starts at 17.19 deg")):
        driver.run_batch(plan(Hold(0.3, 0.1)))
    bench.emulator.panel.press_hold("pendant")
    with pytest.raises(PendantHold):
        driver.run_batch(plan())
    with pytest.raises(PlanRefused, match="travel"):
        driver.run_batch(plan(Move(START_RAD, 1.5, 2.0)))
    with pytest.raises(PlanRefused, match="velocity"):
        driver.run_batch(plan(Move(START_RAD, 0.9, 0.1)))


# -- a bad line while a job runs -------------------------------------------------------------------------------------


class DamagedByte(LoopbackPort):
    """A wire that damages one byte, counted over all that went this way."""

    def __init__(self, emulator: Emulator, baud: int, parity: str, way: str, at: int) -> None:
        super().__init__(emulator, baud, parity)
        self._way, self._at = way, at
        self.passed = {"to the controller": 0, "to the host": 0}

    def _damaged(self, way: str, data: bytes) -> bytes:
        begin, damaged = self.passed[way], bytearray(data)
        self.passed[way] += len(data)
        if way == self._way and begin <= self._at < begin + len(data):
            damaged[self._at - begin] ^= 0x10
        return bytes(damaged)

    def write(self, data: bytes) -> None:
        super().write(self._damaged("to the controller", data))

    def read(self, timeout_s: float) -> bytes:
        return self._damaged("to the host", super().read(timeout_s))


def a_watched_job(way: str = "", at: int = -1) -> list[dict[str, int]]:
    """Run a job of nine seconds over such a wire; bytes that had passed at every answer to a question."""
    bench = make_bench(layer="batch", stream_baud=0)
    ports: list[DamagedByte] = []
    passed: list[dict[str, int]] = []

    def port(path: str, baud: int, parity: str) -> DamagedByte:
        ports.append(DamagedByte(bench.emulator, baud, parity, way, at))
        return ports[-1]

    driver = MotomanDriver(bench.setup, port_factory=port)
    driver.open()
    driver.start_cycling()
    columns = driver.run_batch(
        JointPlan("0", (Hold(START_RAD, 9.0),), {}),
        progress=lambda stage, share: passed.append(dict(ports[0].passed)) if stage == "motion" else None,
        look=lambda reports: None,
    )
    driver.close()
    assert len(columns["time_ns"]) == 2251
    return passed


@pytest.mark.slow
@pytest.mark.parametrize("way", ["to the controller", "to the host"])
def test_a_damaged_byte_while_a_job_runs_costs_less_than_its_watchdog(way: str) -> None:
    passed = a_watched_job()
    # One round of questions and the part of the record that comes with it; mostly the latter on the way to the host.
    for at in range(passed[3][way], passed[4][way], 5 if way == "to the controller" else 37):
        a_watched_job(way, at)


@pytest.mark.parametrize("at", range(100, 130, 4))  # every kind of utterance of one round of questions
def test_four_seconds_of_silence_are_less_than_the_watchdog(at: int) -> None:
    bench = make_bench(layer="batch", stream_baud=0, faults=[f"silence@{at}:4"])
    driver = bench.driver()
    driver.open()
    driver.start_cycling()
    begun_s, looks = bench.emulator.now_s, []
    columns = driver.run_batch(
        JointPlan("0", (Hold(START_RAD, 9.0),), {}),
        progress=lambda stage, share: None,
        look=lambda reports: looks.append(bench.emulator.now_s),
    )
    assert max(np.diff([begun_s, *looks])) > 3.9, "the silence fell into the job"
    assert len(columns["time_ns"]) == 2251
    assert driver.standing()[0].valid, "no reply of then is taken for one of now"
    driver.close()


@pytest.mark.parametrize("gone_s", [1, 7, 12])
def test_what_a_job_recorded_is_fetched_once_a_lost_port_is_back(gone_s: int) -> None:
    bench = make_bench(layer="batch", stream_baud=0, faults=[f"unplug@400:{gone_s}"])
    driver = bench.driver()
    driver.open()
    driver.start_cycling()
    with pytest.raises(HardwareError, match="port is gone"):
        driver.run_batch(plan(Sine(START_RAD, 0.3, 1.0, 10)), look=lambda reports: None)
    job = bench.emulator.batch._job
    assert job is not None and job.state == jobs.STOPPED
    assert job.done >= 400
    kept = driver.batch_columns
    pulses = np.rint(kept["position_rad"] * UNITS.pulses_per_rad).astype(int)
    assert pulses.tolist() == [sample[0] for sample in job.samples]
    driver.close()
    assert not bench.emulator.panel.servo_on
    assert not bench.still_moving()


@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.98])
def test_a_port_that_is_lost_during_the_transfer_and_comes_back_costs_nothing(share: float) -> None:
    motion = plan(Sine(START_RAD, 0.3, 1.0, 10))
    spoken: dict[str, int] = {}
    bench = make_bench(layer="batch", stream_baud=0)
    driver = bench.driver()
    driver.open()

    def remember(stage: str, done: float) -> None:
        spoken[f"{stage} {done:.0%}"] = bench.emulator.faults.counted["utterance"]

    whole = driver.run_batch(motion, progress=remember)
    driver.close()
    # From the question about the finished job on, with which the transfer begins.
    first, last = spoken["motion 100%"], spoken["transfer 100%"]
    at = first + round(share * (last - first))
    bench = make_bench(layer="batch", stream_baud=0, faults=[f"close@{at}:8"])
    driver = bench.driver()
    driver.open()
    kept = driver.run_batch(motion)
    driver.close()
    assert np.array_equal(kept["position_rad"], whole["position_rad"])
    assert np.array_equal(kept["torque_nm"], whole["torque_nm"])


def test_a_port_that_never_comes_back_is_not_waited_for_long_and_leaves_what_had_come() -> None:
    bench = make_bench(layer="batch", stream_baud=0, faults=["unplug@1500"])
    driver = bench.driver()
    driver.open()
    arrived: list[float] = []
    with pytest.raises(HardwareError, match="port is gone"):
        driver.run_batch(
            plan(Sine(START_RAD, 0.3, 1.0, 10)),
            look=lambda reports: None,
            arrived=lambda samples: arrived.extend(samples["position_rad"].tolist()),
        )
    job = bench.emulator.batch._job
    assert job is not None
    pulses = np.rint(np.array(arrived) * UNITS.pulses_per_rad).astype(int).tolist()
    assert 0.2 * 1500 < len(pulses) < 0.3 * 1500
    assert pulses == [sample[0] for sample in job.samples[: len(pulses)]]
    assert driver.batch_columns["position_rad"].tolist() == arrived
    assert bench.emulator.now_s < 1500 * TICK_S + 25.0
    driver.close()


# -- the friction table ----------------------------------------------------------------------------------------------

CURVE = FrictionCurve.through(np.linspace(0.2, 2.0, 10), 5.0 + 2.0 * np.sqrt(np.linspace(0.2, 2.0, 10)))


@pytest.mark.parametrize("direction", [1, -1])
def test_the_downloaded_table_gives_the_curve_back(direction: int) -> None:
    bench = make_bench(layer="batch", direction=direction)
    driver = bench.driver()
    driver.open()
    driver.download_table("0", CURVE, ratio=0.9, stiffness_nm_per_rad=8000.0, gravity_cos_nm=4.0, gravity_sin_nm=3.0)
    table: Table = bench.emulator.batch._tables[0][1]
    per_rad = math.degrees(1000.0)
    for speed in np.linspace(0.0, 2.2, 50):
        curve_nm = table.curve_micro(speed * per_rad * 10) * 1e-6 * 100.0
        assert curve_nm == pytest.approx(float(CURVE.magnitude(np.array([speed]))[0]), rel=2e-3)
    compensator = Compensator(table, 0)
    q = 0.7
    pulses = round(direction * q * per_rad)
    moved = compensator.torque_micro(pulses, direction * 1.0 * per_rad * 10, gravity=True) * 1e-6 * 100.0 * direction
    friction = 0.9 * float(CURVE.magnitude(np.array([1.0]))[0])
    assert moved == pytest.approx(friction + 4.0 * math.cos(q) + 3.0 * math.sin(q), rel=2e-3)
    driver.close()


def test_a_damaged_table_is_refused() -> None:
    bench = make_bench()
    coded = friction_table(UNITS, CURVE, 0.9, 8000.0, 0.0, 0.0)
    with pytest.raises(FormatMistake):
        bench.host().order(f"FTABLE 1,{coded[:20]}{'A' if coded[20] != 'A' else 'B'}{coded[21:]}")
    bench.host().order(f"FTABLE 1,{coded}")
    assert len(f"FTABLE 1,{coded}") + 1 <= 256


def test_compensation_is_applied_on_the_controllers_tick() -> None:
    bench = make_bench(layer="batch")
    driver = bench.driver()
    driver.open()
    driver.download_table("0", CURVE, ratio=1.0, stiffness_nm_per_rad=8000.0)
    driver.compensate_by_table(["0"])
    seen: list[float] = []
    axis = bench.emulator.axes[0]
    run = axis.run

    def watch(duration_s: float) -> None:
        seen.append(axis.feed_forward_nm)
        run(duration_s)

    axis.run = watch
    driver.run_batch(plan(Sine(START_RAD, 0.3, 1.0)))
    driver.compensate_by_table([])
    assert max(seen) == pytest.approx(7.0, rel=0.01)
    assert min(seen) == pytest.approx(-7.0, rel=0.01)
    assert axis.feed_forward_nm == 0.0
    driver.close()
