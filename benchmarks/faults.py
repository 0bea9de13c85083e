"""Every fault at every phase of every verb that moves, judged by the simulated drives' own state and withheld truth.

    python benchmarks/faults.py [--runs 2000] [--seed 1] [--only lag] [--verbs calibrate] [--kept FILE] [--docs PAGE]

Two joints, lock-step, one process, about a second a run. A clean run of each verb first tells when each phase is; then
faults strike, each at a moment and a cycle rate drawn by its seed. ``--runs`` draws so many from all, evenly over the
verbs; without it each fault strikes once in each phase. The host's word counts for nothing:

* **at rest, without power**: after the run, and a second in which nobody talks to them, the drives stand and have no
  power; they did so in time after the host's stop; and no joint ever left its limits or passed its highest speed;
* **everything kept**: every row that the loop recorded is in the run's recording, and it can be read; so can every
  profile that was in the store before;
* **no wrong curve called ok**: no joint with outcome ok, and no profile that was promoted, has a curve more than its
  interval and 2 % off the truth;
* and no defect of the program: every ending is one of our errors, with a next step.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import os
import re
import shutil
import signal
import tempfile
import time
import traceback
import zlib
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, partial
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from frictid_drivers.cia402 import Cia402Driver
from frictid_drivers.mit import MitDriver
from frictid_drivers.mit.simulated import Rack as Motors
from frictid_drivers.mit.simulated import VirtualMitDriver
from frictid_drivers.servos.driver import ServoDriver
from frictid_drivers.servos.simulated import Chain, VirtualServoDriver
from frictid_drivers.virtual import VirtualDriver
from frictid_drivers.virtual.faults import ENVIRONMENT
from frictid_hil.config.profile import FrictionProfile
from frictid_hil.config.provenance import git_revision
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import Defect, FrictidError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.check import check
from frictid_hil.jobs.compare import true_curve
from frictid_hil.jobs.compensate import CompensateOptions, compensate
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.jobs.gap_record import GapRecordOptions, record
from frictid_hil.jobs.recalibrate import RecalibrateOptions, recalibrate
from frictid_hil.jobs.reset import reset
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.experiments import plan_document
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.plan import Plan
from frictid_hil.plan.setup import JointSetup, RobotSetup
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.recording.mcap_reader import read_rows
from frictid_hil.runner.events import Event, PhaseStarted, Preflight
from frictid_hil.runner.ring import Ring, sample_ring
from frictid_hil.runs import run as run_module

Draw = Callable[[np.random.Generator], dict[str, Any]]

NAME = "faulty-bench"
JOINT, OTHER = "3", "4"


def _arm(*absent: str, **further: Any) -> dict[str, Any]:
    return {"extends": "hp3j.yaml", "joints": dict.fromkeys(absent), **further}


def _motors(model: str) -> dict[str, Any]:
    values = load_robot("mit-bench.yaml").values()
    (joint,) = values["joints"].values()
    options = {**joint["options"], "model": model}
    joints = {name: {**joint, "id": number, "options": options} for number, name in enumerate((JOINT, OTHER), 1)}
    return {**values, "joints": joints}


def _servos(model: str, *names: str) -> dict[str, Any]:
    values = load_robot("so101.yaml").values()
    joint = values["joints"]["shoulder_pan"]
    joint["options"] = {"model": model}
    joints = {name: {**joint, "id": number} for number, name in enumerate(names, 1)}
    procedure = values["procedure"] | {"cycles": 3}
    return {**values, "joints": joints, "procedure": procedure, "policy": {"warm_up": {"fixed_s": 0}}}


ROBOTS: dict[str, Callable[[], dict[str, Any]]] = {
    "two joints": lambda: _arm("0", "1", "2", "5"),
    "one joint": lambda: _arm("0", "1", "2", "4", "5", procedure={"cycles": 3}, policy={"warm_up": {"fixed_s": 0}}),
    "damiao": lambda: _motors("DM-J4310"),
    "robstride": lambda: _motors("RS00"),
    "dynamixel": lambda: _servos("XL330-M288", JOINT, OTHER),
    "one dynamixel": lambda: _servos("XL330-M288", JOINT),
    "feetech": lambda: _servos("STS3215", JOINT, OTHER),
}
VERBS = {
    "calibrate": "two joints",
    "together": "two joints",
    "compensate": "two joints",
    "recalibrate": "one joint",
    "gap record": "one joint",
    "check": "two joints",
    "reset": "two joints",
    "damiao calibrate": "damiao",
    "damiao compensate": "damiao",
    "robstride calibrate": "robstride",
    "robstride together": "robstride",
    "dynamixel calibrate": "dynamixel",
    "dynamixel compensate": "dynamixel",
    "dynamixel recalibrate": "one dynamixel",
    "feetech calibrate": "feetech",
    "feetech compensate": "feetech",
}
"""What is run, and on which robot. Unattended runs refuse Feetech servos, which have no watchdog."""
SERVOS = ("dynamixel", "one dynamixel", "feetech")
STILL = ("check", "reset")
"""Verbs without power."""
RATES_HZ = (250.0, 250.0, 250.0, 250.0, 500.0, 500.0, 1000.0)
"""Drawn from: most runs are slow, and therefore cheap."""
SERVO_RATES_HZ = (200.0,)
"""Servos are to be kept to it (docs/guides/servos.md)."""
REST_S, OFF_S, OFF_RAD_S = 0.5, 2.6, 0.02
"""Longest from the host's stop to rest and to the end of power (docs/reference/stops.md), and what counts as rest."""
SERVO_OFF_S = 2.32
"""That of two servos: 2 s, 60 ms for each that is silent, and 200 ms of their watchdog (as above)."""
SILENT_S, LOOK_S = 1.0, 0.005
"""Nobody talks to the drives for so long: their own watchdogs have had their say. They are looked at so often."""
STANDS_S = 0.02
"""Who stands has gone no way within this time: a loop that holds a joint at an edge of its encoder has a speed, but the
joint goes nowhere."""
MARGIN = 0.02
BEFORE_SYNC = ("preflight", "configure")
HANGS_S = 120
"""Of processor time, and ten times as long on the clock of a computer that others use as well."""


def _node(rng: np.random.Generator) -> str:
    return str(rng.choice([JOINT, JOINT, OTHER]))


