"""A run loses nothing: at every step of its life, whatever happens, what was there before is there afterwards.

The hardware is a script that says what the runner would say, so that every fault can be put at every step.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import FrictidError, HardwareBusy, HardwareError, Interrupted, PlanRefused, UsageError
from frictid_hil.jobs.plans import calibration_plan
from frictid_hil.jobs.watch import Silent
from frictid_hil.plan.plan import Plan
from frictid_hil.protocol.driver import Capabilities, JointIdentity
from frictid_hil.recording.mcap_reader import read_rows
from frictid_hil.recording.samples import Mark
from frictid_hil.runner.events import Configured, JointRun, Marked, PhaseStarted, Preflight
from frictid_hil.runner.ring import FRAME_ROW, SAMPLE_ROW
from frictid_hil.runs import life
from frictid_hil.runs.folder import RunFolder, load_manifest, parts_of
from frictid_hil.runs.keeper import RowKeeper
from frictid_hil.runs.life import Order, Run, State

STEPS = 12
"""Steps of the script below, two joints of them: a fault may come before each."""
MEASURING = 4
"""The first step at which something may have moved."""
KEEPS = {"4": STEPS, "5": STEPS + 1}
"""Further moments of a fault: the finished joint is identified and written."""
ENDS = STEPS + 2
"""The last one: everything has moved, the manifest is about to say how it ended."""
MOMENTS = ENDS + 1


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("hp3j")


@pytest.fixture(scope="module")
def plan(robot: Robot) -> Plan:
    return calibration_plan(robot, robot.to_setup(), {n: robot.procedure(n) for n in ("4", "5")}, {})


class Script:
    """What a driver and the runner do, step by step, with a fault before one of them."""

    def __init__(self, at: int, fault: Callable[[], None]) -> None:
        self._at = at
        self._fault = fault
        self._step = 0

    def reach(self, moment: int) -> None:
        """The fault, where this is its moment."""
        if moment == self._at:
            self._fault()

    def _next(self) -> None:
        self.reach(self._step)
        self._step += 1

    def __call__(
        self, _name: str, setup: Any, plan: Plan, keeper: Any, *, notify: Any, proceed: Any, **_: object
    ) -> int:
        self._next()
        identities = {joint.name: JointIdentity(joint.name, serial=f"S{joint.name}") for joint in setup.joints}
        preflight = Preflight(identities, Capabilities(1000.0, frozenset()), ())
        notify(preflight)
        self._next()
        if not proceed(preflight):
            raise PlanRefused("not confirmed; nothing has moved")
        for session, entry in enumerate(plan.joints):
            self._next()
            notify(PhaseStarted(entry.joint, "configure", 0.0))
            notify(Configured({"map": session}))
            self._next()
            notify(PhaseStarted(entry.joint, "reference", 0.0))
            self._next()
            self._measure(keeper, [joint.name for joint in setup.joints].index(entry.joint), session)
            mark = Mark("cycles", session * 1000, session * 1000 + 500)
            notify(Marked(entry.joint, mark))
            self._next()
            notify(JointRun(entry.joint, session, (mark,), 1000.0, 500, 0, 0, 0.0, 0.5))
            self._next()
        return 0

    def _measure(self, keeper: Any, index: int, session: int) -> None:
        rows = np.zeros(500, SAMPLE_ROW)
        rows["t_ns"], rows["joint"] = session * 1000 + np.arange(500), index
        keeper.samples(rows)
        keeper.frames(np.zeros(5, FRAME_ROW))


def nothing() -> None:
    pass


def ran(order: Order, plan: Plan, script: Script, monkeypatch: pytest.MonkeyPatch) -> FrictidError | None:
    """A run that keeps a word of every joint that it finished; what it came to."""
    monkeypatch.setattr(life, "run_plan", script)
    with Run(order, Silent()) as run:

        def keep(moved: JointRun) -> None:
            script.reach(KEEPS[moved.joint])
            assert run.folder.samples(moved).time_ns.size == 500
            (run.folder.path / "joints").mkdir(exist_ok=True)
            (run.folder.path / "joints" / f"{moved.joint}.json").write_text("{}")

        error = run.move(plan, each=keep)
        script.reach(ENDS)
        run.end(error)
        return error


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refusal() -> None:
    raise PlanRefused("bus load of 104 %")


def absence() -> None:
    raise HardwareError("node 4 is silent")


def signal() -> None:
    raise Interrupted("stopped on request")


def key() -> None:
    raise KeyboardInterrupt


def defect() -> None:
    raise ZeroDivisionError


def kill() -> None:
    os._exit(9)


def full() -> None:
    _fail_writing(errno.ENOSPC)


def read_only() -> None:
    _fail_writing(errno.EROFS)


def fault_outcome(fault: Callable[[], None]) -> str:
    """What the manifest is to say of one of our own errors."""
    with pytest.raises(FrictidError) as told:
        fault()
    return told.value.outcome


_real_fsync = os.fsync


def _fail_writing(number: int) -> None:
    def fails(_: int) -> None:
        raise OSError(number, os.strerror(number))

    setattr(os, "fsync", fails)  # noqa: B010  from now on, until the test is over


@pytest.fixture(autouse=True)
def _write_again() -> Iterator[None]:
    yield
    os.fsync = _real_fsync


FAULTS = [refusal, absence, signal, key, defect, full, read_only, kill]


def meet(fault: Callable[[], None], order: Order, plan: Plan, at: int, monkeypatch: pytest.MonkeyPatch) -> str:
    """How a run with a fault ends: ``raised``, ``killed``, or the outcome that its manifest tells."""
    if fault is kill:
        child = os.fork()
        if child == 0:
            ran(order, plan, Script(at, fault), monkeypatch)
            os._exit(0)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
        return "killed"
    try:
        error = ran(order, plan, Script(at, fault), monkeypatch)
    except (Exception, KeyboardInterrupt):
        return "raised"
    finally:
        os.fsync = _real_fsync
    return "ok" if error is None else error.outcome


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_what_was_in_a_folder_before_is_there_after_every_fault_at_every_step(
    fault: Callable[[], None], robot: Robot, plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for at in range(MOMENTS):
        out = tmp_path / f"{at}" / "mydata"
        (out / "chapters").mkdir(parents=True)
        (out / "thesis.txt").write_text("three years")
        (out / "chapters" / "samples.mcap").write_bytes(b"\x89mine")
        before = snapshot(out)
        order = Order("calibrate", robot, robot.to_setup(), options={"cycles": 3}, out=out)
        ended = meet(fault, order, plan, at, monkeypatch)
        after = snapshot(out)
        assert before.items() <= after.items(), at
        if at < MEASURING and fault is not kill:
            assert ended == "raised" and after == before, f"a refusal leaves nothing, step {at}"
        if at >= MEASURING and fault in (refusal, absence, signal):
            assert load_manifest(out)["outcome"] == (fault_outcome(fault) if at == ENDS else ended) != "ok", at
        if at >= MEASURING and fault in (key, defect):
            assert ended == "raised" and load_manifest(out)["outcome"] in ("interrupted", "aborted"), at
        if at > 6:
            assert {session["joint"] for session in load_manifest(out)["sessions"]} >= {"4"}
            assert "joints/4.json" in after or at == KEEPS["4"]
            if fault not in (kill, full, read_only):
                assert read_rows(out / "samples.mcap")["4"].size == 500, f"the finished joint's samples, step {at}"


@pytest.fixture(scope="module")
def begun(robot: Robot, plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run that was interrupted after its first joint."""
    out = tmp_path_factory.mktemp("begun") / "run"
    order = Order("calibrate", robot, robot.to_setup(), options={"cycles": 3}, out=out)
    with pytest.MonkeyPatch.context() as patch:
        error = ran(order, plan, Script(8, signal), patch)
    assert isinstance(error, Interrupted)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("fault", [*FAULTS, nothing])
