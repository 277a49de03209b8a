"""A flight as a scene for MeshCat's viewer: the robot in motion, goals, paths and world axes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.model.description import Array, JointKind, Pose, RobotDescription, Shape
from spacerobot_ros.model.meshes import TriangleMesh
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_multiply,
)
from spacerobot_ros.model.visuals import Visual, solid_mesh, visuals_of
from spacerobot_ros.report.flight import Flight, Target
from spacerobot_ros.report.meshcat import (
    Command,
    Scene,
    clip,
    line,
    matrix_of,
    segments,
    set_animation,
    set_property,
    set_transform,
    solid,
)
from spacerobot_ros.report.signals import Cycles, Indices, Signal, simplified
from spacerobot_ros.report.solids import SolidRobot, body_color
from spacerobot_ros.report.style import FAINT, GHOST, PALETTE

FULL_CYCLES = 3
"""Cycles at the beginning and at the end of a gait that are shown as they were."""

_MOST = 1000
_MOST_INSTANTS = 300
"""Instants of equal phase between the cycles that are shown in full."""


@dataclass(frozen=True)
class KeyFrames:
    """States to show: their ``indices``, ascending, with the first and the last of the recording.

    ``error``: how far, in tolerances, a state that is meant to be seen is from the line between
    the key frames around it. ``every``: between the cycles shown in full, one state is shown every
    so many cycles, always at the same phase; 0 where there are no such.
    """

    indices: Indices
    error: float
    every: int = 0


def key_frames(motion: Signal, cycles: Cycles | None) -> KeyFrames:
    """Choose at most a thousand key frames between which linear interpolation is good enough.

    Parameters
    ----------
    motion
        What is to be seen, (N, k), each column divided by its tolerance.
    cycles
        The equal cycles in it. Between the first and the last few of them, states of equal phase
        stand for the rest: sampled anyhow, fast loops would look like slow ones.
    """
    shown, every = np.arange(len(motion)), 0
    if cycles is not None and cycles.count > 2 * FULL_CYCLES:
        start = cycles.start + FULL_CYCLES * cycles.period
        count = cycles.count - 2 * FULL_CYCLES
        end = start + count * cycles.period
        every = max(1, -(-count // _MOST_INSTANTS))
        instants = start + cycles.period * np.arange(0, count + 1, every)
        full = (motion.time <= start) | (motion.time >= end - 1e-9)
        places = np.searchsorted(motion.time, instants - 1e-9)
        shown = np.union1d(np.flatnonzero(full), np.minimum(places, len(motion) - 1))
    chosen, error = simplified(Signal(motion.time[shown], motion.values[shown]), _MOST)
    return KeyFrames(shown[chosen], error, every)


_POSITION_TOLERANCE = 0.001
"""Of what is drawn between key frames, as a part of the size of the picture."""

_ANGLE_TOLERANCE = 0.005
"""Likewise, rad."""

_LINE_POINTS = 4000
_MOST_FACES = 20_000
"""Of all meshes together: some 0.6 MB."""

_BACKGROUND = [246 / 255, 247 / 255, 249 / 255]
_FIELD_OF_VIEW = 30.0
"""Degrees."""

_AXES = ("#d55e00", "#009e73", "#0072b2")
WORLD, ROBOT = "/flight", "/flight/robot"


def scene_of(flight: Flight) -> Scene | str:
    """Return the scene of a flight, or one sentence on why there is none."""
    drawn = flight.drawn
    if drawn is None:
        return flight.not_drawn
    center, radius = _extent(flight, drawn)
    frames = key_frames(_visible(flight, radius), flight.cycles)
    commands = _stage(center, radius, flight.flat)
    commands += _robot(drawn.robot, flight.meshes)
    commands += _lines(flight)
    ghosts = _ghosts(flight, drawn.robot, radius)
    commands += ghosts
    commands.append(_motion(flight, drawn.robot, frames.indices))
    return Scene(commands, _parts(flight), _caption(flight, frames, radius, bool(ghosts)))


def _extent(flight: Flight, drawn: SolidRobot) -> tuple[Array, float]:
    """Center and radius of what is to be seen."""
    clouds = [flight.position.values, flight.tool.values[:, :3]]
    for index in flight.samples(12):
        clouds.append(drawn.at(flight.joints[index], flight.base_at(index)).points())
    targets = flight.targets if flight.position_counts else []
    clouds += [t.goal.position[np.newaxis] for t in (*targets, *flight.tool_targets)]
    points = np.concatenate(clouds)
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2, max(0.5 * float(np.linalg.norm(high - low)), 1e-3)


def _visible(flight: Flight, radius: float) -> Signal:
    """All that moves in the picture (N, k), in tolerances."""
    assert flight.robot is not None
    columns = [flight.position.values / (_POSITION_TOLERANCE * radius)]
    columns.append(flight.attitude.values / _ANGLE_TOLERANCE)
    slides = np.array([joint.kind.value == "prismatic" for joint in flight.robot.movable_joints])
    scale = np.where(slides, _POSITION_TOLERANCE * radius, _ANGLE_TOLERANCE)
    columns.append(flight.joints / scale)
    return Signal(flight.position.time, np.column_stack(columns))


def _stage(center: Array, radius: float, flat: bool) -> list[Command]:
    """Background, camera, world axes and grid; everything is moved and scaled to radius 1."""
    world = np.eye(4)
    world[:3, :3] /= radius
    world[:3, 3] = -center / radius
    azimuth, elevation = math.radians(-90 if flat else -58), math.radians(89.9 if flat else 24)
    distance = 0.85 / math.sin(math.radians(_FIELD_OF_VIEW / 2))
    x, y, z = distance * np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
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
        segments(f"{WORLD}/grid", _grid(center, radius, spacing, flat), FAINT, 0.6),
        *[
            segments(f"{WORLD}/world/{name}", np.array([[0.0] * 3, 0.25 * radius * unit]), tint)
            for name, unit, tint in zip("xyz", np.eye(3), _AXES, strict=True)
        ],
    ]


def _grid(center: Array, radius: float, spacing: float, flat: bool) -> Array:
    """Ends (2 k, 3) of lines parallel to x and y, on whole multiples of ``spacing``."""
    z = center[2] - (0.0 if flat else 0.8 * radius)
    first = np.floor((center[:2] - 1.3 * radius) / spacing)
    last = np.ceil((center[:2] + 1.3 * radius) / spacing)
    (x0, y0), (x1, y1) = first * spacing, last * spacing
    lines = [[(x, y0, z), (x, y1, z)] for x in spacing * np.arange(first[0], last[0] + 1)]
    lines += [[(x0, y, z), (x1, y, z)] for y in spacing * np.arange(first[1], last[1] + 1)]
    return np.array(lines).reshape(-1, 3)


def _link_paths(robot: RobotDescription) -> dict[str, str]:
    """Place of every link in the viewer's tree, which is the tree of the URDF."""
    paths = {robot.base_link: ROBOT}
    pending = list(robot.joints)
    while pending:
        ready = [joint for joint in pending if joint.parent in paths]
        pending = [joint for joint in pending if joint.parent not in paths]
        for joint in ready:
            name = joint.child.replace("/", "\N{DIVISION SLASH}")
            paths[joint.child] = f"{paths[joint.parent]}/link {name}"
    return paths


