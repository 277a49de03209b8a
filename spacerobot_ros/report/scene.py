"""The 3D view of a flight: its scene, and the commands that MeshCat's viewer takes."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from importlib.metadata import distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.flight.flight import Signal
from spacerobot_ros.model.description import Array, JointKind, Pose, RobotDescription, Shape
from spacerobot_ros.model.kinematics import joints_outward
from spacerobot_ros.model.meshes import TriangleMesh
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
)
from spacerobot_ros.model.visuals import Visual, solid_mesh, visuals_of
from spacerobot_ros.report.figures import GHOST_COLOUR, LINE_COLOUR, PALETTE
from spacerobot_ros.report.flight import FlightReport
from spacerobot_ros.report.page_parts import PagePart, package_file
from spacerobot_ros.report.signals import Cycles, Indices, simplified
from spacerobot_ros.report.solids import EDGE_COLOUR, SolidRobot, body_color, obstacle_color

Command = dict[str, Any]


@dataclass(frozen=True)
class Scene:
    """Commands of the viewer, spans of time to choose from (name, start, end), and a caption."""

    commands: list[Command]
    parts: list[tuple[str, float, float]]
    caption: str


def viewer_script() -> str | None:
    """Return MeshCat's viewer; None where the package ``meshcat`` is not installed."""
    spec = find_spec("meshcat")
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        path = Path(folder) / "viewer" / "dist" / "main.min.js"
        if path.is_file():
            return path.read_text(encoding="utf-8")
    return None


def set_property(path: str, name: str, value: Any) -> Command:
    """Set a property of the object at a path, such as ``visible``."""
    return {"type": "set_property", "path": path, "property": name, "value": value}


def set_transform(path: str, matrix: Array) -> Command:
    """Set a matrix (4, 4), which is sent column by column."""
    flat = [round(float(x), 9) for x in matrix.T.ravel()]
    return {"type": "set_transform", "path": path, "matrix": flat}


def _set_object(path: str, geometry: Command, material: Command, kind: str) -> Command:
    names = {"geometry": f"{path} geometry", "material": f"{path} material"}
    unit = np.eye(4).ravel().tolist()
    return {
        "type": "set_object",
        "path": path,
        "object": {
            "metadata": {"version": 4.5, "type": "Object"},
            "geometries": [{"uuid": names["geometry"], **geometry}],
            "materials": [{"uuid": names["material"], **material}],
            "object": {"uuid": path, "type": kind, "matrix": unit, **names},
        },
    }


def line(path: str, points: Array, color: str) -> Command:
    """A line through points (k, 3)."""
    return _set_object(path, _point_geometry(points), _line_material(color, 1.0), "Line")


def segments(path: str, ends: Array, color: str, opacity: float = 1.0) -> Command:
    """Separate lines between points (2 k, 3)."""
    return _set_object(path, _point_geometry(ends), _line_material(color, opacity), "LineSegments")


def _point_geometry(points: Array) -> Command:
    numbers = {"type": "Float32Array", "array": _round_values(points)}
    position = {"itemSize": 3, "normalized": False, **numbers}
    return {"type": "BufferGeometry", "data": {"attributes": {"position": position}}}


def _line_material(color: str, opacity: float) -> Command:
    stroke = {"type": "LineBasicMaterial", "color": _color_number(color), "linewidth": 1}
    return stroke if opacity == 1.0 else stroke | {"transparent": True, "opacity": opacity}


