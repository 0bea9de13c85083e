"""The diagnosis on real machines, the quick ones of ``benchmarks/gap_real.py``; skipped without recordings."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import gap_sets
import pytest

from frictid_hil.gap.diagnose import diagnose

ROOT = Path(__file__).resolve().parents[2]
REAL = gap_sets.real_data()

pytestmark = [
    pytest.mark.real_data,
    pytest.mark.skipif(REAL is None, reason="no real recordings (FRICTID_REAL_DATA)"),
]


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return loaded("gap_real")


def loaded(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("judge_pulses", [True, False])
def test_the_linear_axis_keeps_an_open_gap_that_nobody_clears(benchmark: ModuleType, judge_pulses: bool) -> None:
    found = diagnose(benchmark.emps(REAL, judge_pulses))
    # Asymmetry helps on both recordings, and nothing that has a name closes the gap.
    assert found.verdict == "unknown" and "cause" in found.reasons
    assert found.held_out["direction_asymmetry"] < -4.0
    assert found.before.forward_torque_nm is None and "controller" in found.reasons["forward_torque_nm"]


@pytest.mark.slow
@pytest.mark.parametrize("odd_judged", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_second_joint_of_the_pendulum_has_a_gap_that_no_effect_closes(
    benchmark: ModuleType, odd_judged: bool
) -> None:
    found = diagnose(benchmark.double_pendulum(REAL, "c1", 2, odd_judged))
    # Beyond two floors and beyond what friction repeats to: nothing is named, and nothing is cleared either.
    assert found.verdict == "unknown" and not found.causes
    # The best of them takes 5.2 % of the squares away, 2.6 % of the gap.
    assert min(found.held_out.values()) > -5.5


@pytest.mark.slow
def test_a_cause_beside_a_gap_of_the_machines_own_is_named_and_what_stays_is_told(benchmark: ModuleType) -> None:
    added = loaded("gap_variants").VARIANTS["friction with the load beside the gap"]
    found = diagnose(added.change(benchmark.double_pendulum(REAL, "c1", 2, False)))
    assert found.verdict == "explained" and found.causes[0].effect == "load_dependent_friction"
    assert found.causes[0].confidence < 0.9 and "rest" in found.reasons
    assert found.after.inverse_nm is not None and found.before.inverse_nm is not None
    assert 0.5 * found.before.inverse_nm < found.after.inverse_nm < 0.8 * found.before.inverse_nm


@pytest.mark.slow
def test_one_log_of_the_arm_decides_nothing(benchmark: ModuleType) -> None:
    found = diagnose(benchmark.so101(REAL, "Elbow", (), ("backlash_detection",)))
    assert found.verdict == "ambiguous" and found.next_experiment is not None
    assert found.causes[0].effect == "torque_delay"
    assert all(c.confidence < 0.9 for c in found.causes)


@pytest.mark.slow
def test_the_arm_is_late_whichever_motions_are_judged(benchmark: ModuleType) -> None:
    motions = sorted(path.name for path in (REAL / "so101").iterdir() if path.is_dir())
    for judged in (motions[::2], motions[1::2]):
        found = diagnose(benchmark.so101(REAL, "Rotation", judged))
        assert found.causes[0].effect == "torque_delay"
        assert 0.0 < found.causes[0].parameters["delay_s"].value < 0.3
