"""Mermaid diagrams as SVG, drawn while the site is built, not by a script in the browser."""

from __future__ import annotations

import hashlib

import mermaidx


def diagram(text: str) -> str:
    """Return the HTML figure of a diagram in Mermaid's language, in one line.

    Raises
    ------
    Exception
        Mermaid cannot read the text.
    """
    name = "diagram-" + hashlib.sha256(text.encode()).hexdigest()[:8]
    svg = mermaidx.render(text).svg().replace("my-svg", name).replace("\n", " ")
    return f'<figure class="diagram">{svg}</figure>'
