"""The plant in MuJoCo, with contact forces between the links, obstacles and target; a grasp is
modelled as a weld.

The parameter ``engine`` selects it instead of :class:`.EffortPlant` or :class:`.VelocityPlant`;
commands, states and topics are the same. MuJoCo integrates with the Runge-Kutta 4 method. Contacts,
joint stops, locked joints and welds are soft constraints with a time constant of two steps. The
constraint forces are internal, so the total momentum changes only by the integration error: with 1
ms steps, by about 1e-9 of its largest value in free motion, and by 1e-5 during a grasp.

Under velocity commands, a change in the commanded rates takes effect within a step. Apart from such
changes, servo efforts stay within the URDF effort limits: a joint that meets an obstacle stalls.
"""

from __future__ import annotations

from threading import Lock
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import CommandError, ParameterError, SpaceRobotError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.grasp import BodyMotion, RobotMotion, combined_momenta
from spacerobot_ros.model.integration import count_steps
from spacerobot_ros.model.rotations import cross, matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.simulation.capture import CapturePlant, Target, capturing_link
from spacerobot_ros.simulation.config import PlantConfig, TargetConfig
from spacerobot_ros.simulation.loads import PlantLoads
from spacerobot_ros.simulation.mujoco_model import (
    TARGET,
    MujocoLoads,
    body_name,
    build_model,
    import_mujoco,
    joint_addresses,
)
from spacerobot_ros.simulation.plant import Counts, Flags, InitialState

DEFAULT_INTEGRATION_STEP = 0.001
"""Longest Runge-Kutta step, s."""

_STOP_DISTANCE = 1e-4
"""Distance to the limit, m or rad, at which a joint is considered stopped, because stops are
soft."""

_SHARES = (1 / 6, 2 / 6, 2 / 6, 1 / 6)
"""Stage weights in a Runge-Kutta 4 step."""

_CONTROL_CALLBACK = Lock()
"""MuJoCo allows one callback per process, so plants in different threads take turns."""

_RIGID = 1e15
"""Inertia of a motor that maintains its rate, kg or kg m^2."""


