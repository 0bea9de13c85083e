"""Everything about the controller that a person sees on its pendant: key switch, holds, alarms, servo power.

``Panel`` also answers the stock host-control commands, in the controller's own words and numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from frictid_drivers.motoman.emulator.axis import Axis

Reply = tuple[str, str]
DONE: Reply = ("90,000", "0000")


def refusal(number: int) -> Reply:
    """``90,000`` with an error number."""
    return "90,000", f"{number:04d}"


def data(text: str) -> Reply:
    """``90,001`` with data."""
    return "90,001", text


class Panel:
    """State of the controller and its stock commands.

    Args:
        axes: the arm.
        generation: erc, xrc, nx or dx; decides the bits of RSTATS.

    Attributes:
        teach: key switch at teach.
        remote: command remote is set.
        holds: pendant, external, command - whichever are on.
        alarm: its number, 0 for none.
        servo_blocked: an e-stop keeps servo power off.
        servo_on: servo power.
        operating: something is moving the arm.
        on_stop: called when motion must end at once; told why.
    """

    def __init__(self, axes: Sequence[Axis], generation: str = "nx") -> None:
        self.axes = axes
        self._generation = generation
        self.teach = False
        self.remote = True
        self.holds: set[str] = set()
        self.alarm = 0
        self.servo_blocked = False
        self.servo_on = False
        self.operating = False
        self.position_known = True
        self.on_stop: Callable[[str], None] = _nobody
        self._commands: dict[str, Callable[[list[str]], Reply]] = {
            "RSTATS": self._rstats,
            "RPOSJ": self._rposj,
            "RALARM": self._ralarm,
            "SVON": self._svon,
            "HOLD": self._hold,
            "RESET": self._reset,
            "CANCEL": self._cancel,
        }

    def knows(self, command: str) -> bool:
        """Whether this is a stock command."""
        return command in self._commands

    def obey(self, command: str, operands: list[str]) -> Reply:
        """Execute one stock command."""
        return self._commands[command](operands)

    def words(self) -> tuple[int, int]:
        """The two figures of RSTATS."""
        first = 0b100 | (0b1000 if self.operating else 0)
        second = (
            (0b10 if "pendant" in self.holds else 0)
            | (0b100 if "external" in self.holds else 0)
            | (0b1000 if "command" in self.holds else 0)
            | (0b10000 if self.alarm else 0)
            | (0b1000000 if self.servo_on else 0)
        )
        if self._generation != "erc":
            first |= (0b100000 if self.teach else 0b1000000) | (0b10000000 if self.remote else 0)
        return first, second

    def moving_forbidden(self) -> int:
        """0, or the number of the reason why nothing may move now."""
        if self.alarm:
            return 2060
        if not self.remote:
            return 2100
        if self.teach:
            return 2080
        for hold, number in (("pendant", 2020), ("external", 2040), ("command", 2050)):
            if hold in self.holds:
                return number
        if not self.servo_on:
            return 2070
        return 2010 if self.operating else 0

    def power(self, on: bool) -> None:
        """Switch servo power of the whole arm."""
        self.servo_on = on
        for axis in self.axes:
            axis.power(on)

    def raise_alarm(self, number: int) -> None:
        """An alarm: motion ends, servo power drops."""
        self.alarm = number
        self.on_stop("alarm")
        self.power(False)

    def press_hold(self, which: str) -> None:
        """A hold is pressed, wired or commanded."""
        self.holds.add(which)
        self.on_stop("hold")

    # -- stock commands ----------------------------------------------------------------------------------------

    def _rstats(self, operands: list[str]) -> Reply:
        return refusal(1011) if operands else data(",".join(map(str, self.words())))

    def _rposj(self, operands: list[str]) -> Reply:
        if operands:
            return refusal(1011)
        if not self.position_known:
            return refusal(3070)
        pulses = [axis.pulses for axis in self.axes]
        return data(",".join(f"{value:>8d}" for value in pulses + [0] * (12 - len(pulses))))

    def _ralarm(self, operands: list[str]) -> Reply:
        return refusal(1011) if operands else data(f"{self.alarm},0,0,0,0")

    def _svon(self, operands: list[str]) -> Reply:
        wanted = _switch(operands)
        if isinstance(wanted, int):
            return refusal(wanted)
        if not self.remote:
            return refusal(2100)
        if wanted == "on":
            if self.alarm:
                return refusal(2060)
            if self.servo_blocked:
                return refusal(3450)
            self.power(True)
        else:
            self.on_stop("servo off")
            self.power(False)
        return DONE

    def _hold(self, operands: list[str]) -> Reply:
        wanted = _switch(operands)
        if isinstance(wanted, int):
            return refusal(wanted)
        if wanted == "on":
            self.press_hold("command")
        else:
            self.holds.discard("command")
        return DONE

    def _reset(self, operands: list[str]) -> Reply:
        if operands:
            return refusal(1011)
        self.alarm = 0
        return DONE

    def _cancel(self, operands: list[str]) -> Reply:
        return refusal(1011) if operands else DONE


def _switch(operands: list[str]) -> str | int:
    """on or off, or an error number."""
    if len(operands) != 1:
        return 1011
    return {"1": "on", "0": "off"}.get(operands[0], 1012)


def _nobody(reason: str) -> None:
    """Nothing is moving yet."""
