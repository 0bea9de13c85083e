"""``gap record`` on the virtual robot: a set that a diagnosis can read, with the payload mounted where it says so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy import signal

from frictid_drivers.virtual import VirtualDriver
from frictid_hil.config.robot import load_robot
from frictid_hil.config.search import find
from frictid_hil.errors import FrictidError, Interrupted, UsageError
from frictid_hil.gap.diagnosis import Diagnosis, Figures, NextExperiment
from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.jobs import gap_record
from frictid_hil.jobs.gap_record import FIRST, GapRecordOptions, _next, record, record_until_decided
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.experiments import (
    FULL,
    SCHEMA,
    Envelope,
    Experiment,
    catalogue,
    chosen,
    names_of_plan,
    plan_document,
)
from frictid_hil.plan.plan import Plan
from frictid_hil.runner.events import Event, PhaseStarted, Preflight

pytestmark = pytest.mark.slow

HP3J = find("hp3j.yaml").resolve()
NOISE_NM = 0.005 * 11.4


class Refusing(Silent):
    def confirm(self, plan: Plan, preflight: Preflight) -> bool:
        return False


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The wrist bend of the shipped robot, alone, with one effect."""
    monkeypatch.chdir(tmp_path)
    values: dict[str, Any] = yaml.safe_load(HP3J.read_text())
    joint = {**values["joints"]["4"], "node": 1, "axis": 0}
    joint["simulated"]["effects"] = {"direction_asymmetry": {"coulomb_share": 0.1, "viscous_share": 0.1}}
    values.update(name="one", bus=f"virtual:{tmp_path.name}", joints={"0": joint})
    path = tmp_path / "one.yaml"
    path.write_text(yaml.safe_dump(values))
    return str(path)


def plan_file(tmp_path: Path, *names: str) -> Path:
    path = tmp_path / f"plan-{'-'.join(names)}.yaml"
    path.write_text(yaml.safe_dump(plan_document(names, "a test")))
    return path


def columns(folder: Path, name: str) -> dict[str, np.ndarray[Any, Any]]:
    header, *rows = (folder / f"{name}.csv").read_text().splitlines()
    table = np.array([row.split(",") for row in rows], dtype=np.float64)
    return {key: table[:, k] for k, key in enumerate(header.split(","))}


def test_a_recorded_set_loads_and_its_rows_are_timed_as_it_says(robot: str, tmp_path: Path) -> None:
    out = tmp_path / "set"
    result = record(GapRecordOptions(robot, "0", plan=plan_file(tmp_path, "chirp"), out=out), Silent()).to_json()
    assert result["outcome"] == "ok"
    assert result["experiments"] == ["chirp"]
    assert result["set"] == str(out)
    loaded = ExperimentSet.load(out)
    assert loaded.nominal.inertia_kg_m2 == 0.1
    assert not loaded.experiments[0].validation
    nominal = yaml.safe_load((out / "nominal.yaml").read_text())
    assert "effects" not in nominal["joint"]
    log = columns(out, "chirp")
    assert np.allclose(np.diff(log["time_s"]), 0.001, atol=1e-12)
    assert log["time_s"][0] == 0.0
    assert nominal["experiments"][0]["duration_s"] == pytest.approx(11.0, abs=0.005)
    # The controller replayed by the set's own words leaves torque noise and nothing else.
    gains, step_s = nominal["controller"], 0.001
    error = log["position_command_rad"] - log["position_rad"]
    assert gains["command_rate"] == "backward"
    rate = np.diff(log["position_command_rad"], prepend=log["position_command_rad"][0]) / step_s
    demand = gains["kp"] * error + gains["ki"] * step_s * (np.cumsum(error) - error)
    demand += gains["kd"] * (rate - log["velocity_rad_s"])
    # Row 0's command rate is of the motion before, which no log of the set holds.
    left = log["torque_nm"][2:] - demand[1:-1]
    left -= np.median(left[:300])
    assert left.std() == pytest.approx(NOISE_NM, rel=0.05)
    low = signal.filtfilt(*signal.butter(2, 25.0 / 500.0), left)
    assert low.std() < 0.3 * NOISE_NM


