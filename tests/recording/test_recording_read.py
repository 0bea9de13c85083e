from __future__ import annotations

import os
import random
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.columns import ColumnMap, JointColumns, Source
from frictid_hil.config.columns import load_columns
from frictid_hil.errors import InputFileError
from frictid_hil.recording.csv import write_csv
from frictid_hil.recording.mat import read_numbers
from frictid_hil.recording.mcap import write_samples
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Mark, Samples

REAL = Path(os.environ.get("FRICTID_REAL_DATA", Path(__file__).parents[2].parent / "shared" / "data" / "real"))
real_data = pytest.mark.skipif(not REAL.is_dir(), reason="no real recordings (FRICTID_REAL_DATA)")

TIME = np.arange(50) * 1e-3
EMPS = {"t": TIME[:, None], "qm": np.sin(TIME)[:, None], "vir": np.cos(TIME)[:, None], "gtau": 35.15}
MAP = ColumnMap(
    "emps",
    Source(("t",), 1e9),
    {"axis": JointColumns({"position_rad": Source(("qm",)), "torque_nm": Source(("gtau", "vir"))}, prismatic=True)},
)


def mat(folder: Path, values: Mapping[str, object], **options: Any) -> Path:
    path = folder / "log.mat"
    scipy.io.savemat(path, values, **options)
    return path


def some(joint: str = "0", **changes: object) -> Samples:
    values: dict[str, object] = {
        "joint": joint,
        "time_ns": np.arange(50, dtype=np.int64) * 1_000_000,
        "position_rad": np.sin(TIME),
        "torque_nm": np.cos(TIME),
    }
    return Samples(**{**values, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize("compressed", [False, True])
def test_a_mat_file_through_a_column_map(tmp_path: Path, compressed: bool) -> None:
    (axis,) = read(mat(tmp_path, EMPS, do_compression=compressed), MAP)
    assert (axis.joint, axis.prismatic) == ("axis", True)
    assert axis.torque_nm is not None
    assert np.array_equal(axis.torque_nm, 35.15 * np.cos(TIME))
    assert axis.time_ns.tolist() == list(range(0, 50_000_000, 1_000_000))


def test_a_mat_file_under_our_own_names_structs_and_matrices(tmp_path: Path) -> None:
    own = {"time_s": TIME, "position_rad": np.sin(TIME), "torque_nm": np.cos(TIME), "text": "hello"}
    (joint,) = read(mat(tmp_path, own), joint="2")
    assert joint.joint == "2"
    nested = {"log": {"t": TIME, "q": np.column_stack([np.sin(TIME), np.cos(TIME)]), "u": TIME}}
    columns = ColumnMap(
        "nested",
        Source(("log.t",), 1e9),
        {"b": JointColumns({"position_rad": Source(("log.q",), index=1), "torque_nm": Source(("log.u",))})},
    )
    (b,) = read(mat(tmp_path, nested), columns)
    assert np.array_equal(b.position_rad, np.cos(TIME))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({**EMPS, "qm": np.sin(TIME)[:40, None]}, "qm has 40 values for 50 times"),
        ({**EMPS, "qm": np.where(TIME == 0.010, np.nan, TIME)}, "row 11: position_m is nan"),
        ({**EMPS, "vir": np.ones((50, 2))}, "variable vir is a matrix (50, 2)"),
        ({**EMPS, "vir": np.ones(7)}, "gtau * vir has 7 values for 50 times"),
        ({**EMPS, "vir": "text"}, "no numeric variable 'vir'"),
        ({"t": TIME}, "no numeric variable 'qm'; the file has t"),
        ({**EMPS, "t": TIME[::-1]}, "row 2: time does not increase"),
    ],
)
def test_mistakes_in_a_mat_file(tmp_path: Path, values: dict[str, object], words: str) -> None:
    with pytest.raises(InputFileError) as caught:
        read(mat(tmp_path, values), MAP)
    assert words in str(caught.value)


