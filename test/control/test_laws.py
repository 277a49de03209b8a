"""The laws: what they have in common, their formulas, and their behaviour at singularities."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pinocchio as pin
import pytest
from control.flights import (
    END_EFFECTOR,
    INVERTIBLE,
    PLANAR_GAINS,
    PLANAR_GOAL,
    SERVICER_GAINS,
    SERVICER_SHAPE,
    PinocchioPlant,
    fly,
    law_of,
    load,
    planar_start,
    pose,
    random_pose_reference,
    random_state,
    scaled_robot,
)
from scipy.linalg import block_diag, expm
from scipy.spatial.transform import Rotation
from support.executive_loop import UPRIGHT
from support.oracles import Array
from support.random_robots import random_robot_urdf
from support.sentences import assert_one_sentence

from spacerobot_ros import fly as fly_robot
from spacerobot_ros.control import (
    LAWS,
    Actuation,
    ControlLaw,
    ControlState,
    GainPair,
    Gains,
    JointReference,
    OutputSelection,
    PoseReference,
    Reference,
    TargetNotSetError,
)
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.laws.model_based import ModelBasedLaw
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.inverse_kinematics import AXES
from spacerobot_ros.parameters import configured, declared
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario, scenario_names

# -- states, references and output accelerations of the servicer ---------------------------------

GAINS = Gains(
    GainPair(3.0, 4.0), GainPair(2.0, 3.5), GainPair(5.0, 6.0), GainPair(7.0, 5.5), GainPair(1, 2)
)
KP = np.repeat([3.0, 2.0, 5.0, 7.0], 3)
KD = np.repeat([4.0, 3.5, 6.0, 5.5], 3)
POSES = OutputSelection(AXES, AXES, (), END_EFFECTOR)


def well_conditioned_state(rng: np.random.Generator) -> ControlState:
    """Return a moving servicer with its arm away from singularities."""
    state = random_state(rng, 6)
    return replace(state, q=SERVICER_SHAPE + rng.uniform(-0.2, 0.2, 6))


def random_reference(rng: np.random.Generator) -> Reference:
    return Reference(random_pose_reference(rng), random_pose_reference(rng))


class OutputMotion(PinocchioPlant):
    """Velocities (12,) and accelerations (12,) of base and end-effector pose, from Pinocchio."""

    def __init__(self, robot: SpaceRobot, state: ControlState, actuation: Actuation) -> None:
        super().__init__(robot, state)
        udot = self.own_acceleration(actuation.wrench_B, actuation.tau)
        pin.forwardKinematics(self.model, self.data, self.q, self.u, udot)
        pin.updateFramePlacements(self.model, self.data)
        self.links = (robot.base_link, END_EFFECTOR)
        self.velocity = self._all(pin.getFrameVelocity)
        self.acceleration = self._all(pin.getFrameClassicalAcceleration)

    def _all(self, function: Callable[..., pin.Motion]) -> Array:
        axes = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        frames = [self.model.getFrameId(link, pin.FrameType.BODY) for link in self.links]
        motions = [function(self.model, self.data, frame, axes) for frame in frames]
        return np.concatenate([part for m in motions for part in (m.linear, m.angular)])

    def errors(self, reference: Reference) -> tuple[Array, Array, Array]:
        """Return errors, error rates, and the wanted accelerations, each (12,)."""
        error, velocity, acceleration = [], [], []
        for link, wanted in zip(self.links, (reference.base, reference.end_effector), strict=True):
            assert wanted is not None
            R, r = self.frame_W(link)
            turn = Rotation.from_quat(wanted.quaternion) * Rotation.from_matrix(R).inv()
            error += [wanted.position - r, turn.as_rotvec()]
            velocity += [wanted.velocity, wanted.angular_velocity]
            acceleration += [wanted.acceleration, wanted.angular_acceleration]
        rate = np.concatenate(velocity) - self.velocity
        return np.concatenate(error), rate, np.concatenate(acceleration)


# -- what laws have in common --------------------------------------------------------------------


def test_a_law_without_its_reference_says_which() -> None:
    law = law_of("transposed_jacobian", load("servicer"), GAINS)
    state = random_state(np.random.default_rng(1), 6)
    with pytest.raises(TargetNotSetError, match="the end-effector"):
        law.command(state, Reference(base=pose([0, 0, 0])))


def test_registry_and_options() -> None:
    assert set(LAWS) == {"transposed_jacobian", "model_based", "computed_torque"}
    robot = load("planar_manipulator")
    for name, law in LAWS.items():
        assert law.name == name
        built = law(robot, law.default_outputs(robot, END_EFFECTOR), PLANAR_GAINS, law.Options())
        assert isinstance(built, ControlLaw)
        for option in declared(law.Options):
            for value in (option.minimum - 1.0, np.nan):
                options = law.Options(**{option.name: value})
                with pytest.raises(ParameterError, match=f"'{option.name}'"):
                    law(robot, built.outputs.selection, PLANAR_GAINS, options)


class _Spring(ControlLaw):
    """A law as somebody else may write it: it pulls the outputs."""

    name = "spring"
    gain_units = ("N/m", "N s/m")

    def results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        z1 = self.outputs
        pull = symbols["kp"] * z1.error + symbols["kd"] * z1.error_rate
        return {"actuation": (z1.J_z @ z1.J_q_inverse).T @ pull}


def test_a_law_says_which_gains_it_lacks() -> None:
    robot = load("planar_manipulator")
    outputs, gains = _Spring.default_outputs(robot, END_EFFECTOR), Gains.uniform(1.0, 2.0)
    with pytest.raises(ParameterError) as refused:
        _Spring(robot, outputs, replace(gains, base_attitude=GainPair(1.0)))
    assert_one_sentence(str(refused.value), "The law 'spring' has no automatic gains")
    with pytest.raises(ParameterError) as refused:
        _Spring(robot, outputs, gains).set_gains(Gains.uniform(1.0, 1.0, 0.1))
    assert str(refused.value) == "The law 'spring' has no integral term: its gains ki must be 0."


@pytest.mark.parametrize(
    ("results", "shape"), [({"actuation": ca.SX(5, 1)}, "(5, 1)"), ({"tau": ca.SX(8, 1)}, "(0, 1)")]
)
def test_a_command_of_the_wrong_size_is_refused(results: dict[str, ca.SX], shape: str) -> None:
    class Short(_Spring):
        def results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
            return results

    robot = load("planar_manipulator")
    with pytest.raises(ParameterError) as refused:
        Short(robot, Short.default_outputs(robot, END_EFFECTOR), PLANAR_GAINS)
    assert_one_sentence(str(refused.value), f"has shape {shape}; it must be a column of 8")


@pytest.mark.parametrize(
    "chosen",
    [
        {},
        {"law": "model_based"},
        {"law": "model_based", "model_based.posture_stiffness": 2.0, "end_effector_outputs": "x"},
    ],
)
def test_on_its_way_to_a_goal_the_law_is_given_the_reference_of_that_time(
    chosen: dict[str, str | float],
) -> None:
    config = configured(
        ControllerConfig, {"profile": "quintic", "max_force": 0.0, "max_torque": 0.0, **chosen}
    )
    robot = load("planar_manipulator")
    controller, state = build_controller(robot, config), planar_start()
    controller.command(2.0, state, state.q, state.qdot)
    shape = state.q + np.array([0.4, -0.3])
    hand = PLANAR_GOAL.end_effector
    controller.set_goals(2.0, state, base=PLANAR_GOAL.base, end_effector=hand, joints=shape)
    assert controller.profile is not None
    alone = build_controller(robot, config).law
    for share in (0.2, 0.5, 0.9, 1.0):
        time = 2.0 + share * controller.profile.duration
        result = controller.command(time, state, state.q, state.qdot)
        wanted = alone.command(state, controller.profile.at(time - 2.0))
        found = result.realised.tau + result.excess.tau
        assert np.abs(wanted.tau).max() > 1e-3
        np.testing.assert_allclose(found, wanted.tau, rtol=1e-9, atol=1e-12)
        found = result.realised.wrench_B + result.excess.wrench_B
        np.testing.assert_allclose(found, wanted.wrench_B, rtol=1e-9, atol=1e-12)


def test_the_units_of_gains_in_the_parameters_are_those_of_the_laws() -> None:
    for name, law in LAWS.items():
        for gain, unit in zip(("kp", "kd"), law.gain_units, strict=True):
            (described,) = (
                each.description
                for each in declared(ControllerConfig)
                if each.name == f"gains.base_position.{gain}"
            )
            stated = next(part for part in described.split(" with ")[1:] if name in part)
            before = described.split(stated)[0]
            assert before.endswith(f"{unit} with ")


@pytest.mark.parametrize("law", list(LAWS))
def test_gains_are_bounded_so_that_commands_are_numbers(law: str) -> None:
    groups = [name for name in vars(Gains()) if not name.endswith("_matrix")]
    names = [f"gains.{group}.{gain}" for group in groups for gain in ("kp", "kd")]
    for name in names:
        with pytest.raises(ParameterError, match=name.replace(".", r"\.")):
            configured(ControllerConfig, {"law": law, name: 1e300})
    with pytest.raises(ParameterError, match=r"'max_force' is 1e[+]160; .* 1e-100 to 1e[+]100"):
        configured(ControllerConfig, {"law": law, "max_force": 1e160})
    largest = configured(ControllerConfig, {"law": law, **dict.fromkeys(names, 1e9)})
    controller = build_controller(load("planar_manipulator"), largest)
    state = replace(planar_start(), qdot=np.array([0.5, -0.25]))
    controller.command(0.0, state, state.q, state.qdot)
    result = controller.command(0.01, replace(state, r_WB=np.full(3, 100.0)), state.q, state.qdot)
    for part in (result.realised, result.excess):
        assert np.isfinite(part.wrench_B).all()
        assert np.isfinite(part.tau).all()


# -- the laws against Pinocchio's accelerations and against the paper's own formulas -------------


def positive_matrix(rng: np.random.Generator, size: int) -> Array:
    A = rng.normal(size=(size, size))
    return np.asarray(A @ A.T + size * np.eye(size))


@pytest.mark.parametrize("seed", range(5))
def test_errors_have_the_dynamics_of_the_gains_which_may_be_matrices(seed: int) -> None:
    """Eq. (28) by Pinocchio's accelerations, and eq. (29); gains that change take effect."""
    rng = np.random.default_rng(seed)
    robot = load("servicer")
    state, reference = well_conditioned_state(rng), random_reference(rng)
    Kp, Kd = positive_matrix(rng, 12), positive_matrix(rng, 12)
    gains = replace(
        GAINS, kp_matrix=tuple(Kp.ravel().tolist()), kd_matrix=tuple(Kd.ravel().tolist())
    )
    matrices = PaperMatrices(state)
    law, transposed = (
        LAWS[name](robot, POSES, GAINS) for name in ("model_based", "transposed_jacobian")
    )
    for given, K, D, atol in ((gains, Kp, Kd, 1e-8), (GAINS, np.diag(KP), np.diag(KD), 1e-9)):
        law.set_gains(given)
        motion = OutputMotion(robot, state, law.command(state, reference))
        e, edot, wanted = motion.errors(reference)
        residual = wanted - motion.acceleration + D @ edot + K @ e
        np.testing.assert_allclose(residual, 0.0, atol=atol)
        np.testing.assert_allclose(law.error, e, atol=1e-12)
        np.testing.assert_allclose(law.error_rate, edot, atol=1e-12)
        assert not law.status.singular
        assert law.status.damping == 0.0
        transposed.set_gains(given)
        expected = matrices.actuation(matrices.J_z.T @ (K @ e + D @ edot))
        found = np.concatenate(transposed.command(state, reference))
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("matrix", "sentence"),
    [
        ([1.0, 0.0, 0.0, 1.0], "has 4 values; the 5 outputs of the law .* require 25"),
        (np.triu(np.ones((5, 5))), "is not symmetric"),
        (np.diag([1.0, 1.0, 0.0, 1.0, 1.0]), "is not positive definite"),
    ],
)
def test_matrices_that_are_no_gains_are_refused(matrix: Any, sentence: str) -> None:
    for name in ("kp_matrix", "kd_matrix"):
        numbers = np.ravel(matrix).tolist()
        config = configured(ControllerConfig, {f"gains.{name}": numbers})
        with pytest.raises(ParameterError, match=rf"^Parameter 'gains\.{name}' {sentence}"):
            build_controller(load("planar_manipulator"), config)


