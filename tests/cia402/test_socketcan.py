"""A real SocketCAN link, ``vcan0`` of a kernel that runs as a process; host and drives are processes there."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import pytest

from frictid_drivers.virtual.rack import Rack
from frictid_hil.config.robot import load_robot

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
sys.path.insert(0, str(FOLDER))
kernel_with_can = importlib.import_module("kernel_with_can")
guest = importlib.import_module("socketcan_guest")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(kernel_with_can.missing()), reason=f"no SocketCAN here: {kernel_with_can.missing()}"),
]


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Everything that was tried there, in one go: a kernel takes seconds to start, and the packages as long to load."""
    folder = tmp_path_factory.mktemp("vcan")
    rack = Rack()
    rack.install(load_robot(guest.robot_file(folder)).to_setup())
    rack.warm_up()  # compiled here, where it is quick
    kernel_with_can.run(FOLDER / "socketcan_guest.py", folder, timeout_s=570.0)
    return json.loads((folder / "found.json").read_text())


def test_drives_are_reached_and_read(found):
    assert found["check"]["ok"], found["check"]
    assert "frictid virtual servo" in found["check"]["joints"]["0"]["product"]


def test_friction_is_found_though_error_frames_come_that_mean_nothing(found):
    run = found["calibrated"]
    assert run["outcome"] in ("ok", "gate_failed"), run
    joint = run["joints"]["0"]
    # A busy computer stalls such a kernel; then the run says so, whatever else the stall has bent.
    assert not joint["remarks"] or any("late" in remark for remark in joint["remarks"]), joint["remarks"]
    assert joint["coulomb_nm"] == pytest.approx(guest.COULOMB_NM, rel=0.08)


def test_bus_off_ends_the_run_by_name(found):
    run = found["bus off"]
    assert (run["exit_code"], run["error"]["what"]) == (3, "the bus is off (bus-off)")


def test_a_link_that_goes_down_in_motion_ends_the_run_and_says_what_may_have_power(found):
    run = found["link down"]
    assert run["exit_code"] == 3 and "Network is down" in run["error"]["what"]
    assert "may still have power" in run["error"]["next_step"]
    assert found["check while down"]["exit_code"] == 3


def test_drives_come_back_when_the_link_does(found):
    assert found["reset"]["outcome"] == "ok", found["reset"]
    assert found["check after"]["ok"], found["check after"]


def test_a_classical_link_is_refused_for_can_fd_and_the_command_told(found):
    assert found["fd"]["ok"], found["fd"]
    refused = found["fd on a classical link"]
    assert refused["exit_code"] == 3 and "ip link set vcan0 up type can" in refused["next"]


def test_behind_another_authors_canopen_on_that_link(tmp_path):
    pytest.importorskip("durand", reason="durand (of the extra dev) is not installed")
    kernel_with_can.run(FOLDER / "socketcan_strangers.py", tmp_path, timeout_s=570.0)
    found = json.loads((tmp_path / "found.json").read_text())
    assert all(one["good"] for one in found.values()), found


def test_a_script_that_fails_there_fails_here(tmp_path):
    script = tmp_path / "fails.py"
    script.write_text("import sys\nsys.exit('as it should')\n")
    with pytest.raises(RuntimeError, match="as it should"):
        kernel_with_can.run(script, tmp_path, timeout_s=60.0)


def test_of_that_kernel_nothing_is_left(found):
    alive = subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout
    assert not [line for line in alive.splitlines() if line.startswith(kernel_with_can.KERNEL) and "vcan" in line]