def matrix_of(pose: Pose) -> Array:
    """Return a pose as a matrix (4, 4)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = pose.R, pose.r
    return matrix


def clip(path: str, time: Array, tracks: dict[str, Array]) -> Command:
    """Return how an object moves: ``position`` (N, 3), ``quaternion`` (N, 4) or both, at times."""
    kinds = {"position": "vector3", "quaternion": "quaternion"}
    made = []
    for name, values in tracks.items():
        if name == "quaternion":
            # The viewer interpolates the short way between quaternions of equal sign.
            flips = np.cumsum((values[1:] * values[:-1]).sum(axis=1) < 0) % 2
            values = values * np.append(1, 1 - 2 * flips)[:, np.newaxis]
        numbers = {"times": np.round(time, 4).tolist(), "values": _round_values(values)}
        made.append({"name": f".{name}", "type": kinds[name], **numbers})
    return {"path": path, "clip": {"fps": 1, "name": "flight", "tracks": made}}


def set_animation(clips: list[Command]) -> Command:
    """Return the command that loads an animation of several objects."""
    return {"type": "set_animation", "animations": clips, "options": {"play": True}}


def solid(path: str, visual: Visual, color: str, opacity: float = 1.0) -> list[Command]:
    """Return a visual and its sharp edges, if it has any."""
    shape = visual.shape
    matrix = matrix_of(shape.pose)
    if shape.kind == "cylinder":
        # Along y in three.js, along z in URDF.
        matrix = matrix @ np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    look = {"type": "MeshPhongMaterial", "color": _color_number(color), "shininess": 15}
    # Keep edges and ghosts visible in the surface of a solid.
    look |= {"polygonOffset": True, "polygonOffsetFactor": 1, "polygonOffsetUnits": 1}
    if opacity < 1.0:
        look |= {"transparent": True, "opacity": opacity, "depthWrite": False}
        look |= {"polygonOffsetFactor": -1, "polygonOffsetUnits": -1}
    if shape.kind in ("mesh", "capsule"):
        # Both sides are drawn, because files differ in which one is outside.
        look |= {"flatShading": True, "side": 2}
        return [_set_object(f"{path}/solid", _mesh_geometry(visual.mesh), look, "Mesh")]
    geometry = {"box": _box, "cylinder": _cylinder, "sphere": _sphere}[shape.kind](shape.size)
    commands = [
        _set_object(f"{path}/solid", geometry, look, "Mesh"),
        set_transform(f"{path}/solid", matrix),
    ]
    edges = visual.edges.lines
    if len(edges):
        tint = EDGE_COLOUR if opacity == 1.0 else color
        ends = edges.reshape(-1, 3)
        commands.append(segments(f"{path}/edges", ends, tint, 0.5 if opacity == 1.0 else 1.0))
    return commands


def _mesh_geometry(mesh: TriangleMesh) -> Command:
    kind = "Uint16Array" if len(mesh.vertices) < 1 << 16 else "Uint32Array"
    made = _point_geometry(mesh.vertices)
    made["data"]["index"] = {"type": kind, "array": mesh.faces.ravel().tolist()}
    return made


def _box(size: tuple[float, ...]) -> dict[str, Any]:
    width, height, depth = size
    return {"type": "BoxGeometry", "width": width, "height": height, "depth": depth}


def _cylinder(size: tuple[float, ...]) -> dict[str, Any]:
    radius, length = size
    ends = {"radiusTop": radius, "radiusBottom": radius}
    return {"type": "CylinderGeometry", "height": length, "radialSegments": 32, **ends}


def _sphere(size: tuple[float, ...]) -> dict[str, Any]:
    return {"type": "SphereGeometry", "radius": size[0], "widthSegments": 24, "heightSegments": 16}


def _round_values(values: Array) -> list[float]:
    return np.round(values.ravel(), 5).tolist()


def _color_number(color: str) -> int:
    return int(color[1:], 16)


NO_VIEWER = "The 3D view needs the Python package meshcat: pip install meshcat."

_MARKUP = """<section id="animation" class="loading">
<div id="stage"><div id="pane" role="img" aria-label="The robot in motion"></div></div>
<div id="bar"><button id="play" type="button">Play</button>
<input id="time" type="range" min="0" max="1" step="any" value="0" aria-label="Time">
<output id="now"></output>
<select id="part" aria-label="Span of time"></select>
<select id="speed" aria-label="Speed"></select></div>
<p class="missing">The 3D view needs WebGL, which this browser does not offer; the figures below \
do not.</p>
<noscript><p class="missing">The 3D view needs JavaScript; the figures below do not.</p>\
</noscript>
<p class="caption"><b>The flight.</b> {caption} Drag to turn the view, with the right button to \
move it; click it first to zoom with the wheel.</p>
</section>
"""


def player_of(scene: Scene | str) -> PagePart:
    """Return the player of a scene, or the reason why there is none."""
    viewer = viewer_script()
    if isinstance(scene, str) or viewer is None:
        sentence = scene if isinstance(scene, str) else NO_VIEWER
        return PagePart(f'<p class="missing">{escape(sentence)}</p>')
    parts = [{"name": name, "start": start, "end": end} for name, start, end in scene.parts]
    return PagePart(
        markup=_MARKUP.format(caption=escape(scene.caption)),
        data={"flight": {"parts": parts, "commands": scene.commands}},
        programs=(viewer, package_file("player.js")),
        notices=_licence_notices(),
    )


def _licence_notices() -> tuple[tuple[str, str], ...]:
    """Return the licences of MeshCat and of the libraries in its viewer, such as three.js."""
    own, others = "", []
    for file in distribution("meshcat").files or ():
        if file.name in ("LICENSE.txt", "LICENSE", "LICENCE"):
            own = file.read_text()
        elif file.name.endswith("THIRD_PARTY_LICENSES.json"):
            others += json.loads(file.read_text())
    # A library without the text of its licence has the MIT licence, as in MeshCat's own.
    mit = own[own.find("Permission is hereby granted") :]
    found = [("MeshCat", own)]
    for each in others:
        name, licence = f"{each.get('name', '')} {each.get('version', '')}", each.get("license", "")
        holder = f"Copyright (c) {each.get('author', '')}"
        words = f"{licence}\n\n{holder}\n\n{mit if licence == 'MIT' else ''}"
        found.append((name, each.get("licenseText") or words))
    return tuple(found)


FULL_CYCLES = 3
"""Cycles at the beginning and at the end of a gait that are shown in full."""

_MAX_KEY_FRAMES = 1000
_MAX_CYCLE_INSTANTS = 300
"""Instants of equal phase between the cycles that are shown in full."""


@dataclass(frozen=True)
class KeyFrames:
    """Recorded states to show, between which motion is interpolated.

    Attributes
    ----------
    indices
        Their indices, ascending, with the first and the last state of the recording.
    error
        Largest distance of an omitted state from the interpolation, in tolerances.
    every
        Between the cycles shown in full, one state is shown per so many cycles, always at the same
        phase; 0: all cycles are shown in full.
    """

    indices: Indices
    error: float
    every: int = 0


def key_frames(motion: Signal, cycles: Cycles | None) -> KeyFrames:
    """Choose at most a thousand key frames between which linear interpolation is good enough.

    Parameters
    ----------
    motion
        The visible motion, (N, k), each column divided by its tolerance.
    cycles
        Its equal cycles. All but the first and the last few are sampled at equal phase: otherwise
        fast loops would look like slow ones (aliasing).
    """
    shown, every = np.arange(len(motion)), 0
    if cycles is not None and cycles.count > 2 * FULL_CYCLES:
        start = cycles.start + FULL_CYCLES * cycles.period
        count = cycles.count - 2 * FULL_CYCLES
        end = start + count * cycles.period
        every = max(1, -(-count // _MAX_CYCLE_INSTANTS))
        instants = start + cycles.period * np.arange(0, count + 1, every)
        full = (motion.time <= start) | (motion.time >= end - 1e-9)
        places = np.searchsorted(motion.time, instants - 1e-9)
        shown = np.union1d(np.flatnonzero(full), np.minimum(places, len(motion) - 1))
    chosen, error = simplified(Signal(motion.time[shown], motion.values[shown]), _MAX_KEY_FRAMES)
    return KeyFrames(shown[chosen], error, every)


_POSITION_TOLERANCE = 0.001
"""Tolerance of positions between key frames, as a share of the size of the scene."""

_ANGLE_TOLERANCE = 0.005  # rad
_MAX_LINE_POINTS = 4000
_MAX_MESH_FACES = 20_000
"""Largest number of faces of all meshes together: some 0.6 MB."""

_BACKGROUND = [246 / 255, 247 / 255, 249 / 255]
_FIELD_OF_VIEW = 30.0
"""Field of view of the camera from top to bottom, deg."""

_MIN_ASPECT = 1.3
"""Width of the picture over its height, on narrow screens."""

_MARGIN = 1.06
"""Distance of the camera over the least from which the whole scene is seen."""

_AXIS_COLOURS = ("#d55e00", "#009e73", "#0072b2")
WORLD, ROBOT, TARGET = "/flight", "/flight/robot", "/flight/target"


def scene_of(flight: FlightReport) -> Scene | str:
    """Return the scene of a flight, or the reason why there is none."""
    drawn = flight.drawn
    if drawn is None:
        return flight.hidden_links_text
    points = _visible_points(flight, drawn)
    low, high = points.min(axis=0), points.max(axis=0)
    center, radius = (low + high) / 2, max(0.5 * float(np.linalg.norm(high - low)), 1e-3)
    frames = key_frames(_scaled_motion(flight, radius), flight.cycles)
    commands = _stage_commands(points, center, radius, flight.flat)
    commands += _robot_commands(drawn.robot, flight.meshes)
    commands += _obstacle_commands(flight)
    commands += _target_commands(flight)
    commands += _path_commands(flight)
    ghosts = _goal_commands(flight, drawn.robot, radius)
    commands += ghosts
    commands.append(_motion_command(flight, drawn, frames.indices, radius))
    return Scene(commands, _time_spans(flight), _caption_text(flight, frames, radius, bool(ghosts)))


def _visible_points(flight: FlightReport, drawn: SolidRobot) -> Array:
    """Return points (N, 3) of robot, paths, goals and target in W, m, which are to be seen."""
    clouds = [flight.position.values, flight.tool.values[:, :3]]
    for index in flight.samples(12):
        clouds.append(drawn.at(flight.joints[index], flight.base_at(index)).corner_points())
    targets = flight.targets if flight.position_counts else []
    clouds += [t.goal.position[np.newaxis] for t in (*targets, *flight.tool_targets)]
    clouds += [goal.position[np.newaxis] for goal in flight.link_goals.values()]
    clouds.append(flight.target_pose.values[:, :3])
    return np.concatenate(clouds)


def _scaled_motion(flight: FlightReport, radius: float) -> Signal:
    """Return the visible motion (N, k), in tolerances."""
    assert flight.robot is not None
    columns = [flight.position.values / (_POSITION_TOLERANCE * radius)]
    columns.append(flight.attitude.values / _ANGLE_TOLERANCE)
    slides = np.array([joint.kind.value == "prismatic" for joint in flight.robot.movable_joints])
    scale = np.where(slides, _POSITION_TOLERANCE * radius, _ANGLE_TOLERANCE)
    columns.append(flight.joints / scale)
    return Signal(flight.position.time, np.column_stack(columns))


def _camera_position(points: Array, flat: bool) -> Array:
    """Return the position (3,) from which the origin is looked at and all points (N, 3) are seen.

    It is the nearest one in the direction of the view, with a margin.
    """
    azimuth, elevation = math.radians(-90 if flat else -58), math.radians(89.9 if flat else 24)
    backwards = np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    up = np.cross(backwards, right)
    slope = math.tan(math.radians(_FIELD_OF_VIEW / 2))
    sideways = np.maximum(np.abs(points @ up), np.abs(points @ right) / _MIN_ASPECT) / slope
    return _MARGIN * float((points @ backwards + sideways).max()) * backwards


def _stage_commands(points: Array, center: Array, radius: float, flat: bool) -> list[Command]:
    """Background, camera, world axes and grid; the scene is moved and scaled to radius 1."""
    world = np.eye(4)
    world[:3, :3] /= radius
    world[:3, 3] = -center / radius
    x, y, z = _camera_position((points - center) / radius, flat).tolist()
    camera = "/Cameras/default/rotated/<object>"
    spacing = 10.0 ** math.floor(math.log10(radius))
    spacing *= 1.0 if radius / spacing > 4 else 0.5
    return [
        set_property("/Background", "top_color", _BACKGROUND),
        set_property("/Background", "bottom_color", _BACKGROUND),
        set_property("/Grid", "visible", False),
        set_property("/Axes", "visible", False),
        set_property(camera, "fov", _FIELD_OF_VIEW),
        # The camera's own y axis is up.
        set_property(camera, "position", [x, z, -y]),
        set_transform(WORLD, world),
        segments(f"{WORLD}/grid", _grid_commands(center, radius, spacing, flat), LINE_COLOUR, 0.6),
        *[
            segments(f"{WORLD}/world/{name}", np.array([[0.0] * 3, 0.25 * radius * unit]), tint)
            for name, unit, tint in zip("xyz", np.eye(3), _AXIS_COLOURS, strict=True)
        ],
    ]


def _grid_commands(center: Array, radius: float, spacing: float, flat: bool) -> Array:
    """Ends (2 k, 3) of lines parallel to x and y, on whole multiples of ``spacing``."""
    z = center[2] - (0.0 if flat else 0.8 * radius)
    first = np.floor((center[:2] - 1.3 * radius) / spacing)
    last = np.ceil((center[:2] + 1.3 * radius) / spacing)
    (x0, y0), (x1, y1) = first * spacing, last * spacing
    lines = [[(x, y0, z), (x, y1, z)] for x in spacing * np.arange(first[0], last[0] + 1)]
    lines += [[(x0, y, z), (x1, y, z)] for y in spacing * np.arange(first[1], last[1] + 1)]
    return np.array(lines).reshape(-1, 3)


def _link_paths(robot: RobotDescription) -> dict[str, str]:
    """Return the path of every link in the viewer's tree, which is the tree of the URDF."""
    paths = {robot.base_link: ROBOT}
    for joint in joints_outward(robot):
        paths[joint.child] = f"{paths[joint.parent]}/link {_node_name(joint.child)}"
    return paths


