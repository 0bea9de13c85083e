"""Every page in a real browser: no console errors, and every figure with its axes, units and data."""

from __future__ import annotations

import html
import json
import os
import re
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
import uvicorn
from PIL import Image
from shown import (
    PAGES,
    in_browser,
    needs_browser,
    pages,
    picture,
    printed,
    profile,
    recording,
    serious,
    some_history,
    with_axe,
)

from frictid_hil.jobs.dashboard import application
from frictid_hil.profiles.records import Attempt
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.recording.mcap import write_samples
from frictid_hil.report.calendar import calendar
from frictid_hil.report.calibration import calibration_page
from frictid_hil.report.figures import line
from frictid_hil.report.index import index_page
from frictid_hil.report.pages import Page, write_page
from frictid_hil.runs.folder import SCHEMA


@pytest.fixture
def history(tmp_path: Path) -> ProfileStore:
    return some_history(tmp_path)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Page]:
    return pages(some_history(tmp_path_factory.mktemp("history")))


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("name", [*PAGES, "compensation by hand without a force sensor"])
def test_page_draws_without_errors(name: str, made: dict[str, Page], tmp_path: Path) -> None:
    page = made[name]
    figures = [figure for section in page.sections for figure in section.figures]
    assert figures
    dom, console = in_browser(with_axe(write_page(page, tmp_path / f"{name}.html")), tmp_path / "browser")
    assert console == []
    assert serious(dom) == []
    drawn = re.split(r'id="figure-\d+"', dom)[1:]
    assert len(drawn) == len(figures)
    for figure, svg in zip(figures, drawn, strict=True):
        for kind, title in (("xtitle", figure.x_title), ("ytitle", figure.y_title)):
            (shown,) = re.findall(rf'class="{kind}"[^>]*>(.*?)</text>', svg)
            assert html.unescape(re.sub(r"<[^>]+>", "", shown)) == title
            lying = figure.traces[0].get("orientation") == "h"
            of_names = kind == ("ytitle" if lying else "xtitle") and figure.traces[0]["type"] == "bar"
            assert of_names or re.search(r"\[.+\]$|\[.+\] *", title), "an axis without its unit"
        assert figure.traces and all(len(trace["x"]) == len(trace["y"]) > 0 for trace in figure.traces)
        assert all(any(y is not None for y in trace["y"]) for trace in figure.traces), "a trace without data"
        assert len(re.findall(r'class="[^"]*(?:js-line|js-fill|point)"', svg)) >= len(figure.traces)


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize("name", ["index", "calibration", "recalibration", "gap"])
def test_the_contrast_holds_in_the_dark_too(name: str, made: dict[str, Page], tmp_path: Path) -> None:
    path = write_page(made[name], tmp_path / "page.html")
    path.write_text(path.read_text().replace("screen and (prefers-color-scheme: dark)", "screen"))
    dom, _ = in_browser(with_axe(path), tmp_path / "browser")
    assert serious(dom) == []


def test_the_calendar_tells_every_night_and_leads_to_its_page(made: dict[str, Page], tmp_path: Path) -> None:
    text = write_page(made["index"], tmp_path / "index.html").read_text()
    # The first of March 2026 is a Sunday: it stands alone in the first of three weeks.
    assert re.findall(r'<th scope="row">([^<]*)</th>', text) == ["2026-03-01", "2026-03-02", "2026-03-09"]
    days = re.findall(r'class="day (\w*)"[^>]*aria-label="([^"]*)"', text)
    assert [state for state, _ in days] == ["promoted"] * 5 + ["drifted", "", "", "failed"]
    assert days[5][1] == "2026-03-06: drifted (joint 1)" and days[6][1].endswith("no recalibration")
    assert text.count('href="../runs/six/recalibration.html"') == 2, "in the calendar and in the table"


def test_a_long_history_shows_its_newest_year() -> None:
    nights = [Attempt(f"{year}-06-15T02:00:00Z", "ok", 0, True) for year in (2019, 2025, 2026)]
    shown = calendar(nights, {})
    days = [day for week in shown.weeks for day in week if day is not None and day.state]
    assert [day.date for day in days] == ["2025-06-15", "2026-06-15"] or [day.date for day in days] == ["2026-06-15"]
    assert len(shown.weeks) == 53 and all(len(week) == 7 for week in shown.weeks)


