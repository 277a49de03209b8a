"""The robot and its surroundings as nodes in a viser scene.

The frame tree of the URDF is attached to the base pose, so only transforms changed by a joint
are sent again. Node paths use slashes as separators, so they do not contain link names,
which may include slashes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from spacerobot_ros.collision.distances import collision_visuals, obstacle_visuals
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.kinematics import ForwardKinematics, joints_outward
from spacerobot_ros.model.meshes import Visual, meshes_from_files, visuals_of
from spacerobot_ros.model.thrusters import ThrusterTable
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY

if TYPE_CHECKING:
    import viser

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255."""

GHOST_OPACITY = 0.35
_PLANNED: Color = (240, 150, 25)
_FLOWN: Color = (60, 130, 240)
_FLOWN_END_EFFECTOR: Color = (215, 125, 175)
_PLUME: Color = (255, 110, 40)
_COLLISION: Color = (200, 60, 200)
_LINE_WIDTH = 3.0  # pixels

_FRAME_SIZE = 0.12
"""Length of link axes, in robot lengths."""

_STARS, _SKY = 1800, 40.0
"""Number of stars, and distance of the stars in robot lengths."""

_SPACE = np.full((1, 1, 3), 14, np.uint8)
"""Image of the space behind the stars: one pixel (red, green, blue)."""

_SUN = np.array([0.55, 0.65, 0.52]) / np.linalg.norm([0.55, 0.65, 0.52])
_SUN_COLOR: Color = (255, 244, 214)
_SUN_INTENSITY, _SKY_INTENSITY = 3.0, 0.35

_GRID: tuple[Color, Color] = (150, 150, 155), (120, 120, 128)
"""Cell and section colours, visible on white and black."""

_MAX_MESH_TRIANGLES = 20_000
"""Largest number of triangles in a mesh; finer meshes are simplified."""


def wxyz(quaternion: Array) -> Array:
    """Return a quaternion (x, y, z, w) in viser's order."""
    return np.asarray(quaternion)[[3, 0, 1, 2]]


def xyzw(quaternion: Array) -> Array:
    """Return a quaternion in viser's order as (x, y, z, w)."""
    return np.asarray(quaternion, dtype=float)[[1, 2, 3, 0]]


