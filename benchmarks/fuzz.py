"""Spoilt input for everything that reads, files, frames and bytes of a line: our own refusal or an answer, no more.

    python benchmarks/fuzz.py [--decoders 1000000] [--files N] [--minutes 60] [--seed 1] [NAME...]

Every kind begins with input that is good, and spoils it: bits flipped, pieces cut, dropped, doubled, exchanged with
another good one's, numbers and words put in that readers trip over, lengths made huge; for packed formats within the
packing, too. The first of them are traced, and whatever comes to a line of ours that none came to before is spoilt
further, as is some of what could be read. A decoder gets so many inputs; the formats of files share the minutes, and
get so many at most. An input is a find where anything but a ``FrictidError`` comes out, where it takes longer than
10 s, or more than 1 GB; or where the process dies. Finds are kept in the folder ``fuzz-finds`` and printed.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import gzip
import hashlib
import io
import itertools
import json
import multiprocessing
import queue
import random
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import can
import can.io.player
import numpy as np

from frictid_drivers.cia402.codec import CommandDecoder, Decoder
from frictid_drivers.cia402.frame_map import FrameMap
from frictid_drivers.cia402.network import Node, SdoDrive, Wire
from frictid_drivers.mit.families import FAMILIES, Motor, Parameter
from frictid_drivers.mit.models import MODELS
from frictid_drivers.motoman.bsc import BscLink, Message, encode_blocks
from frictid_drivers.motoman.stream_frames import FrameReader, FrameType, encode_frame
from frictid_drivers.servos.packets import Dynamixel, Feetech
from frictid_hil.config.columns import load_columns
from frictid_hil.config.nominal import load_nominal
from frictid_hil.config.profile import load_profile
from frictid_hil.config.robot import load_robot
from frictid_hil.config.search import shipped_dir
from frictid_hil.errors import FrictidError
from frictid_hil.recording.bus_log import BusLogWriter, read_frames
from frictid_hil.recording.csv import write_csv
from frictid_hil.recording.mcap import write_samples
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Samples

LONGEST_S, MOST_BYTES = 10, 1 << 30
_LONGEST_OF_A_WIRE, _LONGEST_OF_A_FILE = 120, 20_000
WORDS = (
    b"nan", b"-inf", b"1e999", b"-0", b"0", b"\xff\xfe", b"\0" * 8, b"\xff" * 8, b"[" * 300, b"{a: " * 200, b"&a [*a]",
    b"<<: *a", b"!!python/object:os.system ", b"../..", b"'", b'"', b"\n", b":", b"- ", b",", b"\x7f\xff\xff\xff",
    b"\x80\0\0\0", b"9" * 400, "\u2028\u0660".encode(), b"<a>" * 100, b"true", b"null", b"1.5deg", b"2024-01-01",
)  # fmt: skip


def spoilt(data: bytes, dice: random.Random, other: bytes = b"") -> bytes:
    """The same after one to six edits, each somewhere in it."""
    for _ in range(dice.choice((1, 1, 2, 3, 6))):
        at = dice.randrange(len(data) + 1)
        edit = dice.randrange(8)
        if edit == 0 and at < len(data):
            data = data[:at] + bytes([data[at] ^ 1 << dice.randrange(8)]) + data[at + 1 :]
        elif edit == 1:
            data = data[:at]
        elif edit == 2:
            data = data[:at] + data[at + 1 + dice.randrange(64) :]
        elif edit == 3:
            data = data[:at] + data[max(0, at - dice.randrange(256)) : at] + data[at:]
        elif edit == 4:
            size = dice.choice((1, 2, 4, 8))
            number = dice.choice((0, 1, -1, 0x7F, 1 << 31, (1 << 63) - 1, dice.getrandbits(64))) & (1 << 8 * size) - 1
            data = data[:at] + number.to_bytes(size, dice.choice(("little", "big"))) + data[at + size :]
        elif edit == 5:
            data = data[:at] + dice.choice(WORDS) + data[at + dice.choice((0, 0, 1, 4, 8)) :]
        elif edit == 6 and other:
            start = dice.randrange(len(other) + 1)
            data = data[:at] + other[start : start + dice.randrange(200)] + data[at:]
        elif edit == 7 and at < len(data):
            data = data[:at] + bytes([dice.randrange(256)]) + data[at + 1 :]
    return data


Spoil = Callable[[bytes, random.Random, bytes], bytes]


def within_gzip(data: bytes, dice: random.Random, other: bytes) -> bytes:
    """Mostly what is packed, sometimes the packing."""
    with contextlib.suppress(OSError, EOFError, zlib.error):
        if dice.random() > 0.2:
            return gzip.compress(spoilt(gzip.decompress(data), dice), 1)
    return spoilt(data, dice, other)


def within_zip(data: bytes, dice: random.Random, other: bytes) -> bytes:
    """Mostly one member of an archive, sometimes the archive."""
    members: dict[str, bytes] = {}
    # The standard library raises ten kinds of errors for a spoilt archive.
    with contextlib.suppress(Exception), zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    if not members or dice.random() < 0.3:
        return spoilt(data, dice, other)
    chosen = dice.choice(list(members))
    members[chosen] = spoilt(members[chosen], dice)
    told = io.BytesIO()
    with zipfile.ZipFile(told, "w", dice.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return told.getvalue()


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of input.

    Attributes:
        seeds: that are good.
        use: reads one.
        spoil: makes it bad.
        decoder: cheap: counted in inputs, not in minutes.
    """

    seeds: tuple[bytes, ...]
    use: Callable[[bytes], object]
    spoil: Spoil = spoilt
    decoder: bool = False


