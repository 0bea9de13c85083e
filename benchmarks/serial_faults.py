"""Every fault of the serial emulator at every phase of a whole ``calibrate``, streamed and in batch.

    python benchmarks/serial_faults.py [--places 2] [--docs PAGE]   virtual time (about 25 minutes of processor time;
                                                                    half as many with --places 1; --layers one of them;
                                                                    --kept FILE goes on after an interruption)
    python benchmarks/serial_faults.py --pty [--docs PAGE]          20 of them through the command line, on a pseudo
                                                                    terminal and the wall clock (about 10 minutes)

Joint 3, the quick programme. A healthy run first tells which acknowledgement, block, frame or tick belongs to
which phase; then every kind of fault strikes at some of them. Every run must end - at most 150 s of the controller's
time later than a healthy one - with an outcome and no traceback; the joint must stand afterwards; an error must name a
cause that this fault can have; a run that succeeds must be within 2.5 % of the truth; what moved must be recorded; and
every recorded position must be the one that the joint had at that tick.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from frictid_drivers.motoman import MotomanDriver
from frictid_drivers.motoman.emulator.build import build
from frictid_drivers.motoman.emulator.faults import OCCASIONS, Fault, FaultPlan
from frictid_drivers.motoman.emulator.jobs import Job
from frictid_drivers.motoman.emulator.loopback import LoopbackPort
from frictid_drivers.motoman.emulator.machine import Emulator
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import FrictidError, InputFileError
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.compare import compare
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.recording.mcap_reader import read_mcap
from frictid_hil.runner.events import Event, JobProgress, Marked, PhaseStarted
from frictid_hil.runs import run as run_module

JOINT, LIMIT_PERCENT, LATER_S, TICK_NS = "3", 2.5, 150.0, 4_000_000
ROBOT = """\
schema: frictid.robot/1
extends: hp3j-serial.yaml
name: hp3j-faults
bus: serial:loopback
options:
  layer: {layer}