def _of_joint(**row: Any) -> Draw:
    return lambda rng: {**row, "joint": JOINT}


def _of_either(**row: Any) -> Draw:
    return lambda rng: {**row, "joint": _node(rng)}


def _of_bus(**row: Any) -> Draw:
    return lambda rng: dict(row)


WRONG_REPORTS: dict[str, Draw] = {
    "torque late 6 ms": _of_joint(kind="lag", quantity="torque", delay_s=0.006),
    "torque late 20 ms": _of_joint(kind="lag", quantity="torque", delay_s=0.02),
    "torque late 60 ms": _of_joint(kind="lag", quantity="torque", delay_s=0.06),
    "position late 10 ms": _of_joint(kind="lag", quantity="position", delay_s=0.01),
    "torque clipped 9 N m": _of_joint(kind="clip", quantity="torque", level=300),
    "torque clipped 6 N m": _of_joint(kind="clip", quantity="torque", level=200),
    "torque times 1.5": _of_joint(kind="scale", quantity="torque", factor=1.5),
    "torque times 0.7": _of_joint(kind="scale", quantity="torque", factor=0.7),
    "torque frozen": _of_joint(kind="freeze", quantity="torque"),
    "torque inverted": _of_joint(kind="invert", quantity="torque"),
    "torque zero": _of_joint(kind="scale", quantity="torque", factor=0.0),
    "torque offset": _of_joint(kind="jump", quantity="torque", level=120),
    "velocity frozen": _of_joint(kind="freeze", quantity="velocity"),
    "velocity inverted": _of_joint(kind="invert", quantity="velocity"),
    "velocity zero": _of_joint(kind="scale", quantity="velocity", factor=0.0),
    "position frozen": _of_either(kind="freeze", quantity="position"),
    "position jumps a turn": _of_either(kind="jump", quantity="position", level=131072),
    "position jumps for 3 ms": _of_either(kind="jump", quantity="position", level=131072, for_s=0.003),
    "position inverted": _of_either(kind="invert", quantity="position"),
    "position scaled 1.1": _of_joint(kind="scale", quantity="position", factor=1.1),
    "statusword flaps": _of_either(kind="flap"),
}
FRAMES: dict[str, Draw] = {
    "reports lost 1": _of_either(kind="drop", frames="tpdo1", count=1),
    "reports lost 100": _of_either(kind="drop", frames="tpdo1", count=100),
    "commands lost 100": _of_either(kind="drop", frames="rpdo1", count=100),
    "every command lost": _of_either(kind="drop", frames="rpdo1"),
    "SYNC lost 1": _of_bus(kind="drop", frames="sync", count=1),
    "SYNC lost 100": _of_bus(kind="drop", frames="sync", count=100),
    "reports late 2.5 ms": _of_joint(kind="delay", frames="tpdo1", delay_s=0.0025),
    "reports late 5 ms": _of_joint(kind="delay", frames="tpdo1", delay_s=0.005),
    "commands late 20 ms": _of_joint(kind="delay", frames="rpdo1", delay_s=0.02),
    "reports twice": _of_either(kind="duplicate", frames="tpdo1"),
    "reports reordered": _of_joint(kind="reorder", frames="tpdo1", count=50),
    "reports corrupt 1": _of_joint(kind="corrupt", frames="tpdo1", count=1),
    "reports corrupt 20": _of_joint(kind="corrupt", frames="tpdo1", count=20),
    "commands corrupt 1": _of_joint(kind="corrupt", frames="rpdo1", count=1),
    "reports cut short": _of_either(kind="truncate", frames="tpdo1", level=3, count=20),
    "reports of a wrong node": _of_either(kind="misaddress", frames="tpdo1", count=20),
    "foreign commands": _of_either(kind="foreign", frames="rpdo1"),
    "foreign reports": _of_joint(kind="foreign", frames="tpdo1"),
    "heartbeat lost": _of_either(kind="drop", frames="heartbeat"),
    "host heartbeat lost": _of_bus(kind="drop", frames="host_heartbeat"),
}
DRIVES: dict[str, Draw] = {
    "node silent": _of_either(kind="mute"),
    "node silent 50 ms": _of_either(kind="mute", for_s=0.05),
    "node reboots": _of_either(kind="reset"),
    "drive faults": _of_either(kind="fault", code=0x7305),
    "EMCY storm": _of_either(kind="emcy", code=0x4210, count=500),
    "brake stays closed": _of_joint(kind="blocked"),
    "encoder stands": _of_joint(kind="stuck_encoder"),
    "interlock input": _of_either(kind="interlock_open"),
}
INTERFACE: dict[str, Draw] = {
    f"{way} {error}{times}": _of_bus(kind=f"{way}_error", error=error, **count)
    for way in ("send", "receive")
    for error in ("can", "os", "runtime", "value")
    for times, count in ((" once", {"count": 1}), ("", {}))
} | {"bus off": _of_bus(kind="bus_off")}
SDO: dict[str, Draw] = {
    "SDO refused": _of_either(kind="abort", count=1),
    "every SDO refused": _of_either(kind="abort"),
    "SDO answer lost": _of_either(kind="drop", frames="sdo", count=1),
    "SDO answer short": _of_either(kind="truncate", frames="sdo", level=3, count=1),
    "SDO answer corrupt": _of_either(kind="corrupt", frames="sdo", count=1),
    "SDO of a wrong node": _of_either(kind="misaddress", frames="sdo", count=1),
    "SDO answered twice": _of_either(kind="duplicate", frames="sdo", count=3),
    "node silent in set-up": _of_either(kind="drop", frames="sdo"),
    "interface fails in set-up": _of_bus(kind="send_error", error="os"),
    "interface deaf in set-up": _of_bus(kind="receive_error", error="runtime"),
}
MOTORS: dict[str, Draw] = {
    "torque late 6 ms": _of_joint(kind="lag", quantity="torque", delay_s=0.006),
    "torque late 20 ms": _of_joint(kind="lag", quantity="torque", delay_s=0.02),
    "torque late 60 ms": _of_joint(kind="lag", quantity="torque", delay_s=0.06),
    "position late 10 ms": _of_joint(kind="lag", quantity="position", delay_s=0.01),
    "torque clipped 0.3 N m": _of_joint(kind="clip", quantity="torque", level=0.3),
    "torque times 1.5": _of_joint(kind="scale", quantity="torque", factor=1.5),
    "torque times 0.7": _of_joint(kind="scale", quantity="torque", factor=0.7),
    "torque frozen": _of_joint(kind="freeze", quantity="torque"),
    "torque inverted": _of_joint(kind="invert", quantity="torque"),
    "torque zero": _of_joint(kind="scale", quantity="torque", factor=0.0),
    "torque offset": _of_joint(kind="jump", quantity="torque", level=0.5),
    "velocity frozen": _of_joint(kind="freeze", quantity="velocity"),
    "velocity inverted": _of_joint(kind="invert", quantity="velocity"),
    "velocity zero": _of_joint(kind="scale", quantity="velocity", factor=0.0),
    "position frozen": _of_either(kind="freeze", quantity="position"),
    "position jumps": _of_either(kind="jump", quantity="position", level=0.6),
    "position jumps for 3 ms": _of_either(kind="jump", quantity="position", level=0.6, for_s=0.003),
    "position inverted": _of_either(kind="invert", quantity="position"),
    "position scaled 1.1": _of_joint(kind="scale", quantity="position", factor=1.1),
    "reports lost 1": _of_either(kind="drop", frames="report", count=1),
    "reports lost 100": _of_either(kind="drop", frames="report", count=100),
    "commands lost 100": _of_either(kind="drop", frames="command", count=100),
    "every command lost": _of_either(kind="drop", frames="command"),
    "reports late 5 ms": _of_joint(kind="delay", frames="report", delay_s=0.005),
    "commands late 20 ms": _of_joint(kind="delay", frames="command", delay_s=0.02),
    "reports twice": _of_either(kind="duplicate", frames="report"),
    "reports reordered": _of_joint(kind="reorder", frames="report", count=50),
    "reports corrupt 1": _of_joint(kind="corrupt", frames="report", count=1),
    "reports corrupt 20": _of_joint(kind="corrupt", frames="report", count=20),
    "commands corrupt 1": _of_joint(kind="corrupt", frames="command", count=1),
    "reports cut short": _of_either(kind="truncate", frames="report", level=3, count=20),
    "reports of a wrong node": _of_either(kind="misaddress", frames="report", count=20),
    "foreign commands": _of_either(kind="foreign", frames="command"),
    "foreign reports": _of_joint(kind="foreign", frames="report"),
    "node silent": _of_either(kind="mute"),
    "node silent 50 ms": _of_either(kind="mute", for_s=0.05),
    "node reboots": _of_either(kind="reset"),
    "drive faults": _of_either(kind="fault"),
    "brake stays closed": _of_joint(kind="blocked"),
} | INTERFACE
SERVO_LINE: dict[str, Draw] = {
    "torque late 20 ms": _of_joint(kind="lag", quantity="torque", delay_s=0.02),
    "torque late 60 ms": _of_joint(kind="lag", quantity="torque", delay_s=0.06),
    "position late 20 ms": _of_joint(kind="lag", quantity="position", delay_s=0.02),
    "torque clipped 0.3 N m": _of_joint(kind="clip", quantity="torque", level=0.3),
    "torque times 1.5": _of_joint(kind="scale", quantity="torque", factor=1.5),
    "torque times 0.7": _of_joint(kind="scale", quantity="torque", factor=0.7),
    "torque frozen": _of_joint(kind="freeze", quantity="torque"),
    "torque inverted": _of_joint(kind="invert", quantity="torque"),
    "torque zero": _of_joint(kind="scale", quantity="torque", factor=0.0),
    "torque offset": _of_joint(kind="jump", quantity="torque", level=0.2),
    "position frozen": _of_either(kind="freeze", quantity="position"),
    "position jumps": _of_either(kind="jump", quantity="position", level=0.6),
    "position jumps for 10 ms": _of_either(kind="jump", quantity="position", level=0.6, for_s=0.01),
    "position inverted": _of_either(kind="invert", quantity="position"),
    "position scaled 1.1": _of_joint(kind="scale", quantity="position", factor=1.1),
    "reports lost 1": _of_either(kind="drop", frames="report", count=1),
    "reports lost 100": _of_either(kind="drop", frames="report", count=100),
    "every report lost": _of_either(kind="drop", frames="report"),
    "writes lost 1": _of_bus(kind="drop", frames="write", count=1),
    "writes lost 100": _of_bus(kind="drop", frames="write", count=100),
    "every write lost": _of_bus(kind="drop", frames="write"),
    "requests lost 1": _of_bus(kind="drop", frames="request", count=1),
    "requests lost 100": _of_bus(kind="drop", frames="request", count=100),
    "reports late 2 ms": _of_joint(kind="delay", frames="report", delay_s=0.002),
    "reports late 12 ms": _of_joint(kind="delay", frames="report", delay_s=0.012),
    "writes late 20 ms": _of_bus(kind="delay", frames="write", delay_s=0.02),
    "reports twice": _of_either(kind="duplicate", frames="report"),
    "writes twice": _of_bus(kind="duplicate", frames="write"),
    "reports reordered": _of_joint(kind="reorder", frames="report", count=50),
    "reports damaged 1": _of_joint(kind="corrupt", frames="report", count=1),
    "reports damaged 20": _of_joint(kind="corrupt", frames="report", count=20),
    "writes damaged 1": _of_bus(kind="corrupt", frames="write", count=1),
    "writes damaged 20": _of_bus(kind="corrupt", frames="write", count=20),
    "reports cut short": _of_either(kind="truncate", frames="report", level=5, count=20),
    "a wrong id answers": _of_either(kind="misaddress", frames="report", count=20),
    "foreign writes": _of_bus(kind="foreign", frames="write"),
    "foreign requests": _of_bus(kind="foreign", frames="request"),
    "foreign reports": _of_joint(kind="foreign", frames="report"),
    "servo silent": _of_either(kind="mute"),
    "servo silent 50 ms": _of_either(kind="mute", for_s=0.05),
    "servo reboots": _of_either(kind="reset"),
    "error byte": _of_either(kind="fault"),
    "joint blocked": _of_joint(kind="blocked"),
    "host stalls 50 ms": _of_bus(kind="stall", delay_s=0.05),
    "host stalls 400 ms": _of_bus(kind="stall", delay_s=0.4),
} | {
    f"{way} {error}{times}": _of_bus(kind=f"{way}_error", error=error, **count)
    for way in ("send", "receive")
    for error in ("can", "os", "runtime", "value")
    for times, count in ((" once", {"count": 1}), ("", {}))
}
SERVO_SET_UP: dict[str, Draw] = {
    "answer lost": _of_either(kind="drop", frames="report", count=1),
    "every answer lost": _of_either(kind="drop", frames="report"),
    "answer cut short": _of_either(kind="truncate", frames="report", level=5, count=1),
    "answer damaged": _of_either(kind="corrupt", frames="report", count=1),
    "a wrong id answers": _of_either(kind="misaddress", frames="report", count=1),
    "answered twice": _of_either(kind="duplicate", frames="report", count=3),
    "answer late": _of_either(kind="delay", frames="report", delay_s=0.03, count=1),
    "request lost": _of_bus(kind="drop", frames="request", count=1),
    "request damaged": _of_bus(kind="corrupt", frames="request", count=1),
    "write lost": _of_bus(kind="drop", frames="write", count=1),
    "port fails in set-up": _of_bus(kind="send_error", error="os"),
    "port deaf in set-up": _of_bus(kind="receive_error", error="runtime"),
}
OUT_OF_REACH = ("every write lost", "servo silent", "send can", "send os", "send runtime", "send value")
"""Nothing that the host says arrives any more. A servo without a watchdog then holds its last goal, under power."""
MOTORS_SET_UP: dict[str, Draw] = {
    "answer lost": _of_either(kind="drop", frames="report", count=1),
    "every answer lost": _of_either(kind="drop", frames="report"),
    "answer short": _of_either(kind="truncate", frames="report", level=3, count=1),
    "answer corrupt": _of_either(kind="corrupt", frames="report", count=1),
    "answer of a wrong node": _of_either(kind="misaddress", frames="report", count=1),
    "answered twice": _of_either(kind="duplicate", frames="report", count=3),
    "request lost": _of_either(kind="drop", frames="command", count=1),
    "interface fails in set-up": _of_bus(kind="send_error", error="os"),
    "interface deaf in set-up": _of_bus(kind="receive_error", error="runtime"),
}
IN_MOTION = WRONG_REPORTS | FRAMES | DRIVES | INTERFACE
WHOLE_RUN = ("torque times 1.5", "torque times 0.7", "torque offset", "position scaled 1.1")
"""From the beginning these are another robot, not a fault: no host can tell. They strike later only."""


