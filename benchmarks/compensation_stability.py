"""Where compensated joints stand still, and where they begin to hunt or run away.

    python benchmarks/compensation.py calibrate --out runs/benchmark
    python benchmarks/compensation_stability.py bus --profile runs/benchmark/profile.yaml
    python benchmarks/compensation_stability.py pushes --profile runs/benchmark/profile.yaml
    python benchmarks/compensation_stability.py limits --profile runs/benchmark/profile.yaml

With ``--elastic 30`` the links resonate at 30 Hz; the profile is then one identified on such joints (``calibrate
--robot`` with the file that ``robot --elastic 30 --out FILE`` writes).

With ``--other`` they are joints that this product did not simulate (``other_plant``), each calibrated first; once for
all with ``--kept FOLDER``.

``bus``: R + 0.02 and K + 10 %, with 2 and 5 cycles of delay, through driver, bus and drive. ``free``: a person swings
the joint and lets go of it in full swing; ``PD hold``: the low-gain PD of the track task brings it to a place and holds
it; forwards and backwards.

``pushes``: the same R and K, without the bus, by the product's own law on the simulated joint: pushed to 3 to 20
deg/s, forwards and backwards, and let go.

``limits``: R and K upwards from our setting in steps of 0.01 until a joint pushed to 20 deg/s, either way, no longer
comes to rest within 4 s, or gets faster than it was when let go; as ``pushes``.

A joint stands where its true speed in the last second is below 0.01 deg/s rms. ``bus`` and ``pushes`` end with 1 where
one does not.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from compensation_other_plant import calibrated
from compensation_robots import JOINTS, variant
from other_plant import OtherPlant

from frictid_drivers.virtual import joint_drive
from frictid_hil.config.profile import JointProfile, load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import FrictidError
from frictid_hil.jobs.compensation.plan import law_of
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.plan.control import Bounds, Compensated, ControlLaw, Swing
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Hold, Motion, Move, Plan, joint_plan
from frictid_hil.plan.setup import JointSetup
from frictid_hil.protocol.driver import Feedback
from frictid_hil.runner.compensation import LawInForce
from frictid_hil.runner.events import Event, PhaseStarted
from frictid_hil.runs.run import run_plan
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.servo_loop import ServoLoop

STILL_DEG_S = 0.01
MORE_RATIO, MORE_STIFFNESS = 0.02, 1.1
PUSHED_RAD_S, PUSHED_HZ = math.radians(20.0), 0.5
PUSHES_DEG_S = (3.0, 5.0, 8.0, 12.0, 20.0)
REST_S = 5.0
GROWTH = 1.05
"""A joint that is faster than when it was let go by this factor runs away, wherever it stops."""
RINGING_CYCLES = 100
"""After it was let go: the last of the push arrives, and an elastic link rings."""


def changed_law(entry: JointProfile, setup: JointSetup, hold: bool, ratio: float, stiffness: float) -> ControlLaw:
    """Mode mop of setting ``ours`` with R plus ``ratio`` and K times ``stiffness``."""
    law = law_of(entry, setup, "mop", Wanted("track" if hold else "hand", ("mop",)), [])
    assert law.friction is not None
    friction = law.friction
    return replace(
        law,
        friction=replace(
            friction,
            ratio=friction.ratio + ratio,
            stiffness_nm_per_rad=friction.stiffness_nm_per_rad * stiffness,
        ),
    )


# -- through the bus ---------------------------------------------------------------------------------------------------


Plant = type[ServoLoop] | type[OtherPlant]
built: list[Any] = []


def remembering(plant: Plant) -> type[Any]:
    """The simulated joint, remembering how fast it really was."""

    class Truth(plant):  # type: ignore[misc,valid-type]
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            self.speeds: list[float] = []
            built.append(self)

        def advance(self, *arguments: Any, **options: Any) -> None:
            """As the simulated joint's."""
            super().advance(*arguments, **options)
            self.speeds.append(self.true_velocity_rad_s)

    return Truth


