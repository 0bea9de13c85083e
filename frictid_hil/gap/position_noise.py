"""Noise of the position: what it makes of the residual, and a motion without it that columns can be made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import Nominal
from frictid_hil.gap.residuals import LowPass, Recording, nominal_torque, view_of
from frictid_hil.simulation.inverse import View

SMOOTHED_HZ = (4.0, 6.0, 9.0, 13.0, 20.0, 30.0, 45.0, 70.0, 100.0)
"""Cut-offs to choose from. None is lower: a move of a joint takes a quarter of a second."""
NOISE_SHARE = 0.03
"""RMS of an acceleration's noise over its own up to which it is left alone: its square is lost of an inertia."""


def quiet_views(nominal: Nominal, logs: Sequence[Recording]) -> tuple[list[View], list[Array]]:
    """(what columns are made of, noise of the residual that comes from the position, N m (n,)), per log.

    A column that holds the noise of what it explains would explain it: a torque constant of zero leaves no residual,
    and acceleration noise is inertia to the last digit. So columns are made of the believed torque and of a position
    that is smoothed where its noise, differentiated twice, is stronger than the torque's own. Noise of the same size
    on the smoothed position then shows what it makes of the residual: through the inertia, and through a stuck spring.
    """
    views: list[View] = []
    noises: list[Array] = []
    random = np.random.default_rng(0)
    for log in logs:
        view, torque, e = log.view, log.experiment.torque_nm, log.experiment
        assert view is not None and torque is not None
        step = nominal.encoder_resolution_rad or 0.0
        position_noise = max(white_rms(e.position_rad), step / math.sqrt(12.0))
        hertz = _cutoff_hz(e.position_rad, position_noise, log.step_s)
        smooth = replace(e, position_rad=LowPass(1.0 / log.step_s, hertz)(e.position_rad))
        quiet = view_of(nominal, smooth, log.step_s, view.start_s)
        noisy = replace(e, position_rad=smooth.position_rad + position_noise * random.standard_normal(torque.size))
        loud = view_of(nominal, noisy, log.step_s, view.start_s)
        asked = nominal_torque(nominal, e, quiet)
        noises.append(nominal_torque(nominal, e, loud) - asked)
        noises[-1][[0, -1]] = 0.0
        views.append(replace(quiet, torque_nm=asked))
    return views, noises


def _cutoff_hz(position_rad: Array, noise_rad: float, step_s: float) -> float:
    """The highest cut-off behind which noise of the position is no more than a trace of the acceleration."""
    random = np.random.default_rng(1)
    columns = np.stack([position_rad, noise_rad * random.standard_normal(position_rad.size)], axis=1)
    acceleration = LowPass.at(1.0 / step_s)(np.diff(columns, 2, axis=0) / step_s**2)
    top_hz = 0.2 / step_s
    usable = [top_hz, *(hertz for hertz in reversed(SMOOTHED_HZ) if hertz < top_hz)]
    for hertz in usable:
        inside = LowPass(1.0 / step_s, hertz)(acceleration)[len(acceleration) // 20 : -(len(acceleration) // 20) - 1]
        moved, noise = np.sqrt(np.mean(inside**2, axis=0))
        if noise <= NOISE_SHARE * moved:
            return hertz
    return usable[-1]


def white_rms(values: Array) -> float:
    """RMS of the white part of a column, by the median of its sixth differences, which no motion reaches."""
    return _noise_rms(values, 6)


def differenced_rms(values: Array) -> float:
    """RMS of the noise of a column that was made of a position differenced twice, as a rigid-body torque is."""
    return math.sqrt(6.0) * _noise_rms(values, 4)


def _noise_rms(values: Array, differences: int) -> float:
    if values.size < 8:
        return 0.0
    return float(np.median(np.abs(np.diff(values, differences)))) / (0.6745 * math.sqrt(math.comb(12, 6)))