def faults_of(verb: str, phase: str) -> Mapping[str, Draw]:
    """What can go wrong in a phase of a verb."""
    if VERBS[verb] in SERVOS:
        return SERVO_SET_UP if phase in BEFORE_SYNC else SERVO_LINE
    if VERBS[verb] in ("damiao", "robstride"):
        return MOTORS_SET_UP if phase in BEFORE_SYNC else MOTORS
    return SDO if phase in BEFORE_SYNC else IN_MOTION


@dataclass(frozen=True)
class Case:
    """One injection."""

    verb: str
    phase: str
    name: str
    seed: int

    def drawn(self) -> np.random.Generator:
        """The dice of this injection."""
        return np.random.default_rng(zlib.crc32(f"{self.verb}/{self.phase}/{self.name}/{self.seed}".encode()))

    @property
    def rate_hz(self) -> float:
        """Of the cycles, drawn."""
        return float(self.drawn().choice(SERVO_RATES_HZ if VERBS[self.verb] in SERVOS else RATES_HZ))

    def row(self, phases: Mapping[str, Phase]) -> dict[str, Any]:
        """The fault as a robot file would list it."""
        rng = self.drawn()
        row = faults_of(self.verb, self.phase)[self.name](rng)
        if "joint" in row and VERBS[self.verb].startswith("one "):
            row["joint"] = JOINT
        phase = phases[self.phase]
        if self.phase not in BEFORE_SYNC:
            return {**row, "at_s": round(float(rng.uniform(phase.start_s, phase.end_s)), 4)}
        share = 0.5 if "joint" in row else 1.0  # half of the answers are of either joint
        after = int(rng.integers(round(phase.first_sdo * share), max(1, round(phase.last_sdo * share) - 1)))
        return {**row, "after": after}


