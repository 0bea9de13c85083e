"""What every driver must do, as a pytest suite that runs against your own fake of the wire.

::

    from frictid_hil.testing.driver_conformance import DriverConformance, Truth

    class TestMyDriver(DriverConformance):
        @pytest.fixture
        def bench(self):
            return MyBench()        # see ``Bench``

Each check drives a fresh driver through its life and compares what it says with what the fake knows to be true.
``CHECKS`` are plain functions, for those who use another test runner: they raise ``AssertionError``.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import pytest

from frictid_hil.errors import FrictidError, PlanRefused, SafetyAbort
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.protocol.driver import (
    Driver,
    DriverKind,
    Feedback,
    FrameMapped,
    JointIdentity,
    JointState,
    SetPoint,
    Severity,
)
from frictid_hil.protocol.frames import LogDecoder


@dataclass(frozen=True, slots=True)
class Truth:
    """What a fake knows of a joint, joint side, in the joint's direction."""

    position_rad: float  # where it is
    velocity_rad_s: float  # how fast it moves
    torque_nm: float  # what its motor gives
    powered: bool  # its power stage is on


class Bench(Protocol):
    """Your fake: a robot of one joint or more that stands without power at its locked positions."""

    setup: RobotSetup  # of the robot; its ``cycle_hz`` is used. Joints need some friction or inertia, and room to move

    def driver(self) -> Driver:
        """A new driver on a fresh wire; what the others do concerns the newest one."""

    def truth(self, joint: str) -> Truth:
        """Of the newest wire, now."""

    def silence(self, silent: bool) -> None:
        """From now on nothing of the newest wire reaches the host, or everything again."""

    def decoder(self, driver: Driver) -> LogDecoder | None:
        """A fresh decoder for logs of this driver; None where it brings none."""


class Rig:
    """A driver that is opened, configured at the bench's rate, and cycles; set-points are at the locked positions.

    ``frames`` are all that was told to the frame sink, ``rows`` what each cycle reported, as text, where ``keep`` is.
    """

    def __init__(self, bench: Bench) -> None:
        self.bench, self.setup = bench, bench.setup
        self.driver = bench.driver()
        self.frames: list[tuple[int, int, bytes]] = []
        self.rows: list[list[str]] = []
        self.keep = False
        self.driver.open(lambda t_ns, can_id, data, sent: self.frames.append((t_ns, can_id, data)))
        self.identities = self.driver.identify()
        self.capabilities = self.driver.capabilities()
        self.driver.configure(self.setup.cycle_hz, [joint.name for joint in self.setup.joints])
        for joint in self.setup.joints:
            self.driver.set_limits(
                joint.name,
                torque_nm=joint.max_torque_nm,
                position_min_rad=joint.position_min_rad,
                position_max_rad=joint.position_max_rad,
            )
        self.set_points = [SetPoint(joint.locked_position_rad) for joint in self.setup.joints]
        self.driver.start_cycling()
        self._period_ns = round(1e9 / self.setup.cycle_hz)
        self._next_ns = self.driver.clock.now_ns()

    def cycle(self) -> Sequence[Feedback]:
        """One exchange at its time."""
        self._next_ns = max(self._next_ns + self._period_ns, self.driver.clock.now_ns())
        self.driver.clock.wait_until(self._next_ns)
        reports = self.driver.exchange(self.set_points)
        if self.keep:
            self.rows.append([str(report) for report in reports])
        return reports

    def seconds(self, duration_s: float, until: Callable[[Sequence[Feedback]], bool] = lambda _: False) -> bool:
        """Exchanges for so long, or until something is seen; whether it was."""
        return any(until(self.cycle()) for _ in range(max(1, round(duration_s * self.setup.cycle_hz))))

    def enable(self, mode: Mode = Mode.POSITION) -> None:
        """Every joint, seen to be; only the first one in another mode than position."""
        for at, joint in enumerate(self.setup.joints):
            self.driver.enable(joint.name, Mode.POSITION if at else mode)
        on = self.seconds(5.0, lambda reports: all(report.state is JointState.ENABLED for report in reports))
        assert on, "no power within 5 s of `enable`"

    def move(
        self, by_rad: float, duration_s: float, watch: Callable[[Feedback, Truth], None] | None = None, at: int = 0
    ) -> None:
        """One joint by so much and smoothly, told its speed as well; watched in the middle half of the time."""
        steps = max(4, round(duration_s * self.setup.cycle_hz))
        set_point, joint = self.set_points[at], self.setup.joints[at].name
        start_rad = set_point.position_rad
        for k in range(1, steps + 1):
            share = k / steps
            set_point.position_rad = start_rad + by_rad * (share - math.sin(math.tau * share) / math.tau)
            set_point.velocity_rad_s = by_rad / duration_s * (1.0 - math.cos(math.tau * share)) if k < steps else 0.0
            report = self.cycle()[at]
            if watch is not None and 0.25 <= share <= 0.75:
                watch(report, self.bench.truth(joint))

    def truths(self) -> list[Truth]:
        """Of all joints."""
        return [self.bench.truth(joint.name) for joint in self.setup.joints]

    def slack_rad(self, at: int = 0) -> float:
        """How far a joint may be from its set-point while it stands."""
        joint = self.setup.joints[at].name
        return (
            0.02
            + 3.0 * _finite(self.identities[joint].position_resolution_rad)
            + self.capabilities.droop_rad.get(joint, 0.0)
        )


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _stroke_rad(joint: JointSetup) -> float:
    """A travel towards the further limit that every joint has room for, rad."""
    up = joint.position_max_rad - joint.locked_position_rad
    down = joint.locked_position_rad - joint.position_min_rad
    return min(0.3, 0.4 * up) if up >= down else -min(0.3, 0.4 * down)