def test_a_flight_with_matrices_of_gains_moves_along_their_modes() -> None:
    """A free body under a step: its way is that of the linear system, by the exponential."""
    K, D = np.array([[0.5, 0.2], [0.2, 0.3]]), np.array([[1.0, -0.3], [-0.3, 1.2]])
    parameters = {
        **{"plant.tick_rate": 100.0, "coordinated_control.tick_rate": 100.0},
        **{"coordinated_control.base_outputs": "x y", "coordinated_control.profile": "step"},
        "coordinated_control.gains.kp_matrix": K.ravel().tolist(),
        "coordinated_control.gains.kd_matrix": D.ravel().tolist(),
    }
    flight = fly_robot(
        "planar_manipulator", position=[0.4, 0.0, 0.0], method="model_based", parameters=parameters
    )
    assert flight.succeeded
    motion = np.block([[np.zeros((2, 2)), np.eye(2)], [-K, -D]])
    for tick in range(0, 800, 50):
        error = expm(motion * flight.time[tick]) @ [0.4, 0.0, 0.0, 0.0]
        np.testing.assert_allclose([0.4, 0.0] - flight.pose[tick, :2], error[:2], atol=2e-3)
    assert np.abs(flight.pose[:, 1]).max() > 0.02, "the errors are coupled"


