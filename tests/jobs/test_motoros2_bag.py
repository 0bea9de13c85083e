"""A bag as MotoROS2 fills it: joint states of the whole controller and of every group, measured torque in ``effort``.

Topics, default joint names (``group_1/joint_1``), order and the period of 20 ms are those of its sources and of its
default configuration; the messages themselves are written here, none was recorded on a controller.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from frictid_hil.config.write import dump
from frictid_hil.friction.trajectory import Array
from frictid_hil.jobs.gap.logs import Source
from frictid_hil.jobs.gap_diagnose import diagnose
from frictid_hil.jobs.identify import IdentifyOptions, identify

TYPES = get_typestore(Stores.ROS2_HUMBLE)
STATE = "sensor_msgs/msg/JointState"
PERIOD_S = 0.02
COULOMB_NM, VISCOUS, COS_NM, INERTIA = 2.0, 0.8, 5.0, 0.6


def sweeps() -> tuple[Array, Array, Array]:
    """Position, velocity and acceleration of a trapezoid there and back at each of six speeds."""
    steps = []
    for speed in (0.1, 0.2, 0.4, 0.6, 0.8, 1.0):
        for way in (1.0, -1.0):
            ramp = round(speed / 2.0 / 1e-3)
            steps += (
                [way * 2.0] * ramp
                + [0.0] * round((0.8 / speed - ramp * 1e-3) / 1e-3)
                + [-way * 2.0] * ramp
                + [0.0] * 300
            )
    acceleration = np.array(steps)
    velocity = np.cumsum(acceleration) * 1e-3
    every = round(PERIOD_S / 1e-3)
    position = np.cumsum(velocity) * 1e-3
    return position[::every], velocity[::every], acceleration[::every]


def bag(path: Path) -> Path:
    """Joint 2 of six moves; one message in 500 is lost on its way, as `sensor_data` allows."""
    rng = np.random.default_rng(1)
    position, velocity, acceleration = sweeps()
    torque = (
        INERTIA * acceleration + COS_NM * np.cos(position) + VISCOUS * velocity + COULOMB_NM * np.tanh(velocity / 1e-3)
    )
    torque += 0.05 * rng.standard_normal(torque.size)
    header, time = TYPES.types["std_msgs/msg/Header"], TYPES.types["builtin_interfaces/msg/Time"]
    names = [f"group_1/joint_{number}" for number in range(1, 7)]
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = [
            writer.add_connection(topic, STATE, typestore=TYPES)
            for topic in ("/ctrl_groups/r1/joint_states", "/joint_states")
        ]
        for k in range(position.size):
            if rng.random() < 0.002:
                continue
            stamp_ns = 10**18 + round(k * PERIOD_S * 1e9) + int(rng.integers(0, 200_000))
            at, speed, effort = np.full(6, 0.3), np.zeros(6), 0.5 + 0.02 * rng.standard_normal(6)
            at[1], speed[1], effort[1] = position[k], velocity[k], torque[k]
            message = TYPES.types[STATE](header(time(*divmod(stamp_ns, 10**9)), ""), names, at, speed, effort)
            for topic in topics:
                writer.write(topic, stamp_ns + 2_000_000, TYPES.serialize_cdr(message, STATE))
    return path


def test_friction_is_identified_from_it(tmp_path: Path) -> None:
    joint = identify(IdentifyOptions((bag(tmp_path / "bag"),), joints=("group_1/joint_2",)))["joints"][
        "group_1/joint_2"
    ]
    assert joint["coulomb_nm"] == pytest.approx(COULOMB_NM, rel=0.02)
    expected = [COULOMB_NM + VISCOUS * velocity for velocity in joint["velocity_rad_s"]]
    assert joint["torque_nm"] == pytest.approx(expected, rel=0.03)
    assert any("/joint_states, which stands above" in note for note in joint["notes"])


@pytest.mark.slow
def test_a_belief_is_compared_with_it(tmp_path: Path) -> None:
    """A belief with half of the friction misses the other half, on what was not fitted."""
    friction = {"coulomb_nm": 0.5 * COULOMB_NM, "viscous_nm_s_per_rad": VISCOUS}
    belief = {
        "joint": {"inertia_kg_m2": INERTIA, "gravity_cos_nm": COS_NM, "gravity_sin_nm": 0.0, "friction": friction}
    }
    (tmp_path / "nominal.yaml").write_text(dump(belief))
    found = diagnose(Source([bag(tmp_path / "bag")], nominal=tmp_path / "nominal.yaml", joint="group_1/joint_2"))
    assert found["outcome"] == "ok" and found["where"] and found["causes"]
    before, floor = (found["gap"][name]["inverse_nm"] for name in ("before", "noise_floor"))
    assert before == pytest.approx(0.5 * COULOMB_NM, rel=0.15) and floor < 0.1
