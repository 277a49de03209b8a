"""Reaction wheels: bodies of revolution on the base that spin about their axes.

A wheel is the child of a continuous joint with the element ``<wheel/>``, whose ``<limit>``
specifies the largest rate and torque. Let ``A`` (3, k) be the wheel axes in the base frame, ``J``
(k,) the moments of inertia about them, and ``h = J (A' omega + qdot_w)`` (k,) the spins: the wheel
momenta about their axes in inertial space. The base and the arm obey the equations of a gyrostat, a
robot without wheels (docs/theory/wheels.md), so a control law for the base and the arm also works
for a robot with wheels, which produce part of its base torque.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import Proof, RobotDescriptionError, UnreachableError
from spacerobot_ros.model.description import Array, Body, Joint, JointKind, RobotDescription

_MAX_OFFSET = 1e-4  # m, of the centre of mass from the axis

_MOMENTUM_ROUNDING, _LEAST_MOMENTUM = 1e-9, 1e-12
"""Largest angular momentum that the wheels may leave to the base: as a relative value, and in kg
m^2/s."""

_REST_SHARE = 1e-9

_MAX_ASYMMETRY = 1e-3
"""Largest relative deviation of a wheel's inertia from that of a body of revolution."""


@dataclass(frozen=True)
class ReactionWheels:
    """The k wheels of a robot, in coordinate order.

    Attributes
    ----------
    description
        The robot.
    names
        Names of their joints.
    index
        (k,) wheel coordinates in q.
    other
        (n - k,) coordinates of the other joints in q.
    axes_B
        (3, k) unit vectors of the wheel axes, in the base frame.
    inertia
        (k,) moments of inertia about the axes, kg m^2.
    rate, torque
        (k,) largest rates relative to the base, rad/s, and largest motor torques, N m.
    """

    description: RobotDescription
    names: tuple[str, ...]
    index: npt.NDArray[np.int64]
    other: npt.NDArray[np.int64]
    axes_B: Array
    inertia: Array
    rate: Array
    torque: Array

    @classmethod
    def of(cls, description: RobotDescription) -> ReactionWheels:
        """Return the wheels of a robot, possibly none."""
        joints = list(description.joint_names)
        wheels = _wheels_of(description)
        index = np.array([joints.index(joint.name) for _, joint in wheels], dtype=np.int64)
        return cls(
            description,
            description.wheel_names,
            index,
            np.delete(np.arange(len(joints)), index),
            np.array([body.origin.R @ joint.axis for body, joint in wheels]).reshape(-1, 3).T,
            np.array([_spin_inertia(body, joint.axis) for body, joint in wheels]),
            description.limits("velocity")[index],
            description.limits("effort")[index],
        )

    def __len__(self) -> int:
        return len(self.names)

    def are_spinning(self, qdot: Array) -> bool:
        """Return whether any wheel spins relative to the base at joint velocities (n,), rad/s."""
        return bool(np.any(np.abs(qdot[self.index]) > _REST_SHARE * self.rate))

    def spins(self, omega_WB_B: Array, rates: Array) -> Array:
        """Return the momenta h (k,) about the axes, kg m^2/s, at relative rates (k,), rad/s."""
        return np.asarray(self.inertia * (self.axes_B.T @ omega_WB_B + rates))

    def rates_for(
        self, L_B: Array, near: Array | None = None, largest: Array | None = None
    ) -> Array:
        """Return rates (k,), rad/s, at which the wheels store a given angular momentum while the
        base and the arm are at rest. For redundant wheels, these are the rates nearest to ``near``,
        or the smallest within the limits.

        Parameters
        ----------
        L_B
            (3,) in the base frame, kg m^2/s.
        near
            (k,) preferred rates of redundant wheels, rad/s; by default zero.
        largest
            (k,) largest rates, rad/s; by default, the wheel limits.

        Raises
        ------
        UnreachableError
            No rates within the limits store the momentum; the message is a clause that states the
            reason.
        """
        rate = self.rate if largest is None else largest
        near = np.zeros(len(self)) if near is None else near
        stored = self.axes_B * self.inertia
        scaled = stored * rate
        nearest = near + rate * (np.linalg.pinv(scaled) @ (L_B - stored @ near))
        left = float(np.linalg.norm(stored @ nearest - L_B))
        if left > _MOMENTUM_ROUNDING * float(np.linalg.norm(L_B)) + _LEAST_MOMENTUM:
            raise UnreachableError(
                f"their axes do not span a direction in which it has {left:.3g} kg m^2/s",
                Proof.MOMENTUM,
            )
        if np.all(np.abs(nearest) <= rate):
            return np.asarray(nearest)
        from scipy.optimize import linprog  # Slow to import, and few robots have wheels.

        # The fractions x of the limits with the smallest maximum t: |x| <= t.
        k = len(self)
        U, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
        rows = U.T[sizes > _MOMENTUM_ROUNDING * sizes[0]]
        found = linprog(
            np.append(np.zeros(k), 1.0),
            A_ub=np.block([[np.eye(k), -np.ones((k, 1))], [-np.eye(k), -np.ones((k, 1))]]),
            b_ub=np.zeros(2 * k),
            A_eq=np.hstack([rows @ scaled, np.zeros((len(rows), 1))]),
            b_eq=rows @ L_B,
            bounds=(None, None),
        )
        if found.fun > 1:
            raise UnreachableError(
                f"it is {found.fun:.4g} times the largest that they can store in its direction",
                Proof.MOMENTUM,
            )
        shares = found.x[:k]
        return np.asarray(rate * (shares + np.linalg.pinv(scaled) @ (L_B - scaled @ shares)))

    @cached_property
    def gyrostat(self) -> RobotDescription:
        """The robot without wheels: it has only the other joints, and the wheels are part of the
        base, without moments of inertia about their axes.
        """
        links = {link.name: link for link in self.description.links}
        wheels = _wheels_of(self.description)
        for (body, joint), moment in zip(wheels, self.inertia, strict=True):
            link = links[body.name]
            about = link.inertia.about_com - moment * np.outer(joint.axis, joint.axis)
            links[body.name] = replace(link, inertia=replace(link.inertia, about_com=about))
        return self.description.with_links(tuple(links.values())).with_locked(
            dict.fromkeys(self.names, 0.0)
        )


