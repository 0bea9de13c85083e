"""``frictid-hil schedule``: the systemd service and timer that run ``recalibrate``, and a cron line for those without.

The service may do what a night needs and nothing else: write below its own state and data folders, schedule in real
time, reach the bus. It is started once per night, catches up after a power failure, and is stopped with the signal
that brings a joint to rest.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from frictid_hil.config.robot import Robot, load_robot
from frictid_hil.errors import FrictidError, UsageError
from frictid_hil.files import write_whole

_EXAMPLE = 'for example --on-calendar "Mon..Fri 02:30"'
_WEEK = ("sun", "mon", "tue", "wed", "thu", "fri", "sat")
"""As cron counts the days, from 0."""
_STOP_S = 60
_VERIFY_TIMEOUT_S = 30.0


@dataclass(frozen=True, slots=True)
class ScheduleOptions:
    """What a person asked for.

    Attributes:
        robot: robot file, by path or name.
        on_calendar: when, as systemd writes it (``Mon..Fri 02:30``).
        bus: ``interface:channel`` for ``recalibrate``.
        system: for the whole machine, run as ``user``; else for this person alone.
        user: account of a system service.
        notify: command given the result on its standard input.
        out: folder for the units; None for systemd's own.
    """

    robot: str
    on_calendar: str
    bus: str | None = None
    system: bool = False
    user: str = "frictid"
    notify: str | None = None
    out: Path | None = None


def schedule(options: ScheduleOptions) -> dict[str, Any]:
    """Write the units, verified; nothing is enabled or started.

    Raises:
        UsageError: a calendar expression that systemd refuses, or a robot that may not be moved unattended.
        FrictidError: a folder that cannot be written, or units that systemd refuses.
    """
    robot = load_robot(options.robot)
    if robot.policy.unattended is None and robot.driver(options.bus) != "virtual":
        raise UsageError(
            "this robot may not be moved unattended",
            where=str(robot.path),
            next_step="add policy.unattended to the robot file first",
        )
    elapses = next_elapse(options.on_calendar)
    name = f"frictid-hil-{robot.name}"
    service, timer = _service(options, robot), _timer(options, robot)
    verified = verify({f"{name}.service": service, f"{name}.timer": timer}, system=options.system)
    folder = options.out or _unit_folder(options.system)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FrictidError(
            f"cannot be created: {error.strerror}", where=str(folder), next_step="run it as root, or give --out"
        ) from None
    paths = [folder / f"{name}.service", folder / f"{name}.timer"]
    for path, text in zip(paths, (service, timer), strict=True):
        write_whole(path, text)
    scope = "" if options.system else "--user "
    return {
        "outcome": "ok",
        "robot": robot.name,
        "service": str(paths[0].resolve()),
        "timer": str(paths[1].resolve()),
        "next_elapse": elapses,
        "verified": verified,
        "enable": f"systemctl {scope}daemon-reload && systemctl {scope}enable --now {name}.timer",
        "cron": cron_line(options, robot),
    }


def next_elapse(on_calendar: str) -> str | None:
    """When an expression comes true next, by systemd itself; None where systemd is not installed.

    Raises:
        UsageError: systemd does not understand it, or it never comes true.
    """
    if not on_calendar.strip() or "\n" in on_calendar:
        raise UsageError(
            f"no calendar expression: {on_calendar!r}", next_step='for example --on-calendar "Mon..Fri 02:30"'
        )
    tool = shutil.which("systemd-analyze")
    if tool is None:
        return None
    answer = _run([tool, "calendar", on_calendar])
    if answer.returncode:
        raise UsageError(
            f"systemd refuses the calendar expression {on_calendar!r}: {_last_line(answer.stderr)}",
            next_step=f"see `man systemd.time`; {_EXAMPLE}",
        )
    for line in answer.stdout.splitlines():
        if line.strip().startswith("Next elapse:"):
            elapse = line.split(":", 1)[1].strip()
            if elapse == "never":
                raise UsageError(f"the calendar expression {on_calendar!r} never comes true")
            return elapse
    return None


def _last_line(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[-1] if lines else ""


def verify(units: dict[str, str], *, system: bool) -> bool:
    """Have systemd check the units; False where systemd is not installed.

    Raises:
        FrictidError: systemd refuses them; its own words.
    """
    tool = shutil.which("systemd-analyze")
    if tool is None:
        return False
    with tempfile.TemporaryDirectory(prefix="frictid-units-") as temporary:
        paths = []
        for name, text in units.items():
            path = Path(temporary) / name
            path.write_text(text)
            paths.append(str(path))
        # Without a session (a container, ssh) there is no user manager to ask; the syntax is the same.
        for manager in ["--system"] if system else ["--user", "--system"]:
            answer = _run([tool, "verify", manager, "--man=no", "--recursive-errors=no", *paths])
            mine = [line for line in answer.stderr.splitlines() if any(name in line for name in units)]
            if mine:
                raise FrictidError(f"systemd refuses the units: {'; '.join(mine)}", where=", ".join(units))
            if answer.returncode == 0:
                return True
    return False


def cron_line(options: ScheduleOptions, robot: Robot) -> str:
    """A line for ``crontab -e``: at the weekdays and the hour of the calendar expression, else daily at 02:30."""
    hour, minute = _hour_and_minute(options.on_calendar)
    folder = shlex.quote(str(_work_folder()))
    # cron tells nobody of a folder that is not there: the line makes it.
    words = f"mkdir -p {folder} && cd {folder} && {shlex.join(_command(options, robot))} >> {robot.name}.log 2>&1"
    return f"{minute} {hour} * * {_weekdays(options.on_calendar)} " + words.replace("%", r"\%")


def _command(options: ScheduleOptions, robot: Robot) -> list[str]:
    program = shutil.which("frictid-hil", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")
    command = [program or "frictid-hil", "recalibrate", "--robot", str(robot.path.resolve()), "--json"]
    if options.bus is not None:
        command += ["--bus", options.bus]
    if options.notify is not None:
        command += ["--notify", options.notify]
    return command


def _service(options: ScheduleOptions, robot: Robot) -> str:
    command = " ".join(_quoted(word) for word in _command(options, robot))
    lines = [
        "[Unit]",
        f"Description=Recalibrate the friction profile of robot {robot.name}",
        "",
        "[Service]",
        "Type=oneshot",
        f"ExecStart={command}",
        # 5: a quality gate failed, which is a result and is told as one.
        "SuccessExitStatus=5",
        "KillSignal=SIGTERM",
        "KillMode=mixed",
        f"TimeoutStopSec={_STOP_S}",
        "TimeoutStartSec=infinity",
        "",
        "# Real time: the cyclic loop asks for SCHED_FIFO 60 and locked memory.",
        "LimitRTPRIO=99",
        "LimitMEMLOCK=infinity",
        "RestrictRealtime=no",
        "",
        "# It needs its own folders, the bus, and nothing else.",
        "NoNewPrivileges=yes",
        "ProtectSystem=strict",
        "LockPersonality=yes",
        "RestrictSUIDSGID=yes",
        "SystemCallArchitectures=native",
        "RestrictAddressFamilies=AF_UNIX AF_CAN AF_INET AF_INET6 AF_NETLINK",
        "UMask=0027",
    ]
    if options.system:
        lines += [
            f"User={options.user}",
            f"StateDirectory=frictid-hil/{robot.name}",
            f"WorkingDirectory=/var/lib/frictid-hil/{robot.name}",
            f"Environment=XDG_DATA_HOME=/var/lib/frictid-hil/{robot.name}/data",
            f"Environment=XDG_STATE_HOME=/var/lib/frictid-hil/{robot.name}/state",
            f"Environment=NUMBA_CACHE_DIR=/var/lib/frictid-hil/{robot.name}/numba",
            "AmbientCapabilities=CAP_SYS_NICE",
            "CapabilityBoundingSet=CAP_SYS_NICE",
            "PrivateTmp=yes",
            "ProtectHome=read-only",
            "ProtectKernelTunables=yes",
            "ProtectKernelModules=yes",
            "ProtectKernelLogs=yes",
            "ProtectControlGroups=yes",
            "ProtectClock=yes",
            "ProtectHostname=yes",
            "RestrictNamespaces=yes",
            "MemoryDenyWriteExecute=no",
        ]
    else:
        lines += [
            "StateDirectory=frictid-hil",
            "WorkingDirectory=%S/frictid-hil",
            "ReadWritePaths=%h",
        ]
    return "\n".join(lines) + "\n"


def _timer(options: ScheduleOptions, robot: Robot) -> str:
    return "\n".join(
        [
            "[Unit]",
            f"Description=When robot {robot.name} is recalibrated",
            "",
            "[Timer]",
            f"OnCalendar={options.on_calendar}",
            "# A night missed while the computer was off is made up for once.",
            "Persistent=true",
            "AccuracySec=1min",
            "",
            "[Install]",
            "WantedBy=timers.target",
            "",
        ]
    )


def _quoted(word: str) -> str:
    """A word of ExecStart: systemd's own quoting, in which % and $ have meanings."""
    word = word.replace("\\", "\\\\").replace("%", "%%").replace("$", "$$").replace('"', '\\"')
    return f'"{word}"' if any(c.isspace() or c in "\"';" for c in word) else word


