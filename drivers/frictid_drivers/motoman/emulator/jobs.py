"""The batch application: one job of one axis, generated, run and recorded on the controller, handed over on request.

Texts are those of the controller-application page; every number in them is decimal unless said otherwise there.
"""

from __future__ import annotations

import base64
import math
import struct
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from frictid_drivers.motoman.emulator.panel import DONE, Panel, Refused, Reply, data, require

SAMPLES_PER_BLOCK = 18
MOST_TICKS = 60_000
STOPPING_TICKS = 25
_START_TOLERANCE = 0.005  # rad between the planned start of a job and where the axis stands

ACCEPTED, RUNNING, FINISHED, STOPPED = 1, 2, 3, 4
REASONS = {"": 0, "watchdog": 1, "hold": 2, "alarm": 3, "limit": 4, "torque": 5, "host": 6, "servo off": 7}


def _shifted(byte: int) -> int:
    """What one byte does to an empty register of CRC-16/CCITT-FALSE, bit by bit as in the standard's text."""
    register = byte << 8
    for _ in range(8):
        register = (register << 1 ^ 0x1021) & 0xFFFF if register & 0x8000 else register << 1
    return register


_SHIFTED = [_shifted(byte) for byte in range(256)]


def crc16(raw: bytes) -> int:
    """CRC-16/CCITT-FALSE."""
    register = 0xFFFF
    for byte in raw:
        register = (register << 8 & 0xFF00) ^ _SHIFTED[register >> 8 ^ byte]
    return register


@dataclass(frozen=True, slots=True)
class Table:
    """What FTABLE brought for one axis: the curve at equal steps of speed from standstill, and what holds the joint.

    Torques at the motor shaft in uN m, positions in pulses. The first point is F_0; beyond the last one the curve goes
    on with the last slope.
    """

    ratio: float  # R, part of the friction that is compensated
    step_tenths: float  # 0.1 pulse/s between two points
    stiffness_micro: float  # K, uN m per pulse
    turn_pulses: float  # pulses per revolution of the joint, for gravity
    gravity_cos_micro: float  # uN m at the motor shaft
    gravity_sin_micro: float  # uN m at the motor shaft
    points_micro: tuple[int, ...]  # the curve

    def curve_micro(self, speed_tenths: float) -> float:
        """phi of a speed >= 0."""
        place = speed_tenths / self.step_tenths
        index = min(int(place), len(self.points_micro) - 2)
        low, high = self.points_micro[index : index + 2]
        return low + (high - low) * (place - index)


class Compensator:
    """The slip spring of one axis, (24a)-(24c), relaxed at ``pulses``, with its table on top; ``delay_ticks`` late."""

    def __init__(self, table: Table, pulses: int, delay_ticks: int = 0) -> None:
        self.table = table
        self._under_way = deque([0.0] * delay_ticks)
        self._pulses = pulses
        self._stretch = 0.0

    def torque_micro(self, pulses: int, speed_tenths: float, *, gravity: bool) -> float:
        """Torque to add now, uN m; ``gravity`` adds what holds a floating axis."""
        self._under_way.append(self._computed(pulses, speed_tenths, gravity=gravity))
        return self._under_way.popleft()

    def _computed(self, pulses: int, speed_tenths: float, *, gravity: bool) -> float:
        table = self.table
        coulomb = table.points_micro[0]
        longest = coulomb / table.stiffness_micro
        # (24a) with the increment of the encoder in place of v dt.
        self._stretch = max(-longest, min(longest, self._stretch + pulses - self._pulses))
        self._pulses = pulses
        rate_part = math.copysign(table.curve_micro(abs(speed_tenths)) - coulomb, speed_tenths)
        friction = table.ratio * (table.stiffness_micro * self._stretch + rate_part)
        if not gravity:
            return friction
        angle = 2 * math.pi * pulses / table.turn_pulses
        return friction + table.gravity_cos_micro * math.cos(angle) + table.gravity_sin_micro * math.sin(angle)


