"""The 3D view on the page of a flight: the scene as commands for the MeshCat viewer."""

from __future__ import annotations

import heapq
import itertools
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape
from importlib.metadata import distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.errors import quantity
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.model.description import Array, Pose, Shape
from spacerobot_ros.model.meshes import Visual, solid_mesh
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.report.figures import (
    BASE_COLOUR,
    GHOST_COLOUR,
    HAND_COLOUR,
    LINE_COLOUR,
    PLANNED_COLOUR,
)
from spacerobot_ros.report.flight import Cycles, FlightReport
from spacerobot_ros.report.page_parts import PagePart, missing, package_file
from spacerobot_ros.report.scene import (
    EDGE_COLOUR,
    Body,
    View,
    bodies_of,
    corner_points,
    goal_of_base,
    is_flat,
    obstacles_of,
    placed_solids,
)

Command = dict[str, Any]


@dataclass(frozen=True)
class View3D:
    """Viewer commands, selectable time spans (name, start, end), and a caption."""

    commands: list[Command]
    parts: list[tuple[str, float, float]]
    caption: str


def viewer_script() -> str | None:
    """Return MeshCat's viewer; None if the package ``meshcat`` is not installed."""
    spec = find_spec("meshcat")
    for folder in (spec.submodule_search_locations or ()) if spec is not None else ():
        path = Path(folder) / "viewer" / "dist" / "main.min.js"
        if path.is_file():
            return path.read_text(encoding="utf-8")
    return None


NO_VIEWER = "The 3D view needs the Python package meshcat: pip install meshcat."

_MARKUP = """<section id="animation" class="loading">
<div id="stage"><div id="pane" role="img" aria-label="The robot in motion"></div></div>
<div id="bar"><button id="play" type="button">Play</button>
<input id="time" type="range" min="0" max="1" step="any" value="0" aria-label="Time">
<output id="now"></output>
<select id="part" aria-label="Span of time"></select>
<select id="speed" aria-label="Speed"></select></div>
<p class="missing">The 3D view needs WebGL, which this browser does not provide; the figures \
below work without it.</p>
<noscript><p class="missing">The 3D view needs JavaScript; the figures below work without \
it.</p>\
</noscript>
<p class="caption"><b>The flight.</b> {caption} Drag to rotate the view, with the right button to \
move it; click it first to zoom with the wheel.</p>
</section>
"""


def player_of(scene: View3D | str) -> PagePart:
    """Return a scene player, or the reason why there is none."""
    viewer = viewer_script()
    if isinstance(scene, str) or viewer is None:
        return PagePart(missing(scene if isinstance(scene, str) else NO_VIEWER))
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
    # A library without a licence text has the MIT licence, whose text is in MeshCat's licence.
    mit = own[own.find("Permission is hereby granted") :]
    found = [("MeshCat", own)]
    for each in others:
        name, licence = f"{each.get('name', '')} {each.get('version', '')}", each.get("license", "")
        holder = f"Copyright (c) {each.get('author', '')}"
        words = f"{licence}\n\n{holder}\n\n{mit if licence == 'MIT' else ''}"
        found.append((name, each.get("licenseText") or words))
    return tuple(found)


# -- key frames ---------------------------------------------------------------------------------

FULL_CYCLES = 3
"""Number of cycles shown in full at the start and at the end of a gait."""

_MAX_KEY_FRAMES = 1000
_MAX_CYCLE_INSTANTS = 300
"""Largest number of equal-phase instants between the cycles shown in full."""

_INITIAL_STRETCHES = 64
"""Number of parts into which a recording is split before simplification, to limit the computing
time."""


class KeyFrames(NamedTuple):
    """Recorded states to show; the motion between these states is interpolated.

    Attributes
    ----------
    indices
        State indices, ascending, including the first and last recorded state.
    error
        Largest deviation of an omitted state from the interpolation, in tolerances.
    every
        Number of cycles per shown state between the cycles shown in full, always at the same phase;
        0 if all cycles are shown in full.
    """

    indices: NDArray[np.int64]
    error: float
    every: int = 0