def of_joint(options: argparse.Namespace, joint: str, folder: Path, delay: int = 2) -> tuple[Path, JointProfile, Plant]:
    """Robot file, profile and plant of one joint."""
    robot = variant(folder / "robot.yaml", joints=[joint], elastic_hz=options.elastic, delay_cycles=delay)
    if not options.other:
        return robot, load_profile(options.profile).joints[joint], ServoLoop
    _, profile = calibrated(joint, options.kept or folder, options.bus, options.seed)
    return robot, load_profile(profile).joints[joint], OtherPlant


def off_the_bus(options: argparse.Namespace, joint: str) -> tuple[JointProfile, JointSetup, Plant]:
    """Profile, limits and plant of one joint that is driven on bare arrays."""
    with tempfile.TemporaryDirectory() as folder:
        robot, entry, plant = of_joint(options, joint, Path(folder))
        return entry, load_robot(str(robot)).to_setup().joint(joint), plant


class Forgetful:
    """Keeps nothing."""

    def samples(self, rows: object) -> None:
        """Ignore."""

    def frames(self, rows: object) -> None:
        """Ignore."""


def on_the_bus(
    robot: Path, bus: str, entry: JointProfile, joint: str, hold: bool, way: float, seed: int
) -> tuple[float, str]:
    """(True speed of the last second, deg/s rms; what stopped it) at R + 0.02 and K + 10 %, moved forwards or back."""
    loaded = load_robot(str(robot))
    setup = loaded.to_setup(bus, seed=seed)
    one = setup.joint(joint)
    law = changed_law(entry, one, hold, MORE_RATIO, MORE_STIFFNESS)
    centre = one.start_position_rad + math.radians(10.0)
    wide = Bounds(one.position_min_rad, one.position_max_rad, one.max_velocity_rad_s, math.inf)
    amplitude = PUSHED_RAD_S / (2 * math.pi * PUSHED_HZ)
    motions: list[Motion] = [Move.within(one.locked_position_rad, centre, math.radians(20.0)), Hold(centre, 0.3)]
    if hold:
        goal = centre + way * math.radians(5.0)
        motions.append(Compensated("there", Move.within(centre, goal, math.radians(20.0)), law, wide))
        motions.append(Compensated("rest", Hold(goal, REST_S), law, wide))
    else:
        # Let go of in the middle of the travel, forwards after two periods, backwards half a period later.
        swing = Swing(centre, amplitude, PUSHED_HZ, (2.0 if way > 0 else 2.5) / PUSHED_HZ)
        motions.append(Compensated("swing", swing, law, wide))
        motions.append(Compensated("rest", Hold(centre, REST_S), law, wide))
    # The joint is looked at while it rests under the law; the run ends there.
    plan = Plan(loaded.name, setup.cycle_hz, (joint_plan(one, motions, {}, None),))
    drivers: list[Any] = []
    built.clear()

    def notify(event: Event) -> None:
        if isinstance(event, PhaseStarted) and event.phase == "swing":
            drivers[0].simulate_hand(joint, centre, amplitude, PUSHED_HZ)
        elif isinstance(event, PhaseStarted) and event.phase == "rest":
            if not hold:
                drivers[0].simulate_hand(joint, centre, 0.0, 0.0)
            begun.append(len(built[0].speeds))

    begun: list[int] = []
    stopped = ""
    try:
        run_plan("virtual", setup, plan, Forgetful(), notify=notify, proceed=lambda _: True, prepare=drivers.append)
    except FrictidError as error:
        stopped = error.what
    if not begun:
        return math.inf, stopped
    end = begun[0] + round(REST_S * setup.cycle_hz)
    last = np.array(built[0].speeds[end - round(setup.cycle_hz) : end])
    return (math.degrees(float(np.sqrt(np.mean(last**2)))) if last.size else math.inf), stopped


