"""Recordings that lie anywhere: roles, beliefs, a first nominal joint."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from frictid_hil.config.nominal import load_nominal
from frictid_hil.config.profile import load_profile
from frictid_hil.errors import ConfigError, InputFileError, UsageError
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.jobs.gap.logs import Source
from frictid_hil.jobs.gap_diagnose import draft

STEP_S = 0.004
INERTIA, COS, SIN, COULOMB, VISCOUS = 0.6, 5.0, -1.0, 2.0, 0.8


def _log(path: Path, seconds: float = 12.0, phase: float = 0.0, header: str = "", scale: float = 1.0) -> Path:
    """A joint without effects, its torque by the plain equation; noise of 0.05 N m."""
    time_s = STEP_S * np.arange(round(seconds / STEP_S))
    q = 0.8 * np.sin(1.3 * time_s + phase) + 0.3 * np.sin(3.1 * time_s)
    velocity = 1.04 * np.cos(1.3 * time_s + phase) + 0.93 * np.cos(3.1 * time_s)
    acceleration = -1.352 * np.sin(1.3 * time_s + phase) - 2.883 * np.sin(3.1 * time_s)
    torque = INERTIA * acceleration + COS * np.cos(q) + SIN * np.sin(q) + VISCOUS * velocity
    torque += COULOMB * np.tanh(velocity / 1e-3) + 0.05 * np.random.default_rng(1).standard_normal(q.size)
    table = np.column_stack([time_s, scale * q, torque])
    np.savetxt(path, table, delimiter=",", header=header or "time_s,position_rad,torque_nm", comments="")
    return path


def test_the_end_of_a_single_recording_is_judged_on(tmp_path: Path) -> None:
    read = Source([_log(tmp_path / "walk.csv")]).load()
    assert [(e.name, e.validation) for e in read.experiments] == [("walk", False), ("walk, last third", True)]
    first, last = read.experiments
    assert last.time_s[0] > first.time_s[-1] and last.time_s.size == pytest.approx(0.5 * first.time_s.size, rel=0.01)


def test_of_several_recordings_the_last_are_judged_on_or_those_named(tmp_path: Path) -> None:
    logs = [_log(tmp_path / f"{name}.csv", seconds) for name, seconds in (("a", 9.0), ("b", 9.0), ("c", 9.0))]
    assert [e.name for e in Source(logs).load().experiments if e.validation] == ["c"]
    assert [e.name for e in Source(logs, validation=["a"]).load().experiments if e.validation] == ["a"]
    with pytest.raises(UsageError, match="no log is called d"):
        Source(logs, validation=["d"]).load()


@pytest.mark.parametrize(("split", "end_s"), [("25%", 3.0), ("4s", 4.0)])
def test_a_split_by_time_judges_on_the_end_of_every_log(tmp_path: Path, split: str, end_s: float) -> None:
    logs = [_log(tmp_path / f"{name}.csv") for name in ("a", "b")]
    read = Source(logs, split=split).load()
    assert [(e.name, e.validation) for e in read.experiments] == [
        ("a", False), (f"a, last {split}", True), ("b", False), (f"b, last {split}", True),
    ]  # fmt: skip
    assert all(np.ptp(e.time_s) == pytest.approx(end_s, abs=0.02) for e in read.experiments if e.validation)


def test_a_split_by_log_is_that_of_several_logs(tmp_path: Path) -> None:
    logs = [_log(tmp_path / f"{name}.csv") for name in ("a", "b")]
    assert [e.validation for e in Source(logs, split="log").load().experiments] == [False, True]
    with pytest.raises(UsageError, match="needs several logs"):
        Source(logs[:1], split="log").load()
    for split, why in (("half", "cannot be read"), ("100%", "leaves nothing"), ("20s", "leaves nothing")):
        with pytest.raises(UsageError, match=why):
            Source(logs, split=split).load()
    with pytest.raises(UsageError, match="both say"):
        Source(logs, split="30%", validation=["a"]).load()


def test_a_nominal_file_tells_belief_and_roles(tmp_path: Path) -> None:
    told = {
        "joint": {"inertia_kg_m2": 0.5, "friction": {"coulomb_nm": 2.0}},
        "tolerance": {"inertia_kg_m2": 0.2},
        "experiments": [{"name": "a", "role": "validation", "payload": True}],
    }
    (tmp_path / "n.yaml").write_text(yaml.safe_dump(told))
    logs = [_log(tmp_path / "a.csv"), _log(tmp_path / "b.csv")]
    read = Source(logs, nominal=tmp_path / "n.yaml").load()
    assert [(e.validation, e.payload) for e in read.experiments] == [(True, True), (False, False)]
    assert read.nominal.inertia_kg_m2 == 0.5 and read.nominal.tolerances.inertia_kg_m2.relative == 0.2


def test_a_profile_alone_is_a_belief(tmp_path: Path) -> None:
    golden = Path(__file__).parents[1] / "config" / "golden" / "profile-1.yaml"
    known = load_profile(golden)
    name, joint = next(iter(known.joints.items()))
    read = Source([_log(tmp_path / "a.csv")], profile=golden, joint=name).load()
    assert read.nominal.curve is not None and read.nominal.curve.torque_nm == joint.torque_nm
    assert read.nominal.inertia_kg_m2 == joint.inertia_kg_m2.value
    assert read.nominal.tolerances.friction_torque.source in ("stated", "profile")


def test_foreign_columns_are_read_by_their_map(tmp_path: Path) -> None:
    log = _log(tmp_path / "arm.csv", header="t,deg,tau", scale=180.0 / np.pi)
    columns = {
        "schema": "frictid.columns/1",
        "name": "arm",
        "time": {"column": "t", "unit": "s"},
        "joints": {"elbow": {"position": {"column": "deg", "unit": "deg"}, "torque": {"column": "tau", "unit": "N m"}}},
    }
    (tmp_path / "arm.yaml").write_text(yaml.safe_dump(columns))
    read = Source([log], columns=str(tmp_path / "arm.yaml")).load()
    assert max(e.travel_rad for e in read.experiments) == pytest.approx(2.1, abs=0.3)


def test_a_set_is_a_set_and_takes_no_options_of_logs(tmp_path: Path) -> None:
    _log(tmp_path / "a.csv")
    (tmp_path / "nominal.yaml").write_text("joint: {}\nexperiments: [{name: a}]\n")
    assert isinstance(Source([tmp_path]).load(), ExperimentSet)
    with pytest.raises(UsageError, match="says by itself"):
        Source([tmp_path], validation=["a"]).load()
    (tmp_path / "nominal.yaml").write_text("joint: {}\n")
    with pytest.raises(ConfigError, match="at least one log"):
        Source([tmp_path]).load()


def test_a_draft_finds_the_joint_and_says_how_sure_it_is(tmp_path: Path) -> None:
    logs = [_log(tmp_path / "a.csv", 20.0), _log(tmp_path / "b.csv", 20.0, phase=1.0)]
    out = tmp_path / "nominal.yaml"
    found = draft(Source(logs), out)["draft"]["numbers"]
    truth: dict[str, Any] = {"inertia_kg_m2": INERTIA, "gravity_cos_nm": COS, "gravity_sin_nm": SIN}
    truth |= {"coulomb_nm": COULOMB, "viscous_nm_s_per_rad": VISCOUS, "bias_nm": 0.0}
    for name, value in truth.items():
        assert abs(found[name]["value"] - value) < 3.0 * found[name]["sigma"] + 0.02 * abs(value), name
    read = load_nominal(out, logs=False)
    assert read.file.tolerance is not None and read.file.joint.inertia_kg_m2 == pytest.approx(INERTIA, rel=0.05)
    assert Source(logs, nominal=out).load().nominal.tolerances.inertia_kg_m2.source == "stated"


def test_a_draft_says_which_number_no_joint_has(tmp_path: Path) -> None:
    log = _log(tmp_path / "odd.csv")
    table = np.loadtxt(log, delimiter=",", skiprows=1)
    table[:, 2] -= 2.0 * COULOMB * np.tanh(np.gradient(table[:, 1], STEP_S) / 1e-3)
    np.savetxt(log, table, delimiter=",", header="time_s,position_rad,torque_nm", comments="")
    told = draft(Source([log]), tmp_path / "n.yaml")
    assert [line.split()[0] for line in told["draft"]["warnings"]] == ["coulomb_nm"]
    assert Source([log], nominal=tmp_path / "n.yaml").load().nominal.curve is not None
    assert draft(Source([_log(tmp_path / "fine.csv")]), tmp_path / "m.yaml")["draft"]["warnings"] == []


def test_a_draft_is_not_written_over_a_file_unless_told(tmp_path: Path) -> None:
    log, out = _log(tmp_path / "a.csv"), tmp_path / "nominal.yaml"
    out.write_text("mine")
    with pytest.raises(UsageError, match="exists already"):
        draft(Source([log]), out)
    assert out.read_text() == "mine"
    draft(Source([log]), out, force=True)
    assert out.read_text() != "mine"


def test_without_torque_there_is_nothing_to_draft(tmp_path: Path) -> None:
    time_s = STEP_S * np.arange(1000)
    table = np.column_stack([time_s, np.sin(time_s), np.sin(time_s + 0.1)])
    header = "time_s,position_rad,position_command_rad"
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header=header, comments="")
    with pytest.raises(InputFileError, match="no log has a torque"):
        draft(Source([tmp_path / "a.csv"]), tmp_path / "n.yaml")
