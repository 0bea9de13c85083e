"""Do the columns of a recording agree with each other? Gates against data that are wrong and look right.

A torque that comes late, is cut off, or changes its scale in the middle gives a smooth curve with narrow intervals;
another column, another stretch of the run, or what was expected of the joint gives it away. Not to be seen are a factor
from the first sample to the last, and a delay of position and torque alike.

Through a sine, a late torque looks like less inertia and more friction at high speeds. At a turning point it can be
told: friction turns over along a travel that is the same at every speed (20), which takes a fast joint less time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from frictid_hil.friction.estimate import Estimate
from frictid_hil.friction.gate import Gate
from frictid_hil.friction.recording import CycleRecording, Motion
from frictid_hil.friction.trajectory import Array

MOST_SEEN_S = 0.0015  # what the data may ask for beyond the declared delay of the torque, where they are sure of it ...
MOST_SEEN_WITH_LINK_S = 0.003
SURE = 2.5  # ... by so many standard deviations, its own and the declared one's ...
MOST_UNSURE_S = 0.006  # ... but for joints that move together, without a gate of inertia, no more than this and a step
MOST_TURNOVER_S = 0.012  # friction that turns over later, or sooner, after a fast turn than after such slow travel ...
MOST_TURNOVER_SEEN_S = 0.004  # ... and where the delay asked for has the same sign and is more than ``MOST_SEEN_S``
MOST_SEEN_DRAGGED_S, SURE_BESIDE = 0.00075, 1.0
"""The same where a link was found, which drags that delay down, if it is more than so many standard
deviations: soft joints that are not late ask for 0.06 ms."""
MOST_COARSE_TURNOVER_S, MOST_TURNOVER_STEP_S, FEW_CYCLES = 0.03, 0.0105, 3
"""Samples further apart, with the coarse steps of servos, tell no less than this, and below 100 Hz nothing."""
MOST_APART_S = 0.008  # reported velocity against differenced position: a filter that nobody declared does no harm ...
MOST_UNSTEADY_S = 0.004  # ... but a delay that comes and goes does.
MOST_SCALE = 0.05
MOST_INERTIA = 2.0  # inertia against what the robot file expects, either way
FLAT_SHARE = 0.003
FLAT_SPIKE = 6.0  # samples at the very extreme over the mean of the three steps below; a sine has 3, noise less than 1

CONTINUED = 2.0
"""The bound of ``GateLimits.other_stretches`` grows by this where a stretch was slower than the slowest pair, where the
curve is only continued, and no cycle tells its friction at that speed ..."""
SLOWEST_SHARE = 0.5  # ... down to this share of that pair's speed.
_BESIDE = 1.0 / 12.0  # share of a cycle beside its turning point: half its peak speed, inertia and gravity as at it
_AROUND = 0.2  # share of a cycle to either side of its middle in which the joint turns
_STEPS = 1000.0
_LATE = "torque or position are late: a filter that was not declared (`options: timing`), or reports of old figures"
_LEAST_SAMPLES, _LEAST_AT_SPEED = 50, 12
_PARTS = 8  # of a repeated cycle; the first one is left out, as one of the two runs may begin from rest
_LEAST = 4  # samples of a part
_ALIKE = 4.0  # samples that err together, after smoothing
_BAND = 0.15  # speeds that count as one, as a share
_CLEAR = 0.2  # share of its peak at which a cycle is clear of its turning points, where friction is still a spring


def consistency(recording: CycleRecording, motion: Motion, result: Estimate, most_changed: float) -> list[Gate]:
    """All questions that a recording allows to ask; the last argument is ``GateLimits.other_stretches``."""
    asked = [_delay(recording, result), _turnover(recording, motion, result), _velocity(recording, motion)]
    asked += [_inertia(recording, result), _flat(recording), _repetition(recording, motion, result, most_changed)]
    return [gate for gate in (*asked, _elsewhere(recording, motion, result, most_changed)) if gate is not None]


def _delay(recording: CycleRecording, result: Estimate) -> Gate | None:
    """The torque's own rate explains what is left of it where the torque is late."""
    seen_s, deviation_s = (result.figures.get(name) for name in ("seen_delay_s", "seen_delay_deviation_s"))
    if seen_s is None or deviation_s is None:
        return None
    sure_s = SURE * math.hypot(deviation_s, recording.skew.uncertainty_s)
    # A link that swings drags the figure; a torque that is very late looks like one.
    least_s = MOST_SEEN_S if result.link_resonance_hz is None else MOST_SEEN_WITH_LINK_S
    if recording.coupled:
        sure_s = min(sure_s, MOST_UNSURE_S + float(np.median(np.diff(recording.time_s))))
    allowed_s = max(least_s, sure_s)
    said = (
        f"the data ask for {1e3 * seen_s:+.2f} +- {2e3 * deviation_s:.2f} ms of torque delay beyond the declared one "
        f"(allowed {1e3 * allowed_s:.2f} ms)"
    )
    return Gate.at_most("seen_delay", abs(seen_s), allowed_s, said, _LATE)


