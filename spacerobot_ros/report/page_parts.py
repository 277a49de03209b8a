"""HTML page components: page shell and security policy, tables, figures and scripts.

Flight and campaign reports are built from these components. A page is self-contained: its
Content-Security-Policy forbids loading any resource and allows only its own scripts, identified by
hash. Untrusted text in a bag is therefore never executed.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from typing import Any

_SCROLL_HINT = '<p class="hint">Wider than this screen: scroll sideways →</p>'
_WITH_EXPONENT = re.compile(r"\d[\d.]*e-\d+")
_SECURITY_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


@dataclass(frozen=True)
class PagePart:
    """A page component with scripts.

    Attributes
    ----------
    markup
        HTML of the part.
    data
        JSON data for the scripts, by element id.
    programs
        JavaScript, in execution order.
    style
        CSS.
    notices
        Name and licence of each third-party script.
    """

    markup: str = ""
    data: dict[str, Any] = field(default_factory=dict)
    programs: tuple[str, ...] = ()
    style: str = ""
    notices: tuple[tuple[str, str], ...] = ()


def package_file(name: str) -> str:
    """Return the content of a package file, such as ``page.css``."""
    return files("spacerobot_ros.report").joinpath(name).read_text(encoding="utf-8")


def html_page(title: str, body: Sequence[str], footer: str, parts: Sequence[PagePart] = ()) -> str:
    """Return a whole page, with a button to switch between the light and dark themes.

    Parameters
    ----------
    title, footer
        Plain text.
    body
        HTML of the elements; empty strings are omitted.
    parts
        Components whose scripts, styles and licences are added to the page; their markup is in
        ``body``.
    """
    parts = (*parts, PagePart(programs=(package_file("page.js"),)))
    programs = [program.encode() for part in parts for program in part.programs]
    hashes = [base64.b64encode(hashlib.sha256(each).digest()).decode() for each in programs]
    allowed = " ".join(f"'sha256-{each}'" for each in hashes)
    policy = f"{_SECURITY_POLICY}; script-src {allowed}"
    css = "".join(part.style for part in parts) + package_file("page.css")
    end = f"<footer><p>{escape(footer)}</p></footer>"
    content = "\n".join(filter(None, (*body, _licences_html(parts), end)))
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{escape(policy)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{escape(title)}</title>\n<style>\n{css}</style>\n</head>\n<body>\n<main>\n"
        '<button id="theme" type="button" hidden>Dark</button>\n'
        f"{content}\n</main>\n{_scripts_html(parts)}\n</body>\n</html>\n"
    )


def _scripts_html(parts: Sequence[PagePart]) -> str:
    made = []
    for part in parts:
        for identity, content in part.data.items():
            text = json.dumps(content, separators=(",", ":"))
            # A link name must not close the script element that contains it.
            text = text.replace("</", "<\\/").replace("<!--", "<\\u0021--")
            made.append(f'<script type="application/json" id="{identity}">{text}</script>')
    made += [f"<script>{program}</script>" for part in parts for program in part.programs]
    return "\n".join(made)


def _licences_html(parts: Sequence[PagePart]) -> str:
    notices = [notice for part in parts for notice in part.notices]
    if not notices:
        return ""
    texts = "".join(f"<h3>{escape(n)}</h3><pre>{escape(text.strip())}</pre>" for n, text in notices)
    return f'<details id="licences"><summary>Licences of the scripts</summary>{texts}</details>'


def unbroken(text: str) -> str:
    """Return a string as HTML without line breaks inside numbers such as ``1.5e-06``."""
    return _WITH_EXPONENT.sub(r'<span class="unbroken">\g<0></span>', escape(text))


def missing(text: str) -> str:
    """Return a sentence about something that a page lacks; an empty string if there is none."""
    return f'<p class="missing">{escape(text)}</p>' if text else ""


def folded(summary: str, content: str) -> str:
    """Return content (HTML) that is shown only after a click on its summary."""
    return f"<details><summary>{escape(summary)}</summary>{content}</details>"


def facts(texts: Sequence[str]) -> str:
    """Return short facts on one line, or an empty string if there are none."""
    spans = "".join(f"<span>{escape(fact)}</span>" for fact in texts)
    return f'<p class="facts">{spans}</p>' if texts else ""


def tiles(rows: Sequence[tuple[str, str, str]]) -> str:
    """Return the key figures as tiles, each with a label, value and note."""
    made = []
    for label, value, note in rows:
        small = f"<small>{unbroken(note)}</small>" if note else ""
        # Names may be broken at underscores.
        shown = unbroken(value).replace("_", "_<wbr>")
        made.append(f"<div><dt>{escape(label)}</dt><dd>{shown}{small}</dd></div>")
    return f'<dl class="tiles">{"".join(made)}</dl>' if made else ""


def table(
    identity: str, head: Sequence[str], rows: Sequence[Sequence[str]], numeric: Sequence[int] = ()
) -> str:
    """Return a table; the first cell of each row is a header, and ``numeric`` columns are
    right-aligned.

    If ``head`` is empty, the table has no header row.
    """

    def row(cells: Sequence[str], tag: str) -> str:
        made = []
        for column, cell in enumerate(cells):
            name, scope = ("th", ' scope="row"') if tag == "td" and column == 0 else (tag, "")
            kind = ' class="number"' if column in numeric else ""
            made.append(f"<{name}{scope}{kind}>{unbroken(cell)}</{name}>")
        return f"<tr>{''.join(made)}</tr>\n"

    body = "".join(row(cells, "td") for cells in rows)
    titles = f"<thead>\n{row(head, 'th')}</thead>" if head else ""
    return (
        f'{_SCROLL_HINT}<div class="scroll"><table id="{identity}">{titles}'
        f"<tbody>\n{body}</tbody></table></div>"
    )


def figure(name: str, svg: bytes, text: str, caption: str, attributes: str = "") -> str:
    """Return a picture (SVG) with its caption (HTML) as an element with the id ``name``.

    ``text`` is the alternative text; a space precedes each of the HTML ``attributes``.
    """
    data = base64.b64encode(svg).decode()
    return (
        f'<figure id="{name}"{attributes}>{_SCROLL_HINT}'
        f'<div class="scroll"><img src="data:image/svg+xml;base64,{data}" '
        f'alt="{escape(text)}"></div>\n<figcaption>{caption}</figcaption></figure>'
    )
