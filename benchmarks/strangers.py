"""Calibrate drives of ten families whose CANopen is another author's, over a wire between processes.

    python benchmarks/strangers.py                 all families (2 min), by `durand` on UDP multicast
    python benchmarks/strangers.py elmo nanotec    these
    python benchmarks/strangers.py --gateway       the same on socketcand, behind a gateway on TCP
    python benchmarks/strangers.py --npm           the same by the npm package `canopen`, on slcan (needs node and npm)

Every family: `check` has no error, configuring meets nothing that `check` did not say, F_0 is within 1 % of the
simulated joint's, and tshark finds no malformed frame in the recording (left out where it is not installed). Each frame
is answered before the next one is sent (``stranger_wire``), so a loaded machine changes no figure.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from socketcand_gateway import CHANNEL
from stranger_wire import StrangerDriver

from frictid_drivers.virtual.personality import known_personalities
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import FrictidError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.check import check
from frictid_hil.jobs.watch import Silent
from frictid_hil.protocol.driver import Severity
from frictid_hil.runner.events import Event, Warned

DRIVER = "stranger"
COULOMB_NM = 5.0
LIMIT_PERCENT = 1.0
RATES_HZ = {"prbt": 125}
NEEDS: dict[str, dict[str, Any]] = {
    "epos4": {"position_units_per_revolution": 131_072 * 100},
    "nanotec": {"raise_torque_limit": True},
}


@dataclass(frozen=True, slots=True)
class Stack:
    """Another author's CANopen, and the wire to it.

    Attributes:
        script: plays the node.
        arguments: of the script, after robot file and family.
        usual_hz: cycle rate, where a family has no own.
        gateway: the bus is behind a gateway on TCP, as `socketcand` serves it.
        link: name of a SocketCAN link; "" elsewhere.
    """

    script: str
    arguments: tuple[str, ...] = ()
    usual_hz: int = 500
    gateway: bool = False
    link: str = ""

    def wire(self, folder: Path, family: str) -> tuple[str, dict[str, Any]]:
        """Bus and options of a robot file, of this process's own."""
        if self.arguments:
            return f"slcan:{folder / family}.tty", {"sleep_after_open": 0}
        if self.link:
            return f"socketcan:{self.link}", {}
        port = 20_000 + os.getpid() % 20_000
        if self.gateway:
            return f"socketcand:{CHANNEL}", {"host": "127.0.0.1", "port": port, "tcp_tune": True}
        group = f"udp_multicast:239.74.{os.getpid() >> 8 & 0xFF}.{os.getpid() & 0xFF}"
        return group, {"port": port}


DURAND = Stack("stranger_node.py")
GATEWAY = Stack("stranger_node.py", gateway=True)
SOCKETCAN = Stack("stranger_node.py", usual_hz=250, link="vcan0")
PACKAGE = Path(__file__).with_name("npm_canopen")


def npm_canopen(folder: Path) -> Stack:
    """The npm package, installed into this folder by its own client.

    Raises:
        OSError: there is no node or no npm.
        subprocess.CalledProcessError: the package cannot be had.
    """
    subprocess.run(["node", "--version"], check=True, capture_output=True)
    shutil.copytree(PACKAGE, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("node_modules"))
    # Its native module is for block transfer alone, and not built.
    command = ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--prefer-offline", "--fetch-retries=0"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True, timeout=60)
    return Stack("slcan_hub.py", (str(folder),), usual_hz=250)


def robot_file(folder: Path, family: str, stack: Stack = DURAND) -> Path:
    """One joint, on a wire of this process's own."""
    bus, wire = stack.wire(folder, family)
    joint = {
        "node": 3, "gear_ratio": 100, "max_velocity_rad_s": 3.0, "max_torque_nm": 60.0, "rated_torque_nm": 40.0,
        "position_min_rad": -2.0, "position_max_rad": 2.0, "start_position_rad": 0.0, "locked_position_rad": 0.0,
        "options": NEEDS.get(family, {}),
        "simulated": {"inertia_kg_m2": 0.3, "friction": {"coulomb_nm": COULOMB_NM, "viscous_nm_s_per_rad": 1.5}},
    }  # fmt: skip
    values = {
        "schema": "frictid.robot/1", "name": family, "driver": DRIVER,
        "bus": bus,
        "cycle_hz": RATES_HZ.get(family, stack.usual_hz),
        "options": {"allow_torque_without_watchdog": True, **wire},
        "procedure": {"amplitude_rad": 0.2, "velocity_rad_s": 0.6, "cycles": 4, "ratio": 0.8},
        "joints": {"0": joint},
    }  # fmt: skip
    path = folder / f"{family}.yaml"
    path.write_text(yaml.safe_dump(values, sort_keys=False))
    return path


