"""What `docs/reference/security.md` says is defended, where no other test already holds it."""

import importlib
import json
import os
import re
import socket
import stat
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from frictid_drivers.virtual import channel
from frictid_hil.cli.output import Output, folding
from frictid_hil.errors import FrictidError, HardwareError, UsageError
from frictid_hil.files import part_of_path, write_whole
from frictid_hil.jobs import dashboard
from frictid_hil.jobs.calibrate import CalibrateOptions, calibrate
from frictid_hil.jobs.live import live
from frictid_hil.jobs.schedule import ScheduleOptions, schedule
from frictid_hil.jobs.watch import Silent
from frictid_hil.profiles.store import ProfileStore
from frictid_hil.protocol.can_bus import BusLock
from frictid_hil.recording.growing_file import GrowingFile

PAGE = Path(__file__).resolve().parents[1] / "docs" / "reference" / "security.md"
PACKAGES = [Path(str(importlib.import_module(name).__file__)).parent for name in ("frictid_hil", "frictid_drivers")]


def test_every_test_that_the_page_names_is_there():
    told = re.findall(r"`([\w/]+\.py)::(\w+)`", PAGE.read_text())
    assert len(told) > 8
    for file, name in told:
        assert f"def {name}(" in (Path(__file__).parent / file).read_text(), (file, name)


def test_no_file_of_ours_starts_a_shell_or_loads_what_could_run():
    words = (
        r"shell=True", r"os\.system", r"os\.popen", r"pickle\.loads?\(", r"yaml\.(unsafe_|full_)load",
        r"allow_pickle=True", r"\beval\(",
    )  # fmt: skip
    unsafe = re.compile("|".join(words))
    found = [
        f"{path.name}:{number}"
        for package in PACKAGES
        for path in package.rglob("*.py")
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if unsafe.search(line)
    ]
    assert not found


