"""A first ``nominal.yaml`` from recordings alone: least squares of the plainest joint, each number with its tolerance.

``torque = inertia*acc + gravity_cos*cos(q) + gravity_sin*sin(q) + bias + coulomb*s + viscous*v``, every column behind
the same low-pass, below the edge of a script's where one has smoothed the torque; s is the slip spring of equation
(20). Standard errors allow for residuals that hang together in time and for how far the halves of the recordings
disagree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from frictid_hil.errors import InputFileError
from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet
from frictid_hil.gap.residuals import LowPass, slip_state, uniform
from frictid_hil.gap.smoothing import as_smoothed

SLIP_RAD = 2e-4  # travel in which the slip spring yields, and friction builds up, where nobody measured it
SPEEDS = 8  # points of the drafted friction curve
SHORT_RAD = 0.3
"""Travel below which gravity's shape over the position is not told from a constant; so too of a linear axis."""
LEAST_LEVEL = 2e-3  # friction level written at least, over the viscous torque at top speed: four digits still hold it
LEAST_TOLERANCE = 0.005  # no number of a least-squares draft is worth more than this share
LARGEST_TOLERANCE = 0.5
"""A number less certain than this share of itself is next to unknown; more would say it may have any sign."""


def drafted(logs: ExperimentSet) -> dict[str, Any]:
    """``joint``, ``tolerance`` and ``draft`` of a first ``nominal.yaml`` (``InputFileError``: no log has a torque)."""
    if all(log.torque_nm is None for log in logs.experiments):
        raise InputFileError(
            "no log has a torque, so there is no friction to draft",
            where=logs.name,
            next_step="command and position alone are diagnosed without a nominal joint",
        )
    logs, smoothed = as_smoothed(logs)
    known = [log for log in logs.experiments if log.torque_nm is not None]
    tables = [_table(log) for log in known]
    rigid = all(log.rigid_body_torque_nm is not None for log in known)
    table = np.concatenate(tables)
    columns, torque = table[:, :-1], table[:, -1]
    short = max(log.travel_rad for log in known) < SHORT_RAD
    left_out = _RIGID if rigid else (_COS, _SIN) if short else ()
    fitted = [k for k in range(columns.shape[1]) if np.any(columns[:, k]) and k not in left_out]
    weights = np.zeros(columns.shape[1])
    weights[fitted] = np.linalg.lstsq(columns[:, fitted], torque, rcond=None)[0]
    sigma = np.full(columns.shape[1], np.inf)
    sigma[fitted] = _standard_errors(tables, fitted, torque - columns @ weights)
    document = _document(weights, sigma, known, rigid, torque, columns)
    document["draft"]["warnings"] += [smoothed] if smoothed is not None else []
    return document


_NAMES = ("inertia_kg_m2", "gravity_cos_nm", "gravity_sin_nm", "bias_nm", "coulomb_nm", "viscous_nm_s_per_rad")
_INERTIA, _COS, _SIN, _BIAS, _COULOMB, _VISCOUS = range(6)
_RIGID = (_INERTIA, _COS, _SIN)


def _table(log: Experiment) -> Array:
    """Columns in the order of the numbers, the torque last; low-passed and thinned, shape (m, 7)."""
    even, step_s, _ = uniform(log)
    assert even.torque_nm is not None
    low_pass = LowPass.at(1.0 / step_s, even.band_hz)
    q = even.position_rad
    velocity = np.gradient(q, step_s)
    acceleration = np.zeros_like(q)
    acceleration[1:-1] = (q[2:] - 2.0 * q[1:-1] + q[:-2]) / step_s**2
    torque = even.torque_nm - (even.rigid_body_torque_nm if even.rigid_body_torque_nm is not None else 0.0)
    slip = slip_state(q, 1.0 / SLIP_RAD)
    every = [acceleration, np.cos(q), np.sin(q), np.ones_like(q), slip, velocity, torque]
    filtered = low_pass(np.stack(every, axis=1))
    rows: Array = filtered[5 : -5 : low_pass.stride]
    return rows


