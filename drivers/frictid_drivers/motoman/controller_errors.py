"""The controller's own error numbers as exceptions that say what they mean.

From public documents; ``90,000`` carries ``0000`` or one of these numbers.
"""

from __future__ import annotations

from typing import ClassVar

from frictid_hil.errors import HardwareError


class LinkError(HardwareError):
    """The serial link itself failed: no answer, or none that could be read."""


class BadReply(HardwareError):
    """The controller answered something that this command cannot be answered with."""


class ControllerError(HardwareError):
    """The controller refused a command with a number that is not in our list."""

    number: int = 0
    meaning: ClassVar[str] = "not in the public list"
    remedy: ClassVar[str] = "look the number up in the controller's manual"


class UnknownCommand(ControllerError):
    """1010."""

    number, meaning, remedy = 1010, "the controller does not know this command", "check `options.controller`"


class WrongOperandCount(ControllerError):
    """1011."""

    number, meaning, remedy = 1011, "wrong number of operands", "check `options.controller`"


class OperandOutOfRange(ControllerError):
    """1012."""

    number, meaning, remedy = 1012, "an operand is out of range", "check the limits in the robot file"


class WrongOperandLength(ControllerError):
    """1013."""

    number, meaning, remedy = 1013, "an operand has the wrong length", "check `options.controller`"


class ManipulatorOperating(ControllerError):
    """2010."""

    number, meaning, remedy = 2010, "the manipulator is operating", "wait until the running job has ended"


class PendantHold(ControllerError):
    """2020."""

    number, meaning, remedy = 2020, "hold by the programming pendant", "release HOLD on the pendant"


class PanelHold(ControllerError):
    """2030."""

    number, meaning, remedy = 2030, "hold by the playback panel", "release HOLD on the panel"


class ExternalHold(ControllerError):
    """2040."""

    number, meaning, remedy = 2040, "external hold", "clear the external hold input"


class CommandHold(ControllerError):
    """2050."""

    number, meaning, remedy = 2050, "hold by command", "find out what stopped the arm, then release with HOLD 0"


class AlarmOrError(ControllerError):
    """2060."""

    number, meaning, remedy = 2060, "an alarm or error is pending", "clear its cause, then reset on the pendant"


class ServoOff(ControllerError):
    """2070."""

    number, meaning, remedy = 2070, "servo power is off", "turn servo power on"


class WrongMode(ControllerError):
    """2080."""

    number, meaning, remedy = 2080, "wrong mode", "turn the key to play"


class NotCommandRemote(ControllerError):
    """2100."""

    number, meaning, remedy = 2100, "command remote is not set", "enable remote mode and command remote on the pendant"


class ServoOnNeeded(ControllerError):
    """3010."""

    number, meaning, remedy = 3010, "servo power must be on for this", "turn servo power on"


class HomeNeeded(ControllerError):
    """3040."""

    number, meaning, remedy = 3040, "home position return or check is needed", "check the home position on the pendant"


class CurrentValueNotMade(ControllerError):
    """3070."""

    number, meaning, remedy = 3070, "the current position value is not made", "turn servo power on once"


class ServoCannotTurnOn(ControllerError):
    """3450."""

    number, meaning, remedy = (
        3450,
        "servo power cannot be turned on",
        "close the safety circuit and release the e-stops",
    )


class NoSuchJob(ControllerError):
    """4040."""

    number, meaning, remedy = 4040, "no such job", "check the job's name"


class FormatMistake(ControllerError):
    """5170."""

    number, meaning, remedy = 5170, "the message has a wrong format", "check that both sides speak the same version"


_KNOWN: dict[int, type[ControllerError]] = {
    kind.number: kind
    for kind in (
        UnknownCommand,
        WrongOperandCount,
        OperandOutOfRange,
        WrongOperandLength,
        ManipulatorOperating,
        PendantHold,
        PanelHold,
        ExternalHold,
        CommandHold,
        AlarmOrError,
        ServoOff,
        WrongMode,
        NotCommandRemote,
        ServoOnNeeded,
        HomeNeeded,
        CurrentValueNotMade,
        ServoCannotTurnOn,
        NoSuchJob,
        FormatMistake,
    )
}


def controller_error(number: int, *, where: str) -> ControllerError:
    """The exception for a number from ``90,000``; ``where`` names the command."""
    kind = _KNOWN.get(number, ControllerError)
    error = kind(f"controller error {number:04d}: {kind.meaning}", where=where, next_step=kind.remedy)
    error.number = number
    return error