def _turnover(recording: CycleRecording, motion: Motion, result: Estimate) -> Gate | None:
    """Friction turns over after the same travel at every speed: what it takes longer is lateness."""
    step_s = float(np.median(np.diff(recording.time_s)))
    fine = step_s <= 1.05 * MOST_TURNOVER_SEEN_S
    # Few samples tell it of few cycles only, which need it: many slow ones, with coarse steps, feign a longer travel.
    if not fine and (step_s > MOST_TURNOVER_STEP_S or recording.procedure.cycles > FEW_CYCLES):
        return None
    late_s = turnover_lateness(recording, motion)
    if late_s.size == 0:
        return None
    worst_s = float(late_s[np.argmax(np.abs(late_s))] if fine else late_s[-1])
    # Two witnesses need to say less: inertia alone makes some milliseconds of one of them.
    seen_s, deviation_s = (result.figures.get(f"seen_delay{part}_s", 0.0) for part in ("", "_deviation"))
    least_s = MOST_SEEN_S if result.link_resonance_hz is None else max(MOST_SEEN_DRAGGED_S, SURE_BESIDE * deviation_s)
    both = seen_s * np.sign(worst_s) > least_s
    allowed_s = (MOST_TURNOVER_SEEN_S if both else MOST_TURNOVER_S) if fine else MOST_COARSE_TURNOVER_S
    if not fine and worst_s < 0.0:
        # Sooner is what the coarse steps of slow cycles feign, unless there is one and the data ask for it as well.
        if both and recording.procedure.cycles < FEW_CYCLES:
            allowed_s = MOST_TURNOVER_S
        else:
            worst_s = 0.0
    said = (
        f"after a fast turning point friction turns over {1e3 * worst_s:+.1f} ms later than after the same travel in "
        f"slow cycles (allowed {1e3 * allowed_s:.0f} ms)"
    )
    return Gate.at_most("turnover", abs(worst_s), allowed_s, said, _LATE)