def _node_name(link: str) -> str:
    """Return the name of a link without slashes, which separate nodes of the viewer's tree."""
    return link.replace("/", "\N{DIVISION SLASH}")


def _robot_commands(robot: RobotDescription, meshes: Mapping[str, TriangleMesh]) -> list[Command]:
    commands: list[Command] = []
    paths = _link_paths(robot)
    visuals = visuals_of(robot, meshes, _faces_per_mesh(meshes))
    for joint in robot.joints:
        commands.append(set_transform(paths[joint.child], matrix_of(joint.origin)))
    for number, visual in enumerate(visuals):
        path = f"{paths[visual.link]}/visual {number}"
        commands += solid(path, visual, body_color(visual.body))
    return commands


def _obstacle_commands(flight: FlightReport) -> list[Command]:
    commands: list[Command] = []
    for number, (visual, pose) in enumerate(flight.obstacles):
        path = f"{WORLD}/obstacle {number} {_node_name(visual.link)}"
        commands.append(set_transform(path, matrix_of(pose)))
        commands += solid(path, visual, obstacle_color(visual))
    return commands


def _target_commands(flight: FlightReport) -> list[Command]:
    if flight.target is None or not len(flight.target_pose):
        return []
    commands = [set_transform(TARGET, matrix_of(_pose_of(flight.target_pose.values[0])))]
    for number, visual in enumerate(visuals_of(flight.target, {}, _MAX_MESH_FACES)):
        path = f"{TARGET}/{number} {_node_name(visual.link)}"
        commands.append(set_transform(path, matrix_of(flight.target.frames[visual.link][1])))
        commands += solid(path, visual, obstacle_color(visual))
    return commands


