"""The part of the page in which the flight is played."""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import dataclass
from html import escape
from importlib.resources import files

from spacerobot_ros.report.meshcat import viewer_script
from spacerobot_ros.report.scene import Scene

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


@dataclass(frozen=True)
class Player:
    """What goes into the page: ``markup``, ``scripts``, and what its security policy must allow."""

    markup: str
    scripts: str = ""
    policy: str = ""


def player_of(scene: Scene | str) -> Player:
    """Return the player of a scene, or the sentence that stands for it."""
    viewer = viewer_script()
    if isinstance(scene, str) or viewer is None:
        sentence = scene if isinstance(scene, str) else NO_VIEWER
        return Player(f'<p class="missing">{escape(sentence)}</p>')
    parts = [{"name": name, "start": start, "end": end} for name, start, end in scene.parts]
    data = json.dumps({"parts": parts, "commands": scene.commands}, separators=(",", ":"))
    # A name of a link cannot end the script that it stands in.
    data = data.replace("</", "<\\/").replace("<!--", "<\\u0021--")
    own = files("spacerobot_ros.report").joinpath("player.js").read_text(encoding="utf-8")
    programs = [viewer, own]
    scripts = f'<script type="application/json" id="flight">{data}</script>\n'
    scripts += "\n".join(f"<script>{program}</script>" for program in programs)
    hashes = [hashlib.sha256(program.encode()).digest() for program in programs]
    allowed = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in hashes)
    return Player(_MARKUP.format(caption=escape(scene.caption)), scripts, f"script-src {allowed}")