def key_frames(motion: Signal, cycles: Cycles | None) -> KeyFrames:
    """Choose at most a thousand key frames such that linear interpolation is accurate enough.

    Parameters
    ----------
    motion
        The visible motion (N, k), with each column divided by its tolerance.
    cycles
        Its equal cycles. All but the first and last few cycles are sampled at the same phase:
        otherwise fast loops would look like slow loops (aliasing).
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


def simplified(motion: Signal, most: int) -> tuple[NDArray[np.int64], float]:
    """Drop samples that lie on lines between other samples (Douglas-Peucker); the samples farthest
    from such lines are kept first.

    Parameters
    ----------
    motion
        The motion, with each column divided by its tolerance.
    most
        Largest number of samples to keep, in addition to a few dozen that are always kept.

    Returns
    -------
    The kept samples, and the largest distance of a dropped sample, in tolerances.
    """
    bounds = np.unique(np.linspace(0, len(motion) - 1, _INITIAL_STRETCHES + 1).astype(int)).tolist()
    if len(bounds) < 2:
        return np.array(bounds, np.int64), 0.0
    kept = set(bounds)
    heap = [_farthest_sample(motion, a, b) for a, b in itertools.pairwise(bounds)]
    heapq.heapify(heap)
    while -heap[0][0] > 1.0 and len(kept) < most:
        _, a, b, k = heapq.heappop(heap)
        kept.add(k)
        heapq.heappush(heap, _farthest_sample(motion, a, k))
        heapq.heappush(heap, _farthest_sample(motion, k, b))
    return np.array(sorted(kept), np.int64), -heap[0][0]


def _farthest_sample(motion: Signal, a: int, b: int) -> tuple[float, int, int, int]:
    """The negative largest distance from the line between samples a and b, a, b, and its sample."""
    if b - a < 2:
        return 0.0, a, b, a
    time, values = motion.time[a : b + 1], motion.values[a : b + 1]
    span = float(time[-1] - time[0])  # Negative if a plant was restarted.
    share: Array = ((time - time[0]) / (span if abs(span) > 1e-12 else np.inf))[:, np.newaxis]
    off = np.abs(values - values[0] - share * (values[-1] - values[0])).max(axis=1, initial=0.0)
    k = 1 + int(np.argmax(off[1:-1]))
    return -float(off[k]), a, b, a + k


# -- commands -----------------------------------------------------------------------------------


def _set_property(path: str, name: str, value: Any) -> Command:
    """Set a property of the object at a path, such as ``visible``."""
    return {"type": "set_property", "path": path, "property": name, "value": value}


def _place(path: str, r: Array, A: Array) -> Command:
    """Move and turn (or scale) the object at a path by an offset (3,) and a matrix (3, 3)."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = A, r
    # The matrix is sent column by column.
    flat = [round(float(x), 9) for x in matrix.T.ravel()]
    return {"type": "set_transform", "path": path, "matrix": flat}


def _set_object(path: str, points: Array, material: Command, kind: str, index: Any = ()) -> Command:
    """Set the object at a path: points (k, 3) and their connections."""
    names = {"geometry": f"{path} geometry", "material": f"{path} material"}
    position = {"itemSize": 3, "normalized": False, "type": "Float32Array"}
    data: Command = {"attributes": {"position": position | {"array": _rounded(points)}}}
    if len(index):
        data["index"] = {"type": "Uint32Array", "array": np.ravel(index).tolist()}
    return {
        "type": "set_object",
        "path": path,
        "object": {
            "metadata": {"version": 4.5, "type": "Object"},
            "geometries": [{"uuid": names["geometry"], "type": "BufferGeometry", "data": data}],
            "materials": [{"uuid": names["material"], **material}],
            "object": {"uuid": path, "type": kind, "matrix": np.eye(4).ravel().tolist(), **names},
        },
    }


def _lines(path: str, points: Array, color: str, opacity: float = 1.0) -> Command:
    """Draw a line through points (k, 3), or separate segments with ends (k, 2, 3)."""
    look = {"type": "LineBasicMaterial", "color": int(color[1:], 16), **_see_through(opacity)}
    kind = "Line" if points.ndim == 2 else "LineSegments"
    return _set_object(path, points.reshape(-1, 3), look, kind)


