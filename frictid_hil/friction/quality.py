"""Quality gates: questions that a measurement must pass before its curve may replace another one.

Each gate says what was measured, against which limit, and what a failure usually means. A failed gate keeps the result
and forbids its promotion.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from scipy.ndimage import uniform_filter1d

from frictid_hil.friction.consistency import consistency
from frictid_hil.friction.estimate import Estimate
from frictid_hil.friction.gate import Gate, GateLimits
from frictid_hil.friction.intervals import Drift
from frictid_hil.friction.recording import CycleRecording, Motion, synchronised
from frictid_hil.friction.skew import MOST_APART, TimeSkew
from frictid_hil.friction.trajectory import Array

_USUAL = GateLimits()
_RARE = 0.02  # share of a cycle; a cosine is as long above cos(pi times it) of its peak
_ROUGH_S = 0.008
_AT_LIMIT = 0.98


def gates(recording: CycleRecording, result: Estimate, limits: GateLimits = _USUAL) -> tuple[Gate, ...]:
    """All gates that this recording allows to ask."""
    motion = synchronised(recording)
    asked = [
        _tracking(recording, motion, limits.tracking_least, limits.tracking_most),
        _roughness(recording, result, limits.high_frequency_torque),
        _samples(result, limits.samples_per_window),
        _lateness(recording, limits.late_cycles),
        _kinks(recording, result, limits.straightness),
        *consistency(recording, motion, result, limits.other_stretches),
    ]
    if not recording.coupled:
        asked.append(_asymmetry(result, limits.direction_asymmetry))
    if math.isfinite(recording.torque_limit_nm) or recording.limited_share:
        asked.append(_saturation(recording, limits.saturation))
    if result.time_skew is not None:
        asked.append(_time_skew(result.time_skew))
    if result.drift is not None:
        asked.append(_drift(recording, result.drift, limits.drift))
    if result.link_resonance_hz is not None:
        asked.append(_resonance(recording, result.link_resonance_hz.value, limits.link_resonance))
    return tuple(asked)


def achieved_over_commanded(recording: CycleRecording, motion: Motion) -> Array:
    """Peak speed of each cycle, mean of both directions, over nV/N, shape (N,).

    A peak is judged by the speed that ``_RARE`` of the cycle exceeds: one jerk after a late set-point is none.
    """
    starts = np.searchsorted(motion.time_s, recording.procedure.cycle_starts_s)
    commanded = recording.procedure.peak_velocities_rad_s
    reached = [
        float(np.subtract(*np.quantile(v, (1.0 - _RARE, _RARE)))) / 2 if (v := motion.velocity_rad_s[a:b]).size else 0.0
        for a, b in pairwise(starts)
    ]
    ratios: Array = np.array(reached) / (commanded * math.cos(math.pi * _RARE))
    return ratios


def _tracking(recording: CycleRecording, motion: Motion, least: float, most: float) -> Gate:
    ratios = achieved_over_commanded(recording, motion)
    worst = int(np.argmax(np.abs(ratios - 1.0)))
    ratio = float(ratios[worst])
    said = f"cycle {worst + 1} reached {100 * ratio:.1f} % of its commanded peak speed"
    if least <= ratio <= most:
        return Gate("tracking", True, ratio, least, f"tracking: {said} at worst")
    others = [k for k, other in enumerate(ratios) if k != worst and not least <= other <= most]
    if others:
        said += ", " + ", ".join(f"cycle {k + 1} {100 * ratios[k]:.1f} %" for k in others)
    cause = (
        "the command is averaged or filtered on its way, or torque saturates"
        if ratio < 1
        else "the position loop overshoots or hunts"
    )
    said = f"tracking: {said} (allowed {100 * least:.3g} to {100 * most:.3g} %)"
    return Gate.about("tracking", False, ratio, least if ratio < 1 else most, said, cause)


def _roughness(recording: CycleRecording, result: Estimate, most: float) -> Gate:
    step_s = float(np.median(np.diff(recording.time_s)))
    torque = np.asarray(recording.torque_nm, dtype=np.float64)
    fast = torque - uniform_filter1d(torque, max(3, round(_ROUGH_S / step_s) | 1))
    level = float(np.mean(result.curve.torque_nm))
    share = float(np.sqrt(np.mean(fast**2))) / level
    said = f"torque jitters by {100 * share:.1f} % of the friction (allowed {100 * most:.3g} %)"
    cause = "the position loop oscillates, or the torque signal is too noisy"
    return Gate.at_most("high_frequency_torque", share, most, said, cause)


def _samples(result: Estimate, least: float) -> Gate:
    fewest = int(min(result.pairs.samples_plus.min(), result.pairs.samples_minus.min()))
    said = f"the smallest window averages {fewest} samples (at least {least:g} needed)"
    cause = "raise the rate or the travel, or lower the peak speed"
    return Gate.about("samples_per_window", fewest >= least, fewest, least, said, cause)


def _lateness(recording: CycleRecording, most: float) -> Gate:
    late = recording.late_cycles
    share = late / len(recording.time_s)
    said = f"{late} control cycles were late or missed, {100 * share:.2f} % (allowed {100 * most:.3g} %)"
    return Gate.at_most("late_cycles", share, most, said, "give the process real-time priority, or lower the rate")


def _asymmetry(result: Estimate, most: float) -> Gate:
    shares = np.abs(result.asymmetry_nm) / np.asarray(result.curve.torque_nm)
    worst = int(np.argmax(shares))
    share = float(shares[worst])
    said = (
        f"at pair {worst + 1} of {shares.size} the two directions lie {100 * share:.1f} % to either side of their mean "
        f"(allowed {100 * most:.3g} %)"
    )
    cause = "a load that works one way, torque saturating one way, or a damaged gear"
    return Gate.at_most("direction_asymmetry", share, most, said, cause)


def _kinks(recording: CycleRecording, result: Estimate, most: float) -> Gate:
    """How far a pair leaves the line through its neighbours; below the standard V_1 a Stribeck dip may."""
    v, f = np.array(result.curve.velocity_rad_s), np.array(result.curve.torque_nm)
    slow = int(np.sum(v < 0.09 * recording.procedure.velocity_rad_s))
    pairs = v.size
    v, f = v[slow:], f[slow:]
    if v.size < 3:
        return Gate("straightness", True, 0.0, most, "too few pairs to see one leave its neighbours' line")
    line = f[:-2] + (f[2:] - f[:-2]) * (v[1:-1] - v[:-2]) / (v[2:] - v[:-2])
    leaves = np.abs(f[1:-1] - line) / f.mean()
    worst = int(np.argmax(leaves))
    share = float(leaves[worst])
    said = (
        f"pair {slow + worst + 2} of {pairs} leaves the line through its neighbours by {100 * share:.1f} % of the "
        f"friction (allowed {100 * most:.3g} %)"
    )
    return Gate.at_most("straightness", share, most, said, "that cycle was disturbed; run it again")


def _saturation(recording: CycleRecording, most: float) -> Gate:
    share = float(np.mean(np.abs(recording.torque_nm) >= _AT_LIMIT * recording.torque_limit_nm))
    said = f"torque stood at its limit in {100 * share:.2f} % of the samples (allowed {100 * most:.3g} %)"
    if recording.limited_share > share:
        share = recording.limited_share
        said = (
            f"the drive said in {100 * share:.2f} % of the samples that one of its limits was active "
            f"(statusword bit 11; allowed {100 * most:.3g} %)"
        )
    cause = "raise the travel (peak torque grows as V^2/A) or lower the peak speed"
    return Gate.at_most("saturation", share, most, said, cause)


def _time_skew(skew: TimeSkew) -> Gate:
    said = (
        f"the torque lags the position by {1e3 * skew.measured_s:.3f} +- {2e3 * skew.measured_deviation_s:.3f} ms as "
        f"measured, {1e3 * skew.declared_s:.3f} +- {2e3 * skew.declared_deviation_s:.3f} ms as declared: "
        f"{skew.apart:.1f} standard deviations apart (allowed {MOST_APART:g})"
    )
    cause = (
        "an undeclared filter or a wrong `options: timing` (the measured one was used), or what shook was not the "
        "joint's own inertia"
    )
    return Gate.about("time_skew", skew.agree, skew.apart, MOST_APART, said, cause)


def _drift(recording: CycleRecording, drift: Drift, most: float) -> Gate:
    duration_s = recording.procedure.duration_s
    change = abs(drift.over(duration_s))
    passed = change <= most + drift.over(duration_s, drift.chance)
    said = (
        f"friction had changed by {100 * drift.change:+.1f} % when cycle {drift.cycle} ran again "
        f"{drift.apart_s:.1f} s later: {100 * change:.1f} % over the run (allowed {100 * most:.3g} %, "
        f"and the {100 * drift.over(duration_s, drift.chance):.1f} % that torque noise and steps may feign)"
    )
    return Gate.about("drift", passed, change, most, said, "warm the joint up first")


def _resonance(recording: CycleRecording, resonance_hz: float, most: float) -> Gate:
    fastest_hz = float(recording.procedure.angular_frequencies_rad_s[-1]) / (2 * math.pi)
    share = fastest_hz / resonance_hz
    said = (
        f"the fastest cycle, {fastest_hz:.2f} Hz, is {100 * share:.0f} % (allowed {100 * most:.3g} %) "
        f"of the link's resonance at {resonance_hz:.1f} Hz"
    )
    return Gate.at_most("link_resonance", share, most, said, "raise the travel, or lower the peak speed")
