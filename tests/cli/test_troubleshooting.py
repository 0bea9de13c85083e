"""Troubleshooting quotes what the program prints, and has the mistakes that people make."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from called import run

import frictid_drivers
import frictid_hil
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[2] / "docs" / "troubleshooting.md"


def quoted() -> list[str]:
    """The phrases in the first column of its tables."""
    rows = re.findall(r"^\| `(.+?)` \|", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return [row for row in rows if row != "Printed"]


def pieces(phrase: str) -> list[str]:
    """What stands between the places of names and numbers."""
    return [piece for piece in (part.strip(" ,;:") for part in phrase.split("...")) if piece]


def _texts(folder: Path) -> Iterator[str]:
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value
            elif isinstance(node, ast.JoinedStr):
                yield "".join(str(part.value) if isinstance(part, ast.Constant) else "\0" for part in node.values)


@cache
def printed() -> tuple[str, ...]:
    """Every text of the program, with a null character where a figure goes."""
    return tuple(text for package in (frictid_hil, frictid_drivers) for text in _texts(Path(package.__path__[0])))


def told_in(text: str, phrase: str) -> bool:
    """Whether all pieces of a phrase stand in a text, in order."""
    return re.search(".*?".join(map(re.escape, pieces(phrase))), text, re.DOTALL) is not None


def is_printed(phrase: str) -> bool:
    """Whether a text of the program holds the phrase, or is the phrase once its own places are filled."""
    if any(told_in(text, phrase) for text in printed()):
        return True
    parts = (text.split("\0") for text in printed() if len(text.replace("\0", "")) > 8)
    near = (one for one in parts if all(part in phrase for part in one))
    return any(re.fullmatch(".+".join(map(re.escape, one)), phrase) for one in near)


@pytest.mark.parametrize("phrase", quoted())
def test_a_phrase_of_the_page_is_one_of_the_program(phrase: str) -> None:
    assert is_printed(phrase)


@pytest.mark.parametrize("phrase", ["the bus is held by another process (exit 3)", "sign of friction is wrong"])
def test_a_phrase_that_is_none_would_be_noticed(phrase: str) -> None:
    assert len(quoted()) > 40
    assert not is_printed(phrase)


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with a robot, files with mistakes, and logs that lie."""
    values = load_robot("hp3j").values()
    values |= {"name": "bench", "bus": "virtual:trouble", "joints": {"0": values["joints"]["5"]}}
    text = dump(values)
    (tmp_path / "bench.yaml").write_text(text)
    (tmp_path / "key.yaml").write_text(text.replace("gear_ratio", "gear_ration"))
    (tmp_path / "degrees.yaml").write_text(re.sub(r"position_max_rad: \S+", "position_max_rad: 90", text))
    time = np.arange(0.0, 8.0, 0.005)
    position = 0.3 * np.sin(1.5 * time)
    velocity = np.gradient(position, 0.005)
    torque = 2.0 * np.sign(velocity) + 0.1 * velocity
    logs = {
        "fine": (time, position, velocity, torque),
        "milliseconds": (1e3 * time, position, velocity, torque),
        "degrees": (time, position, np.rad2deg(velocity), torque),
        "negated": (time, position, velocity, -torque),
        "one_way": (time, 0.2 * time, 0.2 + 0.0 * time, 2.0 + 0.0 * time),
        "still": (time, 0.0 * time, 0.0 * time, torque),
    }
    for name, columns in logs.items():
        rows = "".join(",".join(f"{value:.9g}" for value in row) + "\n" for row in zip(*columns, strict=True))
        (tmp_path / f"{name}.csv").write_text("time_s,position_rad,velocity_rad_s,torque_nm\n" + rows)
    (tmp_path / "word.csv").write_text("time_s,position_rad,torque_nm\n0,0,1\n1,x,2\n")
    (tmp_path / "foreign.csv").write_text("t;pos;tau\n0;0;1\n1;1;2\n")
    return tmp_path


MISTAKES = [
    "calibrate --robot no-such.yaml",
    "check --robot key.yaml",
    "calibrate --robot degrees.yaml --dry-run",
    "calibrate --robot bench.yaml --amplitude 20",
    "calibrate --robot bench.yaml",
    "calibrate --robot bench.yaml --joint 7 --dry-run",
    "calibrate --robot bench.yaml --amplitude 400deg --dry-run",
    "calibrate --robot bench.yaml --velocity 500deg/s --amplitude 60deg --dry-run",
    "calibrate --robot hp3j --joint 1 --amplitude 5deg --dry-run",
    "calibrate --resume no-such",
    "check --robot bench.yaml --bus can0",
    "check --robot hp3j --bus socketcan:nowhere7",
    "report no-such",
    "identify foreign.csv",
    "identify word.csv",
    "identify milliseconds.csv",
    "identify degrees.csv",
    "identify negated.csv",
    "identify one_way.csv",
    "identify still.csv",
    "identify fine.csv --velocity 115deg/s --amplitude 20deg",
    "identify fine.csv --columns no-such",
    "compensate --robot hp3j --joint 3 --task hand --yes --store store",
    "profile history nobody --store store",
    "recalibrate --robot hp3j --bus socketcan:nowhere7",
]


@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_a_mistake_prints_is_found_on_the_page(mistake: str, place: Path) -> None:
    ended = run(*mistake.split(), cwd=place, XDG_DATA_HOME=str(place / "data"))
    assert ended.returncode in (1, 2, 3), ended.stdout
    said = " ".join(ended.stderr.replace("│", " ").split())
    assert "Traceback" not in said
    assert any(told_in(said, phrase) for phrase in quoted()), said
