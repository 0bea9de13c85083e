"""The result of a compensation: its JSON and its page, also where it ended early."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from frictid_hil.errors import FrictidError
from frictid_hil.jobs.compensation.figures import (
    DOMINATED_PERCENT,
    ModeFigures,
    figures,
    following_lag_s,
    friction_dominates,
    tracking_floor_rad,
)
from frictid_hil.jobs.compensation.plan import Asked
from frictid_hil.jobs.compensation.wanted import Wanted
from frictid_hil.plan.control import Compensated
from frictid_hil.plan.mode import Mode
from frictid_hil.recording.samples import Mark
from frictid_hil.report.compensation import ModeRun, compensation_page
from frictid_hil.report.pages import write_page
from frictid_hil.report.words import plain
from frictid_hil.runner.events import JointRun
from frictid_hil.runs.life import Ended, Run

_LATE_PERCENT = 50.0  # of the tracking error, from which on the lag of a drive's own loop is told


@dataclass(slots=True)
class Progress:
    """What a run has measured so far, by mode; an error halfway loses nothing of it."""

    runs: dict[str, ModeRun] = field(default_factory=dict)
    run: JointRun | None = None
    service: Mark | None = None


@dataclass(frozen=True, slots=True)
class CompensationResult:
    """The result of a compensation: its figures as in the JSON, its page where a mode was finished."""

    ended: Ended
    figures: Mapping[str, Any]
    report: Path | None = None

    def to_json(self) -> dict[str, Any]:
        """The JSON of the verb."""
        report = {"report": str(self.report.resolve())} if self.report else {}
        return {**self.ended.to_json(), **self.figures, **report}


def result_of(asked: Asked, run: Run, progress: Progress, error: FrictidError | None) -> CompensationResult:
    """The result; manifest and page are written."""
    wanted, moved = asked.wanted, progress.run
    inertia, source = _inertia(asked)
    found = figures(progress.runs, wanted.task, inertia, _floors(asked, inertia))
    friction = next((law.friction for law in asked.laws.values() if law.friction is not None), None)
    told: dict[str, Any] = {
        "joint": asked.joint,
        "task": wanted.task,
        "setting": wanted.setting,
        "compensation_ratio": friction.ratio if friction else None,
        "compensation_ratio_lowest": asked.lowest_ratio,
        "stiffness_nm_per_rad": friction.stiffness_nm_per_rad if friction else None,
        "inertia_kg_m2": inertia,
        "inertia_source": source,
        "seed": asked.setup.seed if wanted.simulated else None,
        **{key: getattr(moved, key, None) for key in ("rate_hz", "late_cycles", "missed_cycles")},
        "warnings": list(asked.warnings),
        "profile": str(asked.profile.resolve()),
        "modes": {
            **{mode: figure.values() for mode, figure in found.items()},
            **_service_figures(wanted, progress.service),
        },
        "friction_dominates": friction_dominates(found),
        "remarks": [*_remarks(found), *_late(wanted, progress.runs, found)],
    }
    ended = run.end(error)
    if not progress.runs:
        return CompensationResult(ended, told)
    page = compensation_page(
        asked.robot.name,
        asked.joint,
        wanted.task,
        progress.runs,
        told["modes"],
        facts=_facts({**told, "run": str(ended.run.resolve())}, "SIMULATED" if wanted.simulated else "REAL"),
        remarks=told["remarks"],
        outcome=ended.outcome,
        error=error.what if error else "",
    )
    return CompensationResult(ended, told, write_page(page, ended.run / "report.html"))


def _remarks(found: Mapping[str, ModeFigures]) -> list[str]:
    """What the figures mean, in words."""
    dominates = friction_dominates(found)
    if dominates is None:
        return []
    left_percent = 100.0 - (found["mop-reference"].ceiling_percent or 0.0)
    exact = f"given back exactly, friction would leave {left_percent:.1f} % of it"
    if dominates:
        return [f"friction dominates the tracking error: {exact}"]
    return [
        f"inertia has a large part in the tracking error: {exact}, more than {100.0 - DOMINATED_PERCENT:.0f} %; "
        "at a lower `--speed` friction dominates"
    ]


def _late(wanted: Wanted, runs: Mapping[str, ModeRun], found: Mapping[str, ModeFigures]) -> list[str]:
    """A remark for a drive's own loop: how much of the tracking error is delay, which friction does not cause."""
    base = found.get("nc")
    if wanted.drive_mode is Mode.TORQUE or base is None or not base.tracking_rms_rad or len(runs) < 2:
        return []
    lag_s = min(following_lag_s(run) for run in runs.values())
    share_percent = 100.0 * lag_s * wanted.peak_rad_s / base.tracking_rms_rad
    if share_percent < _LATE_PERCENT:
        return []
    return [
        f"the drive follows its set-points {1e3 * lag_s:.1f} ms late, which makes {share_percent:.0f} % of the "
        "tracking error without compensation; no friction compensation takes that away. A higher `cycle_hz` does, "
        "and at a lower `--speed` friction has the larger part"
    ]


