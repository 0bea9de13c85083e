"""The cyclic loop beside canopen's own PDO variables, between two processes, in one run; with an empty loop beside it.

    python benchmarks/cycle.py [--seconds 20] [--blocks 10] [--bound] [--loop JOINTS HZ]

The drives are frames that were packed beforehand: a process that answers every SYNC and computes nothing, so that the
host's own time shows. Host and drives are joined by a local socket. Round trips follow each other without a pause:
write all set-points, SYNC, wait for all reports, read all of them; the drives answer without ever sleeping, on a core
of their own, as hardware does. Ours (on one core), stock canopen's, stock canopen's on one core, and packed frames sent
and received by the socket's own calls take turns in blocks: the last is what wire and drives take where every frame is
a call of the system.
Then the loop that moves real robots (deadline, exchange, supervisor, sample and frame rings) at a rate, and before and
after it a loop that does nothing but wait for its deadlines: what it misses is the computer's. ``--bound`` compares it
instead with itself bound to a single core, by turns. ``--loop 1 1000 --seconds 60`` runs that loop alone.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import math
import multiprocessing
import os
import platform
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import can
import canopen
import numba
import numpy as np
from canopen.objectdictionary import ODVariable

from frictid_drivers.cia402.axis import Axis
from frictid_drivers.cia402.codec import Decoder
from frictid_drivers.cia402.cycle import Cycle
from frictid_drivers.cia402.frame_map import FrameMap, JointFrames
from frictid_drivers.cia402.layout import Layout, NodeWish, plan_layout
from frictid_drivers.cia402.scale import Scale
from frictid_drivers.cia402.settings import read_settings
from frictid_drivers.virtual.channel import socket_path
from frictid_drivers.virtual.rack_process import be_punctual
from frictid_drivers.virtual.socket_bus import CLASSICAL, pack
from frictid_hil.config.provenance import git_revision
from frictid_hil.friction.trajectory import Array
from frictid_hil.plan.mode import Mode
from frictid_hil.plan.setup import RobotSetup
from frictid_hil.protocol.can_load import BitRates
from frictid_hil.protocol.driver import Feedback, JointState, SetPoint, WallClock
from frictid_hil.runner.cycle import CyclicLoop
from frictid_hil.runner.realtime import make_punctual
from frictid_hil.runner.ring import frame_ring, sample_ring
from frictid_hil.runner.scheduler import Recorder
from frictid_hil.runner.supervisor import JointLimits, Supervisor

RATES_HZ, ACTIVE = (250, 500, 1000), (1, 6, 12)
PATIENCE_S = 2.0
ENABLED, CSP = 0x1237, 8
SYNC, HEARTBEAT, OPERATIONAL = 0x80, 0x700, b"\5"
MSG_DONTWAIT = int(socket.MSG_DONTWAIT)
KINDS = {0x6040: 6, 0x607A: 4, 0x60B2: 3, 0x6041: 6, 0x6064: 4, 0x6077: 3, 0x606C: 4}
"""Data types of CANopen: 3 i16, 4 i32, 6 u16."""


def layout_of(active: int, cycle_hz: float) -> Layout:
    """All joints active, as the driver lays them out."""
    names = [str(number) for number in range(active)]
    wishes = [NodeWish(name, number + 1) for number, name in enumerate(names)]
    return plan_layout(
        wishes, names, cycle_hz, sync_counter=True, host_heartbeat_s=0.05, drive_heartbeat_s=0.1,
        rates=BitRates(1_000_000),
    )  # fmt: skip


def answer(channel: str, active: int, cycle_hz: float, *, at_once: bool) -> None:
    """Be the drives: answer SYNC with packed reports, for whoever is on the bus, until this process is killed.

    Args:
        channel: of the bus.
        active: joints.
        cycle_hz: rate.
        at_once: never sleep, as hardware does not; takes a core.
    """
    due = []
    for pdos in layout_of(active, cycle_hz).pdos.values():
        for pdo in pdos:
            if pdo.transmit:
                values = {0x6041: ENABLED, 0x6061: CSP}
                frame = pdo.frame
                packed = (values.get(one.index, 0).to_bytes(one.type.bits // 8, "little") for one in frame.entries)
                due.append((pack(frame.cob_id, b"".join(packed), 0), pdo.every))
    heartbeat_every = max(1, round(0.1 * cycle_hz))
    due += [(pack(HEARTBEAT + number + 1, OPERATIONAL, 0), heartbeat_every) for number in range(active)]
    frames = np.frombuffer(b"".join(frame for frame, _ in due), np.uint8).copy()
    every = np.array([cycles for _, cycles in due])
    heard = np.zeros(CLASSICAL.size, np.uint8)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(str(socket_path(channel)))
    listener.listen(1)
    how = MSG_DONTWAIT if at_once else 0
    _answer_one(-1, heard, heard.ctypes.data, frames.ctypes.data, every, how)  # compiles it
    be_punctual()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    print("ready", flush=True)
    while True:
        member, _ = listener.accept()
        _answer_one(member.fileno(), heard, heard.ctypes.data, frames.ctypes.data, every, how)
        member.close()


def _libc(name: str) -> Any:
    function = getattr(ctypes.CDLL(None), name)
    function.argtypes, function.restype = (
        [ctypes.c_int, ctypes.c_size_t, ctypes.c_size_t, ctypes.c_int],
        ctypes.c_ssize_t,
    )
    return function


_RECEIVE, _SEND = _libc("recv"), _libc("send")


@numba.njit
def _answer_one(fd: int, heard: Any, heard_at: int, frames_at: int, every: Any, how: int) -> None:
    """Until the other side closes."""
    syncs, size = 0, heard.size
    while fd >= 0:
        received = _RECEIVE(fd, heard_at, size, how)
        if received == 0:
            return
        if received == size and heard[0] == SYNC and heard[1] == 0:
            for at in range(every.size):
                if syncs % every[at] == 0:
                    _SEND(fd, frames_at + at * size, size, MSG_DONTWAIT)
            syncs += 1


@contextlib.contextmanager
def drives(active: int, cycle_hz: float, *, at_once: bool = False) -> Iterator[str]:
    """Them, in a process of their own; the name of their channel."""
    channel = f"cycle-{os.getpid()}"
    command = [sys.executable, __file__, "--answer", channel, str(active), str(cycle_hz), str(int(at_once))]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        yield channel
    finally:
        process.kill()
        process.wait()
        socket_path(channel).unlink(missing_ok=True)


class OurDrives:
    """What ``CyclicLoop`` needs of a driver: the cyclic half of ours, on drives that were configured beforehand.

    Args:
        channel: of the drives.
        active: joints.
        cycle_hz: rate.
    """

    def __init__(self, channel: str, active: int, cycle_hz: float) -> None:
        layout = layout_of(active, cycle_hz)
        self.clock: WallClock = LateClock()
        self.bus = can.Bus(interface="frictid", channel=channel)
        self.frames = frame_ring(shared=False)
        scale = Scale(1e-6, 1e-6, 0.01, 10.0, 100.0)
        joints = tuple(
            JointFrames(
                name, number + 1, scale.position_rad, scale.velocity_rad_s, scale.torque_nm,
                reports=tuple(pdo.frame for pdo in pdos if pdo.transmit),
                commands=tuple(pdo.frame for pdo in pdos if not pdo.transmit),
            )
            for number, (name, pdos) in enumerate(layout.pdos.items())
        )  # fmt: skip
        settings, _ = read_settings(RobotSetup("cycle", f"frictid:{channel}", cycle_hz, ()))
        frame_map = FrameMap(joints, window_ns=round(settings.reply_window * 1e9 / cycle_hz))
        decoder = Decoder(frame_map, layout.active)
        axes = [self._axis(joint, scale, at) for joint, at in zip(joints, decoder.feedback, strict=True)]
        recorder = Recorder(sample_ring(), self.frames)
        self._cycle = Cycle(
            self.bus, self.clock, recorder, frame_map, layout, axes, decoder, settings,
            other=lambda *frame: None,
        )  # fmt: skip
        self.exchange = self._cycle.exchange
        for axis in axes:
            axis.enable(Mode.POSITION)

    @staticmethod
    def _axis(joint: JointFrames, scale: Scale, feedback: Feedback) -> Axis:
        return Axis(joint, scale, feedback, max_torque_nm=10.0, standstill_rad_s=0.02, reset_cycles=100)


class BareWire:
    """The same frames by the socket's own calls, neither packed nor read: what wire and drives take."""

    def __init__(self, channel: str, active: int, cycle_hz: float) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.connect(str(socket_path(channel)))
        self._socket.setblocking(False)
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        pdos = [pdo for one in layout_of(active, cycle_hz).pdos.values() for pdo in one]
        self._sent = [pack(pdo.frame.cob_id, bytes(8), 0) for pdo in pdos if not pdo.transmit and pdo.number == 1]
        self._sent.append(pack(SYNC, b"\1", 0))
        self._awaited = {pdo.frame.cob_id for pdo in pdos if pdo.transmit and pdo.every == 1}

    def exchange(self, number: int) -> None:
        """One."""
        for frame in self._sent:
            self._socket.send(frame)
        left = len(self._awaited)
        while left:
            try:
                left -= CLASSICAL.unpack(self._socket.recv(CLASSICAL.size))[0] in self._awaited
            except BlockingIOError:
                self._poll.poll(1e3 * PATIENCE_S)

    def close(self) -> None:
        """Leave the bus."""
        self._socket.close()


