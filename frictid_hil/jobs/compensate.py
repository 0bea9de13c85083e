"""``frictid-hil compensate``: compensates a joint with a profile, in one mode after the other.

The order is always the same. Profile and plan are checked, the drives are read and compared with the profile, and a
person is asked. A travel that is new to this robot is rehearsed, and the joint is probed in position control. Only then
it is given its compensation (section 5 of the paper). ``compensation.result`` forms the figures of each mode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from frictid_hil.config.profile import LOOP_STIFFNESS
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import Interrupted, UsageError
from frictid_hil.jobs.compensation.figures import mode_run
from frictid_hil.jobs.compensation.plan import Asked, compensation_plan
from frictid_hil.jobs.compensation.profile_fit import doubts_of_drive, doubts_of_file, refuse
from frictid_hil.jobs.compensation.result import CompensationResult, Progress, result_of
from frictid_hil.jobs.compensation.wanted import MODES, Wanted
from frictid_hil.jobs.plans import expected_of
from frictid_hil.jobs.profiles import named_profile
from frictid_hil.jobs.watch import Watcher
from frictid_hil.plan.control import Compensated
from frictid_hil.plan.limits import refuse_beyond_limits
from frictid_hil.plan.mode import Mode
from frictid_hil.protocol.driver import OWN_FRICTION_COMPENSATION, Driver
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.care import Care
from frictid_hil.runner.events import Event, JointRun, Marked, PhaseStarted, Preflight
from frictid_hil.runner.ring import Rows
from frictid_hil.runs.keeper import RowKeeper
from frictid_hil.runs.life import Order, Run
from frictid_hil.runs.rehearsals import Rehearsals
from frictid_hil.units import degrees

VERB = "compensate"


@dataclass(frozen=True, slots=True)
class CompensateOptions:
    """What a person asked for, see ``frictid-hil compensate --help``."""

    robot: str
    # File, a run folder that holds one, or an id of the store; ``active`` is the one in force there.
    profile: Path | str
    joint: str
    wanted: Wanted  # task, modes, setting and the rest of what is to be run
    bus: str | None = None
    realtime: bool = False
    seed: int = 0
    out: Path | None = None
    store: Path | None = None


def plan_compensation(options: CompensateOptions) -> Asked:
    """Decide all that can be before a bus is opened (``UsageError``: arguments, files, an unfit profile, limits)."""
    robot = load_robot(options.robot)
    robot.check_joints([options.joint])
    simulated = robot.kind(options.bus).simulated
    setup = robot.to_setup(options.bus, realtime=options.realtime, seed=options.seed)
    joint = setup.joint(options.joint)
    profile, profile_path = named_profile(str(options.profile), robot.name, options.store)
    wanted = options.wanted.completed(simulated=simulated)
    doubts = doubts_of_file(profile, joint, robot.name, robot.policy)
    if not wanted.force:
        refuse(doubts, joint.name)
    if wanted.task == "hand" and simulated and "hand" not in joint.simulated:
        raise UsageError(
            "this simulated joint has nobody to guide it",
            where=f"joint {joint.name}",
            next_step="give it stiffness and damping under `simulated: hand:` in the robot file",
        )
    entry = profile.joint(joint.name)
    if measured := entry.quality.get(LOOP_STIFFNESS):
        # Measured together with the friction; it takes the place of a stated one.
        setup = setup.with_joint(joint.name, loop_stiffness_nm_per_rad=measured)
    forced = [f"forced in spite of: {doubt}" for doubt in doubts]
    rehearsals = Rehearsals(robot, options.bus)
    asked = compensation_plan(robot, setup, joint.name, profile_path, entry, wanted, rehearsals, forced)
    refuse_beyond_limits(asked.plan, setup, expected_of(robot))
    return asked


def compensate(options: CompensateOptions, watcher: Watcher, live: Live | None = None) -> CompensationResult:
    """Compensate a joint in each mode that is asked for, and compare the modes; ``live`` is told figures of a service.

    ``UsageError``, ``HardwareError``: before anything moved. Later an error, also a refusal by the probe, is an ending.
    """
    asked = plan_compensation(options)
    order = Order(VERB, asked.robot, asked.setup, options.bus, {"profile": str(asked.profile)}, options.out)
    progress = Progress()
    hand = Hand(asked, watcher)

    def doubt(preflight: Preflight) -> None:
        doubts = doubts_of_drive(asked.entry, preflight.identities[asked.joint])
        if not asked.wanted.force:
            refuse(doubts, asked.joint)
        for one in doubts:
            watcher.note(f"forced in spite of: {one}")
        _refuse_mode(asked.wanted.drive_mode, preflight)

    with Run(order, watcher) as run:
        figures = LiveFigures(asked.joint, live)

        def noticed(event: Event) -> None:
            hand.follow(event)
            if isinstance(event, PhaseStarted) and event.phase.partition(" ")[2] in MODES:
                figures.counting = True

        error = run.move(
            asked.plan,
            each=lambda moved: _measure(moved, run, asked, progress),
            asked=doubt,
            noticed=noticed,
            through=figures.before if asked.wanted.endless else lambda keeper: keeper,
            prepare=hand.take_driver,
            care=Care(tolerated=frozenset({OWN_FRICTION_COMPENSATION} if asked.wanted.force else ())),
        )
        half = run.so_far(asked.joint) if error is not None else None
        if half is not None and isinstance(error, Interrupted):
            # A service has no other end; what it rehearsed was seen whole.
            run.rehearsed(half, asked.plan)
        if asked.wanted.endless:
            progress.service = figures.mark()
        elif half is not None and progress.run is None:
            _measure(half, run, asked, progress)
        return result_of(asked, run, progress, error)


def _refuse_mode(mode: Mode, preflight: Preflight) -> None:
    can = preflight.capabilities
    if mode is Mode.TORQUE and mode not in can.modes and can.torque_offset:
        raise UsageError(
            "these drives take no torque by itself, so that nobody can guide the joint by hand",
            cause="the hand test and a tracking test of ours need torque control; these drives close their own loop",
            next_step="use --task track --drive-mode position, which compensates on top of that loop",
        )
    if mode is not Mode.TORQUE and not can.torque_offset:
        other = "use --drive-mode torque" if Mode.TORQUE in can.modes else "they have no torque mode either (6502)"
        raise UsageError("these drives take no torque offset (60B2)", next_step=other)
    if mode not in can.modes:
        raise UsageError(f"these drives have no {mode.name.lower()} mode (6502)")


def _measure(moved: JointRun, run: Run, asked: Asked, progress: Progress) -> None:
    """Cut each mode's task out of what the joint has done."""
    progress.run = moved if moved.cycles else None
    samples = run.folder.samples(moved)
    motions = {m.name: m for m in asked.plan.joints[0].motions if isinstance(m, Compensated)}
    for mark in samples.marks:
        task, _, mode = mark.name.partition(" ")
        if task == asked.wanted.task and mark.name in motions:
            progress.runs[mode] = mode_run(samples, mark, motions[mark.name], mode, asked.wanted.period_s)


