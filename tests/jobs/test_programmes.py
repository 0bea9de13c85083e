"""Short programmes: fewer speeds, the same bus, marks that carry them, an accuracy that is told and kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_hil.config.profile import load_profile
from frictid_hil.errors import UsageError
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate, plan_calibration
from frictid_hil.jobs.compare import compare
from frictid_hil.jobs.identification.programmes import PROGRAMMES, programme
from frictid_hil.jobs.identify import IdentifyOptions, identify
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.plan import Cycles

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("programmes") / "quick"
    options = CalibrateOptions("hp3j.yaml", bus="virtual:quick", joints=("5",), program="quick", out=out)
    result = calibrate(options, Silent()).to_json()
    assert result["outcome"] == "ok", result
    return out


def test_a_short_programme_names_its_speeds_and_what_it_gives() -> None:
    planned = plan_calibration(CalibrateOptions("hp3j.yaml", joints=("1",), program="standard"))
    (cycles,) = [motion for motion in planned.plan.joints[0].motions if isinstance(motion, Cycles)]
    assert np.degrees(cycles.procedure.peak_velocities_rad_s) == pytest.approx([12, 60, 115])
    assert planned.method == "least-squares"
    assert planned.plan.notes[0].startswith("programme standard: 3 speeds, 6.8 s")
    assert f"at most {PROGRAMMES['standard'].error_percent:g} %" in planned.plan.notes[0]


def test_speeds_scale_with_the_peak_velocity_asked_for() -> None:
    options = CalibrateOptions("hp3j.yaml", joints=("1",), program="quick", velocity_rad_s=1.0)
    (cycles,) = [m for m in plan_calibration(options).plan.joints[0].motions if isinstance(m, Cycles)]
    assert cycles.procedure.peak_velocities_rad_s == pytest.approx([30 / 115, 1.0])


def test_a_short_programme_keeps_the_accuracy_it_tells(quick: Path) -> None:
    distance = compare(quick, None, "hp3j.yaml")["joints"]["5"]
    assert distance["e_percent_measured_range"] <= PROGRAMMES["quick"].error_percent


def test_its_recording_identifies_to_the_same_profile(quick: Path) -> None:
    out = quick.parent / "again"
    again = identify(IdentifyOptions((quick,), robot="hp3j.yaml", method="least-squares", out=out))
    assert again["outcome"] == "ok"
    first, second = load_profile(quick / "profile.yaml"), load_profile(out / "profile.yaml")
    assert first.joints == second.joints
    assert first.joint("5").procedure is not None
    assert len(first.joint("5").procedure.shares or ()) == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [({"program": "fast"}, "no programme"), ({"program": "quick", "cycles": 5}, "leave --cycles out")],
)
def test_what_makes_no_programme_is_refused(options: dict[str, object], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        plan_calibration(CalibrateOptions("hp3j.yaml", **options))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "rate_hz", "quantum_s", "said"),
    [
        ({}, 1000.0, 0.0, "by aligned; error at most 0.25 % over the measured speeds"),
        ({"cycles": 5}, 1000.0, 0.0, "not measured for N = 5;"),
        ({"amplitude_rad": 0.1, "velocity_rad_s": 1.0}, 1000.0, 0.0, "not measured for A = 5.73 deg, V = 57.3 deg/s;"),
        ({}, 500.0, 0.0, "not measured for 500 Hz;"),
        ({}, 1000.0, 0.02, "not measured for a controller that cycles by itself;"),
    ],
)
def test_an_accuracy_is_promised_only_where_it_was_measured(
    changes: dict[str, float], rate_hz: float, quantum_s: float, said: str
) -> None:
    usual: dict[str, Any] = {"amplitude_rad": 0.349066, "velocity_rad_s": 2.00713, "cycles": 10, "ratio": 0.8}
    assert said in programme("thorough").note(Procedure(**usual | changes), rate_hz, quantum_s)