@dataclass
class Phase:
    """When a phase is in a clean run: after the first SYNC, and by SDO answers."""

    start_s: float
    end_s: float = 0.0
    first_sdo: int = 0
    last_sdo: int = 0


@dataclass
class Verdict:
    """What became of one run."""

    verb: str
    phase: str
    name: str
    seed: int
    ended: str = ""
    exit_code: int = 0
    said: str = ""
    noticed: bool = False
    rest_s: float = 0.0
    off_s: float = 0.0
    off_percent: float = 0.0
    failures: list[str] = field(default_factory=list)
    took_s: float = 0.0


@dataclass(frozen=True)
class Axle:
    """A simulated joint as it really is."""

    name: str
    powered: Callable[[], bool]
    position_rad: Callable[[], float]
    velocity_rad_s: Callable[[], float]
    within_rad: tuple[float, float]
    fastest_rad_s: float
    watchdog: bool = True


def _axle(joint: JointSetup, powered: Callable[[], bool], plant: Any, *, watchdog: bool = True) -> Axle:
    return Axle(
        joint.name,
        powered,
        lambda: float(plant.position_rad),
        lambda: float(plant.true_velocity_rad_s),
        (joint.position_min_rad, joint.position_max_rad),
        joint.max_velocity_rad_s,
        watchdog,
    )


