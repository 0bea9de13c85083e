"""Sets that lack something, and sets that are broken: null with a reason, a clear error, never a sure wrong cause."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import gap_sets
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from frictid_hil.errors import ConfigError, FrictidError, InputFileError
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal, read_log
from frictid_hil.simulation.effects import backlash, torque_delay

ASYMMETRY = {"direction_asymmetry": {"coulomb_share": 0.1, "viscous_share": 0.15}}


@pytest.fixture(scope="module")
def asymmetric() -> ExperimentSet:
    return gap_sets.make(ASYMMETRY)


def _each(experiments: ExperimentSet, change) -> ExperimentSet:
    return replace(experiments, experiments=tuple(change(e) for e in experiments.experiments))


@pytest.mark.slow
def test_without_controller_the_forward_figures_are_null_with_a_reason(asymmetric: ExperimentSet) -> None:
    d = diagnose(replace(asymmetric, nominal=replace(asymmetric.nominal, controller=None)))
    assert d.before.forward_torque_nm is None and "controller" in d.reasons["forward_torque_nm"]
    assert d.before.inverse_nm is not None
    assert d.causes and d.causes[0].effect == "direction_asymmetry"


@pytest.mark.slow
def test_nominal_with_nothing_but_a_joint(asymmetric: ExperimentSet) -> None:
    d = diagnose(replace(asymmetric, nominal=Nominal()))
    assert "friction" in d.reasons and "inertia" in d.reasons
    assert d.improved_model() is None
    assert not any(c.confidence >= 0.9 and c.effect != "direction_asymmetry" for c in d.causes)


@pytest.mark.slow
def test_rigid_body_torque_from_elsewhere(asymmetric: ExperimentSet) -> None:
    def given_rigid(e: Experiment) -> Experiment:
        q, dt = e.position_rad, gap_sets.STEP_S
        acceleration = np.gradient(np.gradient(q, dt), dt)
        inertia = 0.4 + (0.1 if e.payload else 0.0)
        gravity = 4.0 + (3.0 if e.payload else 0.0)
        return replace(e, rigid_body_torque_nm=inertia * acceleration + gravity * np.cos(q))

    nominal = Nominal(curve=gap_sets.NOMINAL.curve, presliding_stiffness_nm_per_rad=20000.0)
    d = diagnose(replace(_each(asymmetric, given_rigid), nominal=nominal))
    assert d.causes and d.causes[0].effect == "direction_asymmetry"
    assert d.before.forward_torque_nm is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("inertia", "gravity", "cause", "share"),
    [(0.2, 4.0, "inertia_error", 1.0), (0.4, 6.0, "gravity_error", -1.0 / 3.0)],
)
def test_a_rigid_body_column_is_wrong_by_its_inertia_or_its_gravity(
    inertia: float, gravity: float, cause: str, share: float
) -> None:
    """Beside a column neither could be named: a torque constant, a ripple and a friction level stood in for both."""

    def given_rigid(e: Experiment) -> Experiment:
        q, torque = e.position_rad, e.torque_nm
        assert torque is not None
        acceleration = np.zeros_like(q)
        acceleration[1:-1] = np.diff(q, 2) / gap_sets.STEP_S**2
        own = np.append(0.5 * (torque[1:] + torque[:-1]), torque[-1])  # a column goes with the torque of its own row
        return replace(e, torque_nm=own, rigid_body_torque_nm=inertia * acceleration + gravity * np.cos(q))

    light = gap_sets.make(only=("sines_small", "sines_large", "triangle_slow", "chirp", "sines_repeat"))
    nominal = Nominal(curve=gap_sets.NOMINAL.curve, presliding_stiffness_nm_per_rad=20000.0)
    d = diagnose(replace(_each(light, given_rigid), nominal=nominal))
    assert d.verdict == "explained" and d.causes[0].effect == cause
    told = d.causes[0].parameters["error_share"]
    assert told.low is not None and told.high is not None and told.low < share < told.high < told.low + 0.2


@pytest.mark.slow
def test_one_log_alone_is_never_sure(asymmetric: ExperimentSet) -> None:
    one = replace(asymmetric, experiments=asymmetric.experiments[:1])
    d = diagnose(replace(one, nominal=replace(one.nominal, controller=None)))
    assert "gap" in d.reasons
    assert all(c.confidence < 0.9 for c in d.causes)


@pytest.mark.slow
def test_one_direction_only_is_never_sure(asymmetric: ExperimentSet) -> None:
    def rising(e: Experiment) -> Experiment:
        command = e.position_command_rad
        assert command is not None
        n = int(np.argmax(command))
        n = max(n, 300)
        return replace(
            e,
            time_s=e.time_s[:n],
            position_rad=e.position_rad[:n],
            velocity_rad_s=None,
            torque_nm=e.torque_nm[:n] if e.torque_nm is not None else None,
            position_command_rad=command[:n],
        )

    chosen = tuple(rising(e) for e in asymmetric.experiments if e.name in ("sines_large", "triangle_slow"))
    d = diagnose(replace(asymmetric, experiments=chosen))
    assert all(c.confidence < 0.9 for c in d.causes)


@pytest.mark.slow
def test_position_and_command_alone() -> None:
    made = gap_sets.make()

    def late(e: Experiment) -> Experiment:
        assert e.position_command_rad is not None
        position = np.interp(e.time_s - 0.06, e.time_s, e.position_command_rad)
        return replace(e, position_rad=position, torque_nm=None, velocity_rad_s=None)

    d = diagnose(replace(_each(made, late), nominal=Nominal()))
    assert d.causes[0].effect == "torque_delay"
    # A delay and a first-order lag of a tenth of it move a slow command alike.
    late_s = sum(value.value for name, value in d.causes[0].parameters.items() if name in ("delay_s", "lag_s"))
    assert late_s == pytest.approx(0.06, abs=0.003)
    assert d.before.inverse_nm is None and "torque" in d.reasons["inverse_nm"]


@pytest.mark.slow
def test_play_on_one_sinusoid_is_ambiguous_with_a_gain() -> None:
    time = 0.02 * np.arange(1500)
    command = 0.4 * np.sin(1.0 * time)
    position = backlash.behind_play(torque_delay.delayed(command, 0.08, 0.02), 0.03, 0.02)
    log = Experiment("backlash_detection", False, False, 0, time, position, position_command_rad=command)
    d = diagnose(ExperimentSet("one", Nominal(), (log,)))
    assert d.verdict == "ambiguous" and d.next_experiment is not None and d.next_experiment.duration_s > 0
    assert all(c.confidence < 0.9 for c in d.causes)


@pytest.mark.slow
def test_jittered_clock_still_finds_the_cause(asymmetric: ExperimentSet) -> None:
    random = np.random.default_rng(5)

    def jitter(e: Experiment) -> Experiment:
        time = e.time_s + 0.0004 * random.uniform(-1, 1, e.time_s.size)

        def at(column):
            return np.interp(time, e.time_s, column)

        return replace(
            e,
            time_s=time,
            position_rad=at(e.position_rad),
            torque_nm=at(e.torque_nm),
            velocity_rad_s=None,
            position_command_rad=at(e.position_command_rad),
        )

    d = diagnose(_each(asymmetric, jitter))
    assert "direction_asymmetry" in [c.effect for c in d.causes]


def _broken(kind: str, e: Experiment) -> Experiment:
    torque = e.torque_nm
    assert torque is not None and e.position_command_rad is not None
    match kind:
        case "degrees":
            return replace(e, position_rad=np.degrees(e.position_rad))
        case "swapped torque":
            return replace(e, torque_nm=-torque)
        case "swapped position":
            return replace(e, position_rad=-e.position_rad)
        case "constant position":
            return replace(e, position_rad=np.zeros_like(torque))
        case "constant torque":
            return replace(e, torque_nm=np.ones_like(torque))
        case "backwards":
            return replace(e, time_s=e.time_s[::-1])
        case "nan":
            broken = torque.copy()
            broken[7] = np.nan
            return replace(e, torque_nm=broken)
    return replace(
        e, **{c: getattr(e, c)[:50] for c in ("time_s", "position_rad", "torque_nm", "position_command_rad")}
    )


@pytest.mark.parametrize(
    "kind",
    [
        "degrees",
        "swapped torque",
        "swapped position",
        "constant position",
        "constant torque",
        "backwards",
        "nan",
        "short",
    ],
)
def test_unusable_logs_are_refused(asymmetric: ExperimentSet, kind: str) -> None:
    with pytest.raises(InputFileError):
        diagnose(_each(asymmetric, lambda e: _broken(kind, e)))


def _write(folder: Path, text: str, nominal: dict[str, object] | None = None) -> None:
    document = nominal or {"joint": {}, "experiments": [{"name": "a", "role": "identification"}]}
    (folder / "nominal.yaml").write_text(yaml.safe_dump(document))
    (folder / "a.csv").write_text(text)


def test_missing_column_empty_log_and_missing_file(tmp_path: Path) -> None:
    _write(tmp_path, "time_s,torque_nm\n0,1\n1,2\n")
    with pytest.raises(InputFileError, match="position_rad"):
        ExperimentSet.load(tmp_path)
    _write(tmp_path, "time_s,position_rad,torque_nm\n")
    with pytest.raises(InputFileError):
        ExperimentSet.load(tmp_path)
    (tmp_path / "a.csv").unlink()
    with pytest.raises(InputFileError, match="no such log"):
        ExperimentSet.load(tmp_path)
    with pytest.raises(ConfigError):
        ExperimentSet.load(tmp_path / "nowhere")


def test_gzip_and_unknown_columns(tmp_path: Path) -> None:
    with gzip.open(tmp_path / "a.csv.gz", "wt") as file:
        file.write("time_s,position_rad,torque_nm,humour\n0,0,1,2\n0.1,1,1,2\n")
    samples = read_log(tmp_path / "a.csv.gz")
    assert set(samples.columns()) == {"position_rad", "torque_nm"}


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=200))
def test_reader_never_leaks_a_foreign_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.mktemp("log") / "a.csv"
    path.write_text("time_s,position_rad,torque_nm\n" + text, encoding="utf-8")
    try:
        samples = read_log(path)
    except FrictidError:
        return
    assert np.all(np.isfinite(samples.position_rad))
