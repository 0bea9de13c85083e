"""The plant channel: measured torque against what the believed joint asks for along the measured motion."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.config.nominal import ReportFilter
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.channel import (
    FAMILY,
    STIFFNESS,
    Builder,
    Channel,
    Rows,
    Term,
    effect_prior,
    of_each_log,
    rows_of,
    taken,
)
from frictid_hil.gap.experiment_set import Nominal
from frictid_hil.gap.generic import WHOLE, families
from frictid_hil.gap.noise import LOCAL_S
from frictid_hil.gap.nuisances import bent_rate_nm, nuisances
from frictid_hil.gap.position_noise import differenced_rms, quiet_views, white_rms
from frictid_hil.gap.residuals import LowPass, Recording, first_slide, reported, rms
from frictid_hil.gap.rigid_column import about_its_level
from frictid_hil.simulation.effects import all_effects
from frictid_hil.simulation.inverse import View

BEYOND = 6.0
"""One-sigma of a belief that is plainly wrong, over its tolerance, at least: then the tolerance says little more."""
SIZES = (0.1, 0.3, 1.0)  # sizes of a generic function, over what a cause may well make: half decades
BANDS_HZ = (20.0, 40.0, 80.0, 160.0)  # cut-offs to choose from
BENT = "bent"  # shape of an error of what depends on speed, where the curve bends below its first pair
EACH_LOG = "each log"  # family of what differs from log to log, and says nothing of a further one
SEVERAL = 3  # logs from which on what is of one log alone can be told from what is of all
SWAMPED = 3.0
"""Noise of the position over that of the median row, from which on a row tells nothing: a ninth of the others."""
UNTOLD = 0.1  # the same over the friction level, below which a row does tell something
LINE_ROWS = 20_000  # rows of a log by which lines are looked for at most
LINE_SHARE = 0.1
"""Part of what a low-pass takes away that a line over position must describe to be let through; noise gives 1e-3."""


def plant_channel(
    nominal: Nominal,  # the believed joint
    recordings: Sequence[Recording],  # all logs of the set
    library: Collection[str],  # effects that may be used
    # ``inertia`` and ``friction`` where they were fitted to these logs, so that they are free.
    estimated: Collection[str],
    # The believed joint recorded as the same logs, where it can be simulated: what it shows is no gap.
    believed: Sequence[Recording] = (),
    # The same with its encoder's steps: what they make of the rows is noise where it is louder than the position's own.
    stepped: Sequence[Recording] = (),
    *,
    lines: bool = True,  # lines over position may widen the band
) -> Channel | None:
    """The channel of a set; None where no log has a torque."""
    logs = [r for r in recordings if r.view is not None and r.plant_nm is not None]
    if not logs:
        return None
    report = nominal.torque_report_filter
    residuals = [plant_residual(r, report) for r in logs]
    if believed:
        residuals = [left - plant_residual(b, report) for left, b in zip(residuals, believed, strict=True)]
    views, noises = quiet_views(nominal, logs)
    if stepped:
        pairs = zip(stepped, believed, strict=True)
        folded = [plant_residual(one, report) - plant_residual(other, report) for one, other in pairs]
        noises = [max(pair, key=rms) for pair in zip(noises, folded, strict=True)]
    measured = [r.view for r in logs if r.view is not None]
    friction_nm = rms(np.concatenate([v.coulomb_nm * v.slip + v.rate_nm for v in views]))
    gap_nm = rms(np.concatenate([logs[0].low_pass(residual)[5:-5] for residual in residuals]))
    scale = min(friction_nm / 3.0, gap_nm)
    builder, known, candidates = terms_of(nominal, views, measured, logs, library, estimated, scale)
    low_pass = band(residuals, logs[0].low_pass, candidates if lines else (), builder.parts)
    rows = []
    for r, v, residual, noise, columns in zip(logs, measured, residuals, noises, builder.parts, strict=True):
        held = first_slide(v.position_rad, 3.0 * v.coulomb_nm / v.stiffness_nm_per_rad)
        first = min(held // low_pass.stride + 1, len(range(0, residual.size, low_pass.stride)) // 3)
        rows.append(rows_of(r, columns, residual, low_pass, first=first, known_noise=noise, report=report))
    step_s, white = logs[0].step_s * low_pass.stride, white_nm(logs, low_pass)
    rows = [no_louder(row) for row in without_nuisances(rows, known, candidates)]
    rows = heard(rows, white, views[0].coulomb_nm, step_s)
    raw = _raw(logs, residuals, noises)
    known_floor = math.hypot(white, rms(np.concatenate([log.known_noise[log.told] for log in rows])))
    known_floor = math.inf if logs[0].experiment.smoothed else known_floor
    return Channel(
        "plant", step_s, tuple(rows), tuple(known), tuple(candidates), scale, low_pass.cutoff_hz, raw, known_floor
    )


def terms_of(
    nominal: Nominal,
    views: Sequence[View],  # what columns are made of
    measured: Sequence[View],  # whose torque tells which shapes to try
    logs: Sequence[Recording],
    library: Collection[str],
    estimated: Collection[str],
    scale: float,  # what a cause may well make
) -> tuple[Builder, list[Term], list[Term]]:
    """(columns, nuisances, candidates): the ways in which a joint may differ along its motion."""
    builder = Builder([[] for _ in logs])
    known = nuisances(nominal, views, logs, builder, estimated)
    candidates = _causes(library, views, measured, known, scale, builder)
    if bent_nm := bent_rate_nm(nominal, views):
        numbers = builder.add(bent_nm)
        errors = [t for t in candidates if t.effect == "viscous_error"]
        candidates += [replace(t, shape={BENT: 1.0}, columns=numbers) for t in errors]
    if all(r.experiment.rigid_body_torque_nm is not None for r in logs):
        candidates += about_its_level(candidates, builder)
    generic = families(views)
    if sum(not r.experiment.validation for r in logs) >= SEVERAL:
        generic[EACH_LOG] = of_each_log([np.stack([np.ones_like(v.slip), v.slip], axis=1) for v in views])
    candidates += families_of(generic, scale, builder)
    return builder, known, candidates


def _causes(
    library: Collection[str],
    views: Sequence[View],
    measured: Sequence[View],
    known: Sequence[Term],
    scale: float,
    builder: Builder,
) -> list[Term]:
    """Every effect of the library: beliefs that are plainly wrong, and what no belief speaks of."""
    candidates = []
    for name in (n for n in all_effects() if n in library):
        form = all_effects()[name].inverse
        if form is None:
            continue
        told = [t for t in known if t.effect == name and STIFFNESS not in t.shape]
        for term in told:
            columns = [taken(part, term.columns) for part in builder.parts]
            _, visible = effect_prior(name, {}, columns, scale, form.bounds)
            deviation = np.maximum(BEYOND * term.deviation, visible)
            candidates.append(Term(name, term.shape, term.columns, term.mean, deviation, *form.bounds, form.bounded))
        for shape in () if told else form.grid_for(measured):
            columns = form.regressors(views, shape)
            mean, deviation = effect_prior(name, shape, columns, scale, form.bounds)
            numbers = builder.add(columns)
            candidates.append(Term(name, shape, numbers, mean, deviation, *form.bounds, form.bounded))
    if "presliding_hysteresis" in library:
        wrong = [t for t in known if t.effect == "presliding_hysteresis"]
        candidates += [replace(t, deviation=BEYOND * t.deviation) for t in wrong]
    return candidates


def families_of(generic: Mapping[str, Sequence[Array]], scale: float, builder: Builder) -> list[Term]:
    """Families of generic functions by name, each at the sizes that it may have."""
    numbers = {name: builder.add(columns) for name, columns in generic.items()}
    return [_family(n, size * scale, numbers[n], columns) for n, columns in generic.items() for size in SIZES]


def _family(name: str, size: float, numbers: tuple[int, ...], columns: Sequence[Array]) -> Term:
    """A family of generic functions whose sum has about the given size."""
    squares = sum(np.sum(block**2, axis=0) for block in columns)
    each = np.sqrt(squares / sum(block.shape[0] for block in columns))
    count = int(np.count_nonzero(each > 1e-9 * max(float(each.max()), 1e-300)))
    deviation = np.where(each > 1e-9 * each.max(), size / (math.sqrt(max(count, 1)) * np.maximum(each, 1e-300)), 0.0)
    return Term(FAMILY + name, {"size": size}, numbers, np.zeros(each.size), deviation)


def _raw(logs: Sequence[Recording], residuals: Sequence[Array], noises: Sequence[Array]) -> tuple[float, float]:
    """(RMS of the residual of the validation logs before any filter, what noise of torque and position leaves), N m.

    A torque that was smoothed after it was recorded can be compared behind that filter alone.
    """
    chosen = [k for k, r in enumerate(logs) if r.experiment.validation] or list(range(len(logs)))
    smoothed = logs[0].experiment.smoothed
    gap = rms(np.concatenate([logs[k].low_pass(residuals[k]) if smoothed else residuals[k] for k in chosen]))
    white = [white_rms(t) for k in chosen if (t := logs[k].experiment.torque_nm) is not None]
    own = [differenced_rms(t) for k in chosen if (t := logs[k].experiment.rigid_body_torque_nm) is not None]
    noise = math.hypot(rms(np.concatenate([noises[k] for k in chosen])), rms(np.array(white)))
    return gap, min(gap, math.hypot(noise, rms(np.array(own)) if own else 0.0))


def white_nm(logs: Sequence[Recording], low_pass: LowPass) -> float:
    """RMS that white noise of the torque leaves behind the low-pass, N m."""
    white = [white_rms(t) for r in logs if (t := r.experiment.torque_nm) is not None]
    return low_pass.white_gain * rms(np.array(white))


def no_louder(row: Rows) -> Rows:
    """A log whose known noise is no louder than its residual: a coarse count that stands still makes none."""
    heard, known = rms(row.y), rms(row.known_noise)
    return row if known <= heard else replace(row, known_noise=row.known_noise * (heard / known))


def heard(rows: Sequence[Rows], white_nm: float, coulomb_nm: float, step_s: float) -> list[Rows]:
    """The logs, those rows marked in which noise of the position is much louder than in most: of a stuck spring.

    A coarse encoder does not say how far a stuck joint has bent its spring, and so not which torque it asks for.
    """
    window = np.full(round(LOCAL_S / step_s) + 1, 1.0) / (round(LOCAL_S / step_s) + 1)
    local = [np.sqrt(np.convolve(log.known_noise**2, window, mode="same") + white_nm**2) for log in rows]
    most_nm = max(SWAMPED * float(np.median(np.concatenate(local))), UNTOLD * coulomb_nm)
    return [replace(log, told=size <= most_nm) for log, size in zip(rows, local, strict=True)]


def without_nuisances(logs: Sequence[Rows], nuisances: Sequence[Term], candidates: Sequence[Term]) -> list[Rows]:
    """The logs with that part of generic functions taken off which the belief's own tolerances can say."""
    whole = (EACH_LOG, *WHOLE)
    known = [c for term in nuisances for c in term.columns]
    families = [t for t in candidates if t.effect.startswith(FAMILY) and t.effect.removeprefix(FAMILY) not in whole]
    generic = sorted({c for term in families for c in term.columns})
    x = np.concatenate([log.x for log in logs])
    weights = np.linalg.pinv(x[:, known]) @ x[:, generic]
    result = []
    for log in logs:
        table = log.x.copy()
        table[:, generic] -= log.x[:, known] @ weights
        result.append(replace(log, x=table))
    return result