class PaperMatrices:
    """The paper's matrices of the servicer, in numpy, from H+, C+ and J+ alone."""

    def __init__(self, state: ControlState) -> None:
        robot = load("servicer")
        R = Rotation.from_quat(state.quaternion_WB).as_matrix()
        self._of_base = robot.jacobian(robot.base_link, state.q)
        self.J_q = np.vstack([self._of_base, np.eye(12)[6:]])
        twist = np.concatenate([state.v_WB_B, state.omega_WB_B, state.qdot])
        self.z0dot = np.linalg.solve(self.J_q, twist)
        self.H = robot.inertia_matrix(state.q)
        self.C = robot.bias(state.q, self.z0dot[:3], state.omega_WB_B, state.qdot)
        in_base = np.vstack([self._of_base, robot.jacobian(END_EFFECTOR, state.q)])
        self.J_z = block_diag(R, R, R, R) @ in_base

    def actuation(self, Q: Array) -> Array:
        """Invert eq. (21)."""
        return np.asarray(np.linalg.solve(self.J_q.T, Q))


@pytest.mark.parametrize("seed", range(5))
def test_laws_are_the_printed_ones(seed: int) -> None:
    """Eqs (24), (25), (27), (29) and (30), with ``J_z^-1``, for a square J_z.

    A quaternion of the other sign is the same state, and masses cancel from eq. (29).
    """
    rng = np.random.default_rng(100 + seed)
    robot = load("servicer")
    wrong = scaled_robot(robot, lambda: float(rng.uniform(0.5, 2.0)))
    state, reference = well_conditioned_state(rng), random_reference(rng)
    at = PaperMatrices(state)
    step = 1e-6

    def moved(time: float) -> PaperMatrices:
        turn = Rotation.from_quat(state.quaternion_WB) * Rotation.from_rotvec(
            time * state.omega_WB_B
        )
        return PaperMatrices(
            replace(state, quaternion_WB=turn.as_quat(), q=state.q + time * state.qdot)
        )

    J_z_dot = (moved(step).J_z - moved(-step).J_z) / (2 * step)
    motion = OutputMotion(robot, state, Actuation(np.zeros(6), np.zeros(6)))
    e, edot, wanted = motion.errors(reference)

    J_inverse = np.linalg.inv(at.J_z)
    H_tilde = J_inverse.T @ at.H @ J_inverse
    C_tilde = J_inverse.T @ at.C - H_tilde @ J_z_dot @ at.z0dot
    Q_27 = at.J_z.T @ (H_tilde @ (KP * e + KD * edot + wanted) + C_tilde)
    Q_29 = at.J_z.T @ (KP * e + KD * edot)
    smallest = np.linalg.svd(at.J_z, compute_uv=False)[-1]
    for name, believed, Q, tolerance in (
        ("model_based", robot, Q_27, 1e-7),
        ("transposed_jacobian", robot, Q_29, 1e-12),
        ("transposed_jacobian", wrong, Q_29, 1e-12),
    ):
        law = LAWS[name](believed, POSES, GAINS)
        found = np.concatenate(law.command(state, reference))
        expected = at.actuation(Q)
        np.testing.assert_allclose(
            found, expected, atol=tolerance * float(np.linalg.norm(expected))
        )
        other = law.command(replace(state, quaternion_WB=-state.quaternion_WB), reference)
        np.testing.assert_allclose(np.concatenate(other), found, rtol=1e-12)
        if believed is robot:
            assert law.status.smallest_singular_value == pytest.approx(smallest, rel=1e-9)


