"""The figures of a compensation: the paper's criteria (25) and (28), raw and without inertia, each mode against nc.

Hand torque obeys tau_hand = I a + (what friction and gravity still take). The first term is work that no friction
compensation can spare: it sets the ceiling of the raw reduction, and is removed for the second figure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from frictid_hil.friction.compensation import Compensation, CompensationSettings
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.friction.filtering import Gaussian
from frictid_hil.friction.metrics import plain_rms, ratio_interval, rms_by_part
from frictid_hil.friction.trajectory import Array
from frictid_hil.jobs.identification.cycles import declared_skew
from frictid_hil.plan.control import Compensated, PositionGains
from frictid_hil.plan.plan import Motion
from frictid_hil.recording.samples import Mark, Samples
from frictid_hil.report.compensation import ModeRun

DOMINATED_PERCENT = 85.0
"""Friction dominates a tracking error where giving it back exactly would take away this much of it."""

_WIDTH_S = 0.004  # of the smoothing that is common to acceleration and torque: half power at 33 Hz


@dataclass(frozen=True, slots=True)
class ModeFigures:
    """The figures of one mode. A figure that cannot be formed is None, and ``reasons`` says why."""

    velocity_rms_rad_s: float  # V_s of (25)
    torque_rms_nm: float | None = None  # F_s of (25)
    torque_rms_inertia_removed_nm: float | None = None  # of hand torque minus inertia times acceleration
    reduction_percent: float | None = None  # of the task's own measure against nc: F_s for ``hand``, E_s for ``track``
    reduction_inertia_removed_percent: float | None = None  # of the one with inertia removed
    tracking_rms_rad: float | None = None  # E_s of (28)
    # Reduction that inertia leaves room for. ``hand``: raw reduction against nc of a joint without any friction that
    # moves as this one did. ``track``: of an ideal joint (``tracking_floor_rad``).
    ceiling_percent: float | None = None
    inertial_rms_nm: float | None = None  # of inertia times acceleration
    velocity_error_rms_rad_s: float | None = None  # of the path's speed less the measured one; None by hand
    drive_torque_rms_nm: float | None = None
    # Of the task's own measure, from cycle to cycle; None where there is one cycle.
    interval_95: tuple[float, float] | None = None
    reduction_interval_95_percent: tuple[float, float] | None = None  # of its reduction
    reasons: Mapping[str, str] = field(default_factory=dict)  # by figure

    def values(self) -> dict[str, object]:
        """The figures as plain values for JSON."""
        return {name: value for name, value in asdict(self).items() if name != "inertial_rms_nm"}


def mode_run(samples: Samples, mark: Mark, motion: Compensated, mode: str, period_s: float) -> ModeRun:
    """The samples of one mode, from its second cycle to the end of its last whole one."""
    part = samples.during(mark)
    time_s = (part.time_ns - mark.start_ns) * 1e-9
    whole_s = np.floor(float(time_s[-1]) / period_s + 0.01) * period_s
    begin_s = min(period_s, whole_s - period_s)
    kept = (time_s >= begin_s) & (time_s < whole_s)
    part, time_s = part.select(kept), time_s[kept]
    assert part.velocity_rad_s is not None and part.torque_nm is not None  # live rows have both
    return ModeRun(
        mode=mode,
        time_s=time_s,
        position_rad=part.position_rad,
        velocity_rad_s=part.velocity_rad_s,
        reference_rad=motion.position_rad(time_s),
        torque_nm=part.torque_nm,
        external_torque_nm=part.external_torque_nm,
        velocity_delay_s=declared_skew(samples).velocity_delay_s,
        cycles=max(1, round((whole_s - begin_s) / period_s)),
    )


def figures(
    runs: Mapping[str, ModeRun], task: str, inertia_kg_m2: float | None, floors_rad: Mapping[str, float] | None = None
) -> dict[str, ModeFigures]:
    """The figures of all modes, each against ``nc``; ``floors_rad``, by mode, is an ideal joint's tracking error."""
    floors_rad = floors_rad or {}
    alone = {mode: _alone(run, task, inertia_kg_m2) for mode, run in runs.items()}
    base = alone.get("nc")
    repeated = {mode: _by_cycle(run, task) for mode, run in runs.items()}
    return {
        mode: _with_intervals(
            _against(figure, base, task, floors_rad.get(mode)),
            repeated[mode],
            repeated.get("nc") if mode != "nc" else None,
        )
        for mode, figure in alone.items()
    }


