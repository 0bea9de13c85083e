from __future__ import annotations

import gzip
import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.columns import ColumnMap, JointColumns, Source
from frictid_hil.errors import FrictidError, InputFileError
from frictid_hil.recording import bounds
from frictid_hil.recording.csv import CsvTable, read_csv, write_csv
from frictid_hil.recording.draft import draft
from frictid_hil.recording.samples import Samples

HEADER = "time_s,position_rad,velocity_rad_s,torque_nm,position_command_rad\n"
ROWS = "0.000,0.1,0.0,8.5,0.1\n0.002,0.2,1.5,8.6,0.2\n0.004,0.3,1.4,-8.7,0.3\n"


def written(folder: Path, text: str, name: str = "log.csv") -> Path:
    path = folder / name
    raw = text.encode()
    path.write_bytes(gzip.compress(raw) if name.endswith(".gz") else raw)
    return path


def refused(path: Path) -> str:
    with pytest.raises(InputFileError) as caught:
        read_csv(path)
    return str(caught.value)


def test_the_standard_header(tmp_path: Path) -> None:
    for name in ("log.csv", "log.csv.gz"):
        (samples,) = read_csv(written(tmp_path, HEADER + ROWS, name))
        assert samples.joint == "0"
        assert samples.time_ns.tolist() == [0, 2_000_000, 4_000_000]
        assert samples.torque_nm is not None
        assert samples.torque_nm.tolist() == [8.5, 8.6, -8.7]
        assert samples.temperature_c is None


@pytest.mark.parametrize("name", ["log.csv", "log.csv.gz"])
@pytest.mark.parametrize("prismatic", [False, True])
def test_what_is_written_is_read_to_the_last_bit(tmp_path: Path, name: str, prismatic: bool) -> None:
    rng = np.random.default_rng(1)
    columns: dict[str, Any] = {}
    for column in Samples.COLUMNS:
        columns[column] = rng.standard_normal(200) * 10.0 ** rng.integers(-9, 9)
    columns["temperature_c"][3] = np.nan
    time_ns = np.cumsum(rng.integers(1, 5_000_000, 200)).astype(np.int64)
    original = Samples("0", time_ns, prismatic=prismatic, **columns)
    write_csv(tmp_path / name, original)
    (read,) = read_csv(tmp_path / name)
    assert read.prismatic == prismatic
    assert np.array_equal(read.time_ns, time_ns)
    for column, values in columns.items():
        assert np.array_equal(read.columns()[column], values, equal_nan=True), column
    first = (tmp_path / name).read_bytes()
    write_csv(tmp_path / name, read)
    assert (tmp_path / name).read_bytes() == first


def test_optional_columns_comments_blank_lines_and_quotes(tmp_path: Path) -> None:
    header = '# made by hand\n\n"time_s", position_command_rad ,position_rad,note\r\n'
    text = header + '0,1,2,3\r\n\r\n# half\r\n"0.5",1,2,3\r\n'
    (samples,) = read_csv(written(tmp_path, "\ufeff" + text))
    assert samples.torque_nm is None
    assert samples.time_ns.tolist() == [0, 500_000_000]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file is empty"),
        ("\n\n", "the file is empty"),
        (ROWS, "no header: the first line holds numbers"),
        (HEADER, "0 rows of samples"),
        (HEADER + "0,1,2,3,4\n", "1 rows of samples"),
        (HEADER.replace("time_s", "t") + ROWS, "no column time_s"),
        (HEADER.replace("position_rad", "position_deg", 1) + ROWS, "unknown column 'position_deg'; did you mean"),
        (HEADER.replace("torque_nm", "Torque_Nm") + ROWS, "unknown column 'Torque_Nm'; did you mean torque_nm?"),
        (HEADER.replace("torque_nm", "time_s") + ROWS, "column 'time_s' appears twice"),
        ("time_s,position_rad,velocity_rad_s\n0,1,2\n1,2,3\n", "neither torque_nm nor position_command_rad"),
        ("time_s,position_m,torque_nm\n0,1,2\n1,2,3\n", "did you mean"),
        (HEADER + ROWS.replace("8.6", "fast"), "line 3, column torque_nm: 'fast' is not a number"),
        (HEADER + ROWS.replace("8.6", ""), "line 3, column torque_nm: blank"),
        (HEADER + ROWS.replace("8.6", "nan"), "line 3: torque_nm is nan"),
        (HEADER + ROWS.replace("8.6", "inf"), "line 3: torque_nm is inf"),
        (HEADER + "\n# gap\n" + ROWS.replace("8.6", "nan"), "line 5: torque_nm is nan"),
        (HEADER + ROWS.replace("8.6", "8,6"), "line 3"),
        (HEADER + ROWS.replace("0.004", "0.001"), "line 4: time does not increase"),
        (HEADER + ROWS.replace("0.004", "0.002"), "line 4: time does not increase"),
        (HEADER + ROWS.replace("0.002", "nan"), "line 3: time is nan"),
        (HEADER + ROWS.replace("0.004", "1e300"), "out of range"),
        (HEADER + ROWS[:-9], "line 4 has 4 values where the header has 5"),
    ],
)
def test_mistakes_name_the_line_and_the_column(tmp_path: Path, text: str, words: str) -> None:
    message = refused(written(tmp_path, text))
    assert words in message
    assert "log.csv" in message


