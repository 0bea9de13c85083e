"""Every page of the product with made-up figures, and a browser to look at it with."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import signal
import subprocess
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_hil.config.policy import Policy
from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile, JudgedGate, ProcedureUsed
from frictid_hil.config.provenance import Provenance
from frictid_hil.friction.curve import FrictionCurve
from frictid_hil.gap.diagnosis import Cause, Diagnosis, Figures, NextExperiment, Value, Where
from frictid_hil.gap.experiment_set import Experiment, ExperimentSet, Nominal
from frictid_hil.gap.profiles import missing_torque
from frictid_hil.profiles.judgement import judge
from frictid_hil.profiles.records import Attempt
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.recording.samples import Mark, Samples
from frictid_hil.report.arm import JointRun, arm_page
from frictid_hil.report.calibration import calibration_page
from frictid_hil.report.compensation import ModeRun, compensation_page
from frictid_hil.report.gap import SideBySide, gap_page
from frictid_hil.report.index import index_page
from frictid_hil.report.pages import Page
from frictid_hil.report.recalibration import recalibration_page

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SPEEDS = (0.2, 0.8, 1.4, 2.0)

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (apt install chromium)")


def profile(factor: float, day: int) -> FrictionProfile:
    torque = tuple(factor * (4.0 + 2.0 * v) for v in SPEEDS)
    joint = JointProfile(
        method="aligned",
        velocity_rad_s=SPEEDS,
        torque_nm=torque,
        torque_interval_nm=tuple((t - 0.1, t + 0.1) for t in torque),
        coulomb_nm=Estimate(value=4.0 * factor, low=3.9 * factor, high=4.1 * factor),
        temperature_c=20.0 + day,
        procedure=ProcedureUsed(amplitude_rad=0.35, velocity_rad_s=2.0, cycles=4, ratio=0.8),
        gates=(JudgedGate(name="tracking", passed=True, message="the speeds were reached"),),
    )
    return FrictionProfile(
        robot="arm", joints={"0": joint, "1": joint}, provenance=Provenance(created_utc=f"2026-03-{day:02d}T02:00:00Z")
    )


def recording(joint: str) -> Samples:
    time_ns = np.arange(4000) * 1_000_000
    phase = time_ns * 1e-9 * 2 * np.pi
    return Samples(
        joint,
        time_ns,
        position_rad=0.175 * (1 - np.cos(phase)),
        velocity_rad_s=1.1 * np.sin(phase),
        torque_nm=6 * np.sign(np.sin(phase)),
        position_command_rad=0.175 * (1 - np.cos(phase)) + 1e-4,
        marks=(Mark("cycles", 0, 4_000_000_000),),
    )


def some_history(folder: Path) -> ProfileStore:
    """A robot with five promoted nights."""
    store = ProfileStore(folder / "store")
    for day in range(1, 6):
        store.promote("arm", store.add(profile(1 + 0.03 * day, day)), by="test", reason="night")
    return store


def pages(store: ProfileStore) -> dict[str, Page]:
    nights = [
        Attempt(f"2026-03-{day:02d}T02:00:00Z", "ok", 0, True, "id", drift_limit_percent=10.0, reason="fine")
        for day in range(1, 6)
    ]
    nights.append(Attempt("2026-03-06T02:00:00Z", "ok", 0, profile="id", drifted=("1",)))
    nights.append(Attempt("2026-03-09T02:00:00Z", "refused", 3, reason="no drive answers"))
    new, old = profile(1.3, 6), profile(1.0, 1)
    verdict = judge(Policy(), new, old, old, failed={})
    result = {
        "outcome": "ok", "promoted": False, "reason": verdict.reason, "next_step": verdict.next_step, "run": "runs/x",
        "stored": "id", "drift": verdict.joints, "joints": {name: {"outcome": "ok"} for name in new.joints},
    }  # fmt: skip
    index = index_page(
        "arm",
        store.trends("arm"),
        store.promotions("arm"),
        nights,
        store.active("arm"),
        store.baseline("arm"),
        {"2026-03-06T02:00:00Z": "../runs/six/recalibration.html"},
    )
    return {
        "calibration": calibration_page(
            new, {name: recording(name) for name in new.joints}, outcome="ok", previous=old
        ),
        "recalibration": recalibration_page(result, Policy(), new, old, old, store.trends("arm")),
        "index": index,
        "gap": a_gap_page(),
        "arm": an_arm_page(),
        "compensation by hand": compensated("hand"),
        "compensation by hand without a force sensor": compensated("hand", force_sensor=False),
        "compensation on a path": compensated("track"),
    }


def a_gap_page() -> Page:
    """A joint with a wave over position that its nominal model lacks, and an improved one beside it."""
    time_s = 0.002 * np.arange(8000)
    position = 0.4 * np.sin(1.5 * time_s)
    torque = 2.0 * np.tanh(np.gradient(position, 0.002) / 0.01) + 0.3 * np.cos(40.0 * position)
    curve = FrictionCurve.through(np.array([0.1, 1.0]), np.array([2.0, 2.0001]))
    log = Experiment("slow", False, False, 0, time_s, position, torque_nm=torque)
    profiles = missing_torque(ExperimentSet("joint <2>", Nominal(inertia_kg_m2=1e-6, curve=curve), (log,)))
    assert [p.title for p in profiles][:2] == ["Missing torque over speed", "Missing torque over position"]
    wave = profiles[1].curves[0]
    assert np.corrcoef(wave.y, np.cos(40.0 * wave.x))[0, 1] > 0.95
    gap = Figures(0.2, 0.2, 1e-3)
    found = Diagnosis(
        name="joint <2>",
        verdict="ambiguous",
        causes=(Cause("torque_ripple", 0.5, {"amplitude_nm": Value(0.3, 0.29, 0.31)}, ("gravity_error",), 90.0),),
        where=(Where("position", 0.8, "over the position"), Where("reversal", 0.2, "after reversals")),
        before=gap,
        after=Figures(0.02, 0.02, 1e-4),
        noise_floor=Figures(0.01, None, 1e-4),
        per_log={"slow": {"before": gap, "after": gap}},
        next_experiment=NextExperiment("a slow triangle", 20.0, ("torque_ripple", "gravity_error"), {}),
        reasons={"after": "no controller"},
        summary="joint <2>: 80 % of the gap sits along the position.",
    )
    beside = SideBySide("slow", time_s, torque, torque - 0.3, torque - 0.01, 1e-3 * position, 1e-4 * position)
    return gap_page(found, (beside,), profiles)


def an_arm_page() -> Page:
    """Two joints, one of them with a cause, and how their user's model ran."""
    quiet = Diagnosis("pan", "none", (), (Where("reversal", 1.0, ""),), Figures(0.1), Figures(0.1), Figures(0.1))
    where = (Where("position", 0.8, "over the position"), Where("reversal", 0.2, "after reversals"))
    cause = Cause("torque_ripple", 0.9, {"amplitude_nm": Value(0.3, 0.29, 0.31)})
    lift = Diagnosis("lift <2>", "explained", (cause,), where, Figures(0.9), Figures(0.11), Figures(0.1))
    time_s = 0.01 * np.arange(1000)
    torque = np.sin(time_s)
    runs = [
        JointRun("pan", "moves", "torque [N m]", time_s, torque, torque - 0.1, None),
        JointRun("lift <2>", "moves", "torque [N m]", time_s, torque, torque - 0.9, torque - 0.1),
    ]
    found = {"pan": quiet, "lift <2>": lift}
    return arm_page("arm <1>", "1 of 2 joints are as the model says.", found, {"pan": "pan.html"}, ("Note.",), runs)