def _by_cycle(run: ModeRun, task: str) -> Array | None:
    """The task's own measure of each cycle, shape (cycles,); None where there is none."""
    measure = run.reference_rad - run.position_rad if task == "track" else run.external_torque_nm
    if measure is None or not np.all(np.isfinite(measure)):
        return None
    return rms_by_part(measure, run.cycles)


def _with_intervals(figure: ModeFigures, own: Array | None, base: Array | None) -> ModeFigures:
    """The figures with the scatter from cycle to cycle: of the mode, and of its reduction against ``base``."""
    if own is None:
        return figure
    ratio = None if base is None else ratio_interval(base, own)
    reduction = None if ratio is None else (100.0 * (1.0 - ratio[1]), 100.0 * (1.0 - ratio[0]))
    interval = ratio_interval(np.ones_like(own), own)
    return replace(figure, interval_95=interval, reduction_interval_95_percent=reduction)


def friction_dominates(found: Mapping[str, ModeFigures]) -> bool | None:
    """Whether friction, not inertia, makes the tracking error, by the ceiling of mop-reference; None if unknown."""
    ceiling = found["mop-reference"].ceiling_percent if "mop-reference" in found else None
    return None if ceiling is None else ceiling >= DOMINATED_PERCENT


def following_lag_s(run: ModeRun) -> float:
    """Time by which the joint follows its path, by least squares of the tracking error on the speed of the path, s."""
    speed = np.gradient(run.reference_rad, run.time_s)
    return float((run.reference_rad - run.position_rad) @ speed / (speed @ speed))


def smoothed_acceleration(run: ModeRun) -> tuple[Array, Array]:
    """(acceleration rad/s^2, hand torque N m) through the same smoothing, ends cut off; for runs with a hand torque.

    On the wall clock a loop comes late now and then, or misses a cycle: rows are brought to an even grid first, and the
    acceleration is the rate of the drive's velocity. Differencing the position twice would make v dt / s^2 out of a
    drive that heard SYNC dt later than its row says (at 60 deg/s, 1 ms and s = 4 ms: 65 rad/s^2); differencing the
    velocity once makes a dt / s of it, a hundredth of that.
    """
    assert run.external_torque_nm is not None
    step_s = float(np.median(np.diff(run.time_s)))
    even_s = np.arange(run.time_s[0], run.time_s[-1] + 0.5 * step_s, step_s)
    velocity, torque_nm = (
        np.interp(even_s, run.time_s, column) for column in (run.velocity_rad_s, run.external_torque_nm)
    )
    kernel = Gaussian(step_s, max(_WIDTH_S, step_s))
    cut = int(np.ceil((kernel.reach_s + run.velocity_delay_s) / step_s)) + 1
    inside = slice(cut, -cut)
    return kernel.rate(velocity, run.velocity_delay_s)[inside], kernel.smooth(torque_nm)[inside]


