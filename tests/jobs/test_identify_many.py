"""Many recordings at once: over processes the same to the last bit, and a bad file spoils only itself."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from frictid_hil.config.profile import load_profile
from frictid_hil.errors import FrictidError, HardwareError, UsageError
from frictid_hil.friction import trajectory
from frictid_hil.friction.trajectory import Procedure
from frictid_hil.jobs.identification.executors import answers, executor
from frictid_hil.jobs.identify import IdentifyOptions, identify, profile_names
from frictid_hil.recording.mcap import write_samples
from frictid_hil.recording.samples import Samples

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


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """A real scheduler and two worker processes on this machine."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=logging.ERROR
    ) as running:
        yield "dask:" + running.scheduler_address.removeprefix("tcp:")


def check_as_alone(logs: Path, executor: str, out: Path) -> None:
    """Every file as serially, the bad one told by name, progress for each."""
    told: list[str] = []
    result = identify(options(logs, executor=executor, out=out / "many"), told.append)
    entries = {Path(entry["log"]).name: entry for entry in result["recordings"]}
    assert len(entries) == 5 and [line.split()[0] for line in told] == [f"{k}/5" for k in range(1, 6)]
    assert entries["zz_broken.csv"]["error"] and "zz_broken.csv" in result["error"]["what"]
    assert result["outcome"] == "gate_failed" and result["error"]["what"].startswith("1 of 5 recordings failed: zz_")
    for k in range(4):
        alone = identify(options(logs / f"log{k}.csv", out=out / f"alone{k}"))
        entry = entries[f"log{k}.csv"]
        assert entry["error"] is None
        assert entry["joints"] == alone["joints"]
        assert load_profile(Path(entry["profile"])).joints == load_profile(Path(alone["profile"])).joints
        assert Path(entry["report"]).stem == Path(entry["profile"]).stem and Path(alone["report"]).name == "report.html"
        assert "torque over velocity" in Path(alone["report"]).read_text(), "the loops, though nothing was marked"


@pytest.mark.slow
def test_over_processes_as_alone_and_a_bad_file_spoils_only_itself(logs: Path, tmp_path: Path) -> None:
    check_as_alone(logs, "processes:2", tmp_path)


@pytest.mark.slow
def test_over_a_cluster_as_alone_and_a_bad_file_spoils_only_itself(logs: Path, cluster: str, tmp_path: Path) -> None:
    check_as_alone(logs, cluster, tmp_path)


@pytest.mark.slow
def test_profiles_of_recordings_with_one_name_do_not_overwrite_each_other(logs: Path, tmp_path: Path) -> None:
    for night in ("night1", "night2"):
        (tmp_path / night / "arm").mkdir(parents=True)
        (tmp_path / night / "arm" / "log.csv").write_bytes((logs / f"log{night[-1]}.csv").read_bytes())
    result = identify(options(tmp_path / "night*", executor="processes:1", out=tmp_path / "out"))
    names = [Path(entry["profile"]).name for entry in result["recordings"]]
    assert names == ["night1-arm-log.csv.yaml", "night2-arm-log.csv.yaml"] and result["outcome"] == "ok"
    with pytest.raises(UsageError, match="exists already"):
        identify(options(tmp_path / "night*", executor="processes:1", out=tmp_path / "out"))


def test_names_of_profiles_come_from_whole_paths(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    name = tmp_path.name
    assert profile_names([Path("a.csv"), Path("b.csv")]) == [f"{name}-a.yaml", f"{name}-b.yaml"]
    assert profile_names([Path("a.csv"), Path("a.mcap")]) == ["a.csv.yaml", "a.mcap.yaml"]
    assert profile_names([Path("a.csv")]) == ["profile.yaml"]


@pytest.mark.slow
def test_a_damaged_recording_is_told(tmp_path: Path) -> None:
    time_s = np.arange(0.0, P.duration_s + 1.0, 0.001)
    v, a, path = (of(P, time_s - 0.5) for of in (trajectory.velocity, trajectory.acceleration, trajectory.position))
    torque = 4.0 * np.tanh(v / 0.01) + 0.5 * a
    write_samples(tmp_path / "whole.mcap", [Samples("0", np.round(time_s * 1e9).astype(np.int64), path, v, torque)])
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[:-3000])
    (tmp_path / "torn.mcap").write_bytes(data[: len(data) // 4])
    told: list[str] = []
    cut, torn, whole = identify(options(tmp_path), told.append)["recordings"]
    assert cut["joints"]["0"]["torque_nm"] == whole["joints"]["0"]["torque_nm"]
    assert "is damaged" in cut["joints"]["0"]["notes"][0] and "is damaged" not in str(whole["joints"]["0"]["notes"])
    assert torn["error"] and "the file is damaged: the file ends in the middle" in told[1]


@pytest.mark.slow
def test_a_killed_worker_of_a_cluster_costs_its_own_task_alone(cluster: str) -> None:
    # Defined here, so that it travels by value: workers cannot import the tests.
    def die_at_two(task: int) -> int:
        """A task whose worker is killed, as by the system when memory runs out."""
        if task == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return 10 * task

    with executor(cluster, 4) as pool:
        got = list(answers(pool, die_at_two, range(4)))
    assert [got[0], got[1], got[3]] == [0, 10, 30]
    assert isinstance(got[2], FrictidError) and "no answer" in got[2].what


@pytest.mark.slow
def test_no_cluster_there(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("frictid_hil.jobs.identification.executors.CONNECT_TIMEOUT", "0.3s")
    with pytest.raises(HardwareError, match="no cluster answers"), executor("dask://127.0.0.1:9", 4):
        pass


@pytest.mark.slow
@pytest.mark.parametrize("named", ["threads:4", "processes:0", "dask:host"])
def test_no_such_executor(logs: Path, named: str) -> None:
    with pytest.raises(UsageError, match="no executor"):
        identify(options(logs, executor=named))