def test_a_continued_run_adds_a_part_and_takes_nothing_from_the_others(
    fault: Callable[[], None],
    robot: Robot,
    plan: Plan,
    begun: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    manifest_before = load_manifest(begun)
    for at in range(MOMENTS):
        out = tmp_path / f"{at}"
        out.mkdir()
        for name, data in snapshot(begun).items():
            (out / name).parent.mkdir(exist_ok=True)
            (out / name).write_bytes(data)
        before = snapshot(out)
        order = Order("calibrate", robot, robot.to_setup(), resume=out)
        ended = meet(fault, order, plan, at, monkeypatch)
        after, manifest = snapshot(out), load_manifest(out)
        kept = {name: data for name, data in before.items() if name not in ("manifest.json", "joints/4.json")}
        assert kept.items() <= after.items() and after.keys() >= before.keys(), at
        assert manifest["options"] == {"cycles": 3}
        sessions = manifest_before["sessions"]
        assert manifest["sessions"][: len(sessions)] == sessions, at
        if at < MEASURING and fault not in (kill, nothing):
            assert ended == "raised" and after == before, f"a refusal changes nothing, step {at}"
        if fault is nothing:
            assert [path.name for path, _ in parts_of(out)] == [
                "bus.blf",
                "samples.mcap",
                "bus-2.blf",
                "samples-2.mcap",
            ]
            assert [session["part"] for session in manifest["sessions"]] == [1, 2, 2]
            assert manifest["frame_maps"].keys() == {"bus.blf", "bus-2.blf"}
            break


def test_a_part_is_made_even_where_the_first_one_finished_no_joint(
    robot: Robot, plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    order = Order("calibrate", robot, robot.to_setup(), out=out)
    assert isinstance(ran(order, plan, Script(6, signal), monkeypatch), Interrupted)
    measured = (out / "samples.mcap").read_bytes()
    ran(Order("calibrate", robot, robot.to_setup(), resume=out), plan, Script(99, nothing), monkeypatch)
    assert (out / "samples.mcap").read_bytes() == measured and (out / "samples-2.mcap").exists()


@pytest.mark.parametrize(
    "name", ["manifest.json", "profile.yaml", "samples.mcap", "bus-2.blf", "report.html", "joints"]
)
def test_a_folder_that_holds_what_a_run_writes_is_refused(robot: Robot, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(UsageError, match=r"run already|would overwrite"):
        RunFolder.create(robot, "calibrate", {}, tmp_path)
    assert snapshot(tmp_path) == {name: b"mine"}


@pytest.mark.parametrize("place", ["/proc/nowhere/run", "file/run"])
def test_a_folder_that_takes_no_file_is_told_before_the_bus_is_reached(
    robot: Robot, plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    (tmp_path / "file").write_text("not a folder")
    order = Order("calibrate", robot, robot.to_setup(), out=tmp_path / place)
    with pytest.raises(FrictidError, match="cannot be written to") as told:
        ran(order, plan, Script(0, lambda: pytest.fail("the bus was reached")), monkeypatch)
    assert place in told.value.where and snapshot(tmp_path) == {"file": b"not a folder"}


def test_one_process_at_a_time_is_at_work_on_a_run(robot: Robot, begun: Path, tmp_path: Path) -> None:
    first = RunFolder.resume(begun, robot)
    with pytest.raises(HardwareBusy, match="another process is at work"):
        RunFolder.resume(begun, robot)
    first.withdraw()
    RunFolder.resume(begun, robot).withdraw()


def test_both_files_are_closed_where_one_cannot_be_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keeper = RowKeeper(tmp_path / "samples.mcap", tmp_path / "bus.blf", ["0"], {}, lambda _: None)
    keeper.frames(np.zeros(7, FRAME_ROW))
    monkeypatch.setattr(keeper._samples, "flush", refusal)
    with pytest.raises(PlanRefused):
        keeper.close()
    assert keeper._samples._file.closed and keeper._frames._file.closed


def test_what_a_run_does_belongs_to_its_state(
    robot: Robot, plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(life, "run_plan", Script(99, nothing))
    run = Run(Order("calibrate", robot, robot.to_setup(), out=tmp_path / "run"), Silent())
    for too_early in (run.end, lambda: run.folder):
        with pytest.raises(RuntimeError, match="run of calibrate is planned, this needs"):
            too_early()
    run.move(plan, each=lambda _: None)
    assert run.state is State.MEASURING
    run.end()
    for too_late in (run.end, lambda: run.move(plan, each=lambda _: None)):
        with pytest.raises(RuntimeError, match="run of calibrate is ended, this needs"):
            too_late()


def test_an_interrupted_run_names_the_command_that_goes_on_with_it(
    robot: Robot, plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "a run"
    order = Order("calibrate", robot, robot.to_setup(), out=out, continued_by="frictid-hil calibrate --resume")
    error = ran(order, plan, Script(8, signal), monkeypatch)
    assert error is not None and error.next_step == f"continue with `frictid-hil calibrate --resume '{out}'`"
    assert json.loads((out / "manifest.json").read_text())["error"]["next_step"] == error.next_step


def test_ctrl_c_after_the_motion_is_told_as_such_and_ends_the_run(
    robot: Robot, plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(life, "run_plan", Script(99, nothing))
    order = Order("calibrate", robot, robot.to_setup(), out=tmp_path / "run")
    with pytest.raises(Interrupted, match="after the motion had ended"), Run(order, Silent()) as run:
        run.move(plan, each=lambda _: None)
        raise KeyboardInterrupt
    assert load_manifest(tmp_path / "run")["outcome"] == "interrupted"
