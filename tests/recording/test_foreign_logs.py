from __future__ import annotations

import gzip
import io
import json
import pickle
import random
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from frictid_hil.columns import ColumnMap
from frictid_hil.config.columns import load_columns
from frictid_hil.errors import FrictidError, InputFileError
from frictid_hil.jobs.columns import columns
from frictid_hil.recording.mcap import write_samples
from frictid_hil.recording.read import read
from frictid_hil.recording.samples import Samples

N = 200
TIME = np.arange(N) * 0.01
POSITION = 0.5 * np.sin(2 * np.pi * 0.5 * TIME)
VELOCITY = 0.5 * np.pi * np.cos(2 * np.pi * 0.5 * TIME)
TORQUE = 0.3 * np.tanh(VELOCITY / 0.05) + 0.1 * np.gradient(VELOCITY, TIME)

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
STATE = "sensor_msgs/msg/JointState"


def joint_state(store: Any, k: int, names: list[str], stamp_ns: int | None = None, empty: bool = False) -> Any:
    stamp_ns = 10**18 + k * 10_000_000 if stamp_ns is None else stamp_ns
    header_type = store.types["std_msgs/msg/Header"]
    stamp = store.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    header = header_type(k, stamp, "base") if store is ROS1 else header_type(stamp, "base")
    factor = np.array([1.0 if name == "elbow" else -2.0 for name in names])
    effort = np.zeros(0) if empty else TORQUE[k] * factor
    return store.types[STATE](header, names, POSITION[k] * factor, VELOCITY[k] * factor, effort)


def bag2(folder: Path, storage: StoragePlugin = StoragePlugin.MCAP, **options: Any) -> Path:
    path = folder / "bag"
    with Writer2(path, version=9, storage_plugin=storage) as writer:
        topic = writer.add_connection("/joint_states", STATE, typestore=ROS2)
        order = list(range(N))
        order[50], order[51] = order[51], order[50]
        for logged, k in enumerate(order):
            names = ["elbow", "wrist"] if k % 3 else ["wrist", "elbow"]
            message = joint_state(ROS2, k, names, **options)
            writer.write(topic, 10**18 + logged * 10_000_000 + 500_000, ROS2.serialize_cdr(message, STATE))
    return path


def bag1(folder: Path) -> Path:
    path = folder / "log.bag"
    with Writer1(path) as writer:
        topic = writer.add_connection("/joint_states", STATE, typestore=ROS1)
        for k in range(N):
            message = joint_state(ROS1, k, ["elbow", "wrist"])
            writer.write(topic, 10**18 + k * 10_000_000, ROS1.serialize_ros1(message, STATE))
    return path


def written_map(folder: Path, text: str) -> ColumnMap:
    (folder / "map.yaml").write_text("schema: frictid.columns/1\nname: test\n" + text)
    return load_columns(folder / "map.yaml")


MATRIX_MAP = """
time: {column: t, unit: ms}
joints:
  "{joint}":
    position: {column: "q/{joint}", unit: deg}
    velocity: {column: "qd/{joint}", unit: rpm}
    torque: {column: "current/{joint}", unit: mA, torque_constant_nm_per_a: 0.05, gear_ratio: 100,
             torque_constant_sigma: 0.1}
"""


def matrices() -> dict[str, Any]:
    two = np.array([1.0, -2.0])
    return {
        "t": 1e3 * TIME,
        "q": np.rad2deg(POSITION[:, None] * two),
        "qd": VELOCITY[:, None] * two * 30 / np.pi,
        "current": TORQUE[:, None] * two / 5.0 * 1e3,
    }


def check_two(joints: list[Samples], second: str = "1", first: str = "0") -> None:
    found = {samples.joint: samples for samples in joints}
    assert set(found) == {first, second}
    for name, factor in ((first, 1.0), (second, -2.0)):
        samples = found[name]
        assert np.allclose(samples.time_s - samples.time_s[0], TIME)
        assert np.allclose(samples.position_rad, factor * POSITION)
        assert samples.velocity_rad_s is not None and np.allclose(samples.velocity_rad_s, factor * VELOCITY)
        assert samples.torque_nm is not None and np.allclose(samples.torque_nm, factor * TORQUE)


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_rosbag2_whose_names_change_order_and_whose_messages_come_late(
    tmp_path: Path, storage: StoragePlugin
) -> None:
    joints = read(bag2(tmp_path, storage))
    check_two(joints, "wrist", "elbow")
    assert any("came late" in line for line in joints[0].meta["told"])


