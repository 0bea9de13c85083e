"""From the bus to the cause and back, for two of the effects; ``benchmarks/gap_end_to_end.py`` runs all of them."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

from frictid_hil.simulation.effects import all_effects

BENCHMARK = Path(__file__).resolve().parents[2] / "benchmarks" / "gap_end_to_end.py"


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    spec = importlib.util.spec_from_file_location("gap_end_to_end", BENCHMARK)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def _runs_stay_in_the_test_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_sizes_are_given_for_every_effect_and_lie_in_its_bounds(benchmark: ModuleType, tmp_path: Path) -> None:
    assert set(benchmark.SIZES) == set(all_effects())
    bare = benchmark.joint_of(benchmark.robot_with({}, tmp_path))
    for name in benchmark.SIZES:
        assert bare.with_effects({name: benchmark.drawn(name)}).effects[name] != all_effects()[name].off


@pytest.mark.slow
@pytest.mark.parametrize("effect", ["torque_bias", "joint_elasticity"])
def test_an_effect_is_recorded_named_and_closed(benchmark: ModuleType, effect: str, tmp_path: Path) -> None:
    """One of what moves, and one whose partner (bias, gravity) this set cannot tell from it."""
    outcome = benchmark.outcome_of(effect, tmp_path / effect)
    assert outcome.right, outcome
    assert outcome.closed, outcome
    assert outcome.left_of_replay is None or outcome.left_of_replay <= 0.2, outcome
