"""Pictures of robots in environments: their solids, and the goal as lines."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from spacerobot_ros.environments.tasks import RobotStates, Task
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.meshes import meshes_from_files
from spacerobot_ros.planning.core.controllability import sample_shapes
from spacerobot_ros.report.figures import GHOST_COLOUR
from spacerobot_ros.report.scene import (
    MAX_MESH_FACES,
    Body,
    Canvas,
    View,
    corner_points,
    outlines,
    placed_solids,
    robot_bodies,
)

WIDTH, HEIGHT = 640, 480

_SHAPES = 50
"""Number of configurations used to choose the picture scale."""

Picture = npt.NDArray[np.uint8]


class Camera:
    """Draws the robots of a task with the base in the centre and a scale that fits
    all configurations."""

    def __init__(self, task: Task) -> None:
        self._task, self._robot = task, task.robot.description
        self._meshes = meshes_from_files(self._robot, MAX_MESH_FACES)
        origins = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (_SHAPES, 1))
        bodies = self._bodies(origins, sample_shapes(task.robot, _SHAPES))
        points = [corner_points(placed_solids(bodies, instant)) for instant in range(_SHAPES)]
        self._reach = float(np.linalg.norm(np.concatenate(points), axis=1).max())

    def _bodies(self, poses: Array, q: Array) -> list[Body]:
        return robot_bodies(self._robot, self._meshes, poses, q, MAX_MESH_FACES)

    def picture(self, states: RobotStates, goals: Array) -> Picture:
        """Return a picture (HEIGHT, WIDTH, 3) of one robot from its state and its goal (one
        row each)."""
        view, half = View(), self._reach * np.array([WIDTH / HEIGHT, 1.0])
        middle = view(states.pose[0, :3])
        canvas = Canvas(view, middle - half, middle + half, WIDTH)
        bodies = self._bodies(states.pose, states.q)
        canvas.draw(placed_solids(bodies, 0))
        poses = self._task.goal_poses(states, goals)
        if poses is not None:
            base = [each.visuals for each in bodies if each.name == self._robot.base_link]
            solids = () if self._task.link or not base else base[0]
            canvas.draw_lines(outlines(Body("goal", solids, poses)), GHOST_COLOUR)
        image = canvas.image()
        opaque = image[..., :3] * image[..., 3:] + (1.0 - image[..., 3:])
        return np.asarray(np.clip(255.0 * opaque, 0.0, 255.0), np.uint8)