def test_the_payload_is_mounted_for_its_experiments_alone(robot: str, tmp_path: Path) -> None:
    out = tmp_path / "set"
    plan = plan_file(tmp_path, "sines_payload", "sines_repeat")
    record(GapRecordOptions(robot, "0", plan=plan, out=out), Silent())
    bare, loaded = columns(out, "sines_repeat"), columns(out, "sines_payload")
    assert bare["position_rad"][0] == pytest.approx(loaded["position_rad"][0], abs=2e-3)
    # Friction cancels over a cycle there and back; 0.6 N m of payload stays.
    more = loaded["torque_nm"][600:-400].mean() - bare["torque_nm"][600:-400].mean()
    assert more == pytest.approx(0.6 * np.cos(bare["position_rad"][600:-400]).mean(), rel=0.1)
    listed = yaml.safe_load((out / "nominal.yaml").read_text())["experiments"]
    flags = {e["name"]: (e["payload"], e["run_order"]) for e in listed}
    assert flags == {"sines_repeat": (False, 0), "sines_payload": (True, 1)}


def test_without_a_payload_validation_runs_bare_and_the_rest_is_left_out(robot: str, tmp_path: Path) -> None:
    out = tmp_path / "set"
    plan = plan_file(tmp_path, "sines_payload", "moves_payload")
    result = record(GapRecordOptions(robot, "0", plan=plan, payload=False, out=out), Silent()).to_json()
    assert result["experiments"] == ["moves_payload"]
    assert not ExperimentSet.load(out).experiments[0].payload


class Mounting(Silent):
    """A person who says yes or no when asked for the payload."""

    def __init__(self, mounted: bool) -> None:
        self.mounted = mounted
        self.questions: list[str] = []
        self.notes: list[str] = []

    def ask(self, question: str) -> bool:
        self.questions.append(question)
        return self.mounted

    def note(self, message: str) -> None:
        self.notes.append(message)