_LIVE_NS = 500_000_000
_HELD_BACK_NS = 1_000_000_000  # of a service's figures: how it was ended is not counted


@runtime_checkable
class GuidedBySimulation(Protocol):
    """A driver whose robot has a simulated person."""

    def simulate_hand(self, joint: str, centre_rad: float, amplitude_rad: float, frequency_hz: float) -> None:
        """Guide the joint along centre + amplitude sin(2 pi f t) from now; frequency 0 lets go."""


Live = Callable[[str], None]  # told a line of figures twice a second while a service runs


class Hand:
    """The simulated person, following the phases; on a real robot the person reads what to do."""

    def __init__(self, asked: Asked, watcher: Watcher) -> None:
        self._joint = asked.joint
        self._centre_rad = asked.centre_rad
        names = {motion.name for motion in asked.plan.joints[0].motions}
        # A person who does not rest lets go at the end of the swing.
        self._last = {
            name if (rest := name.replace("hand ", "rest ")) not in names else rest
            for name in names
            if name[:5] == "hand "
        }
        self._wanted = asked.wanted
        self._watcher = watcher
        self._driver: GuidedBySimulation | None = None

    def take_driver(self, driver: Driver) -> None:
        """Remember a driver that has a simulated person (``run_plan``'s ``prepare``)."""
        if isinstance(driver, GuidedBySimulation):
            self._driver = driver

    def follow(self, event: Event) -> None:
        """Guide the joint, hold it at rest or let it go, as the phase needs it."""
        if self._wanted.task != "hand":
            return
        if isinstance(event, PhaseStarted):
            phase = event.phase.partition(" ")[0]
            if phase == "hand":
                self._guide(self._wanted.amplitude_rad)
            elif phase == "rest":
                self._guide(0.0)
        elif isinstance(event, Marked) and event.mark.name in self._last and self._driver is not None:
            self._driver.simulate_hand(self._joint, self._centre_rad, 0.0, 0.0)

    def _guide(self, amplitude_rad: float) -> None:
        if self._driver is not None:
            self._driver.simulate_hand(self._joint, self._centre_rad, amplitude_rad, 1.0 / self._wanted.period_s)
        elif amplitude_rad:
            self._watcher.note(
                f"move joint {self._joint} by hand, {degrees(amplitude_rad):.0f} deg to either side, "
                f"back and forth in {self._wanted.period_s:g} s"
            )
        else:
            self._watcher.note(f"bring joint {self._joint} back to {degrees(self._centre_rad):.0f} deg and hold it")


