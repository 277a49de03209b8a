"""MuJoCo model of a robot with obstacles and a target, and external loads on its bodies."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np

from spacerobot_ros.collision import CollisionGeometry, Solid
from spacerobot_ros.collision.distances import solids_of
from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model.description import Array, Inertia, RobotDescription
from spacerobot_ros.model.integration import LoadLayout
from spacerobot_ros.model.rotations import (
    cross,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rpy_from_matrix,
)
from spacerobot_ros.resources import optional_module

TARGET = "target/"
"""Prefix of target body and geometry names."""

_OBSTACLE = "obstacle/"
"""Prefix of obstacle geometry names."""

_CONTACT_TIME_CONSTANT = 2.0
"""Time constant of contacts, stops and welds, in steps: MuJoCo's recommended minimum."""

_MIN_INERTIA = 2e-15
"""Smallest principal inertia of a robot with point masses, kg m^2: MuJoCo accepts none, and gives
it to massless links, too.
"""


def import_mujoco() -> Any:
    """Return the MuJoCo module; see :func:`.optional_module`."""
    return optional_module("mujoco", "mujoco", "Flights in MuJoCo need")


def body_name(link: str) -> str:
    """Return the MuJoCo body name for a link; ``world`` is reserved."""
    return "link world" if link == "world" else link


def robot_spec(mujoco: Any, description: RobotDescription) -> Any:
    """Return the MuJoCo specification of a robot with a free base, without geometries.

    Raises
    ------
    RobotDescriptionError
        MuJoCo rejects the robot, or a joint mimics another.
    """
    if description.has_mimic_joints:
        raise RobotDescriptionError(
            f"Robot '{description.name}' has mimic joints (<mimic>), which MuJoCo does not read "
            "from a URDF."
        )
    root = ElementTree.fromstring(description.urdf)
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)  # MuJoCo would look for the mesh files.
        link.set("name", body_name(link.get("name", "")))
    for origin in root.iter("origin"):
        if quaternion := origin.attrib.pop("quat_xyzw", ""):  # MuJoCo would not read it.
            q = np.array(quaternion.split(), dtype=float)
            rpy = rpy_from_matrix(matrix_from_quaternion(q / np.linalg.norm(q)))
            origin.set("rpy", " ".join(map(repr, rpy.tolist())))
    for end in (*root.iter("parent"), *root.iter("child")):
        end.set("link", body_name(end.get("link", "")))
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    except ValueError as error:
        raise _refused(description, error) from error
    if any(np.linalg.eigvalsh(x.inertia.about_com)[0] < _MIN_INERTIA for x in description.bodies):
        spec.compiler.boundinertia = _MIN_INERTIA
    spec.compiler.fusestatic = False  # Loads also act on massless links.
    spec.worldbody.first_body().add_freejoint()
    return spec


def joint_addresses(model: Any, description: RobotDescription) -> tuple[list[int], list[int]]:
    """Return the joint indices, in the robot's order, in ``qpos`` and in ``qvel``."""
    joints = [model.joint(name) for name in description.joint_names]
    return [int(each.qposadr[0]) for each in joints], [int(each.dofadr[0]) for each in joints]


def _refused(description: RobotDescription, error: ValueError) -> RobotDescriptionError:
    reason = str(error).removesuffix(".")
    remedy = " `spacerobot new URDF --nearest-inertia` writes a URDF with possible inertias."
    return RobotDescriptionError(
        f"MuJoCo rejects robot '{description.name}': {reason}."
        f"{remedy if 'balanceinertia' in reason else ''}"
    )


def build_model(
    mujoco: Any,
    robot: RobotDescription,
    target: tuple[RobotDescription, str] | None,
    step: float,
    *,
    contacts: bool = True,
) -> tuple[Any, list[str]]:
    """Return the MuJoCo model of the robot, obstacles and target, and the names of the target
    geometries.

    Parameters
    ----------
    target
        The target, and the link that captures it; None if there is no target.
    step
        Step of MuJoCo's Runge-Kutta 4 integrator, s.
    contacts
        Whether to model contact forces and joint stops. If so, the masses are taken from the
        description, and may differ from the masses in the URDF; otherwise, the robot moves freely,
        and MuJoCo reads its masses from the URDF.

    Raises
    ------
    RobotDescriptionError
        MuJoCo rejects the robot, or a joint mimics another.
    """
    spec, shapes = robot_spec(mujoco, robot), list[str]()
    # The wrench on the base, in B, rotates with it at every stage of every step.
    spec.worldbody.first_body().add_site(name="wrench")
    for axis in np.eye(6):
        spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_SITE, target="wrench", gear=axis.tolist())
    for name in robot.joint_names:
        spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
        spec.add_equality(
            name=f"lock {name}",
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=name,
            active=False,
        )
    if contacts:
        # The mass properties of the description may not be those of its URDF.
        inertias = {body.name: body.inertia for body in robot.bodies}
        for link in robot.links:
            body = spec.body(body_name(link.name))
            body.explicitinertial = True
            # A link on a fixed joint is part of another body.
            _set_inertia(body, inertias.get(link.name, Inertia()))
        shapes = _add_contacts(mujoco, spec, robot, target)
    try:
        model = spec.compile()
    except ValueError as error:
        raise _refused(robot, error) from error
    _set_options(mujoco, model, step)
    if not contacts:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return model, shapes


