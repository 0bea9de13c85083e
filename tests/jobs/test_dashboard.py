"""The dashboard reads what lies there, leads nowhere else, and answers nobody but this computer."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from starlette.testclient import TestClient

from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile
from frictid_hil.config.provenance import Provenance
from frictid_hil.jobs.dashboard import application
from frictid_hil.profiles.records import Attempt
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.recording.mcap import write_samples
from frictid_hil.recording.samples import Samples
from frictid_hil.runs.folder import SCHEMA

ALONE = Estimate.none("not asked for")


def profile() -> FrictionProfile:
    joint = JointProfile(
        method="aligned",
        velocity_rad_s=(0.1, 1.0),
        torque_nm=(1.0, 2.0),
        coulomb_nm=Estimate(value=0.9),
        inertia_kg_m2=ALONE,
    )
    return FrictionProfile(robot="arm", joints={"0": joint}, provenance=Provenance(created_utc="2026-03-01T02:00:00Z"))


def samples(joint: str, travel_rad: float) -> Samples:
    time_s = np.arange(0.0, 20.0, 0.002)
    position = travel_rad * np.sin(time_s)
    return Samples(joint, np.round(time_s * 1e9).astype(np.int64), position, torque_nm=2.0 * position)


def a_run(folder: Path, outcome: str | None, error: str = "") -> Path:
    (folder / "joints").mkdir(parents=True)
    manifest = {"schema": SCHEMA, "verb": "calibrate", "robot": "<arm>", "started_utc": "2026-03-01T02:00:00Z"}
    manifest |= {"outcome": outcome, "error": {"what": error}}  # type: ignore[dict-item]
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    moving = a_run(tmp_path / "runs" / "arm" / "moving", None)
    write_samples(moving / "samples.mcap", [samples("still", 1e-4), samples("elbow", 0.5)])
    (a_run(tmp_path / "runs" / "arm" / "done", "ok") / "report.html").write_text("<p>the report</p>")
    a_run(tmp_path / "runs" / "refused", "refused", "no drive <answers>")
    a_run(tmp_path / "elsewhere", "ok")
    (tmp_path / "runs" / "link").symlink_to(tmp_path / "elsewhere")
    return tmp_path / "runs"


@pytest.fixture
def browser(runs: Path, tmp_path: Path) -> TestClient:
    store = ProfileStore(tmp_path / "store")
    store.promote("arm", store.add(profile()), by="test", reason="first")
    return TestClient(application(runs, store), base_url="http://127.0.0.1:8642")


def test_home_leads_to_robots_and_to_runs_of_this_folder_alone(browser: TestClient) -> None:
    text = browser.get("/").text
    for address in ("/robots/arm", "/runs/arm/moving", "/runs/arm/done", "/runs/refused"):
        assert f'href="{address}"' in text
        assert browser.get(address).status_code == 200
    assert "1 robot, 3 runs; 1 at work or cut off" in text
    assert "/runs/link" not in text and "<arm>" not in text


def test_a_run_at_work_shows_the_joint_that_moves(browser: TestClient, runs: Path) -> None:
    assert "plotly.js" in browser.get("/runs/arm/moving").text and "Plotly" in browser.get("/plotly.js").text
    now = browser.get("/runs/arm/moving/now").json()
    assert not now["ended"] and now["told"] == "Joint elbow, 20 s of run time."
    assert 300 < len(now["time_s"]) <= 700 and now["time_s"][0] == pytest.approx(10.0, abs=0.01)
    assert max(now["position"]) == pytest.approx(np.degrees(0.5), rel=1e-2) and now["position_unit"] == "deg"
    (runs / "arm" / "moving" / "samples.mcap").write_bytes(b"")
    assert browser.get("/runs/arm/moving/now").json()["told"] == "no samples yet"


def test_a_run_that_ended_shows_its_report_or_why_there_is_none(browser: TestClient) -> None:
    assert browser.get("/runs/arm/done").text == "<p>the report</p>"
    assert "no drive &lt;answers&gt;" in browser.get("/runs/refused").text
    assert browser.get("/runs/refused/now").json()["ended"]


@pytest.mark.parametrize(
    "address", ["/runs/../elsewhere", "/runs/%2e%2e/elsewhere", "/runs/link", "/robots/%2e%2e", "/x"]
)
def test_an_address_never_becomes_a_path(browser: TestClient, address: str) -> None:
    assert browser.get(address).status_code == 404


def test_nothing_is_written_and_nobody_else_is_answered(browser: TestClient) -> None:
    assert browser.post("/").status_code == 405
    assert browser.get("/", headers={"host": "attacker.example"}).status_code == 400


def test_a_robot_whose_first_night_was_refused_is_listed(browser: TestClient, tmp_path: Path) -> None:
    ProfileStore(tmp_path / "store").note_attempt("young", Attempt("2026-03-01T02:00:00Z", "refused", 3, reason="off"))
    text = browser.get("/").text
    assert "none yet" in text and browser.get("/robots/young").status_code == 200
