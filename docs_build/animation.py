"""The first picture of the documents: a satellite that turns itself by the motion of its arm.

``make animation`` flies the robot ``surveyor`` without ROS and writes ``docs/images/turning.gif``.
Light and camera are those of the reports' pictures.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from spacerobot_ros import fly
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.meshes import meshes_from_files
from spacerobot_ros.report.scene import (
    MAX_MESH_FACES,
    Canvas,
    View,
    corner_points,
    outlines,
    placed_solids,
    robot_bodies,
)

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
    rows = np.linspace(0, len(flight.time) - 1, _FRAMES).round().astype(int)
    robot, q = flight.required_robot(), flight.q[rows]
    of_base = [link for link, (body, _) in robot.frames.items() if body == 0]
    bodies = robot_bodies(robot, meshes, flight.pose[rows], q, MAX_MESH_FACES)
    instants = [placed_solids(bodies, instant) for instant in range(len(rows))]
    points = _VIEW(np.concatenate([corner_points(solids) for solids in instants]))
    middle, extent = (points.max(axis=0) + points.min(axis=0)) / 2, np.ptp(points, axis=0)
    scale = _MARGIN * float((extent / _SIZE).max())
    low, high = (middle + side * scale * np.array(_SIZE) / 2 for side in (-1, 1))
    base = [replace(each, poses=each.poses[-1:]) for each in bodies if each.name in of_base]
    ghost = [_VIEW(line) for body in base for line in outlines(body)]
    sky, frames = _sky(), []
    for row, solids in zip(rows, instants, strict=True):
        canvas = Canvas(_VIEW, low, high, _SIZE[0])
        canvas.draw(solids)
        picture = Image.fromarray(np.round(255 * canvas.image()).astype(np.uint8), "RGBA")
        frame = sky.copy()
        pen = ImageDraw.Draw(frame)
        for line in ghost:
            at = (line - low) / scale
            pen.line([(x, _SIZE[1] - y) for x, y in at.tolist()], fill=_GHOST, width=1)
        frame.paste(picture, (0, 0), picture)
        _write(frame, flight, int(row))
        frames.append(frame)
    return frames


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