class LateClock(WallClock):
    """Keeps how late every wait came back, nanoseconds."""

    def __init__(self) -> None:
        super().__init__()
        self.late_ns: list[int] = []

    def wait_until(self, deadline_ns: int) -> None:
        """As any wall clock."""
        super().wait_until(deadline_ns)
        self.late_ns.append(self.now_ns() - deadline_ns)


class StockDrives:
    """The same exchange by canopen's nodes and PDO variables, and the thread that reads its bus.

    Args:
        channel: of the drives.
        active: joints.
        cycle_hz: rate.
    """

    def __init__(self, channel: str, active: int, cycle_hz: float) -> None:
        self._network: Any = canopen.Network()
        dictionary: Any = canopen.ObjectDictionary()  # type: ignore[no-untyped-call]  # canopen is only partly typed
        for index, kind in KINDS.items():
            variable = ODVariable(f"{index:04X}", index)
            variable.data_type = kind
            dictionary.add_object(variable)
        self._commands: list[tuple[Any, list[Any]]] = []
        self._reports: list[tuple[Any, list[Any]]] = []
        nodes = [self._network.add_node(canopen.RemoteNode(number + 1, dictionary)) for number in range(active)]
        self._network.connect(interface="frictid", channel=channel)
        for node, pdos in zip(nodes, layout_of(active, cycle_hz).pdos.values(), strict=True):
            for pdo in pdos:
                indices = [entry.index for entry in pdo.frame.entries]
                if not set(indices) <= set(KINDS):
                    continue
                maps = canopen.pdo.base.PdoMap(node.tpdo if pdo.transmit else node.rpdo, None, None)  # type: ignore[no-untyped-call]
                maps.cob_id = pdo.frame.cob_id
                variables = [maps.add_variable(index) for index in indices]
                if pdo.transmit:
                    self._network.subscribe(pdo.frame.cob_id, maps.on_message)
                    self._reports.append((maps, variables))
                else:
                    self._commands.append((maps, variables))

    def exchange(self, number: int) -> list[float]:
        """One: write, SYNC, wait, read."""
        for command, variables in self._commands:
            for variable in variables:
                variable.raw = number & 0x7F
            command.transmit()
        for report, _ in self._reports:
            report.is_received = False
        self._network.sync.transmit()
        end_s = time.monotonic() + PATIENCE_S
        for report, _ in self._reports:
            with report.receive_condition:
                while not report.is_received and report.receive_condition.wait(end_s - time.monotonic()):
                    pass
            if not report.is_received:
                raise TimeoutError("no report")
        return [variable.raw for _, variables in self._reports for variable in variables]

    def close(self) -> None:
        """Leave the bus."""
        self._network.disconnect()