class LiveFigures:
    """Keeps rows as the keeper does, forgets them, and tells what they say."""

    def __init__(self, joint: str, live: Live | None) -> None:
        self._joint = joint
        self._live = live
        self._sums = np.zeros(3)
        self._recent: list[Rows] = []
        self._told_ns = 0
        self._seen_ns = 0
        self.counting = False

    def before(self, keeper: RowKeeper) -> LiveFigures:
        """Pass rows on to ``keeper`` from now on, after looking at them."""
        self._keeper = keeper
        return self

    def samples(self, rows: Rows) -> None:
        """Keep rows, add those of the joint to the figures, and tell the figures now and then."""
        self._keeper.samples(rows)
        now_ns = int(rows["t_ns"][-1]) + 1
        mine = self._keeper.taken(self._joint, self._seen_ns, now_ns)
        self._seen_ns = now_ns
        if not (mine.size and self.counting):
            return
        recent = np.concatenate([*self._recent, mine])
        old = recent["t_ns"] < now_ns - _HELD_BACK_NS
        counted, self._recent = recent[old], [recent[~old]]
        torque = np.nan_to_num(counted["external_torque_nm"])
        self._sums += (counted.size, float(np.sum(counted["velocity_rad_s"] ** 2)), float(np.sum(torque**2)))
        if self._live is not None and now_ns - self._told_ns >= _LIVE_NS:
            self._told_ns = now_ns
            self._live(_live_line(recent))

    def frames(self, rows: Rows) -> None:
        """Keep the frames of the bus."""
        self._keeper.frames(rows)

    def mark(self) -> Mark:
        """Return the sums over a service as a mark, so that they are kept with the recording."""
        return Mark("service", 0, self._seen_ns, {"count_v2_t2": self._sums.tolist()})


def _live_line(rows: Rows) -> str:
    last = rows[-1]
    external = rows["external_torque_nm"]
    hand = f"hand {np.sqrt(np.mean(external**2)):6.3f} N m rms" if np.isfinite(external).all() else "hand not measured"
    return (
        f"{last['t_ns'] * 1e-9:8.1f} s  {degrees(float(last['position_rad'])):8.2f} deg  "
        f"{degrees(float(last['velocity_rad_s'])):7.1f} deg/s  drive {float(last['torque_nm']):7.2f} N m  {hand}"
    )
