"""What a person asks of a compensation: task, modes, setting, speed, travel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from frictid_hil.errors import UsageError
from frictid_hil.plan.mode import Mode

TASKS = ("hand", "track")
MODES = ("nc", "mo", "mol", "mop", "mop-reference")
SETTINGS = ("ours", "paper")

HAND_FREQUENCY_HZ = 0.5
HAND_AMPLITUDE_RAD = math.radians(20.0)
TRACK_SPEED_RAD_S = math.radians(30.0)
TRACK_AMPLITUDE_RAD = math.radians(10.0)


@dataclass(frozen=True, slots=True)
class Wanted:
    """What a person asks for, see ``frictid-hil compensate --help``."""

    task: str
    modes: tuple[str, ...] = ()
    setting: str = "ours"
    ratio: float | None = None  # R instead of the setting's; so K and B_c after it
    stiffness_nm_per_rad: float | None = None
    viscous_nm_s_per_rad: float | None = None
    speed_rad_s: float | None = None  # of the triangle; of the hand at the middle of its travel
    duration_s: float = 10.0  # of one mode; 0 until interrupted
    centre_rad: float | None = None
    drive_mode: Mode = Mode.TORQUE  # TORQUE, or POSITION or VELOCITY with the torque as offset
    force: bool = False  # doubts only warn
    simulated: bool = False  # the robot is, and the paper's K may then hunt; ``completed`` fills it in

    def completed(self, *, simulated: bool) -> Wanted:
        """With what follows from the robot and from what was left out (``UsageError``: a negative duration)."""
        if self.duration_s < 0.0:
            raise UsageError("the duration must not be negative")
        modes = self.modes or MODES
        if not self.modes and self.task == "hand":
            modes = ("mop",) if self.endless else MODES[:4]
        return replace(self, modes=modes, simulated=simulated)

    @property
    def amplitude_rad(self) -> float:
        """The travel to either side of the centre."""
        return HAND_AMPLITUDE_RAD if self.task == "hand" else TRACK_AMPLITUDE_RAD

    @property
    def peak_rad_s(self) -> float:
        """Highest speed of the task."""
        if self.speed_rad_s is not None:
            return self.speed_rad_s
        return 2 * math.pi * HAND_FREQUENCY_HZ * HAND_AMPLITUDE_RAD if self.task == "hand" else TRACK_SPEED_RAD_S

    @property
    def period_s(self) -> float:
        """The duration of one cycle of the task."""
        travel_rad = self.amplitude_rad * (2 * math.pi if self.task == "hand" else 4.0)
        return travel_rad / self.peak_rad_s

    @property
    def endless(self) -> bool:
        """True where the task runs until it is interrupted."""
        return self.duration_s == 0.0

    @property
    def cycles(self) -> int:
        """Whole cycles within the duration, the first not counted into any figure."""
        return max(2, round(self.duration_s / self.period_s))


def refuse_contradictions(wanted: Wanted) -> None:
    """Refuse options that contradict each other (``UsageError``: naming them)."""
    for value, known, what in (
        (wanted.task, TASKS, "task"),
        (wanted.setting, SETTINGS, "setting"),
        *((mode, MODES, "mode") for mode in wanted.modes),
    ):
        if value not in known:
            raise UsageError(f"no {what} {value!r}; there are {', '.join(known)}")
    if len(set(wanted.modes)) != len(wanted.modes) or not wanted.modes:
        raise UsageError("name each mode once")
    if wanted.task == "hand":
        if "mop-reference" in wanted.modes:
            raise UsageError(
                "mop-reference needs to know what the joint will do; a person's hand does not tell",
                next_step="use it with --task track",
            )
        if wanted.drive_mode is not Mode.TORQUE:
            raise UsageError("a joint under position or velocity control cannot be guided by hand")
    elif wanted.endless:
        raise UsageError("only --task hand runs until interrupted", next_step="give --duration, e.g. 10s")
    if wanted.endless and len(wanted.modes) != 1:
        raise UsageError(
            "until interrupted, one mode runs; several were asked for", next_step="add --mode mop, for instance"
        )
    if wanted.peak_rad_s <= 0:
        raise UsageError("the speed must be positive")