def samples() -> list[Samples]:
    """A short recording of two joints."""
    time_ns = np.arange(60, dtype=np.int64) * 5_000_000
    wave = np.sin(time_ns * 1e-8)
    return [
        Samples(name, time_ns, wave, velocity_rad_s=wave, torque_nm=2 * wave, position_command_rad=wave)
        for name in ("1", "2")
    ]


def columns() -> dict[str, Any]:
    """Arrays by name, as other programs write them."""
    one = samples()[0]
    return {"time_s": one.time_ns * 1e-9, "position_rad": one.position_rad, "torque_nm": one.torque_nm}


def written(write: Callable[[Path], object], name: str) -> bytes:
    """What a writer makes."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


def opened(name: str, reader: Callable[[Path], object]) -> Callable[[bytes], object]:
    """Reads bytes as a file of that name."""
    place: list[tempfile.TemporaryDirectory[str]] = []

    def use(data: bytes) -> object:
        if not place:
            place.append(tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
        path = Path(place[0].name) / name
        path.write_bytes(data)
        return reader(path)

    return use


# -- files ------------------------------------------------------------------------------------------------------------


def of_mat() -> bytes:
    """A MATLAB 5 file by hand: one compressed matrix among plain ones."""

    def element(kind: int, data: bytes) -> bytes:
        return struct.pack("<II", kind, len(data)) + data + bytes(-len(data) % 8)

    def matrix(name: bytes) -> bytes:
        inside = element(6, struct.pack("<II", 6, 0)) + element(5, struct.pack("<ii", 40, 1)) + element(1, name)
        return element(14, inside + element(9, np.linspace(0.0, 1.0, 40).tobytes()))

    packed = zlib.compress(matrix(b"velocity_rad_s"))
    head = b"MATLAB 5.0".ljust(116) + bytes(8) + b"\0\x01IM"
    plain = b"".join(matrix(name) for name in (b"time_s", b"position_rad", b"torque_nm"))
    return head + plain + struct.pack("<II", 15, len(packed)) + packed


def of_bus_log(name: str) -> bytes:
    """Frames as a log of this kind."""

    def write(path: Path) -> None:
        if name.endswith(".blf"):
            with BusLogWriter(path) as log:
                for n in range(40):
                    log.frame(n * 1_000_000, 0x181 + n % 3, bytes([n] * 8), sent=n % 2 == 0)
            return
        with can.Logger(str(path)) as logger:
            for n in range(40):
                logger(
                    can.Message(timestamp=n * 1e-3, arbitration_id=0x181 + n % 3, data=[n] * 8, is_extended_id=False)
                )

    return written(write, name)


def of_npz() -> bytes:
    """Arrays of numpy."""
    told = io.BytesIO()
    np.savez_compressed(told, **columns())
    return told.getvalue()


def of_hdf5() -> bytes:
    """The same in HDF5."""
    import h5py

    def write(path: Path) -> None:
        with h5py.File(path, "w") as file:
            for name, values in columns().items():
                file.create_dataset(name, data=values, compression="gzip")

    return written(write, "a.h5")


def of_parquet() -> bytes:
    """The same in parquet."""
    import pyarrow
    import pyarrow.parquet

    table = pyarrow.table(columns())
    return written(lambda path: pyarrow.parquet.write_table(table, path), "a.parquet")


def of_bag() -> bytes:
    """Joint states in a bag of ROS 1."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS1_NOETIC), "sensor_msgs/msg/JointState"
    types: Any = store.types

    def write(path: Path) -> None:
        with Writer(path) as bag:
            topic = bag.add_connection("/joint_states", kind, typestore=store)
            for n in range(40):
                stamp = types["builtin_interfaces/msg/Time"](1000, n * 10_000_000)
                header, figures = types["std_msgs/msg/Header"](n, stamp, "base"), np.array([0.01 * n])
                message = types[kind](header, ["elbow"], figures, figures, figures)
                bag.write(topic, 10**12 + n * 10_000_000, store.serialize_ros1(message, kind))

    return written(write, "log.bag")


