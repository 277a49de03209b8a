"""The rows of pairs of links in C: ``rows.c`` with the tables of one robot, for all of its pairs.

Its formulas are those of ``rows.py`` with derivatives by hand, which take a tenth of the time of
CasADi's. Rows of obstacles are not among them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.collision.geometry import CollisionGeometry, Solid
from spacerobot_ros.collision.rows import (
    SHARPNESS_OF_FACES,
    SHARPNESS_OF_MINIMUM,
    SQUARE_ROOT_OFFSET,
    DistanceRows,
    Form,
    ball_and_field_roles,
    chain_of,
)
from spacerobot_ros.model.compilation import compiled_functions
from spacerobot_ros.model.description import JointKind, Pose, RobotDescription

_SOURCE = Path(__file__).with_name("rows.c")

_STRUCTURES = """
#include <math.h>
typedef struct { int joint, slides; double factor, offset, axis[3], R[9], r[3]; } Step;
typedef struct {
  int rod, first_step, steps, first_ball, balls;
  double radii, half[3], R[9], r[3];
} Role;
typedef struct { int first_role, roles; } Pair;
"""
"""The structures of the tables: a joint and the pose behind it; balls in a field; a pair."""


@dataclass(frozen=True)
class _Step:
    """A joint on the way from a field to balls, and the fixed pose behind it.

    Attributes
    ----------
    index
        Number of the body that the joint carries.
    forward
        Whether the way goes from the parent to the body; else back.
    behind
        The next frame in that behind the joint.
    """

    index: int
    forward: bool
    behind: Pose


class CompiledRows:
    """Rows of pairs of links of one robot in C."""

    def __init__(self, geometry: CollisionGeometry, functions: Sequence[ca.Function]) -> None:
        self._geometry, self._functions = geometry, functions

    @classmethod
    def of(cls, geometry: CollisionGeometry) -> CompiledRows | None:
        """Compile the rows of all link pairs, or take them from the cache; None: no compiler."""
        pairs = np.flatnonzero(~geometry.with_obstacles).tolist()
        if not pairs:
            return None
        names = ("link_distance", "link_distance_jac", "link_distance_hess")
        functions = compiled_functions(
            _source(geometry), names, lambda: _rows_of_pair(geometry, pairs[0], names)
        )
        return None if functions is None else cls(geometry, functions)

    def rows(self, pair: int) -> DistanceRows:
        """Return the rows of a pair, by its number."""
        robot, solids = self._geometry.robot, self._geometry.solids
        q, multiplier = ca.MX.sym("q", len(robot.joint_names)), ca.MX.sym("lambda")
        value, jacobian, hessian = self._functions
        first, second = (solids[i] for i in self._geometry.pairs[pair])
        bodies = [index for index, _ in _joints_between(robot, first.body, second.body)]
        moving = np.abs(robot.coupling[0][np.array(bodies) - 1]).any(axis=0)
        return DistanceRows(
            ca.Function("distances", [q], [value(q, pair)]),
            ca.Function("distances_jac", [q], [_only(jacobian(q, pair), moving[np.newaxis])]),
            ca.Function(
                "distances_hess",
                [q, multiplier],
                [_only(hessian(q, pair, multiplier), np.outer(moving, moving))],
            ),
        )


def _rows_of_pair(
    geometry: CollisionGeometry, pair: int, names: tuple[str, str, str]
) -> list[ca.Function]:
    """Return functions of CasADi, by their names in C, that are right for one pair."""
    rows = DistanceRows.of(geometry, [pair])
    q, number = ca.MX.sym("q", len(geometry.robot.joint_names)), ca.MX.sym("pair")
    multiplier = ca.MX.sym("lambda")
    curvature = ca.densify(rows.hessian(q, multiplier))
    return [
        ca.Function(names[0], [q, number], [rows.values(q)]),
        ca.Function(names[1], [q, number], [ca.densify(rows.jacobian(q))]),
        ca.Function(names[2], [q, number, multiplier], [curvature]),
    ]


def _source(geometry: CollisionGeometry) -> str:
    """Return the C of one robot."""
    tables = _Tables(geometry.robot)
    for pair, of_obstacle in enumerate(geometry.with_obstacles):
        links = [] if of_obstacle else [geometry.solids[i] for i in geometry.pairs[pair]]
        tables.add(links)
    return f"{_STRUCTURES}{tables.text()}\n{_SOURCE.read_text('utf-8')}"


class _Tables:
    """The tables of ``rows.c``: each line is a structure."""

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._pairs: list[str] = []
        self._roles: list[str] = []
        self._steps: list[str] = []
        self._balls: list[str] = []
        self._most_steps = self._most_balls = 1

    def add(self, links: Sequence[Solid]) -> None:
        """Add a pair of links; of none, one without rows."""
        forms = [Form.of(each) for each in links]
        roles = ball_and_field_roles(forms[0], forms[1]) if forms else []
        self._pairs.append(_structure([len(self._roles), len(roles)]))
        for balls, field in roles:
            self._add_role(links[balls], forms[balls], links[field], forms[field])

    def _add_role(self, solid: Solid, form: Form, field_solid: Solid, field: Form) -> None:
        first, way = _way(self._robot, field_solid, field, solid)
        places = [len(self._steps), len(way), len(self._balls), len(form.balls)]
        numbers = [field.box.radius + form.radius, *field.box.half, *first.R.ravel(), *first.r]
        self._roles.append(_structure([int(field.is_rod), *places], numbers))
        self._steps += [self._step(each) for each in way]
        self._balls += [_structure([], each) for each in form.balls]
        self._most_steps = max(self._most_steps, len(way))
        self._most_balls = max(self._most_balls, len(form.balls))

    def _step(self, step: _Step) -> str:
        joint, (G, b) = self._robot.bodies[step.index].joint, self._robot.coupling
        assert joint is not None
        row, sign = step.index - 1, 1.0 if step.forward else -1.0
        coordinate = int(np.argmax(np.abs(G[row])))
        slides = joint.kind is JointKind.PRISMATIC
        moved = [sign * G[row, coordinate], sign * b[row], *joint.axis]
        behind = [*step.behind.R.ravel(), *step.behind.r]
        return _structure([coordinate, int(slides)], [*moved, *behind])

    def text(self) -> str:
        """Return the C."""
        numbers = {
            "JOINTS": len(self._robot.joint_names),
            "MOST_STEPS": self._most_steps,
            "MOST_BALLS": self._most_balls,
            "SHARPNESS_OF_MINIMUM": SHARPNESS_OF_MINIMUM,
            "SHARPNESS_OF_FACES": SHARPNESS_OF_FACES,
            "SQUARE_ROOT_OFFSET": SQUARE_ROOT_OFFSET,
        }
        tables = {
            "Pair PAIRS[]": self._pairs,
            "Role ROLES[]": self._roles,
            "Step STEPS[]": self._steps,
            "double BALLS[][3]": self._balls,
        }
        lines = [f"#define {name} {number!r}" for name, number in numbers.items()]
        for name, entries in tables.items():
            lines += [f"static const {name} = {{", *(f"  {each}," for each in entries), "};"]
        return "\n".join(lines)


def _structure(integers: Sequence[int], numbers: Iterable[float] = ()) -> str:
    """Return a structure, or an array of numbers, with no digit lost."""
    values = [str(each) for each in integers] + [float(each).hex() for each in numbers]
    return f"{{{', '.join(values)}}}"


def _way(
    robot: RobotDescription, field_solid: Solid, field: Form, solid: Solid
) -> tuple[Pose, list[_Step]]:
    """Return the way from the frame of a field to the link of a solid: a pose, and the joints."""
    pose_of_field = robot.frames[field_solid.link][1] @ field.box.pose
    way = _joints_between(robot, field_solid.body, solid.body)
    # Poses between the joints: those of bodies whose joints are passed outwards or back.
    fixed = [_inverse(pose_of_field)]
    for index, forward in way:
        origin = robot.bodies[index].origin
        if forward:
            fixed[-1] = fixed[-1] @ origin
            fixed.append(Pose())
        else:
            fixed.append(_inverse(origin))
    fixed[-1] = fixed[-1] @ robot.frames[solid.link][1]
    steps = [
        _Step(index, forward, behind)
        for (index, forward), behind in zip(way, fixed[1:], strict=True)
    ]
    return fixed[0], steps


def _joints_between(robot: RobotDescription, start: int, end: int) -> list[tuple[int, bool]]:
    """Return the bodies whose joints lie between two bodies, and whether they are passed outwards,
    from the parent to the body.
    """
    back, out = chain_of(robot, start), chain_of(robot, end)
    common = len([1 for a, b in zip(back, out, strict=False) if a == b])
    return [(i, False) for i in reversed(back[common:])] + [(i, True) for i in out[common:]]


def _only(matrix: ca.MX, kept: npt.NDArray[np.bool_]) -> ca.MX:
    """Return a matrix without entries that are always zero."""
    return ca.project(matrix, ca.sparsify(ca.DM(kept.astype(float))).sparsity())


def _inverse(pose: Pose) -> Pose:
    return Pose(pose.R.T, -pose.R.T @ pose.r)