def compensated(task: str, *, force_sensor: bool = True) -> Page:
    time_s = np.arange(0.0, 4.0, 0.01)
    wave = 0.2 * np.sin(2 * np.pi * time_s / 4)
    runs = {
        mode: ModeRun(
            mode,
            time_s,
            scale * wave,
            scale * np.gradient(wave, time_s),
            wave,
            5 * wave,
            8 * wave if force_sensor else None,
        )
        for mode, scale in (("nc", 0.7), ("mop", 0.98))
    }
    modes: dict[str, dict[str, Any]] = {
        mode: {
            "velocity_rms_rad_s": 0.2,
            "torque_rms_nm": torque if force_sensor else None,
            "torque_rms_inertia_removed_nm": torque if force_sensor else None,
            "reduction_percent": reduction,
            "reduction_inertia_removed_percent": reduction,
            "tracking_rms_rad": 0.01 * torque,
            "interval_95": (0.009 * torque, 0.011 * torque),
            "reduction_interval_95_percent": None if reduction is None else (reduction - 1.0, reduction + 1.0),
        }
        for mode, torque, reduction in (("nc", 5.0, None), ("mop", 1.0, 80.0))
    }
    return compensation_page("arm", "1", task, runs, modes, facts={"run": "runs/x"}, outcome="ok")


