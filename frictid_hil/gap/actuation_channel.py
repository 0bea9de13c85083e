"""The actuation channel: measured torque against the controller's demand, replayed on the measured position."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import Builder, Channel, Term, of_each_log, rows_of
from frictid_hil.gap.command_timing import FASTEST, between_rows
from frictid_hil.gap.drive_replay import DriveReplay, forms, with_one
from frictid_hil.gap.experiment_set import Controller, Nominal, with_gains
from frictid_hil.gap.gain_errors import gain_errors
from frictid_hil.gap.plant_channel import BEYOND, families_of, white_nm, without_nuisances
from frictid_hil.gap.residuals import LowPass, Recording, demand_of, demand_parts, held, reported, rms, settled
from frictid_hil.simulation.drive_form import ActuationForm, DriveView
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.inverse_loops import lagged

SLOWEST = 10
"""Control ticks to a row of the log up to which what the controller did between two rows can be told from them."""
WITHIN_ROWS = 0.3
"""One-sigma of when a command took effect and a velocity was taken, in rows of a log slower than its controller."""
NEAREST = (1.0 / math.sqrt(2.0), math.sqrt(2.0))
"""Coefficients of a time: values to try at most double, so that the nearest one is no further from the true one."""


def why_not_replayed(nominal: Nominal, recordings: Sequence[Recording]) -> str | None:
    """Why the controller's demand cannot be formed; None where it can."""
    logs = [r for r in recordings if r.experiment.torque_nm is not None and r.demand_nm is not None]
    if not logs:
        return "no controller is known, so nothing stands against the reported torque but the joint"
    controller = nominal.controller
    if controller is None:
        return None
    ticks = [controller.rate_hz * r.step_s for r in logs]
    if max(ticks) > SLOWEST or min(ticks) < 1.0 / FASTEST:
        return "the logs are much slower than the controller, or faster, so its demand cannot be replayed"
    return None


def actuation_channel(
    nominal: Nominal,  # the believed joint
    recordings: Sequence[Recording],  # all logs of the set
    library: Collection[str],  # effects that may be used
    seen: Mapping[str, float],  # effect -> value found in the kinematic channel
    # The believed joint recorded as the same logs, where it can be simulated: what it shows is no gap.
    believed: Sequence[Recording] = (),
) -> Channel | None:
    """The channel of a set; None where the demand cannot be formed."""
    if why_not_replayed(nominal, recordings) is not None:
        return None
    logs = [r for r in recordings if r.experiment.torque_nm is not None and r.demand_nm is not None]
    controller = nominal.controller
    limit_nm = math.inf if controller is None else controller.torque_limit_nm
    drives = [DriveReplay.of(r, nominal) for r in logs]
    base = [drive.torque(nominal.believed_effects) for drive in drives]
    shown = _residuals([DriveReplay.of(r, nominal) for r in believed], nominal) or [np.zeros(b.size) for b in base]
    residuals = [left - own for left, own in zip(_residuals(drives, nominal), shown, strict=True)]
    # A drive acts on what the controller asks for, and that on the velocity it sees: the one that was read to lag.
    lags = any(form.torque is None and name in seen for name, form in forms().items())
    shares = gain_errors(nominal, logs, shown, library, lags=lags).tolist()
    views = [_view(r, controller, limit_nm, shares) for r in logs]
    builder = Builder([[] for _ in logs])
    nuisances, candidates = _gains(nominal, views, builder, library)
    nuisances += _timing(nominal, base, logs, builder)
    # And on what wrong gains ask for.
    found = nominal if controller is None else replace(nominal, controller=with_gains(controller, shares))
    drives = [DriveReplay.of(r, found) for r in logs]
    asking = [DriveReplay.of(r, found, as_reported=True) for r in logs] if lags else drives
    scale = rms(np.concatenate(residuals))
    for name, form in forms().items():
        if name not in library:
            continue
        for value, columns in _shapes(name, form, views, drives, asking, nominal, seen):
            numbers = builder.add(columns)
            spread, ends = (0.3, NEAREST) if form.late else (0.1, (-math.inf, math.inf))
            candidates.append(Term(name, value, numbers, np.ones(1), np.full(1, spread), *ends))
    candidates += families_of(_generic(logs, base), scale, builder)
    low_pass, report = logs[0].low_pass, nominal.torque_report_filter
    told = zip(logs, builder.parts, residuals, strict=True)
    rows = [rows_of(r, columns, residual, low_pass, report=report) for r, columns, residual in told]
    rows = without_nuisances(rows, nuisances, candidates)
    between = any(r.resampled or between_rows(controller, r.step_s) for r in logs)
    return Channel(
        "actuation",
        logs[0].step_s * low_pass.stride,
        tuple(rows),
        tuple(nuisances),
        tuple(candidates),
        scale,
        low_pass.cutoff_hz,
        # A demand that is known exactly leaves the torque's own noise, and nothing that a model may take for noise.
        known_floor=math.inf if between or logs[0].experiment.smoothed else white_nm(logs, low_pass),
        between_rows=between,
    )


def _view(recording: Recording, controller: Controller | None, limit_nm: float, shares: Sequence[float]) -> DriveView:
    e = recording.experiment
    assert e.torque_nm is not None and recording.demand_nm is not None
    parts: Array = np.empty((0, 3))
    if controller is not None and e.torque_demand_nm is None:
        parts = demand_parts(controller, e, recording.step_s, shares)
    return DriveView(recording.step_s, limit_nm, recording.demand_nm, e.torque_nm, parts)


