"""Where: the squared gap split by what the joint was doing and by what the residual follows; the shares add up to 1.

Drive and sensors take their part first: reported torque against demand, reported velocity against position. Of the
plant's residual, the samples just after a reversal and those at standstill are regions of their own. What is left,
the sliding part, is described by functions of speed, position, acceleration, load and time; each family is given its
mean contribution over all orders in which the families may be asked (Shapley's share of explained squares), since they
overlap on any recording. What none of them describes is split by frequency: fast changes, and the rest by speed.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.diagnosis import Where
from frictid_hil.gap.residuals import LowPass, Recording, rms
from frictid_hil.simulation.effect import Region
from frictid_hil.simulation.inverse import View

FAST_HZ = 3.0  # changes of the residual above this frequency, that nothing else describes, are the region of frequency
SPEED_BANDS = (0.0, 0.015, 0.05, 0.1, 0.2, 0.35, 0.5, 0.75)
"""Lower edges of the bands of speed, as shares of the top speed; two are told as one."""
STILL = 0.003  # share of the top speed below which a joint stands
RIPPLE_ORDERS = (1, 2, 4)  # cycles per motor revolution that count as position

_WORDS = {
    Region.ACTUATION: "between what the controller asks for and what the drive delivers",
    Region.KINEMATICS: "between the position and the reported velocity",
    Region.REVERSAL: "just after reversals of motion",
    Region.STANDSTILL: "while the joint stands still",
    Region.VELOCITY_BAND: "in sliding, following speed and direction",
    Region.POSITION: "in sliding, following the position (gravity's shape, ripple)",
    Region.ACCELERATION: "in sliding, in proportion to the acceleration",
    Region.LOAD: "in sliding, as friction that grows with the load carried",
    Region.TEMPERATURE: "in sliding, as friction that changes over time or with temperature",
    Region.FREQUENCY: f"in sliding, as changes faster than {FAST_HZ:g} Hz",
}


@dataclass(frozen=True, slots=True)
class _Log:
    """One recording, low-passed and thinned; arrays of shape (m,)."""

    recording: Recording
    view: View
    residual_nm: Array
    velocity_rad_s: Array
    sliding: np.ndarray
    stride: int


def where(
    recordings: Sequence[Recording], noise_nm: float, *, velocity_gain_nm_s_per_rad: float | None = None
) -> tuple[Where, ...]:
    """Shares of the squared gap of all logs, the largest region first; empty without a residual to share out.

    RMS ``noise_nm``, that noise alone leaves in a low-passed residual, is not counted. An error of the reported
    velocity is weighed by the loop's torque per velocity error; by the inertia times its rate of change where there is
    no controller.
    """
    every = [r for r in recordings if r.plant_nm is not None and r.view is not None]
    if not every:
        return ()
    top = max(float(np.quantile(np.abs(r.view.velocity_rad_s), 0.995)) for r in every if r.view is not None)
    sums: dict[tuple[Region, str], float] = {}

    def add(region: Region, squares: float, words: str = "") -> None:
        key = (region, words or _WORDS[region])
        sums[key] = sums.get(key, 0.0) + max(0.0, squares)

    logs = []
    for recording in every:
        low_pass = recording.low_pass
        row_s = recording.step_s * low_pass.stride
        floor = noise_nm**2 * row_s
        for region, beside_noise in _of_drive(recording, low_pass, velocity_gain_nm_s_per_rad):
            squares, white = np.sum(low_pass.thinned(beside_noise) ** 2, axis=0) * row_s
            add(region, float(squares - white))
        log, winding, still = _thinned(recording, low_pass, top)
        squares = log.residual_nm**2 * row_s
        add(Region.REVERSAL, float(np.sum(squares[winding] - floor)))
        add(Region.STANDSTILL, float(np.sum(squares[still] - floor)))
        logs.append(log)
    for (region, words), squares_of in _sliding(logs, top, noise_nm).items():
        add(region, squares_of, words)
    total = sum(sums.values())
    if total <= 0.0:
        return ()
    found = [Where(region.value, value / total, words) for (region, words), value in sums.items() if value > 0.0]
    whole = by_region(found)
    return tuple(sorted(found, key=lambda w: (-whole[Region(w.region)], w.region, -w.share_of_gap)))


def by_region(places: Sequence[Where]) -> dict[Region, float]:
    """Shares by region, the bands of speed taken together, largest first."""
    shares: dict[Region, float] = {}
    for place in places:
        region = Region(place.region)
        shares[region] = shares.get(region, 0.0) + place.share_of_gap
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def lives(places: Sequence[Where]) -> str:
    """Half a sentence: where most of the gap is; empty where nothing is known."""
    shares = by_region(places)
    if not shares:
        return ""
    region, share = next(iter(shares.items()))
    return f"{100 * share:.0f} % of the gap sits {_WORDS[region]}"


def _of_drive(recording: Recording, low_pass: LowPass, velocity_gain: float | None) -> list[tuple[Region, Array]]:
    """The residuals of drive and sensors as torques, unfiltered, each with white noise as loud as its own, (n, 2)."""
    view = recording.view
    assert view is not None
    parts = []
    if recording.actuation_nm is not None:
        parts.append((Region.ACTUATION, _beside_noise(recording.actuation_nm, low_pass)))
    if recording.kinematic_rad_s is not None:
        # Nobody states for when in a row its velocity holds.
        change = np.gradient(low_pass(view.velocity_rad_s), recording.step_s)
        late_s, half_s = recording.kinematic_rad_s @ change / max(change @ change, 1e-300), 0.5 * recording.step_s
        errors = _beside_noise(recording.kinematic_rad_s - np.clip(late_s, -half_s, half_s) * change, low_pass)
        if velocity_gain is None:
            errors = np.gradient(low_pass(errors), recording.step_s, axis=0)
        weight = view.motor_inertia_kg_m2 + view.link_inertia_kg_m2 if velocity_gain is None else velocity_gain
        parts.append((Region.KINEMATICS, weight * errors))
    return parts


def _beside_noise(residual: Array, low_pass: LowPass) -> Array:
    """A residual and white noise as loud as it is in the octave above the band, (n, 2)."""
    above = LowPass(low_pass.rate_hz, 2.0 * low_pass.cutoff_hz)(residual) - low_pass(residual)
    white = np.random.default_rng(0).standard_normal(residual.size) * rms(above) / low_pass.white_gain
    return np.stack([residual, white], axis=1)


def _thinned(recording: Recording, low_pass: LowPass, top: float) -> tuple[_Log, np.ndarray, np.ndarray]:
    """(the log, samples after a reversal, samples at standstill)."""
    view = recording.view
    assert view is not None and recording.plant_nm is not None
    table = low_pass.thinned(np.stack([recording.plant_nm, view.velocity_rad_s], axis=1))
    rows = table.shape[0]
    winding = _after_reversal(view.position_rad, view.slip, 4.0 * view.coulomb_nm / view.stiffness_nm_per_rad)
    winding = winding[:: low_pass.stride][:rows]
    still = np.abs(table[:, 1]) < STILL * top
    winding &= ~still
    log = _Log(recording, view, table[:, 0], table[:, 1], ~still & ~winding, low_pass.stride)
    return log, winding, still


def _sliding(logs: Sequence[_Log], top: float, noise_nm: float) -> dict[tuple[Region, str], float]:
    """Squares of the sliding part by region, N2 m2 s."""
    end_s = max(log.view.start_s + log.recording.step_s * log.view.position_rad.size for log in logs)
    known_c = [c for log in logs if (c := log.recording.experiment.temperature_c) is not None and np.isfinite(c).any()]
    warm_c = float(np.nanmean(np.concatenate(known_c))) if known_c else 0.0
    families = [_families(log, top, end_s, warm_c) for log in logs]
    names = list(families[0])
    weight = [math.sqrt(log.recording.step_s * log.stride) for log in logs]
    y = np.concatenate([w * log.residual_nm[log.sliding] for w, log in zip(weight, logs, strict=True)])
    columns = {
        name: np.concatenate([w * f[name][log.sliding] for w, f, log in zip(weight, families, logs, strict=True)])
        for name in names
    }
    if y.size < 4 * sum(c.shape[1] for c in columns.values()):
        return {}
    explained = _Explained(columns, y)
    shares = explained.shares()
    # What depends on speed is told by band, each by its own squares.
    by_speed = shares.pop(Region.VELOCITY_BAND)
    result = {(name, _WORDS[name]): squares for name, squares in shares.items()}
    fitted = explained.fitted((Region.VELOCITY_BAND,)) ** 2
    rest = y - explained.fitted(tuple(names))
    fast, parts = 0.0, []
    ends = np.cumsum([np.count_nonzero(log.sliding) for log in logs])
    for log, w, own in zip(logs, weight, np.split(rest, ends[:-1]), strict=True):
        part = np.zeros(log.residual_nm.size)
        part[log.sliding] = own
        above = _above(part, 1.0 / (log.recording.step_s * log.stride))
        white = (noise_nm * w) ** 2
        share = float(np.sum(above**2)) / max(float(np.sum(part**2)), 1e-300)
        fast += max(0.0, float(np.sum(above**2)) - share * (white * own.size))
        # Halves of a spectrum are orthogonal; sample by sample the slow one keeps its part of the squares.
        parts.append((1.0 - share) * np.maximum(own**2 - white, 0.0))
    slow = np.concatenate(parts)
    result[Region.FREQUENCY, _WORDS[Region.FREQUENCY]] = fast
    speed = np.concatenate([np.abs(log.velocity_rad_s[log.sliding]) for log in logs])
    whole = max(float(np.sum(fitted)), 1e-300)
    edges = (*(edge * top for edge in SPEED_BANDS[::2]), math.inf)
    for low, high in itertools.pairwise(edges):
        there = (speed >= low) & (speed < high)
        words = f"sliding at {low:.2g} to {min(high, top):.2g} rad/s"
        mine = by_speed * float(np.sum(fitted[there])) / whole + float(np.sum(slow[there]))
        result[Region.VELOCITY_BAND, words] = mine
    return result


def _families(log: _Log, top: float, end_s: float, warm_c: float) -> dict[Region, Array]:
    """Columns by region, low-passed like the residual and thinned: shape (m, k) each."""
    view = log.view
    q, v, slip = view.position_rad, log.velocity_rad_s, view.slip
    motor = 2.0 * math.pi * q if view.gear_ratio == 1.0 else view.gear_ratio * q
    ripple = [f(k * motor) for k in RIPPLE_ORDERS for f in (np.cos, np.sin)] if view.gear_ratio != 1.0 else []
    late = (view.start_s + log.recording.step_s * np.arange(q.size)) / end_s
    friction = view.coulomb_nm * slip + view.rate_nm
    measured_c = log.recording.experiment.temperature_c
    warmer = np.zeros_like(q) if measured_c is None else np.nan_to_num(measured_c - warm_c)
    raw = {
        Region.POSITION: [np.cos(q), np.sin(q), np.cos(2 * q), np.sin(2 * q), *ripple],
        Region.ACCELERATION: [view.acceleration_rad_s2],
        Region.LOAD: [slip * np.abs(view.load_nm), slip * view.load_nm**2],
        # Friction in the middle of the set is friction at some speed; only what changes from there is time's.
        Region.TEMPERATURE: [friction * (late - 0.5), friction * (late - 0.5) ** 2, friction * warmer],
    }
    low_pass = log.recording.low_pass
    thin = low_pass.thinned(np.stack([c for family in raw.values() for c in family], axis=1))
    ends = np.cumsum([len(family) for family in raw.values()])
    result = dict(zip(raw, np.split(thin, ends[:-1], axis=1), strict=True))
    edges = np.array([*SPEED_BANDS, np.inf]) * top
    band = np.clip(np.digitize(np.abs(v), edges) - 1, 0, len(SPEED_BANDS) - 1) + len(SPEED_BANDS) * (v < 0)
    result[Region.VELOCITY_BAND] = np.eye(2 * len(SPEED_BANDS))[band]
    return result


class _Explained:
    """Squares of a residual that families of columns describe, alone and together."""

    def __init__(self, columns: Mapping[Region, Array], y: Array) -> None:
        self._columns = columns
        self._names = tuple(columns)
        self._table = np.concatenate(list(columns.values()), axis=1)
        self._table = self._table / np.maximum(np.sqrt(np.sum(self._table**2, axis=0)), 1e-12)
        self._gram = self._table.T @ self._table
        self._right = self._table.T @ y
        ends = np.cumsum([c.shape[1] for c in columns.values()])
        self._at = {
            name: np.arange(end - columns[name].shape[1], end) for name, end in zip(self._names, ends, strict=True)
        }
        self._known: dict[frozenset[Region], float] = {frozenset(): 0.0}

    def fitted(self, names: Sequence[Region]) -> Array:
        """What the families together say, shape (m,)."""
        at = np.concatenate([self._at[name] for name in names])
        return np.asarray(self._table[:, at] @ self._weights(at))

    def shares(self) -> dict[Region, float]:
        """Shapley's share of the explained squares, by family; they add up to what all explain together."""
        n = len(self._names)
        shares = {}
        for name in self._names:
            others = [other for other in self._names if other is not name]
            mean = 0.0
            for size in range(n):
                weight = math.factorial(size) * math.factorial(n - size - 1) / math.factorial(n)
                for group in itertools.combinations(others, size):
                    mean += weight * (self._squares(frozenset((*group, name))) - self._squares(frozenset(group)))
            shares[name] = max(0.0, mean)
        return shares

    def _squares(self, names: frozenset[Region]) -> float:
        if names not in self._known:
            at = np.concatenate([self._at[name] for name in self._names if name in names])
            self._known[names] = float(self._weights(at) @ self._right[at])
        return self._known[names]

    def _weights(self, at: np.ndarray) -> Array:
        inner = self._gram[np.ix_(at, at)] + 1e-6 * np.eye(at.size)
        return np.asarray(np.linalg.solve(inner, self._right[at]))


def _above(values: Array, rate_hz: float) -> Array:
    """The part above ``FAST_HZ``, by its spectrum: orthogonal to the rest, so that squares add up."""
    spectrum = np.fft.rfft(values)
    spectrum[np.fft.rfftfreq(values.size, 1.0 / rate_hz) < FAST_HZ] = 0.0
    return np.asarray(np.fft.irfft(spectrum, values.size))


def _after_reversal(position_rad: Array, slip: Array, travel_rad: float) -> np.ndarray:
    """True until the joint has moved ``travel_rad`` since its direction of sliding changed."""
    direction = np.where(np.abs(slip) >= 0.999, np.sign(slip), 0.0)
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(position_rad)))])
    slid = np.maximum.accumulate(np.where(direction != 0.0, np.arange(path.size), -1))[:-1]  # row that slid last
    before = np.concatenate([[0.0], np.where(slid < 0, 0.0, direction[slid])])
    start = np.where((direction == 0.0) | (direction != before), path, -np.inf)
    mask: np.ndarray = path - np.maximum.accumulate(start) < travel_rad
    return mask
