"""Calibrate drives of ten families whose CANopen is another author's (`durand`), over UDP multicast, in two processes.

    python benchmarks/strangers.py                 all families (4 min)
    python benchmarks/strangers.py elmo nanotec    these

Every family: `check` has no error, configuring meets nothing that `check` did not say, and F_0 is within 1 % of the
simulated joint's. The wire is the loopback interface, the clock the wall's: a machine that is busy with other things
loses reports, and the run ends as it would on a bad bus.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from frictid_drivers.cia402 import Cia402Driver
from frictid_drivers.virtual.personality import known_personalities
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import FrictidError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.check import check
from frictid_hil.jobs.watch import Silent
from frictid_hil.protocol.driver import Severity
from frictid_hil.runner.events import Event, Warned

COULOMB_NM = 5.0
LIMIT_PERCENT = 1.0
RATES_HZ = {"prbt": 125}
NEEDS: dict[str, dict[str, Any]] = {
    "epos4": {"position_units_per_revolution": 131_072 * 100},
    "nanotec": {"raise_torque_limit": True},
}


def robot_file(folder: Path, family: str) -> Path:
    """One joint, on a multicast group and a port of this process's own."""
    joint = {
        "node": 3, "gear_ratio": 100, "max_velocity_rad_s": 3.0, "max_torque_nm": 60.0, "rated_torque_nm": 40.0,
        "position_min_rad": -2.0, "position_max_rad": 2.0, "start_position_rad": 0.0, "locked_position_rad": 0.0,
        "options": NEEDS.get(family, {}),
        "simulated": {"inertia_kg_m2": 0.3, "friction": {"coulomb_nm": COULOMB_NM, "viscous_nm_s_per_rad": 1.5}},
    }  # fmt: skip
    values = {
        "schema": "frictid.robot/1", "name": family, "driver": "cia402",
        "bus": f"udp_multicast:239.74.{os.getpid() >> 8 & 0xFF}.{os.getpid() & 0xFF}",
        "cycle_hz": RATES_HZ.get(family, 100), "care": {"silence_s": 0.2},
        "options": {"allow_torque_without_watchdog": True, "port": 20_000 + os.getpid() % 20_000},
        "procedure": {"amplitude_rad": 0.2, "velocity_rad_s": 0.6, "cycles": 4, "ratio": 0.8},
        "joints": {"0": joint},
    }  # fmt: skip
    path = folder / f"{family}.yaml"
    path.write_text(yaml.safe_dump(values, sort_keys=False))
    return path


@contextlib.contextmanager
def stranger(robot: Path, family: str) -> Iterator[None]:
    """The node in a process of its own."""
    script = Path(__file__).with_name("stranger_node.py")
    node = subprocess.Popen([sys.executable, str(script), str(robot), family], stdout=subprocess.PIPE, text=True)
    try:
        assert node.stdout is not None and node.stdout.readline() == "ready\n", "the node did not start"
        yield
    finally:
        node.kill()
        node.wait()


@dataclass(frozen=True, slots=True)
class Met:
    """What `check` says of a drive, and what configuring it meets."""

    errors: set[str]
    warnings: set[str]
    remarks: set[str]
    ended: str


def configured(folder: Path, family: str) -> Met:
    """`check`, then everything that is written to a drive before it moves."""
    robot = robot_file(folder, family)
    loaded = load_robot(robot)
    with stranger(robot, family), contextlib.closing(Cia402Driver(loaded.to_setup())) as driver:
        driver.open()
        findings = driver.check(None)
        ended = ""
        try:
            driver.configure(loaded.file.cycle_hz, ["0"])
            driver.set_limits("0", torque_nm=60.0, position_min_rad=-2.0, position_max_rad=2.0)
        except FrictidError as error:
            ended = str(error)
        remarks = {one.message for one in driver.remarks()}
    return Met(
        {one.message for one in findings if one.severity is Severity.ERROR},
        {one.message for one in findings if one.severity is Severity.WARNING},
        remarks,
        ended,
    )


def calibrated(folder: Path, family: str) -> dict[str, Any]:
    """The JSON of `check` and of `calibrate` for one family, and the warnings that were new to the second."""
    robot = robot_file(folder, family)
    told = Told()
    with stranger(robot, family):
        checked = check(str(robot))
        result = calibrate(CalibrateOptions(str(robot), out=folder / f"{family} run"), told).to_json()
    foreseen = {finding["message"] for finding in checked["findings"]}
    return {"check": checked, "calibrate": result, "surprises": [one for one in told.notes if not _said(one, foreseen)]}


class Told(Silent):
    """Keeps what the run remarks."""

    def __init__(self) -> None:
        self.notes: list[str] = []

    def event(self, event: Event) -> None:
        """Warnings of the run."""
        if isinstance(event, Warned):
            self.notes.append(event.message)


def _said(note: str, foreseen: set[str]) -> bool:
    return any(message in note for message in foreseen)


def main(families: Sequence[str]) -> int:
    """Print a line per family; 1 where one fails."""
    os.environ.setdefault("XDG_STATE_HOME", tempfile.mkdtemp())
    failed = 0
    print(f"{'family':12} {'check':6} {'outcome':12} {'F_0 N m':>8} {'off %':>6} {'late':>5} surprises")
    for family in families or sorted(known_personalities()):
        with tempfile.TemporaryDirectory() as folder:
            found = calibrated(Path(folder), family)
        entry = found["calibrate"].get("joints", {}).get("0", {})
        coulomb_nm = entry.get("coulomb_nm") or float("nan")
        off_percent = 100 * (coulomb_nm / COULOMB_NM - 1)
        good = found["check"]["ok"] and not found["surprises"] and abs(off_percent) <= LIMIT_PERCENT
        failed += not (good and found["calibrate"]["outcome"] == "ok")
        print(
            f"{family:12} {'ok' if found['check']['ok'] else 'ERROR':6} {found['calibrate']['outcome']:12} "
            f"{coulomb_nm:8.3f} {off_percent:6.2f} {entry.get('late_cycles', 0):5} {found['surprises']}"
            f"{found['calibrate'].get('error', '')}",
            flush=True,
        )
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
