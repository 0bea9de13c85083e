"""A robot's own page: what is active, how every joint has changed, and how the nights went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from frictid_hil.config.attempts import Attempt
from frictid_hil.config.promotions import Promotion
from frictid_hil.config.summary import TrendPoint
from frictid_hil.report.pages import Page, Section, Table
from frictid_hil.report.trends import trend_figures

_SHOWN = 60


def index_page(
    robot: str,
    trends: Mapping[str, Sequence[TrendPoint]],
    promotions: Sequence[Promotion],
    nights: Sequence[Attempt],
    active: Promotion | None,
    baseline: str | None,
) -> Page:
    """The page of one robot.

    Args:
        robot: name.
        trends: of every joint, oldest first.
        promotions: the journal, oldest first.
        nights: recalibrations, oldest first.
        active: what is in force; None where nothing is.
        baseline: id of the profile that drift is measured from.
    """
    headline = f"Profile {active.id} is active since {active.utc}." if active else "No profile was promoted yet."
    if nights:
        last = nights[-1]
        headline += f" Last recalibration: {last.utc}, {last.outcome}{', promoted' if last.promoted else ''}."
        if last.drifted:
            headline += f" Drifted: joints {', '.join(last.drifted)}."
    sections = [
        Section("Joints", words=(_baseline(baseline),), tables=(_joints(trends),), figures=trend_figures(trends)),
        Section("Recalibrations", tables=(_nights(nights),)) if nights else None,
        Section("Promotions", tables=(_promotions(promotions),)) if promotions else None,
    ]
    count = max((len(points) for points in trends.values()), default=0)
    facts = {"profiles kept": str(count), "recalibrations": str(len(nights)), "baseline": baseline or "none"}
    return Page(f"Friction history of {robot}", headline, [section for section in sections if section], facts)


def _baseline(baseline: str | None) -> str:
    return f"Drift is measured from the baseline {baseline}." if baseline else "There is no baseline to measure from."


def _joints(trends: Mapping[str, Sequence[TrendPoint]]) -> Table:
    rows = []
    for name, points in trends.items():
        last = points[-1].joint
        rows.append(
            (
                name,
                "" if last.coulomb_nm is None else f"{last.coulomb_nm:.4g}",
                "" if last.distance_percent is None else f"{last.distance_percent:.1f}",
                "" if last.temperature_c is None else f"{last.temperature_c:.1f}",
                ", ".join(last.gates_failed) or "none",
                points[-1].created_utc,
            )
        )
    headings = ("joint", "F_0 [N m or N]", "from baseline [%]", "temperature [degC]", "failed gates", "measured")
    return Table(headings, tuple(rows), caption="The newest measurement of every joint, promoted or not.")


def _nights(nights: Sequence[Attempt]) -> Table:
    rows = tuple(
        (
            one.utc,
            one.outcome,
            "promoted" if one.promoted else "not promoted",
            ", ".join(one.drifted),
            one.reason,
            one.next_step,
        )
        for one in reversed(nights[-_SHOWN:])
    )
    caption = f"Newest first, {min(_SHOWN, len(nights))} of {len(nights)}."
    return Table(("began", "outcome", "profile", "drifted joints", "why", "next step"), rows, caption=caption)


def _promotions(promotions: Sequence[Promotion]) -> Table:
    rows = tuple((one.utc, one.action, one.id, one.by, one.reason) for one in reversed(promotions[-_SHOWN:]))
    caption = f"Newest first, {min(_SHOWN, len(promotions))} of {len(promotions)}."
    return Table(("when", "what", "profile", "by", "why"), rows, caption=caption)