def _pose_of(values: Array) -> Pose:
    return Pose(matrix_from_quaternion(values[3:]), values[:3])


def _faces_per_mesh(meshes: Mapping[str, TriangleMesh]) -> int:
    """Return the largest number of faces of a mesh, so that the page stays small."""
    return _MAX_MESH_FACES // max(len(meshes), 1)


def _motion_command(
    flight: FlightReport, drawn: SolidRobot, indices: Indices, radius: float
) -> Command:
    """The animation: position and quaternion of the base, of every link that a joint moves, and of
    the target.
    """
    time, paths = flight.position.time[indices], _link_paths(drawn.robot)
    base = {"position": flight.position.values[indices], "quaternion": flight.quaternion[indices]}
    clips = [clip(ROBOT, time, base)]
    transforms = drawn.kinematics.transforms_at(flight.joints[indices])
    places = {child: i for i, (_, child) in enumerate(drawn.kinematics.moving)}
    for joint in drawn.robot.moving_joints:
        poses = transforms[:, places[joint.child]]
        slides = joint.kind is JointKind.PRISMATIC
        moved = {"position": poses[:, :3]} if slides else {"quaternion": poses[:, 3:]}
        clips.append(clip(paths[joint.child], time, moved))
    target = flight.target_pose
    if len(target):
        shown, _ = simplified(_scaled_by_tolerances(target, radius), _MAX_KEY_FRAMES)
        moved = {"position": target.values[shown, :3], "quaternion": target.values[shown, 3:]}
        clips.append(clip(TARGET, target.time[shown], moved))
    return set_animation(clips)