def _robot(robot: RobotDescription, meshes: Mapping[str, TriangleMesh]) -> list[Command]:
    commands: list[Command] = []
    paths = _link_paths(robot)
    visuals = visuals_of(robot, meshes, _faces(meshes))
    for joint in robot.joints:
        commands.append(set_transform(paths[joint.child], matrix_of(joint.origin)))
        if not visuals:
            ends = np.array([np.zeros(3), joint.origin.r])
            path = f"{paths[joint.parent]}/line to {paths[joint.child].rpartition('/')[2]}"
            commands.append(segments(path, ends, body_color(robot.frames[joint.parent][0])))
    for number, visual in enumerate(visuals or _balls(robot)):
        path = f"{paths[visual.link]}/visual {number}"
        commands += solid(path, visual, body_color(visual.body))
    return commands


def _faces(meshes: Mapping[str, TriangleMesh]) -> int:
    """Return how many faces each mesh may have, so that the page stays small."""
    return _MOST_FACES // max(len(meshes), 1)


def _balls(robot: RobotDescription) -> list[Visual]:
    """Return a small ball for each link of a robot that has no visuals."""
    return [_ball(link.name, robot.frames[link.name][0], 0.03) for link in robot.links]


def _ball(link: str, body: int, radius: float) -> Visual:
    shape = Shape("sphere", (radius,), Pose())
    return Visual(link, body, shape, solid_mesh(shape))