def _add_contacts(
    mujoco: Any, spec: Any, robot: RobotDescription, target: tuple[RobotDescription, str] | None
) -> list[str]:
    geometry = CollisionGeometry(robot)
    names = [
        _add_shape(mujoco, spec, solid, f"{_OBSTACLE if solid.is_obstacle else ''}{index}")
        for index, solid in enumerate(geometry.solids)
    ]
    pairs = [(names[i], names[j]) for i, j in geometry.pairs]
    shapes: list[str] = []
    if target is not None:
        body, link = target
        _add_target(spec, body)
        solids, _, _ = solids_of(body)
        shapes = [
            _add_shape(mujoco, spec, solid, f"{TARGET}{index}", TARGET)
            for index, solid in enumerate(solids)
        ]
        hand = robot.frames[link][0]
        for name, solid in zip(names, geometry.solids, strict=True):
            if solid.body != hand:
                pairs += [(name, shape) for shape in shapes]
            else:
                # Not listed as pairs, which could not be disabled while the hand holds the target.
                spec.geom(name).contype = 1
        for shape in shapes:
            spec.geom(shape).conaffinity = 1
        grasp = spec.add_equality(
            name="grasp",
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=link,
            name2=f"{TARGET}{body.base_link}",
            active=False,
        )
        grasp.data[10] = 1.0  # Torque counts as much as force.
    for first, second in pairs:
        spec.add_pair(geomname1=first, geomname2=second)
    return shapes


def _set_inertia(body: Any, inertia: Inertia) -> None:
    moments, axes = np.linalg.eigh(inertia.about_com)
    axes = axes * np.linalg.det(axes)
    body.mass, body.ipos = inertia.mass, inertia.com
    body.fullinertia = np.full(6, np.nan)  # Unspecified.
    body.inertia, body.iquat = moments, np.roll(quaternion_from_matrix(axes), 1)


def _add_target(spec: Any, target: RobotDescription) -> None:
    body = spec.worldbody.add_body(name=f"{TARGET}{target.base_link}")
    joint = body.add_freejoint()
    joint.name = f"{TARGET}free"
    body.explicitinertial = True
    _set_inertia(body, target.bodies[0].inertia)
    for name, (_, pose) in target.frames.items():
        if name != target.base_link:
            body.add_body(
                name=f"{TARGET}{name}", pos=pose.r, quat=np.roll(quaternion_from_matrix(pose.R), 1)
            )


def _add_shape(mujoco: Any, spec: Any, solid: Solid, name: str, prefix: str = "") -> str:
    body = spec.worldbody if solid.is_obstacle else spec.body(body_name(f"{prefix}{solid.link}"))
    kinds, size = mujoco.mjtGeom, solid.shape.size
    # Pairs with contact forces are listed individually.
    about: dict[str, Any] = {"name": name, "mass": 0.0, "contype": 0, "conaffinity": 0}
    if solid.vertices is not None:
        spec.add_mesh(name=name, uservert=solid.vertices.ravel().tolist())
        body.add_geom(type=kinds.mjGEOM_MESH, meshname=name, **about)
        return name
    kind, numbers = {
        "box": (kinds.mjGEOM_BOX, [length / 2 for length in size]),
        "sphere": (kinds.mjGEOM_SPHERE, [size[0], 0.0, 0.0]),
        "cylinder": (kinds.mjGEOM_CYLINDER, [size[0], size[-1] / 2, 0.0]),
        "capsule": (kinds.mjGEOM_CAPSULE, [size[0], size[-1] / 2, 0.0]),
    }[solid.shape.kind]
    pose = solid.shape.pose
    body.add_geom(
        type=kind,
        size=numbers,
        pos=pose.r,
        quat=np.roll(quaternion_from_matrix(pose.R), 1),
        **about,
    )
    return name


def _set_options(mujoco: Any, model: Any, step: float) -> None:
    """Set Runge-Kutta 4 with steps of ``step`` s, and disable effects other than contacts."""
    for flag in ("GRAVITY", "SENSOR", "SPRING", "DAMPER", "FRICTIONLOSS", "ISLAND", "AUTORESET"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.timestep = step
    # The plant clips efforts itself; servos exceed the limits where commanded rates jump.
    model.jnt_actfrclimited[:] = 0
    stiff = [_CONTACT_TIME_CONSTANT * step, 1.0]
    for soft in (model.eq_solref, model.jnt_solref, model.pair_solref):
        soft[:] = stiff


class MujocoLoads:
    """External loads on robot bodies in MuJoCo; see :class:`.ExternalLoads`.

    Parameters
    ----------
    mujoco
        The module.
    model, data
        MuJoCo's model and state.
    links
        Link names of the robot.
    """

    def __init__(self, mujoco: Any, model: Any, data: Any, links: Sequence[str]) -> None:
        self._mujoco, self._model, self._data = mujoco, model, data
        self._layout = LoadLayout(len(links))
        self.bodies = np.array([model.body(body_name(name)).id for name in links])
        """Indices of the link bodies."""

    def apply(self, vector: Array, time: float) -> None:
        """Apply the load vector at a given time (s) to all bodies, given their current motion.

        Body poses and velocities must correspond to MuJoCo's current state.
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
        """Return the force, and the moment about a point (3,), of the last loads (6,), in W."""
        F, T = self._data.xfrc_applied[self.bodies].T.reshape(2, 3, -1)
        arms = self._data.xipos[self.bodies] - center
        return np.append(F.sum(axis=1), T.sum(axis=1) + cross(arms, F.T).sum(axis=0))
