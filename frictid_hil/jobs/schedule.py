"""``frictid-hil schedule``: the systemd service and timer that run ``recalibrate``, and a cron line for those without.

The service may only do what a night needs: write below its own state and data folders, schedule in real time, and reach
the bus. Its time limit ends it with the signal that brings a joint to rest. A night that was missed on a real bus is
not made up for, because people are present when the computer starts again.
"""

from __future__ import annotations

import os
import pwd
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import platformdirs

from frictid_hil.config.robot import Robot, interface_of, load_robot
from frictid_hil.errors import FrictidError, UsageError
from frictid_hil.files import made_folder, write_whole
from frictid_hil.runner.realtime import WAKE_TIME

_EXAMPLE = 'for example --on-calendar "Mon..Fri 02:30"'
_STOP_S = 60
_VERIFY_TIMEOUT_S = 30.0


@dataclass(frozen=True, slots=True)
class ScheduleOptions:
    """What a person asked for, see ``frictid-hil schedule --help``."""

    robot: str
    on_calendar: str
    bus: str | None = None
    system: bool = False
    user: str = "frictid"  # account of a system service
    notify: str | None = None
    out: Path | None = None  # folder for the units; None for systemd's own
    time_limit_s: float = 4 * 3600.0  # a night that takes longer is stopped as by Ctrl-C


def schedule(options: ScheduleOptions) -> dict[str, Any]:
    """Write the units, verified; nothing is enabled (``UsageError``: calendar, account, permission)."""
    robot = load_robot(options.robot)
    if robot.policy.unattended is None and not robot.kind(options.bus).simulated:
        raise UsageError(
            "this robot may not be moved unattended",
            where=str(robot.path),
            next_step="add policy.unattended to the robot file first",
        )
    if options.system and options.out is None:
        _refuse_without_account(options.user)
    elapses = next_elapse(with_last_day(options.on_calendar))
    name = f"frictid-hil-{robot.name}"
    units = {f"{name}.service": _service(options, robot), f"{name}.timer": _timer(options, robot)}
    verified = verify(units, system=options.system)
    folder = options.out or _unit_folder(options.system)
    made_folder(folder, next_step="run it as root, or give --out")
    paths = [folder / unit for unit in units]
    for path, text in zip(paths, units.values(), strict=True):
        write_whole(path, text)
    cron, cron_refused = _cron_line(options, robot)
    return {
        "outcome": "ok",
        "robot": robot.name,
        "service": str(paths[0].resolve()),
        "timer": str(paths[1].resolve()),
        "next_elapse": elapses,
        "verified": verified,
        "enable": _enable(options, paths),
        "cron": cron,
        "cron_refused": cron_refused,
    }


def _refuse_without_account(name: str) -> None:
    try:
        pwd.getpwnam(name)
    except KeyError:
        raise UsageError(
            f"there is no account {name!r} on this computer",
            next_step=f"make it: `sudo useradd --system --groups dialout {name}`; or give --account, or --out "
            "for units of another computer",
        ) from None


def _enable(options: ScheduleOptions, paths: list[Path]) -> str:
    """The commands that turn the timer on."""
    systemctl = "systemctl" if options.system else "systemctl --user"
    # Without lingering a person's units end when the person logs out.
    first = [] if options.system else ["loginctl enable-linger"]
    known = options.out is None or options.out.resolve() == _unit_folder(options.system).resolve()
    # systemd looks for units in its own folders only; it has to be shown others.
    found = "daemon-reload" if known else f"link {shlex.join(str(path.resolve()) for path in paths)}"
    return " && ".join([*first, f"{systemctl} {found}", f"{systemctl} enable --now {paths[1].name}"])


def next_elapse(on_calendar: str) -> str | None:
    """When it comes true next, by systemd itself; None without systemd (``UsageError``: unreadable, or never)."""
    if not on_calendar.strip() or "\n" in on_calendar:
        raise UsageError(f"no calendar expression: {on_calendar!r}", next_step=_EXAMPLE)
    tool = shutil.which("systemd-analyze")
    if tool is None:
        return None
    answer = _run([tool, "calendar", on_calendar])
    if answer.returncode:
        why = answer.stderr.strip().rpartition("\n")[2]
        raise UsageError(
            f"systemd refuses the calendar expression {on_calendar!r}: {why}",
            next_step=f"see `man systemd.time`; {_EXAMPLE}",
        )
    for line in answer.stdout.splitlines():
        if line.strip().startswith("Next elapse:"):
            elapse = line.split(":", 1)[1].strip()
            if elapse == "never":
                raise UsageError(f"the calendar expression {on_calendar!r} never comes true")
            return elapse
    return None


