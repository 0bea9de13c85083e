"""The friction curve phi(v): line sections through the identified pairs, equations (8) and (9).

phi is odd, joins (V_n, F_n) by lines, and is extended with the first and the last slope. Below V_1 and above V_N it is
an extrapolation, and says so. F_0 = phi(0+) is an extrapolated Coulomb level, not the break-away torque.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.trajectory import Array


@dataclass(frozen=True, slots=True)
class FrictionCurve:
    """An identified curve, built by ``FrictionCurve.through``."""

    velocity_rad_s: tuple[float, ...]  # V_1..V_N, strictly increasing, positive, shape (N,)
    torque_nm: tuple[float, ...]  # F_1..F_N, shape (N,)

    @staticmethod
    def through(velocity_rad_s: Array, torque_nm: Array, *, where: str = "") -> FrictionCurve:
        """The curve through N >= 2 pairs in any order, shape (N,) each; ``where`` names them in an error.

        Raises:
            IdentificationError: fewer than two pairs, non-finite or non-positive V_n, duplicate V_n, or F_0 <= 0.
        """
        v = np.asarray(velocity_rad_s, dtype=np.float64)
        f = np.asarray(torque_nm, dtype=np.float64)
        if v.ndim != 1 or v.shape != f.shape:
            raise IdentificationError(
                f"velocities {v.shape} and torques {f.shape} must be equal 1-D shapes", where=where
            )
        if v.size < 2:
            raise IdentificationError(f"a curve needs at least 2 pairs, got {v.size}", where=where)
        if not (np.all(np.isfinite(v)) and np.all(np.isfinite(f))):
            raise IdentificationError("a velocity-torque pair is not finite", where=where)
        order = np.argsort(v, kind="stable")
        v, f = v[order], f[order]
        if v[0] <= 0:
            raise IdentificationError(f"V_1 = {v[0]:.6g} rad/s is not positive", where=where)
        same = np.flatnonzero(np.diff(v) <= 0)
        if same.size:
            raise IdentificationError(
                f"two cycles reached the same mean velocity {v[same[0]]:.6g} rad/s",
                where=where,
                cause="saturated or poorly tracked cycles",
                next_step="lower the peak velocity or raise the travel",
            )
        curve = FrictionCurve(tuple(map(float, v)), tuple(map(float, f)))
        if curve.coulomb_nm <= 0:
            raise IdentificationError(
                f"F_0 = {curve.coulomb_nm:.4g} N m is not positive",
                where=where,
                cause="wrong torque sign, wrong direction, or the drive's own friction compensation is on",
                next_step="check the torque sign with `frictid-hil check`",
            )
        return curve

    @property
    def slopes_nm_s_per_rad(self) -> Array:
        """B_0..B_N of (9a)-(9c), shape (N + 1,)."""
        inner = np.diff(self.torque_nm) / np.diff(self.velocity_rad_s)
        return np.concatenate([[inner[0]], inner, [inner[-1]]])

    @property
    def coulomb_nm(self) -> float:
        """F_0 of (9f)."""
        (v1, v2), (f1, f2) = self.velocity_rad_s[:2], self.torque_nm[:2]
        return float(f1 - (f2 - f1) / (v2 - v1) * v1)

    @property
    def measured_range_rad_s(self) -> tuple[float, float]:
        """(V_1, V_N); outside the curve is extrapolated."""
        return self.velocity_rad_s[0], self.velocity_rad_s[-1]

    def torque(self, velocity_rad_s: Array) -> Array:
        """phi(v) of (8), N m, any shape; 0 at v = 0. Uses abs(v) in (9g)."""
        v = np.asarray(velocity_rad_s, dtype=np.float64)
        return np.asarray(np.sign(v) * self.magnitude(np.abs(v)))

    def magnitude(self, speed_rad_s: Array) -> Array:
        """phi(abs(v)) with phi(0) = F_0, N m, any shape."""
        speed = np.asarray(speed_rad_s, dtype=np.float64)
        knots = np.concatenate([[0.0], self.velocity_rad_s])
        levels = np.concatenate([[self.coulomb_nm], self.torque_nm])
        n = np.clip(np.searchsorted(knots, speed, side="right") - 1, 0, len(knots) - 1)
        return np.asarray(levels[n] + self.slopes_nm_s_per_rad[n] * (speed - knots[n]))

    def rate_part(self, velocity_rad_s: Array) -> Array:
        """phi_0(v) = phi(v) - F_0 sgn(v) of (17): continuous through zero, N m."""
        v = np.asarray(velocity_rad_s, dtype=np.float64)
        return np.asarray(np.sign(v) * (self.magnitude(np.abs(v)) - self.coulomb_nm))
