"""Units proven by physics: what a wrong unit does to a recording, and the words that name it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_hil.config.columns import load_columns
from frictid_hil.errors import InputFileError
from frictid_hil.jobs.columns import columns
from frictid_hil.recording.proofs import doubts_of, velocity_factor
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Samples

TIME = np.arange(4000) * 0.005
POSITION = 0.8 * np.sin(1.5 * TIME) + 0.2 * np.sin(4.1 * TIME)
VELOCITY = 1.2 * np.cos(1.5 * TIME) + 0.82 * np.cos(4.1 * TIME)
ACCELERATION = -1.8 * np.sin(1.5 * TIME) - 3.362 * np.sin(4.1 * TIME)
NOISE = np.random.default_rng(3)
TORQUE = (
    0.4 * ACCELERATION
    + 2.0 * np.cos(POSITION)
    + 0.9 * np.tanh(VELOCITY / 0.02)
    + 0.1 * NOISE.standard_normal(TIME.size)
)


def samples(**changes: Any) -> Samples:
    scale = changes.pop("time", 1.0)
    columns = {"position_rad": POSITION, "velocity_rad_s": VELOCITY, "torque_nm": TORQUE, **changes}
    return Samples("0", np.rint(TIME * scale * 1e9).astype(np.int64), **columns)


def test_a_sound_recording_raises_no_doubt() -> None:
    assert doubts_of(samples()) == ()
    factor = velocity_factor(samples(), [slice(None)])
    assert factor is not None
    assert abs(factor[0] - 1.0) < 0.01


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"velocity_rad_s": np.rad2deg(VELOCITY)}, "velocity is in degrees"),
        ({"position_rad": np.rad2deg(POSITION)}, "the position is in degrees"),
        ({"velocity_rad_s": VELOCITY * 30 / np.pi}, "the velocity is in rpm"),
        ({"velocity_rad_s": -VELOCITY}, "opposite sign"),
        ({"time": 1e3}, "the time is in milliseconds"),
        ({"time": 1e3, "velocity_rad_s": np.rad2deg(VELOCITY)}, "milliseconds and the velocity in degrees"),
        ({"position_rad": POSITION / (2 * np.pi)}, "the position is in turns"),
    ],
)
def test_a_velocity_that_is_not_the_differenced_position_names_the_unit(changes: Any, words: str) -> None:
    with pytest.raises(InputFileError, match="times the differenced position") as caught:
        doubts_of(samples(**changes))
    assert words in caught.value.cause


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"torque_nm": -TORQUE}, "opposite sign (factor -1"),
        ({"torque_nm": np.abs(2.0 * np.tanh(VELOCITY / 0.02))}, "magnitude without its sign"),
        ({"time": 1e3, "velocity_rad_s": None}, "milliseconds taken for seconds (factor 1000)"),
        ({"position_rad": np.rad2deg(POSITION), "velocity_rad_s": None}, "degrees (factor 57.3)"),
        ({"velocity_rad_s": 51 * VELOCITY}, "another gear side"),
    ],
)
def test_what_is_odd_travels_as_a_doubt(changes: Any, words: str) -> None:
    assert words in " ".join(doubts_of(samples(**changes)))


def test_a_driven_joint_with_noise_is_not_called_negated() -> None:
    for seed in range(20):
        noise = np.random.default_rng(seed).standard_normal(TIME.size)
        assert doubts_of(samples(torque_nm=TORQUE + 3.0 * noise)) == ()
        assert doubts_of(samples(torque_nm=3.0 * noise)) == ()


def table(path: Path, header: str, *values: Any) -> Path:
    rows = ("; ".join(f"{value:.9g}".replace(".", ",") for value in row) for row in zip(*values, strict=True))
    path.write_text(header + "\n" + "\n".join(rows) + "\n")
    return path


def test_a_draft_reads_degrees_rpm_and_milliseconds_with_semicolons(tmp_path: Path) -> None:
    log = table(
        tmp_path / "log.csv",
        "Zeit; shoulder_pos; shoulder_vel; shoulder_torque [mNm]; shoulder_cmd",
        1e3 * TIME,
        np.rad2deg(POSITION),
        VELOCITY * 30 / np.pi,
        1e3 * TORQUE,
        np.rad2deg(np.roll(POSITION, -4)),
    )
    result = columns(log, out=tmp_path / "map.yaml")
    said = " ".join(result["findings"])
    assert "semicolons" in said and "decimal commas" in said
    assert "time: Zeit in ms" in said
    assert "velocity in rpm" in said
    lag = re.search(r"follows the command by ([\d.]+) ms", said)
    assert lag is not None and abs(float(lag[1]) - 20.0) < 2.0
    (shoulder,) = read(log, load_columns(tmp_path / "map.yaml"))
    assert np.allclose(shoulder.position_rad, POSITION, atol=1e-6)
    assert shoulder.velocity_rad_s is not None and np.allclose(shoulder.velocity_rad_s, VELOCITY, atol=1e-6)
    assert shoulder.torque_nm is not None and np.allclose(shoulder.torque_nm, TORQUE, atol=1e-6)
    assert result["joints"]["shoulder"]["doubts"] == []


def test_a_draft_asks_for_the_torque_constant_and_for_a_position(tmp_path: Path) -> None:
    log = table(tmp_path / "log.csv", "t; q1; i1; q2; i2", TIME, POSITION, TORQUE, -POSITION, -TORQUE)
    result = columns(log)
    assert "torque constant" in " ".join(result["findings"])
    assert "q2" in result["map"] and "torque_constant_nm_per_a" in result["map"]
    odd = table(tmp_path / "odd.csv", "t; a; b", TIME, POSITION, TORQUE)
    with pytest.raises(InputFileError, match="named like a position; the file has t, a, b"):
        columns(odd)
