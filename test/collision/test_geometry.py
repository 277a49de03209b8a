"""Solids and pairs of robots, and their distances against Pinocchio's."""

from __future__ import annotations

import json
import logging
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from scipy.optimize import lsq_linear
from support.slow import some_fast
from support.urdf_text import without_collisions

from spacerobot_ros.collision import CollisionGeometry, LinkPair
from spacerobot_ros.collision.distances import EnclosureDistances
from spacerobot_ros.collision.planes import PlaneDistances
from spacerobot_ros.errors import PlanningError, RobotDescriptionError
from spacerobot_ros.files import warn_first_time
from spacerobot_ros.model import load_robot, parse_robot
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.meshes import solid_mesh
from spacerobot_ros.model.urdf import obstacles_from_topic, with_srdf
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.resources import robot_file

INERTIAL = (
    '<inertial><mass value="{}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
    "</inertial>"
)


def link(name: str, *elements: str, mass: float = 2.0) -> str:
    return f'<link name="{name}">{INERTIAL.format(mass)}{"".join(elements)}</link>'


def joint(name: str, parent: str, child: str, xyz: str, kind: str = "revolute") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="0.1 0 0.2"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="2" velocity="1" effort="1"/></joint>'
    )


def solid(tag: str, geometry: str, xyz: str = "0 0 0") -> str:
    return f'<{tag}><origin xyz="{xyz}" rpy="0.2 0.1 0"/><geometry>{geometry}</geometry></{tag}>'


def chain(*elements: tuple[str, ...]) -> str:
    """Return the URDF of links a, b, ... 1 m apart, each on the one before."""
    names = "abcdefgh"[: len(elements)]
    text = "".join(link(name, *each) for name, each in zip(names, elements, strict=True))
    for i in range(1, len(names)):
        text += joint(f"j{i}", names[i - 1], names[i], "1 0 0.1")
    return f'<robot name="chain">{text}</robot>'


BALL = solid("visual", '<sphere radius="0.1"/>')


def test_collision_shapes_come_before_visual_ones() -> None:
    small = solid("collision", '<box size="0.1 0.2 0.3"/>', "0 0 0.5")
    robot = parse_robot(chain((BALL,), (BALL, small, small), (BALL,)))
    geometry = CollisionGeometry(robot)
    kinds = [(each.link, each.shape.kind) for each in geometry.solids]
    assert kinds == [("a", "sphere"), ("b", "box"), ("b", "box"), ("c", "sphere")]
    assert [len(each.shapes) for each in robot.links] == [1, 1, 1]
    assert geometry.notes == (
        "Links without <collision> use the shapes of their <visual>: 'a', 'c'.",
    )


def test_pairs_of_one_body_and_of_neighbours_do_not_count() -> None:
    text = chain((BALL,), (BALL,), (BALL,)).replace(
        "</robot>",
        link("tool", BALL) + joint("weld", "c", "tool", "0 0.3 0", kind="fixed") + "</robot>",
    )
    geometry = CollisionGeometry(parse_robot(text))
    assert [geometry.links_of(i) for i in range(len(geometry.pairs))] == [
        LinkPair("a", "c"),
        LinkPair("a", "tool"),
    ]


def test_pairs_that_are_always_in_contact_do_not_count() -> None:
    wide = solid("visual", '<sphere radius="2.6"/>')
    geometry = CollisionGeometry(parse_robot(chain((wide,), (), (BALL,), (BALL,))))
    # c is always within 2 m of a; d comes out of it.
    assert geometry.ignored_pairs == {LinkPair("a", "c"): "always in contact"}
    assert [geometry.links_of(i) for i in range(len(geometry.pairs))] == [LinkPair("a", "d")]


def srdf(tmp_path: Path, *lines: str) -> Path:
    path = tmp_path / "chain.srdf"
    path.write_text(f'<robot name="chain">{"".join(lines)}</robot>')
    return path


