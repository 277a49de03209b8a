"""A free-floating robot in MuJoCo, moved by the commands that a plant has carried out.

An independent engine: masses, kinematics and inertia matrices are MuJoCo's, from the same URDF.
Under efforts it integrates the equations of motion by its own Runge-Kutta 4. Under velocities the
base follows from MuJoCo's momentum matrices, by a Runge-Kutta 4 here. Contacts, stops and friction
in joints are off. External loads act on MuJoCo's bodies, at every stage of every step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.lazy import optional_module
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.external_loads import LoadLayout
from spacerobot_ros.model.rotations import cross, matrix_from_quaternion, quaternion_multiply

EFFORT_STEP = 0.001
"""Longest Runge-Kutta step under efforts, s."""

VELOCITY_STEP = 0.01
"""Longest Runge-Kutta step of the base under held velocities, s."""


_MIN_INERTIA = 1e-12
"""Smallest principal inertia, kg m^2: MuJoCo takes no point masses."""


def import_mujoco() -> Any:
    """Return the module of MuJoCo; see :func:`.optional_module`."""
    return optional_module("mujoco", "mujoco", "Flights in MuJoCo need")


def mujoco_spec(mujoco: Any, description: RobotDescription) -> Any:
    """Return MuJoCo's specification of a robot whose base is free; its shapes are left out.

    Raises
    ------
    RobotDescriptionError
        MuJoCo refuses the robot, or a joint follows another one.
    """
    if description.has_mimic_joints:
        raise RobotDescriptionError(
            f"Robot '{description.name}' has joints that follow others (<mimic>), which MuJoCo "
            "does not read from a URDF."
        )
    root = ElementTree.fromstring(description.urdf)
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)  # MuJoCo would look for the files of meshes.
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise _refused(description, error) from error
    spec.compiler.boundinertia = _MIN_INERTIA
    spec.compiler.fusestatic = False  # Loads act on links without mass, too.
    spec.worldbody.first_body().add_freejoint()
    return spec


def without_environment(mujoco: Any, model: Any, step: float) -> None:
    """Have a model integrate free motion by Runge-Kutta 4 with steps of ``step`` s."""
    for name in ("CONSTRAINT", "GRAVITY", "SENSOR", "SPRING", "DAMPER", "ISLAND", "AUTORESET"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.timestep = step


def add_motors(mujoco: Any, spec: Any, description: RobotDescription) -> None:
    """Add actuators to a specification: six for the wrench on the base in B, one for each joint."""
    # The wrench turns with the base, at every stage of every step.
    spec.worldbody.first_body().add_site(name="wrench")
    for axis in np.eye(6):
        spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_SITE, target="wrench", gear=axis.tolist())
    for name in description.joint_names:
        spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)


def compiled_model(spec: Any, description: RobotDescription) -> Any:
    """Return MuJoCo's model of a specification.

    Raises
    ------
    RobotDescriptionError
        MuJoCo refuses the robot.
    """
    try:
        return spec.compile()
    except ValueError as error:
        raise _refused(description, error) from error


def joint_addresses(model: Any, description: RobotDescription) -> tuple[list[int], list[int]]:
    """Return the indices of the joints, by the order of the robot, in ``qpos`` and in ``qvel``."""
    joints = [model.joint(name) for name in description.joint_names]
    return [int(each.qposadr[0]) for each in joints], [int(each.dofadr[0]) for each in joints]


def _refused(description: RobotDescription, error: ValueError) -> RobotDescriptionError:
    reason = str(error).removesuffix(".")
    return RobotDescriptionError(f"MuJoCo refuses robot '{description.name}': {reason}.")


class MujocoLoads:
    """External loads on the bodies of a robot in MuJoCo, by :mod:`.model.external_loads`.

    Parameters
    ----------
    mujoco
        The module.
    model, data
        MuJoCo's model and state.
    links
        Names of the robot's links.
    """

    def __init__(self, mujoco: Any, model: Any, data: Any, links: Sequence[str]) -> None:
        self._mujoco, self._model, self._data = mujoco, model, data
        self._layout = LoadLayout(len(links))
        self.bodies = np.array([model.body(name).id for name in links])
        """Indices of the links' bodies."""

    def apply(self, vector: Array, time: float) -> None:
        """Apply the loads of a vector at a time, s, to all bodies where they are and as they move.

        Poses and velocities of the bodies must belong to MuJoCo's present state.
        """
        model, data, layout = self._model, self._data, self._layout
        in_link = vector[layout.in_link].reshape(-1, 6)
        in_world = vector[layout.in_world].reshape(-1, 6)
        (n,), (friction,) = vector[layout.mean_motion], vector[layout.friction]
        R_WO, gravity_W = matrix_from_quaternion(vector[layout.quaternion_WO]), layout.gravity_W
        outward = R_WO @ np.array([math.cos(n * time), math.sin(n * time), 0.0])
        velocity = np.zeros(6)
        for row, body in enumerate(self.bodies):
            r, m = data.xipos[body], model.body_mass[body]
            R, axes = data.xmat[body].reshape(3, 3), data.ximat[body].reshape(3, 3)
            inertia = (axes * model.body_inertia[body]) @ axes.T
            self._mujoco.mj_objectVelocity(
                model, data, self._mujoco.mjtObj.mjOBJ_BODY, body, velocity, 0
            )
            force = R @ in_link[row, :3] + in_world[row, :3]
            torque = R @ in_link[row, 3:] + in_world[row, 3:]
            torque = torque + cross(data.xpos[body] - r, force)
            force = force + m * (vector[gravity_W] + n**2 * (3 * outward * (outward @ r) - r))
            force -= friction * m * velocity[3:]
            torque += 3 * n**2 * cross(outward, inertia @ outward)
            torque -= friction * (inertia @ velocity[:3])
            data.xfrc_applied[body] = np.concatenate([force, torque])

    def momentum_rates(self, center: Array) -> Array:
        """Return force over moment (6,) about a centre (3,) of the loads last applied, in W."""
        F, T = self._data.xfrc_applied[self.bodies].T.reshape(2, 3, -1)
        arms = self._data.xipos[self.bodies] - center
        return np.append(F.sum(axis=1), T.sum(axis=1) + cross(arms, F.T).sum(axis=0))