"""
KINDS = (
    *("lost_ack", "wrong_ack", "nak", "nak x3", "nak x5", "bad_bcc", "bad_bcc x6", "lost_block", "garble"),
    *("silence :4", "silence :25", "enq", "enq :1", "split", "merge :0.02", "close"),
    *("bad_crc", "bad_crc x7", "lost_frame x2", "lost_frame x90", "deaf", "deaf x90", "noise x2", "noise x90"),
    *("late :0.02", "late :0.5", "alarm :4107", "hold", "drop :30", "unplug"),
)
LINK = (
    "no answer|rejected|unreadable|silent|no reply|ended|never acknowledged|no HELLO|in the middle|instead of|asked for"
    "|whole numbers|heard nothing"
)
LOST = "watchdog|no HELLO|no feedback"
CAUSES = {
    "close": "port is gone|port failed",
    "unplug": "port is gone|port failed|no feedback",
    "alarm": "alarm 4107",
    "hold": "pendant hold|pressed hold",
    "late": LOST,
    "bad_crc": LOST,
    "lost_frame": LOST,
    "deaf": LOST,
    "noise": LOST,
    "silence": f"{LINK}|{LOST}|heard nothing",
    "enq": f"bid for the line|{LINK}",
}
ON_TERMINALS = {
    "stream": (
        *(
            "lost_ack@3",
            "wrong_ack@9",
            "nak@2",
            "nak@4x5",
            "bad_bcc@5",
            "garble@11",
            "silence@14:4",
            "enq@1:1",
            "split@0",
        ),
        *(
            "merge@0:0.01",
            "bad_crc@400",
            "deaf@1800x90",
            "late@700:0.02",
            "alarm@2000:4107",
            "hold@3000",
            "unplug@1900",
        ),
    ),
    "batch": ("bad_bcc@70x2", "lost_block@80", "hold@900", "close@250"),
}


@dataclass
class Watched:
    """One run: the controller behind it, and what its joint really did."""

    emulator: Emulator
    driver: MotomanDriver
    truth_pulses: dict[int, int] = field(default_factory=dict)
    jobs: list[Job] = field(default_factory=list)
    lost_at_sample: int = 0

    @staticmethod
    def of(setup: RobotSetup, faults: Sequence[str]) -> Watched:
        """Driver and controller on one virtual wire."""
        emulator = build(setup, FaultPlan(Fault.parse(text) for text in faults))
        driver = MotomanDriver(setup, port_factory=lambda path, baud, parity: LoopbackPort(emulator, baud, parity))
        watched = Watched(emulator, driver)
        axis = emulator.axes[setup.joint(JOINT).address]
        run, start = axis.run, emulator.batch._commands["FRUN"]

        def remember(duration_s: float) -> None:
            if emulator.stream is not None:
                watched.truth_pulses[emulator.stream.tick_number] = axis.pulses
            run(duration_s)

        def remember_job(text: str, operands: list[str]) -> Any:
            job = emulator.batch._job
            if job is not None and job not in watched.jobs:
                watched.jobs.append(job)
            return start(text, operands)

        lose = emulator._lose_port

        def remember_loss(for_s: float) -> None:
            if emulator.batch.moving:
                watched.lost_at_sample = len(watched.jobs[-1].samples)
            lose(for_s)

        axis.run = remember  # type: ignore[method-assign]  # a tap that stays as long as the controller
        emulator._lose_port = remember_loss  # type: ignore[method-assign]  # likewise
        emulator.batch._commands["FRUN"] = remember_job
        return watched

    def true_pulses(self, times_ns: np.ndarray[Any, Any]) -> list[int | None]:
        """Where the joint was at these times of the recording."""
        if not self.jobs:
            first = -self.driver.clock.tick_ns(0) // TICK_NS
            return [self.truth_pulses.get(first + int(time_ns) // TICK_NS) for time_ns in times_ns]
        cuts = np.flatnonzero(np.diff(times_ns) != TICK_NS) + 1
        true: list[int | None] = []
        for part, job in zip(np.split(times_ns, cuts), self.jobs, strict=False):
            true += [sample[0] for sample in job.samples[: len(part)]]
        return true

    def still_moving(self) -> bool:
        """Six seconds later (a job's own watchdog takes five), for one second."""
        emulator = self.emulator
        emulator.advance(emulator.now_s + 6.0)
        before = [axis.issued for axis in emulator.axes]
        emulator.advance(emulator.now_s + 1.0)
        return emulator.panel.operating or before != [axis.issued for axis in emulator.axes]


@dataclass(frozen=True)
class Outcome:
    """How one run ended; ``wrong`` says what must not be."""

    exit_code: int
    told: str
    wrong: tuple[str, ...]
    seconds: float

    @property
    def cell(self) -> str:
        """As the table shows it."""
        return {0: "recovers", 5: "refuses (5)"}.get(self.exit_code, f"stops ({self.exit_code})")


def inject(layer: str, faults: Sequence[str], *, limit_s: float, told: Callable[[Event], None]) -> Outcome:
    """One whole calibration with these faults."""
    runs: list[Watched] = []

    def driver(setup: RobotSetup) -> MotomanDriver:
        runs.append(Watched.of(setup, faults))
        return runs[-1].driver

    class Watch(Silent):
        def event(self, event: Event) -> None:
            told(event)

    module: Any = run_module
    module.new_driver = lambda name, setup: driver(setup)
    wrong: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        robot, out = Path(folder) / "robot.yaml", Path(folder) / "run"
        robot.write_text(ROBOT.format(layer=layer))
        # Every run is this robot's first: it rehearses.
        os.environ["XDG_STATE_HOME"] = folder
        INJECTED.append(runs)
        options = CalibrateOptions(str(robot), out=out, program="quick", joints=(JOINT,))
        try:
            result = calibrate(options, Watch()).to_json()
        except FrictidError as refused:
            result = {"exit_code": refused.exit_code, "error": {"what": str(refused), "cause": refused.cause}}
        except Exception:  # a defect: the very thing this benchmark looks for; it counts as wrong and is told
            return Outcome(-1, "", ("traceback: " + traceback.format_exc().splitlines()[-1],), 0.0)
        (watched,) = runs
        ended_s = watched.emulator.now_s
        if ended_s > limit_s:
            wrong.append(f"took {ended_s:.0f} s")
        error = result.get("error") or {}
        text = f"{error.get('what', '')} | {error.get('cause', '')}"
        wrong += judge_outcome(result, faults, text, lambda: compare(out, None, str(robot)))
        if watched.still_moving():
            wrong.append("still moving")
        wrong += judge_recording(watched, out, code=int(result["exit_code"]))
    return Outcome(int(result["exit_code"]), text, tuple(wrong), ended_s)


MOVED_PULSES = 500
"""Less than half a degree of any joint: more than it gives way when power comes on."""
SOON_SAMPLES = 500
"""Of a job: by then the first of them must have come."""
INJECTED: list[list[Watched]] = []
"""The runs so far; the healthy one is looked at while it goes on."""


def judge_outcome(
    result: Mapping[str, Any], faults: Sequence[str], text: str, distance: Callable[[], Mapping[str, Any]]
) -> Iterator[str]:
    """An outcome, a cause, and no wrong friction."""
    code = result["exit_code"]
    if code not in (0, 3, 4, 5):
        yield f"exit code {code}"
    if code in (3, 4):
        causes = "|".join(CAUSES.get(fault.partition("@")[0], LINK) for fault in faults)
        if not re.search(causes, text):
            yield f"cause: {text}"
    if code == 0:
        percent = distance()["joints"][JOINT]["e_percent_measured_range"]
        if percent > LIMIT_PERCENT:
            yield f"{percent:.1f} % from the truth"


def judge_recording(watched: Watched, out: Path, *, code: int) -> Iterator[str]:
    """What moved is there, and is what happened."""
    # A stream tells of every tick. Of a job some 70 samples a second come while it runs, the rest afterwards, for which
    # a line that failed leaves no chance.
    jobs_to_fetch = len(watched.jobs) - (code == 3 and watched.lost_at_sample < SOON_SAMPLES)
    streamed = list(watched.truth_pulses.values())
    recorded = jobs_to_fetch > 0 or bool(streamed and max(streamed) - min(streamed) > MOVED_PULSES)
    path = out / "samples.mcap"
    kept = None
    with contextlib.suppress(InputFileError):  # what cannot be read counts as lost
        kept = read_mcap(path, JOINT)[0] if path.exists() and path.stat().st_size else None
    if kept is None or len(kept.time_ns) == 0:
        if recorded:
            yield "nothing was recorded"
        return
    axis = next(axis for axis, joint in zip(watched.emulator.axes, range(6), strict=True) if str(joint) == JOINT)
    measured = np.rint(kept.position_rad * axis.plate.pulses_per_rad)
    true = watched.true_pulses(kept.time_ns)
    wrong = sum(a != b for a, b in zip(measured, true, strict=True)) if len(true) == len(measured) else len(measured)
    if wrong:
        yield f"{wrong} of {len(measured)} samples are not what happened"


Phases = dict[str, tuple[Counter[str], Counter[str]]]
"""By name: how often every occasion had come at its begin, and at its end."""

# -- phases ------------------------------------------------------------------------------------------------------------


def phases_of(layer: str) -> tuple[Phases, float]:
    """Every phase of a healthy run, with the counts of all occasions at its begin and end; and how long it takes."""
    bounds: list[tuple[str, Counter[str]]] = [("open", Counter())]

    def told(event: Event) -> None:
        name = None
        if isinstance(event, PhaseStarted) and event.phase not in ("reference", "enable", "hold", "drift"):
            name = "power on" if event.phase == "configure" else event.phase
        elif isinstance(event, JobProgress) and event.share >= 1.0:
            name = "its transfer" if event.stage == "motion" else "power off"
        elif isinstance(event, Marked) and layer == "stream":
            name = "power off"
        if name is None:
            return
        if layer == "batch":
            # Job by job: the rehearsal, everything else, each with its transfer.
            name = {"reversal": "cycles"}.get(name, name)
        counted = Counter(INJECTED[-1][-1].emulator.faults.counted)
        if bounds[-1][0] == "power off":
            bounds.pop()
        bounds.append((name, counted))

    healthy = inject(layer, (), limit_s=1e9, told=told)
    if healthy.exit_code or healthy.wrong:
        raise SystemExit(f"{layer}: the healthy run fails: {healthy}")
    last = Counter(INJECTED[-1][-1].emulator.faults.counted)
    phases: Phases = {}
    for (name, begin), (_, end) in zip(bounds, [*bounds[1:], ("", last)], strict=True):
        name = f"{name} of the cycles" if name == "its transfer" and name in phases else name
        phases[name] = (phases[name][0] if name in phases else begin, end)
    return phases, healthy.seconds


def places(kind: str, begin: Counter[str], end: Counter[str], count: int) -> list[int]:
    """Where in a phase this kind of fault can strike."""
    occasion = OCCASIONS[kind.partition(" ")[0]]
    low, high = begin[occasion], end[occasion]
    count = min(count, high - low)
    return sorted({low + (high - low) * (2 * k + 1) // (2 * count) for k in range(count)})


@dataclass(frozen=True)
class Row:
    """One kind of fault over all phases of a layer."""

    cells: list[str]
    runs: int
    wrong: int


def row(layer: str, kind: str, phases: Phases, healthy_s: float, count: int) -> Row:
    """Let this kind strike at ``count`` places of every phase."""
    name, _, how = kind.partition(" ")
    cells, runs, wrong = [], 0, 0
    for phase, (begin, end) in phases.items():
        outcomes = []
        for at in places(kind, begin, end, count):
            fault = f"{name}@{at}{how}"
            outcome = inject(layer, [fault], limit_s=healthy_s + LATER_S, told=lambda event: None)
            outcomes.append("**WRONG**" if outcome.wrong else outcome.cell)
            runs += 1
            wrong += bool(outcome.wrong)
            if outcome.wrong:
                print(f"{layer} {phase} {fault}: {'; '.join(outcome.wrong)}", file=sys.stderr, flush=True)
            INJECTED.clear()
        cells.append(", ".join(dict.fromkeys(outcomes)) or "-")
    return Row(cells, runs, wrong)


ENDINGS = ["layer", "fault", "phase", "ending"]
TERMINALS = ["layer", "fault", "exit_code", "told", "samples_kept", "wall_s", "wrong"]


def in_virtual_time(
    layers: Sequence[str], kinds: Sequence[str], count: int, kept: Path | None
) -> tuple[list[list[str]], int, int]:
    """A row of ``ENDINGS`` for every fault and phase, how many runs it took, and how many of them were wrong."""
    known = json.loads(kept.read_text()) if kept is not None and kept.exists() else {}
    rows: list[list[str]] = []
    runs, wrong = 0, 0
    for layer in layers:
        phases, healthy_s = phases_of(layer)
        for kind in kinds:
            name = f"{layer} {kind} {count}"
            done = Row(**known[name]) if name in known else row(layer, kind, phases, healthy_s, count)
            known[name] = asdict(done)
            if kept is not None:
                kept.write_text(json.dumps(known, indent=1))
            runs, wrong = runs + done.runs, wrong + done.wrong
            if done.runs:
                rows += [[layer, kind, phase, cell] for phase, cell in zip(phases, done.cells, strict=True)]
                print(layer, kind, " | ".join(done.cells), flush=True)
    return rows, runs, wrong


# -- the same on a pseudo terminal -------------------------------------------------------------------------------------


def on_terminals() -> tuple[list[list[str]], int, int]:
    """Twenty of them, each ``frictid-hil emulate`` and ``frictid-hil calibrate`` as a person would start them."""
    rows: list[list[str]] = []
    for layer, faults in ON_TERMINALS.items():
        for fault in faults:
            with tempfile.TemporaryDirectory() as folder:
                cells, wrong = _on_terminal(layer, fault, Path(folder))
            rows.append([layer, fault, *cells, "; ".join(wrong)])
            print(" | ".join(rows[-1]), flush=True)
    return rows, len(rows), sum(bool(entry[-1]) for entry in rows)


def _on_terminal(layer: str, fault: str, folder: Path) -> tuple[list[str], list[str]]:
    robot, out = folder / "robot.yaml", folder / "run"
    robot.write_text(ROBOT.format(layer=layer))
    emulator = subprocess.Popen(
        ["frictid-hil", "emulate", "motoman", "--pty", "--robot", str(robot), "--fault", fault],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert emulator.stdout is not None
    try:
        port = emulator.stdout.readline().split()[-1]
        begun_s = time.monotonic()
        command = ["frictid-hil", "calibrate", "--robot", str(robot), "--bus", f"serial:{port}", "--joint", JOINT]
        done = subprocess.run(
            [*command, "--program", "quick", "--yes", "--json", "--out", str(out)],
            capture_output=True,
            text=True,
            timeout=400,
            check=False,
            env={**os.environ, "XDG_STATE_HOME": str(folder)},
        )
        took_s = time.monotonic() - begun_s
        standing = _stands(f"serial:{port}", robot) if emulator.poll() is None else True
    finally:
        emulator.terminate()
        emulator.communicate(timeout=10)
    try:
        result = json.loads(done.stdout)
    except ValueError:
        return [str(done.returncode), "", "", f"{took_s:.0f}"], [f"no JSON: {done.stderr[-200:]}"]
    error = result.get("error") or {}
    text = f"{error.get('what', '')} | {error.get('cause', '')}" if error else ""
    truth = load_robot(str(robot))
    result["exit_code"] = done.returncode
    wrong = list(judge_outcome(result, [fault], text, lambda: compare(out, None, str(truth.path))))
    if "Traceback" in done.stderr or "Traceback" in text:
        wrong.append("traceback")
    if not standing:
        wrong.append("does not stand")
    path = out / "samples.mcap"
    kept = len(read_mcap(path, JOINT)[0].time_ns) if path.exists() and path.stat().st_size else 0
    return [str(done.returncode), text.partition(" |")[0], str(kept), f"{took_s:.0f}"], wrong


def _stands(bus: str, robot: Path) -> bool:
    """Two looks through stock host control."""
    driver = MotomanDriver(load_robot(str(robot)).to_setup(bus))
    try:
        driver.open()
        before = [report.position_rad for report in driver.standing()]
        time.sleep(0.2)
        return bool(np.allclose(before, [report.position_rad for report in driver.standing()], atol=1e-4))
    except FrictidError:
        return True  # the port has gone with the fault; the emulated controller behind it is judged in virtual time
    finally:
        driver.close()


def counted(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """How often each ending or exit code came in each layer."""
    column = heads.index("ending" if "ending" in heads else "exit_code")
    endings = sorted({entry[column] for entry in rows} - {"", "-"})
    counts = Counter((entry[0], entry[column]) for entry in rows)
    lines = [f"| layer | {' | '.join(endings)} |", "|" + "---|" * (1 + len(endings))]
    for layer in dict.fromkeys(entry[0] for entry in rows):
        lines.append(f"| {layer} | {' | '.join(str(counts[layer, ending]) for ending in endings)} |")
    return "\n".join(lines)


def write(page: Path, name: str, how: str, heads: Sequence[str], rows: Sequence[Sequence[str]], told: str) -> None:
    """Every row into ``data/serial-NAME.csv``, the counts between this benchmark's two comments on the page."""
    table = page.parent / "data" / f"serial-{name}.csv"
    with table.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([heads, *rows])
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True).stdout
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    command = f"python benchmarks/serial_faults.py {how}"
    before, _, rest = page.read_text().partition(begin)
    _, _, after = rest.partition(end)
    text = f"`{command}` at commit {commit.strip()}: {told}. [Every one of them](data/{table.name}); in short:"
    page.write_text(f"{before}{begin}\n{text}\n\n{counted(heads, rows)}\n{end}{after}")


def main() -> int:
    """0 when nothing was wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=2, help="how many places per phase and kind")
    parser.add_argument("--layers", default="stream,batch", help="one of them")
    parser.add_argument("--kinds", default=",".join(KINDS), help="some of them, separated by commas")
    parser.add_argument("--kept", type=Path, help="rows that are there already, and where new ones go")
    parser.add_argument("--pty", action="store_true")
    parser.add_argument("--docs", type=Path, help="the page to write to; its table goes to data/ beside it")
    asked = parser.parse_args()
    if asked.pty:
        name, how, heads = "faults-pty", "--pty", TERMINALS
        rows, runs, bad = on_terminals()
    else:
        name, how, heads = "faults", f"--places {asked.places}", ENDINGS
        layers, kinds = asked.layers.split(","), asked.kinds.split(",")
        rows, runs, bad = in_virtual_time(layers, kinds, asked.places, asked.kept)
    told = f"{runs} runs, {bad} of them wrong"
    print(told)
    if asked.docs:
        write(asked.docs, name, how, heads, rows, told)
    return 0 if bad == 0 else 1


if __name__ == "__main__":
    sys.exit(main())