@pytest.mark.slow
@needs_browser
def test_a_broken_page_would_be_noticed(made: dict[str, Page], tmp_path: Path) -> None:
    path = write_page(made["index"], tmp_path / "index.html")
    path.write_text(path.read_text().replace("\ndraw();\n", "\ndraw();\nundefinedFunction();\n"))
    _, console = in_browser(path, tmp_path / "browser")
    assert any("undefinedFunction" in line for line in console)


def test_pages_are_whole_in_themselves(made: dict[str, Page], tmp_path: Path) -> None:
    for name, page in made.items():
        text = write_page(page, tmp_path / f"{name}.html").read_text()
        assert not re.search(r'<(?:script|link|img)[^>]+(?:src|href)="(?!data:)', text), "something from elsewhere"
        assert "prefers-color-scheme: dark" in text and "@media print" in text


def test_a_page_is_small_and_a_thinned_line_keeps_its_peaks(made: dict[str, Page], tmp_path: Path) -> None:
    assert write_page(made["calibration"], tmp_path / "page.html").stat().st_size < 1_500_000
    y = np.zeros(100_000)
    y[54_321] = 7.0
    drawn = line("spike", np.arange(y.size, dtype=float), y, "#000000")
    assert len(drawn["x"]) <= 700 and 7.0 in drawn["y"] and drawn["x"] == sorted(drawn["x"])


def six_joints(folder: Path) -> Path:
    """The page of a run of six joints, with their recordings."""
    one = profile(1.3, 6)
    new = one.model_copy(update={"joints": dict.fromkeys("012345", one.joints["0"])})
    page = calibration_page(new, {name: recording(name) for name in new.joints}, outcome="ok", previous=profile(1.0, 1))
    return write_page(page, folder / "six.html")


def test_a_page_of_six_joints_is_small(tmp_path: Path) -> None:
    assert six_joints(tmp_path).stat().st_size < 1_500_000


@pytest.mark.slow
@needs_browser
def test_its_pdf_is_small(tmp_path: Path) -> None:
    printed(six_joints(tmp_path), tmp_path / "six.pdf")
    assert 100_000 < (tmp_path / "six.pdf").stat().st_size < 3_000_000


def test_all_joints_are_shown_first_with_the_verdict_of_their_gates(made: dict[str, Page]) -> None:
    (overview,) = made["calibration"].sections[0].figures
    assert [title.rpartition("</span> ")[2] for title in overview.panels] == ["joint 0", "joint 1"]
    assert all("\u2713" in title for title in overview.panels)
    kinds = {(trace["name"], trace["line"].get("dash")) for trace in overview.traces}
    assert {("identified curve", "solid"), ("extrapolated", "dot"), ("active before", "dash")} <= kinds
    assert {trace.get("xaxis", "x") for trace in overview.spec()["data"]} == {"x", "x2"}


def test_the_loops_tell_apart_what_lies_in_the_windows(made: dict[str, Page]) -> None:
    page = made["calibration"]
    (loops,) = [
        one for section in page.sections for one in section.figures if one.title == "Joint 0: torque over velocity"
    ]
    outside, inside, _ = loops.traces
    top = np.degrees(2.0)
    assert inside["name"] == "inside the windows" and len(outside["x"]) > 200 and len(inside["x"]) > 200
    # Four cycles of V = 2 rad/s and c = 0.8: the windows of the slowest begin at 0.8 / 4 of V.
    assert 0.2 * top <= min(abs(v) for v in inside["x"]) < 0.21 * top
    assert max(abs(v) for v in outside["x"]) < 0.8 * top
    done = page.sections[0].words[0]
    assert "4 sinusoidal cycles of 20.05 deg peak to peak" in done and "rise to 114.6 deg/s" in done


def test_the_limit_of_the_policy_is_drawn_beside_the_distance(made: dict[str, Page]) -> None:
    figures = [one for section in made["recalibration"].sections for one in section.figures]
    (distance,) = [one for one in figures if one.title.startswith("Distance")]
    assert [trace["y"] for trace in distance.traces if trace["name"] == "limit of the policy"] == [[10.0, 10.0]]


def test_words_between_backquotes_are_code_and_nothing_else_is_markup(tmp_path: Path) -> None:
    page = Page("t", "type `frictid-hil <x>` & look", [], {})
    text = write_page(page, tmp_path / "t.html").read_text()
    assert "type <code>frictid-hil &lt;x&gt;</code> &amp; look" in text


