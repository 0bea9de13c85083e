"""Do the 95 % intervals hold the truth, and are they narrow enough to mean something?

    python benchmarks/interval_coverage.py [--amplitudes 20,10,5] [--methods aligned,least-squares] [--draws 3]

The plants are written for the tests, share nothing with the product's simulation, and have effects that no estimator
contains: Maxwell slip, a ripple that multiplies the friction with a rectified sine in it, friction that grows with the
load, a link on a spring. What an interval claims is tested as it is claimed: it holds in 95 of 100 *repetitions*, over
everything it declares itself unsure of. So every joint of every plant is measured ``--draws`` times, each time with
other noise, another starting angle (the phase of the ripple) and a true timing drawn from its declared uncertainty, and

    cover   share of knots, over joints and draws, whose interval holds the truth
    width   rms half width over rms error, over the same knots

Both are of a plant kind as a whole. One recording alone says little: where its errors happen to be small, ``width`` is
large without any interval being wrong. ``flagged`` is the share of recordings that fail a gate and would not be
promoted; they count all the same.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "friction"))

from maxwell import ARM, Joint, record

from frictid_hil.errors import FrictidError
from frictid_hil.friction.estimate import estimate
from frictid_hil.friction.quality import gates
from frictid_hil.friction.recording import CycleRecording, Skew
from frictid_hil.friction.trajectory import Procedure

KINDS = {
    "rigid": {},
    "ripple": {"ripple": 0.1},
    "load": {"load": 0.05},
    "flexible": {"link_share": 0.5, "link_frequency_hz": 28.0},
    "drift": {"drift": -0.03},
    "all at once": {"ripple": 0.06, "load": 0.05, "link_share": 0.5, "link_frequency_hz": 32.0},
}
V_RAD_S = math.radians(115.0)
TORQUE_SHARE = 0.9
"""A plan that needs more of the torque limit is run at a lower V, as `calibrate` would otherwise refuse it."""
UNCERTAINTY_S = 0.0002
"""Declared one standard deviation of the timing, as the CiA-402 driver declares it of a drive with known filters."""


def drawn(joint: Joint, amplitude_deg: float, seed: int) -> CycleRecording:
    """One measurement: its noise, its place on the motor's turn and its true timing drawn anew."""
    rng = np.random.default_rng(seed)
    joint = replace(joint, start=joint.start + rng.uniform(0.0, 0.06))
    amplitude = math.radians(amplitude_deg)
    needed = joint.steady(V_RAD_S) + math.hypot(joint.gravity_cos, joint.gravity_sin)
    fastest = math.sqrt((TORQUE_SHARE * joint.max_torque - needed) * amplitude / (2 * joint.inertia))
    recording: CycleRecording = record(joint, Procedure(amplitude, min(V_RAD_S, fastest)), seed=seed)
    off_s = rng.normal() * UNCERTAINTY_S
    return replace(recording, skew=Skew(torque_delay_s=5e-4 + off_s, uncertainty_s=UNCERTAINTY_S))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--amplitudes", default="20,10,5")
    parser.add_argument("--methods", default="aligned,least-squares")
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--terms", action="store_true", help="print what the intervals are made of, in percent")
    arguments = parser.parse_args()
    print("| plant | A | method | cover | width | rms error [%] | flagged |\n|---|---|---|---|---|---|---|")
    whole: dict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    for kind in arguments.kinds.split(","):
        for amplitude in map(float, arguments.amplitudes.split(",")):
            errors: dict[str, list[float]] = defaultdict(list)
            widths: dict[str, list[float]] = defaultdict(list)
            flagged: dict[str, list[bool]] = defaultdict(list)
            terms: dict[str, list[list[float]]] = defaultdict(list)
            for index, base in enumerate(ARM):
                for draw in range(arguments.draws):
                    joint = replace(base, **KINDS[kind])
                    seed = 1000 * draw + 10 * index + len(kind) + int(100 * amplitude)
                    recording = drawn(joint, amplitude, seed)
                    for method in arguments.methods.split(","):
                        try:
                            found = estimate(recording, method)
                        except FrictidError as problem:
                            print(f"{kind} A={amplitude:g} joint {index}: {problem.what}", file=sys.stderr)
                            flagged[method].append(True)
                            continue
                        knots, level = np.array(found.curve.velocity_rad_s), float(np.mean(found.curve.torque_nm))
                        errors[method].extend((np.array(found.curve.torque_nm) - joint.steady(knots)) / level)
                        widths[method].extend(found.half_width_nm / level)
                        flagged[method].append(not all(gate.passed for gate in gates(recording, found)))
                        if arguments.terms and found.terms is not None:
                            t = found.terms
                            parts = [t.scatter, t.skew, t.model, t.drift, t.link]
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
