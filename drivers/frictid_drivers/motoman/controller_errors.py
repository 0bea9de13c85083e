"""The controller's own error numbers (``90,000`` carries one, or ``0000``; public documents) as exceptions."""

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


_KNOWN: dict[int, type[ControllerError]] = {}


def _known(name: str, number: int, meaning: str, remedy: str) -> type[ControllerError]:
    named = {"number": number, "meaning": meaning, "remedy": remedy, "__module__": __name__}
    _KNOWN[number] = type(name, (ControllerError,), named)
    return _KNOWN[number]


UnknownCommand = _known(
    "UnknownCommand", 1010, "the controller does not know this command", "check `options.controller`"
)
WrongOperandCount = _known("WrongOperandCount", 1011, "wrong number of operands", "check `options.controller`")
OperandOutOfRange = _known(
    "OperandOutOfRange", 1012, "an operand is out of range", "check the limits in the robot file"
)
WrongOperandLength = _known("WrongOperandLength", 1013, "an operand has the wrong length", "check `options.controller`")
ManipulatorOperating = _known(
    "ManipulatorOperating", 2010, "the manipulator is operating", "wait until the running job has ended"
)
PendantHold = _known("PendantHold", 2020, "hold by the programming pendant", "release HOLD on the pendant")
PanelHold = _known("PanelHold", 2030, "hold by the playback panel", "release HOLD on the panel")
ExternalHold = _known("ExternalHold", 2040, "external hold", "clear the external hold input")
CommandHold = _known("CommandHold", 2050, "hold by command", "find out what stopped the arm, then release with HOLD 0")
AlarmOrError = _known(
    "AlarmOrError", 2060, "an alarm or error is pending", "clear its cause, then reset on the pendant"
)
ServoOff = _known("ServoOff", 2070, "servo power is off", "turn servo power on")
WrongMode = _known("WrongMode", 2080, "wrong mode", "turn the key to play")
NotCommandRemote = _known(
    "NotCommandRemote", 2100, "command remote is not set", "enable remote mode and command remote on the pendant"
)
ServoOnNeeded = _known("ServoOnNeeded", 3010, "servo power must be on for this", "turn servo power on")
HomeNeeded = _known(
    "HomeNeeded", 3040, "home position return or check is needed", "check the home position on the pendant"
)
CurrentValueNotMade = _known(
    "CurrentValueNotMade", 3070, "the current position value is not made", "turn servo power on once"
)
ServoCannotTurnOn = _known(
    "ServoCannotTurnOn", 3450, "servo power cannot be turned on", "close the safety circuit and release the e-stops"
)
NoSuchJob = _known("NoSuchJob", 4040, "no such job", "check the job's name")
FormatMistake = _known(
    "FormatMistake", 5170, "the message has a wrong format", "check that both sides speak the same version"
)


def controller_error(number: int, *, where: str) -> ControllerError:
    """The exception for a number from ``90,000``; ``where`` names the command."""
    kind = _KNOWN.get(number, ControllerError)
    error = kind(f"controller error {number:04d}: {kind.meaning}", where=where, next_step=kind.remedy)
    error.number = number
    return error
