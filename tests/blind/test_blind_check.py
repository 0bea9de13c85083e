"""The blind check end to end with a scripted diagnosis: the seal holds, crashes are counted, runs repeat."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path

import pytest

from frictid_hil.blind.check import run_check
from frictid_hil.errors import UsageError
from frictid_hil.jobs.gap_check import run_gap_check

# Answers "stribeck, sure" to everything, dies on case_001, and reports every file it could see from where it stands.
SCRIPT = """
import json, os, pathlib, sys
for line in sys.stdin:
    request = json.loads(line)
    if request["case"] == "case_001":
        os._exit(7)
    here = pathlib.Path.cwd()
    seen = sorted(str(p.relative_to(here.parent)) for p in here.parent.rglob("*") if p.is_file())
    effect = request["left_out"] or "stribeck"
    print(json.dumps({"case": request["case"], "seconds": 0.1, "seen": seen, "argv": sys.argv,
        "diagnosis": {"verdict": "explained", "causes": [{"effect": effect, "confidence": 0.99}], "gap": None}}),
        flush=True)
"""


@pytest.fixture
def scripted(tmp_path: Path) -> tuple[str, ...]:
    script = tmp_path / "scripted.py"
    script.write_text(SCRIPT)
    return (sys.executable, str(script))


@pytest.mark.slow
def test_truth_is_sealed_until_the_last_answer(tmp_path: Path, scripted: tuple[str, ...]) -> None:
    out = tmp_path / "check"
    phases: list[tuple[str, int, int]] = []
    result = run_check(
        4, 21, out=out, leave_one_out=True, diagnoser=scripted, progress=lambda *step: phases.append(step)
    )
    answers = json.loads((out / "answers.json").read_text())
    seen = {name for answer in answers if "seen" in answer for name in answer["seen"]}
    assert "commitment.json" in seen
    assert any(name.endswith("nominal.yaml") for name in seen)
    assert not any("truth" in name or "result" in name for name in seen)
    commitment = json.loads((out / "commitment.json").read_text())
    assert "seed" not in commitment
    files = sorted((out / "truth").iterdir())
    assert hashlib.sha256(b"".join(f.read_bytes() for f in files)).hexdigest() == commitment["truth_sha256"]
    assert commitment["truth_sha256"] == result["truth_sha256"]
    assert phases[0] == ("draw", 1, 4)
    assert ("diagnose", 4, 4) in phases
    assert [entry["case"] for entry in result["scores"]["errors"]] == ["case_001"]
    assert "code 7" in result["scores"]["errors"][0]["message"]
    assert result["scores"]["cases"] == 4


@pytest.mark.slow
def test_an_interrupted_check_goes_on_where_it_stopped(tmp_path: Path, scripted: tuple[str, ...]) -> None:
    out = tmp_path / "check"

    def stop(phase: str, done: int, of: int) -> None:
        if phase == "diagnose":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_check(3, 21, out=out, diagnoser=scripted, progress=stop)
    (answered,) = (out / "answers.jsonl").read_text().splitlines()
    with (out / "answers.jsonl").open("a") as file:
        file.write('{"phase": "diagnose", "case": "case_0')
    mute = (sys.executable, "-c", "raise SystemExit(3)")
    result = run_check(3, 21, out=out, diagnoser=mute)
    assert len(result["scores"]["errors"]) == 2, answered
    other = run_check(3, 22, out=tmp_path / "check", diagnoser=mute)
    assert len(other["scores"]["errors"]) == 3


@pytest.mark.slow
def test_equal_seeds_seal_equal_truth_whatever_the_processes(scripted: tuple[str, ...]) -> None:
    once = run_check(1, 5, diagnoser=scripted)["truth_sha256"]
    assert run_check(1, 5, diagnoser=scripted, processes=2)["truth_sha256"] == once
    assert run_check(1, 6, diagnoser=scripted)["truth_sha256"] != once


def test_a_folder_with_an_earlier_check_is_refused(tmp_path: Path) -> None:
    for world, name in (("narrow", "result.json"), ("wide", "gap-check.md")):
        (tmp_path / world).mkdir()
        (tmp_path / world / name).write_text("mine")
        with pytest.raises(UsageError, match="would be overwritten") as told:
            run_gap_check(cases=3, out=tmp_path / world)
        assert name in told.value.where and "--force" in told.value.next_step
    with pytest.raises(UsageError, match="would be overwritten"):
        run_gap_check(cases=3, out=tmp_path, worlds=("zoo", "wide"))
    assert {path.read_text() for path in tmp_path.rglob("*") if path.is_file()} == {"mine"}
    with pytest.raises(UsageError, match="cannot be scored"):
        run_gap_check(cases=0)
