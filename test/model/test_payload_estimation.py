"""Parameters of a held body from momenta of point masses, with noise, in a plane, and at rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from support.oracles import Array

from spacerobot_ros.model.grasp import BodyMotion
from spacerobot_ros.model.payload_estimation import (
    PAYLOAD_PARAMETERS,
    PayloadEstimate,
    estimate_payload,
    momentum_regressor,
    payload_parameters,
)

MASSES = np.array([3.0, 1.5, 0.7, 2.2, 0.4])
POINTS = np.array(
    [[0.3, -0.1, 0.2], [0.5, 0.4, -0.3], [-0.2, 0.6, 0.1], [0.1, -0.5, 0.6], [0.9, 0.2, -0.4]]
)
"""A body of point masses, kg and m in its frame."""

ABOUT = np.array([0.4, -1.2, 0.7])
TOTAL = np.array([0.3, -0.2, 0.5, 1.1, -0.7, 0.2])
ROBOT_MASS, RADIUS = 40.0, 0.6


def true_parameters() -> Array:
    about = sum(
        m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(MASSES, POINTS, strict=True)
    )
    h = MASSES @ POINTS
    six = [about[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return np.array([MASSES.sum(), *h, *six])


def motions(count: int = 20, *, planar: bool = False) -> list[BodyMotion]:
    """Triples of successive states of a smooth motion."""
    rng = np.random.default_rng(3)
    phase, pace = rng.uniform(0.0, 6.0, (4, 3)), rng.uniform(0.5, 2.0, (4, 3))
    found = []
    for t in (np.linspace(0.0, 20.0, count)[:, np.newaxis] + [0.0, 0.01, 0.02]).ravel():
        r, v, turn, omega = np.sin(phase + pace * t) * [[1.0], [0.2], [1.0], [0.3]]
        if planar:
            r[2] = v[2] = 0.0
            turn[:2] = omega[:2] = 0.0
        found.append(BodyMotion(Rotation.from_rotvec(turn).as_matrix(), r, v, omega))
    return found


def momentum(motion: BodyMotion) -> Array:
    """The momenta of the point masses about a fixed point."""
    p, L = np.zeros(3), np.zeros(3)
    for m, r in zip(MASSES, POINTS, strict=True):
        arm = motion.R_WT @ r
        of_point = m * (motion.v + np.cross(motion.omega, arm))
        p += of_point
        L += np.cross(motion.r_WT + arm - ABOUT, of_point)
    return np.concatenate([p, L])


def fitted(regressors: Array, known: Array) -> PayloadEstimate:
    return estimate_payload(
        "hand", regressors.reshape(-1, 3, 6, 10), known.reshape(-1, 3, 6), ROBOT_MASS, RADIUS
    )


def estimate(moving: list[BodyMotion], noise: float = 0.0, scale: float = 1.0) -> PayloadEstimate:
    known = np.array([TOTAL - scale * momentum(motion) for motion in moving])
    known += noise * np.random.default_rng(8).normal(size=known.shape) * [1, 1, 1, 0.5, 0.5, 0.5]
    return fitted(np.array([momentum_regressor(motion, ABOUT) for motion in moving]), known)


def test_momenta_are_linear_in_the_parameters() -> None:
    for motion in motions(4):
        A = momentum_regressor(motion, ABOUT)
        np.testing.assert_allclose(A @ true_parameters(), momentum(motion), atol=1e-13)


def test_all_ten_parameters_follow_from_motion_in_space() -> None:
    found = estimate(motions())
    np.testing.assert_allclose(found.parameters, true_parameters(), rtol=1e-11, atol=1e-12)
    assert found.undetermined == ()
    assert found.directions.shape == (0, 10)
    assert not found.corrected
    assert found.deviations.max() < 1e-9
    payload = found.payload
    assert payload is not None
    assert payload.link == "hand"
    center = MASSES @ POINTS / MASSES.sum()
    np.testing.assert_allclose(payload.inertia.com, center, rtol=1e-10)
    off = POINTS - center
    about = sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(MASSES, off, strict=True))
    np.testing.assert_allclose(payload.inertia.about_com, about, atol=1e-10)
    np.testing.assert_allclose(payload_parameters(payload.inertia), true_parameters(), atol=1e-10)


def test_noise_is_averaged_and_the_deviations_say_how_well() -> None:
    found = estimate(motions(130), noise=0.02)
    error = found.parameters - true_parameters()
    assert found.undetermined == ()
    assert np.abs(error / found.deviations).max() < 3.5
    assert 0.5 < np.sqrt(np.mean((error / found.deviations) ** 2)) < 1.7
    assert abs(error[0]) < 0.02
    # By hand: the covariance of the linear problem at the noise that was added.
    A = np.array([momentum_regressor(motion, ABOUT) for motion in motions(130)])
    A = (A - A.mean(axis=0)) / (0.02 * np.array([1, 1, 1, 0.5, 0.5, 0.5]))[:, np.newaxis]
    covariance = np.linalg.inv(np.einsum("nij,nik->jk", A, A))
    np.testing.assert_allclose(found.deviations, np.sqrt(np.diag(covariance)), rtol=0.1)


def test_parameters_that_a_planar_motion_does_not_show_are_named() -> None:
    found = estimate(motions(planar=True))
    assert found.undetermined == ("Ixx", "Iyy", "Ixy")
    assert found.payload is None
    assert found.directions.shape == (3, 10)
    np.testing.assert_allclose(found.directions @ found.directions.T, np.eye(3), atol=1e-12)
    assert not found.corrected
    shown = ~np.isnan(found.parameters)
    assert np.array_equal(shown, ~np.isnan(found.deviations))
    np.testing.assert_allclose(found.parameters[shown], true_parameters()[shown], atol=1e-10)
    off = [PAYLOAD_PARAMETERS.index(name) for name in found.undetermined]
    np.testing.assert_allclose(np.delete(found.directions, off, axis=1), 0.0, atol=1e-9)


def test_a_body_at_rest_shows_nothing() -> None:
    still = [BodyMotion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))] * 6
    found = estimate(still)
    assert found.undetermined == PAYLOAD_PARAMETERS
    assert np.isnan(found.deviations).all()
    assert not found.corrected


def test_errors_of_the_velocities_of_the_body_do_not_bias_its_mass() -> None:
    """Both sides have them: the robot of 40 kg turns with the body that it holds."""
    rng, moving = np.random.default_rng(5), motions(300)
    regressors, known = [], []
    for motion in moving:
        off = 0.05 * rng.normal(size=3)
        seen = replace(motion, v=motion.v + off)
        regressors.append(momentum_regressor(seen, ABOUT))
        known.append(TOTAL - momentum(motion) + np.array([*(ROBOT_MASS * off), 0.0, 0.0, 0.0]))
    found = fitted(np.array(regressors), np.array(known))
    mass, spread = found.parameters[0], found.deviations[0]
    assert spread < 1.0
    assert abs(mass - MASSES.sum()) < 3.5 * spread
    # Without the correction the errors make it lighter by their share of 40 kg.
    A, b = np.array(regressors), np.array(known)
    plain = np.linalg.lstsq(
        (A - A.mean(axis=0)).reshape(-1, 10), -(b - b.mean(axis=0)).ravel(), rcond=None
    )[0]
    assert abs(plain[0] - MASSES.sum()) > 6.0 * spread


def test_a_motion_that_drowns_in_errors_shows_nothing() -> None:
    rng = np.random.default_rng(6)
    regressors = rng.normal(size=(150, 6, 10))
    found = fitted(regressors, rng.normal(size=(150, 6)))
    assert found.undetermined == PAYLOAD_PARAMETERS
    assert found.payload is None