class Watched(Silent):
    """Follows a run from behind: the drives' own state at every step of their time, and the phases."""

    def __init__(self) -> None:
        self.rack: Any = None
        self.now: Callable[[], int] = lambda: 0
        self.axles: list[Axle] = []
        self.rings: list[Ring] = []
        self.phases: dict[str, Phase] = {}
        self.stop_ns: int | None = None
        self.moved_ns = 0
        self.powered_ns: dict[str, int] = {}  # by joint, when it had power last
        self.origin_ns: int | None = None
        self.answers = 0
        self.beyond: dict[str, str] = {}
        self._places: dict[str, deque[tuple[int, float]]] = {}  # by joint, of the last STANDS_S under power
        self._phase = "preflight"
        self.phases["preflight"] = Phase(0.0)

    def event(self, event: Event) -> None:
        """Note when phases begin."""
        if isinstance(event, PhaseStarted):
            self._begin(event.phase)

    def confirm(self, plan: Plan, preflight: Preflight) -> bool:
        """Yes."""
        return True

    def _begin(self, name: str) -> None:
        now_ns = self.now()
        if self.origin_ns is None and name != "configure":
            self.origin_ns = now_ns
        now_s = (now_ns - (now_ns if self.origin_ns is None else self.origin_ns)) * 1e-9
        last = self.phases[self._phase]
        last.end_s, last.last_sdo = now_s, self.answers
        self._phase = name if name not in self.phases else f"{name} again"
        self.phases[self._phase] = Phase(now_s, now_s, self.answers, self.answers)

    def finish(self) -> None:
        """The last phase ends."""
        self._begin("end")

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Hooks where the drives' time goes on, where rows are kept, and where the host stops."""
        opened, stopped = VirtualDriver.open, Cia402Driver.quick_stop
        made, braked, advance, receive = VirtualMitDriver.__init__, MitDriver.quick_stop, Motors.advance, Motors.receive
        built, held, passed, said = VirtualServoDriver.__init__, ServoDriver.quick_stop, Chain.advance, Chain._say

        def open_(driver: VirtualDriver, sink: Any = None) -> None:
            self._follow_can(driver)
            opened(driver, sink)

        def stop(driver: Cia402Driver) -> None:
            self._stopped()
            stopped(driver)

        def make(driver: VirtualMitDriver, setup: RobotSetup) -> None:
            made(driver, setup)
            self._follow_motors(driver)

        def brake(driver: MitDriver) -> None:
            self._stopped()
            braked(driver)

        def advanced(rack: Motors, to_ns: int) -> None:
            advance(rack, to_ns)
            self._advanced()

        def received(rack: Motors, can_id: int, data: bytes) -> Any:
            self.answers += 1
            return receive(rack, can_id, data)

        def build(driver: VirtualServoDriver, setup: RobotSetup) -> None:
            built(driver, setup)
            self._follow_servos(driver)

        def hold(driver: ServoDriver) -> None:
            self._stopped()
            held(driver)

        def went_on(chain: Chain, to_ns: int) -> None:
            passed(chain, to_ns)
            self._advanced()

        def say(chain: Chain, *answer: Any) -> None:
            self.answers += 1
            said(chain, *answer)

        def ring(**how: Any) -> Ring:
            self.rings.append(sample_ring(**how))
            return self.rings[-1]

        vars_: list[tuple[Any, str, Any]] = [
            (VirtualDriver, "open", open_),
            (Cia402Driver, "quick_stop", stop),
            (VirtualMitDriver, "__init__", make),
            (MitDriver, "quick_stop", brake),
            (Motors, "advance", advanced),
            (Motors, "receive", received),
            (VirtualServoDriver, "__init__", build),
            (ServoDriver, "quick_stop", hold),
            (Chain, "advance", went_on),
            (Chain, "_say", say),
            (run_module, "sample_ring", ring),
        ]
        before = [(owner, name, getattr(owner, name)) for owner, name, _ in vars_]
        for owner, name, value in vars_:
            setattr(owner, name, value)
        try:
            yield
        finally:
            for owner, name, value in before:
                setattr(owner, name, value)

    def _stopped(self) -> None:
        if self.stop_ns is None and any(axle.powered() for axle in self.axles):
            self.stop_ns = self.now()

    def _follow_can(self, driver: VirtualDriver) -> None:
        rack: Any = driver._rack
        send, joints = rack.send, driver._setup.joints

        def counted(can_id: int, data: bytes) -> None:
            self.answers += can_id & 0x780 == 0x580
            send(can_id, data)

        def axles() -> list[Axle]:
            axes = [(joint, rack.servos[joint.name].axis) for joint in joints]
            return [_axle(joint, partial(getattr, axis, "powered"), axis._plant) for joint, axis in axes]

        advance = rack.advance

        def advanced(to_ns: int) -> None:
            advance(to_ns)
            self.axles = self.axles or axles()
            self._advanced()

        rack.send, rack.advance = counted, advanced
        self.rack, self.stop_ns, self.axles, self.now = rack, None, [], lambda: rack.now_ns

    def _follow_motors(self, driver: VirtualMitDriver) -> None:
        motors = driver.rack.actuators
        self.rack, self.stop_ns = driver.rack, None
        self.now = lambda: max(motor._now_ns for motor in motors.values())
        pairs = [(joint, motors[joint.name]) for joint in driver.setup.joints]
        self.axles = [_axle(joint, partial(getattr, motor, "on"), motor.plant) for joint, motor in pairs]

    def _follow_servos(self, driver: VirtualServoDriver) -> None:
        servos = driver.chain.servos
        self.rack, self.stop_ns = driver._faulty or driver.chain, None
        self.now = lambda: max(servo._now_ns for servo in servos.values())
        self.axles = [
            _axle(
                joint,
                partial(getattr, servos[joint.name], "on"),
                servos[joint.name].plant,
                watchdog=bool(servos[joint.name].mine.model.registers.watchdog),
            )
            for joint in driver.setup.joints
        ]

    def _advanced(self) -> None:
        for axle in self.axles:
            if axle.powered():
                self.powered_ns[axle.name] = self.now()
                self._look(axle)
            else:
                self._places.pop(axle.name, None)

    def _look(self, axle: Axle) -> None:
        if self.moves(axle):
            self.moved_ns = self.now()
            low, high = axle.within_rad
            if not low <= axle.position_rad() <= high:
                self.beyond.setdefault("limits", f"joint {axle.name} left its limits")
            if abs(axle.velocity_rad_s()) > axle.fastest_rad_s:
                self.beyond["speed"] = f"joint {axle.name} passed its highest speed"

    def moves(self, axle: Axle) -> bool:
        """It went further within ``STANDS_S`` than who is at rest goes; to be asked whenever time has gone on."""
        now_ns, places = self.now(), self._places.setdefault(axle.name, deque())
        places.append((now_ns, axle.position_rad()))
        while len(places) > 2 and places[1][0] <= now_ns - STANDS_S * 1e9:
            places.popleft()
        reached = [place for _, place in places]
        return max(reached) - min(reached) > OFF_RAD_S * STANDS_S


def _usual_hz(kind: str) -> float:
    return 200.0 if kind in SERVOS else 250.0


