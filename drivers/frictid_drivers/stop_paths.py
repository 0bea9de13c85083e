"""What stops a joint, how, how fast, and with which exit code: the page of it, from the very constants in force.

``python -m frictid_drivers.stop_paths docs/reference/stops.md`` writes it.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from frictid_drivers.cia402 import cycle
from frictid_drivers.cia402 import driver as cia402
from frictid_drivers.cia402.settings import read_settings
from frictid_drivers.servos import driver as servos
from frictid_drivers.servos import line
from frictid_drivers.servos.settings import read_settings as read_servo_settings
from frictid_hil.errors import FrictidError, GateFailed, HardwareError, Interrupted, SafetyAbort
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol import wishes
from frictid_hil.runner import arm, process
from frictid_hil.runner.care import Care
from frictid_hil.runner.stopping import DURATIONS_S
from frictid_hil.runner.supervisor import JointLimits

_MS = 1e-6
_DRIVE = read_settings(RobotSetup("any", "virtual:any", 1000.0, ()))[0]
_LINE = read_servo_settings(RobotSetup("any", "serial:any", 1000.0, ()))[0]
_LIMITS = JointLimits(-1.0, 1.0, 1.0, 1.0)
_ALONG = "ever slower along the planned path, then power off"
_QUICK = "quick stop to every joint, standstill awaited, power off"
_BY_DRIVE = "the drive stops by itself (1016, 6007)"


@dataclass(frozen=True, slots=True)
class StopPath:
    """One way in which motion ends."""

    trip: str  # what happens
    seen: str  # how soon it is noticed
    reaction: str  # what is done
    time: str  # how long the reaction may take until the joint stands
    ending: type[FrictidError] | None  # whose exit code it is; None where this program is no more


def _paths() -> list[StopPath]:
    stop = f"at most {DURATIONS_S[-1]:g} s"
    latest_s = arm.STOPPING_S + arm.DISABLING_S + cia402._SETTLE_S
    quick = f"the drive's quick-stop ramp; voltage off after {latest_s:g} s at the latest"
    cycles, silence = "next cycle", f"{1e3 * Care().silence_s:g} ms, never less than three cycles"
    heartbeat = f"{1e3 * _DRIVE.drive_timeout_s:g} ms"
    watchdog = f"{_DRIVE.watchdog_ms} ms"
    return [
        StopPath("Ctrl-C, SIGTERM, SIGHUP or a closed terminal, once", cycles, _ALONG, stop, Interrupted),
        StopPath("the same, twice", cycles, _QUICK, quick, Interrupted),
        StopPath("the command is killed (SIGKILL)", cycles, f"the loop: {_ALONG}", stop, None),
        StopPath(
            "the command is suspended (SIGSTOP), or its disk does not answer",
            "when half of the memory for samples is full, about half a minute",
            f"the loop: {_ALONG}",
            stop,
            SafetyAbort,
        ),
        StopPath("the computer's clock is set", "never: nothing here goes by it", "none", "-", None),
        StopPath("the loop is killed", watchdog, _BY_DRIVE, "the drive's ramp", SafetyAbort),
        StopPath(
            "the loop is suspended or hangs (SIGSTOP)",
            f"{watchdog} by the drive, {process._SILENT_S:g} s by the command, {process._SILENT_STOPPING_S:g} s once a "
            "stop was asked for",
            f"{_BY_DRIVE}; the loop is ended",
            "the drive's ramp",
            SafetyAbort,
        ),
        StopPath("this computer stops", watchdog, _BY_DRIVE, "the drive's ramp", None),
        StopPath("position, speed, power or following error out of bounds", cycles, _QUICK, quick, SafetyAbort),
        StopPath("torque out of bounds", f"{1e3 * _LIMITS.torque_s:g} ms", _QUICK, quick, SafetyAbort),
        StopPath(
            "position and reported velocity disagree, or the same report comes again and again",
            "100 ms",
            _QUICK,
            quick,
            SafetyAbort,
        ),
        StopPath("no report of the moving joint", silence, _QUICK, quick, SafetyAbort),
        StopPath("no heartbeat of a drive", heartbeat, _QUICK, quick, SafetyAbort),
        StopPath("a drive faults, warns (EMCY), boots up, changes mode or state", cycles, _QUICK, quick, SafetyAbort),
        StopPath("a locked joint moves; the interlock opens", cycles, _QUICK, quick, SafetyAbort),
        StopPath("somebody else sends our commands (CANopen, MIT)", cycles, _QUICK, quick, SafetyAbort),
        StopPath(
            f"{cycle._WIRE_FAILURES} cycles fail on the bus, or bus-off",
            cycles,
            _QUICK,
            f"{quick}; where nothing gets through, the drive stops by itself after {watchdog}",
            HardwareError,
        ),
        StopPath("a full disk", "50 ms", _ALONG, stop, FrictidError),
        StopPath("a quality gate", "after the motion", "nothing moves any more; nothing is promoted", "-", GateFailed),
    ]


def _servos() -> list[str]:
    """What becomes of servos on a serial line."""
    off_s, question_s = servos._SETTLE_S + servos._INSIST_S, line._TRIES * _LINE.answer_s
    return [
        "## Servos on a serial line",
        "",
        f"A servo holds its goal until all stand, {servos._SETTLE_S:g} s at most. It is then told to let go, again",
        f"and again for {servos._INSIST_S:g} s, until it says that it has. So power is off within {off_s:g} s of the "
        "stop, and for each",
        f"servo that is silent within {1e3 * question_s:g} ms more. Where no word reaches a servo:",
        "",
        f"- **Dynamixel** lets go by its bus watchdog, {1e3 * _LINE.watchdog_s:g} ms after it last heard anything on",
        "  the line, a question to another servo included. One that followed a current is asked whether it holds a",
        f"  position now, and told again; where it does not say so, nothing is sent from {1e3 * servos._OBEYS_S:g} ms "
        "after the stop on,",
        "  until the watchdog has struck.",
        "- **Feetech** has no watchdog. It goes on to its last goal and holds it **with power** until its supply is",
        "  switched off; the last words of the run name it and say so.",
        "",
        "How far that goal is ahead of the joint is bounded: by the bound of the following error, what the joint",
        "travels until silence is noticed, and the distance that stands for a torque in `compensate`. The servo covers",
        "it at its own speed. On an SO-101 these are 0.5 rad and 2 rad/s times 25 ms, so 0.55 rad, or 0.12 s at the",
        "4.7 rad/s that an STS3215 makes without load. Where a lower speed is set in the servo, it takes longer.",
    ]


def page() -> str:
    """The page as Markdown."""
    insist_ms = cycle._INSIST_NS * _MS
    rows = [
        f"| {path.trip} | {path.seen} | {path.reaction} | {path.time} "
        f"| {'-' if path.ending is None else path.ending.exit_code} |"
        for path in _paths()
    ]
    return "\n".join(
        [
            "# What stops a joint",
            "",
            "Figures are those of the program and of CiA-402 drives at their default settings; the drive's own ramp is",
            "its object 6085. The emergency stop of the robot is above all of this and replaced by none of it.",
            "",
            "| Trip | Noticed within | Reaction | Time to standstill | Exit code |",
            "|---|---|---|---|---|",
            *rows,
            "",
            "## When a stop is not followed",
            "",
            "A quick stop goes out as a PDO, twice. Where the drive is not seen to follow it, it goes out again by SDO",
            f"after {insist_ms:g} ms, after the end of the drive's PDOs by NMT after {2 * insist_ms:g} ms, and as "
            f"disabled voltage after {3 * insist_ms:g} ms.",
            "A drive that is not seen without power keeps its watch over this computer and stops when that is silent;",
            "the last words of the run name its joint, and say to press the emergency stop.",
            "",
            "A CiA-402 drive that stops by itself brings the joint to rest and holds it there **with power**, so that",
            "no arm falls (605A = 6). With `abort_option: 2` in the robot file it takes the power away instead.",
            "",
            "MIT-mode actuators and bus servos have no quick stop of their own: they are told to brake. One that still",
            f"moves {wishes.STOP_NS * 1e-9:g} s later, because another sender commands it, loses its power, too.",
            "An MIT motor that another sender is heard to command after the stop loses it at once.",
            "",
            *_servos(),
            "",
            "This page is generated from the code by `python -m frictid_drivers.stop_paths docs/reference/stops.md`.",
            "",
        ]
    )


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(page(), encoding="utf-8")
