"""Everything that a person sees on the pendant: key switch, holds, alarms, servo power; and the stock commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from frictid_drivers.motoman.emulator.axis import Axis

Reply = tuple[str, str]
DONE: Reply = ("90,000", "0000")


@dataclass(frozen=True, slots=True)
class Settings:
    """How an emulated controller is made; every default is that of the real one, where it is known."""

    generation: str = "nx"  # erc, xrc, nx or dx; decides the bits of RSTATS
    baud: int = 19200  # of host control
    parity: str = "E"  # E, O or N; a byte costs 11 bits with, 10 without
    timer_a_s: float = 3.0  # RS034: answer to ENQ or to a text
    timer_b_s: float = 20.0  # RS035: end of a text
    retry_1: int = 10  # RS036: invalid or no response
    retry_2: int = 3  # RS037: NAK to a text
    hush_s: float = 0.1  # silence after which rubbish on the line has ended
    stream_bauds: tuple[int, ...] = (115200, 921600)  # speeds that FSTREAM may ask for; none on an ordinary port
    batch: bool = True  # the batch application is installed
    tick_s: float = 0.004  # interpolation clock
    averaging_ticks: int = 1  # moving average on the command; 1 is none
    thinking_s: float = 0.012  # between a command and the bid to reply
    table_delay_ticks: int = 0  # between the tick that a table's torque is computed in and the tick that it acts in
    reads_while_running: bool = True  # the batch application hands samples over while a job runs (FREAD 2)

    @property
    def tick_us(self) -> int:
        """Interpolation clock."""
        return round(self.tick_s * 1e6)

    @property
    def averaging_ms(self) -> int:
        """Moving average on the command; 0 is none."""
        return round((self.averaging_ticks - 1) * self.tick_s * 1000)


class Refused(Exception):
    """``90,000`` with this error number is the reply."""


def require(condition: object, number: int) -> None:
    """Refuse with this error number what must be so and is not."""
    if not condition:
        raise Refused(number)


def data(text: str) -> Reply:
    """``90,001`` with data."""
    return "90,001", text


class Panel:
    """State of the controller and its stock commands; ``on_stop`` is told why motion must end at once."""

    def __init__(self, axes: Sequence[Axis], settings: Settings, on_stop: Callable[[str], None]) -> None:
        self.axes = list(axes)
        self.settings = settings
        self.teach = False  # what the key switch says
        self.remote = True  # command remote is set
        self.holds: set[str] = set()  # pendant, external, command
        self.alarm = 0  # its number, 0 for none
        self.servo_blocked = False  # by an e-stop
        self.servo_on = False
        self.operating = False  # something is moving the arm
        self.position_known = True
        self.on_stop = on_stop
        self._commands: dict[str, tuple[int, Callable[..., Reply]]] = {
            "RSTATS": (0, lambda: data(",".join(map(str, self.words())))),
            "RPOSJ": (0, self._rposj),
            "RALARM": (0, lambda: data(f"{self.alarm},0,0,0,0")),
            "SVON": (1, self._svon),
            "HOLD": (1, self._hold),
            "RESET": (0, self._reset),
            "CANCEL": (0, lambda: DONE),
        }
        """With how many operands they have."""

    def knows(self, command: str) -> bool:
        """Whether this is a stock command."""
        return command in self._commands

    def obey(self, command: str, operands: list[str]) -> Reply:
        """Execute one stock command."""
        count, action = self._commands[command]
        require(len(operands) == count, 1011)
        return action(*operands)

    def words(self) -> tuple[int, int]:
        """The two figures of RSTATS."""
        first = 1 << 2 | self.operating << 3
        second = (bool(self.alarm) << 4) | self.servo_on << 6
        for bit, hold in enumerate(("pendant", "external", "command"), start=1):
            second |= (hold in self.holds) << bit
        if self.settings.generation != "erc":
            first |= 1 << (5 if self.teach else 6) | self.remote << 7
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

    def _rposj(self) -> Reply:
        require(self.position_known, 3070)
        pulses = [axis.pulses for axis in self.axes]
        return data(",".join(f"{value:>8d}" for value in pulses + [0] * (12 - len(pulses))))

    def _svon(self, wanted: str) -> Reply:
        require(wanted in ("0", "1"), 1012)
        require(self.remote, 2100)
        if wanted == "0":
            self.on_stop("servo off")
        else:
            require(not self.alarm, 2060)
            require(not self.servo_blocked, 3450)
        self.power(wanted == "1")
        return DONE

    def _hold(self, wanted: str) -> Reply:
        require(wanted in ("0", "1"), 1012)
        if wanted == "1":
            self.press_hold("command")
        else:
            self.holds.discard("command")
        return DONE

    def _reset(self) -> Reply:
        self.alarm = 0
        return DONE
