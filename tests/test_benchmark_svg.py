"""Charts without scripts: valid XML, round ticks, text that cannot break out."""

from __future__ import annotations

import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
from svg import Chart, Line, svg, ticks  # a benchmark draws with it

_SVG = "{http://www.w3.org/2000/svg}"


@given(st.floats(-1e3, 1e3), st.floats(1e-2, 1e6))  # a span far below its place is lost in the last digits of floats
def test_ticks_lie_inside_and_are_a_few(low: float, span: float) -> None:
    values = ticks(low, low + span)
    assert 3 <= len(values) <= 8
    assert all(low - 1e-6 * span <= value <= low + span * (1 + 1e-6) for value in values)


def test_a_chart_holds_its_lines_and_its_words_are_escaped() -> None:
    x = np.linspace(0.0, 1.0, 9000)
    chart = Chart(
        "A < 5 & more", "x", "y", (Line("a<b", x, x**2, "#000000"), Line("", x[:3], x[:3], "#111111", 0, "dot"))
    )
    root = ElementTree.fromstring(svg([chart, chart], columns=2))
    assert len(root.findall(f"{_SVG}g")) == 2
    (line,) = root.findall(f"{_SVG}g/{_SVG}polyline")[:1]
    corners = [tuple(map(float, corner.split(","))) for corner in line.attrib["points"].split()]
    assert len(corners) <= 3000
    assert corners[0][1] > corners[-1][1], "up is up"
    assert len(root.findall(f"{_SVG}g/{_SVG}circle")) == 6
    assert "A < 5 & more" in [text.text for text in root.iter(f"{_SVG}text")]


def test_what_was_not_obtained_is_a_cross() -> None:
    one = Line("refused", np.array([5.0]), np.array([1.0]), "#000000", 0, "cross")
    root = ElementTree.fromstring(svg([Chart("", "", "", (one,))]))
    assert len([path for path in root.findall(f"{_SVG}g/{_SVG}path") if "l8 8" in path.attrib["d"]]) == 1
    assert not root.findall(f"{_SVG}g/{_SVG}circle")


def test_a_level_line_is_drawn() -> None:
    level = Line("level", np.array([0.0, 1.0]), np.array([2.0, 2.0]), "#000000")
    root = ElementTree.fromstring(svg([Chart("", "", "", (level,))]))
    (drawn,) = root.findall(f"{_SVG}g/{_SVG}polyline")
    heights = {corner.split(",")[1] for corner in drawn.attrib["points"].split()}
    assert len(heights) == 1
    assert 0 < float(heights.pop()) == pytest.approx(113, abs=20)
