from __future__ import annotations

import gzip
import math
import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from sim_joints import CONTROLLER, GRAVITY, INERTIA, bare, excitation, simulate

from frictid_hil.simulation.joint import JointModel
from frictid_hil.simulation.replay import Controller, closed_loop, open_loop

PRACTICE = Path(
    os.environ.get("FRICTID_PRACTICE_DATA") or Path(__file__).parents[3] / "shared" / "data" / "gap-practice"
)


def test_a_command_acts_from_its_own_row_and_its_torque_shows_in_the_next() -> None:
    time = np.arange(20) / 500
    command = np.where(np.arange(20) >= 10, 0.201, 0.2)
    rows = closed_loop(bare(), CONTROLLER, time, command)
    still = GRAVITY * math.cos(0.2)
    # The command's derivative is central: it is felt from row 9, its torque is reported in row 10.
    assert np.abs(rows.torque_nm[:10] - still).max() < 1e-6
    kick = CONTROLLER.kd_nm_s_per_rad * 0.001 * 500 / 2
    assert rows.torque_nm[10] - still == pytest.approx(kick, rel=1e-6)
    assert rows.position_rad[9] == pytest.approx(0.2, abs=1e-12) and rows.position_rad[10] > 0.2


def test_noise_and_steps_come_with_a_seed_only() -> None:
    drive = {"torque_noise_per_mille": 5, "torque_quantum_per_mille": 2, "velocity_filter_s": 0}
    model = bare(drive=drive)
    clean, noisy, again = simulate(model), simulate(model, seed=1), simulate(model, seed=1)
    np.testing.assert_array_equal(noisy.torque_nm, again.torque_nm)
    np.testing.assert_array_equal(noisy.position_rad, clean.position_rad)
    assert np.std(noisy.torque_nm - clean.torque_nm) == pytest.approx(0.005 * 20, rel=0.05)
    np.testing.assert_allclose(noisy.torque_nm / 0.04, np.round(noisy.torque_nm / 0.04), atol=1e-9)


def test_rows_at_other_times_are_the_same_motion() -> None:
    time, command = excitation(1000.0)
    controller = Controller(500.0, 2000.0, 25.0, rate_hz=1000.0, velocity_filter_s=0.003)
    whole = closed_loop(bare(), controller, time, command)
    random = np.random.default_rng(5)
    kept = np.sort(random.choice(time.size, time.size // 2, replace=False))
    kept[0], kept[-1] = 0, time.size - 1
    # What a sparser log does to the commands is not the question here.
    sparse = closed_loop(bare(), controller, time[kept], command[kept])
    assert np.abs(sparse.position_rad - whole.position_rad[kept]).max() < 2e-3
    np.testing.assert_allclose(
        np.trapezoid(sparse.torque_nm, time[kept]), np.trapezoid(whole.torque_nm, time), rtol=0.02
    )


def test_the_payload_counts_where_it_is_mounted() -> None:
    assert simulate(bare(), payload=True).torque_nm[0] == pytest.approx((GRAVITY + 3.0) * math.cos(0.2))


def test_start_position_and_holding_torque_agree_with_an_elastic_sagging_link() -> None:
    effects = {"joint_elasticity": {"compliance_rad_per_nm": 1e-3, "relaxation_s": 1e-3}}
    for side in ("motor", "link"):
        model = bare(effects=effects, encoder={"side": side, "counts_per_revolution": 0})
        time = np.arange(500) / 500
        rows = closed_loop(model, CONTROLLER, time, np.full(500, 0.4))
        assert np.abs(rows.position_rad - 0.4).max() < 1e-9
        assert np.ptp(rows.torque_nm) < 1e-6


def test_open_loop_leaves_out_what_has_shaped_the_torque_already() -> None:
    time = np.arange(501) * 1e-3
    torque = np.full(501, 8.0)
    free = bare(friction={"coulomb_nm": 0.0}, gravity_cos_nm=0.0)
    late = free.with_effects({"torque_delay": {"delay_s": 0.01}, "torque_saturation": {"limit_share": 0.05}})
    plain, same = open_loop(free, time, torque), open_loop(late, time, torque)
    np.testing.assert_array_equal(plain.position_rad, same.position_rad)
    assert plain.position_rad[-1] == pytest.approx(8.0 / INERTIA * 0.125, rel=1e-9)


def practice_cases_without_effect() -> list[str]:
    truths = sorted((PRACTICE / "truth").glob("*.yaml")) if PRACTICE.is_dir() else []
    return [path.stem for path in truths if yaml.safe_load(path.read_text(encoding="utf-8"))["kind"] == "none"]


@pytest.mark.slow
@pytest.mark.skipif(not PRACTICE.is_dir(), reason="FRICTID_PRACTICE_DATA names no folder with practice cases")
@pytest.mark.parametrize("case", practice_cases_without_effect() or ["absent"])
def test_a_healthy_practice_joint_is_simulated_down_to_its_noise(case: str) -> None:
    folder = PRACTICE / "cases" / case
    nominal = yaml.safe_load((folder / "nominal.yaml").read_text(encoding="utf-8"))
    truth = yaml.safe_load((PRACTICE / "truth" / f"{case}.yaml").read_text(encoding="utf-8"))
    joint, law, payload = nominal["joint"], nominal["controller"], nominal["payload"]
    model = JointModel.from_mapping(
        {
            "inertia_kg_m2": joint["inertia_kg_m2"],
            "motor_inertia_share": joint["motor_inertia_share"],
            "gravity_cos_nm": joint["gravity_torque_nm"],
            "friction": {key: joint["friction"][key] for key in ("velocity_rad_s", "torque_nm")},
            "presliding_stiffness_nm_per_rad": joint["friction"]["presliding_stiffness_nm_per_rad"],
            "payload": {
                "inertia_kg_m2": payload["inertia_kg_m2"],
                "gravity_cos_nm": payload["gravity_torque_nm"],
            },
            "encoder": {
                "side": "motor",
                "counts_per_revolution": 2 * math.pi / nominal["encoder"]["resolution_rad"] / joint["gear_ratio"],
            },
            "drive": {"velocity_filter_s": 0},
        },
        gear_ratio=joint["gear_ratio"],
        rated_torque_nm=nominal["drive"]["rated_torque_nm"],
        max_torque_nm=law["torque_limit_nm"],
    )
    controller = Controller(
        law["kp"], law["ki"], law["kd"], law["rate_hz"], law["velocity_filter_s"], law["torque_limit_nm"]
    )
    floors = {entry["experiment"]: entry for entry in truth["per_experiment"]}
    state = None
    for experiment in sorted(nominal["experiments"], key=lambda entry: entry["run_order"]):
        with gzip.open(folder / (experiment["file"] + ".gz"), "rt") as file:
            log = np.genfromtxt(file, delimiter=",", names=True)
        rows = closed_loop(
            model, controller, log["time_s"], log["position_command_rad"], payload=experiment["payload"], state=state
        )
        state = rows.state
        floor = floors[experiment["name"]]
        position_rms = np.sqrt(np.mean((rows.position_rad - log["position_rad"]) ** 2))
        assert position_rms < 1.05 * floor["floor_forward_position_rad"] + 1e-7
        # The truth's figures are smoothed over about 20 ms.
        smooth = np.convolve(rows.torque_nm - log["torque_nm"], np.ones(10) / 10, "same")
        assert np.sqrt(np.mean(smooth**2)) < 1.15 * floor["floor_forward_torque_nm"]
