"""A robot's own page: what is active, how every joint has changed, and how the nights went."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from frictid_hil.profiles.records import Attempt, Promotion, TrendPoint
from frictid_hil.report.calendar import STATES, calendar, state_of
from frictid_hil.report.pages import Link, Page, Section, Table
from frictid_hil.report.trends import trend_figures
from frictid_hil.report.words import sentence, when, with_interval
from frictid_hil.units import format_figure

_SHOWN = 60
_DONE = {"promote": "promoted", "rollback": "rolled back to", "baseline": "made the baseline"}


def index_page(
    robot: str,
    trends: Mapping[str, Sequence[TrendPoint]],  # of every joint
    promotions: Sequence[Promotion],
    nights: Sequence[Attempt],
    active: Promotion | None,  # what is in force; None where nothing is
    baseline: str | None,  # id of the profile that drift is measured from
    addresses: Mapping[str, str] | None = None,  # of the page of a night, by its ``utc``
) -> Page:
    """The page of one robot; trends, promotions and nights are told oldest first."""
    addresses = addresses or {}
    headline = f"Profile {active.id} is active since {when(active.utc)}." if active else "No profile was promoted yet."
    if nights:
        last = nights[-1]
        told = "promoted" if last.promoted else f"{_word(last.outcome)}, not promoted"
        headline += f" Last recalibration: {when(last.utc)}, {told}."
        if last.drifted:
            headline += f" Drifted: joint{'s' if len(last.drifted) > 1 else ''} {', '.join(last.drifted)}."
        if not last.promoted and last.next_step:
            headline += f" Next step: {sentence(last.next_step)}"
    measured_from = "There is no baseline to measure from."
    if baseline:
        measured_from = f"Drift is measured from the baseline {baseline}."
    # The policy's limit when the newest night began that tells it.
    limit = next((n.drift_limit_percent for n in reversed(nights) if n.drift_limit_percent is not None), None)
    sections = [
        Section("Nights", calendar=calendar(nights, addresses)) if nights else None,
        Section(
            "Joints",
            words=(measured_from,),
            tables=(_joints(trends),),
            figures=trend_figures(trends, drift_limit_percent=limit),
        ),
        Section("Recalibrations", tables=(_nights(nights, addresses),)) if nights else None,
        Section("Promotions", tables=(_promotions(promotions),)) if promotions else None,
    ]
    count = max((len(points) for points in trends.values()), default=0)
    facts = {"profiles kept": str(count), "recalibrations": str(len(nights)), "baseline": baseline or "none"}
    return Page(f"Friction history of {robot}", headline, [section for section in sections if section], facts)


def _word(outcome: str) -> str:
    return outcome.replace("_", " ")


def _joints(trends: Mapping[str, Sequence[TrendPoint]]) -> Table:
    rows = []
    for name, points in trends.items():
        last = points[-1].joint
        rows.append(
            (
                name,
                ""
                if last.coulomb_nm is None
                else with_interval(last.coulomb_nm, last.coulomb_low_nm, last.coulomb_high_nm, "").strip(),
                format_figure(last.distance_percent, ".1f"),
                format_figure(last.temperature_c, ".1f"),
                ", ".join(last.gates_failed).replace("_", " ") or "none",
                when(points[-1].created_utc),
            )
        )
    headings = ("joint", "F_0 [N m, N]", "from baseline [%]", "temperature [degC]", "failed gates", "measured")
    caption = "The newest measurement of every joint, promoted or not; F_0 with its 95 % interval."
    return Table(headings, tuple(rows), caption=caption)


def _nights(nights: Sequence[Attempt], addresses: Mapping[str, str]) -> Table:
    rows = tuple(
        (
            Link(when(one.utc), addresses[one.utc]) if one.utc in addresses else when(one.utc),
            f"{STATES[state_of(one)][0]} {_word(one.outcome)}",
            "promoted" if one.promoted else "not promoted",
            ", ".join(one.drifted) or "none",
            sentence(one.reason),
            sentence(one.next_step),
        )
        for one in reversed(nights[-_SHOWN:])
    )
    headings = ("began", "outcome", "profile", "drifted joints", "why", "next step")
    return Table(headings, rows, caption=_newest(len(nights)))


def _promotions(promotions: Sequence[Promotion]) -> Table:
    rows = tuple(
        (when(one.utc), _DONE.get(one.action, one.action), one.id, one.by, sentence(one.reason))
        for one in reversed(promotions[-_SHOWN:])
    )
    return Table(("when", "what", "profile", "by", "why"), rows, caption=_newest(len(promotions)))


def _newest(count: int) -> str:
    return f"The newest {_SHOWN} of {count}, newest first." if count > _SHOWN else "Newest first."
