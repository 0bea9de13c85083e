"""The law of one mode, from a profile: gravity, the PD of the task, R, K and curve, and what the torque is clamped to.

All figures come from profile and robot file.
"""

from __future__ import annotations

import math

import numpy as np

from frictid_hil.config.profile import Estimate, JointProfile
from frictid_hil.errors import ProfileMismatch, UsageError
from frictid_hil.friction.compensation import (
    COARSE_RATIO,
    OUR_RATIO,
    PAPER_RATIO,
    PAPER_STIFFNESS_NM_PER_RAD,
    CompensationSettings,
    stiffness_with_margin,
)
from frictid_hil.friction.regression import BIAS_PRIOR
from frictid_hil.friction.rigid_body import COVERAGE
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.plan.control import ControlLaw, Gravity, PositionGains, RippleTorque
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import JointSetup

TRACK_SLACK_RAD = math.radians(5.0)
"""A tracking joint may be this far from its travel; its PD is clamped to what that takes."""
_SPEED_MARGIN, _SPEED_SLACK_RAD_S = 1.4, math.radians(10.0)
_SLEW_PER_COULOMB = 400.0
"""Torque may change by the Coulomb level in 2.5 ms: faster than any reversal, slower than a defect."""


def law_of(entry: JointProfile, joint: JointSetup, mode: str, wanted: Wanted, warnings: list[str]) -> ControlLaw:
    """The law of one mode.

    Raises:
        UsageError: an unstable R or K.
        ProfileMismatch: the profile lacks a figure that this needs.
    """
    where = f"joint {joint.name}"
    curve = entry.curve()
    gravity = Gravity(
        _needed(entry.gravity_cos_nm, "gravity", where),
        _needed(entry.gravity_sin_nm, "gravity", where),
        _needed(entry.bias_nm, "bias", where),
        calibrated_centre_rad(entry, joint),
        _calibrated_travel_rad(entry) / math.sqrt(8.0),
        _unsure_nm(entry.bias_nm, curve.coulomb_nm) if wanted.setting == "ours" else 0.0,
    )
    gains = None
    limit_nm = gravity.largest_nm + 1.2 * float(curve.magnitude(np.array(speed_bound_rad_s(wanted, joint))))
    if wanted.task == "track" and wanted.drive_mode is Mode.TORQUE:
        gains = PositionGains.low(curve.coulomb_nm, _needed(entry.inertia_kg_m2, "inertia", where))
        limit_nm += gains.stiffness_nm_per_rad * TRACK_SLACK_RAD + gains.damping_nm_s_per_rad * 2 * wanted.peak_rad_s
    friction, ripple = None, None
    if mode != "nc":
        friction = friction_settings(entry, mode, wanted, where, warnings)
        if wanted.setting == "ours" and mode.startswith("mop") and entry.ripple is not None:
            ripple = RippleTorque(entry.ripple.period_rad, entry.ripple.table_nm())
    return ControlLaw(
        mode=mode,
        gravity=gravity,
        gains=gains,
        friction=friction,
        ripple=ripple,
        follows_reference=mode == "mop-reference",
        torque_limit_nm=min(limit_nm, joint.max_torque_nm),
        slew_nm_per_s=_SLEW_PER_COULOMB * curve.coulomb_nm,
    )


def friction_settings(
    entry: JointProfile, mode: str, wanted: Wanted, where: str, warnings: list[str]
) -> CompensationSettings:
    """R, K and curve of one mode.

    Raises:
        UsageError: an unstable R or K.
        ProfileMismatch: no presliding stiffness was identified, and no K is given.
    """
    presliding = entry.presliding_stiffness_nm_per_rad.value
    ours = wanted.setting == "ours"
    # R of our setting is lower where the encoder hides presliding.
    usual = PAPER_RATIO if not ours else COARSE_RATIO if entry.presliding_yields == "unseen" else OUR_RATIO
    ratio = usual if wanted.ratio is None else wanted.ratio
    stiffness = wanted.stiffness_nm_per_rad
    if stiffness is None and not ours:
        stiffness = PAPER_STIFFNESS_NM_PER_RAD
    curve = entry.curve()
    if stiffness is None:
        found, level = entry.presliding_stiffness_nm_per_rad, entry.presliding_level_nm
        stiffness = stiffness_with_margin(
            found.low or _needed(found, "presliding stiffness", where),
            level.high or _needed(level, "presliding level", where),
            curve.coulomb_nm,
            ratio,
        )
    asymmetry = tuple(entry.quality.get("asymmetry_nm", ())) if ours else ()
    settings = CompensationSettings.of(
        curve,
        "mop" if mode == "mop-reference" else mode,
        stiffness_nm_per_rad=stiffness,
        ratio=ratio,
        asymmetry_nm=asymmetry if len(asymmetry) == len(curve.velocity_rad_s) else None,
        viscous_nm_s_per_rad=wanted.viscous_nm_s_per_rad,
        gradual=ours and entry.presliding_yields == "gradually",
    )
    published = not ours and wanted.ratio is None and wanted.stiffness_nm_per_rad is None
    try:
        settings.refuse_unstable(presliding, where=where)
    except UsageError as unstable:
        # The published figures are run as published on a simulated robot; a real one needs a person's --force.
        if not (published and (wanted.simulated or wanted.force)):
            raise
        sentence = f"the published setting may hunt: {unstable}"
        if sentence not in warnings:
            warnings.append(sentence)
    return settings


def calibrated_centre_rad(entry: JointProfile, joint: JointSetup) -> float:
    """Middle of the travel over which the profile was identified."""
    return joint.start_position_rad + _calibrated_travel_rad(entry) / 2


def speed_bound_rad_s(wanted: Wanted, joint: JointSetup) -> float:
    """Return the highest speed that the supervisor allows during the task."""
    return min(joint.max_velocity_rad_s, _SPEED_MARGIN * wanted.peak_rad_s + _SPEED_SLACK_RAD_S)


def _calibrated_travel_rad(entry: JointProfile) -> float:
    return entry.procedure.amplitude_rad if entry.procedure else 0.0


def _unsure_nm(bias: Estimate, coulomb_nm: float) -> float:
    """Half of the 95 % interval; where a profile has none, half of the interval that the identification starts from."""
    if bias.low is None or bias.high is None:
        return COVERAGE * BIAS_PRIOR * coulomb_nm
    return (bias.high - bias.low) / 2


def _needed(figure: Estimate, what: str, where: str) -> float:
    if figure.value is None:
        raise ProfileMismatch(
            f"the profile has no {what}: {figure.reason}",
            where=where,
            next_step="identify its run again, or calibrate the joint with its whole procedure, slow reversal included",
        )
    return figure.value