@dataclass
class Job:
    """An accepted job and what became of it."""

    number: int
    axis: int
    path: list[int]
    floating: list[bool]
    torque_limit_micro: int
    watchdog_ticks: int
    state: int = ACCEPTED
    reason: str = ""
    done: int = 0
    dropped: int = 0
    samples: list[tuple[int, int, int]] = field(default_factory=list)

    def shifts(self) -> tuple[int, int]:
        """How far velocity and torque of the whole recording are shifted right to fit 24 bits."""
        return _shifts(self.samples)


class BatchApplication:
    """FHELLO, FJOB, FRUN, FSTAT, FSTOP, FREAD, FTABLE, FTREAD, FCOMP; ``on_guided`` as in ``Emulator``."""

    def __init__(self, panel: Panel, on_guided: Callable[[int, bool], None]) -> None:
        self._panel = panel
        self._axes = panel.axes
        self._settings = panel.settings
        self._on_guided = on_guided
        self._job: Job | None = None
        self._tables: dict[int, tuple[bytes, Table]] = {}
        self._compensators: dict[int, Compensator] = {}
        self.compensated = 0  # mask of axes whose table is applied every tick
        self._unheard_ticks = 0
        self._overload_ticks = 0
        self._stopping: list[int] | None = None
        self._commands: dict[str, Callable[[str, list[str]], Reply]] = {
            "FHELLO": self._hello,
            "FJOB": self._accept,
            "FRUN": self._run,
            "FSTAT": self._stat,
            "FSTOP": self._stop_command,
            "FREAD": self._read,
            "FTABLE": self._table,
            "FTREAD": self._table_back,
            "FCOMP": self._comp,
        }

    @property
    def _running(self) -> Job | None:
        return self._job if self._job is not None and self._job.state == RUNNING else None

    @property
    def moving(self) -> bool:
        """A job is running."""
        return self._running is not None

    def knows(self, command: str) -> bool:
        """Whether this is a command of this application."""
        return command in self._commands

    def obey(self, text: str) -> Reply:
        """Execute one of its commands."""
        command, _, rest = text.partition(" ")
        version, *operands = rest.split(",")
        action = self._commands[command]
        if (command, version) == ("FREAD", "2") and self._settings.reads_while_running:
            action = self._read_so_far
        else:
            require(version == "1", 5170)
        try:
            return action(text, operands)
        except (ValueError, struct.error):
            raise Refused(1012) from None

    def heard_host(self) -> None:
        """The host said something whole: it lives."""
        self._unheard_ticks = 0

    def stop(self, reason: str) -> None:
        """End the running job by deceleration; an alarm or lost servo power ends it at once."""
        job = self._running
        if job is None:
            return
        if reason in ("alarm", "servo off"):
            job.reason = reason
            self._end(job, STOPPED)
        elif self._stopping is None:
            job.reason = reason
            issued = self._axes[job.axis].issued
            speed = job.path[job.done] - job.path[job.done - 1] if 0 < job.done < len(job.path) else 0
            ticks = range(1, STOPPING_TICKS + 1)
            self._stopping = [round(issued + speed * (k - k * k / (2 * STOPPING_TICKS))) for k in ticks]

    def tick(self, dropped: int) -> None:
        """One tick of a running job: latch, then issue the next command."""
        job = self._running
        if job is None:
            return
        axis = self._axes[job.axis]
        self._unheard_ticks += 1
        if self._stopping is None and self._unheard_ticks > job.watchdog_ticks:
            self.stop("watchdog")
        job.samples.append((axis.pulses, axis.speed_tenths, axis.torque_micro))
        self._overload_ticks = self._overload_ticks + 1 if abs(axis.torque_micro) > job.torque_limit_micro else 0
        if self._overload_ticks > 5:
            self.stop("torque")
        job.done += 1
        if self._stopping:
            axis.ask(self._stopping.pop(0))
        elif self._stopping is not None:
            self._end(job, STOPPED)
        elif job.done >= len(job.path):
            self._end(job, FINISHED)
        else:
            self._guide(job, job.floating[job.done])
            job.dropped += axis.ask(job.path[job.done], dropped)

    def compensate(self) -> None:
        """Every tick: the tables' torque on every compensated axis."""
        for number, axis in enumerate(self._axes):
            if not self.compensated >> number & 1 or number not in self._tables:
                continue
            compensator = self._compensators.get(number)
            if compensator is None:
                table, delay_ticks = self._tables[number][1], self._settings.table_delay_ticks
                compensator = self._compensators[number] = Compensator(table, axis.pulses, delay_ticks)
            micro = compensator.torque_micro(axis.pulses, axis.speed_tenths, gravity=axis.floating)
            axis.feed_forward_nm = axis.plate.sign * micro * 1e-6 * axis.plate.gear_ratio

    def _guide(self, job: Job, floating: bool) -> None:
        axis = self._axes[job.axis]
        if floating != axis.floating:
            axis.set_floating(floating)
            self._on_guided(job.axis, floating)

    def _end(self, job: Job, state: int) -> None:
        self._guide(job, False)
        job.state = state
        self._stopping = None
        self._panel.operating = False

    def _asked_for(self, number: int) -> Job:
        if self._job is None or self._job.number != number:
            raise Refused(4040)
        return self._job

    def _hello(self, text: str, operands: list[str]) -> Reply:
        figures = (1, self._settings.tick_us, len(self._axes), MOST_TICKS, 1, self._settings.averaging_ms, 21)
        return data(",".join(map(str, figures)) + ",EMULATED")

    def _accept(self, text: str, operands: list[str]) -> Reply:
        body, _, check = text.rpartition(",")
        require(len(check) == 4 and int(check, 16) == crc16((body + ",").encode("ascii")), 5170)
        require(not self.moving, 2010)
        number, axis_number, start, lowest, highest, step, torque, watchdog = map(int, operands[:8])
        require(0 < number < 65536 and 0 <= axis_number < len(self._axes) and watchdog > 0, 1012)
        path, floating = [start], [False]
        for segment in operands[8:-1]:
            _append_segment(segment, path, floating)
            require(len(path) <= MOST_TICKS, 1013)
        require(len(path) >= 2, 1011)
        plate = self._axes[axis_number].plate
        require(min(path) >= max(lowest, plate.lowest) and max(path) <= min(highest, plate.highest), 1012)
        require(max(abs(b - a) for a, b in pairwise(path)) <= step, 1012)
        self._job = Job(number, axis_number, path, floating, torque, watchdog)
        return DONE

    def _run(self, text: str, operands: list[str]) -> Reply:
        (number,) = map(int, operands)
        job = self._asked_for(number)
        forbidden = self._panel.moving_forbidden()
        require(not forbidden, forbidden)
        require(job.state == ACCEPTED, 2080)
        axis = self._axes[job.axis]
        require(abs(axis.pulses - job.path[0]) <= abs(_START_TOLERANCE * axis.plate.pulses_per_rad), 3040)
        job.state = RUNNING
        self._panel.operating = True
        self._unheard_ticks = self._overload_ticks = 0
        return DONE

    def _stat(self, text: str, operands: list[str]) -> Reply:
        (number,) = map(int, operands)
        job = self._job
        if job is None or job.number != number:
            return data(f"{number},0,0,0,{self._panel.alarm},0,0,0,0")
        velocity_shift, torque_shift = job.shifts() if job.state != RUNNING else (0, 0)
        figures = (
            *(number, job.state, job.done, len(job.path), self._panel.alarm, REASONS[job.reason]),
            *(velocity_shift, torque_shift, job.dropped),
        )
        return data(",".join(map(str, figures)))

    def _stop_command(self, text: str, operands: list[str]) -> Reply:
        self.stop("host")
        return DONE

    def _read(self, text: str, operands: list[str]) -> Reply:
        """FREAD 1: of a job that is over, every block shifted alike."""
        require(not self.moving, 2010)
        return self._blocks(operands, each_shifted=False)

    def _read_so_far(self, text: str, operands: list[str]) -> Reply:
        """FREAD 2: what is there already, also of a running job; every block says how it is shifted."""
        return self._blocks(operands, each_shifted=True)

    def _blocks(self, operands: list[str], *, each_shifted: bool) -> Reply:
        number, first, count = map(int, operands)
        job = self._asked_for(number)
        require(0 <= first < len(job.samples) and count > 0, 1012)
        blocks = []
        shifts = (0, 0) if each_shifted else job.shifts()
        last = min(first + count, len(job.samples))
        for begin in range(first, last, SAMPLES_PER_BLOCK):
            rows = job.samples[begin : min(begin + SAMPLES_PER_BLOCK, last)]
            raw = struct.pack("<HIB", number, begin, len(rows))
            if each_shifted:
                shifts = _shifts(rows)
                raw += bytes(shifts)
            for pulses, speed, torque in rows:
                raw += pulses.to_bytes(4, "little", signed=True)
                raw += (speed >> shifts[0]).to_bytes(3, "little", signed=True)
                raw += (torque >> shifts[1]).to_bytes(3, "little", signed=True)
            raw += crc16(raw).to_bytes(2, "little")
            blocks.append(base64.b64encode(raw).decode("ascii"))
        return data(",".join(blocks))

    def _table(self, text: str, operands: list[str]) -> Reply:
        (coded,) = operands
        raw = base64.b64decode(coded, validate=True)
        require(len(raw) >= 34 and int.from_bytes(raw[-2:], "little") == crc16(raw[:-2]), 5170)
        number, count, ratio, step, stiffness, turn, cosine, sine = struct.unpack_from("<BBHIIIii", raw)
        require(len(raw) == 24 + 4 * count + 2, 1013)
        points = struct.unpack_from(f"<{count}i", raw, 24)
        require(step > 0 and stiffness > 0 and turn > 0 and count >= 2 and points[0] > 0 and ratio <= 10_000, 1012)
        require(number < len(self._axes), 1012)
        table = Table(ratio * 1e-4, float(step), stiffness * 1e-3, float(turn), float(cosine), float(sine), points)
        self._tables[number] = (raw, table)
        self._compensators.pop(number, None)
        return DONE

    def _table_back(self, text: str, operands: list[str]) -> Reply:
        (number,) = map(int, operands)
        require(number in self._tables, 4040)
        return data(base64.b64encode(self._tables[number][0]).decode("ascii"))

    def _comp(self, text: str, operands: list[str]) -> Reply:
        (mask,) = map(int, operands)
        require(all(number in self._tables for number in range(8) if mask >> number & 1), 4040)
        self.compensated = mask
        self._compensators.clear()
        for number, axis in enumerate(self._axes):
            if not mask >> number & 1:
                axis.feed_forward_nm = 0.0
        return DONE