# -- the checks --------------------------------------------------------------------------------------------------------


def says_what_it_is(bench: Bench) -> None:
    """It is a ``Driver``, says its kind, and making one touches nothing."""
    driver = bench.driver()
    assert isinstance(driver, Driver), "a method of the protocol is missing"
    assert isinstance(getattr(type(driver), "kind", None), DriverKind), "no class attribute `kind`: see DriverKind"
    for call in (driver.quick_stop, driver.close, driver.close):
        call()
    try:
        driver.exchange([SetPoint() for _ in bench.setup.joints])
    except FrictidError:
        return
    raise AssertionError("`exchange` before `open` must raise an error of ours")


def tells_identities_and_findings(bench: Bench) -> None:
    """Every joint is identified, ``check`` has no error for a healthy robot, and nothing got power."""
    driver = bench.driver()
    driver.open()
    identities = driver.identify()
    assert list(identities) == [joint.name for joint in bench.setup.joints], "identities are not those of the joints"
    for name, identity in identities.items():
        assert isinstance(identity, JointIdentity) and identity.torque_source, f"joint {name}: what is its torque?"
        assert identity.position_resolution_rad > 0 and identity.torque_resolution_nm > 0, f"joint {name}: resolution"
    errors = [finding for finding in driver.check(None) if finding.severity is Severity.ERROR]
    assert not errors, f"errors found on a healthy robot: {errors}"
    capabilities = driver.capabilities()
    assert capabilities.max_cycle_hz >= bench.setup.cycle_hz and capabilities.modes, "capabilities"
    assert not any(bench.truth(joint.name).powered for joint in bench.setup.joints), "power without `enable`"
    driver.close()


def refuses_a_rate_it_cannot_keep(bench: Bench) -> None:
    """Far above the highest rate, ``check`` finds an error or ``configure`` refuses the plan."""
    driver = bench.driver()
    driver.open()
    most_hz = driver.capabilities().max_cycle_hz
    if math.isfinite(most_hz):
        try:
            driver.configure(20.0 * most_hz, [bench.setup.joints[0].name])
        except PlanRefused:
            pass
        else:
            raise AssertionError(f"configured at 20 times its highest rate of {most_hz:g} Hz")
    driver.close()


