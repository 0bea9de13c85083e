"""Files and frames that were good until somebody spoilt them: read or refused, by every reader, never worse."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from frictid_hil.config.nominal import load_nominal
from frictid_hil.config.robot import load_robot
from frictid_hil.errors import FrictidError
from frictid_hil.recording.bus_log import BusLogWriter, read_frames
from frictid_hil.recording.csv import write_csv
from frictid_hil.recording.mcap import write_samples
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Samples

EXAMPLES = 40
SLOWLY = settings(
    max_examples=EXAMPLES,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
EDIT = st.tuples(
    st.sampled_from(["flip", "cut", "drop", "twice", "number", "word"]),
    st.floats(0.0, 1.0, exclude_max=True),
    st.integers(0, 2**32 - 1),
)
WORDS = (
    b"nan",
    b"inf",
    b"1e999",
    b"\xff\xfe",
    b"\0" * 8,
    b"[" * 500,
    b"&a [*a]",
    b"!!python/object:os.system",
    b"../..",
)


def spoilt(data: bytes, edits: list[tuple[str, float, int]]) -> bytes:
    """The same file after a few edits, each somewhere in it."""
    for kind, share, number in edits:
        at = int(share * len(data))
        if kind == "flip" and data:
            data = data[:at] + bytes([data[at] ^ (number % 255 + 1)]) + data[at + 1 :]
        elif kind == "cut":
            data = data[:at]
        elif kind == "drop":
            data = data[:at] + data[at + number % 64 + 1 :]
        elif kind == "twice":
            data = data[:at] + data[max(0, at - number % 256) : at] + data[at:]
        elif kind == "number":
            data = data[:at] + struct.pack("<I", number) + data[at + 4 :]
        elif kind == "word":
            data = data[:at] + WORDS[number % len(WORDS)] + data[at:]
    return data


def samples() -> Samples:
    time_ns = np.arange(40, dtype=np.int64) * 1_000_000
    wave = np.sin(time_ns * 1e-7)
    return Samples("1", time_ns, wave, velocity_rad_s=wave, torque_nm=2 * wave, position_command_rad=wave)


def csv(path: Path) -> None:
    write_csv(path, samples())


def mcap(path: Path) -> None:
    write_samples(path, [samples()])


def mat(path: Path) -> None:
    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)

    matrices = [
        element(6, struct.pack("<II", 6, 0))
        + element(5, struct.pack("<ii", 40, 1))
        + element(1, name)
        + element(9, np.linspace(0.0, 1.0, 40).tobytes())
        for name in (b"time_s", b"position_rad", b"torque_nm")
    ]
    head = b"MATLAB 5.0".ljust(116) + bytes(8) + b"\0\x01IM"
    path.write_bytes(head + b"".join(element(14, matrix) for matrix in matrices))


def blf(path: Path) -> None:
    with BusLogWriter(path) as log:
        for n in range(20):
            log.frame(n * 1_000_000, 0x181, bytes([n] * 8), sent=False)


def asc(path: Path) -> None:
    lines = "".join(f"   {n * 1e-3:.6f} 1 181 Rx d 8 00 01 02 03 04 05 06 07\n" for n in range(20))
    path.write_text("date Mon Jan 1 00:00:00 2024\nbase hex timestamps absolute\n" + lines)


def candump(path: Path) -> None:
    path.write_text("".join(f"({n * 1e-3:.6f}) can0 181#0001020304050607\n" for n in range(20)))


def robot(path: Path) -> None:
    path.write_text(
        "schema: frictid.robot/1\nextends: hp3j.yaml\nname: x\njoints: {'0': null, '1': {max_torque_nm: 9}}\n"
    )


def nominal(path: Path) -> None:
    path.write_text("schema: frictid.nominal/1\njoint: '1'\ninertia_kg_m2: 0.5\nfriction: {coulomb_nm: 3.0}\n")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "written", "opened"),
    [
        ("a.csv", csv, read),
        ("a.csv.gz", csv, read),
        ("a.mcap", mcap, read),
        ("a.mat", mat, read),
        ("a.blf", blf, read_frames),
        ("a.asc", asc, read_frames),
        ("a.log", candump, read_frames),
        ("robot.yaml", robot, load_robot),
        ("nominal.yaml", nominal, load_nominal),
    ],
)
def test_a_spoilt_file_is_read_or_refused(
    name: str, written: Callable[[Path], None], opened: Callable[[Path], object], tmp_path: Path
) -> None:
    path = tmp_path / name
    written(path)
    whole = path.read_bytes()

    @SLOWLY
    @given(st.lists(EDIT, max_size=6))
    def check(edits: list[tuple[str, float, int]]) -> None:
        path.write_bytes(spoilt(whole, edits))
        try:
            opened(path)
        except FrictidError as error:
            assert str(error)

    check()