def _unit_folder(system: bool) -> Path:
    if system:
        return Path("/etc/systemd/system")
    base = os.environ.get("XDG_CONFIG_HOME", "")
    return (Path(base) if base else Path.home() / ".config") / "systemd" / "user"


def _work_folder() -> Path:
    base = os.environ.get("XDG_STATE_HOME", "")
    return (Path(base) if base else Path.home() / ".local" / "state") / "frictid-hil"


def _weekdays(on_calendar: str) -> str:
    """The weekdays of an expression that begins with some (``Mon..Fri``, ``Tue,Sat``) as cron counts them, else all."""
    word = on_calendar.split()[0].lower()
    numbers: set[int] = set()
    for part in word.split(","):
        first, _, last = part.partition("..")
        if first not in _WEEK or (last or first) not in _WEEK:
            return "*"
        low, high = _WEEK.index(first), _WEEK.index(last or first)
        numbers |= {at % 7 for at in range(low, high + 1 + 7 * (high < low))}
    return ",".join(map(str, sorted(numbers)))


def _hour_and_minute(on_calendar: str) -> tuple[int, int]:
    for word in on_calendar.split():
        hour, colon, rest = word.partition(":")
        if colon and hour.isdigit() and rest[:2].isdigit():
            return int(hour), int(rest[:2])
    return 2, 30


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=_VERIFY_TIMEOUT_S, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        raise FrictidError(f"{command[0]} could not be run: {error}") from None
