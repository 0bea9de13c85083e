"""Every command of the guides: all are understood by the command line, and all that can run here do run.

The slow tests lay out a folder as the guide's reader has it - a small simulated robot, a run, logs - and type each
command of the guide there, in order. What they do not run, and why, stands in ``RUN_ELSEWHERE``.
"""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import typer
from called import run

from frictid_hil.cli.app import app
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.recording.read import read

pytestmark = pytest.mark.slow

DOCS = Path(__file__).parents[2] / "docs"
PAGES = [DOCS / "index.md", *sorted((DOCS / "guides").glob("*.md"))]

RUN_ELSEWHERE = {
    "--realtime": "takes minutes of the clock; tests of the wall clock run it",
    "calibrate --robot hp3j.yaml --yes --out first-run": "the README's first command, which the check runs",
    "calibrate --robot hp3j-arm.yaml --together --yes": "the tests of moving together",
    "calibrate --robot improved.yaml": "the tests of improved joints",
    "gap record": "the README's commands, which the check runs",
    "gap diagnose --model": "the tests of your own simulator",
    "emulate": "runs until it is stopped; the tests of the serial line",
    "--bus serial:PORT": "the tests of the serial line",
    "dashboard": "runs until it is stopped; its own tests",
    "new driver": "the tests of the template",
    "replay log.asc": "the tests of foreign bus logs",
    "BAG": "the tests of foreign logs",
    "DATA_EMPS": "needs recordings that others publish; the tests that have them",
    "--drive-mode position": "the tests of compensated servos",
    "--read": "needs drives; tests with drives on a bench in memory",
}


def commands(page: Path) -> list[str]:
    """What a page asks to be typed: lines of its code blocks, fenced or indented, without remarks."""
    outside, *fenced = re.split(r"^```", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    blocks = [outside, *(text.partition("\n")[2] for text in fenced[1::2])]
    blocks = [line for block in blocks for line in re.findall(r"^ {4,}(\S.*)$", block, re.MULTILINE)]
    blocks += [block.removeprefix("sh\n").removeprefix("\n") for block in fenced[::2]]
    lines = (line.split("  #")[0].strip() for block in blocks for line in block.splitlines())
    return [line.removeprefix("frictid-hil ") for line in lines if line.startswith("frictid-hil ")]


def mentions(page: Path) -> list[str]:
    """Commands in running text that are more than a verb's name."""
    text = page.read_text(encoding="utf-8")
    verbs = "check|calibrate|identify|compare|compensate|replay|recalibrate|schedule|columns|report|profile|gap|new"
    found = re.findall(rf"`(?:frictid-hil )?((?:{verbs}) [^`\n]*)`", text)
    return [one for one in found if " --" in one and "..." not in one]


def understood(command: str) -> None:
    """Parse a command as the command line does, and run nothing."""
    verb = typer.main.get_command(app)
    context = typer.Context(verb, info_name="frictid-hil")
    words = shlex.split(command)
    while hasattr(verb, "get_command"):
        name, verb = words[0], verb.get_command(context, words[0])
        assert verb is not None, f"no verb {name}"
        words = words[1:]
    verb.make_context(command, words, parent=context)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_of_a_page_is_one(page: Path) -> None:
    for command in [*commands(page), *mentions(page)]:
        try:
            understood(command)
        except Exception as error:
            message = error.format_message() if hasattr(error, "format_message") else str(error)
            shortened = command in mentions(page) and ("Missing" in message or "requires an argument" in message)
            assert shortened, f"{command}: {message}"


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ("calibrate --robbot hp3j.yaml", "No such option: --robbot"),
        ("profile shwo x", "no verb shwo"),
        ("calibrate --amplitude 20", "'20' has no unit"),
        ("identify", "Missing parameter"),
    ],
)
def test_a_command_that_is_none_would_be_noticed(wrong: str, why: str) -> None:
    # Typer's usage errors have no public name; their words tell them apart.
    with pytest.raises(Exception, match=why):
        understood(wrong)


# -- what a reader has ---------------------------------------------------------------------------------------------


def small_robot(folder: Path, name: str, joints: dict[str, str], *, whole: bool = False) -> None:
    """A robot file of joints of the shipped robot, without warm-up, and with a short procedure or the whole one."""
    values = load_robot("hp3j").values()
    kept = {ours: values["joints"][theirs] for ours, theirs in joints.items()}
    values |= {"name": name, "bus": f"virtual:guides-{name}", "joints": kept, "policy": {"warm_up": {"fixed_s": 0.0}}}
    if not whole:
        values["procedure"] |= {"amplitude_rad": 0.2, "velocity_rad_s": 1.5, "cycles": 3}
    (folder / f"{name}.yaml").write_text(dump(values))


