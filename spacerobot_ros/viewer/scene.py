"""The robot and what is drawn around it, as nodes of a viser scene.

A tree of frames like that of the URDF hangs on the pose of the base: only what a joint moves is
sent again. Names of links stay out of the paths of nodes, which have slashes of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.control.thrusters import ThrusterTable
from spacerobot_ros.errors import MeshError
from spacerobot_ros.model.description import Array, Pose, RobotDescription, Shape
from spacerobot_ros.model.kinematics import ForwardKinematics, joints_outward
from spacerobot_ros.model.meshes import shape_mesh
from spacerobot_ros.model.visuals import solid_mesh

if TYPE_CHECKING:
    import viser

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""

GHOST_OPACITY = 0.35
_PLANNED: Color = (240, 150, 25)
_FLOWN: Color = (60, 130, 240)
_PLUME: Color = (255, 110, 40)
_LINE = 3.0
"""Pixels."""

_ROOM = 32
"""Segments that a line has room for at least."""

_GRID: tuple[Color, Color] = (150, 150, 155), (120, 120, 128)
"""Cells and sections: seen on white and on black."""

_MOST_TRIANGLES = 20_000
"""Of a mesh that is sent to browsers: a finer one is made coarser."""

_SCALE = 0.05
"""Radius of the spheres that a robot without shapes has at its joints, m."""


def wxyz(quaternion: Array) -> Array:
    """Return a quaternion (x, y, z, w) in viser's order."""
    return np.asarray(quaternion)[[3, 0, 1, 2]]


def xyzw(quaternion: Array) -> Array:
    """Return a quaternion of viser's order as (x, y, z, w)."""
    return np.asarray(quaternion, dtype=float)[[1, 2, 3, 0]]