def _append_segment(segment: str, path: list[int], floating: list[bool]) -> None:
    """Commands of one segment, one per tick."""
    kind, *figures = segment.split(":")
    here = path[-1]
    match (kind, *map(int, figures)):
        case ("H" | "G", int(count)):
            made = [here for _ in _ticks(count)]
        case ("L", int(count), int(goal)):
            made = [round(here + (goal - here) * k / count) for k in _ticks(count)]
        case ("M", int(count), int(goal)):
            shares = (k / count for k in _ticks(count))
            made = [round(here + (goal - here) * (10 * u**3 - 15 * u**4 + 6 * u**5)) for u in shares]
        case ("C", int(travel), int(), *_):
            counts = map(int, figures[1:])
            angles = [2 * math.pi * k / count for count in counts for k in _ticks(count)]
            made = [round(here + travel / 2 * (1 - math.cos(angle))) for angle in angles]
        case _:
            raise ValueError(segment)
    path += made
    floating += [kind == "G"] * len(made)


def _ticks(count: int) -> range:
    if not 0 < count <= MOST_TICKS:
        raise ValueError(f"{count} ticks")
    return range(1, count + 1)


def _shifts(samples: Sequence[tuple[int, int, int]]) -> tuple[int, int]:
    """The smallest of velocity and of torque by which all of these fit 24 bits."""
    largest = [max((abs(sample[k]) for sample in samples), default=0) for k in (1, 2)]
    return max(0, largest[0].bit_length() - 23), max(0, largest[1].bit_length() - 23)
