"""One unit of every drive family, with friction and noise of its own; three of each are a benchmark."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
drive_families = importlib.import_module("drive_families")


@pytest.mark.slow
@pytest.mark.parametrize(("number", "family"), enumerate(drive_families.FAMILIES))
def test_a_unit_is_found_and_its_interval_covers_it(number, family, tmp_path):
    found = drive_families.found(tmp_path, family, drive_families.UNITS[number % len(drive_families.UNITS)])
    assert found.outcome == "ok"
    assert abs(found.off_percent) <= drive_families.LIMIT_PERCENT
    assert found.covered and found.curve_covered >= 0.8