def _triad(path: str, length: float) -> list[Command]:
    """Draw the axes of a frame."""
    return [
        _lines(f"{path}/{name}", np.array([[0.0] * 3, length * unit]), tint)
        for name, unit, tint in zip("xyz", np.eye(3), _AXIS_COLOURS, strict=True)
    ]


def _solid(path: str, visual: Visual, color: str, opacity: float = 1.0) -> list[Command]:
    """Draw a solid and its sharp edges, if it has any."""
    ghost = opacity < 1.0
    # Keep edges and ghosts visible on the surface of a solid.
    offset = {"polygonOffset": True, "polygonOffsetFactor": -1 if ghost else 1}
    look = {"type": "MeshPhongMaterial", "color": int(color[1:], 16), "shininess": 15}
    # Both sides are drawn, because mesh files differ in which side is the outside.
    look |= {"flatShading": True, "side": 2, **offset, "polygonOffsetUnits": -1 if ghost else 1}
    look |= _see_through(opacity) | ({"depthWrite": False} if ghost else {})
    mesh, edges = visual.mesh, visual.edges.lines
    commands = [_set_object(f"{path}/solid", mesh.vertices, look, "Mesh", mesh.faces)]
    if len(edges) and visual.shape.kind not in ("mesh", "capsule"):
        tint = color if ghost else EDGE_COLOUR
        commands.append(_lines(f"{path}/edges", edges, tint, 1.0 if ghost else 0.5))
    return commands


def _see_through(opacity: float) -> Command:
    return {} if opacity == 1.0 else {"transparent": True, "opacity": opacity}


def _clip(path: str, time: Array, poses: Array) -> Command:
    """Return the motion of an object through poses (k, 7) at times (k,)."""
    times = np.round(time, 4).tolist()
    parts = ((".position", "vector3", poses[:, :3]), (".quaternion", "quaternion", poses[:, 3:]))
    tracks = [
        {"name": name, "type": kind, "times": times, "values": _rounded(values)}
        for name, kind, values in parts
    ]
    return {"path": path, "clip": {"fps": 1, "name": "flight", "tracks": tracks}}


def _rounded(values: Array) -> list[float]:
    return np.round(values.ravel(), 5).tolist()


# -- the view of a flight -----------------------------------------------------------------------

_POSITION_TOLERANCE = 0.001
"""Position tolerance between key frames, as a fraction of the scene size."""

_ANGLE_TOLERANCE = 0.005  # rad
_MAX_LINE_POINTS = 4000
_MAX_MESH_FACES = 20_000
"""Largest total number of mesh faces: about 0.6 MB."""

_BACKGROUND = [246 / 255, 247 / 255, 249 / 255]
_FIELD_OF_VIEW = 30.0
"""Vertical field of view of the camera, deg."""

_MIN_ASPECT = 1.3
"""Aspect ratio (width to height) of the picture on narrow screens."""

_MARGIN = 1.06
"""Camera distance relative to the smallest distance at which the whole scene is visible."""

_AXIS_COLOURS = ("#d55e00", "#009e73", "#0072b2")
WORLD = "/flight"


def view_of_flight(flight: FlightReport) -> View3D | str:
    """Return a flight's 3D view, or the reason why there is none."""
    if flight.hidden_links_text:
        return flight.hidden_links_text
    most = _MAX_MESH_FACES // max(len(flight.meshes), 1)
    points, flat = _visible_points(flight), is_flat(flight)
    low, high = points.min(axis=0), points.max(axis=0)
    center, radius = (low + high) / 2, max(0.5 * float(np.linalg.norm(high - low)), 1e-3)
    moving = bodies_of(flight, range(len(flight.time)), most)
    ghosts = _goal_commands(flight, most, radius)
    # A quaternion's numbers change by half as much as the angle.
    tolerances = np.repeat([_POSITION_TOLERANCE * radius, _ANGLE_TOLERANCE / 2], [3, 4])
    motion = Signal(flight.time, np.hstack([each.poses / tolerances for each in moving]))
    frames = key_frames(motion, flight.cycles)
    rows = frames.indices
    clips = [_clip(_path_of(each), flight.time[rows], each.poses[rows]) for each in moving]
    commands = [
        *_stage_commands(points, center, radius, flat),
        *_body_commands([*moving, *obstacles_of(flight)]),
        *_path_commands(flight),
        *ghosts,
        {"type": "set_animation", "animations": clips, "options": {"play": True}},
    ]
    caption = _caption_text(flight, frames, radius, bool(ghosts))
    return View3D(commands, _time_spans(flight), caption)