class MujocoPlant:
    """A free-floating robot in MuJoCo, with its target.

    After :meth:`step`, the attributes are those of :class:`.Plant`, and

    ``wrench``
        (6,) force (N) and torque (N m) of the last tick at the base link origin, in base
        components.
    ``holds_target``
        Whether the target is welded to the robot; if so, the momenta include the target.

    Parameters
    ----------
    robot, control_period, initial, integration_step
        See :class:`.CompiledPlant`; MuJoCo reads the robot's URDF, so its masses must match it.
    actuation
        ``velocity`` or ``effort``, as in parameter ``actuation``.
    target
        The target, and the link that captures it; None if there is no target.
    contacts
        Whether there are contacts, joint stops and locks. If not, the model is exactly as MuJoCo
        reads it from the URDF, and joints under velocity commands keep their rates exactly.

    Raises
    ------
    ParameterError
        The initial state is invalid.
    RobotDescriptionError
        MuJoCo rejects the robot or the target, or a joint mimics another.
    SpaceRobotError
        MuJoCo is not installed.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        control_period: float,
        initial: InitialState | None = None,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
        *,
        actuation: str = "effort",
        target: tuple[MujocoTarget, str] | None = None,
        contacts: bool = True,
    ) -> None:
        self.robot, self.control_period = robot, control_period
        self.initial = initial or InitialState()
        self._steps = count_steps(control_period, integration_step)
        self._velocity = actuation == "velocity"
        self._mujoco = mujoco = import_mujoco()
        self._target = target[0] if target else None
        self._contacts = contacts
        model, shapes = build_model(
            mujoco,
            robot.description,
            (target[0].description, target[1]) if target else None,
            control_period / self._steps,
            contacts=contacts,
        )
        self._model = model
        self._data = mujoco.MjData(model)
        self._q, self._qdot = joint_addresses(model, robot.description)
        self._link_poses = robot.buffered("link_poses")
        self._applied = MujocoLoads(mujoco, model, self._data, robot.link_names)
        self._root = int(model.body(body_name(robot.base_link)).id)
        self._target_body = -1
        if self._target is not None:
            root = f"{TARGET}{self._target.description.base_link}"
            self._target_body = int(model.body(root).id)
            joint = model.joint(f"{TARGET}free")
            self._target_places = int(joint.qposadr[0]), int(joint.dofadr[0])
            links = [f"{TARGET}{name}" for name in self._target.description.frames]
            self._applied_to_target = MujocoLoads(mujoco, model, self._data, links)
        self._locks = [model.equality(f"lock {name}").id for name in robot.joint_names]
        self._target_shapes = [model.geom(name).id for name in shapes]
        n, wheels = robot.n, robot.description.wheel_names
        self._is_wheel = np.array([name in wheels for name in robot.joint_names], dtype=bool)
        self.pose, self.twist = np.zeros(7), np.zeros(6)
        self.q, self.qdot, self.effort = np.zeros((3, n))
        self.wrench, self.momentum = np.zeros(6), np.zeros(7)
        self.link_R, self.link_r = (
            np.zeros((3, 3 * len(robot.link_names))),
            np.zeros((3, len(robot.link_names))),
        )
        self.expected_momenta = np.zeros(6)
        """Linear and angular momentum (6,) in W: the initial value plus thrust and loads."""
        self.limit_counts: dict[str, Counts] = {
            kind: np.zeros(n, dtype=np.int64)
            for kind in ("rate" if self._velocity else "effort", "stroke")
        }
        self.holds_target = False
        self._aim = np.zeros(n)
        """Servo rates commanded in the last tick."""
        self._held: Flags = np.zeros(n, dtype=np.bool_)
        self._loads: PlantLoads | None = None
        self._loaded, self._stage = False, 0
        self.reset()

    # -- the plant ----------------------------------------------------------------------------

    def reset(self) -> None:
        """Return to the initial state, with zero efforts; the limit counters are kept."""
        start, robot = self.initial, self.robot
        rates = start.rates(robot)
        if self._velocity and rates.any():
            raise ParameterError(
                "Joints under velocity commands start at rest: omit the initial joint velocities, "
                "or command them."
            )
        quaternion, q, momenta = start.attitude(), start.shape(robot), start.momenta()
        self._mujoco.mj_resetData(self._model, self._data)
        self._model.geom_conaffinity[self._target_shapes] = 1
        self.holds_target = False
        r_BC_W = matrix_from_quaternion(quaternion) @ robot.center_of_mass(q)
        pose = np.concatenate([start.system_position(robot) - r_BC_W, quaternion])
        twist = robot.base_twist(quaternion, q, rates, momenta[:3], momenta[3:])
        motion = RobotMotion(pose, np.concatenate(twist), q, rates)
        self.go_on(motion, None if self._target is None else self._target.initial)
        self.expected_momenta[:] = momenta
        self.effort[:] = self.wrench[:] = 0.0
        self.hold(self._held)

    def go_on(
        self, motion: RobotMotion, target: BodyMotion | None = None, *, welded: bool = False
    ) -> None:
        """Continue from the given motions of the robot and the target, welded together or not."""
        data = self._data
        data.qpos[:3], data.qpos[3:7] = motion.pose[:3], np.roll(motion.pose[3:], 1)
        data.qpos[self._q], data.qvel[self._qdot] = motion.q, motion.qdot
        data.qvel[:3], data.qvel[3:6] = motion.R_WB @ motion.twist[:3], motion.twist[3:]
        self._aim[:] = motion.qdot
        if target is not None:
            at, rate = self._target_places
            data.qpos[at : at + 3] = target.r_WT
            data.qpos[at + 3 : at + 7] = np.roll(quaternion_from_matrix(target.R_WT), 1)
            data.qvel[rate : rate + 3] = target.v
            data.qvel[rate + 3 : rate + 6] = target.R_WT.T @ target.omega
        self._update()
        if welded:
            self.weld()
            self._update()

    def hold(self, joints: Flags) -> None:
        """Lock the marked joints (n,) at their positions, and release all others."""
        locked = self._held & (self._data.eq_active[self._locks] != 0)
        for joint in np.flatnonzero(joints & ~locked):
            self._model.eq_data[self._locks[joint], 0] = self._data.qpos[self._q[joint]]
        self._data.eq_active[self._locks] = joints
        self._held = joints.copy()

    def load(self, loads: PlantLoads) -> None:
        """Apply external loads; their values may change before each step."""
        self._loads = loads

    def step(self, command: npt.ArrayLike, wrench: npt.ArrayLike = 0.0) -> bool:
        """Advance one tick under joint velocities, or under joint efforts and a base wrench (6,).

        Returns whether any joint was limited.

        Raises
        ------
        CommandError
            A command is not finite; the plant does not advance.
        SpaceRobotError
            The motion is no longer finite.
        """
        n, robot = self.robot.n, self.robot
        wanted = np.broadcast_to(np.asarray(command, dtype=float), (n,))
        pushed = np.broadcast_to(np.asarray(wrench, dtype=float), (6,))
        if not (np.all(np.isfinite(wanted)) and np.all(np.isfinite(pushed))):
            raise CommandError(f"A command is not finite: {[*wanted.tolist(), *pushed.tolist()]}.")
        self._loaded = self._loads is not None and self._loads.has_loads
        self._data.xfrc_applied[:] = 0.0
        if self._loads is not None:
            self._data.time = self._loads.time
        self._data.ctrl[:6] = self.wrench[:] = pushed
        if self._velocity:
            realised = np.clip(wanted, -robot.velocity_limit, robot.velocity_limit)
            if self._contacts:
                self._step_to_rates(realised)
            else:
                self._step_at_rates(realised)
        else:
            # A wheel at its largest rate gets no faster.
            rate, limit, wheel = robot.velocity_limit, robot.effort_limit, self._is_wheel
            lowest = np.where(wheel & (self.qdot <= -rate), 0.0, -limit)
            realised = np.clip(wanted, lowest, np.where(wheel & (self.qdot >= rate), 0.0, limit))
            self._data.ctrl[6:] = self.effort[:] = realised
            self._advance(self._steps)
        if not np.all(np.isfinite(self._data.qpos)):
            raise SpaceRobotError(
                "The motion is no longer finite: the commands drive the robot too fast for the "
                "integration step. Reduce the commands, or parameter 'integration_step'."
            )
        self._update()
        clipped = realised != wanted
        q = self.q
        stopped = (q <= robot.lower + _STOP_DISTANCE) | (q >= robot.upper - _STOP_DISTANCE)
        for kind, limited in zip(self.limit_counts, (clipped, stopped), strict=True):
            self.limit_counts[kind] += limited
        return bool(clipped.any() or stopped.any())

    # -- the target ---------------------------------------------------------------------------

    def weld(self) -> None:
        """Weld the target to the capturing link in their current poses, and disable contacts
        between them.
        """
        model, data = self._model, self._data
        weld = model.equality("grasp").id
        link, target = model.eq_obj1id[weld], model.eq_obj2id[weld]
        R = data.xmat[link].reshape(3, 3)
        model.eq_data[weld, :3] = 0.0
        model.eq_data[weld, 3:6] = R.T @ (data.xpos[target] - data.xpos[link])
        relative = np.zeros(4)
        self._mujoco.mju_negQuat(relative, data.xquat[link])
        self._mujoco.mju_mulQuat(relative, relative.copy(), data.xquat[target])
        model.eq_data[weld, 6:10] = relative
        data.eq_active[weld] = 1
        model.geom_conaffinity[self._target_shapes] = 0
        self.holds_target = True

    def unweld(self) -> None:
        """Let the target float freely."""
        self._data.eq_active[self._model.equality("grasp").id] = 0
        self._model.geom_conaffinity[self._target_shapes] = 1
        self.holds_target = False

    @property
    def target_motion(self) -> BodyMotion:
        """The current motion of the target's root link."""
        data, (at, rate) = self._data, self._target_places
        R = matrix_from_quaternion(np.roll(data.qpos[at + 3 : at + 7], -1))
        omega = R @ data.qvel[rate + 3 : rate + 6]
        return BodyMotion(
            R, data.qpos[at : at + 3].copy(), data.qvel[rate : rate + 3].copy(), omega
        )

    # -- a tick -------------------------------------------------------------------------------

    def _advance(self, steps: int) -> None:
        mujoco = self._mujoco
        with _CONTROL_CALLBACK:
            if self._loaded or self.wrench.any():
                mujoco.set_mjcb_control(self._push)
                self._stage = 0
            try:
                mujoco.mj_step(self._model, self._data, steps)
            finally:
                mujoco.set_mjcb_control(None)

    def _push(self, *_: Any) -> None:
        """Apply the loads at a stage of a step; add the impulse to the expected momenta."""
        data, loads = self._data, self._loads
        data.xfrc_applied[:] = 0.0
        center = self._center()
        R_WB = matrix_from_quaternion(np.roll(data.qpos[3:7], -1))
        force, torque = R_WB @ self.wrench[:3], R_WB @ self.wrench[3:]
        rates = np.append(force, torque + cross(data.qpos[:3] - center, force))
        if self._loaded and loads is not None:
            self._applied.apply(loads.vector, data.time)
            rates += self._applied.momentum_rates(center)
            if self._target is not None and self._target.loads is not None:
                self._applied_to_target.apply(self._target.loads.vector, data.time)
                if self.holds_target:
                    rates += self._applied_to_target.momentum_rates(center)
        self.expected_momenta += self._model.opt.timestep * _SHARES[self._stage] * rates
        self._stage = (self._stage + 1) % len(_SHARES)

    def _step_at_rates(self, rates: Array) -> None:
        """Advance a tick in free motion at these joint rates (n,); they change no momentum."""
        model, data = self._model, self._data
        M = np.zeros((model.nv, model.nv))
        self._mujoco.mj_fullM(model, data, M)
        change = rates - data.qvel[self._qdot]
        data.qvel[:6] -= np.linalg.solve(M[:6, :6], M[:6, self._qdot] @ change)
        data.qvel[self._qdot] = rates
        model.dof_armature[self._qdot] = _RIGID
        self._advance(self._steps)
        model.dof_armature[self._qdot] = 0.0

    def _step_to_rates(self, rates: Array) -> None:
        """Advance a tick in which servos bring the joints to these rates (n,)."""
        model, data, mujoco, robot = self._model, self._data, self._mujoco, self.robot
        h, T = model.opt.timestep, self.control_period
        # A joint that would pass its limit within the tick ends on it.
        aim = np.clip(rates, (robot.lower - self.q) / T, (robot.upper - self.q) / T)
        aim[self._held] = 0.0
        jump, self._aim = aim - self._aim, aim
        M, total = np.zeros((model.nv, model.nv)), np.zeros(robot.n)
        own = [*range(6), *self._qdot]
        for step in range(self._steps):
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            mujoco.mj_fullM(model, data, M)
            H, bias = M[np.ix_(own, own)], data.qfrc_bias[own]
            # Only the joint reactions act on the base.
            by_base = np.linalg.solve(H[:6, :6], np.column_stack([H[:6, 6:], bias[:6]]))
            K = H[6:, 6:] - H[6:, :6] @ by_base[:, :-1]
            reaction = bias[6:] - H[6:, :6] @ by_base[:, -1]
            lacking = (aim - data.qvel[self._qdot]) / h
            commanded = K @ jump / h if step == 0 else np.zeros(robot.n)
            regulated = K @ lacking + reaction - commanded
            limit = robot.effort_limit
            data.ctrl[6:] = commanded + np.clip(regulated, -limit, limit)
            total += data.ctrl[6:]
            self._advance(1)
        self.effort[:] = total / self._steps

    def _center(self) -> Array:
        """Return the centre of mass (3,) of the bodies that move together."""
        masses, centers = self._model.body_subtreemass, self._data.subtree_com
        if not self.holds_target:
            return np.array(centers[self._root])
        roots = [self._root, self._target_body]
        return np.asarray(masses[roots] @ centers[roots] / masses[roots].sum())

    def _update(self) -> None:
        model, data, mujoco = self._model, self._data, self._mujoco
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_subtreeVel(model, data)
        self.pose[:3], self.pose[3:] = data.qpos[:3], np.roll(data.qpos[3:7], -1)
        R_WB = matrix_from_quaternion(self.pose[3:])
        self.twist[:3], self.twist[3:] = R_WB.T @ data.qvel[:3], data.qvel[3:6]
        self.q[:], self.qdot[:] = data.qpos[self._q], data.qvel[self._qdot]
        link_R, link_r = self._link_poses(self.q)
        self.link_R[:], self.link_r[:] = link_R, link_r.reshape(3, -1)  # A vector for one link.
        momenta = self._momenta_of(self._root)
        if self.holds_target:
            target = self._target_body
            masses = tuple(float(model.body_subtreemass[each]) for each in (self._root, target))
            centers = tuple(data.subtree_com[each] for each in (self._root, target))
            momenta = combined_momenta(
                (masses[0], masses[1]),
                (centers[0], centers[1]),
                (momenta, self._momenta_of(target)),
            )
        self.momentum[:6] = momenta
        moving = np.zeros(model.nv)
        mujoco.mj_mulM(model, data, moving, data.qvel)
        own = slice(None) if self.holds_target else [*range(6), *self._qdot]
        self.momentum[6] = float(data.qvel[own] @ moving[own]) / 2

    def _momenta_of(self, root: int) -> Array:
        """Return linear and angular momentum (6,) of a tree about its own centre of mass, in W."""
        data, mass = self._data, float(self._model.body_subtreemass[root])
        return np.concatenate([mass * data.subtree_linvel[root], data.subtree_angmom[root]])


