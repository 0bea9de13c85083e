"""The scheduler against simulated CiA-402 drives, frame by frame, in lock-step."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from frictid_hil.config.robot import load_robot
from frictid_hil.errors import FrictidError, Interrupted, PlanRefused, SafetyAbort
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.plans import calibration_plan, expected_of
from frictid_hil.plan.plan import Plan, WarmUp
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.driver import Driver, Feedback, JointState, SetPoint, new_driver
from frictid_hil.runner.arm import Arm
from frictid_hil.runner.care import Care
from frictid_hil.runner.cycle import Stream
from frictid_hil.runner.events import Event, JointRun, Marked, PhaseStarted, Preflight
from frictid_hil.runner.motions import Motions
from frictid_hil.runner.ring import Rows, frame_ring, sample_ring
from frictid_hil.runner.scheduler import Recorder, Scheduler

DEG = math.pi / 180
ROBOT = load_robot("hp3j.yaml")


class Stop:
    """Asks to stop once a phase has begun and some cycles of it have passed."""

    def __init__(self, level: int = 0, phase: str = "cycles", after: int = 200) -> None:
        self.wanted = level
        self.phase = phase
        self.after = after
        self.armed = False
        self.reads = 0

    @property
    def level(self) -> int:
        if self.armed:
            self.reads += 1
        return self.wanted if self.reads > self.after else 0


def run(
    joints: tuple[str, ...] = ("3",),
    *,
    change: Callable[[RobotSetup], RobotSetup] = lambda setup: setup,
    proceed: bool = True,
    stop: Stop | None = None,
    together: bool = False,
    cycle_hz: float = 1000.0,
    amplitude_rad: float = 6 * DEG,
    velocity_rad_s: float = 40 * DEG,
    tamper: Callable[[Any, str], None] = lambda driver, phase: None,
) -> tuple[list[Event], Rows, Driver, FrictidError | None]:
    setup = replace(ROBOT.to_setup(), cycle_hz=cycle_hz)
    procedures = {name: Procedure(amplitude_rad, velocity_rad_s, cycles=2) for name in joints}
    plan: Plan = calibration_plan(ROBOT, setup, procedures, expected_of(ROBOT), rehearse=joints, together=together)
    setup = change(setup)
    stop = stop or Stop()
    events: list[Event] = []

    def notify(event: Event) -> None:
        events.append(event)
        if isinstance(event, PhaseStarted):
            tamper(driver, event.phase)
            stop.armed = stop.armed or event.phase == stop.phase

    driver = new_driver("virtual", setup)
    samples = sample_ring(1 << 17)
    scheduler = Scheduler(
        driver, setup, plan, Recorder(samples, frame_ring()), notify=notify, proceed=lambda _: proceed, stop=stop
    )
    ended: FrictidError | None = None
    try:
        scheduler.run()
    except FrictidError as error:
        ended = error
    return events, samples.drain(), driver, ended


@pytest.fixture(scope="module")
def healthy() -> tuple[list[Event], Rows, Driver, FrictidError | None]:
    return run(("3", "4"))


@pytest.mark.slow
def test_joints_run_one_by_one_in_the_planned_order(
    healthy: tuple[list[Event], Rows, Driver, FrictidError | None],
) -> None:
    events, _, _, ended = healthy
    assert ended is None
    assert isinstance(events[0], Preflight)
    assert [event.joint for event in events if isinstance(event, JointRun)] == ["3", "4"]
    phases = [event.phase for event in events if isinstance(event, PhaseStarted) and event.joint == "3"]
    assert phases == [
        "configure",
        "reference",
        "enable",
        "units",
        "move",
        "rehearsal",
        "hold",
        "cycles",
        "drift",
        "hold",
        "reversal",
        "return",
        "hold",
    ]


@pytest.mark.slow
def test_only_the_planned_joint_moves(healthy: tuple[list[Event], Rows, Driver, FrictidError | None]) -> None:
    events, rows, _, _ = healthy
    for run_of in (event for event in events if isinstance(event, JointRun)):
        start, end = run_of.marks[0].start_ns, run_of.marks[-1].end_ns
        during = rows[(rows["t_ns"] >= start) & (rows["t_ns"] < end)]
        moving = ROBOT.joint_names.index(run_of.joint)
        for index in range(6):
            travel = np.ptp(during["position_rad"][during["joint"] == index])
            assert (travel > 5 * DEG) == (index == moving), f"joint {index} travelled {travel:.5f} rad"


@pytest.mark.slow
def test_run_time_goes_on_from_joint_to_joint(healthy: tuple[list[Event], Rows, Driver, FrictidError | None]) -> None:
    events, rows, _, _ = healthy
    first, second = (event for event in events if isinstance(event, JointRun))
    assert second.marks[0].start_ns > first.marks[-1].end_ns
    for index in range(6):
        assert np.all(np.diff(rows["t_ns"][rows["joint"] == index]) > 0)
    assert first.rate_hz == pytest.approx(1000.0)
    assert first.late_cycles == first.missed_cycles == 0


@pytest.mark.slow
def test_lock_step_is_bit_identical(healthy: tuple[list[Event], Rows, Driver, FrictidError | None]) -> None:
    _, rows, _, _ = run(("3", "4"))
    assert rows.tobytes() == healthy[1].tobytes()


def test_without_a_yes_nothing_is_enabled() -> None:
    events, rows, _, ended = run(proceed=False)
    assert isinstance(ended, PlanRefused)
    assert [type(event) for event in events] == [Preflight]
    assert rows.size == 0


def test_a_lost_position_reference_is_refused_before_power() -> None:
    def elsewhere(setup: RobotSetup) -> RobotSetup:
        moved = [replace(j, locked_position_rad=j.locked_position_rad + 0.4) for j in setup.joints[1:2]]
        return replace(setup, joints=(setup.joints[0], *moved, *setup.joints[2:]))

    events, _, _, ended = run(change=elsewhere)
    assert isinstance(ended, SafetyAbort)
    assert "joint 1" in str(ended) and "expected" in str(ended)
    assert "enable" not in [event.phase for event in events if isinstance(event, PhaseStarted)]


@pytest.mark.slow
def test_what_was_reported_instead_is_told() -> None:
    def powerless(driver: Any, phase: str) -> None:
        driver.enable = lambda joint, mode: None

    *_, ended = run(tamper=powerless, cycle_hz=50)
    assert "power on every joint not seen within" in str(ended)
    assert ended is not None and "joint 3 disabled, mode " in ended.cause and "status 0x" in ended.cause


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lie", "said"),
    [
        # A position that is absurdly coarse, one that is wrong by a factor, a velocity that is.
        ({"position_units_per_revolution": 3600.0 * 3}, "one unit of position would be"),
        ({"position_units_per_revolution": 131_072.0 * 50 * 3}, "position says that it moved by"),
        ({"velocity_unit_rad_s": 4e-4}, "its reported velocity says"),
    ],
)
def test_a_drive_that_lies_about_its_units_is_refused_before_motion_proper(lie: dict[str, float], said: str) -> None:
    def lying(setup: RobotSetup) -> RobotSetup:
        joints = [replace(joint, options={**joint.options, **lie}) for joint in setup.joints[3:4]]
        return replace(setup, joints=(*setup.joints[:3], *joints, *setup.joints[4:]))

    events, rows, _, ended = run(change=lying)
    assert ended is not None and said in str(ended) and "joint 3" in str(ended)
    phases = [event.phase for event in events if isinstance(event, PhaseStarted)]
    assert phases == [] or phases[-1] == "units"
    assert rows.size == 0 or np.ptp(rows["position_rad"][rows["joint"] == 3]) < 1 * DEG


@pytest.mark.slow
@pytest.mark.parametrize("level", [1, 2])
def test_a_request_to_stop_brings_the_joint_to_rest(level: int) -> None:
    _, rows, _, ended = run(stop=Stop(level))
    assert isinstance(ended, Interrupted)
    last = rows[rows["joint"] == 3][-20:]
    assert np.abs(last["velocity_rad_s"]).max() < 0.5 * DEG
    assert np.ptp(last["position_rad"]) < 0.01 * DEG


def test_states_are_what_the_protocol_names() -> None:
    assert {state.value for state in JointState} == {"unknown", "disabled", "enabled", "stopping", "fault"}


@pytest.mark.slow
def test_joints_that_move_together_do_so_in_step() -> None:
    events, rows, _, ended = run(("1", "3", "4"), together=True, cycle_hz=400.0)
    assert ended is None
    runs = [event for event in events if isinstance(event, JointRun)]
    assert [event.joint for event in runs] == ["1", "3", "4"]
    assert {event.session for event in runs} == {0}
    assert len({tuple((m.name, m.start_ns, m.end_ns) for m in event.marks) for event in runs}) == 1
    cycles = next(mark for mark in runs[0].marks if mark.name == "cycles")
    assert cycles.details["together"] == ["1", "3", "4"]
    during = rows[(rows["t_ns"] >= cycles.start_ns) & (rows["t_ns"] < cycles.end_ns)]
    paths = [during[during["joint"] == index]["position_command_rad"] for index in (1, 3, 4)]
    for path, name in zip(paths, ("1", "3", "4"), strict=True):
        start_rad = ROBOT.file.joints[name].start_position_rad
        np.testing.assert_allclose(path - start_rad, paths[0] - paths[0][0], atol=1e-4)
    for index in (0, 2, 5):
        assert np.ptp(during["position_rad"][during["joint"] == index]) < 0.25 * DEG


def test_no_joint_that_has_warmed_up_ends_the_motion_of_the_others() -> None:
    """Only a joint alone stops at the end of a cycle: the cycles of others end at other times."""
    loop: Any = SimpleNamespace(period_s=0.001, supervisor=None)
    joints = dict(enumerate(ROBOT.to_setup().joints[:2]))

    def sources(*indices: int) -> list[str]:
        mine: Any = {index: joints[index] for index in indices}
        motions = Motions(loop, mine, [], approach_rad_s=0.1, notify=print)
        warm_ups = {index: WarmUp(0.0, 0.1 + 0.1 * index, 1.0, 60.0, 1.0) for index in indices}
        return [type(source).__name__ for source in motions._sources(warm_ups)[0].values()]

    assert sources(0) == ["WarmUpWatch"]
    assert sources(0, 1) == ["Stream", "Stream"]


@pytest.mark.slow
@pytest.mark.parametrize("level", [1, 2])
def test_a_request_to_stop_brings_all_joints_to_rest(level: int) -> None:
    _, rows, _, ended = run(("3", "4"), stop=Stop(level), together=True, cycle_hz=400.0)
    assert isinstance(ended, Interrupted)
    for index in (3, 4):
        last = rows[rows["joint"] == index][-20:]
        assert np.abs(last["velocity_rad_s"]).max() < 0.5 * DEG
        assert np.ptp(last["position_rad"]) < 0.01 * DEG


@pytest.mark.slow
def test_one_joint_out_of_bounds_stops_all() -> None:
    def faulty(setup: RobotSetup) -> RobotSetup:
        return replace(
            setup, options={**setup.options, "faults": [{"kind": "stuck_encoder", "joint": "4", "at_s": 4.0}]}
        )

    _, rows, _, ended = run(("3", "4"), change=faulty, together=True, cycle_hz=400.0)
    assert isinstance(ended, SafetyAbort)
    assert "joint 4" in str(ended)
    last = rows[rows["joint"] == 3][-20:]
    assert np.abs(last["velocity_rad_s"]).max() < 0.5 * DEG


def test_too_high_a_rate_for_all_at_once_is_refused_with_the_highest_that_fits() -> None:
    _, rows, _, ended = run(ROBOT.joint_names, together=True, cycle_hz=1000.0)
    assert isinstance(ended, PlanRefused)
    assert "use a rate of at most 282 Hz" in ended.next_step
    assert rows.size == 0


def test_set_points_carry_the_speed_at_which_they_move() -> None:
    position_rad = 0.1 * np.sin(3.0 * np.arange(500) * 0.002)
    source, set_point, speeds = Stream(position_rad.tolist(), 0.002), SetPoint(), []
    while source.update(Feedback(), set_point):
        speeds.append(set_point.velocity_rad_s)
    assert np.allclose(speeds[1:-1], 0.3 * np.cos(3.0 * np.arange(500) * 0.002)[1:-1], atol=1e-5)
    assert set_point.position_rad == position_rad[-1] and set_point.velocity_rad_s == 0.0


def test_care_takes_bounds_of_the_robot_file_and_droop_of_the_driver() -> None:
    setup = replace(ROBOT.to_setup(), care={"still_rad": 0.01, "following_error_rad": 0.2})
    plan = calibration_plan(
        ROBOT, setup, {"3": Procedure(6 * DEG, 40 * DEG, cycles=2)}, expected_of(ROBOT), rehearse=()
    )
    care = Care().of_robot(setup.care, {"3": 0.03})
    limits = care.limits(setup.joint("3"), plan.joints[0], 0.0)
    assert limits.still_rad == pytest.approx(0.04) and limits.following_error_rad == pytest.approx(0.23)
    assert care.limits(setup.joint("2"), plan.joints[0], 0.0).still_rad == pytest.approx(0.01)


MS = 1_000_000
TRAVEL = (ROBOT.file.joints["3"].start_position_rad, ROBOT.file.joints["3"].start_position_rad + 4 * DEG)


@pytest.mark.slow
@pytest.mark.parametrize("after", [40, 100, 130, 170, 230, 290, *random.Random(13).sample(range(300), 4)])
def test_a_stop_on_request_stays_within_the_planned_travel_and_in_time(after: int) -> None:
    """A short, fast travel: the stop has less room than a tenth of a second at full speed would take."""
    stop = Stop(1, after=after)
    events, rows, _, ended = run(stop=stop, amplitude_rad=4 * DEG, velocity_rad_s=100 * DEG)
    assert isinstance(ended, Interrupted)
    begun_ns = [event for event in events if isinstance(event, Marked)][-1].mark.end_ns
    mine = rows[(rows["joint"] == 3) & (rows["t_ns"] >= begun_ns)]
    commanded, measured = mine["position_command_rad"], mine["position_rad"]
    assert TRAVEL[0] - 1e-4 <= commanded.min() and commanded.max() <= TRAVEL[1] + 1e-4
    # The servo's own lag and overshoot, which the planned motion shows as well.
    assert TRAVEL[0] - 0.35 * DEG <= measured.min() and measured.max() <= TRAVEL[1] + 0.35 * DEG
    moving = np.flatnonzero(np.abs(mine["velocity_rad_s"]) > 1 * DEG)[-1]
    assert mine["t_ns"][moving] - begun_ns < (after + 500) * MS


def runs_away(driver: Any, phase: str) -> None:
    """The position loop of the drive drives the joint away from its set-point as soon as it has power."""
    if phase != "enable":
        return
    axis = driver._rack.servos["3"].axis
    told = axis.command_until
    axis.command_until = lambda end_ns: (axis._plant.measured_position_rad + 0.5, *told(end_ns)[1:])


def test_a_joint_that_runs_away_at_power_on_is_stopped_within_50_ms_of_the_first_bad_sample() -> None:
    _, rows, _, ended = run(tamper=runs_away)
    assert isinstance(ended, SafetyAbort)
    assert "joint 3" in str(ended) and "should stand" in str(ended)
    mine = rows[rows["joint"] == 3]
    moved = np.abs(mine["position_rad"] - mine["position_rad"][0])
    bad = np.flatnonzero((moved > 1 * DEG) | (np.abs(mine["velocity_rad_s"]) > 15 * DEG))[0]
    still = mine["t_ns"] > mine["t_ns"][bad] + 50 * MS
    assert np.abs(mine["velocity_rad_s"][still]).max() < 1 * DEG
    assert np.ptp(mine["position_rad"]) < 5 * DEG


class TimedStop(Stop):
    """Knows when it asked."""

    clock: Any = None
    asked_ns: int | None = None

    @property
    def level(self) -> int:
        level = super().level
        if level and self.asked_ns is None:
            self.asked_ns = self.clock.now_ns()
        return level


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_stop_at_any_moment_with_power_on_ends_in_time_and_within_the_plan(seed: int) -> None:
    """While power comes, on the way, in a rehearsal: half a second, which holds the longest planned deceleration."""
    dice = random.Random(seed)
    stop = TimedStop(1, phase=("enable", "move", "rehearsal", "reversal")[seed], after=dice.randrange(5, 150))

    def see(driver: Any, _: str) -> None:
        stop.clock = driver.clock

    _, rows, _, ended = run(stop=stop, tamper=see)
    assert isinstance(ended, Interrupted) and stop.asked_ns is not None
    mine = rows[rows["joint"] == 3]
    assert TRAVEL[0] - 0.35 * DEG <= mine["position_rad"].min()
    # The proof of units takes half a degree to either side of where the joint stands.
    assert mine["position_rad"].max() <= ROBOT.file.joints["3"].locked_position_rad + (0.5 + 0.35) * DEG
    moving = mine["t_ns"][np.abs(mine["velocity_rad_s"]) > 1 * DEG]
    assert moving.size == 0 or moving[-1] - stop.asked_ns < 500 * MS
    assert np.abs(mine["velocity_rad_s"][-20:]).max() < 0.5 * DEG


class Lost:
    """A driver whose library breaks while the joints are being brought to rest."""

    def __init__(self) -> None:
        self.stops = 0

    def quick_stop(self) -> None:
        self.stops += 1


def test_what_breaks_while_stopping_never_hides_what_ended_the_run() -> None:
    class Loop:
        driver = Lost()

        def settle(self, duration_s: float) -> None:
            raise ZeroDivisionError("a defect of the driver's library")

    arm = Arm((), Loop(), Care())  # type: ignore[arg-type]
    with pytest.raises(SafetyAbort, match="the first error"):
        try:
            raise SafetyAbort("the first error")
        finally:
            arm.stop()
    assert Loop.driver.stops == 2


def test_a_joint_that_hears_its_set_points_again_catches_up_no_faster_than_it_may() -> None:
    """A drive closes a following error within some 15 ms: unless a robot file sets the bound, that is its measure."""
    setup = ROBOT.to_setup()
    plan = calibration_plan(
        ROBOT, setup, {"3": Procedure(6 * DEG, 40 * DEG, cycles=2)}, expected_of(ROBOT), rehearse=()
    )
    for max_velocity_rad_s, bound_rad in ((2.0, 0.03), (20.0, 5 * DEG)):
        joint = replace(setup.joint("3"), max_velocity_rad_s=max_velocity_rad_s)
        limits = Care().of_robot({}, {}).limits(joint, plan.joints[0], 0.0)
        assert limits.following_error_rad == pytest.approx(bound_rad)
