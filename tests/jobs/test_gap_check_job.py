"""``gap check`` in a folder that holds the answers of an interrupted check."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from frictid_hil.blind import check
from frictid_hil.errors import UsageError
from frictid_hil.jobs import gap_check


class Interrupted(Exception):
    pass


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every check is interrupted after its first answer; drawing takes no time."""

    def drawn(world: str, cases: int, seed: int, folder: Path, *_: Any) -> check.Sealed:
        return check.Sealed(folder, {}, {}, hashlib.sha256(f"{world} {cases} {seed}".encode()).hexdigest())

    def answer_once(*arguments: Any) -> None:
        kept: check._Kept = arguments[-1]
        kept.add("diagnose", {"case": "case_000", "diagnosis": {}})
        raise Interrupted

    monkeypatch.setattr(check, "draw_sealed", drawn)
    monkeypatch.setattr(check, "_diagnosed", answer_once)


def begin(folder: Path, **asked: Any) -> int:
    """How many answers the folder holds when the check is interrupted."""
    with pytest.raises(Interrupted):
        gap_check.run_gap_check(1, out=folder, processes=1, **asked)
    return len((folder / "answers.jsonl").read_text().splitlines())


def test_answers_of_another_unfinished_check_are_not_dropped(interrupted: None, tmp_path: Path) -> None:
    assert begin(tmp_path, seed=1) == 1
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(UsageError, match="another unfinished check") as told:
        gap_check.run_gap_check(1, seed=2, out=tmp_path, processes=1)
    assert "answers.jsonl" in told.value.where and "--force" in told.value.next_step
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert begin(tmp_path, seed=1) == 2, "the same check goes on"
    assert begin(tmp_path, seed=2, force=True) == 1


def test_the_folder_of_a_check_tells_no_seed(interrupted: None, tmp_path: Path) -> None:
    begin(tmp_path, seed=1234567)
    assert not any("1234567" in path.read_text() for path in tmp_path.glob("*.*"))
    assert "seed" not in json.loads((tmp_path / "commitment.json").read_text())