class MujocoTarget(Target):
    """The target as a body of a :class:`MujocoPlant`, which integrates its motion."""

    def __init__(
        self, description: RobotDescription, config: TargetConfig, robot: SpaceRobot
    ) -> None:
        super().__init__(description, config, 1.0, 1.0, robot)
        self.plant: MujocoPlant | None = None

    @property
    def momenta(self) -> Array:
        """Linear and angular momentum (6,) about its centre of mass, in W."""
        return np.concatenate(self.motion.momenta(self.inertia))

    def reset(self) -> None:
        """Copy the plant's initial state, to which the plant has just returned."""
        self.step()

    def release(self, motion: BodyMotion) -> None:
        """Release the target, which keeps its current motion."""
        assert self.plant is not None
        self.plant.unweld()
        self.step()

    def step(self) -> None:
        """Copy the plant state."""
        assert self.plant is not None
        motion = self.plant.target_motion
        self.pose[:3], self.pose[3:] = motion.r_WT, quaternion_from_matrix(motion.R_WT)
        self.twist[:3] = motion.R_WT.T @ motion.v
        self.twist[3:] = motion.R_WT.T @ motion.omega


class MujocoCapturePlant(CapturePlant):
    """A MuJoCo plant with a target, which is captured by a weld."""

    def __init__(
        self,
        robot: SpaceRobot,
        initial: InitialState,
        integration_step: float,
        description: RobotDescription,
        config: PlantConfig,
    ) -> None:
        target = MujocoTarget(description, config.target, robot)
        link = capturing_link(robot.description, config)
        self._engine = plant = MujocoPlant(
            robot,
            config.control_period,
            initial,
            integration_step,
            actuation=config.actuation,
            target=(target, link),
        )
        target.plant = plant
        target.step()
        super().__init__(lambda *_: plant, robot, initial, target, config)

    def _continue(self, robot: SpaceRobot, motion: RobotMotion, momenta: Array) -> None:
        engine = self._engine
        if robot is not self._alone.robot:
            engine.weld()
        engine.expected_momenta[:] = momenta

    def _resume_dynamics(
        self, robot: SpaceRobot, motion: RobotMotion, momenta: Array, body: BodyMotion
    ) -> None:
        self._engine.go_on(motion, body, welded=self.payload is not None)
        self._engine.expected_momenta[:] = momenta
        self.target.step()

    def _body(self) -> BodyMotion:
        return self._engine.target_motion