def test_a_bare_mcap_of_joint_states_and_a_ros1_bag(tmp_path: Path) -> None:
    (file,) = bag2(tmp_path).glob("*.mcap")
    check_two(read(file), "wrist", "elbow")
    check_two(read(bag1(tmp_path)), "wrist", "elbow")
    assert [samples.joint for samples in read(file, joint="wrist")] == ["wrist"]


def test_joint_states_without_effort_or_stamp(tmp_path: Path) -> None:
    (first, _) = read(bag2(tmp_path, stamp_ns=0, empty=True))
    assert first.torque_nm is None
    assert "those of the log" in first.meta["told"][0]


def test_controller_states_carry_command_and_feedback(tmp_path: Path) -> None:
    text = """std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback\n"""
    from rosbags.typesys import get_types_from_msg

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "control_msgs/msg/JointTrajectoryControllerState"
    store.register({k: v for k, v in get_types_from_msg(text, kind).items() if k == kind})
    types = store.types
    trajectory_point, duration = (
        types["trajectory_msgs/msg/JointTrajectoryPoint"],
        types["builtin_interfaces/msg/Duration"],
    )
    with Writer2(tmp_path / "bag", version=9) as writer:
        topic = writer.add_connection("/controller_state", kind, typestore=store)
        none = np.zeros(0)
        for k in range(N):
            one = np.array([1.0])
            stamp = types["builtin_interfaces/msg/Time"](*divmod(10**18 + k * 10**7, 10**9))
            since = duration(k, k)
            message = types[kind](
                types["std_msgs/msg/Header"](stamp, ""),
                ["elbow"],
                trajectory_point(one * POSITION[k] + 0.01, none, none, none, since),
                trajectory_point(one * POSITION[k], one * VELOCITY[k], none, none, since),
            )
            writer.write(topic, k, store.serialize_cdr(message, kind))
    (elbow,) = read(tmp_path / "bag")
    assert elbow.position_command_rad is not None
    assert np.allclose(elbow.position_command_rad, POSITION + 0.01)
    assert np.allclose(elbow.position_rad, POSITION)


def npz(folder: Path) -> Path:
    np.savez_compressed(folder / "log.npz", **matrices(), picture=np.zeros((4, 300, 300)))
    return folder / "log.npz"


def hdf5(folder: Path) -> Path:
    with h5py.File(folder / "log.h5", "w") as file:
        for name, value in matrices().items():
            file.create_dataset(name, data=value, compression="gzip")
    return folder / "log.h5"


def mat(folder: Path) -> Path:
    scipy.io.savemat(folder / "log.mat", {**matrices(), "t": matrices()["t"][:, None]}, do_compression=True)
    return folder / "log.mat"


def parquet(folder: Path) -> Path:
    columns = {name: value.tolist() for name, value in matrices().items()}
    pq.write_table(pa.table(columns), folder / "log.parquet")
    return folder / "log.parquet"


