"""Base rotations by closed joint motions: rank and conditioning.

A small loop in the plane of two joints rotates the base by curvature times area (papers 1 and 2).
If three such first-order brackets span the three axes of rotation, they satisfy the Lie algebra
rank condition, and attitude and shape are controllable (paper 1, proposition 1). Brackets are
analytic, so their span at one shape is the span at almost all shapes (proposition 2). The base
position follows from attitude and shape; it is also controllable if three sliders have independent
slots.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.errors import PlanningError, Proof, UnreachableError, counted
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind

MAX_CONDITION = 1e6
"""Condition number above which brackets count as linearly dependent, by rounding errors."""

ZERO_TURN_PER_AREA = 1e-12
"""Threshold, rad per unit area, below which singular values of the brackets are treated as zero."""

_SAMPLED_SHAPE_COUNT = 24
"""Number of sampled shapes; brackets that span at one shape span at almost all shapes."""


@dataclass(frozen=True)
class Controllability:
    """Span of the Lie brackets at one shape.

    Attributes
    ----------
    rank, required_rank
        Number of rotation axes spanned by the brackets, and the required number.
    singular_values
        (3,) singular values, descending, of the best brackets, rad per area (rad^2, rad m or m^2).
    joints
        The joints of these brackets.
    shape
        (n,) shape at which the brackets are taken, m or rad.
    message
        Result as a sentence for the user; if ``controllable`` is false, the reason.
    """

    rank: int
    required_rank: int
    singular_values: Array
    joints: tuple[str, ...]
    shape: Array
    message: str

    @property
    def controllable(self) -> bool:
        """Whether the brackets span all required axes."""
        return self.rank >= self.required_rank

    def require(self) -> None:
        """Check that the robot is controllable.

        Raises
        ------
        PlanningError
            The robot is not controllable; the message says why.
        """
        if not self.controllable:
            raise PlanningError(self.message)

    @property
    def condition(self) -> float:
        """Condition number of the best three brackets; infinite if they are linearly dependent."""
        largest, _, smallest = self.singular_values
        return float(largest / smallest) if smallest > ZERO_TURN_PER_AREA else np.inf


def sample_shapes(robot: SpaceRobot, count: int) -> Array:
    """Return shapes (count, n) spread evenly over the shape space, independent of any seed."""
    lower, upper = robot.description.shape_box
    # Multiples of independent irrational numbers, such as roots of primes, are evenly spread.
    primes = (k for k in itertools.count(2) if all(k % divisor for divisor in range(2, k)))
    roots = np.sqrt(list(itertools.islice(primes, robot.n)))
    fractions = np.outer(np.arange(1, count + 1), roots) % 1.0
    return np.asarray(lower + fractions * (upper - lower))


def curvatures(robot: SpaceRobot, shapes: Array) -> Array:
    """Return the angular curvature (N, 3, n, n) at shapes (N, n); see `SpaceRobot.curvature`."""
    n = robot.n
    stacked = robot.function("curvature")(shapes.T).full()
    # The first joint index varies fastest, then the second joint index, then the shape.
    K = stacked.reshape(6, len(shapes), n, n)[3:]
    return np.asarray(K.transpose(1, 0, 3, 2))


def curvature_matrices(K: Array, joints: Sequence[int]) -> Array:
    """Return ``M`` (..., 3, 3) for three joints from the curvature (..., 3, n, n): paper 2.

    Its columns are the rotations per area for the pairs (1, 2), (2, 3), (3, 1).
    """
    i, j, k = joints
    return K[..., [i, j, k], [j, k, i]]


def best_triple(K: Array, among: Sequence[int]) -> tuple[tuple[int, int, int], Array]:
    """Return the joints with the best-conditioned ``M`` (3, 3) of the curvature (3, n, n)."""
    triples = list(itertools.combinations(among, 3))
    matrices = np.array([curvature_matrices(K, triple) for triple in triples])
    values = np.linalg.svd(matrices, compute_uv=False)
    best = int(np.argmax(values[:, 2] / np.maximum(values[:, 0], ZERO_TURN_PER_AREA)))
    return triples[best], matrices[best]


def brackets_at(robot: SpaceRobot, shape: Array) -> Controllability:
    """Return the span of the first-order brackets of all joints at a shape (n,)."""
    return _span_of_brackets(robot, shape[np.newaxis], None)


def best_sampled_brackets(robot: SpaceRobot, among: Sequence[int] | None = None) -> Controllability:
    """Return the span of the first-order brackets at the best of many sampled shapes."""
    return _span_of_brackets(robot, sample_shapes(robot, _SAMPLED_SHAPE_COUNT), among)


def sliders_of(robot: SpaceRobot) -> list[int]:
    """Return the prismatic joint indices."""
    joints = robot.description.movable_joints
    return [i for i, joint in enumerate(joints) if joint.kind is JointKind.PRISMATIC]


def independent_slots(robot: SpaceRobot, shape: Array | None = None) -> Array:
    """Return the slots (3, s) of sliders that can move the base to any position (paper 1, section
    4.1): the centre-of-mass motion, in B, per unit of slider motion, m/m.

    ``shape`` (n,) is the shape at which the slots are taken; None: the middle of the joint ranges.

    Raises
    ------
    PlanningError
        Fewer than three slots are linearly independent.
    """
    if shape is None:
        shape = np.mean(robot.description.shape_box, axis=0)
    c, sliders = robot.center_of_mass(shape), sliders_of(robot)
    # The motion is linear in the slider position, so a unit step is exact.
    steps = [robot.center_of_mass(shape + np.eye(robot.n)[i]) - c for i in sliders]
    slots = np.column_stack(steps) if steps else np.zeros((3, 0))
    rank = int(np.linalg.matrix_rank(slots, tol=1e-9 * np.abs(slots).max(initial=0.0)))
    if rank == 3:
        return slots
    raise PlanningError(
        "lie_bracket needs three sliders with linearly independent slots (paper 1, section 4.1); "
        f"robot '{robot.description.name}' has {counted(len(sliders), 'movable slider')}, whose "
        f"slots have rank {rank}."
    )


def tilted_goal_error(robot: SpaceRobot, axis: Array, tilt: float) -> UnreachableError:
    """Return the error for a goal attitude tilted by ``tilt`` (rad) from the ``axis`` (3,)."""
    return UnreachableError(
        f"The goal attitude is {tilt:.4g} rad away from any rotation about the axis "
        f"{(np.round(axis, 6) + 0.0).tolist()} of {robot.base_link}: planar robot "
        f"'{robot.description.name}' cannot rotate about any other axis.",
        Proof.RANK,
    )


def check_sliding_masses(robot: SpaceRobot) -> Controllability:
    """Test a robot as in paper 1: three independent slots and spanning slider brackets."""
    sliders = sliders_of(robot)
    try:
        independent_slots(robot)
    except PlanningError as refusal:
        names = tuple(robot.joint_names[i] for i in sliders)
        return Controllability(0, 3, np.zeros(3), names, np.zeros(robot.n), str(refusal))
    return best_sampled_brackets(robot, sliders)


def _span_of_brackets(
    robot: SpaceRobot, shapes: Array, among: Sequence[int] | None
) -> Controllability:
    """Return the span of the brackets at the best-conditioned of the shapes (N, n)."""
    joints = list(range(robot.n)) if among is None else list(among)
    name = robot.description.name
    if len(joints) < 2:
        message = f"Robot '{name}' has {counted(len(joints), 'joint')}: no loop encloses an area."
        return Controllability(0, 3, np.zeros(3), (), shapes[0], message)
    K = curvatures(robot, shapes)
    pairs = np.array(list(itertools.combinations(joints, 2)))
    values = np.linalg.svd(K[:, :, pairs[:, 0], pairs[:, 1]], compute_uv=False)
    rank = int(max(_numerical_rank(row) for row in values))
    where, names = f"at the best of {len(shapes)} shapes", robot.joint_names
    if len(joints) < 3:
        message = f"Two-joint loops of robot '{name}' rotate its base about one axis at a time."
        chosen = tuple(names[i] for i in joints)
        return Controllability(
            min(rank, 1), 3, np.pad(values[0], (0, 2)), chosen, shapes[0], message
        )
    found = [best_triple(at, joints) for at in K]
    singular = np.linalg.svd(np.array([M for _, M in found]), compute_uv=False)
    best = int(np.argmax(singular[:, 2] / np.maximum(singular[:, 0], ZERO_TURN_PER_AREA)))
    triple = tuple(names[i] for i in found[best][0])
    rank = min(rank, _numerical_rank(singular[best]))
    if len(shapes) == 1:
        where = f"at the shape {np.round(shapes[0], 4).tolist()}"
    if rank == 3:
        condition = singular[best, 0] / singular[best, 2]
        message = (
            f"First-order brackets of joints {', '.join(triple)} span the three axes of rotation "
            f"(condition number {condition:.3g} {where})."
        )
    else:
        message = (
            f"First-order brackets of the joints of robot '{name}' span {rank} of the three axes "
            f"of rotation {where}: small loops do not rotate the base about other axes."
        )
    return Controllability(rank, 3, singular[best], triple, shapes[best], message)


def _numerical_rank(values: Array) -> int:
    return int(np.sum(values > max(ZERO_TURN_PER_AREA, float(values[0]) / MAX_CONDITION)))
