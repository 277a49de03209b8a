"""Forms of solids in rows: rods, grids of balls on boxes, and plates; and the solids of a robot."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.collision.geometry import Solid, solids_of
from spacerobot_ros.collision.rounded_box import RoundedBox
from spacerobot_ros.collision.rows import SmoothForm
from spacerobot_ros.errors import MeshError
from spacerobot_ros.model.description import Pose, Shape

TURN = Rotation.from_rotvec([0.3, -0.5, 0.2])
POSE = Pose(TURN.as_matrix(), np.array([0.5, -1.0, 2.0]))


def form(kind: str, *size: float, half: Any = None, radius: float = 0.0) -> SmoothForm:
    """Return the form of a solid, whose enclosure has these half edges."""
    shape = Shape(kind, size, POSE)
    box = RoundedBox(POSE, np.array(size if half is None else half, dtype=float), radius)
    return SmoothForm.of(Solid("link", 1, shape, box))


def local(found: SmoothForm) -> list[list[float]]:
    """Return the balls in the axes of the solid."""
    here = TURN.inv().apply(found.ball_centers - POSE.r)
    return sorted(np.round(here, 9).tolist())


def test_a_long_cylinder_is_a_rod_whose_last_balls_cover_its_rims() -> None:
    """0.2 m thick and 0.9 m long: balls from -0.39 to 0.39 m, no farther apart than the radius."""
    found = form("cylinder", 0.1, 0.9, half=[0.1, 0.1, 0.45])
    assert (found.is_rod, found.radius) == (True, 0.1)
    np.testing.assert_allclose(found.box.half, [0.0, 0.0, 0.39])
    wanted = [[0.0, 0.0, z] for z in np.round(np.linspace(-0.39, 0.39, 9), 9)]
    np.testing.assert_allclose(local(found), wanted, atol=1e-9)
    # However long, at most twelve.
    assert len(form("cylinder", 0.1, 9.0).ball_centers) == 12


def test_a_short_cylinder_is_its_box_and_one_at_the_border_a_rod() -> None:
    assert form("cylinder", 0.5, 0.6, half=[0.5, 0.5, 0.3]).is_rod
    short = form("cylinder", 0.5, 0.59, half=[0.5, 0.5, 0.295])
    assert (short.is_rod, short.radius) == (False, 0.0)
    assert form("cylinder", 0.5, 0.6, half=[0.5, 0.5, 0.3]).box.half.tolist() == [0.0, 0.0, 0.0]


def test_a_sphere_is_one_ball() -> None:
    found = form("sphere", 0.25, half=[0.0, 0.0, 0.0], radius=0.25)
    assert (local(found), found.radius, found.is_rod) == ([[0.0, 0.0, 0.0]], 0.25, True)


def test_a_slender_box_of_square_section_is_a_rod() -> None:
    """Between the circles in and around the section: (0.2 + 0.25) / 2 = 0.225."""
    found = form("box", 1.0, 0.15, 0.2)
    assert found.is_rod
    assert found.radius == pytest.approx(0.225)
    np.testing.assert_allclose(found.box.half, [1.0 - 0.6 * 0.225, 0.0, 0.0])
    middle = form("box", 0.15, 1.0, 0.2)
    np.testing.assert_allclose(middle.box.half, [0.0, 1.0 - 0.6 * 0.225, 0.0])
    # Not slender, and not of square section.
    assert not form("box", 1.0, 0.3, 0.36).is_rod
    assert form("box", 1.0, 0.3, 0.34).is_rod
    assert not form("box", 1.0, 0.1, 0.2).is_rod
    assert form("box", 1.0, 0.13, 0.2).is_rod


def test_a_box_has_balls_on_its_faces_more_along_its_longer_edges() -> None:
    """Edges of 2, 1 and 0.8 m: three, two and two points, all of them on faces."""
    found = form("box", 1.0, 0.5, 0.4)
    assert (found.radius, len(found.ball_centers)) == (0.0, 12)
    assert local(found) == sorted(
        [x, y, z] for x in (-1.0, 0.0, 1.0) for y in (-0.5, 0.5) for z in (-0.4, 0.4)
    )
    # Three along each edge of a longer one leave the middle out.
    cube = form("box", 0.8, 0.9, 1.0)
    assert len(cube.ball_centers) == 26
    assert [0.0, 0.0, 0.0] not in local(cube)


def test_a_plate_is_one_layer_of_thick_balls() -> None:
    found = form("box", 1.0, 0.09, 0.7, radius=0.02)
    assert found.radius == pytest.approx(0.11)
    assert local(found) == sorted([x, 0.0, z] for x in (-1.0, 0.0, 1.0) for z in (-0.7, 0.0, 0.7))
    assert form("box", 1.0, 0.11, 0.7).radius == 0.0


def link(name: str, shapes: tuple[Shape, ...] = (), collisions: tuple[Shape, ...] = ()) -> Any:
    return SimpleNamespace(name=name, shapes=shapes, collisions=collisions)


def robot(*links: Any) -> Any:
    frames = {each.name: (number, None) for number, each in enumerate(links)}
    return SimpleNamespace(links=links, frames=frames)


BOX, BALL = Shape("box", (0.2, 0.0, 0.0), POSE), Shape("sphere", (0.5,), POSE)
NOTHING = Shape("box", (0.0, 0.0, 0.0), POSE)


def test_solids_are_the_shapes_that_have_a_size() -> None:
    solids, notes = solids_of(robot(link("a", (), (BOX, NOTHING)), link("b", (BOX,), (BALL,))))
    assert [(each.link, each.body, each.shape.kind) for each in solids] == [
        ("a", 0, "box"),
        ("b", 1, "sphere"),
    ]
    assert notes == ()


@pytest.mark.parametrize(
    ("drawn", "note"),
    [
        (1, "Links without <collision> have the shapes of their <visual>: 'l0'."),
        (3, "Links without <collision> have the shapes of their <visual>: 'l0', 'l1', 'l2'."),
        (4, "Links without <collision> have the shapes of their <visual>: 'l0', 'l1', 'l2', ..."
            "."),
    ],
)  # fmt: skip
def test_links_that_are_only_drawn_are_named(drawn: int, note: str) -> None:
    links = [link(f"l{i}", (BALL,)) for i in range(drawn)]
    solids, notes = solids_of(robot(*links, link("solid", (), (BOX,))))
    assert notes == (note,)
    assert len(solids) == drawn + 1
    _, notes = solids_of(robot(*links))
    assert notes == ("No link has a <collision>: distances are those of the <visual> shapes.",)
    assert solids_of(robot(link("bare"))) == ((), ())


def test_a_mesh_that_cannot_be_read_is_noted_and_its_neighbours_are_kept() -> None:
    def mesh_of(shape: Shape) -> Any:
        if shape.resource == "bad":
            raise MeshError("it is cut.")
        grid = np.array(np.meshgrid([-1.0, 0.0, 1.0], [0.0, 2.0], [0.0, 3.0])).reshape(3, -1).T
        return SimpleNamespace(vertices=grid)

    good, bad = (Shape("mesh", (1.0, 1.0, 1.0), POSE, resource=each) for each in ("good", "bad"))
    made = cast(Any, robot(link("a", (), (bad, good, BALL))))
    solids, notes = solids_of(made, mesh_of)
    assert notes == ("Contacts of link 'a' are not all noticed: it is cut.",)
    assert [each.shape.kind for each in solids] == ["mesh", "sphere"]
    assert solids[0].vertices is not None
    assert solids[0].vertices.shape == (8, 3)