class RobotDrawing:
    """A drawn robot: the robot itself, or the ghost at its goal.

    Parameters
    ----------
    scene
        Scene to draw in.
    path
        Node path of the base of the robot.
    robot
        The robot.
    color
        Color of all parts; None: the URDF colors.
    on_note
        Function called with a message about each mesh that cannot be drawn.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        path: str,
        robot: RobotDescription,
        *,
        color: Color | None = None,
        on_note: Callable[[str], None] = lambda message: None,
    ) -> None:
        self._scene = scene
        self._kinematics = kinematics = ForwardKinematics(robot)
        self.base = scene.add_frame(path, show_axes=False)
        paths = {robot.base_link: path}
        for joint in joints_outward(robot):
            paths[joint.child] = f"{paths[joint.parent]}/link{len(paths)}"
        frames: dict[str, Any] = {}
        for pairs, poses in (
            (kinematics.moving, kinematics.transforms_at(np.zeros(len(robot.joint_names)))),
            (kinematics.fixed, kinematics.fixed_transforms),
        ):
            for (_, child), pose in zip(pairs, poses, strict=True):
                frames[child] = scene.add_frame(
                    paths[child], show_axes=False, position=pose[:3], wxyz=wxyz(pose[3:])
                )
        self._moving = [frames[child] for _, child in kinematics.moving]
        self._frames = {robot.base_link: self.base, **frames}
        meshes = meshes_from_files(robot, _MAX_MESH_TRIANGLES, on_note)
        self._solids = [
            _draw_solid(scene, f"{paths[visual.link]}/{number}", visual, color)
            for number, visual in enumerate(visuals_of(robot, meshes, _MAX_MESH_TRIANGLES))
        ]
        self._robot, self._paths = robot, paths
        self._extras: dict[str, list[Any]] = {}
        """Parts by kind; each kind is drawn when first shown."""

    def show_collision_shapes(self, *, visible: bool) -> None:
        """Show or hide the geometry used to measure distances between links."""
        scene, paths = self._scene, self._paths
        self._show("collision", visible, lambda: [
            _draw_solid(scene, f"{paths[visual.link]}/collision{number}", visual, _COLLISION)
            for number, visual in enumerate(collision_visuals(self._robot))
            if len(visual.mesh.faces)
        ])  # fmt: skip

    def show_frames(self, *, visible: bool) -> None:
        """Show or hide the axes of all link frames."""
        length = _FRAME_SIZE * reach_of(self._robot)
        for frame in self._frames.values():
            if visible:
                frame.axes_length, frame.axes_radius = length, 0.03 * length
            frame.show_axes = visible

    def show_names(self, *, visible: bool) -> None:
        """Show or hide all link names, at the link frame origins."""
        add, paths = self._scene.add_label, self._paths
        self._show("name", visible, lambda: [add(f"{paths[x]}/name", x) for x in self._frames])

    def _show(self, kind: str, visible: bool, draw: Callable[[], list[Any]]) -> None:
        if visible and kind not in self._extras:
            self._extras[kind] = draw()
        for each in self._extras.get(kind, ()):
            each.visible = visible

    def paint(self, color: Color) -> None:
        """Set the colour of all parts."""
        for solid in self._solids:
            solid.color = color

    def place(self, pose: Array) -> None:
        """Move the base to a pose (7,) in the frame of its parent node."""
        self.base.position = pose[:3]
        self.base.wxyz = wxyz(pose[3:])

    def set_joint_positions(self, q: Array) -> None:
        """Move the links to joint positions (n,), m or rad."""
        for frame, pose in zip(self._moving, self._kinematics.transforms_at(q), strict=True):
            frame.position = pose[:3]
            frame.wxyz = wxyz(pose[3:])


def draw_obstacles(
    scene: viser.SceneApi, path: str, world: RobotDescription | None
) -> list[viser.MeshHandle]:
    """Draw and return the obstacle geometry used to measure distances; None: none."""
    return [
        _draw_solid(scene, f"{path}/{number}", replace(visual, mesh=visual.mesh.moved(pose)))
        for number, (visual, pose) in enumerate(obstacle_visuals(world))
    ]


def _draw_solid(
    scene: viser.SceneApi, path: str, visual: Visual, color: Color | None = None
) -> viser.MeshHandle:
    """Draw a solid in the color of its shape, with shadows, or translucent in another color."""
    red, green, blue, alpha = visual.shape.rgba
    own = round(255 * red), round(255 * green), round(255 * blue)
    opacity = (alpha if alpha < 1.0 else None) if color is None else GHOST_OPACITY
    return scene.add_mesh_simple(
        path,
        visual.mesh.vertices,
        visual.mesh.faces.astype(np.uint32),
        color=color or own,
        opacity=opacity,
        flat_shading=True,
        cast_shadow=color is None,
        receive_shadow=color is None,
    )


def reach_of(robot: RobotDescription) -> float:
    """Return an upper bound on the distance, m, of all parts from the base origin."""
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

    Parameters
    ----------
    scene, path
        Scene to draw in, and node path.
    color
        Color of the line.
    """

    def __init__(self, scene: viser.SceneApi, path: str, color: Color) -> None:
        empty = np.zeros((1, 2, 3), np.float32)
        self._handle: Any = scene.add_line_segments(
            path, empty, color, thickness=_LINE_WIDTH, thickness_units="screen", visible=False
        )
        self._shown, self._empty = True, True

    def show(self, *, visible: bool) -> None:
        """Show or hide the line."""
        self._shown = visible
        self._handle.visible = visible and not self._empty

    def draw(self, points: Array) -> None:
        """Connect points (k, 3), m; fewer than two points clear the line."""
        self.draw_segments(np.stack([points[:-1], points[1:]], axis=1))

    def draw_segments(self, segments: Array) -> None:
        """Draw segments (k, 2, 3), m; an empty array clears the line."""
        self._empty = not len(segments)
        if not self._empty:
            self._handle.points = segments.astype(np.float32)
        self.show(visible=self._shown)


