from __future__ import annotations

import math
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.config.write import dump
from frictid_hil.config.yaml import Place, merge, parse, read
from frictid_hil.errors import ConfigError, FieldProblem, FrictidError, InvalidFields
from frictid_hil.files import write_whole

HERE = Path("hp3j.yaml")


def refused(text: str) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        parse(text, HERE)
    return caught.value


def test_scalars_follow_the_core_schema_of_yaml_1_2() -> None:
    text = "a: 1e-3\nb: off\nc: 12:30\nd: 010\ne: 0x1F\nf: 1_000\ng: ~\nh: 'true'\ni: true\nj: .5\nk: 2026-11-21\n"
    assert parse(text, HERE).data == {
        "a": 0.001,
        "b": "off",
        "c": "12:30",
        "d": 10,
        "e": 31,
        "f": "1_000",
        "g": None,
        "h": "true",
        "i": True,
        "j": 0.5,
        "k": "2026-11-21",
    }


def test_keys_are_text_so_a_quoted_and_a_bare_joint_name_are_the_same() -> None:
    assert parse("joints: {0: a, null: b, 1.5: c}", HERE).data == {"joints": {"0": "a", "null": "b", "1.5": "c"}}
    assert "appears twice; first on line 2" in refused('joints:\n  0: a\n  "0": b\n').what


def test_a_duplicate_key_names_both_places() -> None:
    error = refused("a: 1\nb:\n  c: 1\n  d: 2\n  c: 3\n")
    assert error.where == "hp3j.yaml:5:3"
    assert "'c' appears twice; first on line 3" in error.what


def test_places_count_from_one() -> None:
    document = parse("joints:\n  '1':\n    viscous:   [1, x]\n", HERE)
    assert document.place(("joints", "1", "viscous", 1)) == Place(HERE, 3, 20)
    assert document.place(("joints", "1", "viscous"), of_key=True) == Place(HERE, 3, 5)
    assert document.place(("joints", "1", "gear_ratio")) == Place(HERE, 2, 3), "a missing key is its parent's fault"
    assert document.place(("nowhere", "at", "all")) == Place(HERE, 1, 1)


def test_all_problems_are_told_in_the_order_of_the_file() -> None:
    document = parse("a: 1\nb: 2\n", HERE)
    error = document.error([FieldProblem(("b",), "too large"), FieldProblem(("a",), "too small")])
    assert str(error) == "hp3j.yaml:1:4: a: too small\nhp3j.yaml:2:4: b: too large"


def test_problems_found_by_others_get_their_places() -> None:
    document = parse("joints:\n  '1':\n    simulated:\n      inertia_kg_m2: -1\n", HERE)
    with pytest.raises(ConfigError) as caught, document.locating(("joints", "1", "simulated")):
        raise InvalidFields([FieldProblem(("inertia_kg_m2",), "must be positive, found -1")])
    assert str(caught.value) == "hp3j.yaml:4:22: joints.1.simulated.inertia_kg_m2: must be positive, found -1"


@pytest.mark.parametrize(
    ("text", "where", "word"),
    [
        ("a:\n\tb: 1\n", "hp3j.yaml:2:1", "tab"),
        ("a: [1,\nb: }\n", "hp3j.yaml:2:4", "not valid YAML"),
        ("a: \x01\n", "hp3j.yaml:1:4", "control characters"),
        ("", "hp3j.yaml:1:1", "empty"),
        ("# only a comment\n", "hp3j.yaml:1:1", "empty"),
        ("- a\n- b\n", "hp3j.yaml:1:1", "a list"),
        ("just text\n", "hp3j.yaml:1:1", "'just text'"),
        ("a: 1\n---\nb: 2\n", "hp3j.yaml:2:1", "second document"),
        ("a: !!python/object:os.system x\n", "hp3j.yaml:1:4", "not"),
        ("a: !mine x\n", "hp3j.yaml:1:4", "tags"),
        ("? [a, b]\n: 1\n", "hp3j.yaml:1:3", "key must be plain text"),
        ("a: *nothing\n", "hp3j.yaml:1:4", "refers to nothing"),
        ("a: &x [1, *x]\n", "hp3j.yaml:1:11", "refers to nothing"),
        ("a: " + "[" * 50 + "]" * 50, "hp3j.yaml:1:44", "nested deeper"),
        ("n: " + "9" * 5000, "hp3j.yaml:1:4", "not a valid int"),
        ("n: !!int abc", "hp3j.yaml:1:4", "not a valid int"),
    ],
)
def test_broken_files_name_the_place(text: str, where: str, word: str) -> None:
    error = refused(text)
    assert (error.where, word in error.what) == (where, True), str(error)