def of_bam() -> bytes:
    """A recording of BAM."""
    entries = [
        {"timestamp": 0.01 * n, "position": 0.01 * n, "speed": 1.0, "load": 0.1, "goal_position": 0.0}
        for n in range(30)
    ]
    return json.dumps({"motor": "m", "mass": 1.0, "entries": entries}).encode()


ROBOT = b"""schema: frictid.robot/1
extends: hp3j.yaml
name: x
procedure: {amplitude_rad: 20deg, velocity_rad_s: 115deg/s, cycles: 3}
joints: {'0': null, '1': {max_torque_nm: 9, simulated: {friction: {coulomb_nm: 3}}}}
"""
NOMINAL = b"""schema: frictid.nominal/1
joint: {name: '1', inertia_kg_m2: 0.5}
friction: {coulomb_nm: 3.0, viscous_nm_s_per_rad: 0.4}
tolerance: {inertia_kg_m2: 0.1}
"""
COLUMNS = b"""schema: frictid.columns/1
name: test
time: {column: t, unit: ms}
joints:
  "1":
    position: {column: q, unit: deg}
    torque: {column: i, unit: mA, torque_constant_nm_per_a: 0.05, gear_ratio: 100}
"""
MJCF = b"""<mujoco model="arm"><compiler angle="radian"/><worldbody><body name="link"><joint name="elbow" type="hinge"
axis="0 1 0" damping="0.5" frictionloss="1" armature="0.1" range="-1 1"/><geom type="capsule" size="0.05"
fromto="0 0 0 0 0 0.4" mass="2"/></body></worldbody><actuator><position joint="elbow" kp="50"/></actuator></mujoco>"""
URDF = b"""<robot name="arm"><link name="base"/><link name="link"><inertial><mass value="2"/><inertia ixx="0.1"
iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="elbow" type="revolute"><parent link="base"/>
<child link="link"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="2"/></joint></robot>"""


def _model(path: Path) -> object:
    from frictid_hil.simulation.robot_model import RobotModel

    return RobotModel.load(path)


