"""How many six-joint recordings a second one core takes through Function A, from memory and from files.

    python benchmarks/function_a.py [--recordings 100] [--passes 100] [--files 20]

Distinct recordings of 16 s at 1 kHz are held in memory (velocity and torque of six joints on one time axis) and go
through again and again. From MCAP files, a pass reads every file, and another reads it and puts its joints through:
what counts is the ratio of the two. Processor time of every pass: the best is the machine's, the spread is what a busy
one makes of it.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from frictid_hil.friction import trajectory
from frictid_hil.friction.identify import function_a
from frictid_hil.friction.trajectory import Array, Procedure
from frictid_hil.recording.mcap import write_samples
from frictid_hil.recording.mcap_reader import read_mcap
from frictid_hil.recording.samples import Mark, Samples

PROCEDURE = Procedure(math.radians(20.0), math.radians(115.0))
TIME_S = trajectory.sample_times(PROCEDURE, 0.001)
Recording = tuple[Array, Array]
"""Velocity and torque of six joints, shape (6, n) each."""


def drawn(count: int) -> list[Recording]:
    rng = np.random.default_rng(1)
    v = trajectory.velocity(PROCEDURE, TIME_S)
    torque = 10 * np.sign(v) + 3 * v
    noises = (rng.normal(size=(2, 6, TIME_S.size)) for _ in range(count))
    return [(v + 0.002 * noise[0], torque + 0.3 * noise[1]) for noise in noises]


def seconds(work: Callable[[], None]) -> float:
    began = time.process_time()
    work()
    return time.process_time() - began


def from_memory(recordings: Sequence[Recording]) -> None:
    for velocities, torques in recordings:
        for joint in range(6):
            function_a(TIME_S, velocities[joint], torques[joint], PROCEDURE)


def written(folder: Path, recordings: Sequence[Recording]) -> list[Path]:
    path_rad = trajectory.position(PROCEDURE, TIME_S)
    whole = Mark("cycles", 0, round(PROCEDURE.duration_s * 1e9), {})
    paths = []
    for number, (velocities, torques) in enumerate(recordings):
        joints = [
            Samples(str(joint), np.round(TIME_S * 1e9).astype(np.int64), path_rad, v, f, path_rad, marks=(whole,))
            for joint, (v, f) in enumerate(zip(velocities, torques, strict=True))
        ]
        paths.append(folder / f"{number}.mcap")
        write_samples(paths[-1], joints)
    return paths


def only_read(paths: Sequence[Path]) -> None:
    for path in paths:
        read_mcap(path)


def from_files(paths: Sequence[Path]) -> None:
    for path in paths:
        for samples in read_mcap(path):
            assert samples.velocity_rad_s is not None and samples.torque_nm is not None
            function_a(samples.time_s, samples.velocity_rad_s, samples.torque_nm, PROCEDURE)


def spread(values: Sequence[float]) -> str:
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return f"median {middle:.4g} (5 to 95 % of the passes: {low:.4g} to {high:.4g})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=100)
    parser.add_argument("--passes", type=int, default=100)
    parser.add_argument("--files", type=int, default=20)
    arguments = parser.parse_args()
    recordings = drawn(arguments.recordings)
    from_memory(recordings[:2])
    rates = [len(recordings) / seconds(lambda: from_memory(recordings)) for _ in range(arguments.passes)]
    print(
        f"{len(recordings)} recordings x {arguments.passes} passes, {TIME_S.size} samples x 6 joints, from memory: "
        f"best {max(rates):.0f}, {spread(rates)} a second and core ({1e6 / max(rates) / 6:.0f} us per joint)"
    )
    with tempfile.TemporaryDirectory() as folder:
        paths = written(Path(folder), recordings[: arguments.files])
        only_read(paths)
        passes = max(3, arguments.passes // 10)
        alone, both = [], []
        for _ in range(passes):
            alone.append(seconds(lambda: only_read(paths)))
            both.append(seconds(lambda: from_files(paths)))
        ratios = np.array(both) / np.array(alone)
        print(
            f"{len(paths)} MCAP files x {passes} passes: reading one takes {1e3 * min(alone) / len(paths):.1f} ms; "
            f"with Function A over reading alone: {spread(ratios.tolist())}"
        )


if __name__ == "__main__":
    main()
