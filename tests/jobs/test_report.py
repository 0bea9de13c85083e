"""The verb ``report``: pages of runs and robots, and what it says where there is nothing to show."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile
from frictid_hil.config.provenance import Provenance
from frictid_hil.config.robot import load_robot
from frictid_hil.config.write import dump
from frictid_hil.errors import UsageError
from frictid_hil.jobs.report import report
from frictid_hil.profiles.records import Attempt
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.report.calibration import calibration_page


def profile(factor: float, day: int) -> FrictionProfile:
    joint = JointProfile(
        method="aligned",
        velocity_rad_s=(0.5, 1.0),
        torque_nm=(4.0 * factor, 5.0 * factor),
        coulomb_nm=Estimate(value=3.0 * factor),
        temperature_c=20.0 + day,
    )
    return FrictionProfile(
        robot="arm", joints={"0": joint}, provenance=Provenance(created_utc=f"2026-03-{day:02d}T02:00:00Z")
    )


@pytest.fixture
def store(tmp_path: Path) -> ProfileStore:
    store = ProfileStore(tmp_path / "store")
    for day, factor in ((1, 1.0), (2, 1.1)):
        store.promote("arm", store.add(profile(factor, day)), by="somebody", reason=f"night {day}")
    missed = Attempt("2026-03-03T02:00:00Z", "aborted", 3, reason="robot is off", next_step="switch it on")
    store.note_attempt("arm", missed)
    return store


@pytest.mark.slow
def test_the_page_of_a_robot_has_its_history(store: ProfileStore) -> None:
    command = [sys.executable, "-m", "frictid_hil.cli.app", "report", "--robot", "arm", "--store", str(store.root)]
    answer = subprocess.run([*command, "--json"], capture_output=True, text=True, timeout=100, check=True)
    result = json.loads(answer.stdout)
    page = Path(result["report"])
    assert page == store.root.resolve() / "arm" / "index.html"
    text = page.read_text()
    for told in (store.history("arm")[1].id, "somebody", "Night 2.", "Robot is off.", "Switch it on.", "10.0", "22.0"):
        assert told in text, told
    for figure in ("Coulomb friction F_0 over time", "Distance of the curve from the baseline", "Temperature during"):
        assert figure in text


def test_a_robot_is_named_by_its_file_as_well(store: ProfileStore, tmp_path: Path) -> None:
    robot = tmp_path / "of-the-arm.yaml"
    robot.write_text(dump({**load_robot("hp3j").values(), "name": "arm"}))
    assert report(robot=str(robot), store=store.root) == report(robot="arm", store=store.root)


def test_a_robot_nobody_measured_is_told_with_those_that_are_known(store: ProfileStore) -> None:
    with pytest.raises(UsageError, match="no robot named 'leg'; it has arm"):
        report(robot="leg", store=store.root)
    assert not (store.root / "leg").exists()


def test_one_page_at_a_time(store: ProfileStore, tmp_path: Path) -> None:
    for run, robot in ((None, None), (tmp_path, "arm")):
        with pytest.raises(UsageError, match="name one"):
            report(run, robot=robot, store=store.root)
    with pytest.raises(UsageError):
        report(tmp_path)


@pytest.mark.parametrize(("driver", "seed", "word"), [("virtual", 3, "SIMULATED: "), ("cia402", None, "REAL: ")])
def test_a_page_says_at_once_whether_the_robot_was_real(driver: str, seed: int | None, word: str) -> None:
    whole = profile(1.0, 1)
    made = whole.model_copy(update={"provenance": whole.provenance.model_copy(update={"driver": driver, "seed": seed})})
    page = calibration_page(made, {}, outcome="ok")
    assert page.headline.startswith(word)