def _scaled_by_tolerances(pose: Signal, radius: float) -> Signal:
    """Return a pose (N, 7) over time in tolerances; a quaternion's numbers change by half as much
    as the angle.
    """
    tolerances = np.repeat([_POSITION_TOLERANCE * radius, _ANGLE_TOLERANCE / 2], [3, 4])
    return Signal(pose.time, pose.values / tolerances)


def _path_commands(flight: FlightReport) -> list[Command]:
    lines = [("path of the base", flight.position.values, PALETTE[0])]
    if len(flight.tool):
        lines.append(("path of the end-effector", flight.tool.values[:, :3], PALETTE[4]))
    assert flight.robot is not None
    tool = flight.robot.end_effector(flight.parameter("plant", "end_effector_frame") or "")
    for link, positions in flight.link_positions.items():
        if link != tool or not len(flight.tool):
            lines.append((f"path of {_node_name(link)}", positions, PALETTE[4]))
    commands = []
    for name, points, tint in lines:
        step = max(1, len(points) // _MAX_LINE_POINTS)
        shown = np.concatenate([points[:-1:step], points[-1:]])
        if len(shown) > 1 and float(np.ptp(shown, axis=0).max()) > 0.0:
            commands.append(line(f"{WORLD}/{name}", shown, tint))
    return commands


def _goal_commands(flight: FlightReport, robot: RobotDescription, radius: float) -> list[Command]:
    commands: list[Command] = []
    if flight.base_goal is not None and flight.controls("base"):
        matrix = matrix_of(
            Pose(matrix_from_quaternion(flight.base_goal.quaternion), _ghost_position(flight))
        )
        commands.append(set_transform(f"{WORLD}/goal", matrix))
        visuals = visuals_of(robot, flight.meshes, _faces_per_mesh(flight.meshes) // 4)
        for number, visual in enumerate(visuals):
            if visual.body == 0:
                path = f"{WORLD}/goal/{visual.link.replace('/', '_')} {number}"
                commands.append(set_transform(path, matrix_of(robot.frames[visual.link][1])))
                commands += solid(path, visual, GHOST_COLOUR, 0.25)
    marks: list[tuple[str, Array, Array | None]] = []
    for target in flight.tool_targets[-1:]:
        turned = bool(set(flight.controls("end_effector")) & {3, 4, 5})
        quaternion = target.goal.quaternion if turned else None
        marks.append(("end-effector goal", target.goal.position, quaternion))
    for link, goal in flight.link_goals.items():
        marks.append((f"goal of {_node_name(link)}", goal.position, goal.quaternion))
    for mark, position, quaternion in marks:
        R = np.eye(3) if quaternion is None else matrix_from_quaternion(quaternion)
        path = f"{WORLD}/{mark}"
        commands.append(set_transform(path, matrix_of(Pose(R, position))))
        ball = Shape("sphere", (0.03 * radius,), Pose())
        commands += solid(f"{path}/mark", Visual("", 0, ball, solid_mesh(ball)), GHOST_COLOUR, 0.4)
        if quaternion is not None:
            for name, unit, tint in zip("xyz", np.eye(3), _AXIS_COLOURS, strict=True):
                ends = np.array([np.zeros(3), 0.12 * radius * unit])
                commands.append(segments(f"{path}/{name}", ends, tint))
    return commands


def _ghost_position(flight: FlightReport) -> Array:
    """Return the position of the ghost: the goal, or the last one if only attitude is a goal."""
    assert flight.base_goal is not None
    return flight.base_goal.position if flight.position_counts else flight.position.values[-1]


def _time_spans(flight: FlightReport) -> list[tuple[str, float, float]]:
    end = float(flight.position.time[-1])
    parts = [("whole flight", 0.0, end)]
    cycles = flight.cycles
    if cycles is not None and cycles.count > 2 * FULL_CYCLES:
        if cycles.start > 0.0:
            parts.append((f"first {cycles.start:.4g} s", 0.0, cycles.start))
        full = FULL_CYCLES * cycles.period
        parts.append((f"first {FULL_CYCLES} cycles", cycles.start, cycles.start + full))
        parts.append((f"last {FULL_CYCLES} cycles", cycles.end - full, cycles.end))
    return parts


def _caption_text(flight: FlightReport, frames: KeyFrames, radius: float, ghosts: bool) -> str:
    text = (
        "The robot from the shapes of its URDF, each moving link in the color of its joint in the "
        "figures below; lines are the paths of the base (blue)"
    )
    several = len(flight.link_positions) > 1
    if several:
        text += " and of the end-effectors (orange)"
    elif len(flight.tool) or flight.link_positions:
        text += " and of the end-effector (orange)"
    text += "; the ghost is the goal" if ghosts else ""
    text += "; obstacles have the shapes by which distances are measured" * bool(flight.obstacles)
    text += "; the target moves as target/odom says" * (flight.target is not None)
    if len(flight.position) < 2:
        return f"{text}.{flight.missing_meshes}"
    text += (
        f". {len(frames.indices)} key frames of {len(flight.position)} recorded states; in between "
        "the motion is interpolated"
    )
    within = max(frames.error, 1.0)
    text += (
        f" and within {within * _POSITION_TOLERANCE * radius:.2g} m and "
        f"{within * _ANGLE_TOLERANCE:.2g} rad of the recorded states."
    )
    if frames.every:
        which = "every cycle" if frames.every == 1 else f"every {frames.every}th cycle"
        text += (
            f" The first and the last {FULL_CYCLES} cycles are shown in full; of those "
            f"between, one instant of {which}, always at the same phase, so that fast loops do not "
            "look like slow ones."
        )
    return text + flight.missing_meshes