def _path_of(body: Body) -> str:
    # Slashes separate nodes of the viewer's tree.
    return f"{WORLD}/{body.name.replace('/', chr(0x2215))}"


def _body_commands(bodies: Iterable[Body], opacity: float = 1.0) -> list[Command]:
    commands: list[Command] = []
    for body in bodies:
        path = _path_of(body)
        pose = body.poses[0]
        commands.append(_place(path, pose[:3], matrix_from_quaternion(pose[3:])))
        for number, visual in enumerate(body.visuals):
            commands += _solid(f"{path}/{number}", visual, body.color_of(visual), opacity)
    return commands


def _visible_points(flight: FlightReport) -> Array:
    """Return the points (N, 3) of robot, paths, goals and target in W, m, that must be visible."""
    clouds = [flight.pose[:, :3], flight.tool.values[:, :3], flight.target_pose.values[:, :3]]
    rows = flight.samples(12)
    bodies = bodies_of(flight, rows, _MAX_MESH_FACES)
    clouds += [corner_points(placed_solids(bodies, instant)) for instant in range(len(rows))]
    targets = flight.targets if flight.position_counts else []
    goals = [each.goal.position for each in (*targets, *flight.tool_targets)]
    goals += [each.position for each in flight.link_goals.values()]
    clouds.append(np.array(goals).reshape(-1, 3))
    return np.concatenate(clouds)


def _camera_position(points: Array, flat: bool) -> Array:
    """Return the camera position (3,) at which all points (N, 3) are visible.

    The camera looks at the origin from the nearest such position in the viewing direction, with a
    margin.
    """
    # The up vector must not be parallel to the viewing direction.
    view = View(-90.0, 89.9) if flat else View()
    backwards, (right, up) = view.viewing_direction, view.paper_axes
    slope = math.tan(math.radians(_FIELD_OF_VIEW / 2))
    sideways = np.maximum(np.abs(points @ up), np.abs(points @ right) / _MIN_ASPECT) / slope
    return _MARGIN * float((points @ backwards + sideways).max()) * backwards


def _stage_commands(points: Array, center: Array, radius: float, flat: bool) -> list[Command]:
    """Background, camera, world axes and grid; the scene is moved and scaled to radius 1."""
    x, y, z = _camera_position((points - center) / radius, flat).tolist()
    camera = "/Cameras/default/rotated/<object>"
    spacing = 10.0 ** math.floor(math.log10(radius))
    spacing *= 1.0 if radius / spacing > 4 else 0.5
    return [
        _set_property("/Background", "top_color", _BACKGROUND),
        _set_property("/Background", "bottom_color", _BACKGROUND),
        _set_property("/Grid", "visible", False),
        _set_property("/Axes", "visible", False),
        _set_property(camera, "fov", _FIELD_OF_VIEW),
        # The camera's own y axis is up.
        _set_property(camera, "position", [x, z, -y]),
        _place(WORLD, -center / radius, np.eye(3) / radius),
        _lines(f"{WORLD}/grid", _grid_lines(center, radius, spacing, flat), LINE_COLOUR, 0.6),
        *_triad(f"{WORLD}/world", 0.25 * radius),
    ]


def _grid_lines(center: Array, radius: float, spacing: float, flat: bool) -> Array:
    """Ends (k, 2, 3) of lines parallel to x and y, on whole multiples of ``spacing``."""
    z = center[2] - (0.0 if flat else 0.8 * radius)
    first = np.floor((center[:2] - 1.3 * radius) / spacing)
    last = np.ceil((center[:2] + 1.3 * radius) / spacing)
    (x0, y0), (x1, y1) = first * spacing, last * spacing
    lines = [[(x, y0, z), (x, y1, z)] for x in spacing * np.arange(first[0], last[0] + 1)]
    lines += [[(x0, y, z), (x1, y, z)] for y in spacing * np.arange(first[1], last[1] + 1)]
    return np.array(lines)


