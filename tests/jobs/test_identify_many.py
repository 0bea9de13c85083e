"""Many recordings at once: over processes the same to the last bit, and a bad file spoils only itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from frictid_hil.config.profile import load_profile
from frictid_hil.errors import UsageError
from frictid_hil.friction import trajectory
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.identify import IdentifyOptions, identify

P = Procedure(0.35, 2.0, 4)


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    for k in range(4):
        time_s = np.arange(-0.5, P.duration_s + 0.5, 0.001)
        v, a = trajectory.velocity(P, time_s), trajectory.acceleration(P, time_s)
        noise = np.random.default_rng(k).normal(0.0, 0.05, time_s.size)
        torque = (4.0 + k) * np.tanh(v / 0.01) + 1.5 * v + 0.5 * a + noise
        table = np.column_stack([time_s + 0.5, trajectory.position(P, time_s), v, torque])
        header = "time_s,position_rad,velocity_rad_s,torque_nm"
        np.savetxt(folder / f"log{k}.csv", table, "%.9g", delimiter=",", header=header, comments="")
    (folder / "zz_broken.csv").write_text("time_s,position_rad,torque_nm\n0,0,nonsense\n")
    return folder


def options(*logs: Path, **changes: object) -> IdentifyOptions:
    return IdentifyOptions(logs, amplitude_rad=0.35, velocity_rad_s=2.0, cycles=4, **changes)  # type: ignore[arg-type]


def test_over_processes_as_alone_and_a_bad_file_spoils_only_itself(logs: Path, tmp_path: Path) -> None:
    told: list[str] = []
    result = identify(options(logs, executor="processes:2", out=tmp_path / "many"), told.append)
    entries = {Path(entry["log"]).name: entry for entry in result["recordings"]}
    assert len(entries) == 5 and len(told) == 5
    assert entries["zz_broken.csv"]["error"] and "zz_broken.csv" in result["error"]["what"]
    assert result["outcome"] == "gate_failed"
    for k in range(4):
        alone = identify(options(logs / f"log{k}.csv", out=tmp_path / f"alone{k}"))
        entry = entries[f"log{k}.csv"]
        assert entry["error"] is None
        assert entry["joints"] == alone["joints"]
        assert load_profile(Path(entry["profile"])).joints == load_profile(Path(alone["profile"])).joints


@pytest.mark.parametrize("named", ["threads:4", "processes:0", "dask:host"])
def test_no_such_executor(logs: Path, named: str) -> None:
    with pytest.raises(UsageError, match="no executor"):
        identify(options(logs, executor=named))