def switches_on_without_a_jump(bench: Bench) -> None:
    """Power comes on where the joint stands, or a set-point elsewhere is refused; and the state is the truth."""
    rig = Rig(bench)
    before = rig.truths()
    for joint, set_point in zip(rig.setup.joints, rig.set_points, strict=True):
        set_point.position_rad = joint.locked_position_rad + _stroke_rad(joint)
    try:
        rig.enable()
    except SafetyAbort:
        rig.driver.close()
        rig = Rig(bench)
        before = rig.truths()
        rig.enable()
    rig.seconds(0.2)
    for at, (was, now) in enumerate(zip(before, rig.truths(), strict=True)):
        assert now.powered, "reports ENABLED without power"
        assert abs(now.position_rad - was.position_rad) <= rig.slack_rad(at), "jumped when power came on"
    for joint in rig.setup.joints:
        rig.driver.disable(joint.name)
    off = rig.seconds(3.0, lambda reports: all(report.state is JointState.DISABLED for report in reports))
    assert off and not any(truth.powered for truth in rig.truths()), "no rest within 3 s of `disable`"
    rig.driver.close()


def reports_in_the_units_of_the_joint(bench: Bench) -> None:
    """A known motion of each joint: position, velocity, torque and the echo of the command, in size and sign."""
    for at, joint in enumerate(bench.setup.joints):
        rig = Rig(bench)
        rig.enable()
        rig.seconds(0.1)
        before = rig.truths()
        stroke_rad = _stroke_rad(joint)
        for by_rad in (stroke_rad, -stroke_rad):
            seen: list[tuple[Feedback, Truth]] = []
            rig.move(
                by_rad,
                max(0.6, 2.5 * abs(by_rad) / joint.max_velocity_rad_s),
                lambda report, truth, seen=seen: seen.append((_copy(report), truth)),  # type: ignore[misc]
                at,
            )
            _judge_units(rig, joint, by_rad, seen)
        for other, (was, now) in enumerate(zip(before, rig.truths(), strict=True)):
            still = other == at or abs(now.position_rad - was.position_rad) <= rig.slack_rad(other)
            assert still, f"joint {rig.setup.joints[other].name} moved with joint {joint.name}"
        rig.driver.close()


def _judge_units(rig: Rig, joint: JointSetup, by_rad: float, seen: Sequence[tuple[Feedback, Truth]]) -> None:
    identity, count = rig.identities[joint.name], len(seen)
    speed = sum(truth.velocity_rad_s for _, truth in seen) / count
    assert speed * by_rad > 0, "the joint moved against its set-point"
    for report, truth in seen:
        apart = abs(report.position_rad - truth.position_rad)
        late = 4.0 * abs(truth.velocity_rad_s) / rig.setup.cycle_hz
        assert apart <= late + 2.0 * identity.position_resolution_rad + 1e-3, (
            f"position: reported {report.position_rad:.4f} rad, true {truth.position_rad:.4f} rad"
        )
    told = sum(report.velocity_rad_s for report, _ in seen) / count
    assert abs(told - speed) <= 0.15 * abs(speed) + 0.01, f"velocity: reported {told:.4f}, true {speed:.4f} rad/s"
    told = sum(report.torque_nm for report, _ in seen) / count
    torque = sum(truth.torque_nm for _, truth in seen) / count
    assert abs(told - torque) <= 0.3 * abs(torque) + 2.0 * identity.torque_resolution_nm, (
        f"torque: reported {told:.4f} N m, true {torque:.4f} N m"
    )
    in_force_rad, there_rad = seen[-1][0].position_command_rad, seen[-1][1].position_rad
    assert math.isnan(in_force_rad) or abs(in_force_rad - there_rad) < abs(by_rad), "position_command_rad"


def keeps_to_its_modes(bench: Bench) -> None:
    """Torque mode gives the torque asked for, in sign and size; a mode that it has not is refused."""
    rig = Rig(bench)
    first = rig.setup.joints[0]
    for mode in (Mode.POSITION, Mode.VELOCITY, Mode.TORQUE):
        if mode in rig.capabilities.modes:
            continue
        try:
            rig.driver.enable(first.name, mode)
        except FrictidError:
            continue
        raise AssertionError(f"mode {mode.name} is not among its capabilities and was not refused")
    if Mode.TORQUE in rig.capabilities.modes:
        rig.enable(Mode.TORQUE)
        shown = rig.seconds(0.5, lambda reports: reports[0].mode is Mode.TORQUE)
        assert shown, "mode TORQUE is not shown"
        for sign in (1, -1):
            rig.set_points[0].torque_nm = sign * 0.1 * first.max_torque_nm
            rig.seconds(0.03)
            torque_nm = bench.truth(first.name).torque_nm
            assert abs(torque_nm - rig.set_points[0].torque_nm) <= 0.05 * first.max_torque_nm, (
                f"asked for {rig.set_points[0].torque_nm:.3f} N m, given {torque_nm:.3f} N m"
            )
    rig.driver.close()


