"""Every fault at every phase of a run, judged by the simulated servos' own state and the withheld truth.

    python benchmarks/faults.py [--seeds 1] [--only lag] [--verbs calibrate] [--kept FILE] [--docs PAGE]

Two joints of the shipped robot, lock-step, one process; about four seconds a run. A clean run first tells when each
phase is; then each fault strikes once in each, at a moment drawn by its seed. The host's word counts for nothing:

* **at rest, without power**: after the run, and a second in which nobody talks to them, the servos stand and have no
  power; and they did so in time after the host's stop, or after the drive's own watchdog;
* **everything kept**: every row that the loop recorded is in the run's recording, and it can be read;
* **no wrong curve called ok**: no joint with outcome ok has a curve more than its interval and 2 % off the truth;
* and no defect of the program: every ending is one of our errors, with a next step.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from frictid_drivers.cia402 import Cia402Driver
from frictid_drivers.virtual import VirtualDriver
from frictid_drivers.virtual.faults import ENVIRONMENT
from frictid_drivers.virtual.rack import Rack
from frictid_hil.config.provenance import git_revision
from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import Defect, FrictidError, UsageError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.compare import true_curve
from frictid_hil.jobs.compensate import CompensateOptions, compensate
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.plan import Plan
from frictid_hil.recording.mcap_reader import read_rows
from frictid_hil.runner.events import Event, PhaseStarted, Preflight
from frictid_hil.runner.ring import Ring, sample_ring
from frictid_hil.runs import run as run_module

Draw = Callable[[np.random.Generator], dict[str, Any]]

JOINT, OTHER = "3", "4"
ROBOT = """\
schema: frictid.robot/1
extends: hp3j.yaml
name: faulty-bench
bus: virtual:faulty-bench-{pid}
joints: {{"0": null, "1": null, "2": null, "5": null}}
"""
REST_S, OFF_S, OFF_MPS = 0.5, 2.6, 0.02
"""Longest from the host's stop to rest and to the end of power (docs/reference/stops.md), and what counts as rest."""
SILENT_S = 1.0
"""Nobody talks to the drives for so long: their own watchdogs have had their say."""
MARGIN = 0.02
PHASES = ("preflight", "configure", "enable", "rehearsal", "move", "cycles", "drift", "reversal", "return")
BEFORE_SYNC = ("preflight", "configure")
HANGS_S = 240


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
    "node silent in set-up": _of_either(kind="mute"),
    "interface fails in set-up": _of_bus(kind="send_error", error="os"),
    "interface deaf in set-up": _of_bus(kind="receive_error", error="runtime"),
}
IN_MOTION = WRONG_REPORTS | FRAMES | DRIVES | INTERFACE
WHOLE_RUN = ("torque times 1.5", "torque times 0.7", "torque offset", "position scaled 1.1")
"""From the beginning these are another robot, not a fault: no host can tell. They strike later only."""


@dataclass(frozen=True)
class Case:
    """One injection."""

    verb: str
    phase: str
    name: str
    seed: int

    def row(self, phases: Mapping[str, Phase]) -> dict[str, Any]:
        """The fault as a robot file would list it."""
        words = f"{self.verb}/{self.phase}/{self.name}/{self.seed}"
        rng = np.random.default_rng(zlib.crc32(words.encode()))
        row = (SDO if self.phase in BEFORE_SYNC else IN_MOTION)[self.name](rng)
        phase = phases[self.phase]
        if self.phase not in BEFORE_SYNC:
            return {**row, "at_s": round(float(rng.uniform(phase.start_s, phase.end_s)), 4)}
        share = 0.5 if "joint" in row else 1.0  # half of the answers are of either joint
        after = int(rng.integers(round(phase.first_sdo * share), max(1, round(phase.last_sdo * share) - 1)))
        return {**row, "after": after} if row["kind"] != "mute" else row


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


