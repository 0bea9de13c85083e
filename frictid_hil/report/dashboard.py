"""The dashboard's own pages: what robots and runs there are, and a run while it moves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from frictid_hil.report.pages import Link, Page, Section, Table, template
from frictid_hil.report.words import when

_NEWEST = 100


def home_page(robots: Mapping[str, str], runs: Sequence[tuple[str, Mapping[str, Any]]]) -> Page:
    """Robots, each with when its newest profile was measured (UTC, "" for never), and runs, newest first."""
    moving = [address for address, manifest in runs if manifest["outcome"] is None]
    headline = f"{_count(len(robots), 'robot')}, {_count(len(runs), 'run')}; {len(moving)} at work or cut off."
    robot_rows = tuple(
        (Link(name, f"/robots/{name}"), when(measured) if measured else "none yet") for name, measured in robots.items()
    )
    run_rows = tuple(
        (
            Link(when(manifest["started_utc"]), f"/runs/{address}"),
            str(manifest["verb"]),
            str(manifest["robot"]),
            str(manifest["outcome"] or "at work or cut off").replace("_", " "),
        )
        for address, manifest in runs[:_NEWEST]
    )
    caption = f"The newest {_NEWEST} of {len(runs)}." if len(runs) > _NEWEST else "Newest first."
    nobody = "The store holds no profile yet. `frictid-hil profile promote RUN` puts one there."
    sections = [
        _listed("Robots", Table(("robot", "newest profile"), robot_rows), nobody),
        _listed(
            "Runs",
            Table(("began", "verb", "robot", "outcome"), run_rows, caption=caption),
            "There is no run in this folder yet.",
        ),
    ]
    return Page("frictid-hil", headline, sections)


def live_html(address: str, manifest: Mapping[str, Any]) -> str:
    """The page of a run that has no report yet; it asks ``/runs/ADDRESS/now`` every second."""
    return template("live.html").render(address=address, manifest=manifest, began=when(manifest["started_utc"]))


def _listed(title: str, table: Table, otherwise: str) -> Section:
    return Section(title, tables=(table,)) if table.rows else Section(title, words=(otherwise,))


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"