def ran(folder: Path, robot: str, out: str) -> Path:
    """A calibration of that robot."""
    done = run("calibrate", "--robot", robot, "--yes", "--out", out, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder / out


def own_logs(folder: Path) -> None:
    """The cycles of a joint twice: under our names, and as a logger writes them whose text is not even UTF-8."""
    small_robot(folder, "small", {"0": "3"}, whole=True)
    (samples,) = read(ran(folder, "small.yaml", "run"))
    mark = next(mark for mark in samples.marks if mark.name == "cycles")
    kept = np.flatnonzero((samples.time_ns >= mark.start_ns) & (samples.time_ns < mark.end_ns))[::2]
    names = ("position_rad", "velocity_rad_s", "torque_nm", "position_command_rad")
    seconds = (samples.time_ns[kept] - samples.time_ns[kept[0]]) * 1e-9
    rows = np.column_stack([seconds, *(samples.columns()[name][kept] for name in names)])
    plain = ",".join(("time_s", *names)) + "\n" + "".join(",".join(map(repr, row)) + "\n" for row in rows.tolist())
    (folder / "plain.csv").write_text(plain)
    degrees, rpm = 180.0 / np.pi, 30.0 / np.pi
    foreign = "Prüfstand 2\nZeit [ms];Winkel [°];Drehzahl [1/min];Moment [Nm];Soll [°]\n"
    for row in rows * (1e3, degrees, rpm, 1.0, degrees):
        foreign += ";".join(f"{value:.5f}" for value in row).replace(".", ",") + "\n"
    (folder / "log.csv").write_bytes(foreign.encode("cp1252"))


def calibrating(folder: Path) -> None:
    small_robot(folder, "my-arm", {"0": "5"})
    first = ran(folder, "my-arm.yaml", "runs/monday")
    shutil.copytree(first, folder / "logs" / "tuesday")
    cut = folder / "runs" / "hp3j" / "20261122T120000Z-calibrate"
    shutil.copytree(first, cut)


def compensating(folder: Path) -> None:
    small_robot(folder, "hp3j", {"3": "3"})
    shutil.copy(ran(folder, "hp3j.yaml", "run") / "profile.yaml", folder / "profile.yaml")


def connecting(folder: Path) -> None:
    (block,) = re.findall(r"```yaml\n(.*?)```", (DOCS / "guides" / "connect-a-drive.md").read_text(), re.DOTALL)
    simulated = block.replace("driver: cia402", "driver: virtual").replace("socketcan:can0", "virtual:guides-connect")
    (folder / "my-arm.yaml").write_text(simulated)


def recalibrating(folder: Path) -> None:
    small_robot(folder, "bench", {"elbow": "5"})


def replaying(folder: Path) -> None:
    small_robot(folder, "hp3j", {"5": "5"})
    ran(folder, "hp3j.yaml", "first-run")


def writing_a_robot_file(folder: Path) -> None:
    by_hand, *_ = re.findall(r"```yaml\n(.*?)```", (DOCS / "guides" / "robot-file.md").read_text(), re.DOTALL)
    simulated = by_hand.replace("driver: cia402", "driver: virtual").replace("socketcan:can0", "virtual:guides-bench")
    (folder / "bench.yaml").write_text(simulated)


def diagnosing(folder: Path) -> None:
    own_logs(folder)
    (folder / "joint-1").mkdir()
    for name in ("walk.csv", "moves.csv"):
        shutil.copy(folder / "log.csv", folder / name)
    for name in ("sines.csv", "more.csv"):
        shutil.copy(folder / "plain.csv", folder / "joint-1" / name)
    (folder / "joint-1" / "nominal.yaml").write_text(
        "joint: {inertia_kg_m2: 0.065, friction: {coulomb_nm: 1.5, viscous_nm_s_per_rad: 0.9}}\n"
        "experiments:\n"
        "- {name: sines, file: sines.csv, role: identification}\n"
        "- {name: more, file: more.csv, role: validation}\n"
    )
    told = run("columns", "walk.csv", "--out", "mylog.yaml", cwd=folder)
    assert told.returncode == 0, told.stderr


READERS: dict[str, Callable[[Path], None]] = {
    "calibrate": calibrating,
    "compensate": compensating,
    "connect-a-drive": connecting,
    "diagnose": diagnosing,
    "recalibrate": recalibrating,
    "replay": replaying,
    "robot-file": writing_a_robot_file,
    "together": lambda folder: None,
    "your-own-log": own_logs,
}


def typed(command: str) -> list[str]:
    """The words of a command, with the yes of a person who is not there and no more than a few seconds of motion."""
    words = shlex.split(command)
    if words[0] in ("calibrate", "compensate") and not {"--dry-run", "--yes"} & set(words):
        words.append("--yes")
    if words[0] == "calibrate" and not {"--dry-run", "--resume"} & set(words):
        words += ["--cycles", "2"]
    if words[0] == "compensate" and "--dry-run" not in words:
        words += ["--duration", "2s"]
    return words


@pytest.mark.slow
@pytest.mark.parametrize("guide", sorted(READERS))
def test_the_commands_of_a_guide_run(guide: str, tmp_path: Path) -> None:
    READERS[guide](tmp_path)
    home = {"XDG_DATA_HOME": str(tmp_path / "data"), "XDG_CONFIG_HOME": str(tmp_path / "config")}
    here = [
        one for one in commands(DOCS / "guides" / f"{guide}.md") if not any(other in one for other in RUN_ELSEWHERE)
    ]
    assert here
    for command in here:
        ended = run(*typed(command), cwd=tmp_path, **home)
        assert ended.returncode == 0, f"frictid-hil {command}\n{ended.stdout}\n{ended.stderr}"


def test_every_guide_with_commands_has_a_reader() -> None:
    for page in PAGES:
        here = [one for one in commands(page) if not any(other in one for other in RUN_ELSEWHERE)]
        assert not here or page.stem in READERS, f"{page.name}: {here}"