class Watched(Silent):
    """Follows a run from behind: the servos' own state at every step of their time, and the phases."""

    def __init__(self) -> None:
        self.rack = Rack()
        self.rings: list[Ring] = []
        self.phases: dict[str, Phase] = {}
        self.stop_ns: int | None = None
        self.moved_ns = self.powered_ns = 0
        self.origin_ns: int | None = None
        self.answers = 0
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
        if self.origin_ns is None and name != "configure":
            self.origin_ns = self.rack.now_ns
        now_s = (self.rack.now_ns - (self.rack.now_ns if self.origin_ns is None else self.origin_ns)) * 1e-9
        last = self.phases[self._phase]
        last.end_s, last.last_sdo = now_s, self.answers
        self._phase = name if name not in self.phases else f"{name} again"
        self.phases[self._phase] = Phase(now_s, now_s, self.answers, self.answers)

    def finish(self) -> None:
        """The last phase ends."""
        self._begin("end")

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        """Hooks where the servos' time goes on, where rows are kept, and where the host stops."""
        opened, stopped = VirtualDriver.open, Cia402Driver.quick_stop

        def open_(driver: VirtualDriver, sink: Any = None) -> None:
            self._follow(driver._rack)
            opened(driver, sink)

        def stop(driver: Cia402Driver) -> None:
            if self.stop_ns is None and any(servo.axis.powered for servo in self.rack.servos.values()):
                self.stop_ns = self.rack.now_ns
            stopped(driver)

        def ring(**how: Any) -> Ring:
            self.rings.append(sample_ring(**how))
            return self.rings[-1]

        vars_ = [(VirtualDriver, "open", open_), (Cia402Driver, "quick_stop", stop), (run_module, "sample_ring", ring)]
        before = [(owner, name, getattr(owner, name)) for owner, name, _ in vars_]
        for owner, name, value in vars_:
            setattr(owner, name, value)
        try:
            yield
        finally:
            for owner, name, value in before:
                setattr(owner, name, value)

    def _follow(self, rack: Rack) -> None:
        self.rack, self.stop_ns, advance, send = rack, None, rack.advance, rack.send

        def advanced(to_ns: int) -> None:
            advance(to_ns)
            for servo in rack.servos.values():
                if servo.axis.powered:
                    self.powered_ns = rack.now_ns
                    if abs(servo.axis._plant.velocity_rad_s) > OFF_MPS:
                        self.moved_ns = rack.now_ns

        def counted(can_id: int, data: bytes) -> None:
            self.answers += can_id & 0x780 == 0x580
            send(can_id, data)

        hooked: Any = rack
        hooked.advance, hooked.send = advanced, counted


