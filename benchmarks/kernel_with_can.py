"""A Linux kernel of its own, with SocketCAN, as an ordinary process: for computers whose kernel has no CAN.

User-mode Linux runs Debian's kernel 6.1 in user space, the computer's own files in front of it, read-only but for one
folder. It needs no rights and no emulated processor; it has one processor and its timers are coarse, so what it shows
of timing means nothing, and rates stay at 50 Hz. Debian's packages `user-mode-linux` and `busybox`.

    python benchmarks/kernel_with_can.py SCRIPT FOLDER
"""

from __future__ import annotations

import functools
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from platformdirs import user_cache_path

KERNEL = "linux.uml"
_MODULES = Path("/usr/lib/uml/modules")
_NEEDED = (
    "drivers/net/can/dev/can-dev", "net/can/can", "net/can/can-raw", "net/can/can-bcm", "drivers/net/can/vcan",
)  # fmt: skip
_PASSED_ON = ("PATH", "HOME", "LANG")

_LARGE_STATE = "amx_tile"
_NO_PROCESS = (
    "the kernel of user-mode-linux runs no process on this processor: its floating-point state (AMX) is too large"
)
_FIRST = """#!{busybox} sh
{busybox} mount -t hostfs -o {folder} none {folder}
echo 0 > {folder}/ended
{busybox} poweroff -f
"""
_INIT = """#!{busybox} sh
b={busybox}
$b mount -t proc proc /proc; $b mount -t sysfs sys /sys
$b mkdir -p /dev/shm; $b mount -t tmpfs shm /dev/shm
for module in {modules}; do $b insmod $module; done
$b ip link set lo up; $b ip link add vcan0 type vcan; $b ip link set vcan0 up
$b mount -t hostfs -o {folder} none {folder}
{settings} {python} {script} {folder} > {folder}/said 2>&1 < /dev/null
echo $? > {folder}/ended
$b poweroff -f
"""


@functools.cache
def missing() -> str:
    """What this computer lacks for it; "" for nothing."""
    lacking = [
        package for program, package in ((KERNEL, "user-mode-linux"), ("busybox", "busybox")) if not _at(program)
    ]
    if lacking:
        return f"not installed: Debian's {' and '.join(lacking)}"
    return "" if _LARGE_STATE not in Path("/proc/cpuinfo").read_text() or _starts() else _NO_PROCESS


def _starts() -> bool:
    """Whether a process runs in that kernel: its first one writes a file."""
    with tempfile.TemporaryDirectory(prefix="frictid-kernel-") as name:
        folder = Path(name)
        init = folder / "init"
        init.write_text(_FIRST.format(busybox=_at("busybox"), folder=folder))
        init.chmod(0o755)
        _boot(init, folder, timeout_s=60.0)
        return (folder / "ended").exists()


def run(script: Path, folder: Path, *, timeout_s: float) -> str:
    """Run a Python script beside a link ``vcan0``; returns what it printed.

    Args:
        script: given the folder as its only argument; runs as root of that kernel, with this process's packages.
        folder: the only place that it can write to, besides ``/dev/shm``.
        timeout_s: longest duration.

    Raises:
        RuntimeError: the kernel did not start, or the script failed; with what was printed.
        subprocess.TimeoutExpired: it took longer.
    """
    release = next(_MODULES.iterdir())
    # What is compiled already need not be compiled there, where that takes ten times as long.
    if (compiled := user_cache_path("frictid-hil")).is_dir():
        shutil.copytree(compiled, folder / "cache" / "frictid-hil")
    passed_on = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    given = {
        **passed_on,
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "TMPDIR": "/dev/shm",
        "XDG_CACHE_HOME": str(folder / "cache"),
        "XDG_STATE_HOME": "/dev/shm/state",
        "XDG_DATA_HOME": "/dev/shm/data",
        "FRICTID_RUNTIME_DIR": "/dev/shm/run",
    }
    init = folder / "init"
    init.write_text(
        _INIT.format(
            busybox=_at("busybox"),
            modules=" ".join(f"{release}/kernel/{name}.ko" for name in _NEEDED),
            folder=shlex.quote(str(folder)),
            settings=" ".join(f"{name}={shlex.quote(value)}" for name, value in given.items()),
            python=sys.executable,
            script=script.resolve(),
        )
    )
    init.chmod(0o755)
    printed = _boot(init, folder, timeout_s=timeout_s)
    said, ended = folder / "said", folder / "ended"
    if not ended.exists() or ended.read_text().strip() != "0":
        raise RuntimeError(printed[-3000:] + (said.read_text() if said.exists() else ""))
    return said.read_text()


def _boot(init: Path, folder: Path, *, timeout_s: float) -> str:
    """What the kernel prints until it stops."""
    command = [
        _at(KERNEL), "mem=1024M", "root=/dev/root", "rootfstype=hostfs", "rootflags=/", "ro", f"init={init}",
        f"uml_dir={folder}", "umid=kernel", "con=null", "con0=null,fd:1", "quiet", "panic=-1",
    ]  # fmt: skip
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        errors="replace", env={**os.environ, "TMPDIR": str(folder)}, start_new_session=True,
    ) as kernel:  # fmt: skip
        try:
            printed, _ = kernel.communicate(timeout=timeout_s)
        except subprocess.TimeoutExpired:
            os.killpg(kernel.pid, signal.SIGKILL)  # its processes are processes here, too
            raise
    return printed


def _at(program: str) -> str:
    return shutil.which(program) or ""


if __name__ == "__main__":
    print(missing() or run(Path(sys.argv[1]), Path(sys.argv[2]).resolve(), timeout_s=600.0))
