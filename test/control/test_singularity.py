"""Arms stretched out or folded (paper 4: sin q2 = 0), and goals out of reach."""

from __future__ import annotations

import numpy as np
import pytest
from control.flights import (
    END_EFFECTOR,
    INVERTIBLE,
    PLANAR_GAINS,
    Flight,
    fly,
    law_of,
    load,
    plant_of,
    pose,
)

from spacerobot_ros.control import ControlLaw, ControlState, Gains, Reference

LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
GOAL = Reference(pose([0, 0, 0]), pose([1.5, 1.2, 0]))


def stretched(elbow: float) -> ControlState:
    return ControlState.at_rest(np.zeros(3), LEVEL, np.array([0.3, elbow]))


def size(law: ControlLaw, elbow: float) -> float:
    """Return the length of the command (SI) with the elbow at an angle."""
    actuation = law.command(stretched(elbow), GOAL)
    return float(np.linalg.norm(np.concatenate([actuation.wrench_B, actuation.tau])))


@pytest.mark.parametrize("elbow", [0.0, np.pi, -np.pi, 1e-12, 1e-6, 1e-3, -0.05])
def test_singular_arm(elbow: float) -> None:
    robot = load("planar_manipulator")
    transposed, model_based = (law_of(name, robot, PLANAR_GAINS) for name in INVERTIBLE)
    # No more than the errors ask for: it inverts nothing.
    assert size(transposed, elbow) < 300.0
    assert transposed.status.damping == 0.0
    assert size(model_based, elbow) < 1000.0
    smallest = model_based.status.smallest_singular_value
    assert model_based.status.damping == pytest.approx(np.sqrt(0.1**2 - smallest**2))
    for law in (transposed, model_based):
        assert law.status.singular
        assert law.status.smallest_singular_value < 0.02


def test_eq_27_as_printed_fails_at_a_singularity() -> None:
    """Its ``Htilde = J_z^-T H+ J_z^-1`` has no bound there, so neither has the command."""
    robot = load("planar_manipulator")
    law = law_of("transposed_jacobian", robot, PLANAR_GAINS)
    H = robot.inertia_matrix(np.array([0.3, 1.0]))[np.ix_([0, 1, 5, 6, 7], [0, 1, 5, 6, 7])]
    sizes = []
    for elbow in (1.0, 1e-3, 1e-6):
        law.command(stretched(elbow), GOAL)
        inverse = np.linalg.inv(law._out["J_z"][:, [0, 1, 5, 6, 7]])
        sizes.append(float(np.linalg.norm(H @ inverse @ law.error)))
    assert sizes[2] > 900.0 * sizes[1] > 900.0 * 50.0 * sizes[0]


def test_damping_sets_in_smoothly() -> None:
    """The command has no jump at the threshold, and without damping it explodes."""
    robot = load("planar_manipulator")
    law = law_of("model_based", robot, PLANAR_GAINS)
    sizes, dampings = [], []
    for elbow in np.linspace(0.25, 0.4, 61):
        sizes.append(size(law, elbow))
        dampings.append(law.status.damping)
        assert law.status.singular == (law.status.damping > 0)
    assert np.abs(np.diff(sizes)).max() < 0.02 * max(sizes)
    assert dampings[0] > 0.0
    assert dampings[-1] == 0.0
    undamped = law_of("model_based", robot, PLANAR_GAINS, singular_value_threshold=1e-6)
    assert size(undamped, 1e-5) > 1e5 > 100 * size(law, 1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", INVERTIBLE)
@pytest.mark.parametrize("elbow", [0.0, 0.05])
def test_flight_out_of_a_singularity(name: str, elbow: float) -> None:
    robot = load("planar_manipulator")
    law = law_of(name, robot, PLANAR_GAINS)
    flight = fly(plant_of(robot, stretched(elbow)), law, lambda _: GOAL, 15.0, rate=50.0, every=10)
    assert flight.statuses[0].singular
    assert not flight.statuses[-1].singular
    assert np.abs(flight.errors[-1]).max() < 1e-3


def out_of_reach(name: str) -> Flight:
    """Hold the base while the end-effector is wanted a metre beyond the stretched arm."""
    robot = load("planar_manipulator")
    goal = Reference(pose([0, 0, 0]), pose([3.5, 1, 0]))
    law = law_of(name, robot, PLANAR_GAINS)
    return fly(plant_of(robot, stretched(0.8)), law, lambda _: goal, 20.0, rate=100.0, every=5)


@pytest.mark.slow
@pytest.mark.parametrize("name", INVERTIBLE)
def test_goal_out_of_reach_is_approached_and_held_quietly(name: str) -> None:
    flight = out_of_reach(name)
    last = flight.states[-1]
    rates = np.concatenate([last.v_WB_B, last.omega_WB_B, last.qdot])
    assert np.abs(rates).max() < 0.05
    assert abs(last.q[1]) < 0.02, "the arm is stretched"
    # What is left is shared: the forces on base and end-effector cancel, as the paper says of
    # trajectories that are not feasible.
    error = flight.errors[-1]
    np.testing.assert_allclose(error[:2], -error[3:], atol=0.01)
    assert flight.statuses[-1].singular
    peak = max(np.abs([*a.wrench_B, *a.tau]).max() for a in flight.actuations)
    assert peak < 200.0


@pytest.mark.parametrize("name", INVERTIBLE)
def test_wrist_singularity_of_the_spatial_arm(name: str) -> None:
    """A straight wrist: two joint axes in line."""
    robot = load("servicer")
    gains = Gains.uniform(1.0, 2.0)
    q = np.array([0.2, -1.2, 2.0, 0.3, 0.0, -0.4])
    start = ControlState.at_rest(np.zeros(3), LEVEL, q)
    law = law_of(name, robot, gains)
    present = Reference.present(robot, start, END_EFFECTOR)
    assert present.end_effector is not None
    goal = Reference(
        pose([0.1, 0.1, 0.0], [0.0, 0.1, 0.1]),
        pose(present.end_effector.position + 0.1, [0.3, 0.4, 0.2]),
    )
    actuation = law.command(start, goal)
    assert law.status.singular
    assert law.status.smallest_singular_value < 1e-12
    assert np.abs(np.concatenate([actuation.wrench_B, actuation.tau])).max() < 500.0


def test_far_from_singularities_the_command_takes_one_evaluation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    law = law_of("model_based", load("planar_manipulator"), PLANAR_GAINS)

    def damped(*_: object) -> None:
        raise AssertionError("the singular values are computed for every command")

    monkeypatch.setattr(type(law), "_damped_actuation", damped)
    law.command(stretched(1.5), GOAL)
    assert not law.status.singular
    with pytest.raises(AssertionError, match="singular values"):
        law.command(stretched(0.01), GOAL)