def _velocity(recording: CycleRecording, motion: Motion) -> Gate | None:
    """The drive's velocity on the position's derivative and its rate: how large, how late, and whether that stays."""
    if recording.velocity_rad_s is None:
        return None
    times = motion.time_s + recording.skew.velocity_delay_s
    inside = (times >= recording.time_s[0]) & (times <= recording.time_s[-1])
    reported = motion.smoother.smooth(np.interp(times, recording.time_s, recording.velocity_rad_s))
    columns = np.column_stack([motion.velocity_rad_s, -motion.acceleration_rad_s2])
    found = []
    for begin, end in pairwise(recording.procedure.cycle_starts_s):
        rows = inside & (motion.time_s >= begin) & (motion.time_s < end)
        if rows.sum() >= _LEAST_SAMPLES:
            (scale, late), *_ = np.linalg.lstsq(columns[rows], reported[rows], rcond=None)
            found.append((float(scale), float(late / scale) if scale else math.inf))
    if not found:
        return None
    scales, late_s = np.array(found).T
    off, usual_s = float(np.abs(scales - 1.0).max()), float(np.median(late_s))
    changes_s = float(late_s.max() - late_s.min())
    said = (
        f"the reported velocity is {100 * off:.1f} % off the differenced position at worst (allowed "
        f"{100 * MOST_SCALE:.0f} %), {1e3 * usual_s:+.2f} ms late against it (allowed {1e3 * MOST_APART_S:.0f} ms), "
        f"and that changes by {1e3 * changes_s:.2f} ms from cycle to cycle (allowed {1e3 * MOST_UNSTEADY_S:.0f} ms)"
    )
    passed = off <= MOST_SCALE and abs(usual_s) <= MOST_APART_S and changes_s <= MOST_UNSTEADY_S
    cause = (
        f"the reported velocity is about {np.median(scales):.3g} times the differenced position: its unit (60A9) or "
        "the gear (6091, 6092, 608F) is not what was told. With `replay --eds` these are the maker's values, not this "
        "drive's: give `velocity_unit_rad_s` and `position_units_per_revolution` in the joint's options"
        if off > MOST_SCALE
        else "one of the two is of another moment: check the drive's filters"
    )
    return Gate.about("velocity", passed, changes_s, MOST_UNSTEADY_S, said, cause)


def _inertia(recording: CycleRecording, result: Estimate) -> Gate | None:
    """Inertia is positive, and about what the robot file expects."""
    body = result.rigid_body
    if body is None or body.inertia_kg_m2 is None:
        return None
    found, half, expected = body.inertia_kg_m2.value, body.inertia_kg_m2.half_width, recording.expected_inertia
    if not math.isfinite(half):
        return None
    low, high = 0.0, math.inf
    if expected > 0.0:
        low, high = expected / MOST_INERTIA, expected * MOST_INERTIA
    passed = low < found + half and found - half < high and found + half > 0.0
    told = f", the robot file expects {expected:.4g}" if expected else ""
    said = f"inertia is {found:.4g} +- {half:.2g} kg m^2{told} (allowed {low:.3g} to {high:.3g})"
    cause = "torque that is late or cut off takes inertia away; or `expected` in the robot file is of another load"
    return Gate.about("inertia", passed, found, low if found < low or not math.isfinite(high) else high, said, cause)


def _flat(recording: CycleRecording) -> Gate:
    """A torque that is cut off piles up at its extreme."""
    torque = np.asarray(recording.torque_nm, dtype=np.float64)
    step = max(recording.torque_quantum_nm, float(np.abs(torque).max()) / _STEPS) or 1.0
    share = 0.0
    for signed in (torque, -torque):
        below = np.floor((signed.max() - signed) / step + 0.5)
        counts = np.array([float(np.sum(below == n)) for n in range(4)])
        spike = counts[0] / max(1.0, float(counts[1:].mean()))
        if spike > FLAT_SPIKE and counts[0] / torque.size > FLAT_SHARE:
            share = max(share, counts[0] / torque.size)
    said = f"{100 * share:.2f} % of the samples pile up at the extreme of the torque (allowed {100 * FLAT_SHARE:.1f} %)"
    cause = "the reported torque is cut off: by a limit of the drive, or by its report"
    return Gate.at_most("flat_tops", share, FLAT_SHARE, said, cause)