def test_the_lock_of_a_bus_follows_no_link(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    lock, target = BusLock("socketcan:can0"), tmp_path / "of somebody"
    lock.path.symlink_to(target)
    with pytest.raises(HardwareError, match="cannot lock the bus"):
        lock.acquire()
    assert not target.exists()
    target.write_text("kept")
    with pytest.raises(HardwareError):
        lock.acquire()
    assert target.read_text() == "kept"


def test_everybody_may_take_the_lock_of_a_bus(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    before = os.umask(0o077)
    try:
        lock = BusLock("socketcan:can1")
        lock.acquire()
        lock.release()
    finally:
        os.umask(before)
    assert stat.S_IMODE(lock.path.stat().st_mode) == 0o666


@pytest.fixture
def a_folder_for_all(tmp_path, monkeypatch):
    for name in ("FRICTID_RUNTIME_DIR", "XDG_RUNTIME_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    return tmp_path


def test_sockets_live_in_a_folder_that_is_ours_alone(a_folder_for_all):
    assert stat.S_IMODE(channel.runtime_folder().stat().st_mode) == 0o700


def test_a_folder_that_somebody_else_put_there_is_refused(a_folder_for_all, monkeypatch):
    ours = os.getuid()
    (a_folder_for_all / f"frictid-hil-{ours + 1}").mkdir()
    monkeypatch.setattr("os.getuid", lambda: ours + 1)
    with pytest.raises(HardwareError, match="not a folder of yours"):
        channel.runtime_folder()


def test_a_recording_is_not_written_through_a_link(tmp_path):
    (tmp_path / "samples.mcap").symlink_to(tmp_path / "of somebody")
    with pytest.raises(FrictidError):
        GrowingFile(tmp_path / "samples.mcap")
    assert not (tmp_path / "of somebody").exists()


def test_a_file_replaces_a_link_and_leaves_what_it_pointed_to(tmp_path):
    other, path = tmp_path / "of somebody", tmp_path / "profile.yaml"
    other.write_text("kept")
    path.symlink_to(other)
    write_whole(path, "new")
    assert other.read_text() == "kept" and path.read_text() == "new" and not path.is_symlink()


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o027, 0o640)])
def test_files_are_as_open_as_the_account_wants_them(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        write_whole(tmp_path / "a.yaml", "text")
        GrowingFile(tmp_path / "a.mcap").close()
    finally:
        os.umask(before)
    assert {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("a.yaml", "a.mcap")} == {mode}


def test_a_run_folder_with_links_in_it_is_refused(tmp_path):
    out = tmp_path / "run"
    out.mkdir()
    (out / "samples.mcap").symlink_to(tmp_path / "of somebody")
    with pytest.raises(UsageError, match="which the run would overwrite"):
        calibrate(CalibrateOptions("hp3j", joints=("5",), out=out), Silent())
    assert not (tmp_path / "of somebody").exists()


@pytest.mark.parametrize("name", ["../x", "left/elbow", ".hidden", "", "a\0b", "-" * 65, "a\nb"])
def test_no_name_leads_out_of_a_folder(name):
    with pytest.raises(UsageError):
        part_of_path(name)


def test_what_a_file_says_is_text_on_the_terminal(capsys):
    hostile = "run[/x] [red]a[/] :bug:"
    output, table = Output(), folding(hostile, title=hostile)
    table.add_row(hostile)

    def job():
        raise UsageError(hostile, where=hostile, cause=hostile, next_step=hostile)

    for console in (output.out, output.err):
        console.print(hostile)
        console.print(table)
    with pytest.raises(typer.Exit):
        output.run("check", job)
    shown = capsys.readouterr()
    assert (shown.out.count(hostile), shown.err.count(hostile)) == (4, 8)


@pytest.mark.slow
def test_what_is_notified_comes_on_standard_input_and_through_no_shell(tmp_path):
    heard, planted = tmp_path / "heard", tmp_path / "planted"
    script = f"import sys; open({str(heard)!r}, 'w').write(sys.stdin.read() + repr(sys.argv[1:]))"
    command = f'{sys.executable} -c "{script}" $(touch {planted}) ; touch {planted}'
    asked = ["recalibrate", "--robot", "$(touch planted).yaml", "--json", "--notify", command]
    subprocess.run(
        [sys.executable, "-m", "frictid_hil.cli.app", *asked], capture_output=True, cwd=tmp_path, check=False
    )
    told, arguments = heard.read_text().rsplit("\n", 1)
    assert json.loads(told)["outcome"] == "refused" and "$(touch planted).yaml" in told
    assert arguments.startswith("['$(touch'") and not list(tmp_path.glob("**/planted"))


def test_the_pages_listen_on_this_computer_alone(tmp_path, monkeypatch):
    bound = []

    def bind(self, address):
        bound.append(address)
        raise OSError(98, "far enough")

    monkeypatch.setattr("socket.socket.bind", bind)
    with pytest.raises(FrictidError):
        dashboard.serve(tmp_path, ProfileStore(tmp_path), 8766, lambda address: None)
    assert bound == [("127.0.0.1", 8766)]


def test_the_stream_listens_on_this_computer_alone_and_takes_no_commands():
    client = pytest.importorskip("websockets.sync.client")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    viewer = f"ws://127.0.0.1:{port}"
    with live(Silent(), f"127.0.0.1:{port}"), client.connect(viewer, subprotocols=["foxglove.sdk.v1"]) as connected:
        told = json.loads(connected.recv(timeout=10))
    assert told["op"] == "serverInfo"
    assert not {"clientPublish", "parameters", "services"} & set(told["capabilities"])


def test_the_nightly_service_has_few_rights(tmp_path):
    service = Path(schedule(ScheduleOptions("hp3j", "daily", system=True, out=tmp_path))["service"]).read_text()
    wanted = (
        "NoNewPrivileges=yes ProtectSystem=strict ProtectHome=read-only RestrictSUIDSGID=yes RestrictNamespaces=yes "
        "DevicePolicy=closed SystemCallFilter=@system-service CapabilityBoundingSet=CAP_SYS_NICE UMask=0027 "
        "LockPersonality=yes ProtectKernelModules=yes"
    )
    assert set(wanted.split()) <= set(service.splitlines())
