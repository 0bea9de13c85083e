"""How well does a short shaking measure by how much torque is late, and does a wrong declaration matter then?

    python benchmarks/measured_skew.py [--plants rigid,flexible,other,maxwell,held-out,mujoco] [--amplitudes 20,5]
        [--draws 3] [--wrong-ms=-2,0,4]

Every joint is driven without a bus through the stretch that `calibrate --measure-skew` adds. The declared delay is
wrong by ``--wrong-ms``; the truth is known. Every cell is the mean error of the measured delay +- its spread over the
draws and wrong declarations (other noise, another place on the motor's turn), and in brackets the deviation that the
measurement states of itself, all in microseconds. A joint whose link swings with the shaking is refused.

    rigid, flexible   the shipped robot's joints, rigid and with a link of 28 Hz: the product's simulation
    other             `other_plant.py`: two masses at 60 Hz, LuGre, Runge-Kutta
    maxwell           the plant of the tests, 10 % ripple; its integrator is itself half a step of 50 us late, taken off
    held-out          `held_out_plant.py`, another seed than that of `interval_coverage.py`
    mujoco            the MuJoCo joint of `accuracy.py`; its implicit step of 0.1 ms is half a step late, taken off
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "friction"))

import maxwell
from accuracy import MujocoJoint
from estimators import joints, softened
from held_out_plant import drawn_arm
from held_out_plant import drive as drive_held_out
from other_plant import OtherPlant

from frictid_hil.errors import IdentificationError
from frictid_hil.friction import trajectory
from frictid_hil.friction.link import soft_link
from frictid_hil.friction.recording import CycleRecording, Skew, synchronised
from frictid_hil.friction.skew import measured_skew
from frictid_hil.friction.trajectory import Array, Procedure
from frictid_hil.jobs.identification.skew_stretch import shaking
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.servo_loop import ServoLoop

STEP_S = 0.001
LEAD = 300
V_RAD_S = math.radians(115.0)

Driven = Callable[[Array, int], tuple[Array, Array]]
"""From set-points and a seed to position and torque, the torque being that of the step before."""


def looped(loop_class: type[ServoLoop] | type[OtherPlant], model: JointModel) -> Driven:
    """A simulated servo, one period after the other."""

    def driven(command: Array, seed: int) -> tuple[Array, Array]:
        loop = loop_class(model, period_s=STEP_S, seed=seed, position_rad=float(command[0]))
        loop.brake(False)
        loop.power(True)
        quantum = model.drive.torque_quantum_per_mille * 1e-3 * model.drive.rated_torque_nm
        rows = np.empty((command.size, 2))
        for k, target in enumerate(command.tolist()):
            loop.advance(STEP_S, position_rad=target)
            rows[k] = loop.measured_position_rad, round(loop.torque_nm / quantum) * quantum
        return rows[:, 0], rows[:, 1]

    return driven


def compiled(drive: Callable[..., tuple[Array, Array, Array]], joint: object) -> Driven:
    """A plant that takes all set-points at once."""

    def driven(command: Array, seed: int) -> tuple[Array, Array]:
        position, _, torque = drive(joint, command, np.gradient(command, STEP_S), seed=seed)
        return position, torque

    return driven


def plants(kind: str) -> Iterator[tuple[float, float, float, Driven]]:
    """Start, gear ratio, its own lateness, and how it is driven."""
    if kind == "mujoco":
        yield 0.0, 100.0, 5e-5, lambda command, seed: MujocoJoint(seed).driven(command)
    elif kind == "held-out":
        for joint in drawn_arm(7):
            yield joint.start, joint.gear_ratio, 0.0, compiled(drive_held_out, joint)
    elif kind == "maxwell":
        for other in maxwell.ARM:
            yield other.start, other.gear_ratio, 25e-6, compiled(maxwell.drive, replace(other, ripple=0.1))
    else:
        for model, start in joints().values():
            plant = softened(model, 28.0) if kind == "flexible" else model
            yield start, model.gear_ratio, 0.0, looped(OtherPlant if kind == "other" else ServoLoop, plant)


def recorded(command: Array, gear_ratio: float, procedure: Procedure, driven: Driven, seed: int) -> CycleRecording:
    position, torque = driven(command, seed)
    return CycleRecording(
        time_s=(np.arange(command.size) - LEAD) * STEP_S,
        position_rad=position,
        torque_nm=torque,
        procedure=procedure,
        skew=Skew(torque_delay_s=STEP_S / 2),
        gear_ratio=gear_ratio,
    )


def measured(kind: str, amplitude_deg: float, draws: int, wrong_s: list[float]) -> str:
    """One row of the table."""
    procedure, cells = Procedure(math.radians(amplitude_deg), V_RAD_S), []
    for start, gear_ratio, late_s, driven in plants(kind):
        errors, stated, refused = [], [], 0
        for draw in range(draws):
            here = start + np.random.default_rng(draw).uniform(0.0, 0.06)
            stretch = recorded(shaken(here, procedure), gear_ratio, procedure, driven, draw)
            link = None
            if kind == "flexible":
                times = np.arange(-LEAD, math.ceil(procedure.duration_s / STEP_S) + LEAD) * STEP_S
                path = here + trajectory.position(procedure, times)
                cycles = recorded(path, gear_ratio, procedure, driven, 100 + draw)
                link = soft_link(cycles, synchronised(cycles), float(np.std(cycles.torque_nm)))
            for wrong in wrong_s:
                declared = replace(stretch, skew=Skew(torque_delay_s=STEP_S / 2 - wrong))
                try:
                    found = measured_skew(declared, link)
                except IdentificationError:
                    refused += 1
                    continue
                errors.append(1e6 * (found.delay_s - wrong - late_s))
                stated.append(1e6 * found.deviation_s)
        cell = f"{refused} refused" if refused else ""
        if errors:
            cell = f"{np.mean(errors):.0f} +- {np.std(errors):.0f} ({np.sqrt(np.mean(np.square(stated))):.0f}) {cell}"
        cells.append(cell.strip())
    return " | ".join(cells)


def shaken(start_rad: float, procedure: Procedure) -> Array:
    """Set-points: a hold, the shaking, a hold."""
    still = np.full(LEAD, start_rad)
    moving = [m.position_rad(np.arange(round(m.duration_s / STEP_S)) * STEP_S) for m in shaking(start_rad, procedure)]
    return np.concatenate([still, *moving, still])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plants", default="rigid,flexible,other,maxwell,held-out,mujoco")
    parser.add_argument("--amplitudes", default="20,5")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--wrong-ms", default="-2,0,4")
    arguments = parser.parse_args()
    wrong_s = [1e-3 * float(value) for value in arguments.wrong_ms.split(",")]
    print("| plant | A [deg] | " + " | ".join(f"joint {k}" for k in range(6)) + " |\n" + "|---|---|" + "---|" * 6)
    for kind in arguments.plants.split(","):
        for amplitude in map(float, arguments.amplitudes.split(",")):
            print(f"| {kind} | {amplitude:g} | {measured(kind, amplitude, arguments.draws, wrong_s)} |", flush=True)


if __name__ == "__main__":
    main()