def test_mat_files_that_cannot_be_read(tmp_path: Path) -> None:
    path = tmp_path / "v73.mat"
    path.write_bytes(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512, b" ") + b"\x89HDF\r\n\x1a\n" + bytes(100))
    with pytest.raises(InputFileError, match=r"cannot be read|HDF5"):
        read(path, MAP)
    with pytest.raises(InputFileError, match="cannot be read"):
        read(tmp_path / "absent.mat", MAP)
    with pytest.raises(InputFileError, match="no columns time_s and position_rad"):
        read(mat(tmp_path, EMPS))


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32))
def test_a_damaged_mat_file_is_read_or_refused_never_worse(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    dice = random.Random(seed)
    path = mat(tmp_path_factory.mktemp("fuzz"), EMPS, do_compression=dice.random() < 0.5)
    data = bytearray(path.read_bytes())
    for _ in range(dice.randint(1, 4)):
        at = dice.randrange(dice.choice([300, len(data)]))
        data[at : at + dice.randint(1, 4)] = dice.randbytes(dice.randint(0, 4))
    path.write_bytes(data[: dice.choice([len(data), dice.randrange(len(data))])])
    try:
        read(path, MAP)
    except InputFileError as error:
        assert "log.mat" in error.where


def test_the_right_reader_is_found(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv.gz", some())
    write_samples(tmp_path / "a.mcap", [some("0"), some("1")])
    assert [s.joint for s in read(tmp_path / "a.csv.gz", joint="3")] == ["3"]
    assert [s.joint for s in read(str(tmp_path / "a.mcap"))] == ["0", "1"]
    assert [s.joint for s in read(mat(tmp_path, EMPS), MAP)] == ["axis"]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("bus.blf", "holds frames, not samples"),
        ("absent.txt2", "no such file"),
        ("odd.xyz", "not a recording of a known kind"),
    ],
)
def test_other_files_are_refused_with_a_way_out(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "odd.xyz").write_text("?")
    with pytest.raises(InputFileError, match=words):
        read(tmp_path / name)


def test_a_resumed_run_takes_each_joint_from_where_it_moved(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match=r"no samples.mcap"):
        read(tmp_path)
    moved = (Mark("cycles", 0, 40_000_000),)
    write_samples(tmp_path / "samples.mcap", [some("0", marks=moved), some("1")])
    write_samples(
        tmp_path / "samples-1.mcap", [some("0", position_rad=TIME), some("1", position_rad=TIME, marks=moved)]
    )
    zero, one = read(tmp_path)
    assert np.array_equal(zero.position_rad, np.sin(TIME))
    assert np.array_equal(one.position_rad, TIME)
    assert [s.joint for s in read(tmp_path, joint="1")] == ["1"]
    with pytest.raises(InputFileError, match="no samples of joint '7'; it has 0, 1"):
        read(tmp_path, joint="7")


@pytest.mark.slow
@real_data
@pytest.mark.real_data
@pytest.mark.parametrize(
    ("file", "columns", "joints", "rows", "step_s"),
    [
        ("emps/DATA_EMPS.mat", "emps.yaml", 1, 24_841, 1e-3),
        ("emps/DATA_EMPS_PULSES.mat", "emps.yaml", 1, 24_841, 1e-3),
        ("double_pendulum/a0_slow_75s.csv.gz", "double_pendulum_motor_log", 2, 21_969, 1 / 300),
        ("double_pendulum/c1_143339.csv.gz", "double_pendulum_controller_log", 2, 4_998, 2e-3),
        ("so101/multisine/state_motor.csv.gz", "so101", 6, 6_000, 0.02),
    ],
)
def test_shipped_column_maps_read_the_real_recordings(
    file: str, columns: str, joints: int, rows: int, step_s: float
) -> None:
    recordings = read(REAL / file, load_columns(columns))
    assert len(recordings) == joints
    for samples in recordings:
        assert len(samples) == rows
        assert samples.step_s == pytest.approx(step_s, rel=0.01)


@real_data
@pytest.mark.real_data
def test_emps_columns_are_force_and_position() -> None:
    (axis,) = read(REAL / "emps" / "DATA_EMPS.mat", load_columns("emps"))
    raw = scipy.io.loadmat(REAL / "emps" / "DATA_EMPS.mat")
    assert axis.prismatic and axis.torque_nm is not None
    assert np.array_equal(axis.torque_nm, raw["gtau"][0, 0] * raw["vir"].ravel())
    assert np.array_equal(axis.position_rad, raw["qm"].ravel())


@real_data
@pytest.mark.real_data
@pytest.mark.parametrize("name", ["DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"])
def test_our_reader_of_mat_files_agrees_with_scipy_s(name: str) -> None:
    path = REAL / "emps" / name
    ours = read_numbers(path.read_bytes())
    theirs = {key: value for key, value in scipy.io.loadmat(path).items() if not key.startswith("__")}
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        assert np.array_equal(ours[key], value)