def _alone(run: ModeRun, task: str, inertia_kg_m2: float | None) -> ModeFigures:
    figure = ModeFigures(velocity_rms_rad_s=plain_rms(run.velocity_rad_s), drive_torque_rms_nm=plain_rms(run.torque_nm))
    if task == "track":
        return replace(
            figure,
            tracking_rms_rad=plain_rms(run.reference_rad - run.position_rad),
            velocity_error_rms_rad_s=plain_rms(np.gradient(run.reference_rad, run.time_s) - run.velocity_rad_s),
            reasons={"torque_rms_nm": "nobody touches the joint while it tracks"},
        )
    reasons = {"tracking_rms_rad": "a person's hand has no reference"}
    if run.external_torque_nm is None or not np.all(np.isfinite(run.external_torque_nm)):
        reasons["torque_rms_nm"] = "no force sensor"
        return replace(figure, reasons=reasons)
    figure = replace(figure, torque_rms_nm=plain_rms(run.external_torque_nm), reasons=reasons)
    if inertia_kg_m2 is None:
        reasons["torque_rms_inertia_removed_nm"] = "the inertia is not known"
        return figure
    acceleration, torque_nm = smoothed_acceleration(run)
    inertial_nm = inertia_kg_m2 * acceleration
    return replace(
        figure,
        torque_rms_inertia_removed_nm=plain_rms(torque_nm - inertial_nm),
        inertial_rms_nm=plain_rms(inertial_nm),
    )


def _against(figure: ModeFigures, base: ModeFigures | None, task: str, floor_rad: float | None) -> ModeFigures:
    if base is None:
        return replace(figure, reasons={**figure.reasons, "reduction_percent": "nc did not run"})
    if task == "track":
        return replace(
            figure,
            reduction_percent=_reduction(figure.tracking_rms_rad, base.tracking_rms_rad),
            ceiling_percent=_reduction(floor_rad, base.tracking_rms_rad),
        )
    return replace(
        figure,
        reduction_percent=_reduction(figure.torque_rms_nm, base.torque_rms_nm),
        reduction_inertia_removed_percent=_reduction(
            figure.torque_rms_inertia_removed_nm, base.torque_rms_inertia_removed_nm
        ),
        ceiling_percent=_reduction(figure.inertial_rms_nm, base.torque_rms_nm),
    )


def _reduction(value: float | None, base: float | None) -> float | None:
    if value is None or not base:
        return None
    return 100.0 * (1.0 - value / base)


_STEP_S = 2e-4
_AT_ONCE_NM_PER_RAD = 1e7  # a spring that slips at once


def tracking_floor_rad(
    path: Motion,
    gains: PositionGains,
    inertia_kg_m2: float,
    curve: FrictionCurve,
    *,
    first_s: float,
    follows_reference: bool,
) -> float:
    """E_s of (28) of the ideal joint along a path from rest; what comes before ``first_s`` is not counted.

    A triangle turns at once, and a weak PD takes its time to turn an inertia; no friction compensation can take that
    away. Two ideal joints tell how long::

        measured velocity     no friction at all            I a = k_p (p_d - p) + k_d (v_d - v)
        reference velocity    friction given back exactly   I a = k_p (p_d - p) + k_d (v_d - v) + phi(v_d) - phi(v)

    The second, with ``follows_reference``, turns faster: while it still moves the old way, friction and its
    compensation both push it the new way.
    """
    times_s = np.arange(0.0, path.duration_s, _STEP_S)
    references = path.position_rad(times_s)
    velocities = np.gradient(references, _STEP_S).tolist()
    exact = CompensationSettings.of(curve, "mop", stiffness_nm_per_rad=_AT_ONCE_NM_PER_RAD, ratio=1.0)
    taken, given = Compensation(exact, _STEP_S).step, Compensation(exact, _STEP_S).step
    kp, kd = gains.stiffness_nm_per_rad, gains.damping_nm_s_per_rad
    position, velocity = float(references[0]), 0.0
    errors = []
    for reference, reference_velocity in zip(references.tolist(), velocities, strict=True):
        error = reference - position
        errors.append(error)
        torque = kp * error + kd * (reference_velocity - velocity)
        if follows_reference:
            torque += given(0.0, 0.0, reference_velocity) - taken(velocity * _STEP_S, velocity)
        velocity += torque / inertia_kg_m2 * _STEP_S
        position += velocity * _STEP_S
    counted = np.array(errors)[times_s >= first_s]
    return plain_rms(counted)
