"""The page of a recalibration: was it promoted, why, what has drifted, and how that came over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from frictid_hil.config.policy import Policy
from frictid_hil.config.profile import FrictionProfile, JointProfile
from frictid_hil.config.summary import TrendPoint
from frictid_hil.report.figures import IDENTIFIED, PUBLISHED, REFERENCE, Figure, line, points
from frictid_hil.report.pages import Page, Section, Table
from frictid_hil.report.trends import trend_figures
from frictid_hil.units import degrees


def recalibration_page(
    result: Mapping[str, Any],
    policy: Policy,
    newer: FrictionProfile,
    active: FrictionProfile | None,
    baseline: FrictionProfile | None,
    trends: Mapping[str, Sequence[TrendPoint]],
) -> Page:
    """The page of one night.

    Args:
        result: JSON of the verb.
        policy: that was applied.
        newer: measured.
        active: in force before; None where none was.
        baseline: that drift is measured from; None where there is none yet.
        trends: of every joint, this night included.
    """
    verdict = "promoted" if result["promoted"] else f"not promoted ({result['outcome']})"
    headline = f"{newer.robot}: the new profile was {verdict}: {result['reason']}. Next step: {result['next_step']}."
    curves = tuple(_curves(name, joint, active, baseline) for name, joint in newer.joints.items())
    sections = [
        Section("Verdict", words=(_policy(policy),), checks=_checks(result), tables=(_drift(result),)),
        Section("Over time", figures=trend_figures(trends)),
        Section("Curves", figures=curves),
    ]
    facts = {
        "measured": newer.provenance.created_utc,
        "run": str(result["run"]),
        "stored as": str(result["stored"]),
        "active before": "none" if active is None else active.provenance.created_utc,
        "baseline": "none" if baseline is None else baseline.provenance.created_utc,
        "driver and bus": f"{newer.provenance.driver} on {newer.provenance.bus}",
        "frictid-hil": f"{newer.provenance.tool_version} {newer.provenance.git_revision}".strip(),
    }
    return Page(f"Recalibration of {newer.robot}", headline, sections, facts)


def _policy(policy: Policy) -> str:
    promotion = "automatically" if policy.promotion == "automatic" else "by a person only"
    return (
        f"Policy: drift is reported beyond {policy.drift_percent:g} % from the {policy.drift_reference}; a change of "
        f"more than {policy.refuse_percent:g} % from the active profile is refused; promotion {promotion}."
    )


def _checks(result: Mapping[str, Any]) -> tuple[tuple[bool, str], ...]:
    checks = []
    for name, figures in result["drift"].items():
        gates = result["joints"].get(name, {})
        if gates.get("outcome", "ok") != "ok":
            checks.append((False, f"joint {name}: {'; '.join(gates.get('remarks', []))}"))
        elif figures["broken"]:
            checks.append(
                (False, f"joint {name}: {figures['distance_from_active_percent']:.1f} % from the active profile")
            )
        elif figures["drifted"]:
            checks.append((False, f"joint {name}: has drifted by {figures['distance_percent']:.1f} %"))
        else:
            distance = figures["distance_percent"]
            told = "nothing to compare with yet" if distance is None else f"{distance:.1f} % from the reference"
            checks.append((True, f"joint {name}: {told}"))
    return tuple(checks)


def _drift(result: Mapping[str, Any]) -> Table:
    rows = []
    for name, figures in result["drift"].items():
        share = figures["overlap_share"]
        rows.append(
            (
                name,
                _number(figures["distance_percent"]),
                _number(figures["distance_from_active_percent"]),
                "" if share is None else f"{100 * share:.0f}",
                _number(figures["coulomb_change_percent"]),
                _number(figures["temperature_c"]),
                _number(figures["temperature_change_c"]),
                "; ".join(f"{what}: {how}" for what, how in figures["other_changes"].items()),
            )
        )
    headings = (
        "joint",
        "from reference [%]",
        "from active [%]",
        "intervals that overlap [%]",
        "change of F_0 [%]",
        "temperature [degC]",
        "change [K]",
        "what else changed",
    )
    return Table(headings, tuple(rows), caption="Distances are (15) over the measured speeds.")


def _curves(name: str, joint: JointProfile, active: FrictionProfile | None, baseline: FrictionProfile | None) -> Figure:
    unit, force, scale = ("m/s", "N", 1.0) if joint.prismatic else ("deg/s", "N m", degrees(1.0))
    speeds = np.linspace(0.0, joint.velocity_rad_s[-1], 200)[1:]
    half = None
    if joint.torque_interval_nm is not None:
        half = np.array([(high - low) / 2 for low, high in joint.torque_interval_nm])
    traces = [
        line("measured now", speeds * scale, joint.curve().magnitude(speeds), IDENTIFIED),
        points(
            "pairs V_n, F_n",
            np.array(joint.velocity_rad_s) * scale,
            np.array(joint.torque_nm),
            IDENTIFIED,
            half_width=half,
        ),
    ]
    for title, other, color in (("active before", active, REFERENCE), ("baseline", baseline, PUBLISHED)):
        if other is not None and name in other.joints:
            curve = other.joints[name].curve()
            traces.append(line(title, speeds * scale, curve.magnitude(speeds), color, dash="dash"))
    caption = "Bars are 95 % intervals."
    return Figure(f"Joint {name}: friction", tuple(traces), f"speed [{unit}]", f"friction [{force}]", caption=caption)


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"
