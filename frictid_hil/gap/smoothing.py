"""Was a torque smoothed after it was recorded, by a low-pass that runs forwards and backwards?

Files are handed on that way, and seldom say so. Such a torque holds no noise and nothing fast: friction jumps at a
reversal, and the torque does not. That difference is no gap of the joint. Whatever is compared then stays below the
filter's edge, where it takes nothing off.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import signal

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.experiment_set import ExperimentSet, Nominal
from frictid_hil.gap.residuals import presliding_state, uniform
from frictid_hil.gap.sanity import completed

SMOOTHED = (
    "the torque was low-passed at about {edge:.2g} Hz, without lag, after it was recorded; it is compared below "
    "{band:.2g} Hz"
)
CLIFF_DB = 25.0
"""Loss within an octave, from which on a file was smoothed: a drive's lags of third order lose 18, and friction 6."""
SILENT_DB = 50.0  # fall from there to the top of the spectrum: a sensor's or a counter's own noise ends it earlier
BELOW_DB = 15.0  # by which a torque lies below the jumps of its own friction, above the edge
OWN_DB = 6.0  # an octave's loss in a joint's own torque, which jumps at reversals
LEAST_HZ, MOST_HZ = 3.0, 40.0  # where such an edge is looked for; slower ones are of the motion
MOST_POLES = 4  # order of a low-pass in common use
OCTAVE = 6  # bands in an octave
PART_S = 4.0  # of a recording, whose spectrum is taken by itself
KEPT = 0.95  # of an amplitude at the band's end


def as_smoothed(experiments: ExperimentSet) -> tuple[ExperimentSet, str | None]:
    """(the set with the band in which its torque can be compared, what to tell of it; None where it is as recorded)."""
    stated_hz = experiments.nominal.torque_smoothed_hz
    if stated_hz is not None:
        edge_hz, poles = stated_hz, 2
    else:
        found = _edge(experiments)
        if found is None:
            return experiments, None
        edge_hz, poles = found
    band_hz = edge_hz * (1.0 / KEPT - 1.0) ** (0.5 / poles)
    logs = tuple(replace(e, band_hz=band_hz) for e in experiments.experiments)
    return replace(experiments, experiments=logs), SMOOTHED.format(edge=edge_hz, band=band_hz)


def _edge(experiments: ExperimentSet) -> tuple[float, int] | None:
    """(edge in Hz, order) of the low-pass forwards and backwards that the torques have passed; None where none shows.

    Of order n it loses 12 n dB an octave in the end, and half of that in the octave about its edge. The end of what
    excites a joint looks like an edge, too; there the jumps of friction stay.
    """
    logs = [uniform(e) for e in experiments.experiments if e.torque_nm is not None]
    if not logs:
        return None
    hertz, levels_db = _spectrum([(e.torque_nm, step_s) for e, step_s, _ in logs if e.torque_nm is not None])
    lost_db = levels_db[:-OCTAVE] - levels_db[OCTAVE:]
    sought = np.flatnonzero((hertz[:-OCTAVE] >= LEAST_HZ) & (hertz[:-OCTAVE] <= MOST_HZ))
    if sought.size == 0:
        return None
    steepest = int(sought[np.argmax(lost_db[sought])])
    silent_db = levels_db[steepest] - float(np.max(levels_db[-OCTAVE:]))
    if lost_db[steepest] < CLIFF_DB or silent_db < SILENT_DB:
        return None
    nominal = completed(experiments)[0].nominal
    _, jumps_db = _spectrum([(_friction(nominal, e.position_rad, step_s), step_s) for e, step_s, _ in logs])
    if np.any((jumps_db - levels_db)[steepest + OCTAVE :] < BELOW_DB):
        return None
    # Towards half of the sampling rate a digital filter is steeper than its order says.
    poles = min(max(1, round((float(lost_db[steepest]) - OWN_DB) / 12.0)), MOST_POLES)
    begins = steepest
    while begins > 0 and lost_db[begins - 1] >= 6.0 * poles:
        begins -= 1
    return float(hertz[begins]) * math.sqrt(2.0), poles


def _friction(nominal: Nominal, position_rad: Array, step_s: float) -> Array:
    """Believed friction along a measured position, N m, shape (n,)."""
    assert nominal.curve is not None
    rate_nm = nominal.curve.rate_part(np.gradient(position_rad, step_s))
    return nominal.curve.coulomb_nm * presliding_state(nominal, position_rad) + rate_nm


def _spectrum(columns: Sequence[tuple[Array, float]]) -> tuple[Array, Array]:
    """(middles of bands, evenly over an octave, in Hz; mean power density of all columns in each, in dB).

    ``columns`` are (torque, step in s).
    """
    top_hz = 0.5 / max(step_s for _, step_s in columns)
    width = 2.0 ** (0.5 / OCTAVE)
    hertz = 2.0 ** (np.arange(int(OCTAVE * math.log2(top_hz / width)) + 1) / OCTAVE)
    power = np.zeros(hertz.size)
    for torque_nm, step_s in columns:
        rows = min(torque_nm.size, round(PART_S / step_s))
        at, density = signal.welch(torque_nm, 1.0 / step_s, window="blackmanharris", nperseg=rows)
        inside = (at >= hertz[:, None] / width**1.5) & (at < hertz[:, None] * width**1.5)
        power += inside @ density / np.maximum(np.sum(inside, axis=1), 1) * torque_nm.size
    return hertz, 10.0 * np.log10(power + 1e-300)