class MujocoEngine:
    """A robot in free space, in MuJoCo.

    Parameters
    ----------
    description
        The robot.
    pose
        (7,) position ``r_WB``, m, and quaternion ``R_WB`` (x, y, z, w) of the base at the start.
    q
        (n,) joint positions at the start, m or rad.

    Raises
    ------
    RobotDescriptionError
        MuJoCo refuses the robot, or a joint follows another one.
    SpaceRobotError
        MuJoCo is not installed.
    """

    def __init__(self, description: RobotDescription, pose: Array, q: Array) -> None:
        self._mujoco = mujoco = import_mujoco()
        spec = mujoco_spec(mujoco, description)
        add_motors(mujoco, spec, description)
        self._model = compiled_model(spec, description)
        without_environment(mujoco, self._model, EFFORT_STEP)
        self._data = mujoco.MjData(self._model)
        self._q, self._qdot = joint_addresses(self._model, description)
        links = [link.name for link in description.links]
        self._loads = MujocoLoads(mujoco, self._model, self._data, links)
        self._loading: Array | None = None
        self._place(pose, q)

    @property
    def name(self) -> str:
        """Name and version of the engine."""
        return f"MuJoCo {self._mujoco.__version__}"

    @property
    def pose(self) -> Array:
        """(7,) position, m, and quaternion (x, y, z, w) of the base link."""
        return np.append(self._data.qpos[:3], np.roll(self._data.qpos[3:7], -1))

    @property
    def q(self) -> Array:
        """(n,) joint positions, m or rad."""
        return np.array(self._data.qpos[self._q])

    def move(self, twist: Array, qdot: Array) -> None:
        """Set the twist (6,) ``v_WB_B``, ``omega_WB_B`` of the base and the joint rates (n,)."""
        R_WB = matrix_from_quaternion(self.pose[3:])
        self._data.qvel[:3] = R_WB @ twist[:3]
        self._data.qvel[3:6] = twist[3:]
        self._data.qvel[self._qdot] = qdot

    def load(self, vector: Array | None) -> None:
        """Step under external loads, a vector of :class:`.LoadLayout`, or None, from now on.

        Its time is that of the beginning of the next step.
        """
        if vector is None:
            self._data.xfrc_applied[:] = 0.0
        else:
            (self._data.time,) = vector[LoadLayout(len(self._loads.bodies)).time]
        self._loading = vector

    def step_under_efforts(self, effort: Array, wrench: Array, duration: float) -> None:
        """Fly for ``duration`` s under joint efforts (n,) and a base wrench (6,) in B."""
        steps = math.ceil(duration / EFFORT_STEP - 1e-9)
        self._model.opt.timestep = duration / steps
        self._data.ctrl[:6] = wrench
        self._data.ctrl[6:] = effort
        if self._loading is not None:
            self._mujoco.set_mjcb_control(self._apply_loads)
        try:
            self._mujoco.mj_step(self._model, self._data, steps)
        finally:
            self._mujoco.set_mjcb_control(None)

    def _apply_loads(self, *_: Any) -> None:
        """Apply the loads at a stage of a step."""
        assert self._loading is not None
        self._loads.apply(self._loading, self._data.time)

    def step_under_velocities(self, qdot: Array, momenta: Array, duration: float) -> Array:
        """Fly for ``duration`` s at joint rates (n,); return the momenta, which loads change.

        ``momenta`` (6,) are linear, kg m/s, over angular about the centre of mass, kg m^2/s, in W.
        """
        steps = math.ceil(duration / VELOCITY_STEP - 1e-9)
        h, start = duration / steps, self._data.time
        turn, n = slice(3, 7), len(qdot)

        def rate(state: Array, time: float) -> Array:
            pose, q, momenta = np.split(state, [7, 7 + n])
            self._place(pose, q)
            v_W, omega_B = self._base_velocity(qdot, momenta)
            rates = self._momentum_rates(v_W, omega_B, qdot, time)
            turning = quaternion_multiply(pose[turn], np.append(omega_B, 0.0)) / 2
            return np.concatenate([v_W, turning, qdot, rates])

        state = np.concatenate([self.pose, self.q, momenta])
        for step in range(steps):
            t = start + step * h
            k1 = rate(state, t)
            k2 = rate(state + h / 2 * k1, t + h / 2)
            k3 = rate(state + h / 2 * k2, t + h / 2)
            k4 = rate(state + h * k3, t + h)
            state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
            state[turn] /= np.linalg.norm(state[turn])
        pose, q, momenta = np.split(state, [7, 7 + n])
        self._place(pose, q)
        return momenta

    def _momentum_rates(self, v_W: Array, omega_B: Array, qdot: Array, time: float) -> Array:
        """Return the rates (6,) of both momenta by the loads at the present positions."""
        if self._loading is None:
            return np.zeros(6)
        data = self._data
        data.qvel[:3], data.qvel[3:6], data.qvel[self._qdot] = v_W, omega_B, qdot
        self._mujoco.mj_comVel(self._model, data)
        self._loads.apply(self._loading, time)
        return self._loads.momentum_rates(data.subtree_com[1])

    def _place(self, pose: Array, q: npt.ArrayLike) -> None:
        self._data.qpos[:3] = pose[:3]
        self._data.qpos[3:7] = np.roll(pose[3:] / np.linalg.norm(pose[3:]), 1)
        self._data.qpos[self._q] = q

    def _base_velocity(self, qdot: Array, momenta: Array) -> tuple[Array, Array]:
        """Return the base's velocity in W and its rate in B, by MuJoCo's momentum matrices."""
        mujoco, model, data = self._mujoco, self._model, self._data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        linear, angular = np.zeros((2, 3, model.nv))
        mujoco.mj_jacSubtreeCom(model, data, linear, 1)
        mujoco.mj_angmomMat(model, data, angular, 1)
        A = np.vstack([float(model.body_subtreemass[1]) * linear, angular])
        base = np.linalg.solve(A[:, :6], momenta - A[:, self._qdot] @ qdot)
        return base[:3], base[3:]