def bus(options: argparse.Namespace) -> None:
    print(f"# through the bus, R + 0.02, K + 10 %, {told_of(options)}")
    print("| joint | R | K [N m/rad] | delay [cycles] | free: forwards [deg/s] | back | PD: forwards | back | stands |")
    print("|---|---|---|---|---|---|---|---|---|")
    fell = False
    for joint in options.joint or JOINTS:
        for delay in options.delay or (2, 5):
            with tempfile.TemporaryDirectory() as folder:
                robot, entry, plant = of_joint(options, joint, Path(folder), delay)
                with patch.object(joint_drive, "ServoLoop", remembering(plant)):
                    found = [
                        on_the_bus(robot, options.bus, entry, joint, hold, way, options.seed)
                        for hold in (False, True)
                        for way in (1.0, -1.0)
                    ]
                friction = changed_law(
                    entry, load_robot(str(robot)).to_setup().joint(joint), False, MORE_RATIO, MORE_STIFFNESS
                ).friction
            told = "; ".join(stopped for _, stopped in found if stopped)
            stands = "yes" if not told and all(speed < STILL_DEG_S for speed, _ in found) else f"NO {told}"
            fell |= stands != "yes"
            assert friction is not None
            print(
                f"| {joint} | {friction.ratio:.2f} | {friction.stiffness_nm_per_rad:.0f} | {delay} "
                f"| {' | '.join(f'{speed:.5f}' for speed, _ in found)} | {stands} |",
                flush=True,
            )
    if fell:
        raise SystemExit(1)


# -- pushes -----------------------------------------------------------------------------------------------------------


def pushes(options: argparse.Namespace) -> None:
    print(f"# pushed to {', '.join(f'{v:g}' for v in PUSHES_DEG_S)} deg/s, R + 0.02, K + 10 %, {told_of(options)}")
    print("| joint | delay [cycles] | forwards, fastest of all [deg/s rms] | backwards | stands |")
    print("|---|---|---|---|---|")
    fell = False
    for joint in options.joint or JOINTS:
        entry, setup, plant = off_the_bus(options, joint)
        law = changed_law(entry, setup, False, MORE_RATIO, MORE_STIFFNESS)
        for delay in options.delay or (2, 5):
            fastest = [
                max(alone(law, setup, delay, way, plant, math.radians(speed)) for speed in PUSHES_DEG_S)
                for way in (1.0, -1.0)
            ]
            stands = max(fastest) < STILL_DEG_S
            fell |= not stands
            print(
                f"| {joint} | {delay} | {fastest[0]:.5f} | {fastest[1]:.5f} | {'yes' if stands else 'NO'} |", flush=True
            )
    if fell:
        raise SystemExit(1)


# -- limits ------------------------------------------------------------------------------------------------------------


def limits(options: argparse.Namespace) -> None:
    print(f"# pushed to 20 deg/s and let go, {told_of(options)}; K over presliding")
    print("| joint | delay [cycles] | our K | largest R, free | largest K, free | largest K, PD hold |")
    print("|---|---|---|---|---|---|")
    for joint in options.joint or JOINTS:
        entry, setup, plant = off_the_bus(options, joint)
        presliding = entry.presliding_stiffness_nm_per_rad.value or math.nan
        for delay in options.delay or (2, 5):
            ours = changed_law(entry, setup, False, 0.0, 1.0).friction
            assert ours is not None
            share = ours.stiffness_nm_per_rad / presliding

            stands = partial(stands_with, entry, setup, delay, plant)
            largest_ratio = largest(partial(by_ratio, stands, ours.ratio), ours.ratio, 1.3)
            largest_k = [math.nan, math.nan]
            if not options.ratio_only:
                lowest = math.floor(100 * share) / 100
                largest_k = [largest(partial(by_stiffness, stands, share, hold), lowest, 4.0) for hold in (False, True)]
            print(
                f"| {joint} | {delay} | {share:.2f} | {largest_ratio:.2f} | {largest_k[0]:.2f} | {largest_k[1]:.2f} |",
                flush=True,
            )


def stands_with(
    entry: JointProfile,
    setup: JointSetup,
    delay: int,
    plant: Plant,
    more_ratio: float,
    factor: float,
    hold: bool,
) -> bool:
    """Whether the joint comes to rest from a push either way, with this much more R and K."""
    law = changed_law(entry, setup, hold, more_ratio, factor)
    return all(alone(law, setup, delay, push, plant) < STILL_DEG_S for push in (1.0, -1.0))


