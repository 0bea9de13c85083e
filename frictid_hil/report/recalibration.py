"""The page of a recalibration: was it promoted, why, what has drifted, and how that came over time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from frictid_hil.config.policy import Policy
from frictid_hil.config.profile import FrictionProfile, JointProfile
from frictid_hil.profiles.records import TrendPoint
from frictid_hil.report.calibration import axes_of, over_speed, pairs_of
from frictid_hil.report.figures import IDENTIFIED, PUBLISHED, REFERENCE, Figure, line
from frictid_hil.report.pages import Page, Section, Table
from frictid_hil.report.trends import trend_figures
from frictid_hil.report.words import change, estimate, sentence, when
from frictid_hil.units import format_figure

_REFERENCE = {"baseline": "baseline", "active": "active profile"}


def recalibration_page(
    result: Mapping[str, Any],  # JSON of the verb
    policy: Policy,
    newer: FrictionProfile,  # measured
    active: FrictionProfile | None,  # in force before; None where none was
    baseline: FrictionProfile | None,  # that drift is measured from
    trends: Mapping[str, Sequence[TrendPoint]],  # of every joint, this night included
) -> Page:
    """The page of one night."""
    verdict = "promoted" if result["promoted"] else f"not promoted ({result['outcome'].replace('_', ' ')})"
    headline = f"The new profile was {verdict}: {sentence(result['reason'])} Next step: {result['next_step']}."
    pages = (("Everything that was measured this night", "report.html"),) if result.get("report") else ()
    curves = tuple(_curves(name, joint, active, baseline) for name, joint in newer.joints.items())
    sections = [
        Section("Verdict", (_policy(policy),), _checks(result), (_drift(result, newer),), links=pages),
        Section("Over time", figures=trend_figures(trends, drift_limit_percent=policy.drift_limit_percent)),
        Section("Curves", figures=curves),
    ]
    facts = {
        "measured": when(newer.provenance.created_utc),
        "run": str(result["run"]),
        "stored as": str(result["stored"]),
        "active before": "none" if active is None else when(active.provenance.created_utc),
        "baseline": "none" if baseline is None else when(baseline.provenance.created_utc),
        "driver and bus": f"{newer.provenance.driver} on {newer.provenance.bus}",
        "frictid-hil": f"{newer.provenance.tool_version} {newer.provenance.git_revision}".strip(),
    }
    return Page(f"Recalibration of {newer.robot}", headline, sections, facts)


def _policy(policy: Policy) -> str:
    how = "is promoted at once" if policy.promotion == "automatic" else "waits for a person to promote it"
    return (
        f"The robot file's policy: a joint further than {policy.drift_percent:g} % from the "
        f"{_REFERENCE[policy.drift_reference]} is told as drifted; one that changed by more than "
        f"{policy.refuse_percent:g} % since the active profile is refused. What passes {how}."
    )


def _checks(result: Mapping[str, Any]) -> tuple[tuple[bool, str], ...]:
    checks = []
    for name, figures in result["drift"].items():
        gates = result["joints"].get(name, {})
        if gates.get("outcome", "ok") != "ok":
            checks.append((False, f"Joint {name}: {'; '.join(gates.get('remarks', []))}."))
        elif figures["broken"]:
            percent = figures["distance_from_active_percent"]
            checks.append((False, f"Joint {name} changed by {percent:.1f} % since the active profile."))
        elif figures["drifted"]:
            checks.append((False, f"Joint {name} has drifted by {figures['distance_percent']:.1f} %."))
        else:
            distance = figures["distance_percent"]
            told = "passed; nothing to compare with yet" if distance is None else f"within {distance:.1f} %"
            checks.append((True, f"Joint {name}: {told}."))
    return tuple(checks)


def _drift(result: Mapping[str, Any], newer: FrictionProfile) -> Table:
    rows: list[tuple[str, ...]] = []
    for name, figures in result["drift"].items():
        share, joint = figures["overlap_share"], newer.joints[name]
        rows.append(
            (
                name,
                estimate(joint.coulomb_nm, "N" if joint.prismatic else "N m"),
                change(figures["coulomb_change_percent"]),
                format_figure(figures["distance_percent"], ".1f"),
                "" if share is None else f"{100 * share:.0f}",
                format_figure(figures["distance_from_active_percent"], ".1f"),
                format_figure(figures["temperature_c"], ".1f"),
                change(figures["temperature_change_c"]),
                "; ".join(f"{what}: {how}" for what, how in figures["other_changes"].items()),
            )
        )
    headings = [
        "joint",
        "F_0",
        "F_0 changed [%]",
        "curve changed [%]",
        "intervals that meet [%]",
        "since the active profile [%]",
        "temperature [degC]",
        "warmer by [K]",
        "what else changed",
    ]
    if not any(row[-1] for row in rows):
        headings, rows = headings[:-1], [row[:-1] for row in rows]
    caption = (
        "Changes of F_0, curve and temperature are from the policy's reference. A curve's change is the mean distance "
        "between the two over the measured speeds, in percent of the older one's mean, equation (15)."
    )
    return Table(tuple(headings), tuple(rows), caption=caption)


def _curves(name: str, joint: JointProfile, active: FrictionProfile | None, baseline: FrictionProfile | None) -> Figure:
    scale = axes_of(joint)[2]
    speeds = np.linspace(0.0, joint.velocity_rad_s[-1], 200)[1:]
    traces = []
    for title, other, color in (("active before", active, REFERENCE), ("baseline", baseline, PUBLISHED)):
        if other is not None and name in other.joints:
            curve = other.joints[name].curve()
            traces.append(line(title, speeds * scale, curve.magnitude(speeds), color, dash="dash"))
    traces += [
        line("measured now", speeds * scale, joint.curve().magnitude(speeds), IDENTIFIED),
        pairs_of(joint),
    ]
    return over_speed(f"Joint {name}", joint, traces, "Bars are 95 % intervals.")