def _inertia(asked: Asked) -> tuple[float | None, str]:
    """The inertia that is removed from the hand torque; on a simulated robot the true one, which no law sees."""
    if asked.wanted.simulated:
        value = asked.setup.joint(asked.joint).simulated.get("inertia_kg_m2")
        if isinstance(value, int | float):
            return float(value), "simulated joint"
    return asked.entry.inertia_kg_m2.value, "profile"


def _floors(asked: Asked, inertia_kg_m2: float | None) -> dict[str, float]:
    """By mode, what remains of the tracking error with friction out of the way; not for nc or a drive's own loop."""
    if asked.wanted.task != "track" or inertia_kg_m2 is None:
        return {}
    return {
        motion.law.mode: tracking_floor_rad(
            motion.path,
            motion.law.gains,
            inertia_kg_m2,
            asked.entry.curve(),
            first_s=asked.wanted.period_s,
            follows_reference=motion.law.follows_reference,
        )
        for motion in asked.plan.joints[0].motions
        if isinstance(motion, Compensated) and motion.law.gains is not None and motion.law.friction is not None
    }


def _service_figures(wanted: Wanted, service: Mark | None) -> dict[str, Any]:
    count, velocity, torque = service.details["count_v2_t2"] if service else (0, 0.0, 0.0)
    if not count:
        return {}
    return {
        wanted.modes[0]: {
            "velocity_rms_rad_s": math.sqrt(velocity / count),
            "torque_rms_nm": math.sqrt(torque / count) if torque else None,
            "torque_rms_inertia_removed_nm": None,
            "reduction_percent": None,
            "reduction_inertia_removed_percent": None,
            "tracking_rms_rad": None,
            "reasons": {"reduction_percent": "a service has nothing to compare with"},
        }
    }


def _facts(result: dict[str, Any], robot: str) -> dict[str, str]:
    """Describe how the joint was compensated, for the page."""
    inertia, rate = result["inertia_kg_m2"], result["rate_hz"]
    facts = {
        "robot": robot,
        "setting": str(result["setting"]),
        "compensation ratio": f"{_shown(result['compensation_ratio'])}, at its lowest "
        f"{_shown(result['compensation_ratio_lowest'])}",
        "stiffness K": f"{_shown(result['stiffness_nm_per_rad'])} N m/rad",
        "inertia": "unknown" if inertia is None else f"{_shown(inertia)} kg m2, of the {result['inertia_source']}",
        "rate": f"{_shown(rate)} Hz",
        "seed": str(result["seed"]),
        "profile": str(result["profile"]),
        "run": str(result["run"]),
        "warnings": "; ".join(result["warnings"]),
    }
    return {name: told for name, told in facts.items() if told}


def _shown(value: Any) -> str:
    return plain(value) if isinstance(value, int | float) else str(value)