def files() -> dict[str, Callable[[], Kind]]:
    """Every format of files that is read."""
    csv = functools.partial(written, lambda path: write_csv(path, samples()[0]), "a.csv")
    return {
        "csv": lambda: Kind((csv(), b"time_s;position_rad;torque_nm\n0,0;1,5;2\n0,1;2,5;2\n"), opened("a.csv", read)),
        "csv.gz": lambda: Kind((gzip.compress(csv()),), opened("a.csv.gz", read), within_gzip),
        "mcap": lambda: Kind((written(lambda path: write_samples(path, samples()), "a.mcap"),), opened("a.mcap", read)),
        "mat": lambda: Kind((of_mat(),), opened("a.mat", read)),
        "blf": lambda: Kind((of_bus_log("a.blf"),), opened("a.blf", read_frames)),
        "asc": lambda: Kind((of_bus_log("a.asc"),), opened("a.asc", read_frames)),
        "candump": lambda: Kind((of_bus_log("a.log"),), opened("a.log", read_frames)),
        "trc": lambda: Kind((of_bus_log("a.trc"),), opened("a.trc", read_frames)),
        "npz": lambda: Kind((of_npz(),), opened("a.npz", read), within_zip),
        "hdf5": lambda: Kind((of_hdf5(),), opened("a.h5", read)),
        "parquet": lambda: Kind((of_parquet(),), opened("a.parquet", read)),
        "bag": lambda: Kind((of_bag(),), opened("a.bag", read)),
        "bam": lambda: Kind((of_bam(),), opened("a.json", read)),
        "robot": lambda: Kind((ROBOT, (shipped_dir() / "mit-bench.yaml").read_bytes()), opened("r.yaml", load_robot)),
        "nominal": lambda: Kind((NOMINAL,), opened("nominal.yaml", functools.partial(load_nominal, logs=False))),
        "columns": lambda: Kind((COLUMNS,), opened("map.yaml", load_columns)),
        "profile": lambda: Kind((profile(),), opened("profile.yaml", load_profile)),
        "mjcf": lambda: Kind((MJCF,), opened("arm.xml", _model)),
        "urdf": lambda: Kind((URDF,), opened("arm.urdf", _model)),
    }


def profile() -> bytes:
    """A friction profile as it is written."""
    from frictid_hil.config.profile import Estimate, FrictionProfile, JointProfile
    from frictid_hil.config.provenance import Provenance

    joint = JointProfile(
        method="aligned", velocity_rad_s=(0.5, 1.0, 1.5), torque_nm=(3.0, 3.2, 3.4),
        torque_interval_nm=((2.9, 3.1), (3.1, 3.3), (3.3, 3.5)),
        coulomb_nm=Estimate(value=3.0, low=2.9, high=3.1),
    )  # fmt: skip
    whole = FrictionProfile(robot="x", joints={"1": joint}, provenance=Provenance.now())
    return written(lambda path: whole.save(path), "profile.yaml")


# -- frames and bytes -------------------------------------------------------------------------------------------------

FRAMES = FrameMap.from_mapping(
    {
        "schema": "frictid.frames/1",
        "joints": {
            "0": {
                "node": 1,
                "position_rad_per_unit": 1e-6,
                "velocity_rad_s_per_unit": 1e-6,
                "torque_nm_per_unit": 0.1,
                "reports": [
                    {"cob_id": 0x181, "objects": ["6041:00 u16", "6064:00 i32", "6077:00 i16"]},
                    {"cob_id": 0x281, "objects": ["606C:00 i32"]},
                    {"cob_id": 0x381, "objects": ["6061:00 i8", "603F:00 u16"]},
                ],
                "commands": [{"cob_id": 0x201, "objects": ["6040:00 u16", "607A:00 i32", "60B2:00 i16"]}],
            }
        },
    }
)
IDS = (0x181, 0x281, 0x381, 0x201, 0x81, 0x701, 0x80, 0)