def stays_within_limits(bench: Bench) -> None:
    """No set-point makes it leave the position limits, and none makes it give more than the torque limit.

    A driver may keep to them or refuse by ``SafetyAbort``.
    """
    rig = Rig(bench)
    joint = rig.setup.joints[0]
    stroke_rad = _stroke_rad(joint)
    ends = sorted((joint.locked_position_rad - stroke_rad / 4, joint.locked_position_rad + stroke_rad))
    limit_nm = 0.2 * joint.max_torque_nm
    rig.driver.set_limits(joint.name, torque_nm=joint.max_torque_nm, position_min_rad=ends[0], position_max_rad=ends[1])
    rig.enable()
    rig.seconds(0.05)
    with contextlib.suppress(SafetyAbort):
        rig.move(1.5 * stroke_rad, 1.5)
        rig.seconds(0.3)
    position_rad = bench.truth(joint.name).position_rad
    assert ends[0] - rig.slack_rad() <= position_rad <= ends[1] + rig.slack_rad(), "left its position limits"
    rig.driver.close()
    if Mode.TORQUE in rig.capabilities.modes:
        rig = Rig(bench)
        rig.driver.set_limits(
            joint.name,
            torque_nm=limit_nm,
            position_min_rad=joint.position_min_rad,
            position_max_rad=joint.position_max_rad,
        )
        rig.enable(Mode.TORQUE)
        rig.set_points[0].torque_nm = joint.max_torque_nm
        rig.seconds(0.03)
        torque_nm = bench.truth(joint.name).torque_nm
        assert abs(torque_nm) <= limit_nm + 0.05 * joint.max_torque_nm, f"{torque_nm:.3f} N m above {limit_nm:.3f} N m"
        rig.driver.close()


def holds_a_locked_joint(bench: Bench) -> None:
    """A locked joint holds whatever its set-point says; unlocked, it waits until that moves, or refuses the step."""
    rig = Rig(bench)
    rig.enable()
    name = rig.setup.joints[0].name
    before_rad = bench.truth(name).position_rad
    rig.driver.lock(name)
    rig.move(_stroke_rad(rig.setup.joints[0]), 0.5)
    assert abs(bench.truth(name).position_rad - before_rad) <= rig.slack_rad(), "a locked joint followed its set-point"
    rig.driver.unlock(name)
    with contextlib.suppress(SafetyAbort):
        rig.seconds(0.2)
    assert abs(bench.truth(name).position_rad - before_rad) <= rig.slack_rad(), "`unlock` made it jump"
    rig.driver.close()


