"""What ``profile`` prints for a person."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile
from frictid_hil.config.provenance import Provenance


@pytest.mark.slow
def test_show_tells_quantities_with_their_units(tmp_path: Path) -> None:
    joint = JointProfile(
        method="aligned", velocity_rad_s=(1.0, 2.0), torque_nm=(4.0, 5.0), coulomb_nm=Estimate(value=3.0)
    )
    path = tmp_path / "profile.yaml"
    provenance = Provenance(created_utc="2026-03-01T02:00:00Z")
    FrictionProfile(robot="arm", joints={"0": joint, "1": joint}, provenance=provenance).save(path)
    command = [sys.executable, "-m", "frictid_hil.cli.app", "profile", "show", str(path)]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True).stdout
    assert shown.count("V_n [deg/s]") == shown.count("F_n [N m]") == 2
    assert "57.3" in shown and "arm, 2026-03-01T02:00:00Z" in shown