def plume_lines(table: ThrusterTable, names: tuple[str, ...], duty: Array, length: float) -> Array:
    """Return active thruster plumes as segments (k, 2, 3) in the base frame, m.

    Parameters
    ----------
    table
        The robot's thrusters.
    names, duty
        Thruster names, and the fraction of time each thruster is on, 0 to 1.
    length
        Plume length, m, at a duty cycle of 1.
    """
    segments = []
    for name, part in zip(names, duty, strict=True):
        if part > 0.0 and name in table.names:
            i = table.index(name)
            end = table.r_B[i] - (0.3 + 0.7 * min(float(part), 1.0)) * length * table.direction_B[i]
            segments.append([table.r_B[i], end])
    return np.array(segments, float).reshape(-1, 2, 3)


BACKDROPS = ("Space", "Grid")
"""The displayed surroundings of a robot."""


class Surroundings:
    """Sky or grid, paths and plumes.

    Parameters
    ----------
    scene
        Scene to draw in.
    reach
        Robot size, m; see :func:`reach_of`.
    robot_path
        Node path of the robot's base, to which the plumes are attached.
    center
        (3,) point above the grid, m.
    """

    def __init__(self, scene: viser.SceneApi, reach: float, robot_path: str, center: Array) -> None:
        cell = 10.0 ** np.floor(np.log10(reach)) / 2
        cells, sections = _GRID
        # Keep grid lines at round coordinates.
        x, y, _ = 10 * cell * np.round(center / (10 * cell))
        self._scene = scene
        self._grid = scene.add_grid(
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
        self._sky = self._add_sky(reach, center)
        self.world_axes = scene.add_frame(
            "/world", axes_length=0.25 * reach, axes_radius=0.006 * reach
        )
        self.plume_lines = Lines(scene, f"{robot_path}/plumes", _PLUME)
        self._paths: dict[tuple[str, str], Lines] = {}
        self._paths_shown = True

    def _add_sky(self, reach: float, center: Array) -> list[Any]:
        directions = np.random.default_rng(1957).normal(size=(_STARS, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        # Most stars are faint.
        brightness = 60 + 195 * np.random.default_rng(1961).uniform(size=_STARS) ** 3
        distance = _SKY * reach
        grey = np.repeat(brightness[:, np.newaxis], 3, axis=1).astype(np.uint8)

        def add_points(path: str, points: Array, color: Any, size: float) -> Any:
            at, radius = (distance * points).astype(np.float32), size * distance
            return self._scene.add_point_cloud(
                path, at, color, point_size=radius, point_shape="circle", position=center
            )

        stars = add_points("/stars", directions, grey, 0.002)
        sun = add_points("/sun", _SUN[np.newaxis], _SUN_COLOR, 0.08)
        x, y, z = _SUN.tolist()
        at = x, y, z
        light = self._scene.add_light_directional(
            "/sunlight", color=_SUN_COLOR, intensity=_SUN_INTENSITY, cast_shadow=True, position=at
        )
        # Light from the stars and other bodies: parts in shadow stay visible.
        fill = self._scene.add_light_ambient("/skylight", intensity=_SKY_INTENSITY)
        return [stars, sun, light, fill]

    def show_backdrop(self, setting: str) -> None:
        """Show the sky, lit only by the Sun, or the grid."""
        indoors = setting == "Grid"
        self._scene.configure_default_lights(enabled=indoors)
        self._scene.configure_environment_map("city" if indoors else None)
        # Space is dark on light pages too.
        self._scene.set_background_image(None if indoors else _SPACE)
        self._grid.visible = indoors
        for each in self._sky:
            each.visible = not indoors

    def show_paths(self, *, visible: bool) -> None:
        """Show or hide the planned and flown paths."""
        self._paths_shown = visible
        for each in self._paths.values():
            each.show(visible=visible)

    def draw_paths(self, kind: Literal["flown", "planned"], paths: Mapping[str, Array]) -> None:
        """Draw the paths (k, 3) of the base and end-effectors, m; other paths are cleared."""
        for name in [name for each, name in self._paths if each == kind and name not in paths]:
            self._paths[kind, name].draw(np.zeros((0, 3)))
        for name, points in paths.items():
            if (kind, name) not in self._paths:
                base, color = name == BASE_GOAL_KEY, _PLANNED
                if kind == "flown":
                    color = _FLOWN if base else _FLOWN_END_EFFECTOR
                end = "" if base else f"_of_end_effector{len(self._paths)}"
                self._paths[kind, name] = Lines(self._scene, f"/{kind}_path{end}", color)
                self._paths[kind, name].show(visible=self._paths_shown)
            self._paths[kind, name].draw(points)