def test_pairs_that_an_srdf_disables_do_not_count(tmp_path: Path) -> None:
    robot = parse_robot(chain((BALL,), (BALL,), (BALL,), (BALL,)))
    disabled = '<disable_collisions link1="c" link2="a" reason="Never"/>'
    geometry = CollisionGeometry(with_srdf(robot, srdf(tmp_path, disabled)))
    assert geometry.ignored_pairs == {LinkPair("a", "c"): "disabled by the SRDF"}
    assert len(geometry.pairs) == 2
    quiet = '<disable_default_collisions link="d"/><enable_collisions link1="a" link2="d"/>'
    geometry = CollisionGeometry(with_srdf(robot, srdf(tmp_path, quiet)))
    assert geometry.ignored_pairs == {LinkPair("b", "d"): "disabled by the SRDF"}


def test_an_srdf_beside_the_urdf_is_read(tmp_path: Path) -> None:
    (tmp_path / "chain.urdf").write_text(chain((BALL,), (BALL,), (BALL,)))
    srdf(tmp_path, '<disable_collisions link1="a" link2="c"/>')
    robot = load_robot(tmp_path / "chain.urdf")
    assert robot.disabled_collisions == {frozenset({"a", "c"})}
    assert robot.with_locked({"j1": 0.3}).disabled_collisions == robot.disabled_collisions


def test_the_urdf_text_carries_the_pairs_of_an_srdf(tmp_path: Path) -> None:
    robot = parse_robot(chain((BALL,), (BALL,), (BALL,), (BALL,)).replace('"c"', '"c &amp; c"'))
    pairs = '<disable_collisions link1="a" link2="c &amp; c"/><disable_collisions link1="d" '
    with_both = with_srdf(robot, srdf(tmp_path, f'{pairs} link2="a"/>'))
    again = parse_robot(with_both.urdf)
    assert again.disabled_collisions == {frozenset({"a", "c & c"}), frozenset({"a", "d"})}
    # Those of another file take their place.
    other = with_srdf(again, srdf(tmp_path, '<disable_collisions link1="b" link2="d"/>'))
    assert parse_robot(other.urdf).disabled_collisions == {frozenset({"b", "d"})}
    assert parse_robot(with_srdf(other, srdf(tmp_path)).urdf).disabled_collisions == frozenset()
    with pytest.raises(RobotDescriptionError, match="The robot description has a <disable_coll"):
        parse_robot(robot.urdf.replace("</robot>", '<disable_collisions link1="x"/></robot>'))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<robot", "is not XML"),
        ("<sdf/>", "its root element is <sdf>"),
        (
            '<robot><disable_collisions link1="a" link2="bb"/></robot>',
            "link2 is 'bb', but the robot has no such link. Did you mean 'b'?",
        ),
        ('<robot><disable_collisions link1="a"/></robot>', "link2 is ''"),
    ],
)
def test_a_damaged_srdf_is_refused(tmp_path: Path, text: str, message: str) -> None:
    robot = parse_robot(chain((BALL,), (BALL,)))
    path = tmp_path / "chain.srdf"
    path.write_text(text)
    with pytest.raises(RobotDescriptionError, match=re.escape(message)):
        with_srdf(robot, path)
    with pytest.raises(RobotDescriptionError, match="cannot be read"):
        with_srdf(robot, tmp_path / "none.srdf")


