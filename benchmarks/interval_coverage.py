"""Do the 95 % intervals hold the truth, and are they narrow enough to mean something?

    python benchmarks/interval_coverage.py [--amplitudes 20,10,5] [--methods aligned,least-squares] [--draws 3]
        [--measured] [--held-out SEEDS] [--exact]

The plants are written for the tests, share nothing with the product's simulation, and have effects that no estimator
contains: Maxwell slip, a ripple that multiplies the friction with a rectified sine in it, friction that grows with the
load, a link on a spring. What an interval claims is tested as it is claimed: it holds in 95 of 100 *repetitions*, over
everything it declares itself unsure of. So every joint of every plant is measured ``--draws`` times, each time with
other noise, another starting angle (the phase of the ripple) and a true timing drawn from its declared uncertainty, and

    cover   share of knots, over joints and draws, whose interval holds the truth
    width   rms half width over rms error, over the same knots

Both are of a plant kind as a whole. One recording alone says little: where its errors happen to be small, ``width`` is
large without any interval being wrong. ``flagged`` is the share of recordings that fail a gate and would not be
promoted; they count all the same. ``--measured`` lets every joint shake as `calibrate --measure-skew` does, with the
torque still drawn late by the declared uncertainty; ``--exact`` draws no lateness. ``--held-out`` takes arms of
`held_out_plant.py`, one drawn with each seed, in place of all of these.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "friction"))

from held_out_plant import HeldOutJoint, drawn_arm
from held_out_plant import drive as drive_held_out
from maxwell import ARM, Joint, record
from maxwell import drive as drive_maxwell

from frictid_hil.errors import FrictidError
from frictid_hil.friction import trajectory
from frictid_hil.friction.estimate import estimate
from frictid_hil.friction.quality import gates
from frictid_hil.friction.recording import CycleRecording, Repeat, Skew
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.identification.skew_stretch import shaking

KINDS = {
    "rigid": {},
    "ripple": {"ripple": 0.1},
    "load": {"load": 0.05},
    "flexible": {"link_share": 0.5, "link_frequency_hz": 28.0},
    "drift": {"drift": -0.03},
    "small drift, ripple, load": {"drift": -0.01, "ripple": 0.06, "load": 0.05},
    "all at once": {"ripple": 0.06, "load": 0.05, "link_share": 0.5, "link_frequency_hz": 32.0},
}
V_RAD_S = math.radians(115.0)
TORQUE_SHARE = 0.9
"""A plan that needs more of the torque limit is run at a lower V, as `calibrate` would otherwise refuse it."""
UNCERTAINTY_S = 0.0002
"""Declared one standard deviation of the timing, as the CiA-402 driver declares it of a drive with known filters."""


STEP_S = 0.001


@dataclass(frozen=True)
class Draws:
    """What is drawn anew for every measurement."""

    measured: bool
    exact: bool

    def of(
        self, joint: Joint | HeldOutJoint, amplitude_deg: float, seed: int
    ) -> tuple[Joint | HeldOutJoint, CycleRecording]:
        """One measurement: its noise, its place on the motor's turn and its true timing drawn anew."""
        rng = np.random.default_rng(seed)
        joint = replace(joint, start=joint.start + rng.uniform(0.0, 0.06))
        procedure = within_torque(joint, math.radians(amplitude_deg))
        off_s = 0.0 if self.exact else rng.normal() * UNCERTAINTY_S
        skew = Skew(torque_delay_s=STEP_S / 2 + off_s, uncertainty_s=UNCERTAINTY_S)
        plain = record if isinstance(joint, Joint) else held_out
        recording = replace(plain(joint, procedure, seed=seed), skew=skew)
        return joint, replace(recording, shaken=shaken(joint, recording, seed)) if self.measured else recording


def within_torque(joint: Joint | HeldOutJoint, amplitude_rad: float) -> Procedure:
    """V, or the highest speed that leaves a tenth of the torque."""
    if isinstance(joint, Joint):
        needed = joint.steady(V_RAD_S) + math.hypot(joint.gravity_cos, joint.gravity_sin)
    else:
        needed = float(joint.steady(np.array(V_RAD_S), joint.start)) * (1 + joint.asymmetry) + joint.gravity
    fastest = math.sqrt((TORQUE_SHARE * joint.max_torque - needed) * amplitude_rad / (2 * joint.inertia))
    return Procedure(amplitude_rad, min(V_RAD_S, fastest))


def held_out(joint: HeldOutJoint, procedure: Procedure, *, seed: int) -> CycleRecording:
    """A hold, the cycles, the third again, a hold."""
    lead, starts = 300, procedure.cycle_starts_s
    again_s = float(starts[3] - starts[2])
    time_s = (np.arange(2 * lead + math.ceil((procedure.duration_s + again_s) / STEP_S)) - lead) * STEP_S
    after = time_s - procedure.duration_s
    path = np.where(after < 0, time_s, np.where(after < again_s, after + starts[2], -1.0))
    command = joint.start + trajectory.position(procedure, path)
    q, v, f = drive_held_out(joint, command, trajectory.velocity(procedure, path), seed=seed)
    return CycleRecording(
        time_s, q, f, procedure, velocity_rad_s=v, command_rad=command, gear_ratio=joint.gear_ratio,
        torque_limit_nm=joint.max_torque, repeat=Repeat(3, procedure.duration_s),
    )  # fmt: skip