def require_reaction_wheels(robot: RobotDescription) -> None:
    """Check that wheels are bodies of revolution, mounted on the base, with limits.

    Raises
    ------
    RobotDescriptionError
        A wheel is invalid; the message names its joint.
    """
    followed = {joint.mimic.joint for joint in robot.moving_joints if joint.mimic is not None}
    parents = {body.parent for body in robot.bodies}
    for body, joint in _wheels_of(robot):
        if joint.kind is not JointKind.CONTINUOUS:
            flaw = f'is {joint.kind.value}: give it type="continuous"'
        elif joint.mimic is not None or joint.name in followed:
            flaw = "is coupled to another joint by <mimic>: a wheel spins independently"
        elif body.parent != 0:
            flaw = (
                f"is on link '{robot.bodies[body.parent].name}', which moves: a reaction wheel "
                "must be on the base; without <wheel> it is an ordinary joint"
            )
        elif robot.frames[body.name][0] in parents:
            flaw = "carries a joint: a reaction wheel cannot carry joints"
        elif not (0 < joint.limits.velocity < np.inf and 0 < joint.limits.effort < np.inf):
            flaw = (
                "has no rate and torque limits: give it "
                '<limit velocity="..." effort="..."/> in rad/s and N m'
            )
        else:
            flaw = _imbalance_clause(body, joint.axis)
        if flaw:
            raise RobotDescriptionError(f"The wheel '{joint.name}' {flaw}.")


def _imbalance_clause(body: Body, axis: Array) -> str:
    """Return a clause on a wheel that is not a body of revolution; empty if it is one."""
    inertia = body.inertia
    offset = float(np.linalg.norm(np.cross(axis, inertia.com)))
    if offset > _MAX_OFFSET:
        return (
            f"is not balanced: its centre of mass is {offset:.3g} m off its axis; "
            "move the origin of its <inertial>"
        )
    spin = _spin_inertia(body, axis)
    across = (float(np.trace(inertia.about_com)) - spin) / 2
    symmetric = across * np.eye(3) + (spin - across) * np.outer(axis, axis)
    if np.abs(inertia.about_com - symmetric).max() > _MAX_ASYMMETRY * max(spin, across):
        return (
            "is not balanced: its inertia is not rotationally symmetric about its axis; "
            "give it equal moments about the two transverse axes, and no products of inertia"
        )
    return ""


def _wheels_of(robot: RobotDescription) -> list[tuple[Body, Joint]]:
    """Return the wheels and their joints, in coordinate order."""
    moving = zip(robot.bodies[1:], robot.moving_joints, strict=True)
    return [(body, joint) for body, joint in moving if joint.wheel]


def _spin_inertia(body: Body, axis: Array) -> float:
    return float(axis @ body.inertia.about_com @ axis)