def test_a_line_with_an_extra_comma_is_not_read_as_something_else(tmp_path: Path) -> None:
    text = HEADER + ROWS.replace("0.2,1.5,8.6,0.2", "0.2,1.5,8,6,0.2")
    message = refused(written(tmp_path, text))
    assert "line 3 has 6 values where the header has 5" in message


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    assert "No such file" in refused(tmp_path / "absent.csv")
    whole = gzip.compress((HEADER + ROWS * 50).encode())
    (tmp_path / "cut.csv.gz").write_bytes(whole[:-20])
    assert "cannot be read" in refused(tmp_path / "cut.csv.gz")
    (tmp_path / "no.csv.gz").write_bytes(b"not gzip at all")
    assert "cannot be read" in refused(tmp_path / "no.csv.gz")
    (tmp_path / "latin.csv").write_bytes((HEADER + ROWS).encode() + b"0.006,\xb0,1,1,1\n")
    assert "line 5, column position_rad: '°' is not a number" in refused(tmp_path / "latin.csv")
    (tmp_path / "binary.csv").write_bytes(b"\x00\xff\xfe" + (HEADER + ROWS).encode())
    assert "not UTF-8" in refused(tmp_path / "binary.csv")


def test_a_title_above_the_header_and_a_western_text_are_passed_over_and_told(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    path.write_bytes(
        f"Messung, Prüfstand 2\n# 3. Mai\nPrüfer;M. Muster\n{(HEADER + ROWS).replace(',', ';')}".encode("cp1252")
    )
    (samples,) = read_csv(path)
    plain = tmp_path / "plain.csv"
    plain.write_text(HEADER + ROWS)
    assert samples.columns()["torque_nm"].tolist() == read_csv(plain)[0].columns()["torque_nm"].tolist()
    told = " ".join(samples.meta["told"])
    assert "the header is line 4" in told and "Windows-1252" in told and "semicolons" in told
    path.write_text(path.read_text(encoding="cp1252").replace("8.6", "fast"), encoding="cp1252")
    assert "line 6, column torque_nm: 'fast' is not a number" in refused(path)


def test_a_row_of_units_under_the_names_says_the_units(tmp_path: Path) -> None:
    rows = "".join(f"{k},0;{10 * k},5;{100 / 60};{-k % 7}\n".replace(".", ",") for k in range(60))
    table = CsvTable(written(tmp_path, f"Prüfstand 2\nZeit;Winkel;Drehzahl;Moment\nms;°;1/min;Nm\n{rows}"))
    assert table.names == ["Zeit [ms]", "Winkel [°]", "Drehzahl [1/min]", "Moment [Nm]"]
    assert "line 3 holds the units" in " ".join(table.told)
    joint = draft(table, "bench").document["joints"]["0"]
    assert {key: source["unit"] for key, source in joint.items()} == {
        "position": "deg", "velocity": "rpm", "torque": "N m",
    }  # fmt: skip
    assert table.numbers(["Winkel [°]"])[0][:3].tolist() == [0.5, 10.5, 20.5]


def test_a_row_of_units_may_repeat_the_standard_header_and_not_contradict_it(tmp_path: Path) -> None:
    (samples,) = read_csv(written(tmp_path, f"{HEADER}s,rad,rad/s,Nm,rad\n{ROWS}"))
    assert samples.columns()["torque_nm"].tolist() == [8.5, 8.6, -8.7]
    assert "time_s [ms]" in refused(written(tmp_path, f"{HEADER}ms,rad,rad/s,Nm,rad\n{ROWS}"))


def test_too_many_rows_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bounds, "MAX_ROWS", 2)
    assert "more than 2 rows" in refused(written(tmp_path, HEADER + ROWS))