# -- arms stretched out or folded (paper 4: sin q2 = 0), and goals out of reach ------------------


GOAL = Reference(pose([0, 0, 0]), pose([1.5, 1.2, 0]))


def stretched(elbow: float) -> ControlState:
    return ControlState.at_rest(np.zeros(3), UPRIGHT, np.array([0.3, elbow]))


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
    plant = PinocchioPlant(robot, stretched(elbow))
    flight = fly(plant, law, lambda _: GOAL, 15.0, rate=50.0, every=10)
    assert flight.statuses[0].singular
    assert not flight.statuses[-1].singular
    assert np.abs(flight.errors[-1]).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", INVERTIBLE)
def test_goal_out_of_reach_is_approached_and_held_quietly(name: str) -> None:
    """The base is to stay, and the end-effector to go a metre beyond the stretched arm."""
    robot = load("planar_manipulator")
    goal = Reference(pose([0, 0, 0]), pose([3.5, 1, 0]))
    plant, law = PinocchioPlant(robot, stretched(0.8)), law_of(name, robot, PLANAR_GAINS)
    flight = fly(plant, law, lambda _: goal, 20.0, rate=100.0, every=5)
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


@pytest.mark.parametrize("wrist", [0.0, 0.02, -0.8])
def test_a_motion_through_a_singularity_is_followed(wrist: float) -> None:
    """Its wrench and efforts, for Pinocchio, are the command if the reference has its joints."""
    rng, robot = np.random.default_rng(5), load("servicer")
    state = replace(well_conditioned_state(rng), q=np.array([0.2, -1.2, 2.0, 0.3, wrist, -0.4]))
    wanted = Actuation(rng.uniform(-5.0, 5.0, 6), rng.uniform(-0.1, 0.1, 6))
    motion, present = OutputMotion(robot, state, wanted), Reference.present(robot, state, "")
    assert present.base is not None
    R, r = motion.frame_W(END_EFFECTOR)
    velocities, accelerations = np.split(motion.velocity, 4), np.split(motion.acceleration, 4)
    places = (
        (present.base.position, present.base.quaternion),
        (r, Rotation.from_matrix(R).as_quat()),
    )
    base, hand = (
        PoseReference(*place, *velocities[i : i + 2], *accelerations[i : i + 2])
        for place, i in zip(places, (0, 2), strict=True)
    )
    joints = JointReference(state.q, state.qdot, motion.joint_accelerations(wanted))
    law = law_of("model_based", robot, GAINS)
    given = law.command(state, Reference(base, hand, joints, of_one_motion=True))
    assert law.status.singular == (abs(wrist) < 0.1)
    np.testing.assert_allclose(given.wrench_B, wanted.wrench_B, atol=1e-6)
    np.testing.assert_allclose(given.tau, wanted.tau, atol=1e-6)


