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

SMOOTHEST_HZ = 4.0
"""No position is smoothed below this: a move of a joint takes a quarter of a second."""


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
        inertia = view.motor_inertia_kg_m2 + view.link_inertia_kg_m2 + view.payload_inertia_kg_m2
        loudest = inertia * position_noise
        hertz = math.sqrt(white_rms(torque) / loudest) / (2.0 * math.pi) if loudest > 0.0 else math.inf
        hertz = min(max(hertz, SMOOTHEST_HZ), 0.2 / log.step_s)
        smooth = replace(e, position_rad=LowPass(1.0 / log.step_s, hertz)(e.position_rad))
        quiet = view_of(nominal, smooth, log.step_s, view.start_s, np.gradient(smooth.position_rad, log.step_s))
        noisy = replace(e, position_rad=smooth.position_rad + position_noise * random.standard_normal(torque.size))
        loud = view_of(nominal, noisy, log.step_s, view.start_s, np.gradient(noisy.position_rad, log.step_s))
        asked = nominal_torque(nominal, e, quiet)
        noises.append(nominal_torque(nominal, e, loud) - asked)
        noises[-1][[0, -1]] = 0.0
        views.append(replace(quiet, torque_nm=asked))
    return views, noises


def white_rms(values: Array) -> float:
    """RMS of the white part of a column, by the median of its sixth differences, which no motion reaches."""
    if values.size < 8:
        return 0.0
    return float(np.median(np.abs(np.diff(values, 6)))) / (0.6745 * math.sqrt(math.comb(12, 6)))