PAGES = ("calibration", "recalibration", "index", "gap", "arm", "compensation by hand", "compensation on a path")


def in_browser(page: Path, profile_folder: Path) -> tuple[str, list[str]]:
    """The page's DOM once its scripts have run, and what it wrote to the console."""
    assert CHROMIUM is not None
    command = [
        CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        f"--user-data-dir={profile_folder}", "--enable-logging=stderr", "--virtual-time-budget=8000", "--dump-dom",
        page.as_uri(),
    ]  # fmt: skip
    shown = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    return shown.stdout, [line for line in shown.stderr.splitlines() if ":CONSOLE" in line]


def with_axe(page: Path) -> Path:
    """The page, telling in an element of its own which rules of axe-core it breaks."""
    axe = files("axe_core_python").joinpath("axe.min.js").read_text()
    report = (
        "axe.run().then(found => { const told = document.createElement('pre'); told.id = 'axe';"
        " told.textContent = JSON.stringify(found.violations.map(v => [v.id, v.impact, v.nodes.length,"
        " v.nodes[0].html.slice(0, 200)])); document.body.append(told); });"
    )
    page.write_text(page.read_text().replace("</body>", f"<script>{axe}</script><script>{report}</script></body>"))
    return page


def serious(dom: str) -> list[list[object]]:
    """Rules broken with serious or critical impact: contrast, names of things, the keyboard's way."""
    (told,) = re.findall(r'<pre id="axe">(.*?)</pre>', dom, flags=re.DOTALL)
    return [broken for broken in json.loads(html.unescape(told)) if broken[1] in ("serious", "critical")]


def picture(address: str, to: Path, width: int, height: int) -> None:
    """A screenshot (PNG) of the top of a page, once its scripts have run."""
    _headless(address, to.parent, f"--window-size={width},{height}", f"--screenshot={to}")


def printed(page: Path, to: Path) -> None:
    """The page as PDF."""
    _headless(page.as_uri(), to.parent, f"--print-to-pdf={to}")


def _headless(address: str, place: Path, *what: str) -> None:
    """A browser that does one thing and ends; one that hangs, as browsers do at times, is begun anew."""
    assert CHROMIUM is not None
    for attempt in range(2):
        command = [
            CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars",
            "--disable-sync", "--disable-background-networking", "--disable-component-update",
            f"--user-data-dir={place / f'browser-{attempt}'}", "--virtual-time-budget=8000", *what, address,
        ]  # fmt: skip
        silent = subprocess.DEVNULL
        with subprocess.Popen(command, stdout=silent, stderr=silent, start_new_session=True) as browser:
            try:
                assert browser.wait(100.0) == 0
                return
            except subprocess.TimeoutExpired:
                os.killpg(browser.pid, signal.SIGKILL)
    raise TimeoutError("the browser hung twice")