def verify(units: dict[str, str], *, system: bool) -> bool:
    """Have systemd check the units; False where it is not installed (``FrictidError``: it refuses; its own words)."""
    tool = shutil.which("systemd-analyze")
    if tool is None:
        return False
    with tempfile.TemporaryDirectory(prefix="frictid-units-") as temporary:
        paths = [str(Path(temporary) / name) for name in units]
        for path, text in zip(paths, units.values(), strict=True):
            Path(path).write_text(text)
        # Without a session (a container, ssh) there is no user manager to ask; the syntax is the same.
        for manager in ["--system"] if system else ["--user", "--system"]:
            answer = _run([tool, "verify", manager, "--man=no", "--recursive-errors=no", *paths])
            mine = [line for line in answer.stderr.splitlines() if any(name in line for name in units)]
            if mine:
                raise FrictidError(f"systemd refuses the units: {'; '.join(mine)}", where=", ".join(units))
            if answer.returncode == 0:
                return True
    return False


def _cron_line(options: ScheduleOptions, robot: Robot) -> tuple[str | None, str]:
    """A line for ``crontab -e`` that comes true exactly when the timer does; else None, and why."""
    try:
        when = cron_fields(options.on_calendar)
    except UsageError as error:
        return None, error.what
    folder = shlex.quote(str(platformdirs.user_state_path("frictid-hil")))
    limit = f"timeout --kill-after={_STOP_S} {options.time_limit_s:.0f}"
    # cron tells nobody of a folder that is not there: the line makes it.
    command = f"{limit} {shlex.join(_command(options, robot))} >> {robot.name}.log 2>&1"
    return f"{when} " + f"mkdir -p {folder} && cd {folder} && {command}".replace("%", r"\%"), ""


def _command(options: ScheduleOptions, robot: Robot) -> list[str]:
    program = shutil.which("frictid-hil", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")
    command = [program or "frictid-hil", "recalibrate", "--robot", str(robot.path.resolve()), "--json"]
    given = {"--bus": options.bus, "--notify": options.notify}
    return [*command, *(word for name, value in given.items() if value is not None for word in (name, value))]


def _service(options: ScheduleOptions, robot: Robot) -> str:
    command = " ".join(_quoted(word) for word in _command(options, robot))
    return f"""\
[Unit]
Description=Recalibrate the friction profile of robot {robot.name}

[Service]
Type=oneshot
ExecStart={command}
KillSignal=SIGTERM
KillMode=mixed
TimeoutStartSec={options.time_limit_s:.0f}
TimeoutStopSec={_STOP_S}

# Real time: the cyclic loop asks for SCHED_FIFO 60, locked memory and awake processors.
LimitRTPRIO=99
LimitMEMLOCK=infinity
RestrictRealtime=no

# It needs its own folders, the bus, and nothing else. Not PrivateTmp: the lock of a bus lies in /tmp, for all to see.
NoNewPrivileges=yes
ProtectSystem=strict
ReadWritePaths=/tmp
LockPersonality=yes
RestrictSUIDSGID=yes
SystemCallArchitectures=native
RestrictAddressFamilies=AF_UNIX AF_CAN AF_INET AF_INET6 AF_NETLINK
UMask=0027
""" + (_system_part(options, robot) if options.system else _USER_PART)


_USER_PART = """\
StateDirectory=frictid-hil
WorkingDirectory=%S/frictid-hil
ReadWritePaths=%h
"""


def _system_part(options: ScheduleOptions, robot: Robot) -> str:
    folder = f"/var/lib/frictid-hil/{robot.name}"
    bus = options.bus or robot.file.bus
    port = f"DeviceAllow={_quoted(bus.partition(':')[2])} rw\n" if interface_of(bus) == "serial" else ""
    return f"""\
User={options.user}
StateDirectory=frictid-hil/{robot.name}
WorkingDirectory={folder}
Environment=XDG_DATA_HOME={folder}/data
Environment=XDG_STATE_HOME={folder}/state
Environment=NUMBA_CACHE_DIR={folder}/numba
AmbientCapabilities=CAP_SYS_NICE
CapabilityBoundingSet=CAP_SYS_NICE
ExecStartPre=-+setfacl -m u:{options.user}:rw {WAKE_TIME}
DevicePolicy=closed
DeviceAllow={WAKE_TIME} rw
{port}ProtectHome=read-only
ProtectKernelTunables=yes
ProtectKernelModules=yes
ProtectKernelLogs=yes
ProtectControlGroups=yes
ProtectClock=yes
ProtectHostname=yes
ProtectProc=invisible
RestrictNamespaces=yes
KeyringMode=private
SystemCallFilter=@system-service
SystemCallErrorNumber=EPERM
"""


def _timer(options: ScheduleOptions, robot: Robot) -> str:
    missed = "Persistent=true" if robot.kind(options.bus).simulated else "Persistent=false"
    return f"""\
[Unit]
Description=When robot {robot.name} is recalibrated

[Timer]
OnCalendar={with_last_day(options.on_calendar)}
# A night missed while the computer was off is made up for by a simulated robot only.
{missed}
AccuracySec=1min

[Install]
WantedBy=timers.target
"""


def _quoted(word: str) -> str:
    """A word of ExecStart: systemd's own quoting, in which % and $ have meanings."""
    word = word.replace("\\", "\\\\").replace("%", "%%").replace("$", "$$").replace('"', '\\"')
    return f'"{word}"' if any(c.isspace() or c in "\"';" for c in word) else word


def _unit_folder(system: bool) -> Path:
    return Path("/etc/systemd/system") if system else platformdirs.user_config_path("systemd") / "user"


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=_VERIFY_TIMEOUT_S, check=False)
    except (OSError, subprocess.SubprocessError) as error:
        raise FrictidError(f"{command[0]} could not be run: {error}") from None


