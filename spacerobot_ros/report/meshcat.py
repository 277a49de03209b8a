"""The commands that MeshCat's viewer takes, and the file it is.

The Python package ``meshcat`` sends such commands to a server, which passes them on to the viewer
in a browser. Here they are written into the page, as that package's ``static_html`` does, so that
no server is needed and the package is not even imported: it brings the viewer, a script with
three.js in it. An object is in three.js' JSON object format.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from html import escape
from importlib.metadata import distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.model.description import Array, Pose
from spacerobot_ros.model.meshes import TriangleMesh
from spacerobot_ros.model.visuals import Visual
from spacerobot_ros.report.live import Live, own_file
from spacerobot_ros.report.solids import EDGE

Command = dict[str, Any]


@dataclass(frozen=True)
class Scene:
    """What the viewer is told, the spans of time to look at (name, start, end), and a caption."""

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
    """Set a property of what is at a path, such as ``visible``."""
    return {"type": "set_property", "path": path, "property": name, "value": value}


def set_transform(path: str, matrix: Array) -> Command:
    """Set a matrix (4, 4), which is sent column by column."""
    flat = [round(float(x), 9) for x in matrix.T.ravel()]
    return {"type": "set_transform", "path": path, "matrix": flat}


def _object(path: str, geometry: Command, material: Command, kind: str) -> Command:
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
    return _object(path, _points(points), _stroke(color, 1.0), "Line")


def segments(path: str, ends: Array, color: str, opacity: float = 1.0) -> Command:
    """Separate lines between points (2 k, 3)."""
    return _object(path, _points(ends), _stroke(color, opacity), "LineSegments")


def _points(points: Array) -> Command:
    numbers = {"type": "Float32Array", "array": _rounded(points)}
    position = {"itemSize": 3, "normalized": False, **numbers}
    return {"type": "BufferGeometry", "data": {"attributes": {"position": position}}}


def _stroke(color: str, opacity: float) -> Command:
    stroke = {"type": "LineBasicMaterial", "color": _number(color), "linewidth": 1}
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
            # The viewer goes the short way round between quaternions of the same sign.
            flips = np.cumsum((values[1:] * values[:-1]).sum(axis=1) < 0) % 2
            values = values * np.append(1, 1 - 2 * flips)[:, np.newaxis]
        numbers = {"times": np.round(time, 4).tolist(), "values": _rounded(values)}
        made.append({"name": f".{name}", "type": kinds[name], **numbers})
    return {"path": path, "clip": {"fps": 1, "name": "flight", "tracks": made}}


def set_animation(clips: list[Command]) -> Command:
    """Return the command that loads an animation of several objects."""
    return {"type": "set_animation", "animations": clips, "options": {"play": True}}


def solid(path: str, visual: Visual, color: str, opacity: float = 1.0) -> list[Command]:
    """A visual and, where it is a solid with sharp ones, its edges."""
    shape = visual.shape
    matrix = matrix_of(shape.pose)
    if shape.kind == "cylinder":
        # Along y in three.js, along z in URDF.
        matrix = matrix @ np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
    look = {"type": "MeshPhongMaterial", "color": _number(color), "shininess": 15}
    # Edges and ghosts in the surface of a solid are to be seen.
    look |= {"polygonOffset": True, "polygonOffsetFactor": 1, "polygonOffsetUnits": 1}
    if opacity < 1.0:
        look |= {"transparent": True, "opacity": opacity, "depthWrite": False}
        look |= {"polygonOffsetFactor": -1, "polygonOffsetUnits": -1}
    if shape.kind == "mesh":
        # Of both sides, because files differ in which of them is outside.
        look |= {"flatShading": True, "side": 2}
        return [_object(f"{path}/solid", _triangles(visual.mesh), look, "Mesh")]
    geometry = {"box": _box, "cylinder": _cylinder, "sphere": _sphere}[shape.kind](shape.size)
    commands = [
        _object(f"{path}/solid", geometry, look, "Mesh"),
        set_transform(f"{path}/solid", matrix),
    ]
    edges = visual.edges.lines
    if len(edges):
        tint = EDGE if opacity == 1.0 else color
        ends = edges.reshape(-1, 3)
        commands.append(segments(f"{path}/edges", ends, tint, 0.5 if opacity == 1.0 else 1.0))
    return commands


def _triangles(mesh: TriangleMesh) -> Command:
    kind = "Uint16Array" if len(mesh.vertices) < 1 << 16 else "Uint32Array"
    made = _points(mesh.vertices)
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


def _rounded(values: Array) -> list[float]:
    return np.round(values.ravel(), 5).tolist()


def _number(color: str) -> int:
    """A color ``#rrggbb`` as a number."""
    return int(color[1:], 16)


NO_VIEWER = (
    "There is no 3D view: it takes the viewer of the Python package meshcat (pip install meshcat)."
)

_MARKUP = """<section id="animation" class="loading">
<div id="stage"><div id="pane" role="img" aria-label="The robot in motion"></div></div>
<div id="bar"><button id="play" type="button">Play</button>
<input id="time" type="range" min="0" max="1" step="any" value="0" aria-label="Time">
<output id="now"></output>
<select id="part" aria-label="Span of time"></select>
<select id="speed" aria-label="Speed"></select></div>
<p class="missing">This browser shows no WebGL, which the 3D view takes; the figures below do \
without.</p>
<noscript><p class="missing">The 3D view takes JavaScript; the figures below do without.</p>\
</noscript>
<p class="caption"><b>The flight.</b> {caption} Drag to turn the view, with the right button to \
move it; click it first to zoom with the wheel.</p>
</section>
"""


def player_of(scene: Scene | str) -> Live:
    """Return the player of a scene, or the sentence that stands for it."""
    viewer = viewer_script()
    if isinstance(scene, str) or viewer is None:
        sentence = scene if isinstance(scene, str) else NO_VIEWER
        return Live(f'<p class="missing">{escape(sentence)}</p>')
    parts = [{"name": name, "start": start, "end": end} for name, start, end in scene.parts]
    return Live(
        markup=_MARKUP.format(caption=escape(scene.caption)),
        data={"flight": {"parts": parts, "commands": scene.commands}},
        programs=(viewer, own_file("player.js")),
        notices=_notices(),
    )


def _notices() -> tuple[tuple[str, str], ...]:
    """Return the licences of MeshCat and of what is in its viewer, three.js above all."""
    own, others = "", []
    for file in distribution("meshcat").files or ():
        if file.name in ("LICENSE.txt", "LICENSE", "LICENCE"):
            own = file.read_text()
        elif file.name.endswith("THIRD_PARTY_LICENSES.json"):
            others += json.loads(file.read_text())
    # One of them comes without the text of its licence; MeshCat's own has the words of MIT.
    mit = own[own.find("Permission is hereby granted") :]
    found = [("MeshCat", own)]
    for each in others:
        name, licence = f"{each.get('name', '')} {each.get('version', '')}", each.get("license", "")
        holder = f"Copyright (c) {each.get('author', '')}"
        words = f"{licence}\n\n{holder}\n\n{mit if licence == 'MIT' else ''}"
        found.append((name, each.get("licenseText") or words))
    return tuple(found)