def test_times_of_day_become_run_time(tmp_path: Path) -> None:
    (samples,) = read_csv(written(tmp_path, HEADER + "1700000000.5,1,2,3,4\n1700000000.75,1,2,3,4\n"))
    assert samples.time_ns.tolist() == [0, 250_000_000]


def test_a_full_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (samples,) = read_csv(written(tmp_path, HEADER + ROWS))

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(FrictidError, match="disk is full"):
        write_csv(tmp_path / "out.csv", samples)
    assert not (tmp_path / "out.csv").exists()


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(st.integers(0, 2**32), st.sampled_from(["log.csv", "log.csv.gz"]))
def test_a_damaged_file_is_read_or_refused_never_worse(
    tmp_path_factory: pytest.TempPathFactory, seed: int, name: str
) -> None:
    dice = random.Random(seed)
    path = written(tmp_path_factory.mktemp("fuzz"), HEADER + ROWS, name)
    data = bytearray(path.read_bytes())
    for _ in range(dice.randint(1, 4)):
        at = dice.randrange(len(data))
        data[at : at + dice.randint(0, 4)] = dice.choice([dice.randbytes(dice.randint(0, 4)), b',"\n;#'])
    path.write_bytes(data[: dice.choice([len(data), dice.randrange(len(data))])])
    try:
        read_csv(path)
    except InputFileError as error:
        assert "log.csv" in error.where


@pytest.mark.slow
@settings(max_examples=100, deadline=None)
@given(st.text(alphabet=st.sampled_from('01.,eE+-_ "\n\r#nai\x00\t;é'), max_size=60))
def test_any_rows_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, rows: str) -> None:
    path = written(tmp_path_factory.mktemp("fuzz"), HEADER + rows)
    try:
        read_csv(path)
    except InputFileError as error:
        assert "log.csv" in error.where


MAP = ColumnMap(
    "lists",
    Source(("stamp",), 1e3),
    {
        "a": JointColumns({"position_rad": Source(("q",), index=0), "torque_nm": Source(("u", "gain"), scale=-1.0)}),
        "b": JointColumns(
            {"position_rad": Source(("q",), index=1), "position_command_rad": Source(("c",), index=1, file="c.csv")},
            meta={"machine": "M"},
        ),
    },
)
MAPPED = 'stamp,q,u,gain\n0.5,"[1.0, 2.0]",3.0,2.0\n1000.5,"[1.5 2.5]",4.0,2.0\n'


def test_a_column_map_reads_products_lists_and_companions(tmp_path: Path) -> None:
    path = written(tmp_path, MAPPED)
    written(tmp_path, 'stamp,c\n0.5,"(7, 8)"\n1000.5,"(9, 10)"\n', "c.csv.gz")
    a, b = read_csv(path, MAP)
    assert a.torque_nm is not None and b.position_command_rad is not None
    assert a.time_ns.tolist() == [500, 1_000_500]
    assert (a.position_rad.tolist(), a.torque_nm.tolist()) == ([1.0, 1.5], [-6.0, -8.0])
    assert (b.position_rad.tolist(), b.position_command_rad.tolist()) == ([2.0, 2.5], [8.0, 10.0])
    assert b.meta == {"machine": "M"}
    assert [s.joint for s in read_csv(path, MAP, "b")] == ["b"]


def test_what_does_not_fit_a_column_map(tmp_path: Path) -> None:
    path = written(tmp_path, MAPPED)

    def message(joint: str | None = None) -> str:
        with pytest.raises(InputFileError) as caught:
            read_csv(path, MAP, joint)
        return str(caught.value)

    assert "knows no joint 'z'; it has a, b" in message("z")
    assert "its companion c.csv is not beside it" in message()
    written(tmp_path, 'stamp,c\n0.5,"(7, 8)"\n1001.5,"(9, 10)"\n', "c.csv")
    assert "its rows (2) are not at the times of log.csv" in message()
    path = written(tmp_path, MAPPED.replace(" 2.0]", "]"))
    assert "line 2, column q: no value number 1 in '[1.0,]'" in message("b")
    path = written(tmp_path, MAPPED.replace("gain", "amplification"))
    assert "no column 'gain'; the file has stamp, q, u, amplification" in message("a")