_DAYS = ("monday", "tuesday", "wednesday", "thursday", "friday", "saturday", "sunday")
_SHORTHANDS = {
    "minutely": "*-*-* *:*:00",
    "hourly": "*-*-* *:00:00",
    "daily": "*-*-* 00:00:00",
    "weekly": "Mon *-*-* 00:00:00",
    "monthly": "*-*-01 00:00:00",
    "quarterly": "*-01,04,07,10-01 00:00:00",
    "semiannually": "*-01,07-01 00:00:00",
    "yearly": "*-01-01 00:00:00",
}
_SHORTHANDS |= {"annually": _SHORTHANDS["yearly"], "biannually": _SHORTHANDS["semiannually"]}
_SHORTHANDS |= {"bi-annually": _SHORTHANDS["semiannually"], "semi-annually": _SHORTHANDS["semiannually"]}
_VALUES = {"minute": range(60), "hour": range(24), "day": range(1, 32), "month": range(1, 13)}
_OPEN_STEP = re.compile(r"(?<![\d.])(\d+)/(\d+)", re.ASCII)
_PART = re.compile(r"(\d+)(?:\.\.(\d+))?(?:/(\d+))?", re.ASCII)


def with_last_day(on_calendar: str) -> str:
    """The expression with every step through the days of a month said to its end: ``1/4`` is ``1..31/4``.

    They mean the same; of the first, systemd 252 leaves out what comes in January before the day at which the step of
    December ends.
    """
    words = on_calendar.split()
    for at, word in enumerate(words):
        rest, dash, days = word.rpartition("-")
        if dash and ":" not in word and "~" not in word:
            words[at] = rest + dash + _OPEN_STEP.sub(rf"\1..{_VALUES['day'][-1]}/\2", days)
    return " ".join(words)


def cron_fields(on_calendar: str) -> str:
    """Fields of a crontab line that comes true exactly when an expression does (``UsageError``: cron cannot say it).

    cron knows the local clock and no years, seconds or time zones, and no days counted from the end of a month (``~``).
    Where a day and a weekday are given, systemd wants both, cron takes either (``man 5 crontab``): not translated.
    """
    words = _SHORTHANDS.get(on_calendar.strip().lower(), on_calendar).split()
    weekdays = "*"
    if words and words[0][0].isalpha():
        weekdays = _weekdays(words.pop(0))
    date = words.pop(0) if words and ":" not in words[0] else "*-*-*"
    time = words.pop(0) if words and ":" in words[0] else "00:00:00"
    if words or not on_calendar.strip():
        raise _no(f"{' '.join(words)!r} (cron follows the local clock)")
    dated = re.fullmatch(r"(?:\*-)?([^-]+)-([^-]+)", date)
    timed = re.fullmatch(r"([^:]+):([^:]+)(?::0?0)?", time)
    if dated is None or timed is None:
        raise _no(f"{date!r} (years)" if dated is None else f"{time!r} (seconds)")
    (month, day), (hour, minute) = dated.groups(), timed.groups()
    days, months = _field("day", day), _field("month", month)
    if days != "*" and weekdays != "*":
        raise _no("a day of the month together with a weekday: it takes either, not both")
    return f"{_field('minute', minute)} {_field('hour', hour)} {days} {months} {weekdays}"


def _field(name: str, text: str) -> str:
    values, found = _VALUES[name], set[int]()
    if text == "*":
        return "*"
    for part in text.split(","):
        match = _PART.fullmatch(part)
        if match is None:
            raise _no(f"{part!r} as {name}")
        first, last, step = match.groups()
        low = int(first)
        high = int(last) if last else values[-1] if step else low
        if low not in values or high not in values or low > high or (step and not int(step)):
            raise _no(f"{part!r} as {name}")
        found |= set(range(low, high + 1, int(step or 1)))
    return ",".join(map(str, sorted(found)))


def _weekdays(text: str) -> str:
    """The week of systemd begins on Monday, that of cron on Sunday with 0."""
    found = set[int]()
    for part in filter(None, text.lower().split(",")):
        first, _, last = part.partition("..")
        at = range(_weekday(first), _weekday(last or first) + 1)
        if not at:
            raise _no(f"{part!r} as weekdays")
        found |= {(one + 1) % 7 for one in at}
    return ",".join(map(str, sorted(found)))


def _weekday(text: str) -> int:
    found = [at for at, name in enumerate(_DAYS) if text in (name, name[:3])]
    if not found:
        raise _no(f"{text!r} as weekday")
    return found[0]


def _no(what: str) -> UsageError:
    return UsageError(f"cron cannot say {what}")