class Bench:
    """The robot, its truth, a profile to compensate with, and the phases of clean runs."""

    def __init__(self, folder: Path) -> None:
        os.environ["XDG_CONFIG_HOME"] = os.environ["XDG_DATA_HOME"] = str(folder / "home")
        os.environ["XDG_STATE_HOME"] = str(folder / "home")
        self.folder = folder
        self.file = folder / "faulty-bench.yaml"
        self.file.write_text(ROBOT.format(pid=os.getpid()))
        self.robot: Robot = load_robot(str(self.file))
        self.clean: dict[str, dict[str, Phase]] = {}
        self._profile: Path | None = None

    def phases(self, verb: str) -> dict[str, Phase]:
        """Of a clean run of a verb."""
        if verb not in self.clean:
            if verb == "compensate":
                self._calibrated()
            watched, verdict = Watched(), Verdict(verb, "clean", "nothing", 0)
            self.run(watched, verdict, [])
            if verdict.failures or verdict.exit_code:
                raise SystemExit(f"the clean {verb} fails: {verdict.failures} {verdict.said}")
            self.clean[verb] = watched.phases
        return self.clean[verb]

    def struck(self, case: Case) -> Verdict:
        """One injection and its verdict."""
        verdict = Verdict(**asdict(case))
        self.run(Watched(), verdict, [case.row(self.phases(case.verb))])
        return verdict

    def run(self, watched: Watched, verdict: Verdict, faults: Sequence[Mapping[str, Any]]) -> None:
        """One run of a verb with these faults, judged."""
        began = time.monotonic()
        os.environ[ENVIRONMENT] = json.dumps(faults)
        joints: dict[str, Any] = {}
        with tempfile.TemporaryDirectory(dir=self.folder) as folder:
            out = Path(folder) / "run"
            signal.signal(signal.SIGALRM, _hangs)
            signal.alarm(HANGS_S)
            try:
                with watched.watching():
                    joints = self._verb(verdict, watched, out)
            except UsageError as error:
                _ended(verdict, error)
            except FrictidError as error:
                _ended(verdict, error)
            except TimeoutError:
                verdict.failures.append("hangs")
            except Exception as error:
                verdict.ended, verdict.said = "traceback", f"{type(error).__name__}: {error}"
                verdict.failures.append("traceback " + traceback.format_exc().strip().splitlines()[-3].strip())
            finally:
                signal.alarm(0)
            watched.finish()
            self._judge_servos(watched, verdict)
            _judge_recording(watched, verdict, out)
        if verdict.verb != "compensate":
            self._judge_curves(joints, verdict)
        verdict.took_s = round(time.monotonic() - began, 1)

    def _verb(self, verdict: Verdict, watched: Watched, out: Path) -> dict[str, Any]:
        if verdict.verb == "compensate":
            profile = self._calibrated()
            asked = CompensateOptions(
                str(self.file), profile, JOINT, Wanted("track", ("nc", "mo"), duration_s=2.0), out=out
            )
            ended = compensate(asked, watched).ended
            _ended(verdict, ended.error)
            return {}
        together = verdict.verb == "together"
        options = CalibrateOptions(
            str(self.file),
            joints=(JOINT, OTHER) if together else (JOINT,),
            program="quick",
            together=together,
            rate_hz=500.0 if together else None,
            out=out,
        )
        result = calibrate(options, watched)
        _ended(verdict, result.ended.error)
        return dict(result.joints)

    def _calibrated(self) -> Path:
        if self._profile is None:
            before, os.environ[ENVIRONMENT] = os.environ.get(ENVIRONMENT, "[]"), "[]"
            result = calibrate(
                CalibrateOptions(str(self.file), joints=(JOINT,), program="quick", out=self.folder / "profile"),
                Silent(),
            )
            os.environ[ENVIRONMENT] = before
            assert result.profile_file is not None
            self._profile = result.profile_file
        return self._profile

    def _judge_servos(self, watched: Watched, verdict: Verdict) -> None:
        rack = watched.rack
        ended_ns = rack.now_ns
        rack.advance(ended_ns + round(SILENT_S * 1e9))
        for name, servo in rack.servos.items():
            if servo.axis.powered:
                verdict.failures.append(f"joint {name} has power after the end")
            if abs(servo.axis._plant.velocity_rad_s) > OFF_MPS and servo.axis.powered:
                verdict.failures.append(f"joint {name} moves after the end")
        if watched.stop_ns is not None:
            verdict.noticed = True
            verdict.rest_s = round(max(0, watched.moved_ns - watched.stop_ns) * 1e-9, 3)
            verdict.off_s = round(max(0, watched.powered_ns - watched.stop_ns) * 1e-9, 3)
            if verdict.rest_s > REST_S:
                verdict.failures.append(f"at rest {verdict.rest_s:.2f} s after the stop")
            if verdict.off_s > OFF_S:
                verdict.failures.append(f"without power {verdict.off_s:.2f} s after the stop")

    def _judge_curves(self, joints: Mapping[str, Any], verdict: Verdict) -> None:
        worst = 0.0
        for name, joint in joints.items():
            if joint.get("outcome") != "ok":
                verdict.noticed = True
                continue
            speeds = np.array(joint["velocity_rad_s"])
            truth = true_curve(self.robot, name, float(speeds[-1]) * 1.01).magnitude(speeds)
            low, high = np.array(joint["torque_interval_nm"]).T
            beyond = np.maximum(low - truth, truth - high) / truth.mean()
            worst = max(worst, float(beyond.max()))
        verdict.off_percent = round(100 * worst, 2)
        if worst > MARGIN:
            verdict.failures.append(f"a curve {100 * worst:.1f} % outside its interval is called ok")


def _hangs(_number: int, _frame: object) -> None:
    raise TimeoutError("hangs")


def _ended(verdict: Verdict, error: FrictidError | None) -> None:
    if error is None:
        verdict.ended = "ok"
        return
    verdict.ended, verdict.exit_code, verdict.said = type(error).__name__, error.exit_code, str(error)
    verdict.noticed = True
    if isinstance(error, Defect):
        verdict.failures.append(f"a defect: {error}")
    if not error.next_step:
        verdict.failures.append("no next step is told")


def _judge_recording(watched: Watched, verdict: Verdict, out: Path) -> None:
    recorded = sum(ring._head for ring in watched.rings)
    files = sorted(out.rglob("samples*.mcap"))
    try:
        kept = sum(len(rows) for file in files for rows in read_rows(file).values())
    except FrictidError as error:
        verdict.failures.append(f"the recording cannot be read: {error}")
        return
    if kept != recorded:
        verdict.failures.append(f"{recorded - kept} of {recorded} rows are not in the recording")