def test_meshes_that_are_missing_are_named_with_their_links_together(tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.stl"
    damaged.write_text("damaged")
    files = [*(f"package://nowhere/{k}.stl" for k in (1, 1, 2, 3, 4)), str(damaged)]
    forms = [f'<mesh filename="{file}"/>' for file in files]
    meshes = [(solid(("visual", "collision")[k % 2], form),) for k, form in enumerate(forms)]
    geometry = CollisionGeometry(parse_robot(chain(*meshes, (BALL,))))
    together, alone = (each for each in geometry.notes if "not detected" in each)
    assert together.startswith(
        "Some contacts of links 'a', 'b', 'c' and 2 more are not detected: The mesh "
        "'package://nowhere/1.stl' was not found: "
    )
    assert together.endswith(". The same applies to 3 other meshes.")
    assert alone.startswith("Some contacts of link 'f' are not detected: The mesh ")
    assert "damaged.stl" in alone
    assert "The same" not in alone
    assert [each.link for each in geometry.solids] == ["g"]


def test_a_tilted_flat_mesh_lies_where_its_corners_are(tmp_path: Path) -> None:
    """Its hull is the parallelogram of the corners: the distance from a ball by least squares."""
    corners = np.array([[0, 0, 0], [2, 0, 0.8], [2, 1, 0.8], [0, 1, 0]])
    lines = "".join(f"v {x} {y} {z}\n" for x, y, z in corners)
    (tmp_path / "plate.obj").write_text(f"{lines}f 1 2 3\n")
    plate = f'<collision><geometry><mesh filename="{tmp_path}/plate.obj"/></geometry></collision>'
    other = '<collision><origin xyz="-1 0.5 1"/><geometry><sphere radius="0.25"/></geometry>'
    text = chain((plate,), (), (f"{other}</collision>",))
    robot = parse_robot(text.replace("0.1 0 0.2", "0 0 0"))
    geometry = CollisionGeometry(robot)
    for q in ([0.0, 0.0], [0.3, -0.4]):
        pair, poses = 0, geometry.poses(np.array([q]))
        frame = pin.buildModelFromXML(without_collisions(robot.urdf))
        data = frame.createData()
        pin.framesForwardKinematics(frame, data, np.array(q))
        center = data.oMf[frame.getFrameId("c")].act(np.array([-1.0, 0.5, 1.0]))
        sides = (corners[[1, 3]] - corners[0]).T
        share = lsq_linear(sides, center - corners[0], bounds=(0.0, 1.0)).x
        expected = np.linalg.norm(sides @ share + corners[0] - center) - 0.25
        assert geometry.distances(pair, poses)[0] == pytest.approx(expected, abs=1e-5)


def test_round_meshes_of_many_facets_have_distances(tmp_path: Path) -> None:
    """More facets than coal allows neighbours of a vertex; a cone counts as the box around it."""
    turn = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)
    rim = np.stack((0.5 * np.cos(turn), 0.5 * np.sin(turn), np.zeros_like(turn)), axis=1)
    half = np.array([0.0, 0.0, 0.05])
    disc = np.concatenate((rim - half, rim + half))
    bounds = {}
    for name, corners in (("disc", disc), ("cone", np.concatenate((rim, [[0, 0, 0.4]])))):
        lines = "".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in corners.tolist())
        (tmp_path / f"{name}.obj").write_text(f"{lines}f 1 2 {len(corners)}\n")
        mesh = f'<collision><geometry><mesh filename="{tmp_path}/{name}.obj"/></geometry>'
        text = chain((f"{mesh}</collision>",), (), (BALL.replace("0.2 0.1 0", "0 0 0"),))
        geometry = CollisionGeometry(parse_robot(text.replace("0.1 0 0.2", "0 0 0")))
        (bounds[name],), _ = geometry.nearest_along(np.zeros((1, 2)))
    # The ball of 0.1 m is at (2, 0, 0.2).
    assert bounds["disc"] == pytest.approx(np.hypot(1.5, 0.15) - 0.1, abs=1e-4)
    assert 1.5 - 0.1 - 1e-6 <= bounds["cone"] <= np.hypot(1.5, 0.2) - 0.1


@pytest.mark.parametrize("name", ["dual_arm", "servicer"])
def test_distances_are_those_of_pinocchio(name: str) -> None:
    path = str(robot_file(name))
    robot = load_robot(path)
    geometry = CollisionGeometry(robot)
    model = pin.buildModelFromUrdf(path)
    solids = pin.buildGeomFromUrdf(model, path, pin.GeometryType.VISUAL)
    solids.addAllCollisionPairs()
    data, of_solids = model.createData(), pin.GeometryData(solids)
    order = [robot.joint_names.index(each) for each in list(model.names)[1:]]
    low, high = robot.limits("lower"), robot.limits("upper")
    for q in np.random.default_rng(3).uniform(low, high, (3, len(low))):
        pin.computeDistances(model, data, solids, of_solids, q[order])
        truth: dict[frozenset[str], float] = {}
        for pair, result in zip(solids.collisionPairs, of_solids.distanceResults, strict=True):
            names = frozenset(
                solids.geometryObjects[i].name.rsplit("_", 1)[0] for i in (pair.first, pair.second)
            )
            truth[names] = min(truth.get(names, np.inf), result.min_distance)
        found: dict[frozenset[str], float] = {}
        poses = geometry.poses(q[np.newaxis])
        for number in range(len(geometry.pairs)):
            names = frozenset(geometry.links_of(number))
            distance = float(geometry.distances(number, poses)[0])
            assert geometry.lower_bounds(poses)[0, number] <= distance + 1e-6
            found[names] = min(found.get(names, np.inf), distance)
        assert len(found) >= 15
        for names, distance in found.items():
            assert distance == pytest.approx(truth[names], abs=1e-5), names
        nearest, _ = geometry.nearest_along(q[np.newaxis])
        assert nearest == pytest.approx(min(found.values()), abs=1e-9)


