"""Ten minutes of six joints at 1 kHz in every format: seconds and memory to read them.

python -m benchmarks.logs [--minutes 10]
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from frictid_hil.columns import ColumnMap, JointColumns, Source

JOINTS = 6
MAP = ColumnMap(
    "benchmark",
    Source(("t",), 1e9),
    {
        "{joint}": JointColumns(
            {
                "position_rad": Source(("q/{joint}",)),
                "velocity_rad_s": Source(("v/{joint}",)),
                "torque_nm": Source(("u/{joint}",)),
            }
        )
    },
)


def columns(minutes: float) -> dict[str, Any]:
    t = np.arange(round(minutes * 60_000)) * 1e-3
    phase = t[:, None] + np.arange(JOINTS)
    noise = np.random.default_rng(1).standard_normal(phase.shape)
    return {"t": t, "q": np.sin(phase), "v": np.cos(phase), "u": np.cos(phase) + 0.01 * noise}


def write_npz(path: Path, values: dict[str, Any]) -> None:
    np.savez_compressed(path, **values)


def write_h5(path: Path, values: dict[str, Any]) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for name, value in values.items():
            file.create_dataset(name, data=value, compression="gzip", compression_opts=1)


def write_mat(path: Path, values: dict[str, Any]) -> None:
    import scipy.io

    scipy.io.savemat(path, values, do_compression=True)


def write_parquet(path: Path, values: dict[str, Any]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    def column(value: Any) -> Any:
        return pa.array(value) if value.ndim == 1 else pa.FixedSizeListArray.from_arrays(value.ravel(), value.shape[1])

    pq.write_table(pa.table({name: column(value) for name, value in values.items()}), path)


def write_csv(path: Path, values: dict[str, Any]) -> None:
    names = ["t", *(f"{name}/{k}" for name in "qvu" for k in range(JOINTS))]
    table = np.column_stack([values["t"], values["q"], values["v"], values["u"]])
    with path.open("w") as file:
        file.write(",".join(names) + "\n")
        np.savetxt(file, table, delimiter=",", fmt="%.6f")


def write_mcap(path: Path, values: dict[str, Any]) -> None:
    import shutil

    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    names = [str(k) for k in range(JOINTS)]
    folder = path.with_suffix(".bag2")
    shutil.rmtree(folder, ignore_errors=True)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topic = writer.add_connection("/joint_states", kind, typestore=store)
        for k in range(values["t"].size):
            t_ns = 10**18 + k * 1_000_000
            body = header(stamp(*divmod(t_ns, 10**9)), "base")
            message = store.types[kind](body, names, values["q"][k], values["v"][k], values["u"][k])
            writer.write(topic, t_ns, store.serialize_cdr(message, kind))
    next(folder.glob("*.mcap")).rename(path)


WRITERS: dict[str, Callable[[Path, dict[str, Any]], None]] = {
    "log.npz": write_npz,
    "log.h5": write_h5,
    "log.mat": write_mat,
    "log.parquet": write_parquet,
    "log.csv": write_csv,
    "log.mcap": write_mcap,
}


def _read(path: Path, answer: Any) -> None:
    from frictid_hil.recording.read import read

    read(path.parent / "warm.npz", MAP)  # libraries loaded, kernels at hand
    before, worked = time.perf_counter(), time.process_time()
    joints = read(path, None if path.suffix == ".mcap" else MAP)
    seconds, worked = time.perf_counter() - before, time.process_time() - worked
    answer.send(
        (seconds, worked, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, len(joints), len(joints[0]))
    )


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=10.0)
    minutes = parser.parse_args().minutes
    values = columns(minutes)
    worst = 0.0
    with tempfile.TemporaryDirectory() as folder:
        write_npz(Path(folder) / "warm.npz", columns(0.01))
        for name, writer in WRITERS.items():
            path = Path(folder) / name
            writer(path, values)
            here, there = multiprocessing.get_context("spawn").Pipe()
            process = multiprocessing.get_context("spawn").Process(target=_read, args=(path, there))
            process.start()
            seconds, cpu, megabytes, joints, rows = here.recv()
            process.join()
            size = path.stat().st_size / 1e6
            print(
                f"{name:12s} {size:7.0f} MB  {joints} joints x {rows}  {seconds:6.2f} s  {cpu:6.2f} s of a processor  "
                f"{megabytes:6.0f} MB of memory",
                flush=True,
            )
            worst = max(worst, cpu)
            path.unlink()
    return 0 if worst < 5.0 else 1


if __name__ == "__main__":
    sys.exit(main())
