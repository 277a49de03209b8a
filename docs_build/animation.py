"""The first picture of the documents: a satellite that turns itself by the motion of its arm.

``make animation`` flies the robot ``surveyor`` without ROS and writes ``docs/images/turning.gif``.
Light and camera are those of the reports' pictures.
"""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from spacerobot_ros import fly
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.model.description import Array, Pose
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.model.visuals import meshes_from_files
from spacerobot_ros.report.solids import MAX_MESH_FACES, Canvas, SolidRobot, View

OUT = Path(__file__).parents[1] / "docs" / "images" / "turning.gif"

_SIZE = (640, 360)
"""Columns and rows, pixels."""

_FRAMES, _FRAME_TIME, _REST = 60, 70, 1600
"""Frames of the motion; time of each, and of the last one, ms."""

_VIEW = View(-58.0, 24.0)
_MARGIN = 1.12
_STARS, _COLOURS = 140, 64
_SKY, _INK, _GHOST = (13, 17, 28), (226, 232, 240), (94, 200, 160)


def frames_of(flight: Flight) -> list[Image.Image]:
    """Return the pictures of a flight, at equal intervals of time."""
    meshes = meshes_from_files(flight.required_robot(), MAX_MESH_FACES)
    robot = SolidRobot(flight.required_robot(), meshes)
    rows = np.linspace(0, len(flight.time) - 1, _FRAMES).round().astype(int)
    bodies = [robot.at(flight.q[row], _pose(flight, row)) for row in rows]
    points = _VIEW(np.concatenate([body.corner_points() for body in bodies]))
    middle, extent = (points.max(axis=0) + points.min(axis=0)) / 2, np.ptp(points, axis=0)
    scale = _MARGIN * float((extent / _SIZE).max())
    low, high = (middle + side * scale * np.array(_SIZE) / 2 for side in (-1, 1))
    outlines = [_VIEW(line) for line in robot.base_outlines(_pose(flight, -1))]
    sky, frames = _sky(), []
    for row, body in zip(rows, bodies, strict=True):
        canvas = Canvas(_VIEW, low, high, _SIZE[0])
        canvas.draw(body.faces, body.edges)
        picture = Image.fromarray(np.round(255 * canvas.image()).astype(np.uint8), "RGBA")
        frame = sky.copy()
        pen = ImageDraw.Draw(frame)
        for line in outlines:
            at = (line - low) / scale
            pen.line([(x, _SIZE[1] - y) for x, y in at.tolist()], fill=_GHOST, width=1)
        frame.paste(picture, (0, 0), picture)
        _write(frame, flight, int(row))
        frames.append(frame)
    return frames


def _pose(flight: Flight, row: int) -> Pose:
    return Pose(matrix_from_quaternion(flight.pose[row, 3:]), flight.pose[row, :3])


def _sky() -> Image.Image:
    """Return a dark sky with the same stars each time."""
    sky = Image.new("RGB", _SIZE, _SKY)
    random = np.random.default_rng(7)
    places = random.uniform((0, 0), _SIZE, (_STARS, 2))
    for (x, y), light in zip(places.tolist(), random.uniform(0.15, 0.7, _STARS), strict=True):
        tint = np.array(_SKY) + light * (np.array(_INK) - _SKY)
        sky.putpixel((int(x), int(y)), tuple(tint.astype(int).tolist()))
    return sky


def _write(frame: Image.Image, flight: Flight, row: int) -> None:
    """Write time and angle into the lower corners."""
    font = ImageFont.truetype(
        str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), 15
    )
    pen, foot = ImageDraw.Draw(frame), _SIZE[1] - 14
    pen.text((16, foot), f"{flight.time[row]:4.1f} s", _INK, font, anchor="ls")
    turned = f"base turned by {math.degrees(_angle(flight.pose[row, 3:])):.0f}°"
    pen.text((_SIZE[0] - 16, foot), turned, _INK, font, anchor="rs")


def _angle(quaternion: Array) -> float:
    """Return the angle of a rotation from the attitude of the world, rad."""
    return 2 * math.atan2(float(np.linalg.norm(quaternion[:3])), abs(float(quaternion[3])))


def main() -> None:
    """Write the animation."""
    frames = frames_of(fly("surveyor", rotvec=(0.5, 0.0, 0.0)))
    palette = frames[len(frames) // 2].quantize(_COLOURS)
    drawn = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in frames]
    times = [_FRAME_TIME] * (len(drawn) - 1) + [_REST]
    drawn[0].save(
        OUT, save_all=True, append_images=drawn[1:], duration=times, loop=0, optimize=True
    )
    print(f"{OUT}: {OUT.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