WITHOUT_COAL = """
import json, logging, sys
import numpy as np
sys.modules["coal"] = None
logging.basicConfig(format="%(message)s")
from spacerobot_ros.collision import CollisionGeometry
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.simulation.clearance import ClearanceMonitor
text, shapes = json.load(sys.stdin)
geometry = CollisionGeometry(robot := parse_robot(text))
assert ClearanceMonitor.of(robot, ("base_link", "upper_arm")) is None
poses = geometry.poses(np.array(shapes))
bounds = [geometry.distances(k, poses).tolist() for k in range(len(geometry.pairs))]
pairs = list(zip(geometry.pairs.tolist(), bounds))
ignored = sorted(map(sorted, geometry.ignored_pairs))
json.dump([geometry.exact, ignored, pairs], sys.stdout)
"""


def test_without_coal_distances_are_bounds(tmp_path: Path) -> None:
    robot = parse_robot(without_collisions(load_robot(robot_file("surveyor")).urdf))
    exact = CollisionGeometry(robot)
    low, high = robot.limits("lower"), robot.limits("upper")
    shapes = np.random.default_rng(7).uniform(low, high, (20, len(low)))
    ended = [
        subprocess.run(
            [sys.executable, "-c", WITHOUT_COAL],
            input=json.dumps([robot.urdf, shapes.tolist()]),
            env={**os.environ, "SPACEROBOT_CACHE_DIR": str(tmp_path / "cache")},
            capture_output=True,
            text=True,
            check=True,
        )
        for _ in range(2)
    ]
    # The next command warns of it no more.
    assert [each.stderr for each in ended] == [
        "Distances between links are lower bounds from enclosing spheres, capsules and boxes, "
        "because the package coal is not installed: `pip install '.[collision]'` in the clone.\n"
        "The plant cannot measure clearance without the package coal.\n",
        "",
    ]
    is_exact, ignored_pairs, bounds = json.loads(ended[0].stdout)
    assert (exact.exact, is_exact) == (True, False)
    # The box around the bus and that around the arm are always in contact.
    assert set(exact.ignored_pairs) == set()
    assert ignored_pairs == [["base_link", "upper_arm"]]
    numbers = {tuple(pair): number for number, pair in enumerate(exact.pairs.tolist())}
    poses = exact.poses(shapes)
    loose = 0.0
    for pair, bound in bounds:
        true = exact.distances(numbers[tuple(pair)], poses)
        difference = true - bound
        assert difference.min() > -1e-5
        loose = max(loose, float(difference.max()))
    assert 0.001 < loose < 0.3