def _gains(
    nominal: Nominal, views: Sequence[DriveView], builder: Builder, library: Collection[str]
) -> tuple[list[Term], list[Term]]:
    """Errors of the demand itself: inside their tolerance, and beyond it."""
    nuisances, candidates = [], []
    for name, effect in all_effects().items():
        if effect.demand is None or not all(v.parts_nm.size for v in views):
            continue
        columns = [np.concatenate([np.zeros((1, c.shape[1])), c[:-1]]) for c in effect.demand.regressors(views)]
        numbers, count = builder.add(columns), columns[0].shape[1]
        sigma = getattr(nominal.tolerances, effect.belief).relative
        if sigma > 0.0:
            nuisances.append(Term(name, {}, numbers, np.zeros(count), np.full(count, sigma)))
        if name in library:
            beyond = BEYOND * max(sigma, 0.02)
            candidates.append(Term(name, {}, numbers, np.zeros(count), np.full(count, beyond)))
    return nuisances, candidates


def _timing(nominal: Nominal, base: Sequence[Array], logs: Sequence[Recording], builder: Builder) -> list[Term]:
    """What a delay or lag within its tolerance leaves, per second."""
    tolerances = nominal.tolerances
    columns = [-np.gradient(b, r.step_s)[:, None] for b, r in zip(base, logs, strict=True)]
    report = nominal.torque_report_filter
    unsure_s = 0.5 * report.order * report.time_constant_s if report else 0.0
    numbers = builder.add(columns)
    level = of_each_log([np.ones((b.size, 1)) for b in base])
    # The integral of the controller is unknown where a log begins.
    start = Term("", {}, builder.add(level), np.zeros(len(base)), np.full(len(base), rms(np.concatenate(base))))
    terms = [start, Term("torque_delay", {}, numbers, np.zeros(1), np.array([tolerances.torque_delay_s.of(0.0)]))]
    if unsure_s > 0.0:
        terms.append(Term("", {}, numbers, np.zeros(1), np.array([unsure_s])))
    if all(between_rows(nominal.controller, r.step_s) and r.experiment.torque_demand_nm is None for r in logs):
        for changed in zip(*(_between_rows(nominal, r) for r in logs), strict=True):
            terms.append(Term("", {}, builder.add(changed), np.zeros(1), np.array([WITHIN_ROWS])))
    return terms


def _between_rows(nominal: Nominal, recording: Recording) -> tuple[Array, Array]:
    """What a row does not tell of a faster controller, as changes of the demand per row, shape (n, 1) each.

    A command may be held until the next one, interpolated, or sent late; a velocity may be of now or of some ticks ago.
    """
    e, step_s = recording.experiment, recording.step_s
    assert nominal.controller is not None and e.position_command_rad is not None
    assert recording.demand_nm is not None
    late = replace(e, position_command_rad=held(e.position_command_rad))
    command = demand_of(nominal.controller, late, step_s) - recording.demand_nm
    velocity = demand_of(nominal.controller, e, step_s, step_s) - recording.demand_nm
    return held(command)[:, None], held(velocity)[:, None]


def _shapes(
    name: str,
    form: ActuationForm,
    views: Sequence[DriveView],
    drives: Sequence[DriveReplay],
    asking: Sequence[DriveReplay],
    nominal: Nominal,
    seen: Mapping[str, float],
) -> list[tuple[dict[str, float], list[Array]]]:
    """(parameters, columns) of one effect at every value worth trying."""
    believed = nominal.believed_effects
    base = [drive.torque(believed) for drive in asking]
    result: list[tuple[dict[str, float], list[Array]]] = []
    if form.torque is None and nominal.controller is None:
        return result
    for value in form.guesses(views, seen.get(name)):
        for detail in form.details or (0.0,):
            values = {form.parameter: float(value), **({form.detail: detail} if form.detail else {})}
            if form.torque is None:
                base, changed = [drive.torque(believed) for drive in drives], base
            else:
                effects = with_one(believed, name, form, float(value), detail)
                changed = [drive.torque(effects) for drive in asking]
            result.append((values, [(c - b)[:, None] for c, b in zip(changed, base, strict=True)]))
    return result


def _generic(logs: Sequence[Recording], base: Sequence[Array]) -> dict[str, list[Array]]:
    """Families of functions of demand and motion that no effect of a drive names."""
    top_nm = max(float(np.max(np.abs(b))) for b in base)
    table: dict[str, list[Array]] = {"demand": [], "late demand": [], "motion": [], "time": []}
    for k, (log, demand) in enumerate(zip(logs, base, strict=True)):
        q, t = log.experiment.position_rad, demand / top_nm
        step_s = log.step_s
        velocity = LowPass.at(1.0 / step_s)(np.gradient(q, step_s))
        acceleration = np.gradient(velocity, step_s)
        table["demand"].append(top_nm * np.stack([t, t * np.abs(t), t**3, np.abs(t)], axis=1))
        late = [lagged(demand, step_s, lag) - demand for lag in (0.003, 0.01, 0.03, 0.1)]
        table["late demand"].append(np.stack([*late, np.gradient(demand, step_s)], axis=1))
        places = [np.cos(q), np.sin(q), velocity, np.abs(velocity), np.sign(velocity), acceleration]
        table["motion"].append(np.stack(places, axis=1))
        clock = np.linspace(0.0, 1.0, q.size) + k
        table["time"].append(np.stack([clock, clock * demand, clock**2 * demand], axis=1))
    return table


def _residuals(drives: Sequence[DriveReplay], nominal: Nominal) -> list[Array]:
    """Reported torque less the believed one, as the drive reports it, N m, shape (n,) per recording."""
    report = nominal.torque_report_filter
    left = []
    for drive in drives:
        r, torque = drive.recording, drive.recording.experiment.torque_nm
        assert torque is not None
        left.append(settled(torque - reported(drive.torque(nominal.believed_effects), report, r.step_s), r.step_s))
    return left
