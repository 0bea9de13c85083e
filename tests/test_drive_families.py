"""One unit of every drive family, with friction and noise of its own; three of each are a benchmark."""

from __future__ import annotations

import importlib
import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
HERE = Path(__file__).parent
drive_families = importlib.import_module("drive_families")


@pytest.mark.slow
@pytest.mark.parametrize(("number", "family"), enumerate(drive_families.FAMILIES))
def test_a_unit_is_found_and_its_interval_covers_it(number, family, tmp_path):
    found = drive_families.found(tmp_path, family, drive_families.UNITS[number % len(drive_families.UNITS)])
    assert found.outcome == "ok"
    assert abs(found.off_percent) <= drive_families.LIMIT_PERCENT
    assert found.covered and found.curve_covered >= 0.8


def test_every_test_that_the_page_of_evidence_names_is_there():
    page = (HERE.parent / "docs" / "evidence" / "drives.md").read_text()
    rows = [line for line in page.splitlines() if line.startswith("| ") and "::test_" in line]
    assert len(rows) >= 30
    for row in rows:
        text = ""
        for file, test in re.findall(r"`([\w/]*\.?p?y?)::(\w+)`", row):
            text = (HERE / file).read_text() if file else text
            assert f"def {test}(" in text, (file, test)