def by_ratio(stands: Callable[[float, float, bool], bool], own: float, ratio: float) -> bool:
    return stands(ratio - own, 1.0, False)


def by_stiffness(stands: Callable[[float, float, bool], bool], share: float, hold: bool, stiffness: float) -> bool:
    return stands(0.0, stiffness / share, hold)


def told_of(options: argparse.Namespace) -> str:
    """Which joints these are."""
    plant = "other plant" if options.other else f"elastic {options.elastic:g} Hz"
    return f"seed {options.seed}, {plant}"


def largest(good: Callable[[float], bool], low: float, high: float) -> float:
    """The last step of 0.01 before the first that fails, on the way up; beyond it a joint may stand again by chance.

    NaN where not even the first one stands.
    """
    if not good(low):
        return math.nan
    value = low
    while value < high and good(value + 0.01):
        value += 0.01
    return value


def alone(
    law: ControlLaw,
    setup: JointSetup,
    delay_cycles: int,
    push: float,
    plant: Plant,
    pushed_rad_s: float = PUSHED_RAD_S,
) -> float:
    """True speed of the last of five seconds, deg/s rms, of one simulated joint pushed in the direction of ``push``.

    Infinite where it gets faster than it was when let go.
    """
    model = JointModel.from_mapping(
        setup.simulated,
        gear_ratio=setup.gear_ratio,
        rated_torque_nm=setup.rated_torque_nm,
        max_torque_nm=setup.max_torque_nm,
    )
    centre = setup.start_position_rad + math.radians(10)
    loop = plant(model, period_s=0.001, position_rad=centre)
    loop.brake(False)
    loop.power(True)
    loop.set_mode(Mode.TORQUE.value)
    in_force = LawInForce(law, 0.001, law.gravity.torque_nm(centre))
    step_nm = setup.rated_torque_nm / 1000.0
    # One cycle of the delay is the simulated joint's own.
    queue = [in_force.torque_nm] * (delay_cycles - 1)
    assert law.friction is not None
    push_nm = 2.0 * push * law.friction.coulomb_nm
    report, velocities, pushing = Feedback(valid=True), [], True
    free, fastest = 0, 0.0
    for k in range(5000):
        report.position_rad, report.velocity_rad_s = loop.measured_position_rad, loop.velocity_rad_s
        torque = in_force.update(report, (centre, 0.0))
        pushing = pushing and k < 1000 and abs(loop.true_velocity_rad_s) < pushed_rad_s
        queue.append(torque + (push_nm if pushing else 0.0))
        loop.advance(0.001, torque_nm=round(queue.pop(0) / step_nm) * step_nm)
        velocities.append(loop.true_velocity_rad_s)
        free += not pushing
        speed = abs(loop.true_velocity_rad_s)
        if free <= RINGING_CYCLES:
            fastest = max(fastest, GROWTH * speed)
        elif speed > fastest:
            return math.inf
    return math.degrees(float(np.sqrt(np.mean(np.square(velocities[4000:])))))


def robot(options: argparse.Namespace) -> None:
    print(variant(Path(options.out), elastic_hz=options.elastic))


VERBS = {"bus": bus, "pushes": pushes, "limits": limits, "robot": robot}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=list(VERBS))
    parser.add_argument("--bus", default="virtual:stability")
    parser.add_argument("--profile", default="runs/benchmark/profile.yaml")
    parser.add_argument("--out", default="elastic.yaml")
    parser.add_argument("--joint", action="append")
    parser.add_argument("--elastic", type=float, default=0.0)
    parser.add_argument("--other", action="store_true")
    parser.add_argument("--kept", type=Path, help="folder of the other plant's calibrations, used again")
    parser.add_argument("--delay", type=int, action="append")
    parser.add_argument("--ratio-only", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    VERBS[options.what](options)


if __name__ == "__main__":
    main()
