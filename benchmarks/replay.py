"""Replay: how long a six-joint log takes, whether the profile is the same, and what damage to the log does to it.

    python benchmarks/replay.py [RUN]      records a run of the shipped virtual robot where none is given

Damage is done to 1 % of all frames, drawn at random: removed, swapped with the next one (time stamps travelling with
the frames, or staying in place), sent twice. The row prints what the replay said was missing and how far the curve of
the worst joint is from the clean one, in percent of its mean (15).
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from frictid_hil.config.profile import load_profile
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.replay import ReplayOptions, replay
from frictid_hil.jobs.watch import Silent
from frictid_hil.recording.bus_log import BusLogWriter, Frames, logged, read_frames

SHARE = 0.01
SEEDS = range(5)


def main() -> None:
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        run = Path(sys.argv[1]) if len(sys.argv) > 1 else place / "run"
        if not run.exists():
            calibrate(CalibrateOptions("hp3j", out=run), Silent())
        whole(run)
        damaged(run, place)


def whole(run: Path) -> None:
    began, cpu = time.monotonic(), time.process_time()
    result = replay(ReplayOptions(run, "hp3j", simulation=False))
    wall_s, cpu_s = time.monotonic() - began, time.process_time() - cpu
    log = result["log"]
    frames = read_frames(run / "bus.blf")
    seconds = float(frames.t_ns[-1] - frames.t_ns[0]) * 1e-9
    print(
        f"{len(result['joints'])} joints, {log['frames']} frames, {seconds:.0f} s of bus: {wall_s:.1f} s "
        f"({cpu_s:.1f} s of one core), {seconds / wall_s:.0f} times real time, identical: {result['identical']}"
    )


def damaged(run: Path, place: Path) -> None:
    clean = read_frames(run / "bus.blf")
    kinds = {
        "removed": removed,
        "reordered, stamps travel": reordered,
        "reordered, stamps stay": misplaced,
        "duplicated": duplicated,
    }
    print(f"{'damage':<26}{'outcome':<14}{'lost rows':>10}{'repeated':>10}{'backwards':>10}{'worst curve':>13}")
    for name, damage in kinds.items():
        for seed in SEEDS:
            folder = place / f"{name}-{seed}"
            folder.mkdir()
            for file in ("manifest.json", "profile.yaml"):
                (folder / file).write_bytes((run / file).read_bytes())
            with BusLogWriter(folder / "bus.blf") as writer:
                for frame in logged(damage(clean, np.random.default_rng(seed))):
                    writer.frame(*frame, False)
            result = replay(ReplayOptions(folder, "hp3j", simulation=False))
            told = result["log"]
            worst = max(joint["difference_percent"] or 0.0 for joint in result["joints"].values())
            lost = sum(told["lost_rows"].values())
            print(
                f"{name:<26}{result['outcome']:<14}{lost:>10}{told['repeated']:>10}{told['backwards']:>10}{worst:>12.3f}%"
            )
    assert load_profile(run / "profile.yaml")


def picked(frames: Frames, random: np.random.Generator) -> np.ndarray:
    return np.sort(random.choice(len(frames) - 1, round(SHARE * len(frames)), replace=False))


def taken(frames: Frames, order: np.ndarray, stamps: np.ndarray | None = None) -> Frames:
    t_ns = frames.t_ns[order] if stamps is None else stamps
    return replace(
        frames,
        t_ns=t_ns,
        can_id=frames.can_id[order],
        length=frames.length[order],
        data=frames.data[order],
        sent=frames.sent[order],
    )


def removed(frames: Frames, random: np.random.Generator) -> Frames:
    return taken(frames, np.delete(np.arange(len(frames)), picked(frames, random)))


def swapped(frames: Frames, random: np.random.Generator) -> np.ndarray:
    order = np.arange(len(frames))
    for at in picked(frames, random):
        order[[at, at + 1]] = order[[at + 1, at]]
    return order


def reordered(frames: Frames, random: np.random.Generator) -> Frames:
    return taken(frames, swapped(frames, random))


def misplaced(frames: Frames, random: np.random.Generator) -> Frames:
    return taken(frames, swapped(frames, random), frames.t_ns)


def duplicated(frames: Frames, random: np.random.Generator) -> Frames:
    return taken(frames, np.sort(np.concatenate([np.arange(len(frames)), picked(frames, random)])))


if __name__ == "__main__":
    main()
