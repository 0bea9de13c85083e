"""A seed of the campaign of faults (`benchmarks/faults.py`): judged by the servos and the withheld truth."""

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

CASES = [
    ("preflight", "SDO answer short"),
    ("configure", "SDO refused"),
    ("configure", "interface fails in set-up"),
    ("enable", "node silent"),
    ("move", "position jumps a turn"),
    ("rehearsal", "drive faults"),
    ("rehearsal", "send os"),
    ("cycles", "torque late 20 ms"),
    ("cycles", "torque times 1.5"),
    ("cycles", "torque clipped 6 N m"),
    ("cycles", "node reboots"),
    ("cycles", "bus off"),
]


@pytest.fixture(scope="module")
def faults() -> ModuleType:
    path = Path(__file__).parents[1] / "benchmarks" / "faults.py"
    spec = importlib.util.spec_from_file_location("faults", path)
    assert spec is not None and spec.loader is not None
    module = sys.modules["faults"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def bench(faults: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Iterator[object]:
    with pytest.MonkeyPatch.context() as patch:
        for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME", faults.ENVIRONMENT):
            patch.setenv(name, "")  # the bench sets them; this puts them back
        yield faults.Bench(tmp_path_factory.mktemp("faults"))


@pytest.mark.slow
@pytest.mark.parametrize(("phase", "name"), CASES)
def test_a_fault_leaves_nothing_moving_nothing_lost_and_no_wrong_curve(faults, bench, phase, name):
    verdict = bench.struck(faults.Case("calibrate", phase, name, 1))
    assert verdict.failures == []
    assert verdict.noticed, verdict


@pytest.mark.slow
def test_the_judge_sees_a_wrong_curve(faults, bench):
    verdict = faults.Verdict("calibrate", "cycles", "nothing", 0)
    truth = faults.true_curve(bench.robot, faults.JOINT, 2.0).magnitude(np.array([0.5, 1.0]))
    wrong = {"outcome": "ok", "velocity_rad_s": [0.5, 1.0], "torque_interval_nm": [(t * 1.1, t * 1.2) for t in truth]}
    bench._judge_curves({faults.JOINT: wrong}, verdict)
    assert "called ok" in verdict.failures[0]