def _repetition(recording: CycleRecording, motion: Motion, result: Estimate, most: float) -> Gate | None:
    """The torque of the repeated cycle against that of its first run, part by part; a half run tells nothing."""
    repeat, time = recording.repeat, motion.time_s
    if repeat is None:
        return None
    first_s, last_s = recording.procedure.cycle_starts_s[repeat.cycle - 1 : repeat.cycle + 1]
    length_s = float(last_s - first_s)
    if time[-1] < repeat.start_s + length_s - 2.0 * motion.smoother.step_s:
        return None
    since_s = np.arange(length_s / _PARTS, length_s, motion.smoother.step_s)
    once, again = (np.interp(since_s + begin, time, motion.torque_nm) for begin in (first_s, repeat.start_s))
    parts = np.array_split(again - once, _PARTS - 1)
    if min(part.size for part in parts) < _LEAST:
        return None
    # A part in which something changed would excuse itself by its own spread.
    spread_nm = float(np.median([part.std() for part in parts]))
    chance_nm = spread_nm / max(1.0, parts[-1].size / _ALIKE) ** 0.5
    peak_rad_s = recording.procedure.peak_velocities_rad_s[[repeat.cycle - 1]]
    level_nm = float(result.curve.magnitude(peak_rad_s)[0])
    shares, allowed = np.abs([part.mean() for part in parts]) / level_nm, most + SURE * chance_nm / level_nm
    worst = int(np.argmax(shares))
    share = float(shares[worst])
    return Gate.at_most(
        "repetition",
        share,
        allowed,
        f"cycle {repeat.cycle} again: in part {worst + 2} of {shares.size + 1} its torque differs by "
        f"{100 * share:.1f} % of the friction (allowed {100 * allowed:.3g} %)",
        "the torque's scale or offset changed during the run, something touched the joint, or wrong reports",
    )


def _elsewhere(recording: CycleRecording, motion: Motion, result: Estimate, most: float) -> Gate | None:
    """Half of forward minus backward torque in other stretches of the run, against the curve at the same speeds."""
    judged = []
    for name, velocity, torque in recording.elsewhere:
        judged += [
            (abs(ratio - 1.0), bound, ratio, name)
            for ratio, bound in _ratios(recording, motion, result, velocity, torque, most)
        ]
    if not judged:
        return None
    worst, allowed, ratio, name = max(judged, key=lambda one: one[0] / one[1])
    return Gate.at_most(
        "other_stretches",
        worst,
        allowed,
        f"{name}: friction is {100 * ratio:.0f} % of the curve at the same speed (allowed {100 * allowed:.3g} % off)",
        "the torque's scale or the friction changed during the run: a cold joint (`--warm-up`), a drive that switched "
        "its current range, or wrong reports",
    )


def _ratios(
    recording: CycleRecording, motion: Motion, result: Estimate, velocity: Array, torque: Array, most: float
) -> list[tuple[float, float]]:
    """Friction of a stretch over that of the curve, or, where the curve does not reach, of each cycle; their bounds."""
    slowest, fastest = float(result.curve.velocity_rad_s[0]), float(result.curve.velocity_rad_s[-1])
    top = float(np.abs(velocity).max(initial=0.0))
    continued = top < slowest
    steady = (np.abs(velocity) >= max(0.0 if continued else slowest, 0.9 * top)) & (np.abs(velocity) <= fastest)
    ways = [steady & (velocity > 0.0), steady & (velocity < 0.0)]
    if min(int(way.sum()) for way in ways) < _LEAST_SAMPLES:
        return []
    there, back = (float(np.mean(torque[way])) for way in ways)
    measured_nm, speed = (there - back) / 2, np.abs(velocity)
    if continued:
        cycles_nm = friction_at(recording, motion, float(np.mean(speed[steady])), _LEAST_AT_SPEED)
        if cycles_nm.size:
            return [(measured_nm / float(cycle_nm), most) for cycle_nm in cycles_nm]
        if 0.9 * top < SLOWEST_SHARE * slowest:
            return []
    expected_nm = np.mean([float(np.mean(result.curve.magnitude(speed[way]))) for way in ways])
    return [(measured_nm / float(expected_nm), most * (CONTINUED if continued else 1.0))]