def _path_commands(flight: FlightReport) -> list[Command]:
    def flown(name: str, poses: Signal, tint: str) -> list[tuple[str, Array, str]]:
        parts = np.split(poses.values[:, :3], poses.rows_after(flight.resets))
        return [(f"{name} {k}" if k else name, part, tint) for k, part in enumerate(parts)]

    lines = flown("path of the base", Signal(flight.time, flight.pose), BASE_COLOUR)
    lines += [(f"plan {k}", path, PLANNED_COLOUR) for k, path in enumerate(flight.planned)]
    if len(flight.tool):
        lines += flown("path of the end-effector", flight.tool, HAND_COLOUR)
    assert flight.robot is not None
    tool = flight.robot.end_effector(flight.parameter("plant", "end_effector_frame") or "")
    for link, poses in flight.link_poses.items():
        if link != tool or not len(flight.tool):
            lines += flown(f"path of {link}", poses, HAND_COLOUR)
    commands = []
    for name, points, tint in lines:
        step = max(1, len(points) // _MAX_LINE_POINTS)
        shown = np.concatenate([points[:-1:step], points[-1:]])
        if len(shown) > 1 and float(np.ptp(shown, axis=0).max()) > 0.0:
            commands.append(_lines(f"{WORLD}/{name.replace('/', ' ')}", shown, tint))
    return commands


def _goal_commands(flight: FlightReport, most: int, radius: float) -> list[Command]:
    """Draw the base at its goal as a ghost, and marks at the goals of end-effectors."""
    ghost = goal_of_base(flight, most // 4)
    commands = [] if ghost is None else _body_commands([ghost], 0.25)
    marks: list[tuple[str, Array, Array | None]] = []
    for target in flight.tool_targets[-1:]:
        turned = bool(set(flight.controls("end_effector")) & {3, 4, 5})
        quaternion = target.goal.quaternion if turned else None
        marks.append(("end-effector goal", target.goal.position, quaternion))
    for link, goal in flight.link_goals.items():
        marks.append((f"goal of {link}".replace("/", " "), goal.position, goal.quaternion))
    ball = Shape("sphere", (0.03 * radius,), Pose())
    for mark, position, quaternion in marks:
        path = f"{WORLD}/{mark}"
        R = np.eye(3) if quaternion is None else matrix_from_quaternion(quaternion)
        commands.append(_place(path, position, R))
        commands += _solid(f"{path}/mark", Visual("", 0, ball, solid_mesh(ball)), GHOST_COLOUR, 0.4)
        commands += [] if quaternion is None else _triad(path, 0.12 * radius)
    return commands


def _time_spans(flight: FlightReport) -> list[tuple[str, float, float]]:
    end = float(flight.time[-1])
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
        "The robot is drawn with its URDF geometry; each moving link has the color of its joint "
        "in the figures below; lines are the paths of the base (blue)"
    )
    several = len(flight.link_poses) > 1
    if several:
        text += " and of the end-effectors (pink)"
    elif len(flight.tool) or flight.link_poses:
        text += " and of the end-effector (pink)"
    text += " and the plans (orange)" * bool(flight.planned)
    text += "; the green ghost is the goal" if ghosts else ""
    text += "; obstacles have the geometry used to measure distances" * bool(flight.obstacles)
    text += "; the target moves according to target/odom" * (flight.target is not None)
    if len(flight.time) < 2:
        return f"{text}.{flight.missing_meshes}"
    text += (
        f". {len(frames.indices)} key frames from {len(flight.time)} recorded states; motion "
        "in between is interpolated"
    )
    within = max(frames.error, 1.0)
    text += (
        f" and within {quantity(within * _POSITION_TOLERANCE * radius, 'm')} and "
        f"{quantity(within * _ANGLE_TOLERANCE, 'rad')} of the recorded states."
    )
    if frames.every:
        which = "every cycle" if frames.every == 1 else f"every {frames.every}th cycle"
        text += (
            f" The first and the last {FULL_CYCLES} cycles are shown in full; between them, one "
            f"instant of {which} is shown, always at the same phase, so that fast loops do not "
            "look like slow ones."
        )
    return text + flight.missing_meshes
