"""From figures and facts to one HTML file with everything in it."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup, escape

from frictid_hil.files import write_whole
from frictid_hil.report.calendar import Calendar
from frictid_hil.report.figures import Figure


@dataclass(frozen=True, slots=True)
class Link:
    """Words that lead to another page, by its address relative to this one."""

    words: str
    address: str


@dataclass(frozen=True, slots=True)
class Table:
    """Rows under headings; cells are text or lead to another page."""

    headings: tuple[str, ...]
    rows: tuple[tuple[str | Link, ...], ...]
    caption: str = ""


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a page, in reading order: words, verdicts, tables, figures."""

    title: str
    words: tuple[str, ...] = ()  # what stands between backquotes is set as code
    checks: tuple[tuple[bool, str], ...] = ()  # (passed, sentence) pairs
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()
    links: tuple[tuple[str, str], ...] = ()  # title and relative address of pages that lie beside this one
    calendar: Calendar | None = None


@dataclass(frozen=True, slots=True)
class Page:
    """A whole page; the headline is the one sentence that a reader must not miss, the facts are provenance."""

    title: str
    headline: str
    sections: Sequence[Section]
    facts: Mapping[str, str] = field(default_factory=dict)


def write_page(page: Page, path: Path) -> Path:
    """Write a page as one self-contained file, whole or not at all; raises as ``write_whole``."""
    write_whole(path, html_of(page))
    return path


def html_of(page: Page) -> str:
    """The page as one self-contained document."""
    specs: list[dict[str, Any]] = []
    numbered: dict[int, int] = {}
    for section in page.sections:
        for figure in section.figures:
            numbered[id(figure)] = len(specs)
            specs.append(figure.spec())
    return template("page.html").render(
        page=page,
        number=lambda figure: numbered[id(figure)],
        plotly=plotly() if specs else "",
        # "</" would end the script element early.
        specs=json.dumps(specs, separators=(",", ":")).replace("</", "<\\/"),
    )


def template(name: str) -> jinja2.Template:
    """One of ours; everything put into it is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("frictid_hil.report", "templates"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["prose"] = _prose
    return environment.get_template(name)


def plotly() -> str:
    """The plotting library as JavaScript."""
    return files("frictid_hil.report").joinpath("vendor", "plotly-basic.min.js").read_text()


def _prose(words: str) -> Markup:
    """Plain words as HTML, escaped, with code where backquotes are."""
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", str(escape(words))))