def test_installations_that_share_a_cache_are_each_told_once_that_coal_is_missing(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    sentence, told = "Distances between links are lower bounds.", []
    for prefix in ("/opt/first", "/opt/second", "/opt/first"):
        monkeypatch.setattr(sys, "prefix", prefix)
        caplog.clear()
        warn_first_time(logging.getLogger("collision"), tmp_path, "warned_of_coal", sentence)
        told.append([each.message for each in caplog.records])
    assert told == [[sentence], [sentence], []]


def test_a_robot_without_shapes_has_no_pairs() -> None:
    robot: RobotDescription = parse_robot(chain((), (), ()))
    geometry = CollisionGeometry(robot)
    assert len(geometry.pairs) == 0
    assert geometry.nearest_along(np.zeros((1, 2)))[0] == np.inf
    assert geometry.notes == ()


def test_the_collision_shapes_of_surveyor_are_its_parts_and_leave_the_arm_its_room() -> None:
    """All corners of its meshes are in one of the solids."""
    robot = load_robot(robot_file("surveyor"))
    drawn = CollisionGeometry(parse_robot(without_collisions(robot.urdf)))
    solids = CollisionGeometry(robot).solids
    for mesh in drawn.solids:
        assert mesh.vertices is not None
        beyond = np.full(len(mesh.vertices), np.inf)
        for solid in solids:
            if solid.link == mesh.link:
                at = (mesh.vertices - solid.shape.pose.r) @ solid.shape.pose.R
                if solid.shape.kind == "box":
                    away = np.abs(at) - np.array(solid.shape.size) / 2
                else:
                    radius, length = solid.shape.size
                    away = np.column_stack(
                        [np.hypot(at[:, 0], at[:, 1]) - radius, np.abs(at[:, 2]) - length / 2]
                    )
                beyond = np.minimum(beyond, away.max(axis=1))
        assert beyond.max() < 1e-3, mesh.link
    # The hull of the bus and its dish would touch the arm; they are 5 cm apart.
    q = np.array([[1.57, -0.77, 1.3, 0.19]])
    assert drawn.nearest_along(q)[0] < 0.0
    assert CollisionGeometry(robot).nearest_along(q)[0] == pytest.approx(0.05, abs=1e-4)


def test_a_capsule_is_a_cylinder_with_round_ends() -> None:
    rod = solid("collision", '<capsule radius="0.1" length="0.6"/>')
    geometry = CollisionGeometry(parse_robot(chain((BALL,), (rod,), (BALL,))))
    links = [each.link for each in geometry.solids]
    i, j = links.index("b"), links.index("c")
    pose = geometry.solids[i].shape.pose
    # The capsule along z at the origin, the ball beside it or beyond its end.
    R, r = pose.R.T[np.newaxis], -(pose.R.T @ pose.r)[np.newaxis]
    for place, nearest in (([0.5, 0.1, 0.7], [0.0, 0.0, 0.3]), ([0.6, 0.0, 0.1], [0.0, 0.0, 0.1])):
        found = geometry.distance_function(i, R, r, j, R, np.array([place]))
        expected = np.linalg.norm(np.subtract(place, nearest)) - 0.1 - 0.1
        assert found == pytest.approx(expected, abs=1e-6)
    vertices = solid_mesh(replace(geometry.solids[i].shape, pose=Pose())).vertices
    axis = np.clip(vertices[:, 2], -0.3, 0.3)
    np.testing.assert_allclose(
        np.linalg.norm(vertices - np.outer(axis, [0, 0, 1]), axis=1), 0.1, atol=1e-12
    )
    assert np.ptp(vertices[:, 2]) == pytest.approx(0.8)


def test_plans_are_refused_where_the_mesh_of_a_collision_is_missing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    mesh = '<mesh filename="package://nowhere/arm.stl"/>'
    declared = parse_robot(chain((BALL,), (solid("collision", mesh),), (BALL,)))
    start = np.zeros(len(declared.joint_names))
    with pytest.raises(PlanningError, match=r"link 'b' .*'package://nowhere/arm.stl' .* SRDF"):
        Clearance(declared, 0.01).required(start)
    pairs = [frozenset({"b", link.name}) for link in declared.links if link.name != "b"]
    disabled = replace(declared, disabled_collisions=frozenset(pairs))
    Clearance(disabled, 0.01).required(start)
    drawn = parse_robot(chain((BALL,), (solid("visual", mesh),), (BALL,)))
    Clearance(drawn, 0.01).required(start)
    (warning,) = caplog.messages
    assert warning.startswith("Some contacts of link 'b' are not detected: The mesh 'package://")
    world = f'<robot name="w"><link name="crate">{solid("visual", mesh)}</link></robot>'
    with pytest.raises(RobotDescriptionError, match=r"Obstacle 'crate' .*'package://nowhere/arm"):
        obstacles_from_topic(world)


# -- distances from planes, and their derivatives against differences ----------------------------

ROBOTS = some_fast(
    ["three_joint_arm", "seven_joint_arm", "dual_arm", "free_flyer", "solar_booms", "quadruped"],
    *("three_joint_arm", "dual_arm", "solar_booms"),
)


def shapes(geometry: CollisionGeometry, count: int) -> Array:
    robot = geometry.robot
    low = np.maximum(robot.limits("lower"), -3.0)
    high = np.minimum(robot.limits("upper"), 3.0)
    return np.random.default_rng(11).uniform(low, high, (count, len(low)))


def y_of(q: Array) -> Array:
    """Return what rows are functions of: without obstacles, the base may have any attitude."""
    return np.concatenate([q, [0.0, 0.0, 0.0, 1.0]])


def some_pairs(geometry: CollisionGeometry) -> list[int]:
    return list(range(0, len(geometry.pairs), 1 + len(geometry.pairs) // 5))


@pytest.mark.parametrize("enclosures", [False, True])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_row_is_the_distance_where_its_plane_is_made(name: str, enclosures: bool) -> None:
    geometry = CollisionGeometry(load_robot(robot_file(name)))
    if enclosures:
        geometry.__dict__["distance_function"] = EnclosureDistances(geometry.solids)
    at, contacts = shapes(geometry, 120), 0
    poses = geometry.poses(at)
    for pair in some_pairs(geometry):
        row = PlaneDistances.of(geometry, [pair])
        distances, planes = geometry.planes(pair, poses)
        exact = geometry.distances(pair, poses)
        contacts += int((exact < 0).sum())
        np.testing.assert_allclose(distances, exact, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(planes[:, :3], axis=1), 1.0, atol=1e-9)
        found = [float(row.values(y_of(q), plane)) for q, plane in zip(at, planes, strict=True)]
        # Depths by coal are those of an iteration.
        np.testing.assert_allclose(found, exact, atol=2e-5)
    assert contacts or name != "dual_arm"


@pytest.mark.parametrize("name", ROBOTS)
def test_a_row_changes_as_the_distance_does(name: str) -> None:
    """Where solids are apart, and where their distance has a derivative at all."""
    geometry = CollisionGeometry(load_robot(robot_file(name)))
    at, step, compared = shapes(geometry, 12), 1e-5, 0
    for pair in some_pairs(geometry):
        row = PlaneDistances.of(geometry, [pair])
        distances, planes = geometry.planes(pair, geometry.poses(at))
        for q, d, plane in zip(at, distances, planes, strict=True):
            J = row.jacobian(y_of(q), plane)[1].full()[0, : len(q)]
            moves = step * np.eye(len(q))
            after = geometry.distances(pair, geometry.poses(np.vstack([q + moves, q - moves])))
            ahead, behind = (after[: len(q)] - d) / step, (d - after[len(q) :]) / step
            if d > 0.02 and np.abs(ahead - behind).max() < 1e-3:
                compared += 1
                np.testing.assert_allclose((ahead + behind) / 2, J, atol=2e-3)
    assert compared > 5


def test_derivatives_are_those_of_differences() -> None:
    geometry = CollisionGeometry(load_robot(robot_file("seven_joint_arm")))
    step = 1e-6
    for pair in (0, 7, 20, 31):
        row, at = PlaneDistances.of(geometry, [pair]), shapes(geometry, 4)
        _, planes = geometry.planes(pair, geometry.poses(at))
        # Away from the shapes that the planes were made for, too.
        for q, plane in zip(at[::-1], planes, strict=True):
            y = y_of(q)
            moves = step * np.eye(len(y))
            J = row.jacobian(y, plane)[1].full()
            differences = [
                float(row.values(y + e, plane) - row.values(y - e, plane)) for e in moves
            ]
            assert np.array([differences]) / (2 * step) == pytest.approx(J, abs=1e-7)
            bend = [
                (row.jacobian(y + e, plane)[1] - row.jacobian(y - e, plane)[1]).full()[0]
                for e in moves
            ]
            slope, H = (each.full() for each in row.hessian(y, plane, -1.3))
            assert slope == pytest.approx(-1.3 * J)
            assert -1.3 * np.array(bend) / (2 * step) == pytest.approx(H, abs=1e-7)
