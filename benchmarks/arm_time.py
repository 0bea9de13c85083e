"""Seven joints, ten minutes of logs, one command: how long does the diagnosis take on two cores?

Run: python benchmarks/arm_time.py [--minutes 10] [--rate 500] [--folder FOLDER]

The arm of ``arm_in_mujoco.py`` with one more joint in its forearm; two of the seven have more friction than the file
says. The logs are made first (a minute or two) and kept in FOLDER where one is given.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from arm_in_mujoco import ARM, COLUMNS, DEFAULTS, JOINTS, STEP_S, Array, Machine, command, recorded, write_log

SEVEN = (*JOINTS[:3], "roll", *JOINTS[3:])
MACHINE = Machine(friction={"lift": 1.4, "wrist_1": 1.4})
LOG_S = 60.0


def seven_joints() -> str:
    """The arm's file with a joint that rolls the forearm."""
    hand = '<body name="hand_1" pos="0.57 0 0">'
    roll = """<body name="mid" pos="0.3 0 0">
              <inertial pos="0.1 0 0.01" mass="1.5" diaginertia="0.004 0.02 0.02"/>
              <joint name="roll" class="small" axis="1 0 0"/>
              <body name="hand_1" pos="0.27 0 0">"""
    text = ARM.replace(hand, roll).replace("  </worldbody>", "</body>\n  </worldbody>", 1)
    motor = '    <position name="wrist_1"'
    return text.replace(motor, '    <position name="roll" joint="roll" class="small"/>\n' + motor)


def seven_commands(seed: int) -> Array:
    """Random Fourier motion of all seven, shape (n, 7)."""
    six = command(seed, LOG_S, STEP_S, len(JOINTS))
    return np.insert(six, 3, command(seed + 500, LOG_S, STEP_S, 1)[:, 0] * 0.5, axis=1)


def write_logs(folder: Path, minutes: float, rate_hz: float) -> list[Path]:
    """Model, map and logs of a minute each; the paths of the logs."""
    (folder / "drives.xml").write_text(DEFAULTS)
    (folder / "arm.xml").write_text(seven_joints())
    (folder / "columns.yaml").write_text(COLUMNS)
    every = max(1, round(1.0 / (rate_hz * STEP_S)))
    logs = []
    for k in range(max(2, round(60.0 * minutes / LOG_S))):
        log = recorded(folder / "arm.xml", MACHINE, seven_commands(k), seed=k)
        path = folder / f"motion_{k + 1:02d}.csv"
        logs.append(write_log(path, {name: column[::every] for name, column in log.items()}, SEVEN))
    return logs


def timed(folder: Path, logs: list[Path]) -> dict[str, object]:
    """Wall-clock seconds and answers of the command as a user types it, pages and improved model included."""
    words = ["gap", "diagnose", "--model", "arm.xml", *(log.name for log in logs), "--columns", "columns.yaml"]
    out = ["--out", "pages", "--write-model", "better.xml", "--force", "--json"]
    begin = time.perf_counter()
    run = [sys.executable, "-c", "from frictid_hil.cli.app import app; app()", *words, *out]
    told = json.loads(subprocess.run(run, cwd=folder, check=True, capture_output=True, text=True).stdout)
    verdicts = {name: joint["verdict"] for name, joint in told["joints"].items()}
    return {"seconds": round(time.perf_counter() - begin, 1), "verdicts": verdicts, "arm": told["arm"]["cause"]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--rate", type=float, default=500.0)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = arguments.folder or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        logs = sorted(folder.glob("motion_*.csv")) or write_logs(folder, arguments.minutes, arguments.rate)
        print(json.dumps(timed(folder, logs), indent=2))


if __name__ == "__main__":
    main()