def framed(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Bytes as frames: one that chooses the identifier, one with the length, then the data."""
    at = 0
    while at + 2 <= len(data):
        size = data[at + 1] % 9
        yield IDS[data[at] % len(IDS)], data[at + 2 : at + 2 + size]
        at += 2 + size


def frames(*chosen: tuple[int, bytes]) -> bytes:
    """The other way round."""
    return b"".join(bytes([IDS.index(can_id), len(data)]) + data for can_id, data in chosen)


def pdo(data: bytes) -> object:
    """Reports, commands, emergencies and heartbeats, row by row."""
    decoder, commands = Decoder(FRAMES, ["0"]), CommandDecoder(FRAMES)
    for row, (can_id, content) in enumerate(framed(data)):
        decoder.begin(row)
        decoder.feed(row, can_id, content)
        commands.feed(can_id, content)
        decoder.finish()
    return decoder.feedback


class _Answers(can.BusABC):
    """Answers requests with what it was given, one after the other."""

    def __init__(self) -> None:
        super().__init__(channel="")
        self.left: list[bytes] = []
        self._asked = False

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self._asked = True

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if not (self._asked and self.left):
            return None, True
        self._asked = False
        return can.Message(arbitration_id=0x581, data=self.left.pop(0), is_extended_id=False), True


@functools.cache
def _sdo_drive() -> tuple[_Answers, SdoDrive]:
    import canopen

    bus = _Answers()
    node = Node(1, canopen.ObjectDictionary())  # type: ignore[no-untyped-call]  # canopen is only partly typed
    Wire(bus, None, lambda: 0).add_node(node)
    return bus, SdoDrive(node, "0", 0.0)


def sdo(data: bytes) -> object:
    """Answers to an upload and to a download."""
    bus, drive = _sdo_drive()
    bus.left = [data[at + 1 : at + 1 + data[at] % 9] for at in range(0, len(data), 9)]
    for action in (lambda: drive.upload(0x1008, 0), lambda: drive.download(0x607A, 0, b"123456789")):
        with contextlib.suppress(FrictidError):
            action()
    return None


def mit(data: bytes) -> object:
    """Answers, commands and parameters of every family."""
    can_id = int.from_bytes(data[:4], "little")
    for family in FAMILIES.values():
        for name in ("DM-J4310", "RS00"):
            motor = Motor(1, 0x11, MODELS[name].ranges)
            family.answered(motor, can_id, data[4:])
            family.commanded(motor, can_id, data[4:])
            family.told(motor, Parameter(9), can_id, data[4:])
    return None


def bsc(data: bytes) -> object:
    """A conversation by blocks, time going on now and then."""
    link, now_s = BscLink(), 0.0
    link.send(Message("01,000", "RSTATS"), now_s)
    for at in range(0, len(data), 16):
        link.receive(data[at : at + 16], now_s)
        now_s += 0.01
        for _ in range(20):
            if link.deadline_s is None or link.deadline_s > now_s:
                break
            link.advance(link.deadline_s)
        link.take_events()
        link.take_output()
    return link


def stream(data: bytes) -> object:
    """Frames of the streaming layer."""
    return FrameReader().take(data)


def servos(data: bytes) -> object:
    """Packets of both makers."""
    return [
        list(wire.parse(bytearray(data), answers=answers))
        for wire in (Feetech(), Dynamixel())
        for answers in (False, True)
    ]


def decoders() -> dict[str, Callable[[], Kind]]:
    """Everything that takes apart what comes over a wire."""
    report = frames((0x181, bytes(8)), (0x281, bytes(4)), (0x381, b"\x08\0\0"), (0x701, b"\5"), (0x80, b""))
    alarm = frames((0x81, b"\x30\x81\0\0\0\0\0\0"), (0x201, bytes(8)), (0x181, bytes(3)), (0x701, b"\0"))
    expedited, segmented = (
        bytes.fromhex("084308100001000000"),
        bytes.fromhex("0841081000090000000800414243444546470803484900000000"),
    )
    written_ok, aborted = bytes.fromhex("086000000000000000"), bytes.fromhex("088008100000000206")
    blocks = encode_blocks(Message("90,000", "2010"))
    talk = b"\x05" + blocks[0] + b"\x04\x10\x30\x10\x31"
    packets = (Feetech().answer(1, 0, b"\1\2\3\4"), Dynamixel().answer(1, 0, b"\1\2\3\4"))
    streamed = tuple(encode_frame(kind, 1, bytes(12)) for kind in FrameType)
    return {
        "pdo": lambda: Kind((report, alarm), pdo, decoder=True),
        "sdo": lambda: Kind((expedited + written_ok, segmented, aborted + written_ok), sdo, decoder=True),
        "mit": lambda: Kind(
            (struct.pack("<I", 0x11) + bytes(8), struct.pack("<I", 0x0280_01FD) + bytes(8)), mit, decoder=True
        ),
        "bsc": lambda: Kind((talk, b"\x10\x30\x10\x31" + talk), bsc, decoder=True),
        "stream": lambda: Kind((b"".join(streamed), *streamed), stream, decoder=True),
        "servos": lambda: Kind(packets, servos, decoder=True),
    }


def kinds() -> dict[str, Callable[[], Kind]]:
    """All of them."""
    return {**decoders(), **files()}


# -- running ----------------------------------------------------------------------------------------------------------


class TooSlow(BaseException):
    """No reader can mistake it for an error of the file."""


def _too_slow(number: int, frame: object) -> None:
    raise TooSlow(f"longer than {LONGEST_S} s")


@dataclass(slots=True)
class Found:
    """What a kind of input came to.

    Attributes:
        name: of the kind.
        inputs: how many.
        refused: of them, with our own error.
        lasted_s: all of them.
        slowest_s: the slowest.
        grew_mb: memory of the process, from the first input to its peak.
        finds: what went wrong, by its last line, with the first input that did it.
    """

    name: str
    inputs: int = 0
    refused: int = 0
    lasted_s: float = 0.0
    slowest_s: float = 0.0
    grew_mb: float = 0.0
    finds: dict[str, bytes] = field(default_factory=dict)


def one(kind: Kind, data: bytes, found: Found) -> None:
    """Use one input, within its time."""
    began = time.monotonic()
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
    try:
        kind.use(data)
    except FrictidError as error:
        assert str(error)
        found.refused += 1
    except (Exception, TooSlow, RecursionError) as error:
        where = traceback.extract_tb(error.__traceback__)
        ours = next((at for at in reversed(where) if "frictid" in at.filename), where[-1])
        told = f"{type(error).__name__}: {str(error)[:120]} at {Path(ours.filename).name}:{ours.lineno}"
        found.finds.setdefault(told, data)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    found.slowest_s = max(found.slowest_s, time.monotonic() - began)
    found.inputs += 1


Line = tuple[str, int]
TRACED, KEPT = 5000, 200
"""Inputs that are traced, which takes ten times as long; inputs that could be read and are spoilt further, at most."""


@contextlib.contextmanager
def traced(lines: set[Line]) -> Iterator[None]:
    """Adds the lines of ours that are come to."""

    def here(frame: Any, event: str, _: object) -> Any:
        if event == "call":
            return here if "frictid" in frame.f_code.co_filename else None
        lines.add((frame.f_code.co_filename, frame.f_lineno))
        return here

    before = sys.gettrace()
    sys.settrace(here)
    try:
        yield
    finally:
        sys.settrace(before)


def tried(
    name: str, *, inputs: int = sys.maxsize, lasts_s: float = float("inf"), seed: int = 1, last: Path | None = None
) -> Found:
    """Spoil and use input of a kind until either bound.

    Args:
        name: of the kind.
        inputs: at most so many.
        lasts_s: at most so long.
        seed: of the dice.
        last: file that holds the present input, for a process that dies of it.
    """
    kind, dice, found = kinds()[name](), random.Random(f"{name} {seed}"), Found(name)
    most = _LONGEST_OF_A_WIRE if kind.decoder else _LONGEST_OF_A_FILE
    before = signal.signal(signal.SIGALRM, _too_slow)
    # python-can looks through all installed packages for readers, for every log again: 20 times what reading takes.
    no_search = mock.patch.object(can.io.player, "_update_reader_plugins")
    no_search.start()
    try:
        for data in kind.seeds:
            one(kind, data, found)
        peak_kb, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
        good, lines = list(kind.seeds), set[Line]()
        while found.inputs < inputs and time.monotonic() - began < lasts_s:
            data, refused, known = kind.spoil(dice.choice(good), dice, dice.choice(good)), found.refused, len(lines)
            if last is not None:
                last.write_bytes(data)
            with traced(lines) if found.inputs < min(TRACED, inputs // 4) else contextlib.nullcontext():
                one(kind, data, found)
            # What was spoilt and still read leads further than what was refused at its head.
            further = len(lines) > known or (found.refused == refused and len(good) < KEPT and dice.random() < 0.1)
            if further and len(data) < most:
                good.append(data)
    finally:
        no_search.stop()
        signal.signal(signal.SIGALRM, before)
    found.lasted_s = time.monotonic() - began
    found.grew_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak_kb) / 1024
    return found


def _child(answer: Any, name: str, inputs: int, lasts_s: float, seed: int, last: Path) -> None:
    kinds()[name]()  # loads the libraries before memory is bounded
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + 3 * MOST_BYTES, size + 3 * MOST_BYTES))
    answer.put(tried(name, inputs=inputs, lasts_s=lasts_s, seed=seed, last=last))


def apart(name: str, *, inputs: int, lasts_s: float, seed: int) -> Found:
    """The same in a process of its own, which may die of it; then another goes on with other dice."""
    whole, context = Found(name), multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        last = Path(folder) / "last"
        for attempt in itertools.count():
            answer = context.Queue()
            began = time.monotonic()
            child = context.Process(target=_child, args=(answer, name, inputs, lasts_s, seed + 1000 * attempt, last))
            child.start()
            part = None
            while part is None and (child.is_alive() or not answer.empty()):
                try:
                    part = answer.get(timeout=1.0)
                except queue.Empty:
                    continue
            child.join()
            if isinstance(part, Found):
                part.finds = {**whole.finds, **part.finds}
                return part
            whole.finds.setdefault(
                f"the process ended with {child.exitcode}", last.read_bytes() if last.exists() else b""
            )
            lasts_s -= time.monotonic() - began
            if attempt == 3 or lasts_s < 5.0:
                return whole
    raise AssertionError


def main() -> int:
    """A row for every kind; 1 where something was found."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("names", nargs="*", metavar="NAME", help="kinds; all by default")
    asked.add_argument("--decoders", type=int, default=1_000_000, help="inputs for each decoder")
    asked.add_argument("--minutes", type=float, default=60.0, help="for all formats of files together")
    asked.add_argument("--files", type=int, default=sys.maxsize, help="inputs for each format of files, at most")
    asked.add_argument("--seed", type=int, default=1)
    options = asked.parse_args()
    names = options.names or list(kinds())
    of_files = [name for name in names if name in files()]
    lasts_s = 60.0 * options.minutes / max(1, len(of_files))
    print("| Input | Inputs | Refused, % | A second | Slowest, s | Memory grew, MB | Finds |\n" + "|---" * 7 + "|")
    finds = 0
    for name in names:
        inputs, seconds = (options.files, lasts_s) if name in of_files else (options.decoders, float("inf"))
        found = apart(name, inputs=inputs, lasts_s=seconds, seed=options.seed)
        rate = found.inputs / max(found.lasted_s, 1e-9)
        share = 100 * found.refused / max(1, found.inputs)
        print(
            f"| {name} | {found.inputs:,} | {share:.0f} | {rate:,.0f} | {found.slowest_s:.2f} | {found.grew_mb:.0f} | "
            f"{len(found.finds)} |",
            flush=True,
        )
        finds += len(found.finds)
        for told, data in found.finds.items():
            place = Path("fuzz-finds") / f"{name}-{hashlib.sha256(data).hexdigest()[:10]}"
            place.parent.mkdir(exist_ok=True)
            place.write_bytes(data)
            print(f"  {place}: {told}", file=sys.stderr, flush=True)
    return int(finds > 0)


if __name__ == "__main__":
    sys.exit(main())
