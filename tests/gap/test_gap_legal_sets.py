"""Sets of other people's machines and of the wide world's practice cases: none of them is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import gap_sets
import pytest

from frictid_hil.gap.experiment_set import ExperimentSet
from frictid_hil.gap.residuals import recordings
from frictid_hil.gap.sanity import checked
from frictid_hil.simulation.effects import torque_ripple


def _cases(found: Callable[[], Path | None]) -> list[Path]:
    folder = found()
    return [] if folder is None else [path.parent for path in sorted((folder / "cases").glob("*/nominal.yaml"))]


WIDE, REAL = _cases(gap_sets.practice_wide_data), _cases(gap_sets.real_more_data)

pytestmark = pytest.mark.real_data


@pytest.mark.skipif(not WIDE, reason="no practice cases (FRICTID_PRACTICE_WIDE_DATA)")
@pytest.mark.parametrize("case", [WIDE[k] for k in range(0, len(WIDE), 4)], ids=lambda path: path.name)
def test_practice_cases_of_the_wide_world_are_legal(case: Path) -> None:
    read = checked(ExperimentSet.load(case))
    assert read.nominal.tolerances.friction_torque.source == "stated"
    declared = "torque_report_filter" in (case / "nominal.yaml").read_text()
    assert (read.nominal.torque_report_filter is not None) == declared


@pytest.mark.skipif(not REAL, reason="no real sets (FRICTID_REAL_MORE_DATA)")
@pytest.mark.parametrize("name", ["odri_off_a", "so101_rotation_a", "tiago_j1_a", "tx40_j5_a", "dp_acrobot_j1_pushed"])
def test_sets_of_other_peoples_machines_are_legal(name: str) -> None:
    case = next(path for path in REAL if path.name == name)
    read = checked(ExperimentSet.load(case))
    assert read.experiments and not read.at_rest


@pytest.mark.skipif(not REAL, reason="no real sets (FRICTID_REAL_MORE_DATA)")
def test_the_cogging_of_a_bare_motor_is_seen_at_its_own_lines() -> None:
    """72, 18 and 12 periods a turn, by the README of the recordings; 72 is beyond 60 Hz."""
    case = next(path for path in REAL if path.name == "odri_on_a")
    logs = recordings(ExperimentSet.load(case))
    lines = torque_ripple.lines_seen([log.view for log in logs if log.view is not None])
    assert lines[0] == 72.0 and {18.0, 12.0} <= set(lines)
