"""``frictid-hil calibrate`` over a pseudo terminal and the wall clock, joint by joint, against the simulated truth.

    python benchmarks/serial_pty.py                    six joints, streamed at 921600 baud (4 min)
    python benchmarks/serial_pty.py --batch 1          joint 1 as jobs at 19200 baud (2 min)
    python benchmarks/serial_pty.py --averaging 150 3  a controller that averages its command: must end with exit code 5
    python benchmarks/serial_pty.py --virtual          the same in virtual time (15 s of processor)

Every joint meets an emulated controller of its own, in a process of its own unless time is virtual. Percentages are e
of (15) over [V_1, V_N].
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from frictid_drivers.motoman import MotomanDriver
from frictid_drivers.motoman.emulator.build import build
from frictid_drivers.motoman.emulator.loopback import LoopbackPort
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.compare import compare
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.runs import run as run_module

LIMIT_PERCENT = 2.5
TOOL = "frictid-hil"


def robot_file(folder: Path, *, batch: bool, averaging_ms: int) -> Path:
    """The shipped serial robot with this controller behind its port."""
    lines = ["schema: frictid.robot/1", "extends: hp3j-serial.yaml", "name: hp3j-bench", "bus: serial:none", "options:"]
    lines += ["  layer: batch", "  stream_baud: 0"] if batch else ["  layer: stream"]
    lines += ["  emulator:", f"    averaging_ms: {averaging_ms}"]
    path = folder / "hp3j-bench.yaml"
    path.write_text("\n".join(lines) + "\n")
    return path


def tool(*arguments: str) -> tuple[int, dict[str, Any]]:
    """Exit code and JSON of one call."""
    done = subprocess.run([TOOL, *arguments, "--json"], capture_output=True, text=True, check=False)
    return done.returncode, json.loads(done.stdout)


def measure(robot: Path, joint: str, out: Path) -> bool:
    """One joint; prints a line, and whether it is within the bar."""
    command = [TOOL, "emulate", "motoman", "--pty", "--robot", str(robot)]
    emulator = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert emulator.stdout is not None
    try:
        port = emulator.stdout.readline().split()[-1]
        code, result = tool(
            *("calibrate", "--robot", str(robot), "--bus", f"serial:{port}"),
            *("--joint", joint, "--yes", "--out", str(out)),
        )
    finally:
        emulator.terminate()
        _, told = emulator.communicate(timeout=10)
    entry = result.get("joints", {}).get(joint, {})
    _, compared = tool("compare", str(out), "--truth", str(robot))
    percent = compared.get("joints", {}).get(joint, {}).get("e_percent_measured_range")
    error = (result.get("error") or {}).get("what", "")
    said = "; ".join([text for text in (error, *entry.get("remarks", []), told.partition("\n")[0]) if text])
    shown = "-" if percent is None else f"{percent:.2f} %"
    print(
        f"joint {joint}: exit {code}, {shown}, {entry.get('duration_s') or 0:.1f} s, "
        f"late {entry.get('late_cycles')}, missed {entry.get('missed_cycles')} {said}",
        flush=True,
    )
    return code == 0 and percent is not None and percent <= LIMIT_PERCENT


def measure_in_virtual_time(robot: Path, joint: str, out: Path) -> bool:
    """The same with controller and tool in this process."""

    def driver(setup: RobotSetup) -> MotomanDriver:
        emulator = build(setup)
        return MotomanDriver(setup, port_factory=lambda path, baud, parity: LoopbackPort(emulator, baud, parity))

    module: Any = run_module
    module.new_driver = lambda name, setup: driver(setup)
    result = calibrate(CalibrateOptions(str(robot), out=out, joints=(joint,)), Silent()).to_json()
    entry = result["joints"][joint]
    percent = compare(out, None, str(robot))["joints"].get(joint, {}).get("e_percent_measured_range")
    shown = "-" if percent is None else f"{percent:.2f} %"
    said = "; ".join(entry["remarks"])
    print(f"joint {joint}: exit {result['exit_code']}, {shown}, {entry['duration_s']:.1f} s {said}", flush=True)
    return result["exit_code"] == 0 and percent is not None and bool(percent <= LIMIT_PERCENT)


def main() -> int:
    """0 when every joint is within the bar."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("joints", nargs="*", default=list("012345"))
    parser.add_argument("--batch", action="store_true")
    parser.add_argument("--virtual", action="store_true")
    parser.add_argument("--averaging", type=int, default=0, metavar="MS")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        robot = robot_file(Path(folder), batch=asked.batch, averaging_ms=asked.averaging)
        # Every run is this robot's first: it rehearses.
        os.environ["XDG_STATE_HOME"] = folder
        one = measure_in_virtual_time if asked.virtual else measure
        within = [one(robot, joint, Path(folder) / f"run-{k}-{joint}") for k, joint in enumerate(asked.joints)]
    return 0 if all(within) else 1


if __name__ == "__main__":
    sys.exit(main())