def round_trips_us(exchange: Callable[[int], object], count: int) -> Array:
    """How long each of so many took; the first tenth warms up."""
    taken = np.zeros(count)
    for number in range(count):
        began_ns = time.perf_counter_ns()
        exchange(number)
        taken[number] = (time.perf_counter_ns() - began_ns) * 1e-3
    return taken[count // 10 :]


def compared_us(active: int, blocks: int, count: int) -> tuple[list[float], ...]:
    """Median round trip of ours, of stock canopen's, of stock canopen's on our core, and of the bare wire, by turns.

    In a process of its own, with real-time scheduling for all of them.
    """
    every_core = os.sched_getaffinity(0)
    make_punctual()
    one_core = {max(every_core)}
    ours, stock, kept, wire = list[float](), list[float](), list[float](), list[float]()
    with drives(active, 500.0, at_once=True) as channel:
        for _ in range(blocks):
            os.sched_setaffinity(0, one_core)
            drive = OurDrives(channel, active, 500.0)
            set_points = [SetPoint() for _ in range(active)]

            def exchange(number: int, drive: OurDrives = drive, points: list[SetPoint] = set_points) -> None:
                for point in points:
                    point.position_rad = 1e-6 * (number & 0x7F)
                drive.exchange(points)

            ours.append(float(np.median(round_trips_us(exchange, count))))
            drive.bus.shutdown()
            for kind, cores, found in (
                (StockDrives, every_core, stock),
                (StockDrives, one_core, kept),
                (BareWire, one_core, wire),
            ):
                os.sched_setaffinity(0, cores)
                other = kind(channel, active, 500.0)
                found.append(float(np.median(round_trips_us(other.exchange, count))))
                other.close()
    return ours, stock, kept, wire


@dataclass(frozen=True, slots=True)
class Kept:
    """How a loop kept its deadlines.

    Attributes:
        late_us: p50, p99, p99.9 and the latest.
        missed: deadlines that passed without a cycle.
        cycles: made.
        share: of one processor.
    """

    late_us: tuple[float, float, float, float]
    missed: int
    cycles: int
    share: float

    def __str__(self) -> str:
        late = " / ".join(f"{value:.0f}" for value in self.late_us)
        return f"{late} | {self.missed} of {self.cycles + self.missed} | {100 * self.share:.1f}"


def judged(late_ns: Sequence[int], missed: int, spent_s: float, lasted_s: float) -> Kept:
    """Figures of a loop."""
    p50, p99, p999, worst = (float(late) for late in np.percentile(np.asarray(late_ns) * 1e-3, (50, 99, 99.9, 100)))
    return Kept((p50, p99, p999, worst), missed, len(late_ns), spent_s / lasted_s)


def empty_loop(cycle_hz: float, cycles: int) -> Kept:
    """Deadlines, and nothing to do."""
    clock, period_ns = LateClock(), round(1e9 / cycle_hz)
    deadline_ns, missed = clock.now_ns() + period_ns, 0
    began, spent = time.monotonic(), time.process_time()
    for _ in range(cycles):
        clock.wait_until(deadline_ns)
        skipped = clock.late_ns[-1] // period_ns
        missed += skipped
        deadline_ns += (1 + skipped) * period_ns
    return judged(clock.late_ns, missed, time.process_time() - spent, time.monotonic() - began)


class _NoStop:
    level = 0


class _Swinging:
    """A joint that swings; each cycle has another set-point."""

    def __init__(self, cycles: int, cycle_hz: float) -> None:
        self._left, self._step = cycles, 2 * math.pi / cycle_hz
        self._cycle = 0

    def update(self, feedback: Feedback, set_point: SetPoint) -> bool:
        """The next one."""
        self._cycle += 1
        set_point.position_rad = 0.005 * math.sin(self._cycle * self._step)
        return self._cycle <= self._left


def our_loop(channel: str, active: int, cycle_hz: float, cycles: int) -> Kept:
    """The loop that moves robots, whole."""
    drive: Any = OurDrives(channel, active, cycle_hz)  # the part of a driver that the loop calls
    limits = [JointLimits(-1.0, 1.0, 10.0, 100.0, silence_s=1.0) for _ in range(active)]
    names = [str(number) for number in range(active)]
    supervisor = Supervisor(names, limits, cycle_hz)
    samples = sample_ring(shared=False)
    never: Any = _NoStop()
    loop: Any = CyclicLoop(drive, supervisor, samples, cycle_hz, never, joints=active)
    for _ in range(round(cycle_hz)):  # on a busy computer the drives may need a while
        feedback = loop.cycle(supervised=False)
        if all(report.state is JointState.ENABLED for report in feedback):
            break
    supervisor.watch(tuple(range(active)), Mode.POSITION, {})
    clock: Any = drive.clock
    clock.late_ns.clear()
    missed, began, spent = loop.count.missed, time.monotonic(), time.process_time()
    loop.run({number: _Swinging(cycles, cycle_hz) for number in range(active)})
    kept = judged(clock.late_ns, loop.count.missed - missed, time.process_time() - spent, time.monotonic() - began)
    drive.bus.shutdown()
    return kept


def timed(active: int, cycle_hz: float, seconds: float) -> tuple[Kept, Kept, Kept]:
    """An empty loop, ours, and an empty loop again; in a process of its own."""
    make_punctual()
    cycles = round(seconds * cycle_hz)
    with drives(active, cycle_hz) as channel:
        return (
            empty_loop(cycle_hz, cycles // 2),
            our_loop(channel, active, cycle_hz, cycles),
            empty_loop(cycle_hz, cycles // 2),
        )


def bound_and_free(active: int, cycle_hz: float, seconds: float, blocks: int) -> tuple[list[Kept], list[Kept]]:
    """Our loop on one core and on any, by turns; in a process of its own."""
    every_core = os.sched_getaffinity(0)
    make_punctual()
    bound, free = list[Kept](), list[Kept]()
    for number in range(2 * blocks):
        kept, cores = (bound, {max(every_core)}) if number % 4 in (0, 3) else (free, every_core)
        os.sched_setaffinity(0, every_core)
        with drives(active, cycle_hz) as channel:
            os.sched_setaffinity(0, cores)
            kept.append(our_loop(channel, active, cycle_hz, round(seconds * cycle_hz)))
    return bound, free


def compare_bound_and_free(seconds: float, blocks: int) -> None:
    """The third table: lateness bound over lateness free."""
    print("| Joints | Rate, Hz | Bound / free: p50 | p99 | p99.9 | Missed, bound | Missed, free | Cycles of each |")
    print("|---|---|---|---|---|---|---|---|")
    for active, cycle_hz in ((1, 1000), (6, 250)):
        bound, free = alone(bound_and_free, active, float(cycle_hz), seconds, blocks)
        late = np.array([one.late_us for one in bound]) / np.array([one.late_us for one in free])
        ratios = (f"{np.median(one):.1f} ({one.min():.1f} .. {one.max():.1f})" for one in late.T[:3])
        missed = (str(sum(one.missed for one in kind)) for kind in (bound, free))
        cycles = sum(one.cycles + one.missed for one in free)
        print(f"| {active} | {cycle_hz} | {' | '.join(ratios)} | {' | '.join(missed)} | {cycles} |", flush=True)


def alone(function: Callable[..., Any], *arguments: object) -> Any:
    """In a process of its own, because what makes a process punctual cannot be undone."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


LOOP_HEAD = (
    "| Joints | Rate, Hz | Bus load, % | Late by, us: p50 / p99 / p99.9 / most | Missed | Share of a core, % |\n"
    "|---|---|---|---|---|---|"
)


def print_loop(active: int, cycle_hz: float, seconds: float) -> None:
    """Our loop, and the empty one before and after it."""
    found = layout_of(active, cycle_hz).load()
    before, loop, after = alone(timed, active, float(cycle_hz), seconds)
    fits = "" if found.average_percent <= 80.0 else " (no wire carries this)"
    print(f"| {active} | {cycle_hz} | {found.average_percent:.0f}{fits} | {loop} |")
    print(f"| empty, before | {cycle_hz} | - | {before} |\n| empty, after | {cycle_hz} | - | {after} |", flush=True)


def main() -> None:
    """Both tables."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--seconds", type=float, default=20.0, help="of each loop")
    asked.add_argument("--blocks", type=int, default=10, help="of round trips")
    asked.add_argument("--bound", action="store_true", help="compare our loop on one core with itself on any")
    asked.add_argument("--loop", nargs=2, type=int, metavar=("JOINTS", "HZ"), help="this loop alone")
    asked.add_argument("--answer", nargs=4, metavar=("CHANNEL", "ACTIVE", "HZ", "AT_ONCE"), help=argparse.SUPPRESS)
    options = asked.parse_args()
    if options.answer:
        channel, active, cycle_hz, at_once = options.answer
        answer(channel, int(active), float(cycle_hz), at_once=at_once == "1")
        return
    load = " ".join(f"{one:.1f}" for one in os.getloadavg())
    print(f"commit {git_revision()[:8]}, Python {platform.python_version()}, {os.cpu_count()} cores, load {load}\n")
    if options.bound:
        compare_bound_and_free(options.seconds, options.blocks)
        return
    if options.loop:
        print(LOOP_HEAD)
        active, cycle_hz = options.loop
        print_loop(active, cycle_hz, options.seconds)
        return
    print("| Joints | Ours, us | Stock canopen, us | On one core, us | Wire, us | Stock / ours | On one core / ours |")
    print("|---|---|---|---|---|---|---|")
    for active in ACTIVE:
        ours, stock, kept, wire = (np.array(one) for one in alone(compared_us, active, options.blocks, 2000))
        times = " | ".join(f"{np.median(one):.0f}" for one in (ours, stock, kept, wire))
        ratios = (f"{np.median(one):.1f} ({one.min():.1f} .. {one.max():.1f})" for one in (stock / ours, kept / ours))
        print(f"| {active} | {times} | {' | '.join(ratios)} |", flush=True)
    print("\n" + LOOP_HEAD)
    for active in ACTIVE:
        for cycle_hz in RATES_HZ:
            print_loop(active, cycle_hz, options.seconds)


if __name__ == "__main__":
    main()