class RobotDrawing:
    """A drawing of a robot: the robot itself, or the ghost at its goal.

    Parameters
    ----------
    scene
        Where it is drawn.
    path
        The node of its base; what hangs on a node moves with it.
    robot
        What is drawn.
    color
        Of everything; None: the colors of the URDF.
    on_note
        Called with a sentence about what cannot be drawn.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        path: str,
        robot: RobotDescription,
        *,
        color: Color | None = None,
        on_note: Callable[[str], None] = lambda sentence: None,
    ) -> None:
        self._scene, self._path, self._color, self._on_note = scene, path, color, on_note
        self._kinematics = kinematics = ForwardKinematics(robot)
        self.base = scene.add_frame(path, show_axes=False)
        paths = self._paths(robot)
        frames: dict[str, Any] = {}
        for pairs, poses in (
            (kinematics.moving, kinematics.transforms),
            (kinematics.fixed, kinematics.fixed_transforms),
        ):
            for (_, child), pose in zip(pairs, poses, strict=True):
                frames[child] = scene.add_frame(
                    paths[child], show_axes=False, position=pose[:3], wxyz=wxyz(pose[3:])
                )
        self._moving = [frames[child] for _, child in kinematics.moving]
        self._solids: list[Any] = []
        for link in robot.links:
            for number, shape in enumerate(self._shapes(robot, link.name)):
                solid = self._solid(f"{paths[link.name]}/{number}", shape)
                if solid is not None:
                    self._solids.append(solid)

    def _paths(self, robot: RobotDescription) -> dict[str, str]:
        """Return the path of the scene node of every link."""
        paths = {robot.base_link: self._path}
        for joint in joints_outward(robot):
            paths[joint.child] = f"{paths[joint.parent]}/link{len(paths)}"
        return paths

    def _shapes(self, robot: RobotDescription, link: str) -> list[Shape]:
        shapes = next(each.shapes for each in robot.links if each.name == link)
        if any(each.shapes for each in robot.links):
            return list(shapes)
        ball = Shape("sphere", (_SCALE,), Pose())
        bars = [_bar(joint.origin.r) for joint in robot.joints if joint.parent == link]
        return [ball, *(bar for bar in bars if bar is not None)]

    def _solid(self, path: str, shape: Shape) -> Any | None:
        """Draw a visual in the frame of its link; None where it cannot be drawn."""
        try:
            mesh = shape_mesh(shape, _MOST_TRIANGLES) if shape.kind == "mesh" else solid_mesh(shape)
        except MeshError as error:
            self._on_note(str(error))
            return None
        red, green, blue, alpha = shape.rgba
        look: dict[str, Any] = {"cast_shadow": False, "receive_shadow": False}
        look["color"] = self._color or tuple(round(255 * x) for x in (red, green, blue))
        if self._color is not None:
            look["opacity"] = GHOST_OPACITY
        elif alpha < 1.0:
            look["opacity"] = alpha
        faces = mesh.faces.astype(np.uint32)
        return self._scene.add_mesh_simple(path, mesh.vertices, faces, flat_shading=True, **look)

    def paint(self, color: Color) -> None:
        """Give everything a color."""
        if color != self._color:
            self._color = color
            for solid in self._solids:
                solid.color = color

    def place(self, pose: Array) -> None:
        """Have the base at a pose (7,) in what the drawing hangs on."""
        self.base.position = pose[:3]
        self.base.wxyz = wxyz(pose[3:])

    def set_joint_positions(self, q: Array) -> None:
        """Move the links to positions (n,) of the joints, m or rad."""
        self._kinematics.update(q)
        for frame, pose in zip(self._moving, self._kinematics.transforms, strict=True):
            frame.position = pose[:3]
            frame.wxyz = wxyz(pose[3:])


def _bar(end: Array) -> Shape | None:
    """Return a thin cylinder from the origin to a point, None where that is the origin."""
    length = float(np.linalg.norm(end))
    if length < 1e-6:
        return None
    z = end / length
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(z, x), z])
    return Shape("cylinder", (0.4 * _SCALE, length), Pose(R, end / 2))


def reach_of(robot: RobotDescription) -> float:
    """Return a length that the whole robot fits into, from the origin of its base, m."""
    farthest: dict[str, float] = {robot.base_link: 0.0}
    for joint in joints_outward(robot):
        farthest[joint.child] = farthest[joint.parent] + float(np.linalg.norm(joint.origin.r))
    sizes = [
        farthest[link.name]
        + float(np.linalg.norm(shape.pose.r))
        + (0.0 if shape.kind == "mesh" else 0.5 * float(np.linalg.norm(shape.size)))
        for link in robot.links
        for shape in link.shapes
    ]
    return max([*sizes, *farthest.values(), 0.1])


class Lines:
    """Connected points in the scene, such as a path.

    A node has room for a number of segments, and another takes its place when there are more: pages
    do not draw anew what changes its size.

    Parameters
    ----------
    scene, path
        Where it is drawn.
    color
        Of the line.
    """

    def __init__(self, scene: viser.SceneApi, path: str, color: Color) -> None:
        self._scene, self._path, self._color = scene, path, color
        self._room = 0
        self._handle: Any = None

    def draw(self, points: Array) -> None:
        """Connect points (k, 3), m; fewer than two draw nothing."""
        self.draw_segments(np.stack([points[:-1], points[1:]], axis=1))

    def draw_segments(self, segments: Array) -> None:
        """Draw segments (k, 2, 3), m; none: nothing."""
        if not len(segments):
            if self._handle is not None:
                self._handle.visible = False
            return
        larger = len(segments) > self._room
        if larger:
            self._room = max(_ROOM, 2 ** (len(segments) - 1).bit_length())
        # What is left of the room is at the end, without a length.
        filled = np.broadcast_to(segments[-1, 1], (self._room, 2, 3)).astype(np.float32)
        filled[: len(segments)] = segments
        if larger:
            self._handle = self._scene.add_line_segments(
                self._path, filled, self._color, thickness=_LINE, thickness_units="screen"
            )
        else:
            self._handle.points = filled
            self._handle.visible = True


def plumes(table: ThrusterTable, names: tuple[str, ...], duty: Array, length: float) -> Array:
    """Return the segments (k, 2, 3) of the plumes of the thrusters that are on, base frame, m.

    Parameters
    ----------
    table
        Where they are.
    names, duty
        Of each, for what part of the time it is on.
    length
        Of a plume that is always on, m.
    """
    segments = []
    for name, part in zip(names, duty, strict=True):
        if part > 0.0 and name in table.names:
            i = table.index(name)
            end = table.r_B[i] - (0.3 + 0.7 * min(float(part), 1.0)) * length * table.direction_B[i]
            segments.append([table.r_B[i], end])
    return np.array(segments, float).reshape(-1, 2, 3)


class Surroundings:
    """Grid, paths and plumes.

    Parameters
    ----------
    scene
        Where they are drawn.
    reach
        Length that the robot fits into, m.
    robot_path
        The node of the robot's base, on which the plumes hang.
    center
        (3,) point above which the grid lies, m.
    """

    def __init__(self, scene: viser.SceneApi, reach: float, robot_path: str, center: Array) -> None:
        cell = 10.0 ** np.floor(np.log10(reach)) / 2
        cells, sections = _GRID
        # Lines stay at round coordinates, wherever it is.
        x, y, _ = 10 * cell * np.round(center / (10 * cell))
        scene.add_grid(
            "/grid",
            width=8 * reach,
            height=8 * reach,
            cell_size=cell,
            section_size=10 * cell,
            cell_color=cells,
            section_color=sections,
            position=(x, y, center[2] - 1.2 * reach),
            fade_distance=12 * reach,
        )
        scene.add_frame("/world", axes_length=0.25 * reach, axes_radius=0.006 * reach)
        self.planned = Lines(scene, "/planned_path", _PLANNED)
        self.flown = Lines(scene, "/flown_path", _FLOWN)
        self.plumes = Lines(scene, f"{robot_path}/plumes", _PLUME)
