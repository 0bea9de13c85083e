"""Whatever a file or a person says is text on a page: no element, no attribute and no script comes of it."""

from __future__ import annotations

import json
from html.parser import HTMLParser

from frictid_hil.report.calendar import Calendar, Day
from frictid_hil.report.dashboard import live_html
from frictid_hil.report.figures import Figure
from frictid_hil.report.pages import Link, Page, Section, Table, html_of

HOSTILE = "'\"><img src=x onerror=alert(1)></script><script>alert(2)</script>`<b>`"
FIGURE = Figure(HOSTILE, ({"name": HOSTILE, "x": [HOSTILE], "y": [1.0]},), HOSTILE, HOSTILE, HOSTILE, (HOSTILE,))
SECTION = Section(
    HOSTILE,
    (HOSTILE,),
    ((True, HOSTILE),),
    (Table((HOSTILE,), ((HOSTILE, Link(HOSTILE, HOSTILE)),), HOSTILE),),
    (FIGURE,),
    ((HOSTILE, HOSTILE),),
    Calendar(((Day("2026-01-05", "kept", HOSTILE, HOSTILE), *[None] * 6),), HOSTILE),
)
PAGE = Page(HOSTILE, HOSTILE, (SECTION,) * 4, {HOSTILE: HOSTILE})


class Elements(HTMLParser):
    """What a browser makes of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.handlers: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(tag)
        self.handlers += [name for name, _ in attrs if name.startswith("on")]


def test_a_page_makes_no_element_of_what_a_file_says() -> None:
    made, plain = (Elements(html_of(page)) for page in (PAGE, _with_plain_words()))
    assert made.handlers == [] and "img" not in made.names
    assert made.names.count("script") == plain.names.count("script") > 0


def test_figures_are_data_to_the_browser() -> None:
    text = html_of(PAGE)
    (specs,) = (line for line in text.splitlines() if line.startswith("const specs = "))
    assert "</script" not in specs and "<\\/script" in specs
    assert json.loads(specs.removeprefix("const specs = ").removesuffix(";"))[0]["title"] == HOSTILE


def _with_plain_words() -> Page:
    return Page("title", "headline", (Section("title", figures=(Figure("f", (), "x", "y"),)),))


def test_the_page_of_a_run_at_work_makes_no_element_either() -> None:
    manifest = {"started_utc": "2026-01-05T00:00:00Z", "robot": HOSTILE, "verb": HOSTILE}
    plain = {**manifest, "robot": "arm", "verb": "calibrate"}
    made, usual = Elements(live_html(HOSTILE, manifest)), Elements(live_html("address", plain))
    assert made.names == usual.names and made.handlers == []
