import numpy as np
import pytest

from frictid_hil.errors import IdentificationError
from frictid_hil.friction.presliding import presliding

STEP = 1e-3


def triangles(legs=4, travel=6e-3, speed=4e-3):
    leg = round(travel / speed / STEP)
    path = np.concatenate(
        [np.linspace(0, travel, leg) if k % 2 == 0 else np.linspace(travel, 0, leg) for k in range(legs)]
    )
    return np.arange(path.size) * STEP, path


def slip(path, stiffness, level):
    """Yields at once."""
    force = np.zeros_like(path)
    for k in range(1, path.size):
        force[k] = np.clip(force[k - 1] + stiffness * (path[k] - path[k - 1]), -level, level)
    return force


def dahl(path, stiffness, level):
    """Yields gradually; stiffness of the joint at rest, where friction is zero."""
    force = np.zeros_like(path)
    for k in range(1, path.size):
        dx = path[k] - path[k - 1]
        force[k] = force[k - 1] + stiffness * (1 - force[k - 1] / level * np.sign(dx)) * dx
    return force


@pytest.mark.parametrize("model", [slip, dahl])
@pytest.mark.parametrize(("stiffness", "level"), [(20_000.0, 12.0), (4_000.0, 3.0)])
def test_stiffness_at_rest_is_found_through_noise_steps_and_gravity(model, stiffness, level):
    time, path = triangles()
    rng = np.random.default_rng(4)
    rated = 3 * level
    torque = model(path, stiffness, level) + 40 * np.cos(0.3 + path) + 0.005 * rated * rng.normal(size=path.size)
    torque = np.round(torque / (rated * 1e-3)) * rated * 1e-3
    counts = np.round(path / 5e-7) * 5e-7
    found = presliding(time, counts, torque)
    assert found.stiffness_nm_per_rad.value == pytest.approx(stiffness, rel=0.05)
    assert found.stiffness_nm_per_rad.half_width < 0.15 * stiffness
    assert found.level_nm.value == pytest.approx(level, rel=0.04)
    assert found.gradual == (model is dahl)


@pytest.mark.parametrize("share", [0.5, 0.8])
def test_a_joint_between_the_two_shapes_is_not_called_gradual(share):
    time, path = triangles()
    torque = (1 - share) * slip(path, 6_000.0, 5.0) + share * dahl(path, 6_000.0, 5.0)
    assert not presliding(time, path, torque).gradual


@pytest.mark.parametrize("index", range(6))
def test_a_servo_controlled_joint_tells_its_stiffness(plants, index):
    joint = plants.replace(plants.arm[index], shares=(1.0,))
    time, path = triangles()
    path = joint.start + np.concatenate([np.zeros(300), path])
    q, _, torque = plants.drive(joint, path, np.gradient(path, STEP))
    found = presliding(time, q[300:], torque[300:])
    assert found.stiffness_nm_per_rad.value == pytest.approx(joint.stiffness, rel=0.03)


def test_a_joint_of_many_small_springs_is_not_called_stiffer_than_all_of_them(plants):
    joint = plants.arm[2]
    time, path = triangles()
    path = joint.start + np.concatenate([np.zeros(300), path])
    q, _, torque = plants.drive(joint, path, np.gradient(path, STEP))
    found = presliding(time, q[300:], torque[300:])
    assert 0.6 * joint.stiffness < found.stiffness_nm_per_rad.value <= 1.02 * joint.stiffness


def test_motion_without_reversals_says_so():
    time = np.arange(2000) * STEP
    with pytest.raises(IdentificationError, match="fewer than two turning points"):
        presliding(time, 1e-3 * time, np.ones(2000))


def test_a_frictionless_joint_has_no_presliding():
    time, path = triangles()
    torque = 1e-3 * np.random.default_rng(0).normal(size=path.size)
    with pytest.raises(IdentificationError):
        presliding(time, path, torque)