def _standard_errors(tables: Sequence[Array], fitted: Sequence[int], residual: Array) -> Array:
    """One-sigma of each fitted number: white formula times the residual's memory, or the halves' disagreement."""
    columns = np.concatenate(tables)[:, list(fitted)]
    centred = residual - residual.mean()
    spectrum = np.abs(np.fft.rfft(centred, 2 * centred.size)) ** 2
    correlation = np.fft.irfft(spectrum)[: centred.size] / max(float(centred @ centred), 1e-300)
    end = int(np.argmax(correlation < 0.0)) or correlation.size
    memory = 1.0 + 2.0 * float(np.sum(correlation[1:end]))
    covariance = np.linalg.pinv(columns.T @ columns) * float(np.mean(centred**2)) * memory
    formula: Array = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    halves = []
    for half in (slice(None, columns.shape[0] // 2), slice(columns.shape[0] // 2, None)):
        whole = np.concatenate(tables)[half]
        halves.append(np.linalg.lstsq(whole[:, list(fitted)], whole[:, -1], rcond=None)[0])
    errors: Array = np.maximum(formula, 0.5 * np.abs(halves[0] - halves[1]))
    return errors


def _document(
    weights: Array, sigma: Array, logs: Sequence[Experiment], rigid: bool, torque: Array, columns: Array
) -> dict[str, Any]:
    speed = np.abs(columns[:, _VISCOUS])
    fastest = float(np.quantile(speed, 0.99))
    slope = max(float(weights[_VISCOUS]), 0.0)
    level = max(float(weights[_COULOMB]), LEAST_LEVEL * slope * fastest, 1e-9)
    speeds = fastest * np.arange(1, SPEEDS + 1) / SPEEDS
    typical = level + slope * float(np.median(speed[speed > 0.05 * fastest]))
    joint: dict[str, Any] = {"inertia_kg_m2": 0 if rigid else max(0.0, _rounded(weights[_INERTIA]))}
    if not rigid and np.isfinite(sigma[_COS]):
        joint |= {"gravity_cos_nm": _rounded(weights[_COS]), "gravity_sin_nm": _rounded(weights[_SIN])}
    joint["friction"] = {
        "velocity_rad_s": [_rounded(v) for v in speeds],
        "torque_nm": [_rounded(level + slope * v) for v in speeds],
    }
    friction = float(np.hypot(sigma[_COULOMB], sigma[_VISCOUS] * typical / max(level + slope, 1e-12)))
    tolerance: dict[str, Any] = {
        "friction_torque": _share(friction, typical),
        "viscous": _share(sigma[_VISCOUS], slope),
    }
    if not rigid:
        tolerance["inertia_kg_m2"] = _share(sigma[_INERTIA], weights[_INERTIA])
        if np.isfinite(sigma[_COS]):
            tolerance["absolute"] = {"gravity_torque_nm": _rounded(float(np.hypot(sigma[_COS], sigma[_SIN])))}
    left = float(np.sqrt(np.mean((torque - columns @ weights) ** 2)))
    return {
        "joint": joint,
        "tolerance": tolerance,
        "draft": {
            "from": [log.name for log in logs],
            "by": "least squares: inertia, gravity, constant, Coulomb and viscous friction",
            "numbers": {
                name: {"value": _rounded(w), "sigma": _rounded(s)}
                for name, w, s in zip(_NAMES, weights, sigma, strict=True)
                if np.isfinite(s)
            },
            "torque_rms_nm": _rounded(float(np.sqrt(np.mean(torque**2)))),
            "left_rms_nm": _rounded(left),
            "warnings": _impossible(weights, sigma, () if rigid else (_INERTIA,)),
        },
    }


def _impossible(weights: Array, sigma: Array, rigid: Sequence[int]) -> list[str]:
    """A line for each number that came out below zero; the draft holds 0 in its place."""
    return [
        f"{_NAMES[k]} came out as {weights[k]:.3g}, which no joint has, and is taken as 0: these recordings do not "
        "tell it from the rest; add one that reverses at several speeds, or write the number yourself"
        for k in (*rigid, _COULOMB, _VISCOUS)
        if np.isfinite(sigma[k]) and weights[k] < 0.0
    ]


def _share(sigma: float, value: float) -> float:
    share = abs(sigma / value) if value != 0.0 else LARGEST_TOLERANCE
    return _rounded(min(max(share, LEAST_TOLERANCE), LARGEST_TOLERANCE))


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