def register(folder: Path) -> None:
    """Make the driver known as any installed package does, from a folder that is on the path from now on."""
    info = folder / "stranger-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[frictid_hil.drivers]\n{DRIVER} = stranger_wire:StrangerDriver\n")
    sys.path.insert(0, str(folder))


@contextlib.contextmanager
def stranger(robot: Path, family: str, stack: Stack = DURAND) -> Iterator[None]:
    """The node in a process of its own."""
    script = Path(__file__).with_name(stack.script)
    node = subprocess.Popen(
        [sys.executable, str(script), str(robot), family, *stack.arguments],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        text=True,
    )
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
    with stranger(robot, family), contextlib.closing(StrangerDriver(loaded.to_setup())) as driver:
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


@dataclass(frozen=True, slots=True)
class Calibrated:
    """What became of one family.

    Attributes:
        check: the JSON of `check`.
        run: that of `calibrate`.
        surprises: warnings of the run that `check` did not give.
        log: the frames.
    """

    check: dict[str, Any]
    run: dict[str, Any]
    surprises: list[str]
    log: Path

    @property
    def off_percent(self) -> float:
        """How far F_0 is from the simulated joint's."""
        found = self.run.get("joints", {}).get("0", {}).get("coulomb_nm")
        return float("nan") if found is None else 100.0 * (found / COULOMB_NM - 1.0)

    @property
    def good(self) -> bool:
        """As promised."""
        fine = bool(self.check["ok"]) and self.run["outcome"] == "ok" and not self.surprises
        return fine and abs(self.off_percent) <= LIMIT_PERCENT


def calibrated(folder: Path, family: str, stack: Stack = DURAND) -> Calibrated:
    """`check` and `calibrate` of one family."""
    robot = robot_file(folder, family, stack)
    told, out = Told(), folder / f"{family} run"
    with stranger(robot, family, stack):
        checked = check(str(robot))
        result = calibrate(CalibrateOptions(str(robot), out=out), told).to_json()
    foreseen = {finding["message"] for finding in checked["findings"]}
    return Calibrated(checked, result, [one for one in told.notes if not _said(one, foreseen)], out / "bus.blf")


def dissected(log: Path) -> tuple[int, int] | None:
    """How many frames tshark reads, and how many of them are malformed or no CANopen; None without tshark."""
    if (tshark := shutil.which("tshark")) is None:
        return None
    fields = ["-T", "fields", "-e", "frame.protocols", "-e", "can.len"]
    command = [tshark, "-r", str(log), "-d", "can.subdissector,canopen", *fields]
    whole = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    # An empty SYNC has nothing to dissect.
    bad = [one for one in whole if "malformed" in one or ("canopen" not in one and not one.endswith("\t0"))]
    return len(whole), len(bad)


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


def main(arguments: Sequence[str]) -> int:
    """Print a line per family; 1 where one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("families", nargs="*", metavar="FAMILY", help=", ".join(sorted(known_personalities())))
    parser.add_argument("--npm", action="store_true", help="the npm package `canopen` instead of durand")
    parser.add_argument("--gateway", action="store_true", help="durand behind a gateway on TCP")
    wanted = parser.parse_args(arguments)
    os.environ.setdefault("XDG_STATE_HOME", tempfile.mkdtemp())
    failed = 0
    print(f"{'family':12} {'outcome':12} {'F_0 off %':>9} {'frames':>7} {'malformed':>9} surprises")
    with tempfile.TemporaryDirectory() as home:
        register(Path(home))
        stack = npm_canopen(Path(home) / "npm") if wanted.npm else GATEWAY if wanted.gateway else DURAND
        for family in wanted.families or sorted(known_personalities()):
            with tempfile.TemporaryDirectory() as folder:
                found = calibrated(Path(folder), family, stack)
                frames, bad = dissected(found.log) or ("-", "-")
            failed += not found.good or bad not in ("-", 0)
            outcome = found.run["outcome"] if found.check["ok"] else "check fails"
            error = found.run.get("error", "")
            print(f"{family:12} {outcome:12} {found.off_percent:9.2f} {frames:>7} {bad:>9} {found.surprises} {error}")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