@pytest.mark.parametrize("make", [npz, hdf5, mat, parquet])
def test_matrices_in_other_units_through_a_map_for_every_joint(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    joints = read(make(tmp_path), written_map(tmp_path, MATRIX_MAP))
    check_two(joints)
    assert joints[0].meta["torque_constant_sigma"] == 0.1


def lerobot(folder: Path) -> Path:
    root = folder / "dataset"
    (root / "meta").mkdir(parents=True)
    (root / "data" / "chunk-000").mkdir(parents=True)
    names = ["pan.pos", "lift.pos"]
    feature = {"dtype": "float32", "shape": [2], "names": names}
    info = {"fps": 100, "features": {"observation.state": feature, "action": feature}}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    two = np.rad2deg(POSITION[:, None] * np.array([1.0, -2.0]))
    frames = {
        "observation.state": two.astype(np.float32).tolist(),
        "action": (two + 1.0).astype(np.float32).tolist(),
        "timestamp": (np.arange(N) % 120 / 100).astype(np.float32).tolist(),
        "frame_index": (np.arange(N) % 120).tolist(),
        "episode_index": (np.arange(N) // 120).tolist(),
    }
    pq.write_table(pa.table(frames), root / "data" / "chunk-000" / "file-000.parquet")
    return root


def test_a_lerobot_dataset_by_the_shipped_map(tmp_path: Path) -> None:
    pan, lift = read(lerobot(tmp_path), load_columns("lerobot_degrees"))
    assert (pan.joint, lift.joint) == ("pan", "lift")
    assert np.allclose(lift.position_rad, -2 * POSITION, atol=1e-5)
    assert pan.position_command_rad is not None
    assert np.allclose(np.rad2deg(pan.position_command_rad - pan.position_rad), 1.0, atol=1e-4)
    assert np.isclose(np.diff(pan.time_s).max(), 1.0)  # between its two episodes
    assert any("jitter" in line for line in pan.meta["told"])


def bam(folder: Path) -> Path:
    entries = [
        {"timestamp": t, "position": q, "goal_position": q + 0.01, "load": 0.1, "torque_enable": True}
        for t, q in zip(TIME.tolist(), POSITION.tolist(), strict=True)
    ]
    (folder / "log.json").write_text(json.dumps({"mass": 0.5, "length": 0.2, "motor": "xl330", "entries": entries}))
    return folder / "log.json"


def test_a_recording_of_bam(tmp_path: Path) -> None:
    (joint,) = read(bam(tmp_path))
    assert joint.joint == "xl330"
    assert np.allclose(joint.position_rad, POSITION)
    assert joint.meta["bam_mass"] == 0.5


class _Tensor:
    """What torch writes for a tensor of float32, without torch."""

    def __init__(self, key: str, values: np.ndarray) -> None:
        self.key, self.values = key, np.ascontiguousarray(values, np.float32)


def pace(folder: Path, evil: Any = None) -> Path:
    class Writer(pickle.Pickler):
        def persistent_id(self, thing: Any) -> Any:
            return (
                ("storage", _global("torch", "FloatStorage"), thing.key, "cpu", thing.values.size)
                if isinstance(thing, _Storage)
                else None
            )

        def reducer_override(self, thing: Any) -> Any:
            if isinstance(thing, _Tensor):
                stride = tuple(s // 4 for s in thing.values.strides)
                arguments = (_Storage(thing), 0, thing.values.shape, stride, False, {})
                return _global("torch._utils", "_rebuild_tensor_v2"), arguments
            return NotImplemented

    tensors = {
        "time": _Tensor("0", TIME),
        "dof_pos": _Tensor("1", POSITION[:, None] * np.array([1.0, -2.0])),
        "des_dof_pos": _Tensor("2", POSITION[:, None] * np.array([1.0, -2.0]) + 0.01),
    }
    head = io.BytesIO()
    Writer(head, 2).dump({**tensors, **({"evil": evil} if evil else {})})
    path = folder / "log.pt"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("log/data.pkl", head.getvalue())
        for tensor in tensors.values():
            archive.writestr(f"log/data/{tensor.key}", tensor.values.tobytes())
    return path


class _Storage:
    def __init__(self, tensor: _Tensor) -> None:
        self.key, self.values = tensor.key, tensor.values


def _global(module: str, name: str) -> Any:
    """Something that pickles as a name of a package that is not installed."""
    import sys
    import types

    for part in (module.split(".")[0], module):
        sys.modules.setdefault(part, types.ModuleType(part))
    made = getattr(sys.modules[module], name, None) or type(name, (), {"__module__": module, "__qualname__": name})
    setattr(sys.modules[module], name, made)
    return made


@pytest.fixture(autouse=True)
def no_torch() -> Any:
    yield
    import sys

    for name in ("torch", "torch._utils"):
        if name in sys.modules and not hasattr(sys.modules[name], "__version__"):
            del sys.modules[name]


def test_a_recording_of_pace_and_no_pickle_that_runs(tmp_path: Path) -> None:
    first, second = read(pace(tmp_path))
    assert np.allclose(first.time_s, TIME, atol=1e-6)
    assert np.allclose(second.position_rad, -2 * POSITION, atol=1e-6)
    with pytest.raises(InputFileError, match=r"is no tensor"):
        read(pace(tmp_path, evil=print))


@pytest.mark.parametrize(
    ("separator", "comma"), [(";", True), (";", False), ("\t", True), ("\t", False), ("|", False), (",", False)]
)
def test_csv_dialects_are_found_out_and_told(tmp_path: Path, separator: str, comma: bool) -> None:
    rows = [separator.join(["time_s", "position_rad", "torque_nm"])]
    for row in zip(TIME.tolist(), POSITION.tolist(), TORQUE.tolist(), strict=True):
        line = separator.join(f"{value:.9f}" for value in row)
        rows.append(line.replace(".", ",") if comma else line)
    (tmp_path / "log.csv").write_text("# a remark\n" + "\n".join(rows) + "\n")
    (joint,) = read(tmp_path / "log.csv")
    assert np.allclose(joint.position_rad, POSITION, atol=1e-8)
    told = " ".join(joint.meta.get("told", ()))
    assert ("decimal commas" in told) == comma
    assert ("separated by" in told) == (separator != ",")


def test_a_logger_that_speaks_german_is_drafted(tmp_path: Path) -> None:
    time = np.arange(0.0, 4.0, 0.01)
    angle = 40.0 * np.sin(1.5 * time)
    rows = zip(1e3 * time, angle, np.gradient(angle, 0.01) / 6.0, np.sign(np.gradient(angle)), strict=True)
    text = "Zeit [ms];Winkel [°];Drehzahl [1/min];Moment [Nm]\r\n"
    text += "".join(";".join(f"{value:.4f}".replace(".", ",") for value in row) + "\r\n" for row in rows)
    log = tmp_path / "messung.csv"
    log.write_bytes(f"Prüfstand 2\r\n{text}".encode("cp1252"))
    told = columns(log, out=tmp_path / "map.yaml")
    assert told["joints"]["0"]["columns"] == ["position_rad", "velocity_rad_s", "torque_nm"]
    assert told["joints"]["0"]["travel"] == pytest.approx(np.deg2rad(80.0), rel=1e-3)
    assert told["joints"]["0"]["doubts"] == []


def test_a_wrapped_angle_is_unwrapped_and_one_in_a_second_file_held(tmp_path: Path) -> None:
    turning = 8.0 * TIME
    wrapped = (turning + np.pi) % (2 * np.pi) - np.pi
    np.savez(tmp_path / "log.npz", t=TIME, q=wrapped, u=TORQUE)
    np.savez(tmp_path / "command.npz", t=TIME[::4], want=POSITION[::4])
    columns = written_map(
        tmp_path,
        """
time: {column: t, unit: s}
joints:
  a:
    position: {column: q, unit: rad}
    torque: {column: u, unit: N m}
    position_command: {column: want, unit: rad, file: command.npz}
""",
    )
    (joint,) = read(tmp_path / "log.npz", columns)
    assert np.allclose(joint.position_rad, turning)
    assert "unwrapped" in joint.meta["told"][0]
    assert joint.position_command_rad is not None
    assert np.allclose(joint.position_command_rad, np.repeat(POSITION[::4], 4))


def own_mcap(folder: Path) -> Path:
    samples = Samples("0", (TIME * 1e9).astype(np.int64), POSITION, torque_nm=TORQUE)
    write_samples(folder / "own.mcap", [samples])
    return folder / "own.mcap"


def ros_mcap(folder: Path) -> Path:
    (file,) = bag2(folder).glob("*.mcap")
    return file


def csv_gz(folder: Path) -> Path:
    rows = "\n".join(f"{t};{q}".replace(".", ",") for t, q in zip(TIME.tolist(), POSITION.tolist(), strict=True))
    (folder / "log.csv.gz").write_bytes(gzip.compress(f"time_s;position_rad\n{rows}\n".encode()))
    return folder / "log.csv.gz"


@pytest.mark.parametrize("make", [npz, hdf5, mat, parquet, bam, pace, own_mcap, ros_mcap, bag1, csv_gz])
def test_a_damaged_file_is_read_or_refused_never_worse(
    tmp_path_factory: pytest.TempPathFactory, make: Callable[[Path], Path]
) -> None:
    folder = tmp_path_factory.mktemp("sound")
    path = make(folder)
    sound = path.read_bytes()
    columns = written_map(folder, MATRIX_MAP) if make in (npz, hdf5, mat, parquet) else None

    @settings(max_examples=40, deadline=None)
    @given(st.integers(0, 2**32))
    def damaged(seed: int) -> None:
        dice = random.Random(seed)
        data = bytearray(sound)
        for _ in range(dice.randint(1, 4)):
            at = dice.randrange(dice.choice([min(300, len(data)), len(data)]))
            data[at : at + dice.randint(1, 4)] = dice.randbytes(dice.randint(0, 4))
        path.write_bytes(data[: dice.choice([len(data), dice.randrange(len(data))])])
        try:
            read(path, columns)
        except FrictidError as error:
            assert path.stem in error.where

    damaged()


def csv_bomb(folder: Path) -> Path:
    block = zlib.compressobj(9, zlib.DEFLATED, 31)
    head = block.compress(b"time_s,position_rad,torque_nm\n")
    line = b"0.000000,0.000000,0.000000\n" * 40_000
    (folder / "log.csv.gz").write_bytes(head + b"".join(block.compress(line) for _ in range(80)) + block.flush())
    return folder / "log.csv.gz"


def npz_bomb(folder: Path) -> Path:
    np.savez_compressed(folder / "log.npz", t=np.zeros(9_000_000), q=np.zeros(1), u=np.zeros(1))
    return folder / "log.npz"


def hdf5_bomb(folder: Path) -> Path:
    with h5py.File(folder / "log.h5", "w") as file:
        for name in ("t", "q", "u"):
            file.create_dataset(name, shape=(400_000_000,), dtype="f8", chunks=(1 << 20,), compression="gzip")
    return folder / "log.h5"


def mat_bomb(folder: Path) -> Path:
    scipy.io.savemat(folder / "log.mat", {"t": np.zeros((9_000_000, 1))}, do_compression=True)
    return folder / "log.mat"


def parquet_bomb(folder: Path) -> Path:
    array = pa.repeat(pa.scalar(0.0), 11_000_000)
    pq.write_table(pa.table({"t": array, "q": array, "u": array}), folder / "log.parquet")
    return folder / "log.parquet"


def mcap_bomb(folder: Path) -> Path:
    import zstandard

    packed = zstandard.compress(bytes(1 << 28))
    body = np.array([0, 0, 1 << 28], "<u8").tobytes() + bytes(4) + (4).to_bytes(4, "little") + b"zstd"
    body += len(packed).to_bytes(8, "little") + packed
    head = (4).to_bytes(4, "little") + b"ros2" + bytes(4)
    record = bytes([1]) + len(head).to_bytes(8, "little") + head
    chunk = bytes([6]) + len(body).to_bytes(8, "little") + body
    (folder / "log.mcap").write_bytes(b"\x89MCAP0\r\n" + record + chunk)
    return folder / "log.mcap"


def own_mcap_bomb(folder: Path) -> Path:
    path = mcap_bomb(folder)
    path.write_bytes(path.read_bytes().replace(b"ros2", b"frid", 1))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("make", [csv_bomb, npz_bomb, hdf5_bomb, mat_bomb, parquet_bomb, mcap_bomb, own_mcap_bomb])
def test_a_small_file_that_unpacks_to_gigabytes_is_refused(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    columns = written_map(
        tmp_path,
        "time: {column: t, unit: s}\njoints: {a: {position: {column: q, unit: rad}, torque: {column: u, unit: N m}}}\n",
    )
    path = make(tmp_path)
    assert path.stat().st_size < 5e6
    with pytest.raises(InputFileError, match=r"unpack|more than 10,000,000 rows"):
        read(path, columns if "mcap" not in path.name and "csv" not in path.name else None)
