"""Robots, goals and closed loops that several tests fly."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from support.oracles import Array, PinocchioOracle
from support.oracles.integrated import quaternion_rate

from spacerobot_ros.control import (
    LAWS,
    Actuation,
    ControlLaw,
    ControlState,
    GainPair,
    Gains,
    LawStatus,
    MotionLimits,
    PoseReference,
    Reference,
)
from spacerobot_ros.control.executive import ControlExecutive
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.events import Event
from spacerobot_ros.model import SpaceRobot

URDF = Path(__file__).parents[2] / "urdf"
END_EFFECTOR = "end_effector"
INVERTIBLE = ("transposed_jacobian", "model_based")


@cache
def load(name: str) -> SpaceRobot:
    return SpaceRobot.from_file(URDF / f"{name}.urdf")


def pose(position: npt.ArrayLike, rotvec: npt.ArrayLike = (0, 0, 0)) -> PoseReference:
    """Return a pose to hold; rotvec in rad."""
    return PoseReference(np.array(position, float), Rotation.from_rotvec(rotvec).as_quat())


def random_state(rng: np.random.Generator, joints: int) -> ControlState:
    """Return a state of order one in everything."""
    return ControlState(
        rng.uniform(-2, 2, 3),
        Rotation.random(random_state=rng).as_quat(),
        rng.uniform(-1, 1, 3),
        rng.uniform(-1, 1, 3),
        rng.uniform(-1.2, 1.2, joints),
        rng.uniform(-1, 1, joints),
    )


def random_pose_reference(rng: np.random.Generator) -> PoseReference:
    return PoseReference(
        rng.uniform(-2, 2, 3),
        Rotation.random(random_state=rng).as_quat(),
        *rng.uniform(-1, 1, (4, 3)),
    )


def scaled_robot(robot: SpaceRobot, factor: Callable[[], float]) -> SpaceRobot:
    """Return the robot with every mass and every inertia entry times a factor of its own."""
    root = ET.fromstring(robot.description.urdf)
    for inertial in root.iter("inertial"):
        for name in ("mass", "inertia"):
            element = inertial.find(name)
            assert element is not None
            by = factor()
            for key, value in element.attrib.items():
                element.set(key, repr(float(value) * by))
    return SpaceRobot.from_urdf(ET.tostring(root, encoding="unicode"))


# -- the paper's example ----------------------------------------------------------------------


def planar_start() -> ControlState:
    """Return paper 4's start: at rest, the system's centre of mass at the origin of W."""
    q = np.radians([-58.0, 60.3])
    attitude = Rotation.from_euler("z", 21.0, degrees=True)
    r = -attitude.apply(load("planar_manipulator").center_of_mass(q))
    return ControlState.at_rest(r, attitude.as_quat(), q)


PLANAR_GOAL = Reference(pose([0.5, 0.5, 0.0], [0.0, 0.0, np.radians(15.0)]), pose([1.5, 1.5, 0.0]))
PLANAR_GAINS = Gains.uniform(30.0, 60.0)


# -- the servicer -----------------------------------------------------------------------------

SERVICER_SHAPE = np.array([0.0, -1.2, 2.0, 0.0, 0.8, 0.0])
SERVICER_GOAL = Reference(
    pose([1.0, 0.4, -0.2], [0.1, -0.2, 0.5]), pose([2.28, 1.85, 0.79], [-0.56, 0.95, 1.05])
)
SERVICER_GAINS = {
    "transposed_jacobian": Gains(
        base_position=GainPair(400.0, 900.0),
        base_attitude=GainPair(200.0, 400.0),
        end_effector_position=GainPair(200.0, 200.0),
        end_effector_attitude=GainPair(3.0, 2.0),
        joints=GainPair(1.0, 1.0),
    ),
    "model_based": Gains.uniform(1.0, 2.0),
}
SERVICER_PACE = MotionLimits(
    speed=0.15, acceleration=0.02, angular_speed=0.15, angular_acceleration=0.02
)


def servicer_start() -> ControlState:
    return ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), SERVICER_SHAPE)


# -- executives -------------------------------------------------------------------------------


class Reporting:
    """What an executive has reported so far."""

    executive: ControlExecutive

    @property
    def statuses(self) -> list[ControllerStatus]:
        return [each for each in self.executive.outputs if isinstance(each, ControllerStatus)]

    @property
    def events(self) -> list[Event]:
        return [each for each in self.executive.outputs if isinstance(each, Event)]


def refusals(statuses: Iterable[ControllerStatus]) -> list[ControllerStatus]:
    return [each for each in statuses if each.state is ControllerState.REFUSED]


# -- closed loop ------------------------------------------------------------------------------


class PinocchioPlant(PinocchioOracle):
    """Pinocchio's articulated-body algorithm under Runge-Kutta 4, always at the present state.

    A wrench acts at the base link's origin, and efforts at the joints.
    """

    def __init__(self, robot: SpaceRobot, start: ControlState, longest_step: float = 0.01) -> None:
        super().__init__(robot.description.urdf, robot.joint_names)
        self.longest_step, self.state = longest_step, start

    @property
    def state(self) -> ControlState:
        return self._state

    @state.setter
    def state(self, state: ControlState) -> None:
        self._state = state
        self._show(self._stacked())

    def step(self, actuation: Actuation, duration: float) -> ControlState:
        """Advance under held actuation; return the new state."""
        count = max(1, round(duration / self.longest_step))
        h, n, x = duration / count, self.n, self._stacked()
        for _ in range(count):
            k1 = self._rate(x, actuation)
            k2 = self._rate(x + h / 2 * k1, actuation)
            k3 = self._rate(x + h / 2 * k2, actuation)
            k4 = self._rate(x + h * k3, actuation)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            x[3:7] /= np.linalg.norm(x[3:7])
        r, quaternion, q, v, omega, qdot = np.split(x, [3, 7, 7 + n, 10 + n, 13 + n])
        self.state = ControlState(r, quaternion, v, omega, q, qdot)
        return self.state

    def joint_accelerations(self, actuation: Actuation) -> Array:
        udot = self.own_acceleration(actuation.wrench_B, actuation.tau)
        return np.asarray(self.selection[3:] @ udot)

    def _stacked(self) -> Array:
        s = self.state
        return np.concatenate([s.r_WB, s.quaternion_WB, s.q, s.v_WB_B, s.omega_WB_B, s.qdot])

    def _show(self, x: Array) -> None:
        twist, qdot = np.split(x[7 + self.n :], [6])
        self.place(x[7 : 7 + self.n], x[3:7] / np.linalg.norm(x[3:7]), x[:3])
        self.move(self.base_velocities(twist) + self.joint_velocities(qdot))

    def _rate(self, x: Array, actuation: Actuation) -> Array:
        self._show(x)
        v, omega, qdot = np.split(x[7 + self.n :], [3, 6])
        udot = self.own_acceleration(actuation.wrench_B, actuation.tau)
        velocity = self.data.oMi[1].rotation @ v
        turn = quaternion_rate(x[3:7], omega)
        return np.concatenate([velocity, turn, qdot, udot[:6], self.selection[3:] @ udot])


def law_of(name: str, robot: SpaceRobot, gains: Gains, **options: float) -> ControlLaw:
    law = LAWS[name]
    return law(robot, law.default_outputs(robot, END_EFFECTOR), gains, law.Options(**options))


@dataclass
class Flight:
    """What a closed loop did, sampled at ticks."""

    states: list[ControlState] = field(default_factory=list)
    errors: list[Array] = field(default_factory=list)
    """Of the law's outputs against the reference of the tick."""
    actuations: list[Actuation] = field(default_factory=list)
    statuses: list[LawStatus] = field(default_factory=list)


def fly(
    plant: PinocchioPlant,
    law: ControlLaw,
    reference: Callable[[float], Reference],
    duration: float,
    rate: float = 100.0,
    every: int = 1,
) -> Flight:
    """Close the loop over a plant: commands are held for a tick; every so many are sampled."""
    flight = Flight()
    for tick in range(round(duration * rate) + 1):
        actuation = law.command(plant.state, reference(tick / rate))
        if tick % every == 0:
            flight.states.append(plant.state)
            flight.errors.append(law.error)
            flight.actuations.append(actuation)
            flight.statuses.append(law.status)
        plant.step(actuation, 1 / rate)
    return flight