class Bench:
    """Robots, their truth, a profile to compensate with, a store, and the phases of clean runs."""

    def __init__(self, folder: Path) -> None:
        os.environ["XDG_CONFIG_HOME"] = os.environ["XDG_DATA_HOME"] = str(folder / "home")
        os.environ["XDG_STATE_HOME"] = str(folder / "home")
        self.folder = folder
        self.clean: dict[str, dict[str, Phase]] = {}
        self.calibrated, self.store = cache(self._calibrated), cache(self._promoted)
        self.file, self.robot = cache(self._file), cache(lambda kind: load_robot(str(self.file(kind, _usual_hz(kind)))))

    def _file(self, kind: str, rate_hz: float) -> Path:
        path = self.folder / f"{kind.replace(' ', '-')}-{rate_hz:g}.yaml"
        bus = f"virtual:{NAME}-{os.getpid()}"
        values = {"schema": "frictid.robot/1", **ROBOTS[kind](), "name": NAME, "bus": bus, "cycle_hz": rate_hz}
        path.write_text(dump(values))
        return path

    def phases(self, verb: str) -> dict[str, Phase]:
        """Of a clean run of a verb."""
        if verb not in self.clean:
            watched, verdict = Watched(), Verdict(verb, "clean", "nothing", 0)
            self._run(watched, verdict, [], _usual_hz(VERBS[verb]))
            if verdict.failures or verdict.exit_code:
                raise SystemExit(f"the clean {verb} fails: {verdict.failures} {verdict.said}")
            self.clean[verb] = watched.phases
        return self.clean[verb]

    def struck(self, case: Case) -> Verdict:
        """One injection and its verdict."""
        verdict = Verdict(**asdict(case))
        faults = [case.row(self.phases(case.verb))]
        if case.verb == "reset":
            faults.append({"kind": "left_in_fault", "joint": JOINT})
        self._run(Watched(), verdict, faults, case.rate_hz)
        return verdict

    def _run(self, watched: Watched, verdict: Verdict, faults: Sequence[Mapping[str, Any]], rate_hz: float) -> None:
        """One run of a verb with these faults, judged."""
        file, began = self.file(VERBS[verdict.verb], rate_hz), time.monotonic()
        with tempfile.TemporaryDirectory(dir=self.folder) as folder:
            verb = _Verb(self, verdict, watched, file, Path(folder))
            os.environ[ENVIRONMENT] = json.dumps(faults)
            for number in (signal.SIGALRM, signal.SIGVTALRM):
                signal.signal(number, _hangs)
            signal.alarm(10 * HANGS_S)
            signal.setitimer(signal.ITIMER_VIRTUAL, HANGS_S)
            try:
                with contextlib.chdir(folder), watched.watching():
                    verb.run()
            except FrictidError as error:
                _ended(verdict, error)
            except Hangs:
                verdict.failures.append("hangs")
            except Exception as error:
                verdict.ended, verdict.said = "traceback", f"{type(error).__name__}: {error}"
                verdict.failures.append("traceback " + traceback.format_exc().strip().splitlines()[-3].strip())
            finally:
                signal.alarm(0)
                signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
            watched.finish()
            _judge_drives(watched, verdict)
            if verdict.verb not in STILL:
                _judge_recording(watched, verdict, Path(folder))
            if verdict.verb.endswith("recalibrate"):
                _judge_store(ProfileStore(verb.store), verdict, self.robot(VERBS[verdict.verb]))
            _judge_curves(verb.joints, verdict, self.robot(VERBS[verdict.verb]))
        verdict.took_s = round(time.monotonic() - began, 1)

    def _calibrated(self, kind: str) -> Path:
        """A profile of the joint."""
        with _no_faults():
            options = CalibrateOptions(
                str(self.file(kind, _usual_hz(kind))),
                joints=(JOINT,),
                program="quick",
                out=self.folder / f"{kind} profile",
            )
            profile = calibrate(options, Silent()).profile_file
        assert profile is not None
        return profile

    def _promoted(self, kind: str) -> Path:
        """A store with a profile in force."""
        store = self.folder / f"{kind} store"
        with _no_faults():
            options = RecalibrateOptions(
                str(self.file(kind, _usual_hz(kind))), store=store, out=self.folder / f"{kind} night"
            )
            result = recalibrate(options, Silent())
        assert result["promoted"], result
        return store


class _Verb:
    """One run of a verb."""

    def __init__(self, bench: Bench, verdict: Verdict, watched: Watched, file: Path, folder: Path) -> None:
        self._verdict, self._watched, self._file = verdict, watched, str(file)
        self._folder, self.store = folder, folder / "store"
        self._profile = bench.calibrated(VERBS[verdict.verb]) if verdict.verb.endswith("compensate") else None
        if verdict.verb.endswith("recalibrate"):
            shutil.copytree(bench.store(VERBS[verdict.verb]), self.store)
        self.joints: Mapping[str, Any] = {}

    def run(self) -> None:
        """To its end; what it told is in the verdict."""
        verb = self._verdict.verb
        getattr(self, "_gap_record" if verb == "gap record" else f"_{verb.split()[-1]}")()

    def _calibrate(self, *, together: bool = False) -> None:
        joints = (JOINT, OTHER) if together else (JOINT,)
        options = CalibrateOptions(
            self._file,
            joints=joints,
            program="quick",
            together=together,
            seed=self._verdict.seed,
            out=self._folder / "run",
        )
        result = calibrate(options, self._watched)
        _ended(self._verdict, result.ended.error)
        self.joints = result.joints

    def _together(self) -> None:
        self._calibrate(together=True)

    def _compensate(self) -> None:
        assert self._profile is not None
        mode = Mode.POSITION if self._verdict.verb.startswith("feetech") else Mode.TORQUE
        wanted = Wanted("track", ("nc", "mo", "mop"), drive_mode=mode, duration_s=2.0)
        options = CompensateOptions(
            self._file, self._profile, JOINT, wanted, seed=self._verdict.seed, out=self._folder / "run"
        )
        _ended(self._verdict, compensate(options, self._watched).ended.error)

    def _recalibrate(self) -> None:
        options = RecalibrateOptions(self._file, store=self.store, seed=self._verdict.seed, out=self._folder / "run")
        _told(self._verdict, recalibrate(options, self._watched))

    def _gap_record(self) -> None:
        plan = Path(self._file).with_name("experiments.yaml")
        plan.write_text(yaml.safe_dump(plan_document(("breakaway",), "for a fault")))
        options = GapRecordOptions(
            self._file, joint=JOINT, plan=plan, payload=False, seed=self._verdict.seed, out=self._folder / "run"
        )
        _ended(self._verdict, record(options, self._watched).ended.error)

    def _check(self) -> None:
        _told(self._verdict, check(self._file))

    def _reset(self) -> None:
        _told(self._verdict, reset(self._file, ask=lambda findings: True))


