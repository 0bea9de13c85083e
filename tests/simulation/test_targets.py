"""Improved joints for other simulators hold the numbers they say, and the C step function gives its own vectors."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from frictid_hil.errors import UsageError
from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.native import Use
from frictid_hil.simulation.robot_model import ModelJoint, Motor
from frictid_hil.simulation.target_laws import laws_of, run_c
from frictid_hil.simulation.targets import TARGETS, Numbers, friction_nm, numbers_of, place_of, written_as

SERVO = Motor(("servo",), "position", 900.0, 30.0, 1.0, 40.0, 0.004, 0.0)
BELIEVED = ModelJoint("lift", False, None, 0.2, 3.0, (1.0, 0.0, 0.0), (0.0, 0.0), None, False, 0.0, SERVO)
BARE = JointModel.from_mapping(
    {"inertia_kg_m2": 0.5, "motor_inertia_share": 0.4, "friction": {"coulomb_nm": 3.0, "viscous_nm_s_per_rad": 1.0}},
    gear_ratio=1.0, rated_torque_nm=40.0, max_torque_nm=40.0,
)  # fmt: skip
USE = Use(np.linspace(0.01, 1.5, 300), np.zeros(1), 0.002)


@pytest.fixture
def joint() -> Numbers:
    effects = {
        "stribeck": {"share": 0.3, "stribeck_velocity_rad_s": 0.1, "exponent": 2.0},
        "torque_delay": {"delay_s": 0.002},
        "inertia_error": {"error_share": 0.5},
    }
    return numbers_of(BELIEVED, BARE.with_effects(effects), USE)


def test_the_numbers_are_those_of_the_improved_joint(joint: Numbers) -> None:
    assert joint.dry_nm == pytest.approx(3.0, rel=0.02) and joint.rise_nm == pytest.approx(0.9, rel=0.05)
    assert joint.stribeck_rad_s == pytest.approx(0.1, rel=0.05)
    assert joint.viscous_nm_s_per_rad == pytest.approx(1.0, rel=0.03)
    assert joint.delay_s == pytest.approx(0.006) and joint.armature_kg_m2 == pytest.approx(0.2 + 0.5 * 0.3)
    assert (joint.kp_nm_per_rad, joint.kv_nm_s_per_rad, joint.torque_limit_nm) == (900.0, 30.0, 40.0)
    assert friction_nm(joint, 0.8, 1.0) == pytest.approx(3.8, rel=0.02)


def test_mjlab_gets_actuators_and_is_told_what_they_cannot_hold(joint: Numbers) -> None:
    (text,) = written_as("mjlab", "a.py", {"lift": joint}, {}, 0.002).values()
    code = "\n".join(line for line in text.splitlines() if not line.startswith("from mjlab"))
    names: dict[str, Any] = {"BuiltinPositionActuatorCfg": dict}
    exec(compile(code, "a.py", "exec"), names)
    (lift,) = names["ACTUATORS"]
    assert lift["target_names_expr"] == ("lift",) and lift["frictionloss"] == pytest.approx(3.0, rel=0.02)
    assert (lift["stiffness"], lift["damping"], lift["effort_limit"]) == (900.0, 30.0, 40.0)
    assert names["JOINT_DAMPING"] == {"lift": pytest.approx(1.0, rel=0.03)} and names["DELAY_STEPS"] == {"lift": 3}


def test_isaac_lab_gets_levels_delay_in_steps_and_ranges(joint: Numbers) -> None:
    (text,) = written_as("isaaclab", "a.py", {"lift": joint}, {"lift": [joint, joint]}, 0.002).values()
    made: dict[str, dict[str, object]] = {}

    def config(**values: object) -> dict[str, object]:
        return values

    code = "\n".join(line for line in text.splitlines() if not line.startswith("from isaaclab"))
    exec(compile(code, "a.py", "exec"), names := {"DelayedPDActuatorCfg": config, "IdealPDActuatorCfg": config})
    made = names["ACTUATORS"]  # type: ignore[assignment]
    lift = made["lift"]
    assert lift["min_delay"] == lift["max_delay"] == 3
    assert lift["friction"] > lift["dynamic_friction"] == pytest.approx(3.0, rel=0.02)
    assert set(names["RANGES"]["lift"]) == {"dry_nm", "viscous_nm_s_per_rad", "armature_kg_m2", "delay_s"}


def test_bam_has_a_file_a_joint_and_samples_belong_together(joint: Numbers) -> None:
    made = written_as("bam", "bam.json", {"lift": joint, "pan": joint}, {}, 0.002)
    assert set(made) == {"bam_lift.json", "bam_pan.json"}
    assert json.loads(made["bam_pan.json"])["friction_stribeck"] == joint.rise_nm
    (text,) = written_as("samples", "s.json", {}, {"lift": [joint] * 3, "pan": [joint] * 3}, 0.002).values()
    assert len(json.loads(text)["samples"]) == 3
    with pytest.raises(UsageError, match="no target 'drake'"):
        written_as("drake", "x", {}, {}, 0.002)


def test_every_effect_has_a_place_or_is_lost() -> None:
    for target in TARGETS:
        assert place_of(target, "friction_level_error") and place_of(target, "torque_ripple") is None
        assert (place_of(target, "directional_efficiency") or "").endswith("mean load")
    assert place_of("ros2", "inertia_error") is None and place_of("newton", "inertia_error") == "newton:armature"
    assert place_of("isaaclab", "torque_delay") and place_of("newton", "torque_delay") is None


def test_what_a_file_says_is_read_back_from_it(joint: Numbers) -> None:
    v = np.array([-0.7, 0.3, 1.2])
    for target in ("isaaclab", "mjlab", "ros2", "bam", "c", "samples"):
        texts = written_as(
            target, f"a.{target}", {"lift": joint, "pan": joint}, {"lift": [joint], "pan": [joint]}, 0.002
        )
        (laws,) = laws_of(target, texts, ["lift", "pan"])
        assert set(laws) == {"lift", "pan"}
        expected = [friction_nm(joint, float(speed), float(np.sign(speed))) for speed in v]
        assert laws["pan"].torque_nm(v, np.sign(v)) == pytest.approx(expected, rel=0.06), target
        assert laws["lift"].armature_kg_m2 in (None, pytest.approx(joint.armature_kg_m2))


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_c_step_function_compiles_and_meets_its_vectors(joint: Numbers, tmp_path: Path) -> None:
    plain = numbers_of(BELIEVED, BARE, USE)
    (text,) = written_as("c", "friction.h", {"lift": joint, "pan": plain}, {}, 0.002).values()
    (tmp_path / "friction.h").write_text(text)
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include "friction.h"\nint main(void) { printf("%.17g", frictid_check()); return 0; }\n'
    )
    command = ["cc", "-std=c99", "-Wall", "-Werror", "main.c", "-o", "check", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    worst = subprocess.run(["./check"], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    assert float(worst) < 1e-12
    speed = np.array([0.5, 0.5, -0.2])
    ran = run_c(text, {"pan": speed}, 0.01)["pan"]
    assert ran[:2] == pytest.approx([friction_nm(plain, 0.5, 1.0)] * 2)
    assert text.count('{"pan"') == 1 and f"{friction_nm(plain, 0.0, 0.0)!r}" in text
