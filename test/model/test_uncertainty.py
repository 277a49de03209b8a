"""Derived robots: masses that are believed wrong, joints that are locked."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles import PinocchioOracle, assert_agrees
from support.random_robots import random_robot_urdf

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.resources import share_directory


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


def test_every_mass_and_every_inertia_is_off_by_a_factor_of_its_own() -> None:
    error = 0.3
    true = parse_robot(random_robot_urdf(np.random.default_rng(0), joints=6))
    factors = []
    for seed in range(40):
        believed = true.with_model_error(error, seed)
        assert believed.joint_names == true.joint_names
        for link, original in zip(believed.links, true.links, strict=True):
            if original.inertia.mass == 0.0:
                assert link.inertia.mass == 0.0
                continue
            np.testing.assert_array_equal(link.inertia.com, original.inertia.com)
            moments = link.inertia.about_com[np.nonzero(original.inertia.about_com)]
            ratios = moments / original.inertia.about_com[np.nonzero(original.inertia.about_com)]
            np.testing.assert_allclose(ratios, ratios[0], rtol=1e-12)
            assert np.linalg.eigvalsh(link.inertia.about_com)[0] > 0.0
            factors.append([link.inertia.mass / original.inertia.mass, ratios[0]])
        assert believed.total_mass == pytest.approx(sum(x.inertia.mass for x in believed.links))
    spread = np.array(factors)
    assert spread.min() >= 1 - error
    assert spread.max() <= 1 + error
    # Uniform: mean 1 and standard deviation error / sqrt 3; masses and inertias independent.
    np.testing.assert_allclose(spread.mean(axis=0), 1.0, atol=5 * error / np.sqrt(3 * len(spread)))
    np.testing.assert_allclose(spread.std(axis=0), error / np.sqrt(3), rtol=0.15)
    assert abs(np.corrcoef(spread.T)[0, 1]) < 5 / np.sqrt(len(spread))


def test_a_seed_is_a_robot_and_no_error_is_the_true_one() -> None:
    true = parse_robot(random_robot_urdf(np.random.default_rng(1), joints=4))
    masses = [
        [body.inertia.mass for body in true.with_model_error(error, seed).bodies]
        for error, seed in ((0.1, 3), (0.1, 3), (0.1, 4), (0.0, 3))
    ]
    assert masses[0] == masses[1] != masses[2]
    assert masses[3] == [body.inertia.mass for body in true.bodies]
    with pytest.raises(ValueError, match=r"error of 1\.0"):
        true.with_model_error(1.0, 0)


@pytest.mark.parametrize("seed", range(4))
def test_a_locked_joint_is_one_that_does_not_move(seed: int) -> None:
    """Held against Pinocchio's model of the robot with all its joints."""
    rng = np.random.default_rng(seed)
    urdf = random_robot_urdf(rng, joints=6)
    whole = parse_robot(urdf)
    names = list(whole.joint_names)
    chosen = sorted(rng.choice(6, size=2, replace=False).tolist())
    q, qdot = rng.uniform(-1.0, 1.0, 6), rng.uniform(-1.0, 1.0, 6)
    qdot[chosen] = 0.0
    locked = SpaceRobot(whole.with_locked({names[i]: float(q[i]) for i in chosen}))
    left = [i for i in range(6) if i not in chosen]
    assert list(locked.joint_names) == [names[i] for i in left]
    assert locked.link_names == tuple(link.name for link in whole.links)
    np.testing.assert_array_equal(locked.velocity_limit, whole.limits("velocity")[left])

    oracle = PinocchioOracle(urdf, names)
    v, omega = locked.base_twist(
        [0, 0, 0, 1], q[left], qdot[left], [1.0, -2.0, 0.5], [0.3, 0.2, -1]
    )
    oracle.set_configuration(q, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    oracle.move(oracle.base_velocities(np.concatenate([v, omega])) + oracle.joint_velocities(qdot))
    p, L, _ = oracle.momentum_W()
    assert_agrees(np.concatenate([p, L]), [1.0, -2.0, 0.5, 0.3, 0.2, -1.0])
    for link in locked.link_names:
        R, r = locked.link_pose(link, q[left])
        R_W, r_W = oracle.frame_W(link)
        np.testing.assert_allclose(R, R_W, atol=1e-12)
        np.testing.assert_allclose(r, r_W, atol=1e-12)


def test_what_cannot_be_locked_is_named() -> None:
    robot = parse_robot((share_directory() / "urdf" / "three_joint_arm.urdf").read_text("utf-8"))
    for name in ("nose", "end_effector_mount"):
        with pytest.raises(KeyError, match=name):
            robot.with_locked({name: 0.0})
