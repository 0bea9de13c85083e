"""The Python API as its page shows it, and what it refuses."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import frictid_hil as fh
from frictid_hil.config.profile import Estimate, JointProfile
from frictid_hil.errors import UsageError

GUIDES = Path(__file__).parents[1] / "docs" / "guides"


@pytest.mark.slow
def test_the_page_runs_from_top_to_bottom(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", (GUIDES / "python.md").read_text(encoding="utf-8"), re.DOTALL):
        exec(block, names)
    assert names["result"].ended.outcome == "ok", names["result"].ended.error
    assert (tmp_path / "friction.png").stat().st_size > 5000
    fitted, averaged = (names[name].joint("3").coulomb_nm.value for name in ("again", "profile"))
    assert fitted == pytest.approx(averaged, rel=0.05)
    assert "ok" in capsys.readouterr().out


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path) -> None:
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    notebook = nbformat.read(GUIDES / "first-steps.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=200, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in shown)


def test_a_profile_of_a_joint_is_a_function_of_velocity() -> None:
    joint = JointProfile(
        method="aligned", velocity_rad_s=(0.5, 1.0), torque_nm=(4.0, 5.0), coulomb_nm=Estimate(value=3.0)
    )
    assert joint(1.0) == pytest.approx(5.0) and joint(0.0) == 0.0
    assert joint(np.array([[-1.0, 0.25], [0.75, 2.0]])) == pytest.approx(np.array([[-5.0, 3.5], [4.5, 7.0]]))


def test_a_real_robot_does_not_move_unless_somebody_is_asked(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="real robot"):
        fh.calibrate("hp3j.yaml", bus="socketcan:can7", out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_plan_that_is_not_confirmed_moves_nothing(tmp_path: Path) -> None:
    with pytest.raises(UsageError):
        fh.calibrate("hp3j.yaml", joints=["5"], cycles=2, confirm=lambda plan: False, out=tmp_path / "run")


def test_importing_the_package_loads_nothing_heavy() -> None:
    code = "import sys, frictid_hil; assert not {'numpy', 'scipy', 'numba'} & set(sys.modules); dir(frictid_hil)"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        fh.calibrat  # noqa: B018  # the name is what is tested
