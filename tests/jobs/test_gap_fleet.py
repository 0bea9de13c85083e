"""What varies between robots is told apart from what is not known of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_hil.errors import InputFileError, UsageError
from frictid_hil.jobs.gap_fleet import fleet, spread_of

BIAS, SIGMA = 1.0, 0.05


def _result(path: Path, bias: float, level: float | None) -> Path:
    def told(value: float) -> dict[str, Any]:
        return {"value": value, "interval_95": [value - 1.96 * SIGMA, value + 1.96 * SIGMA]}

    causes = [{"effect": "torque_bias", "parameters": {"bias_nm": told(bias)}}]
    if level is not None:
        causes.append({"effect": "friction_level_error", "parameters": {"error_share": told(level)}})
    joints = {"lift": {"verdict": "explained", "causes": causes}, "pan": {"verdict": "unknown", "causes": causes}}
    path.write_text(json.dumps({"joints": joints}))
    return path


def _fleet(folder: Path, between: float, units: int = 12) -> list[Path]:
    """Robots whose bias differs by nothing but the measurement, and whose level differs by more."""
    random = np.random.default_rng(5)
    biases = BIAS + SIGMA * random.standard_normal(units)
    levels = 0.4 + between * random.standard_normal(units) + SIGMA * random.standard_normal(units)
    return [_result(folder / f"{k}.json", b, v) for k, (b, v) in enumerate(zip(biases, levels, strict=True))]


def test_a_spread_beyond_the_intervals_is_a_fleets(tmp_path: Path) -> None:
    told = fleet(_fleet(tmp_path, 0.2))["joints"]
    assert set(told) == {"lift"}, "an open verdict says nothing of a joint"
    bias, level = told["lift"]["torque_bias"]["bias_nm"], told["lift"]["friction_level_error"]["error_share"]
    assert not bias["varies"] and bias["between_units"]["interval_95"][1] < 0.1
    assert bias["mean"] == pytest.approx(BIAS, abs=0.05) and 0.01 < bias["not_known"] < 0.04
    low, high = level["between_units"]["interval_95"]
    assert level["varies"] and low < 0.2 < high and level["not_known"] > 2.0 * bias["not_known"]


def test_equal_robots_are_seldom_told_to_differ() -> None:
    random = np.random.default_rng(1)
    told = [spread_of(BIAS + SIGMA * random.standard_normal(8), np.full(8, SIGMA), random)[2] for _ in range(200)]
    assert np.mean(told) < 0.08


def test_drawn_robots_spread_as_the_fleet_does(tmp_path: Path) -> None:
    out = tmp_path / "robots.json"
    told = fleet(_fleet(tmp_path, 0.2), samples=400, out=out)
    assert told["samples"] == str(out)
    robots = json.loads(out.read_text())["robots"]
    levels = [robot["lift"]["friction_level_error"]["error_share"] for robot in robots]
    biases = [robot["lift"]["torque_bias"]["bias_nm"] for robot in robots]
    assert np.std(levels) == pytest.approx(0.22, rel=0.35) and np.std(biases) < 0.07
    with pytest.raises(UsageError, match="overwritten"):
        fleet(_fleet(tmp_path, 0.2), samples=4, out=out)


def test_numbers_that_vary_together_are_drawn_together(tmp_path: Path) -> None:
    values = np.linspace(0.2, 1.8, 8)
    results = [_result(tmp_path / f"{k}.json", v, 0.5 * v) for k, v in enumerate(values)]
    out = tmp_path / "robots.json"
    fleet(results, samples=300, out=out)
    robots = [robot["lift"] for robot in json.loads(out.read_text())["robots"]]
    pairs = [(r["torque_bias"]["bias_nm"], r["friction_level_error"]["error_share"]) for r in robots]
    assert np.corrcoef(np.array(pairs).T)[0, 1] > 0.7


def test_a_robot_without_the_effect_counts_as_none_of_it(tmp_path: Path) -> None:
    results = [_result(tmp_path / f"{k}.json", BIAS, 0.4 if k % 2 else None) for k in range(6)]
    level = fleet(results)["joints"]["lift"]["friction_level_error"]["error_share"]
    assert level["mean"] == pytest.approx(0.2, abs=0.1) and level["varies"] and level["units"] == 6


def test_too_few_robots_and_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="2 robots"):
        fleet(_fleet(tmp_path, 0.2, units=2))
    with pytest.raises(UsageError, match="belong together"):
        fleet(_fleet(tmp_path, 0.2), samples=3)
    (tmp_path / "x.json").write_text('{"joints": 3}')
    with pytest.raises(InputFileError, match="no result of a diagnosis"):
        fleet([tmp_path / "x.json"] * 3)