def turnover_lateness(recording: CycleRecording, motion: Motion) -> Array:
    """By how much later friction turns over in the faster half of the cycles than after the slower half's travel, s.

    Returns:
        A figure for each of them, the slowest first; cycles in which it cannot be told are left out.
    """
    starts = recording.procedure.cycle_starts_s
    cycles = [_turned(motion, float(begin), float(end)) for begin, end in pairwise(starts)]
    found = sorted((cycle for cycle in cycles if cycle is not None), key=lambda cycle: -cycle.period_s)
    slow, fast = found[: len(found) // 2], found[len(found) // 2 :]
    if not slow:
        return np.zeros(0)
    travel_rad = float(np.median([cycle.travel_rad for cycle in slow]))
    return np.array([cycle.delay_s - cycle.after_s(motion, travel_rad) for cycle in fast])


@dataclass(frozen=True, slots=True)
class _Turnover:
    """One cycle's: when the joint turns back, and how long and how far after that friction is midway."""

    period_s: float
    turn_s: float
    delay_s: float
    travel_rad: float

    def after_s(self, motion: Motion, travel_rad: float) -> float:
        """How long after the turning point the joint has gone so far."""
        after = (motion.time_s >= self.turn_s) & (motion.time_s < self.turn_s + self.period_s / 2)
        gone = np.abs(motion.position_rad[after] - np.interp(self.turn_s, motion.time_s, motion.position_rad))
        return float(np.interp(travel_rad, np.maximum.accumulate(gone), motion.time_s[after])) - self.turn_s


def _turned(motion: Motion, begin_s: float, end_s: float) -> _Turnover | None:
    time, period_s, middle_s = motion.time_s, end_s - begin_s, (begin_s + end_s) / 2
    way = np.sign(np.interp(begin_s + period_s / 4, time, motion.velocity_rad_s))
    turn_s = _falls_to_zero(time, way * motion.velocity_rad_s, middle_s - _AROUND * period_s, _AROUND * period_s * 2)
    if turn_s is None:
        return None
    beside_s = _BESIDE * period_s
    torque = way * motion.torque_nm
    before, after = np.interp([turn_s - beside_s, turn_s + beside_s], time, torque)
    midway_s = _falls_to_zero(time, torque - (before + after) / 2, turn_s - beside_s, 2 * beside_s)
    if midway_s is None:
        return None
    travel = float(np.subtract(*np.interp([turn_s, midway_s], time, motion.position_rad)))
    return _Turnover(period_s, turn_s, midway_s - turn_s, abs(travel))


def _falls_to_zero(time: Array, column: Array, begin_s: float, lasts_s: float) -> float | None:
    """When a column that begins above zero first comes below it; None where it does not."""
    rows = np.flatnonzero((time >= begin_s) & (time <= begin_s + lasts_s))
    below = rows[column[rows] <= 0.0]
    if below.size == 0 or below[0] == rows[0]:
        return None
    pair = slice(below[0] - 1, below[0] + 1)
    return float(np.interp(0.0, -column[pair], time[pair]))


def friction_at(recording: CycleRecording, motion: Motion, speed_rad_s: float, least_samples: int) -> Array:
    """Half of forward minus backward torque of every cycle, the repeated one too, as it passes through a speed, N m.

    A cycle passes it as often faster and faster as slower and slower, and at the same places both ways: neither inertia
    nor gravity is in it. Cycles that pass it too close to a turning point, or have too few samples of it, are left out.
    """
    peaks = recording.procedure.peak_velocities_rad_s
    spans = list(pairwise(recording.procedure.cycle_starts_s.tolist()))
    repeat = recording.repeat
    if repeat is not None:
        begin_s, end_s = spans[repeat.cycle - 1]
        spans.append((repeat.start_s, repeat.start_s + end_s - begin_s))
        peaks = np.append(peaks, peaks[repeat.cycle - 1])
    time, velocity, found = motion.time_s, motion.velocity_rad_s, []
    near = np.abs(np.abs(velocity) - speed_rad_s) < _BAND * speed_rad_s
    for (begin_s, end_s), peak in zip(spans, peaks, strict=True):
        if speed_rad_s < _CLEAR * peak:
            continue
        here = near & (time >= begin_s) & (time < end_s)
        ways = [here & (velocity > 0.0), here & (velocity < 0.0)]
        if min(int(way.sum()) for way in ways) >= least_samples:
            there, back = (float(np.mean(motion.torque_nm[way])) for way in ways)
            found.append((there - back) / 2)
    return np.array(found)
