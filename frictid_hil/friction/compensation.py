"""Friction compensation, algorithm (24) and its rivals (26), (27): one tiny stateful object per joint.

==========  ===================================================
``mo``      R K e                                           (26)
``mol``     R (K e + B_c v)                                 (27)
``mop``     R (K e + phi_0(v))                              (24)
==========  ===================================================

A spring of stiffness K that slips at F_0 stands for presliding and the sign of motion. Encoder increments drive it, not
v * dt: a coarse or late velocity costs nothing there (20). It yields at once or, where a slow reversal shows that,
gradually, d(K e)/dx = K (1 -/+ K e / F_0) (Dahl 1968, LuGre). R < 1, or a free joint runs away on the first touch; R K
< presliding stiffness, or a standing one hunts (docs/reference/compensation-law.md).
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, replace
from math import exp

import numpy as np

from frictid_hil.errors import UsageError
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.trajectory import Array

FORMS = ("mo", "mol", "mop")

PAPER_RATIO = 0.9
PAPER_STIFFNESS_NM_PER_RAD = 10_000.0
OUR_RATIO = 0.95
COARSE_RATIO = 0.5  # where an encoder too coarse for presliding shows a turn late: the joint starts with a jump, by R

RATIO_MARGIN = 0.02
STIFFNESS_MARGIN = 0.1  # the setting ``ours`` is to stand with R larger by the one and K larger by this share


def stiffness_with_margin(
    presliding_nm_per_rad: float, presliding_level_nm: float, coulomb_nm: float, ratio: float
) -> float:
    """K of the setting ``ours``: the largest for which R K < presliding stiffness holds with both margins.

    docs/reference/compensation-law.md derives it. Of the two figures of presliding, the low end of the stiffness's
    interval and the high end of the level's.
    """
    sliding_nm_per_rad = presliding_nm_per_rad * min(1.0, coulomb_nm / presliding_level_nm)
    return sliding_nm_per_rad / ((1.0 + STIFFNESS_MARGIN) * (ratio + RATIO_MARGIN))


@dataclass(frozen=True, slots=True)
class CompensationSettings:
    """What one joint is given back, as plain values."""

    form: str  # ``mo``, ``mol`` or ``mop``
    coulomb_nm: float  # F_0
    stiffness_nm_per_rad: float  # K
    ratio: float  # R
    # Knots of phi_0, first 0, increasing, shape (k,); extended with the last slope.
    speed_rad_s: tuple[float, ...] = (0.0, 1.0)
    forward_nm: tuple[float, ...] = (0.0, 0.0)  # phi_0 at the knots for positive motion, first 0, shape (k,)
    backward_nm: tuple[float, ...] = (0.0, 0.0)  # its magnitude for negative motion, shape (k,)
    gradual: bool = False  # the spring yields gradually, not at once

    @staticmethod
    def of(
        curve: FrictionCurve,  # phi
        form: str,  # one of FORMS
        *,
        stiffness_nm_per_rad: float,  # K
        ratio: float,  # R
        # Half the difference of forward and backward friction at the curve's pairs, 0 at rest.
        asymmetry_nm: tuple[float, ...] | None = None,
        viscous_nm_s_per_rad: float | None = None,  # B_c for ``mol``; least squares on phi - F_0 unless given
        gradual: bool = False,  # see ``CompensationSettings``
    ) -> CompensationSettings:
        """From an identified curve; ``UsageError`` for another form."""
        if form not in FORMS:
            raise UsageError(f"no compensation {form!r}; there are {', '.join(FORMS)}")
        base = CompensationSettings(form, curve.coulomb_nm, stiffness_nm_per_rad, ratio, gradual=gradual)
        if form == "mol":
            slope = least_squares_viscosity(curve) if viscous_nm_s_per_rad is None else viscous_nm_s_per_rad
            return replace(base, forward_nm=(0.0, slope), backward_nm=(0.0, slope))
        if form == "mo":
            return base
        rate = np.asarray(curve.torque_nm) - curve.coulomb_nm
        even = np.zeros_like(rate) if asymmetry_nm is None else np.asarray(asymmetry_nm)
        return replace(
            base,
            speed_rad_s=(0.0, *curve.velocity_rad_s),
            forward_nm=(0.0, *(rate + even).tolist()),
            backward_nm=(0.0, *(rate - even).tolist()),
        )

    def refuse_unstable(self, presliding_nm_per_rad: float | None, *, where: str = "") -> None:
        """Refuse by a ``UsageError`` what would hunt or run away; only R is checked without a presliding stiffness."""
        if not 0.0 < self.ratio < 1.0:
            raise UsageError(
                f"the compensation ratio R = {self.ratio:g} must lie between 0 and 1",
                where=where,
                cause="at R = 1 nothing is left to slow a free joint down, and it runs away on the first touch",
                next_step="use --compensation-ratio 0.9",
            )
        if not self.stiffness_nm_per_rad > 0.0:
            raise UsageError(f"the stiffness K = {self.stiffness_nm_per_rad:g} N m/rad must be positive", where=where)
        if presliding_nm_per_rad is None:
            return
        if self.ratio * self.stiffness_nm_per_rad >= presliding_nm_per_rad:
            raise UsageError(
                f"R K = {self.ratio * self.stiffness_nm_per_rad:.4g} N m/rad is not below the identified "
                f"presliding stiffness {presliding_nm_per_rad:.4g} N m/rad",
                where=where,
                cause="a standing joint is held by its presliding spring; a compensation stiffer than it makes it hunt",
                next_step=f"use --stiffness below {presliding_nm_per_rad / self.ratio:.4g} N m/rad",
            )


class Compensation:
    """One joint's compensation; nothing is allocated per step but floats.

    The period between two steps is used only where a reference velocity drives the spring.
    """

    __slots__ = (
        "_backward",
        "_forward",
        "_gradual",
        "_knots",
        "_last",
        "_limit",
        "_period",
        "_ratio",
        "_spring",
        "_stiffness",
    )

    def __init__(self, settings: CompensationSettings, period_s: float) -> None:
        self._knots = settings.speed_rad_s
        self._last = len(settings.speed_rad_s) - 2
        self._forward = _sections(settings.speed_rad_s, settings.forward_nm)
        self._backward = _sections(settings.speed_rad_s, settings.backward_nm)
        self._limit = settings.coulomb_nm
        self._stiffness = settings.stiffness_nm_per_rad
        self._ratio = settings.ratio
        self._gradual = settings.gradual
        self._period = period_s
        self._spring = 0.0

    def step(
        self, position_increment_rad: float, velocity_rad_s: float, reference_velocity_rad_s: float | None = None
    ) -> float:
        """f_c of (24c), N m, for the cycle to come; the increment is since the last step, from the encoder.

        Where it is known what the joint will do, friction is that of the reference velocity: it is neither late nor
        noisy, and its sign changes when the motion does.
        """
        if reference_velocity_rad_s is not None:
            velocity_rad_s = reference_velocity_rad_s
            position_increment_rad = reference_velocity_rad_s * self._period
        limit = self._limit
        spring = self._spring
        if self._gradual:
            # The whole of the increment in closed form: it cannot pass the limit, however large.
            ahead = limit if position_increment_rad >= 0.0 else -limit
            spring = ahead - (ahead - spring) * exp(-self._stiffness * position_increment_rad / ahead)
        else:
            spring += self._stiffness * position_increment_rad
            if spring > limit:
                spring = limit
            elif spring < -limit:
                spring = -limit
        self._spring = spring
        last = self._last
        if velocity_rad_s >= 0.0:
            at = bisect_right(self._knots, velocity_rad_s) - 1
            level, slope = self._forward[at if at < last else last]
            return self._ratio * (spring + level + slope * velocity_rad_s)
        at = bisect_right(self._knots, -velocity_rad_s) - 1
        level, slope = self._backward[at if at < last else last]
        return self._ratio * (spring - level + slope * velocity_rad_s)


def least_squares_viscosity(curve: FrictionCurve) -> float:
    """B_c of (27): the line through rest nearest to phi - F_0 over [0, V_N], N m s/rad."""
    speeds: Array = np.linspace(0.0, curve.velocity_rad_s[-1], 512)
    rate = curve.magnitude(speeds) - curve.coulomb_nm
    return float(speeds @ rate / (speeds @ speeds))


def _sections(speeds: tuple[float, ...], levels: tuple[float, ...]) -> tuple[tuple[float, float], ...]:
    """(level at speed 0, slope) of each line section."""
    slopes = (np.diff(levels) / np.diff(speeds)).tolist()
    return tuple((level - slope * low, slope) for level, slope, low in zip(levels, slopes, speeds, strict=False))
