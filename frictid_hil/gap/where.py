"""Where: the squared gap split by what the joint was doing; every sample has one region, so shares add up to 1."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from frictid_hil.friction.trajectory import Array
from frictid_hil.gap.diagnosis import Where
from frictid_hil.gap.residuals import LowPass, Recording
from frictid_hil.simulation.effect import Region

_WORDS = {
    Region.ACTUATION: "the drive does not deliver what the controller asks for",
    Region.REVERSAL: "within the first travel after a reversal of motion",
    Region.STANDSTILL: "while the joint stands or creeps below 2 % of its top speed",
    Region.ACCELERATION: "where the acceleration is high",
    Region.LOAD: "at constant speed under the payload",
    Region.KINEMATICS: "in the reported velocity",
}


def where(recordings: Sequence[Recording], encoder_noise_nm: float) -> tuple[Where, ...]:
    """Shares of the squared gap by region, largest first; empty without a residual to share out.

    Actuation takes its part first (reported torque against demand); the plant's residual is then split by motion: just
    after reversals, at standstill, under strong acceleration, and the rest in three bands of velocity, apart by load.

    Args:
        recordings: logs to judge by.
        encoder_noise_nm: RMS that the encoder's step alone leaves in the plant's residual; not counted.
    """
    logs = [r for r in recordings if r.plant_nm is not None and r.view is not None]
    if not logs:
        return ()
    top = max(float(np.quantile(np.abs(r.view.velocity_rad_s), 0.995)) for r in logs if r.view is not None)
    hard = max(float(np.quantile(np.abs(_smooth_acceleration(r)), 0.95)) for r in logs)
    sums: dict[tuple[Region, str], float] = {}
    for recording in logs:
        low_pass = LowPass.at(1.0 / recording.step_s)
        assert recording.plant_nm is not None
        squares = low_pass(recording.plant_nm) ** 2
        if recording.actuation_nm is not None:
            key = (Region.ACTUATION, _WORDS[Region.ACTUATION])
            sums[key] = sums.get(key, 0.0) + float(np.sum(low_pass(recording.actuation_nm) ** 2))
        for key, mask in _regions(recording, top, hard).items():
            sums[key] = sums.get(key, 0.0) + float(np.sum(np.maximum(squares[mask] - encoder_noise_nm**2, 0.0)))
    total = sum(sums.values())
    if total <= 0.0:
        return ()
    found = [Where(region.value, value / total, words) for (region, words), value in sums.items() if value > 0.0]
    return tuple(sorted(found, key=lambda w: -w.share_of_gap))


def _smooth_acceleration(recording: Recording) -> Array:
    assert recording.view is not None
    return LowPass.at(1.0 / recording.step_s)(recording.view.acceleration_rad_s2)


def _regions(recording: Recording, top: float, hard: float) -> dict[tuple[Region, str], np.ndarray]:
    view = recording.view
    assert view is not None
    speed = np.abs(view.velocity_rad_s)
    still = speed < 0.02 * top
    winding = _after_reversal(view.position_rad, view.slip, 4.0 * view.coulomb_nm / view.stiffness_nm_per_rad)
    accelerating = np.abs(_smooth_acceleration(recording)) > hard
    regions: dict[tuple[Region, str], np.ndarray] = {}
    free = np.ones(speed.size, dtype=bool)

    def take(region: Region, words: str, mask: np.ndarray) -> None:
        nonlocal free
        regions[region, words] = mask & free
        free &= ~mask

    take(Region.REVERSAL, _WORDS[Region.REVERSAL], winding & ~still)
    take(Region.STANDSTILL, _WORDS[Region.STANDSTILL], still)
    take(Region.ACCELERATION, _WORDS[Region.ACCELERATION], accelerating)
    if recording.experiment.payload:
        take(Region.LOAD, _WORDS[Region.LOAD], free.copy())
    for low, high in ((0.0, 0.2), (0.2, 0.6), (0.6, np.inf)):
        words = f"sliding at {low * top:.2g} to {min(high, 1.0) * top:.2g} rad/s"
        take(Region.VELOCITY_BAND, words, (speed >= low * top) & (speed < high * top))
    return regions


def _after_reversal(position_rad: Array, slip: Array, travel_rad: float) -> np.ndarray:
    """True until the joint has moved ``travel_rad`` since its direction of sliding changed."""
    direction = np.where(np.abs(slip) >= 0.999, np.sign(slip), 0.0)
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(position_rad)))])
    since = np.full(path.size, np.inf)
    last, start = 0.0, -np.inf
    for k in range(path.size):
        if direction[k] == 0.0:
            start = path[k]
        elif direction[k] != last:
            start, last = path[k], direction[k]
        since[k] = path[k] - start
    mask: np.ndarray = since < travel_rad
    return mask
