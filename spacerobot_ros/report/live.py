"""What makes a part of a page live: its markup, numbers, programs, and their licences.

A page allows its programs by their hashes, and nothing that a bag holds can become one.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from typing import Any


@dataclass(frozen=True)
class Live:
    """A part of a page.

    Attributes
    ----------
    markup
        Where it stands.
    data
        What it shows, as JSON has it, by the ids that its programs look for.
    programs
        JavaScript, in the order in which it is run.
    style
        CSS.
    notices
        Name and licence of every program of others.
    """

    markup: str = ""
    data: dict[str, Any] = field(default_factory=dict)
    programs: tuple[str, ...] = ()
    style: str = ""
    notices: tuple[tuple[str, str], ...] = ()


def own_file(name: str) -> str:
    """Return the text of a file of this package."""
    return files("spacerobot_ros.report").joinpath(name).read_text(encoding="utf-8")


def scripts_of(parts: Sequence[Live]) -> str:
    """Return the scripts of a page."""
    made = []
    for part in parts:
        for identity, content in part.data.items():
            text = json.dumps(content, separators=(",", ":"))
            # A name of a link cannot end the script that it stands in.
            text = text.replace("</", "<\\/").replace("<!--", "<\\u0021--")
            made.append(f'<script type="application/json" id="{identity}">{text}</script>')
    made += [f"<script>{program}</script>" for part in parts for program in part.programs]
    return "\n".join(made)


def policy_of(parts: Sequence[Live]) -> str:
    """Return the security policy that allows these programs; empty for none."""
    programs = [program for part in parts for program in part.programs]
    hashes = [hashlib.sha256(program.encode()).digest() for program in programs]
    allowed = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in hashes)
    return f"script-src {allowed}" if allowed else ""


def notices_of(parts: Sequence[Live]) -> str:
    """Return the licences of the programs of others, to be unfolded."""
    notices = [notice for part in parts for notice in part.notices]
    if not notices:
        return ""
    texts = "".join(f"<h3>{escape(n)}</h3><pre>{escape(text.strip())}</pre>" for n, text in notices)
    return f'<details id="licences"><summary>Licences of the scripts</summary>{texts}</details>'
