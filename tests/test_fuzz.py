"""Spoilt input of every kind that is read, as ``benchmarks/fuzz.py`` makes it."""

import importlib
import random
import sys
import zipfile
from pathlib import Path

import pytest

from frictid_hil.errors import InputFileError

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
fuzz = importlib.import_module("fuzz")

FILES = sorted(fuzz.files())


@pytest.mark.parametrize("name", sorted(fuzz.decoders()))
def test_a_thousand_spoilt_conversations(name):
    found = fuzz.tried(name, inputs=1000, seed=2)
    assert not found.finds and found.inputs == 1000


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_a_thousand_spoilt_files_or_those_of_four_seconds(name):
    found = fuzz.tried(name, inputs=1000, lasts_s=4.0, seed=3)
    assert not found.finds and found.inputs > 5
    assert found.refused < found.inputs, "what is good is read"


@pytest.mark.parametrize("name", FILES)
def test_what_the_fuzzer_begins_with_is_good(name):
    kind = fuzz.kinds()[name]()
    for seed in kind.seeds:
        kind.use(seed)


def test_what_is_no_error_of_ours_is_found_and_kept(monkeypatch):
    def use(data):
        if b"\xff" in data:
            raise ZeroDivisionError("by accident")
        raise InputFileError("refused")

    monkeypatch.setattr(fuzz, "kinds", lambda: {"pdo": lambda: fuzz.Kind((b"abc",), use)})
    found = fuzz.tried("pdo", inputs=3000)
    (told,) = found.finds
    assert told.startswith("ZeroDivisionError: by accident") and b"\xff" in found.finds[told]
    assert 0 < found.refused < 3000


def test_what_comes_to_a_new_line_is_spoilt_further(monkeypatch):
    """Behind two bytes that chance alone would have to guess at once."""
    from frictid_hil.units import parse_quantity

    def use(data):
        if data[:1] != b"q":
            raise InputFileError("refused")
        parse_quantity("1 rad", "angle")  # a line of ours, seen by the trace
        if data[1:2] == b"z":
            raise ZeroDivisionError("deep inside")
        raise InputFileError("refused later")

    monkeypatch.setattr(fuzz, "kinds", lambda: {"pdo": lambda: fuzz.Kind((b"abc",), use)})
    assert fuzz.tried("pdo", inputs=40_000, seed=4).finds
    monkeypatch.setattr(fuzz, "TRACED", 0)
    assert not fuzz.tried("pdo", inputs=40_000, seed=4).finds


def test_an_input_that_takes_too_long_is_a_find(monkeypatch):
    monkeypatch.setattr(fuzz, "LONGEST_S", 0.05)

    def use(data):
        while True:
            try:
                sum(range(1000))
            except Exception:  # no reader may swallow it
                continue

    found = fuzz.Found("slow")
    with_alarm = fuzz.signal.signal(fuzz.signal.SIGALRM, fuzz._too_slow)
    fuzz.one(fuzz.Kind((b"",), use), b"", found)
    fuzz.signal.signal(fuzz.signal.SIGALRM, with_alarm)
    assert [told.split(":")[0] for told in found.finds] == ["TooSlow"]


def test_spoiling_within_an_archive_leaves_an_archive():
    dice, whole = random.Random(1), 0
    for _ in range(50):
        data = fuzz.within_zip(fuzz.of_npz(), dice, b"")
        whole += zipfile.is_zipfile(fuzz.io.BytesIO(data))
    assert whole > 25