@contextlib.contextmanager
def _no_faults() -> Iterator[None]:
    before, os.environ[ENVIRONMENT] = os.environ.get(ENVIRONMENT, "[]"), "[]"
    yield
    os.environ[ENVIRONMENT] = before


class Hangs(BaseException):
    """Nothing of the program may take this for an error of its bus."""


def _hangs(_number: int, _frame: object) -> None:
    raise Hangs


def _ended(verdict: Verdict, error: FrictidError | None) -> None:
    if error is None:
        verdict.ended = "ok"
        return
    verdict.ended, verdict.exit_code, verdict.said = (
        type(error).__name__,
        error.exit_code,
        f"{error}; {error.next_step}",
    )
    verdict.noticed = True
    if isinstance(error, Defect):
        verdict.failures.append(f"a defect: {error}")
    if not error.next_step:
        verdict.failures.append("no next step is told")


def _told(verdict: Verdict, result: Mapping[str, Any]) -> None:
    """How a verb ended that answers in JSON."""
    verdict.exit_code = result.get("exit_code", 0)
    verdict.ended, verdict.noticed = ("ok", False) if verdict.exit_code == 0 else (str(result.get("outcome")), True)
    error = result.get("error")
    if error:
        verdict.said = error["what"]
        if not error["next_step"]:
            verdict.failures.append("no next step is told")


# -- the judgement -----------------------------------------------------------------------------------------------------


def _holds(axle: Axle, verdict: Verdict) -> bool:
    """Without a watchdog, out of reach, and named in the last words: it keeps its power and its last goal."""
    named = re.search(r"joint ([^:;]+) may still have power", verdict.said)
    told = named is not None and axle.name in named[1].split(", ")
    return told and not axle.watchdog and verdict.name in OUT_OF_REACH


def _judge_drives(watched: Watched, verdict: Verdict) -> None:
    rack = watched.rack
    if rack is None:
        return
    for _ in range(round(SILENT_S / LOOK_S)):
        rack.advance(watched.now() + round(LOOK_S * 1e9))
    for axle in watched.axles:
        if axle.powered():
            if _holds(axle, verdict):
                watched.powered_ns.pop(axle.name)  # no word reaches it, so that there is no time to hold it to
            else:
                verdict.failures.append(f"joint {axle.name} has power after the end")
            if watched.moves(axle):
                verdict.failures.append(f"joint {axle.name} moves after the end")
    verdict.failures += watched.beyond.values()
    if watched.stop_ns is not None:
        verdict.noticed = True
        verdict.rest_s = round(max(0, watched.moved_ns - watched.stop_ns) * 1e-9, 3)
        off_ns = max(watched.powered_ns.values(), default=0)
        verdict.off_s = round(max(0, off_ns - watched.stop_ns) * 1e-9, 3)
        if verdict.rest_s > REST_S:
            verdict.failures.append(f"at rest {verdict.rest_s:.2f} s after the stop")
        if verdict.off_s > (SERVO_OFF_S if VERBS[verdict.verb] in SERVOS else OFF_S):
            verdict.failures.append(f"without power {verdict.off_s:.2f} s after the stop")


def _judge_recording(watched: Watched, verdict: Verdict, folder: Path) -> None:
    recorded = sum(ring._head for ring in watched.rings)
    if not recorded:
        return
    files = sorted(folder.rglob("samples*.mcap"))
    try:
        kept = sum(len(rows) for file in files for rows in read_rows(file).values())
    except FrictidError as error:
        verdict.failures.append(f"the recording cannot be read: {error}")
        return
    if kept != recorded:
        verdict.failures.append(f"{recorded - kept} of {recorded} rows are not in the recording")


def _judge_store(store: ProfileStore, verdict: Verdict, robot: Robot) -> None:
    history = [stored.id for stored in store.history(NAME)]
    try:
        profiles = [store.load(NAME, identity) for identity in history]
        active = store.active_profile(NAME)
    except FrictidError as error:
        verdict.failures.append(f"the store cannot be read: {error}")
        return
    if not profiles or active is None:
        verdict.failures.append("the store has lost its profile")
    else:
        _judge_profile(active, verdict, robot)


def _judge_profile(profile: FrictionProfile, verdict: Verdict, robot: Robot) -> None:
    joints = {
        name: {
            "outcome": "ok",
            "velocity_rad_s": joint.velocity_rad_s,
            "torque_interval_nm": joint.torque_interval_nm,
        }
        for name, joint in profile.joints.items()
    }
    _judge_curves(joints, verdict, robot)


def _judge_curves(joints: Mapping[str, Any], verdict: Verdict, robot: Robot) -> None:
    worst = 0.0
    for name, joint in joints.items():
        if joint.get("outcome") != "ok":
            verdict.noticed = True
            continue
        speeds = np.array(joint["velocity_rad_s"])
        truth = true_curve(robot, name, float(speeds[-1]) * 1.01).magnitude(speeds)
        low, high = np.array(joint["torque_interval_nm"]).T
        beyond = np.maximum(low - truth, truth - high) / truth.mean()
        worst = max(worst, float(beyond.max()))
    verdict.off_percent = max(verdict.off_percent, round(100 * worst, 2))
    if worst > MARGIN:
        verdict.failures.append(f"a curve {100 * worst:.1f} % outside its interval is called ok")


# -- the campaign ------------------------------------------------------------------------------------------------------