def band(
    residuals: Sequence[Array], usual: LowPass, candidates: Sequence[Term], parts: Sequence[Sequence[Array]]
) -> LowPass:
    """The low-pass: the usual one, or as much wider as lines over position need that stand above 20 Hz.

    Noise of the position grows with frequency, so that no more is let through than a cause can use.
    """
    rate = usual.rate_hz
    if usual.cutoff_hz < BANDS_HZ[0]:
        return usual
    usable = [hertz for hertz in BANDS_HZ if hertz <= 0.2 * rate]
    lines = [t for t in candidates if t.effect in all_effects() and all_effects()[t.effect].is_line]
    if len(usable) == 1 or not lines:
        return LowPass(rate, usable[0])
    tables = [[taken(part, t.columns, LINE_ROWS) for part in parts] for t in lines]
    worth = [h for h in usable if max(_described(residuals, table, LowPass(rate, h)) for table in tables) > LINE_SHARE]
    return LowPass(rate, next((h for h in usable if not worth or h > worth[-1]), usable[-1]))


def _described(residuals: Sequence[Array], tables: Sequence[Array], low_pass: LowPass) -> float:
    """Share of what a low-pass takes away that some columns describe in rows that they were not fitted to."""
    halves: list[list[Array]] = [[], []]
    for residual, table in zip(residuals, tables, strict=True):
        rows = table.shape[0]
        joined = np.concatenate([table, residual[:rows, None]], axis=1)
        high = joined - low_pass(joined)
        halves[0].append(high[: rows // 2])
        halves[1].append(high[rows // 2 :])
    known, unseen = np.concatenate(halves[0]), np.concatenate(halves[1])
    weights = np.linalg.lstsq(known[:, :-1], known[:, -1], rcond=None)[0]
    left = unseen[:, -1] - unseen[:, :-1] @ weights
    return 1.0 - float(left @ left) / max(float(unseen[:, -1] @ unseen[:, -1]), 1e-300)


def plant_residual(recording: Recording, report: ReportFilter | None) -> Array:
    """Reported torque less what the believed joint asks for, as the drive reports it, N m, shape (n,)."""
    view, plant = recording.view, recording.plant_nm
    assert view is not None and plant is not None
    asked = view.torque_nm - plant
    return plant if report is None else view.torque_nm - reported(asked, report, recording.step_s)