def test_far_from_singularities_the_command_takes_one_evaluation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    law = law_of("model_based", load("planar_manipulator"), PLANAR_GAINS)

    def computed(*_: object, **__: object) -> None:
        raise AssertionError("the singular values are computed for every command")

    with monkeypatch.context() as patch:
        patch.setattr(np.linalg, "svd", computed)
        law.command(stretched(1.5), GOAL)
        with pytest.raises(AssertionError, match="singular values"):
            law.command(stretched(0.01), GOAL)
    law.command(stretched(1.5), GOAL)
    assert not law.status.singular


def _command_once(robot: SpaceRobot, config: ControllerConfig, shape: Sequence[float]) -> None:
    """Command a robot at rest in a shape, 0 for joints beyond the given ones."""
    controller = build_controller(robot, config)
    positions = dict.fromkeys(robot.joint_names, 0.0) | dict(
        zip(robot.joint_names, shape, strict=False)
    )
    q = np.array([positions[name] for name in controller.law.robot.joint_names])
    state = ControlState.at_rest(np.zeros(3), UPRIGHT, q)
    controller.command(0.0, state, state.q, state.qdot)


@pytest.mark.parametrize("name", scenario_names())
def test_no_scenario_has_gains_that_are_too_high_for_its_period(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    scenario = load_scenario(name)
    robot = SpaceRobot.from_file(robot_file(scenario.plant.robot))
    _command_once(
        robot, scenario.config("coordinated_control"), scenario.plant.initial_joint_positions
    )
    assert not caplog.records


@pytest.mark.parametrize("share", [0.9, 1.1])
@pytest.mark.parametrize("law", LAWS)
def test_gains_that_are_too_high_for_the_period_are_warned_of(
    law: str, share: float, caplog: pytest.LogCaptureFixture
) -> None:
    """``kd`` times the period against the inertia decides, if commands come a period late."""
    period, hull, wheel = 0.02, 0.01, 0.02
    # The joint meets both bodies in series; the other laws command accelerations.
    inertia = hull * wheel / (hull + wheel) if law == "transposed_jacobian" else 1.0
    # A sentence is said once: those of the laws differ.
    kd = (share + 0.001 * len(law)) * inertia / period
    base = "" if law == "computed_torque" else "rz"
    outputs = {"base_outputs": base, "joint_outputs": "turn"}
    gains = {"gains.joints.kp": 0.01 * kd, "gains.joints.kd": kd}
    values = {"law": law, "tick_rate": 1 / period, **outputs, **gains}
    robot = SpaceRobot.from_urdf(_turner(hull, wheel))
    _command_once(robot, configured(ControllerConfig, values), [])
    rates = [1.0, 1.0]
    for _ in range(200):
        # The joint's rate under commands that answer the state before.
        rates.append(rates[-1] - period * kd / inertia * rates[-2])
    assert (abs(rates[-1]) > 1.0) is (share > 1.0)
    if share < 1.0:
        assert not caplog.records
    else:
        (record,) = caplog.records
        assert_one_sentence(
            record.getMessage(), f"kd = {kd:g}", "'joint.turn'", "0.02 s", "tick_rate"
        )
        if law == "transposed_jacobian":
            assert "inertia (or mass) of 0.007" in record.getMessage()


def _turner(hull: float, wheel: float) -> str:
    def link(name: str, inertia: float) -> str:
        diagonal = " ".join(f'{axis}="{inertia}"' for axis in ("ixx", "iyy", "izz"))
        return (
            f'<link name="{name}"><inertial><mass value="1"/>'
            f'<inertia {diagonal} ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )

    return (
        f'<robot name="turner">{link("hull", hull)}{link("wheel", wheel)}'
        '<joint name="turn" type="continuous"><parent link="hull"/><child link="wheel"/>'
        '<axis xyz="0 0 1"/><limit velocity="600" effort="0.2"/></joint></robot>'
    )


# -- paper 3's efforts, and outputs fewer than degrees of freedom --------------------------------

ROBOTS = ("planar_chain", "random_0", "random_1", "random_2", "servicer")


def robot_of(name: str) -> SpaceRobot:
    if not name.startswith("random"):
        return load(name)
    seed = int(name[-1])
    return SpaceRobot.from_urdf(random_robot_urdf(np.random.default_rng(seed), 4 + seed))


@pytest.mark.parametrize("name", ROBOTS)
def test_shape_obeys_the_commanded_acceleration(name: str) -> None:
    """Eqs (7-9), at any momentum: ``qddot = u`` by Pinocchio."""
    rng = np.random.default_rng(30)
    robot = robot_of(name)
    state = random_state(rng, robot.n)
    joints = JointReference(*rng.uniform(-1, 1, (3, robot.n)))
    law = law_of("computed_torque", robot, Gains.uniform(3.0, 2.0))
    actuation = law.command(state, Reference(joints=joints))
    u = joints.qddot + 2.0 * (joints.qdot - state.qdot) + 3.0 * (joints.q - state.q)
    qddot = PinocchioPlant(robot, state).joint_accelerations(actuation)
    np.testing.assert_allclose(qddot, u, atol=1e-10)
    np.testing.assert_array_equal(actuation.wrench_B, 0.0)


def test_outputs_are_all_joints_in_the_order_of_the_model() -> None:
    robot = load("planar_chain")
    law = LAWS["computed_torque"]
    gains = Gains.uniform(1.0, 2.0)
    assert law(robot, OutputSelection(joints=("pin_2", "pin_1")), gains).outputs.labels == (
        "joint.pin_1",
        "joint.pin_2",
    )
    for refused in (
        OutputSelection(joints=("pin_1",)),
        OutputSelection(base=("x",), joints=("pin_1", "pin_2")),
    ):
        with pytest.raises(ParameterError, match="the joints pin_1, pin_2"):
            law(robot, refused, gains)


# -- fewer outputs than degrees of freedom: what the other motion does ---------------------------


def test_null_space_damping_and_posture() -> None:
    """Three outputs of twelve: the rest comes to rest, or moves towards the posture."""
    robot = load("servicer")
    rng = np.random.default_rng(5)
    start = ControlState(
        np.zeros(3),
        UPRIGHT,
        rng.uniform(-0.05, 0.05, 3),
        rng.uniform(-0.05, 0.05, 3),
        SERVICER_SHAPE,
        rng.uniform(-0.1, 0.1, 6),
    )
    posture = SERVICER_SHAPE + np.array([0.2, 0.2, -0.3, 0.1, 0.2, 0.4])
    goal = Reference(end_effector=pose([1.8, 0.2, 0.4]), joints=JointReference.at_rest(posture))
    selection = OutputSelection(end_effector=("x", "y", "z"), end_effector_link=END_EFFECTOR)
    away = {}
    for stiffness in (0.0, 1.0):
        law = ModelBasedLaw(
            robot,
            selection,
            Gains.uniform(1.0, 2.0),
            ModelBasedLaw.Options(null_space_damping=2.0, posture_stiffness=stiffness),
        )
        flight = fly(PinocchioPlant(robot, start), law, lambda _: goal, 12.0, rate=25.0, every=10)
        last = flight.states[-1]
        assert np.abs(flight.errors[-1]).max() < 1e-3
        speed = np.abs(np.concatenate([last.v_WB_B, last.omega_WB_B, last.qdot])).max()
        assert speed < (5e-3 if stiffness else 1e-4)
        away[stiffness] = last.q - posture
    # The pull is weighed by inertia: the heavy inner joints follow it first.
    assert np.abs(away[1.0][:3]).max() < 0.1
    assert np.abs(away[0.0][:3]).max() > 0.2
    assert np.linalg.norm(away[1.0]) < 0.7 * np.linalg.norm(away[0.0])


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_joint_damping_of_the_transposed_jacobian(damping: float) -> None:
    """Nine outputs of twelve: the wrist swings on unless it is damped."""
    robot = load("servicer")
    still = ControlState.at_rest(np.zeros(3), UPRIGHT, SERVICER_SHAPE)
    start = replace(still, qdot=np.array([0.0, 0.0, 0.0, 0.4, -0.3, 0.5]))
    law = TransposedJacobianLaw(
        robot,
        OutputSelection(AXES, ("x", "y", "z"), (), END_EFFECTOR),
        SERVICER_GAINS["transposed_jacobian"],
        TransposedJacobianLaw.Options(joint_damping=damping),
    )
    goal = Reference.present(robot, still, END_EFFECTOR)
    flight = fly(PinocchioPlant(robot, start), law, lambda _: goal, 12.0, rate=50.0, every=10)
    moving = np.abs(flight.states[-1].qdot).max()
    assert moving < 0.01 if damping else moving > 0.1