def test_what_was_left_out_is_told_with_its_reason(robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_file(tmp_path, "breakaway", "sines_payload")
    options = GapRecordOptions(robot, "0", plan=plan, payload=False, out=tmp_path / "a")
    person = Mounting(True)
    result = record(options, person).to_json()
    assert result["skipped"] == [{"experiment": "sines_payload", "reason": "asked for without the payload"}]
    assert person.notes == ["sines_payload was left out: asked for without the payload"] and not person.questions
    # A machine whose payload nobody announced.
    monkeypatch.setattr(VirtualDriver, "kind", replace(VirtualDriver.kind, simulated=False))
    unannounced = record(GapRecordOptions(robot, "0", plan=plan, out=tmp_path / "b"), Mounting(True)).to_json()
    assert "--payload" in unannounced["skipped"][0]["reason"]
    assert unannounced["experiments"] == ["breakaway"]
    with pytest.raises(UsageError, match="all experiments asked for need the payload"):
        record(GapRecordOptions(robot, "0", plan=plan_file(tmp_path, "sines_payload"), out=tmp_path / "c"), Silent())


@pytest.mark.parametrize("mounted", [True, False])
def test_a_person_is_asked_to_mount_the_payload_before_it_moves(
    robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mounted: bool
) -> None:
    monkeypatch.setattr(VirtualDriver, "kind", replace(VirtualDriver.kind, simulated=False))
    person = Mounting(mounted)
    # Nothing but payload steps, so that the question comes before the first motion of a robot in lock-step.
    options = GapRecordOptions(
        robot, "0", plan=plan_file(tmp_path, "chirp_payload"), payload=True, out=tmp_path / "set"
    )
    if not mounted:
        with pytest.raises(UsageError, match="nobody mounted the payload; nothing has moved"):
            record(options, person)
        assert not (tmp_path / "set").exists()
    else:
        result = record(options, person).to_json()
        assert result["experiments"] == ["chirp_payload"] and result["skipped"] == []
    (question,) = person.questions
    assert question.startswith("Mount the payload on joint 0 now") and "kg m2" in question


def test_a_payload_that_nobody_described_is_refused(robot: str, tmp_path: Path) -> None:
    values = yaml.safe_load(Path(robot).read_text())
    del values["joints"]["0"]["simulated"]["payload"]
    Path(robot).write_text(yaml.safe_dump(values))
    with pytest.raises(UsageError, match="payload of joint 0 is not known") as told:
        record(GapRecordOptions(robot, "0", short=True, payload=True, out=tmp_path / "set"), Silent())
    assert "gravity_cos_nm" in told.value.next_step


def test_a_second_recording_adds_to_the_set_and_none_is_overwritten(robot: str, tmp_path: Path) -> None:
    out = tmp_path / "set"
    record(GapRecordOptions(robot, "0", plan=plan_file(tmp_path, "breakaway"), out=out), Silent())
    record(GapRecordOptions(robot, "0", plan=plan_file(tmp_path, "second_posture"), out=out), Silent())
    loaded = ExperimentSet.load(out)
    assert [(e.name, e.run_order) for e in loaded.experiments] == [("breakaway", 0), ("second_posture", 1)]
    record(GapRecordOptions(robot, "0", plan=plan_file(tmp_path, "breakaway"), out=out), Silent())
    assert [e.name for e in ExperimentSet.load(out).experiments] == ["breakaway", "second_posture", "breakaway_2"]
    with pytest.raises(UsageError, match="experiment set already"):
        record(GapRecordOptions(robot, "0", short=True, out=out), Silent())
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.doc").write_text("mine")
    with pytest.raises(UsageError, match="something else"):
        record(GapRecordOptions(robot, "0", out=tmp_path / "other"), Silent())


def test_nothing_is_left_behind_when_the_person_says_no(robot: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing has moved"):
        record(GapRecordOptions(robot, "0", short=True, out=tmp_path / "set"), Refusing())
    assert not (tmp_path / "set").exists()
    assert not list((tmp_path / "runs").rglob("manifest.json"))


class StoppedAt(Silent):
    """A person who presses Ctrl-C when a phase begins."""

    def __init__(self, phase: str) -> None:
        self._phase = phase

    def event(self, event: Event) -> None:
        if isinstance(event, PhaseStarted) and event.phase == self._phase:
            raise Interrupted("stopped on request")


def test_an_interrupted_recording_gives_a_set_and_is_gone_on_with(robot: str, tmp_path: Path) -> None:
    out = tmp_path / "set"
    last = "second_posture"
    plan = plan_file(tmp_path, "breakaway", last)
    options = GapRecordOptions(robot, "0", plan=plan, seed=3, out=out)
    motion = catalogue_of(robot)[last].marked_motions[0].name
    first = record(options, StoppedAt(motion))
    assert first.ended.outcome == "interrupted" and first.experiments == ("breakaway",)
    run = first.ended.run
    assert first.ended.error is not None
    assert first.ended.error.next_step == f"continue with `frictid-hil gap record --resume {run}`"
    assert [e.name for e in ExperimentSet.load(out).experiments] == ["breakaway"]
    before = {path: path.read_bytes() for path in [*out.glob("*.csv"), *run.glob("*1.mcap"), run / "samples.mcap"]}
    plan.unlink()  # what was asked for stands in the run itself
    # A set of what there is, elsewhere; nothing moves.
    made = record(GapRecordOptions(resume=run, out=tmp_path / "made"), Refusing(), move=False)
    assert made.experiments == ("breakaway",)
    assert (tmp_path / "made" / "breakaway.csv").read_bytes() == before[out / "breakaway.csv"]
    # What is missing, into the set that it began.
    second = record(GapRecordOptions(resume=run), Silent())
    assert second.ended.error is None and second.experiments == ("breakaway", last) and second.place == out
    assert [e.name for e in ExperimentSet.load(out).experiments] == ["breakaway", last]
    assert {path: path.read_bytes() for path in before} == before
    with pytest.raises(UsageError, match="began otherwise: seed"):
        record(GapRecordOptions(resume=run, seed=4), Silent())


def catalogue_of(robot: str) -> dict[str, Experiment]:
    loaded = load_robot(robot)
    envelope = gap_record.envelope_of(loaded, loaded.to_setup().joint("0"), GapRecordOptions(robot, "0"))
    return dict(catalogue(envelope))


@pytest.mark.parametrize("place", ["/proc/nowhere", "file/set"])
def test_a_set_that_cannot_be_written_is_refused_before_anything_moves(robot: str, tmp_path: Path, place: str) -> None:
    (tmp_path / "file").write_text("not a folder")
    moved = AssertionError("the person was asked")

    class Asked(Silent):
        def confirm(self, plan: Plan, preflight: Preflight) -> bool:
            raise moved

    with pytest.raises(FrictidError, match="cannot be written to"):
        record(GapRecordOptions(robot, "0", short=True, out=tmp_path / place), Asked())
    assert not list((tmp_path / "runs").rglob("*"))


def test_a_log_that_no_list_names_is_not_written_over(robot: str, tmp_path: Path) -> None:
    out = tmp_path / "set"
    record(GapRecordOptions(robot, "0", plan=plan_file(tmp_path, "breakaway"), out=out), Silent())
    (out / "second_posture.csv").write_text("mine")
    record(GapRecordOptions(robot, "0", plan=plan_file(tmp_path, "second_posture"), out=out), Silent())
    assert (out / "second_posture.csv").read_text() == "mine" and (out / "second_posture_2.csv").exists()


def test_travel_beyond_the_limits_is_refused_before_anything_opens(robot: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not fit"):
        record(GapRecordOptions(robot, "0", centre_rad=2.1, out=tmp_path / "set"), Silent())


@pytest.mark.parametrize(
    "document",
    [None, [], {"schema": "frictid.robot/1"}, {"schema": SCHEMA}, {"schema": SCHEMA, "experiments": [3]}],
)
def test_what_is_no_plan_of_experiments_is_refused(document: object) -> None:
    with pytest.raises(UsageError):
        names_of_plan(document, "plan.yaml")


def test_every_experiment_starts_and_ends_at_rest_and_in_one_piece() -> None:
    envelope = Envelope.within(-2.9, 2.9, 3.0, centre_rad=0.2, travel_rad=0.4)
    experiments = catalogue(envelope)
    assert {*FULL} < set(experiments)
    for experiment in experiments.values():
        times = np.arange(0.0, experiment.duration_s, 1e-3)
        position = experiment.position_rad(times)
        steps = np.abs(np.diff(position))
        assert steps[:300].max() == 0.0
        assert steps[-300:].max() == 0.0
        assert steps.max() <= 1e-3 * max(envelope.velocity_rad_s, 0.4) * 1.001
        assert position[0] == experiment.start_rad
        assert position[-1] == pytest.approx(experiment.end_rad, abs=1e-12)
        parts = np.concatenate([m.position_rad(np.linspace(0.0, m.duration_s, 50)) for m in experiment.marked_motions])
        assert np.abs(parts).max() <= 2.9
    with pytest.raises(UsageError, match="no experiment"):
        chosen(["sines_small", "waltz"], envelope)


def test_recording_goes_on_with_what_tells_most_until_it_is_decided(robot: str, tmp_path: Path) -> None:
    out = tmp_path / "set"
    decided = record_until_decided(GapRecordOptions(robot, "0", out=out, payload=False), Silent(), 200.0)
    told = decided.to_json()
    assert told["outcome"] == "ok" and tuple(told["experiments"][:3]) == FIRST
    assert [e.name for e in ExperimentSet.load(out).experiments] == told["experiments"]
    assert told["duration_s"] <= 200.0 and told["ended_because"]
    assert told["diagnosis"]["verdict"] == "explained"
    assert told["diagnosis"]["causes"][0]["effect"] == "direction_asymmetry"


def test_what_is_not_decided_asks_for_more_until_time_or_experiments_run_out() -> None:
    asked = NextExperiment("chirp_fast tells", 10.0, ("a", "b"), {"experiments": ["chirp_fast"]})
    open_one = diagnosis_of("ambiguous", asked)
    possible = {"chirp": 10.0, "chirp_fast": 11.0, "breakaway": 20.0}
    assert _next(open_one, possible, ["chirp"], 30.0) == (["chirp_fast"], "chirp_fast tells")
    assert _next(open_one, possible, ["chirp", "chirp_fast"], 30.0)[0] == ["breakaway"]
    assert _next(open_one, possible, ["chirp"], 5.0) == ([], "chirp_fast would take 11 s, and 5 s are left")
    assert not _next(open_one, possible, list(possible), 99.0)[0]
    assert _next(diagnosis_of("none", None), possible, [], 99.0) == ([], "the verdict is none")


def diagnosis_of(verdict: str, asked: NextExperiment | None) -> Diagnosis:
    nothing = Figures(None, None, None)
    return Diagnosis("one", verdict, (), (), nothing, nothing, nothing, next_experiment=asked)


def test_until_decided_refuses_what_contradicts_it(robot: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="chooses the experiments itself"):
        record_until_decided(GapRecordOptions(robot, "0", short=True), Silent(), 200.0)
    with pytest.raises(UsageError, match="first experiments take"):
        record_until_decided(GapRecordOptions(robot, "0"), Silent(), 5.0)