def shaken(joint: Joint | HeldOutJoint, recording: CycleRecording, seed: int) -> CycleRecording:
    """The stretch that `calibrate --measure-skew` adds."""
    moving = [
        motion.position_rad(np.arange(round(motion.duration_s / STEP_S)) * STEP_S)
        for motion in shaking(joint.start, recording.procedure)
    ]
    command = np.concatenate([still := np.full(300, joint.start), *moving, still])
    drive = drive_maxwell if isinstance(joint, Joint) else drive_held_out
    q, _, f = drive(joint, command, np.gradient(command, STEP_S), seed=seed + 1)
    time_s = (np.arange(command.size) - still.size) * STEP_S
    return replace(
        recording, time_s=time_s, position_rad=q, torque_nm=f, velocity_rad_s=None, command_rad=None, repeat=None
    )


def truth_nm(joint: Joint | HeldOutJoint, procedure: Procedure, speed_rad_s: np.ndarray) -> np.ndarray:
    """What the intervals must hold.

    Friction of a held-out joint depends on the place and falls while it warms up: one curve can only be the mean over
    the travel and over the run.
    """
    if isinstance(joint, Joint):
        steady: np.ndarray = joint.steady(speed_rad_s)
        return steady
    places = joint.start + procedure.amplitude_rad * np.linspace(0.0, 1.0, 21)
    here = np.mean([joint.steady(speed_rad_s, place) for place in places], axis=0)
    truth: np.ndarray = joint.warm(procedure.duration_s) * here
    return truth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--amplitudes", default="20,10,5")
    parser.add_argument("--methods", default="aligned,least-squares")
    parser.add_argument("--kinds", default=";".join(KINDS), help="parted by ;")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--terms", action="store_true", help="print what the intervals are made of, in percent")
    parser.add_argument("--measured", action="store_true", help="every joint shakes, and the delay is measured")
    parser.add_argument("--exact", action="store_true", help="the declared timing happens to be right")
    parser.add_argument("--held-out", metavar="SEEDS", help="arms of held_out_plant.py instead")
    arguments = parser.parse_args()
    draws = Draws(arguments.measured, arguments.exact)
    arm = (
        [joint for seed in arguments.held_out.split(",") for joint in drawn_arm(int(seed))]
        if arguments.held_out
        else ARM
    )
    kinds = arguments.kinds.split(";") if not arguments.held_out else ["held out"]
    print("| plant | A | method | cover | width | rms error [%] | flagged |\n|---|---|---|---|---|---|---|")
    whole: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    for kind in kinds:
        for amplitude in map(float, arguments.amplitudes.split(",")):
            errors: dict[str, list[float]] = defaultdict(list)
            widths: dict[str, list[float]] = defaultdict(list)
            flagged: dict[str, list[bool]] = defaultdict(list)
            terms: dict[str, list[list[float]]] = defaultdict(list)
            for index, base in enumerate(arm):
                for draw in range(arguments.draws):
                    joint = replace(base, **KINDS.get(kind, {}))
                    seed = 1000 * draw + 10 * index + len(kind) + int(100 * amplitude)
                    joint, recording = draws.of(joint, amplitude, seed)
                    for method in arguments.methods.split(","):
                        try:
                            found = estimate(recording, method)
                        except FrictidError as problem:
                            print(f"{kind} A={amplitude:g} joint {index}: {problem.what}", file=sys.stderr)
                            flagged[method].append(True)
                            continue
                        knots, level = np.array(found.curve.velocity_rad_s), float(np.mean(found.curve.torque_nm))
                        errors[method].extend(
                            (np.array(found.curve.torque_nm) - truth_nm(joint, recording.procedure, knots)) / level
                        )
                        widths[method].extend(found.half_width_nm / level)
                        flagged[method].append(not all(gate.passed for gate in gates(recording, found)))
                        if arguments.terms and found.terms is not None:
                            t = found.terms
                            parts = [t.scatter, t.skew, t.model, t.drift, t.beside, t.link]
                            terms[method].append([float(np.mean((100 * part / level) ** 2)) for part in parts])
            for method, error in errors.items():
                e, w = np.array(error), np.array(widths[method])
                whole[method][0].extend(e)
                whole[method][1].extend(w)
                print(
                    f"| {kind} | {amplitude:g} | {method} | {np.mean(np.abs(e) <= w):.2f} | "
                    f"{np.sqrt(np.mean(w**2) / np.mean(e**2)):.1f} | {100 * np.sqrt(np.mean(e**2)):.2f} | "
                    f"{np.mean(flagged[method]):.2f} |"
                    + (f" {np.sqrt(np.mean(terms[method], axis=0)).round(3)}" if terms[method] else ""),
                    flush=True,
                )
    for method, (error, width) in whole.items():
        e, w = np.array(error), np.array(width)
        print(
            f"\n{method}, everything above: cover {np.mean(np.abs(e) <= w):.3f}, "
            f"width {np.sqrt(np.mean(w**2) / np.mean(e**2)):.1f}"
        )


if __name__ == "__main__":
    main()