def stops_quickly(bench: Bench) -> None:
    """``quick_stop`` in full motion brings it to rest within half a second, and it stays there."""
    rig = Rig(bench)
    rig.enable()
    joint = rig.setup.joints[0]
    steps = round(0.4 * rig.setup.cycle_hz)
    stroke_rad = _stroke_rad(joint)
    for k in range(steps // 2):
        rig.set_points[0].position_rad = joint.locked_position_rad + stroke_rad * k / steps
        rig.set_points[0].velocity_rad_s = stroke_rad / 0.4
        rig.cycle()
    rig.driver.quick_stop()
    rig.driver.quick_stop()
    rig.seconds(0.5)
    stood_rad = bench.truth(joint.name).position_rad
    for _ in range(round(0.3 * rig.setup.cycle_hz)):
        rig.set_points[0].position_rad += stroke_rad / steps
        rig.cycle()
    assert abs(bench.truth(joint.name).position_rad - stood_rad) <= rig.slack_rad(), "moved after `quick_stop`"
    rig.driver.close()


def refuses_what_is_no_number(bench: Bench) -> None:
    """A set-point of NaN or infinity raises ``SafetyAbort``, and no joint moves because of it."""
    for wrong in (math.nan, math.inf):
        rig = Rig(bench)
        rig.enable()
        rig.seconds(0.1)
        before = [truth.position_rad for truth in rig.truths()]
        rig.set_points[0].position_rad = wrong
        try:
            rig.cycle()
        except SafetyAbort:
            pass
        else:
            raise AssertionError(f"a set-point of {wrong} was taken")
        rig.set_points[0].position_rad = before[0]
        rig.seconds(0.3)
        for at, (was, truth) in enumerate(zip(before, rig.truths(), strict=True)):
            assert abs(truth.position_rad - was) <= rig.slack_rad(at), "moved because of a set-point that is no number"
        rig.driver.close()


def counts_the_age_of_silence(bench: Bench) -> None:
    """Without reports the last figures stay and grow older by one each cycle; back again, they are young.

    A driver may also end the run by an error of ours.
    """
    rig = Rig(bench)
    rig.enable()
    reports = [_copy(report) for report in rig.cycle()]
    assert all(report.valid and report.age_cycles == 0 for report in reports), "not all joints report in a cycle"
    bench.silence(True)
    for cycles in (1, 2, 3):
        try:
            silent = rig.cycle()
        except FrictidError:
            bench.silence(False)
            rig.driver.close()
            return
        for was, report in zip(reports, silent, strict=True):
            assert report.age_cycles == cycles, f"age {report.age_cycles} after {cycles} silent cycles"
            assert report.position_rad == was.position_rad, "invented a position"
    bench.silence(False)
    fresh = rig.seconds(0.2, lambda now: all(report.age_cycles == 0 for report in now))
    assert fresh, "does not hear them again"
    rig.driver.close()


def stamps_every_row(bench: Bench) -> None:
    """Time stamps are run time from zero, grow by a period, and no joint is stamped in the future."""
    rig = Rig(bench)
    rig.enable()
    stamps = []
    for _ in range(10):
        reports = rig.cycle()
        now_ns = rig.driver.clock.now_ns()
        assert all(0 <= report.t_ns <= now_ns for report in reports), "a time stamp before zero or after now"
        stamps.append(reports[0].t_ns)
    period_ns = 1e9 / rig.setup.cycle_hz
    for early, late in pairwise(stamps):
        assert 0.5 * period_ns <= late - early <= 1.5 * period_ns or not rig.driver.clock.lock_step, (
            "stamps stand still"
        )
        assert late > early, "two rows with the same time stamp"
    rig.driver.close()


def lets_go_when_closed(bench: Bench) -> None:
    """``close`` in full motion leaves every joint at rest and without power; closing again does no harm."""
    rig = Rig(bench)
    rig.enable()
    rig.move(_stroke_rad(rig.setup.joints[0]) / 2, 0.3)
    rig.driver.close()
    assert not any(truth.powered for truth in rig.truths()), "still under power after `close`"
    rig.driver.close()
    rig.driver.quick_stop()


def replays_as_it_ran(bench: Bench) -> None:
    """A log of its frames decodes to the figures that it reported live, row by row."""
    rig = Rig(bench)
    decoder = bench.decoder(rig.driver)
    if decoder is None:
        assert not isinstance(rig.driver, FrameMapped), "brings a frame map: `Bench.decoder` must give its decoder"
        rig.driver.close()
        return
    rig.enable()
    rig.keep = True
    rig.move(_stroke_rad(rig.setup.joints[0]) / 2, 0.3)
    count = len(rig.frames)
    rows = [[str(report) for report in row.feedback] for row in decoder.rows(iter(rig.frames[:count]))]
    assert rows[-len(rig.rows) :] == rig.rows, "a replay of its frames gives other figures than the live run"
    rig.driver.close()


def _copy(report: Feedback) -> Feedback:
    return Feedback(**{name: getattr(report, name) for name in Feedback.__slots__})


CHECKS: tuple[Callable[[Bench], None], ...] = (
    says_what_it_is,
    tells_identities_and_findings,
    refuses_a_rate_it_cannot_keep,
    switches_on_without_a_jump,
    reports_in_the_units_of_the_joint,
    keeps_to_its_modes,
    stays_within_limits,
    holds_a_locked_joint,
    stops_quickly,
    refuses_what_is_no_number,
    counts_the_age_of_silence,
    stamps_every_row,
    lets_go_when_closed,
    replays_as_it_ran,
)


class DriverConformance:
    """Derive from it, name the class ``Test...`` and give it a fixture ``bench``."""

    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_conforms(self, check: Callable[[Bench], None], bench: Bench) -> None:
        """One check on one bench."""
        check(bench)