def _motion(flight: Flight, robot: RobotDescription, indices: Indices) -> Command:
    """The animation: position and quaternion of the base, and of every link that a joint moves."""
    time, paths = flight.position.time[indices], _link_paths(robot)
    base = {"position": flight.position.values[indices], "quaternion": flight.quaternion[indices]}
    clips = [clip(ROBOT, time, base)]
    G, offsets = robot.coupling
    positions = flight.joints[indices] @ G.T + offsets
    for joint, q in zip(robot.moving_joints, positions.T, strict=True):
        R, r = joint.origin.R, joint.origin.r
        if joint.kind is JointKind.PRISMATIC:
            moved = {"position": r + np.outer(q, R @ joint.axis)}
        else:
            turns = np.column_stack([np.outer(np.sin(q / 2), joint.axis), np.cos(q / 2)])
            at_zero = quaternion_from_matrix(R)
            moved = {"quaternion": quaternion_multiply(at_zero, turns)}
        clips.append(clip(paths[joint.child], time, moved))
    return set_animation(clips)


def _lines(flight: Flight) -> list[Command]:
    """Paths of base and end-effector, and the path of the base that was planned."""
    lines = [("path of the base", flight.position.values, PALETTE[0])]
    if len(flight.tool):
        lines.append(("path of the end-effector", flight.tool.values[:, :3], PALETTE[4]))
    commands = []
    for name, points, tint in lines:
        step = max(1, len(points) // _LINE_POINTS)
        shown = np.concatenate([points[:-1:step], points[-1:]])
        if len(shown) > 1 and float(np.ptp(shown, axis=0).max()) > 0.0:
            commands.append(line(f"{WORLD}/{name}", shown, tint))
    return commands


def _ghosts(flight: Flight, robot: RobotDescription, radius: float) -> list[Command]:
    """The base at its last goal and a mark at the end-effector's."""
    commands: list[Command] = []
    if flight.goal is not None and flight.controls("base"):
        matrix = matrix_of(Pose(matrix_from_quaternion(flight.goal.quaternion), _aim(flight)))
        commands.append(set_transform(f"{WORLD}/goal", matrix))
        visuals = visuals_of(robot, flight.meshes, _faces(flight.meshes) // 4)
        for number, visual in enumerate(visuals):
            if visual.body == 0:
                path = f"{WORLD}/goal/{visual.link.replace('/', '_')} {number}"
                commands.append(set_transform(path, matrix_of(robot.frames[visual.link][1])))
                commands += solid(path, visual, GHOST, 0.25)
    targets: list[Target] = flight.tool_targets[-1:]
    for target in targets:
        pose = Pose(matrix_from_quaternion(target.goal.quaternion), target.goal.position)
        path = f"{WORLD}/end-effector goal"
        commands.append(set_transform(path, matrix_of(pose)))
        commands += solid(f"{path}/mark", _ball("", 0, 0.03 * radius), GHOST, 0.4)
        if set(flight.controls("end_effector")) & {3, 4, 5}:
            for name, unit, tint in zip("xyz", np.eye(3), _AXES, strict=True):
                ends = np.array([np.zeros(3), 0.12 * radius * unit])
                commands.append(segments(f"{path}/{name}", ends, tint))
    return commands


def _aim(flight: Flight) -> Array:
    """Where the ghost of the base stands: at its goal; where the base ends if only its attitude
    was asked for.
    """
    assert flight.goal is not None
    return flight.goal.position if flight.position_counts else flight.position.values[-1]


def _parts(flight: Flight) -> list[tuple[str, float, float]]:
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


def _caption(flight: Flight, frames: KeyFrames, radius: float, ghosts: bool) -> str:
    text = (
        "The robot from the shapes of its URDF, each moving link in the color of its joint in the "
        "figures below; lines are the paths of the base (blue)"
    )
    text += " and of the end-effector (orange)" if len(flight.tool) else ""
    text += "; the ghost is the goal" if ghosts else ""
    text += (
        f". {len(frames.indices)} key frames of {len(flight.position)} recorded states; in between "
        "the motion is interpolated"
    )
    within = max(frames.error, 1.0)
    text += (
        f" and within {within * _POSITION_TOLERANCE * radius:.2g} m and "
        f"{within * _ANGLE_TOLERANCE:.2g} rad of the states that it stands for."
    )
    if frames.every:
        which = "every cycle" if frames.every == 1 else f"every {frames.every}th cycle"
        text += (
            f" The first and the last {FULL_CYCLES} cycles are shown as they were; of those "
            f"between, one instant of {which}, always at the same phase, so that fast loops do not "
            "look like slow ones."
        )
    return text + flight.missing_meshes