def cases(verbs: Sequence[str], seeds: int, only: str, phases: Callable[[str], Mapping[str, Phase]]) -> list[Case]:
    """All injections, the verbs in turn."""
    found = []
    for verb in verbs:
        for phase in phases(verb):
            if phase == "end" or (
                phases(verb)[phase].end_s <= phases(verb)[phase].start_s and phase not in BEFORE_SYNC
            ):
                continue
            for name in SDO if phase in BEFORE_SYNC else IN_MOTION:
                early = phase in ("reference", "enable", "rehearsal")
                if (early and name in WHOLE_RUN) or only not in f"{verb} {phase} {name}":
                    continue
                found += [Case(verb, phase, name, seed) for seed in range(seeds)]
    return found


def page(verdicts: Sequence[Verdict], command: str, commit: str) -> str:
    """The evidence as a page."""
    failed = [verdict for verdict in verdicts if verdict.failures]
    lines = [
        "# Faults on purpose",
        "",
        f"`{command}` at {commit}: {len(verdicts)} injections,",
        f"{len(failed)} of them failed one of these questions, judged by",
        "the simulated servos' own state and the withheld truth, whatever the host said:",
        "",
        "- the joints are at rest and without power in time;",
        "- every row that the loop recorded is in the recording, and it can be read;",
        "- no curve more than its interval and 2 % off the truth is called ok;",
        "- every ending is one of our errors, with a next step.",
        "",
        "| Verb | Injections | Noticed | Longest to rest | Longest to power off | Failed |",
        "|---|---|---|---|---|---|",
    ]
    for verb in dict.fromkeys(verdict.verb for verdict in verdicts):
        rows = [verdict for verdict in verdicts if verdict.verb == verb]
        lines.append(
            f"| {verb} | {len(rows)} | {sum(row.noticed for row in rows)} | {max(row.rest_s for row in rows):.2f} s "
            f"| {max(row.off_s for row in rows):.2f} s | {sum(bool(row.failures) for row in rows)} |"
        )
    lines += ["", "## By fault", "", "| Fault | Injections | Stopped or refused | Failed |", "|---|---|---|---|"]
    for name in dict.fromkeys(verdict.name for verdict in verdicts):
        rows = [verdict for verdict in verdicts if verdict.name == name]
        lines.append(
            f"| {name} | {len(rows)} | {sum(row.noticed for row in rows)} | {sum(bool(row.failures) for row in rows)} |"
        )
    lines += ["", "## Every failure", ""]
    lines += (
        ["| Verb | Phase | Fault | Seed | Ended | What failed |", "|---|---|---|---|---|---|"] if failed else ["None."]
    )
    for row in failed:
        told = "; ".join(row.failures).replace("|", "/")
        lines.append(f"| {row.verb} | {row.phase} | {row.name} | {row.seed} | {row.ended} | {told} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", default="", help="part of 'verb phase fault'")
    parser.add_argument("--verbs", default="calibrate,together,compensate")
    parser.add_argument("--kept", type=Path, help="goes on after an interruption")
    parser.add_argument("--docs", type=Path)
    parser.add_argument("--share", type=float, default=1.0, help="share of the injections, drawn by seed")
    asked = parser.parse_args()
    kept = (
        [Verdict(**json.loads(line)) for line in asked.kept.read_text().splitlines()]
        if (asked.kept and asked.kept.exists())
        else []
    )
    done = {(v.verb, v.phase, v.name, v.seed) for v in kept}
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder))
        todo = cases(asked.verbs.split(","), asked.seeds, asked.only, bench.phases)
        rng = np.random.default_rng(17)
        rng.shuffle(todo)
        for case in todo[: round(asked.share * len(todo))]:
            if (case.verb, case.phase, case.name, case.seed) in done:
                continue
            verdict = bench.struck(case)
            kept.append(verdict)
            if asked.kept:
                with asked.kept.open("a") as file:
                    file.write(json.dumps(asdict(verdict)) + "\n")
            print(
                f"{case.verb} {case.phase} {case.name}: {verdict.ended} {verdict.said[:90]} {verdict.failures}",
                flush=True,
            )
    if asked.docs:
        asked.docs.write_text(page(kept, "python " + " ".join(sys.argv), git_revision() or "?"))
    failed = sum(bool(verdict.failures) for verdict in kept)
    print(f"{len(kept)} injections, {failed} failed")


if __name__ == "__main__":
    main()