def test_aliases_are_read_but_a_bomb_of_them_is_not() -> None:
    assert parse("a: &x {k: 1}\nb: *x\n", HERE).data == {"a": {"k": 1}, "b": {"k": 1}}
    bomb = "a0: &a0 [1,1,1,1,1,1,1,1,1,1]\n" + "".join(
        f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)
    )
    assert "more than" in refused(bomb).what


def test_a_huge_nest_is_refused_without_overflowing_the_stack() -> None:
    assert "nested deeper" in refused("[" * 200_000).what


def test_what_cannot_be_read_says_why(tmp_path: Path) -> None:
    latin = tmp_path / "latin.yaml"
    latin.write_bytes("a: 1\nb: 20°\n".encode("latin-1"))
    with pytest.raises(ConfigError, match=r"latin.yaml:2:6: not UTF-8: byte 0xb0"):
        read(latin)
    with pytest.raises(ConfigError, match="no such file"):
        read(tmp_path / "absent.yaml")
    with pytest.raises(ConfigError, match="folder"):
        read(tmp_path)
    with pytest.raises(ConfigError, match="larger than"):
        read(Path("/dev/zero"))
    utf16 = tmp_path / "utf16.yaml"
    utf16.write_text("a: 1\n", encoding="utf-16")
    with pytest.raises(ConfigError, match="not UTF-8"):
        read(utf16)


def test_no_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    secret = tmp_path / "secret.yaml"
    secret.write_text("a: 1\n")
    secret.chmod(0)
    if os.geteuid() == 0:  # root may read everything, so the refusal is acted out

        def denied(*_: object) -> None:
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr(Path, "open", denied)
    with pytest.raises(ConfigError, match="no permission"):
        read(secret)


def test_a_byte_order_mark_is_no_key(tmp_path: Path) -> None:
    path = tmp_path / "bom.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\n")
    assert read(path).data == {"a": 1}


def test_merge_replaces_lists_and_scalars_and_keeps_every_value_s_own_place() -> None:
    base = parse("a: 1\nm: {x: 1, y: [1, 2]}\n", Path("base.yaml")).root
    over = parse("\n\nm: {y: [3], z: 4}\n", Path("site.yaml")).root
    merged = merge(base, over)
    assert merged.plain() == {"a": 1, "m": {"x": 1, "y": [3], "z": 4}}
    assert str(merged.content["m"].content["x"].place) == "base.yaml:2:8"
    assert str(merged.content["m"].content["y"].place) == "site.yaml:3:8"


@settings(max_examples=300, deadline=None)
@given(st.text(alphabet=st.sampled_from("ab:-[]{}&*!|>'\"#\n\t ,0.1e?%@\x00é"), max_size=60))
def test_any_text_is_read_or_refused_with_a_place(text: str) -> None:
    try:
        document = parse(text, HERE)
    except ConfigError as error:
        assert error.where.startswith("hp3j.yaml")
    else:
        assert isinstance(document.data, dict)


numbers = st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(2**70), 2**70)
scalars = numbers | st.booleans() | st.none() | st.text(max_size=20).filter(lambda s: s.isprintable())
trees = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.from_regex(r"[a-z0-9_]{1,8}", fullmatch=True), inner)
    ),
    max_leaves=20,
)


@pytest.mark.slow
@settings(max_examples=80, deadline=None)
@given(st.dictionaries(st.from_regex(r"[a-z0-9_]{1,8}", fullmatch=True), trees))
def test_what_is_written_is_read_back_bit_for_bit(values: dict[str, object]) -> None:
    text = dump(values)
    assert repr(parse(text, HERE).data) == repr(values)
    assert dump(parse(text, HERE).data) == text


def test_writer_keeps_order_and_writes_a_curve_as_a_row() -> None:
    text = dump({"b": 1e-05, "a": [0.1, 1.0], "pairs": [[1, 2], [3, 4]], "deep": {"0": -0.0}})
    assert text == "b: 1.0e-05\na: [0.1, 1.0]\npairs: [[1, 2], [3, 4]]\ndeep:\n  '0': -0.0\n"


def test_writer_refuses_what_is_not_finite() -> None:
    with pytest.raises(ValueError, match="not a finite number"):
        dump({"a": math.nan})


def test_write_whole_replaces(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    write_whole(path, "old")
    write_whole(path, "new")
    assert path.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["a.yaml"], "nothing staged is left behind"


def test_write_whole_on_a_full_disk_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.yaml"
    write_whole(path, "old")

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(FrictidError, match="disk is full"):
        write_whole(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.yaml"]