def cases(
    verbs: Sequence[str], seeds: Sequence[int], only: str, phases: Callable[[str], Mapping[str, Phase]]
) -> list[Case]:
    """All injections, the verbs in turn."""
    found = []
    for verb in verbs:
        for phase, when in phases(verb).items():
            before = phase in BEFORE_SYNC
            if phase == "end" or (when.end_s <= when.start_s and (not before or when.last_sdo <= when.first_sdo)):
                continue
            for name in faults_of(verb, phase):
                early = phase in ("reference", "enable", "units", "approach", "move", "rehearsal")
                if (early and name in WHOLE_RUN) or only not in f"{verb} {phase} {name}":
                    continue
                found += [Case(verb, phase, name, seed) for seed in seeds]
    return found


def drawn(todo: Sequence[Case], runs: int | None, seed: int) -> list[Case]:
    """So many of them, evenly over the verbs; verbs without power have few."""
    shuffled = [todo[at] for at in np.random.default_rng(seed).permutation(len(todo))]
    if runs is None:
        return shuffled
    by_verb = {verb: [case for case in shuffled if case.verb == verb] for verb in {case.verb: None for case in todo}}
    picked: list[Case] = []
    while len(picked) < runs and any(by_verb.values()):
        picked += [left.pop() for left in by_verb.values() if left]
    return picked[:runs]


BEGIN, END = "<!-- written by benchmarks/faults.py{part} -->", "<!-- end of what it wrote -->"


def told(verdicts: Sequence[Verdict], command: str, commit: str) -> str:
    """The figures by verb, and every failure."""
    failed = [verdict for verdict in verdicts if verdict.failures]
    lines = [
        f"`{command}` at {commit}: {len(verdicts)} injections, {len(failed)} failed.",
        "",
        "| Verb | Injections | Noticed | Longest to rest | Longest to power off | Failed |",
        "|---|---|---|---|---|---|",
    ]
    for verb, rows in _by(verdicts, lambda verdict: verdict.verb):
        rest_s, off_s = max(row.rest_s for row in rows), max(row.off_s for row in rows)
        lines.append(f"| {verb} | {_counted(rows)} | {rest_s:.2f} s | {off_s:.2f} s | {_failed(rows)} |")
    lines += ["", "### Every failure", ""]
    lines += (
        ["| Verb | Phase | Fault | Seed | Ended | What failed |", "|---|---|---|---|---|---|"] if failed else ["None."]
    )
    for row in failed:
        said = "; ".join(row.failures).replace("|", "/")
        lines.append(f"| {row.verb} | {row.phase} | {row.name} | {row.seed} | {row.ended} | {said} |")
    return "\n".join(lines) + "\n"


def write(page: Path, part: str, verdicts: Sequence[Verdict], text: str) -> None:
    """Into a part of the page, and beside it injections by phase and by fault as tables of their own."""
    begin = BEGIN.format(part=f" --part {part}" if part else "")
    before, rest = page.read_text().split(begin)
    after = rest.split(END, 1)[1]
    page.write_text(f"{before}{begin}\n\n{text}\n{END}{after}")
    write_counts(page.parent / "data", f"{part}-faults" if part else "faults", verdicts)


def write_counts(folder: Path, name: str, verdicts: Sequence[Verdict]) -> None:
    """Injections by phase and by fault, each as a table of its own."""
    for key, named in (("phase", "phase"), ("fault", "name")):
        rows = _by(verdicts, attrgetter(named))
        with (folder / f"{name}-by-{key}.csv").open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow([key, "injections", "noticed", "failed"])
            table.writerows([name, len(of), sum(row.noticed for row in of), _failed(of)] for name, of in rows)


def _by(verdicts: Sequence[Verdict], key: Callable[[Verdict], str]) -> list[tuple[str, list[Verdict]]]:
    names = sorted({key(verdict) for verdict in verdicts})
    return [(name, [verdict for verdict in verdicts if key(verdict) == name]) for name in names]


def _counted(rows: Sequence[Verdict]) -> str:
    return f"{len(rows)} | {sum(row.noticed for row in rows)}"


def _failed(rows: Sequence[Verdict]) -> int:
    return sum(bool(row.failures) for row in rows)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, help="so many, drawn evenly over the verbs; all unless told")
    parser.add_argument("--seed", type=int, default=0, help="the first one")
    parser.add_argument("--seeds", type=int, default=1, help="how many moments of each fault in each phase")
    parser.add_argument("--only", default="", help="part of 'verb phase fault'")
    parser.add_argument("--verbs", default=",".join(VERBS))
    parser.add_argument("--kept", type=Path, help="goes on after an interruption")
    parser.add_argument("--again", action="store_true", help="only what failed in --kept; its verdicts are replaced")
    parser.add_argument(
        "--docs", type=Path, help="page whose marked part is written anew, and data/faults-by-*.csv beside it"
    )
    parser.add_argument("--part", default="", help="of that page: servos")
    asked = parser.parse_args()
    lines = asked.kept.read_text().splitlines() if asked.kept and asked.kept.exists() else []
    kept = [Verdict(**json.loads(line)) for line in lines]
    again = [Case(v.verb, v.phase, v.name, v.seed) for v in kept if v.failures]
    if asked.again:
        kept = [verdict for verdict in kept if not verdict.failures]
    done = {(v.verb, v.phase, v.name, v.seed) for v in kept}
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        seeds = range(asked.seed, asked.seed + asked.seeds)
        todo = again if asked.again else []
        if not asked.again and (asked.runs is None or asked.runs > 0):
            every = cases(asked.verbs.split(","), seeds, asked.only, bench.phases)
            todo = drawn(every, asked.runs, asked.seed)
        for case in todo:
            if (case.verb, case.phase, case.name, case.seed) in done:
                continue
            verdict = bench.struck(case)
            kept.append(verdict)
            if asked.kept and not asked.again:
                with asked.kept.open("a") as file:
                    file.write(json.dumps(asdict(verdict)) + "\n")
            ending = f"{verdict.ended} {verdict.said[:90]} {verdict.failures} {verdict.took_s}"
            print(f"{case.verb} {case.phase} {case.name} {case.seed}: {ending}", flush=True)
    if asked.kept and asked.again:
        asked.kept.write_text("".join(json.dumps(asdict(verdict)) + "\n" for verdict in kept))
    if asked.docs:
        text = told(kept, f"python benchmarks/faults.py --runs {len(kept)}", git_revision()[:8])
        write(asked.docs, asked.part, kept, text)
    failed = sum(bool(verdict.failures) for verdict in kept)
    print(f"{len(kept)} injections, {failed} failed")


if __name__ == "__main__":
    main()