def test_an_index_page_of_nothing_says_so() -> None:
    page = index_page("arm", {}, [], [], None, None)
    assert "No profile was promoted" in page.headline
    assert replace(page, title="x").title == "x"


# -- the pictures of the docs ----------------------------------------------------------------------------------------

PICTURES = Path(__file__).parents[2] / "docs" / "images" / "pages"
REWRITE = "FRICTID_WRITE_PICTURES"
"""Set to 1 it has the tests replace the pictures of the docs, which else they compare with."""
DESKTOP, PHONE = (1000, 900), (400, 900)
LIKE = 0.06
"""Mean difference of two pictures, of the whole range, that other fonts and another browser may make."""


def compare(shot: Path, name: str) -> None:
    """The picture in the docs is that of the page; it is small."""
    kept = PICTURES / f"{name}.webp"
    taken = Image.open(shot).convert("RGB")
    if os.environ.get(REWRITE):
        kept.parent.mkdir(exist_ok=True)
        taken.save(kept, quality=60, method=6)
    assert kept.stat().st_size < 80_000
    shown = Image.open(kept).convert("RGB")
    assert shown.size == taken.size
    coarse = [np.asarray(image.resize((50, 45)), dtype=float) / 255 for image in (taken, shown)]
    assert np.std(coarse[0]) > 0.02, "an empty page"
    assert np.mean(np.abs(coarse[0] - coarse[1])) < LIKE, f"the page has changed: {REWRITE}=1 takes its picture anew"


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize(
    ("name", "size"), [*((name, DESKTOP) for name in PAGES), ("calibration", PHONE), ("index", PHONE)]
)
def test_the_docs_show_the_page_as_it_is(
    name: str, size: tuple[int, int], made: dict[str, Page], tmp_path: Path
) -> None:
    page = write_page(made[name], tmp_path / "page.html")
    width, height = size
    # The window of a browser is never narrower than 500 px; a frame is.
    frame = tmp_path / "frame.html"
    style = f"position: fixed; inset: 0; border: 0; width: {width}px; height: {height}px"
    frame.write_text(f'<iframe src="{page.name}" style="{style}"></iframe>')
    picture(frame.as_uri(), tmp_path / "shot.png", max(width, 500), height)
    Image.open(tmp_path / "shot.png").crop((0, 0, width, height)).save(tmp_path / "shot.png")
    compare(tmp_path / "shot.png", name.replace(" ", "-") + ("-phone" if size == PHONE else ""))


@pytest.fixture
def dashboard(history: ProfileStore, tmp_path: Path) -> Iterator[str]:
    """The address of a dashboard with a run that is at work."""
    folder = tmp_path / "runs" / "arm" / "20260309T020000Z-calibrate"
    (folder / "joints").mkdir(parents=True)
    manifest = {"schema": SCHEMA, "verb": "calibrate", "robot": "arm", "started_utc": "2026-03-09T02:00:00Z"}
    (folder / "manifest.json").write_text(json.dumps(manifest | {"outcome": None, "error": {"what": ""}}))
    write_samples(folder / "samples.mcap", [recording("0")])
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = uvicorn.Server(
        uvicorn.Config(application(tmp_path / "runs", history), host="127.0.0.1", port=port, log_level="error")
    )
    serving = threading.Thread(target=server.run, daemon=True)
    serving.start()
    while not server.started:
        time.sleep(0.02)
    yield f"http://127.0.0.1:{port}"
    server.should_exit = True
    serving.join(10.0)


@pytest.mark.slow
@needs_browser
@pytest.mark.parametrize(("name", "path"), [("dashboard", "/"), ("live", "/runs/arm/20260309T020000Z-calibrate")])
def test_the_docs_show_the_dashboard_as_it_is(name: str, path: str, dashboard: str, tmp_path: Path) -> None:
    picture(dashboard + path, tmp_path / "shot.png", *DESKTOP)
    compare(tmp_path / "shot.png", name)
    with urlopen(dashboard + path) as answer:
        text = answer.read().decode().replace("<head>", f'<head><base href="{dashboard}">')
    (tmp_path / "page.html").write_text(text)
    dom, _ = in_browser(with_axe(tmp_path / "page.html"), tmp_path / "browser")
    assert serious(dom) == []


def test_every_picture_of_a_page_is_shown_in_the_docs() -> None:
    guide = (PICTURES.parents[1] / "guides" / "reports.md").read_text(encoding="utf-8")
    for kept in PICTURES.glob("*.webp"):
        assert f"../images/pages/{kept.name}" in guide
