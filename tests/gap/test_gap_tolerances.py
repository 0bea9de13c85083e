"""What a nominal.yaml may say of its own numbers, and the sets that are legal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import gap_sets
import numpy as np
import pytest
import yaml

from frictid_hil.config.profile import Estimate, JointProfile
from frictid_hil.errors import ConfigError, InputFileError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import Builder, taken
from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.experiment_set import LOG_COLUMNS, Controller, Experiment, ExperimentSet
from frictid_hil.gap.forward import nominal_model
from frictid_hil.gap.nuisances import bent_rate_nm, nuisances
from frictid_hil.gap.posterior import FORM
from frictid_hil.gap.residuals import (
    controller_demand,
    demand_of,
    demand_parts,
    friction_scales,
    presliding_state,
    recordings,
    rms,
    slip_state,
)
from frictid_hil.gap.sanity import checked
from frictid_hil.gap.tolerances import RELATIVE_BY_KIND, Tolerances, stated_by
from frictid_hil.simulation.replay import Controller as Loop
from frictid_hil.simulation.replay import Simulated, closed_loop

TIME_S = 0.01 * np.arange(1000)


def _set(folder: Path, logs: dict[str, dict[str, Any]], **sections: Any) -> ExperimentSet:
    """A set on disk, read back; every log is a mapping of columns."""
    experiments = [{"name": name, "role": "identification"} for name in logs]
    document = {"joint": {"gear_ratio": 1}, **sections, "experiments": experiments}
    (folder / "nominal.yaml").write_text(yaml.safe_dump(document))
    for name, columns in logs.items():
        table = np.column_stack(list(columns.values()))
        np.savetxt(folder / f"{name}.csv", table, delimiter=",", header=",".join(columns), comments="")
    return ExperimentSet.load(folder)


def _moving(**more: Any) -> dict[str, Any]:
    return {"time_s": TIME_S, "position_rad": np.sin(TIME_S), "torque_nm": np.cos(TIME_S), **more}


def test_a_tolerance_is_a_share_or_an_absolute_number_or_a_kind(tmp_path: Path) -> None:
    told = {"inertia_kg_m2": 0.07, "friction_torque": "data_sheet", "absolute": {"gravity_torque_nm": 0.3}}
    tolerances = _set(tmp_path, {"a": _moving()}, tolerance=told).nominal.tolerances
    assert tolerances.inertia_kg_m2.of(-2.0) == pytest.approx(0.14)
    assert tolerances.gravity_torque_nm.of(40.0) == pytest.approx(0.3)
    assert tolerances.friction_torque.relative == RELATIVE_BY_KIND["friction_torque"]["data_sheet"]
    assert tolerances.viscous.source == "unstated" and tolerances.viscous.relative > 0.0
    assert tolerances.zero_offset_rad.of(0.0) > 0.0


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ({"inertia": 0.1}, "inertia"),
        ({"viscous": -0.1}, "greater than or equal to 0"),
        ({"viscous": "guess"}, "viscous"),
        ({"absolute": {"zero_offset": 0.1}}, "did you mean zero_offset_rad"),
    ],
)
def test_a_wrong_tolerance_is_told(tmp_path: Path, told: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        _set(tmp_path, {"a": _moving()}, tolerance=told)


def test_every_number_has_a_printed_default() -> None:
    lines = Tolerances.of().lines()
    assert len(lines) == len(fields(Tolerances))
    assert "inertia_kg_m2: 5 % (unstated)" in lines and "zero_offset_rad: 0.002 (unstated)" in lines


def test_a_profile_hands_on_its_own_intervals(tmp_path: Path) -> None:
    profile = JointProfile(
        method="least-squares",
        velocity_rad_s=(0.2, 0.4, 0.8),
        torque_nm=(3.0, 3.2, 3.6),
        torque_interval_nm=((2.9, 3.1), (3.1, 3.3), (3.5, 3.7)),
        coulomb_nm=Estimate(value=2.8),
        inertia_kg_m2=Estimate(value=0.5, low=0.451, high=0.549),
    )
    tolerances = _set(tmp_path, {"a": _moving()}, tolerance=stated_by(profile)).nominal.tolerances
    assert tolerances.inertia_kg_m2.of(0.5) == pytest.approx(0.025)
    assert tolerances.friction_torque.of(3.2) == pytest.approx(0.1 / 1.96)


def test_no_inertia_beside_a_rigid_body_column_is_legal(tmp_path: Path) -> None:
    joint = {"inertia_kg_m2": 0}
    assert _set(tmp_path, {"a": _moving(rigid_body_torque_nm=TIME_S)}, joint=joint).nominal.inertia_kg_m2 is None
    with pytest.raises(ConfigError, match="inertia_kg_m2 is 0"):
        _set(tmp_path, {"a": _moving()}, joint=joint)


def test_a_motor_that_turns_on_and_on_is_no_joint_in_degrees(tmp_path: Path) -> None:
    spinning = _moving(position_rad=8.0 * TIME_S + 0.1 * np.sin(3.0 * TIME_S))
    friction = {"coulomb_nm": 0.5, "viscous_nm_s_per_rad": 0.05}
    checked(_set(tmp_path, {"a": spinning}, joint={"continuous": True, "friction": friction}))
    geared = _set(tmp_path, {"a": spinning}, joint={"gear_ratio": 100})
    with pytest.raises(InputFileError, match="positions up to"):
        checked(geared)


def test_a_log_at_rest_is_left_out_and_named(tmp_path: Path) -> None:
    still = {"time_s": TIME_S, "position_rad": np.full_like(TIME_S, 0.3), "torque_nm": np.cos(TIME_S)}
    read = _set(tmp_path, {"a": _moving(), "still": still})
    assert [e.name for e in read.experiments] == ["a"] and read.at_rest == ("still",)
    with pytest.raises(InputFileError, match="never changes"):
        _set(tmp_path, {"still": still})


def test_a_recording_with_a_long_gap_goes_on_as_another_log(tmp_path: Path) -> None:
    time_s = np.where(np.arange(1000) < 400, TIME_S, TIME_S + 5.0)
    read = _set(tmp_path, {"a": _moving(time_s=time_s)})
    assert [(e.name, e.time_s.size) for e in read.experiments] == [("a, piece 1", 400), ("a, piece 2", 600)]


def test_a_declared_report_filter_is_read(tmp_path: Path) -> None:
    drive = {"torque_report_filter": {"order": 2, "time_constant_s": 0.004}}
    found = _set(tmp_path, {"a": _moving()}, drive=drive).nominal.torque_report_filter
    assert found is not None and (found.order, found.time_constant_s) == (2, 0.004)


def _law(folder: Path, told: dict[str, Any]) -> Controller:
    found = _set(folder, {"a": _moving()}, controller={"rate_hz": 100, **told}).nominal.controller
    assert found is not None
    return found


def test_a_cascade_is_replayed_by_its_own_law(tmp_path: Path) -> None:
    """kv*w + ki*integral(w), w = kp*e - v, stepped by hand."""
    kp, kv, ki, step_s = 12.0, 3.0, 5.0, 0.01
    command, q = np.sin(TIME_S), np.sin(TIME_S - 0.05) + 0.01
    law = _law(tmp_path, {"type": "p_pi", "kp": kp, "kv": kv, "ki": ki})
    velocity = np.diff(q, prepend=q[0]) / step_s
    wanted = kp * (command - q) - velocity
    by_hand = kv * wanted + ki * step_s * np.concatenate([[0.0], np.cumsum(wanted)[:-1]])
    replayed = controller_demand(law, q, command, step_s)
    difference = (replayed - by_hand)[1:]  # the first row has no velocity
    assert np.ptp(replayed) > 5.0
    assert np.ptp(difference) < 0.02 * np.ptp(replayed)  # a constant apart, which the start of the integral takes up


def test_feed_forward_is_added_along_the_command(tmp_path: Path) -> None:
    feed = {"inertia_kg_m2": 2.0, "gravity_cos_nm": 7.0, "viscous_nm_s_per_rad": 0.5}
    law = _law(tmp_path, {"kp": 12.0, "feedforward": feed})
    plain = replace(law, feedforward=None)
    command, q = np.sin(TIME_S), np.sin(TIME_S - 0.05)
    added = controller_demand(law, q, command, 0.01) - controller_demand(plain, q, command, 0.01)
    expected = -2.0 * np.sin(TIME_S) + 7.0 * np.cos(command) + 0.5 * np.cos(TIME_S)
    assert np.allclose(added[5:-5], expected[5:-5], atol=0.01)


@pytest.mark.parametrize("told", [{"type": "unknown"}, {"type": "columns"}], ids=["unknown", "columns"])
def test_a_law_may_be_unknown_or_a_column(tmp_path: Path, told: dict[str, Any]) -> None:
    read = _set(tmp_path, {"a": _moving(torque_demand_nm=np.sin(TIME_S))}, controller=told)
    assert read.nominal.controller is None
    assert read.experiments[0].torque_demand_nm is not None


def test_a_replay_follows_a_cascade() -> None:
    """The same cascade, replayed on the motion it made, asks for the torque it gave."""
    rows, command = _cascaded(CASCADE)
    asked = controller_demand(CASCADE, rows.position_rad, command, 0.002)
    error = (rows.torque_nm[1:] - asked[:-1])[50:]
    assert np.ptp(rows.torque_nm) > 5.0
    assert np.std(error) < 0.02 * np.std(rows.torque_nm)


def test_errors_of_a_cascades_gains_act_alike_in_demand_and_simulator() -> None:
    """kp 10 % higher, ki 20 % lower, kv 15 % lower: shares of kv*kp, ki*kp and kv, and ki with all three."""
    shares = {"kp_error_share": 1.1 * 0.85 - 1.0, "ki_error_share": 1.1 * 0.8 - 1.0, "kd_error_share": 0.85 - 1.0}
    rows, command = _cascaded(CASCADE, controller_gain_error=shares)
    time_s = 0.002 * np.arange(1500)
    log = Experiment(
        "a", False, False, 0, time_s, rows.position_rad, position_command_rad=command, torque_nm=rows.torque_nm
    )
    left = rows.torque_nm[1:] - demand_of(CASCADE, log, 0.002)[:-1]
    made = (demand_parts(CASCADE, log, 0.002, list(shares.values())) @ list(shares.values()))[:-1]
    assert np.std(left[50:]) > 10.0 * np.std((left - made)[50:])


CASCADE = replace(
    gap_sets.NOMINAL.controller, ki_nm_per_rad_s=2600.0, command_rate_weight=0.0, command_rate="backward", cascade=True
)


def _cascaded(law: Controller, **effects: Mapping[str, float]) -> tuple[Simulated, Array]:
    """The joint of the tests under a cascade, and its command, every 2 ms."""
    loop = Loop(**{f.name: getattr(law, f.name) for f in fields(Loop)})
    command = 0.3 * (1.0 - np.cos(2.0 * 0.002 * np.arange(1500)))
    joint = nominal_model(gap_sets.NOMINAL).with_effects(effects)
    return closed_loop(joint, loop, 0.002 * np.arange(1500), command), command


def test_the_page_shows_the_defaults_that_hold() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "experiment-set.md").read_text()
    for name, kinds in RELATIVE_BY_KIND.items():
        cells = " | ".join("exact" if share == 0.0 else f"{100 * share:.3g} %" for share in kinds.values())
        assert f"| `{name}` | {cells} |" in page


def test_what_depends_on_speed_begins_where_the_curve_does() -> None:
    """Friction that rises as the square root of speed is far lower at rest than a line through its first pairs says."""
    speeds = np.geomspace(0.02, 1.8, 12)
    curve = FrictionCurve.through(speeds, 2.6 + 1.6 * np.sqrt(speeds))
    nominal = replace(gap_sets.NOMINAL, curve=curve)
    (r, *_) = recordings(gap_sets.make(nominal=nominal, only=("sines_small",)))
    assert r.view is not None
    (bent,) = bent_rate_nm(nominal, [r.view])
    measured = (r.view.velocity_rad_s > 0.05) & (r.view.slip == 1.0)
    expected = 1.6 * np.sqrt(r.view.velocity_rad_s[measured])
    assert np.allclose(bent[measured, 0], expected, atol=0.02)
    assert not np.allclose(r.view.rate_nm[measured], expected, atol=0.1)
    straight = replace(nominal, curve=FrictionCurve.through(speeds, 2.6 + 1.6 * speeds))
    assert bent_rate_nm(straight, [r.view]) == []


def test_friction_turns_where_a_joint_turns_between_two_rows() -> None:
    """20 ms rows of a motion whose friction builds up within 4 ms: the rows alone do not tell when it turned.

    What a position's second difference is to be compared with is the mean about a row.
    """
    fine_s = np.arange(0.0, 6.0, 2e-4)
    fine, rows = 0.05 * np.sin(6.0 * fine_s) + 0.03 * np.sin(17.0 * fine_s), slice(None, None, 100)
    _, stiffness = friction_scales(gap_sets.NOMINAL)
    slip_per_rad = stiffness / friction_scales(gap_sets.NOMINAL)[0]
    triangle = np.bartlett(201)[1:-1] / 100
    true = np.convolve(np.pad(slip_state(fine, slip_per_rad), 99, mode="edge"), triangle, mode="valid")[rows]
    told, plain = presliding_state(gap_sets.NOMINAL, fine[rows]), slip_state(fine[rows], slip_per_rad)
    assert rms(told - true) < 0.4 * rms(plain - true)
    # Between the steps of a coarse encoder nothing is made up.
    stepped = 1e-3 * np.round(fine[rows] / 1e-3)
    assert np.array_equal(presliding_state(gap_sets.NOMINAL, stepped), slip_state(stepped, slip_per_rad))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "first"),
    [({}, "none"), ({"gravity_error": {"error_share": 0.12}}, "gravity_error")],
)
def test_a_log_of_50_hz_makes_no_rigid_joint_elastic(effect: dict[str, dict[str, float]], first: str) -> None:
    made = gap_sets.make(effect)

    def thinned(e: Experiment) -> Experiment:
        columns = {name: column[::10] for name in LOG_COLUMNS if (column := getattr(e, name)) is not None}
        return replace(e, **columns)

    slow = replace(
        made,
        nominal=replace(made.nominal, controller=None),
        experiments=tuple(thinned(e) for e in made.experiments),
    )
    found = diagnose(slow)
    assert (found.causes[0].effect if found.causes else found.verdict) == first


def test_nobody_knows_friction_below_a_first_pair_that_is_passed_in_reversals_alone() -> None:
    """Where the first pair is high, the recordings slide below it, and tell."""
    (r, *_) = recordings(gap_sets.make(only=("sines_large",)))
    assert r.view is not None
    counts = {}
    for first in (0.02, 0.5):
        curve = FrictionCurve.through(np.array([first, 0.8, 1.8]), np.array([3.2, 3.2, 3.2]))
        builder = Builder([[]])
        terms = nuisances(replace(gap_sets.NOMINAL, curve=curve), [r.view], [r], builder, ())
        counts[first] = len(terms)
        if first == 0.02:
            near_rest = taken(builder.parts[0], terms[-1].columns)[:, 0]
    assert counts[0.02] == counts[0.5] + 1
    assert np.max(np.abs(near_rest)) == pytest.approx(FORM * 3.2, rel=0.2)
    assert not np.any(near_rest[np.abs(r.view.velocity_rad_s) > 0.02])
