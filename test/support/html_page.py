"""A page of a report, taken apart."""

from __future__ import annotations

import base64
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import pytest
from matplotlib.figure import Figure

from spacerobot_ros.report import figures_space, write_report

T = TypeVar("T")


def leave_blank(patch: pytest.MonkeyPatch) -> None:
    """Leave figures blank: it saves most of the time of a report whose text is tested."""

    def savefig(figure: Figure, stream: BinaryIO, **_: Any) -> None:
        stream.write(b'<svg xmlns="http://www.w3.org/2000/svg"/>')

    patch.setattr(Figure, "savefig", savefig)
    patch.setattr(figures_space, "PIXELS", 20)


def write_blank_report(bag: Path) -> Path:
    """Write a report with blank figures beside a bag, and return its path."""
    html = bag.with_suffix(".html")
    with pytest.MonkeyPatch.context() as patch:
        leave_blank(patch)
        write_report(bag, html)
    return html


def present(part: T | str | None) -> T:
    """Return a figure or a view, in place of which there is no sentence."""
    assert part is not None
    assert not isinstance(part, str), part
    return part


class Page(HTMLParser):
    """A parsed report: its tables as rows of cells, its main numbers with their notes, its figures
    as SVG, all text and attributes.
    """

    _VOID = ("meta", "link", "img", "input", "br", "wbr")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str]] = []
        self.tables: dict[str, list[list[str]]] = {}
        self.figures: dict[str, bytes] = {}
        self.scripts: list[str] = []
        self.text = ""
        self.texts: list[str] = []
        self.tiles: dict[str, str] = {}
        self._table = self._figure = self._tile = ""
        self.feed(text)
        self.close()
        assert not self.open, f"left open: {self.open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {key: value or "" for key, value in attrs}
        self.attributes += [(tag, key, value) for key, value in values.items()]
        if tag not in self._VOID:
            self.open.append(tag)
        if tag == "script":
            self.scripts.append("")
        if tag == "table":
            self._table = values.get("id", "")
            self.tables[self._table] = []
        elif tag == "tr":
            self.tables[self._table].append([])
        elif tag in ("td", "th"):
            self.tables[self._table][-1].append("")
        elif tag == "figure":
            self._figure = values["id"]
        elif tag == "img":
            kind, _, data = values["src"].partition(",")
            assert kind == "data:image/svg+xml;base64"
            assert values["alt"]
            self.figures[self._figure] = base64.b64decode(data, validate=True)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if "script" in self.open:
            self.scripts[-1] += data
        if {"style", "script"} & set(self.open):
            return
        self.text += data
        self.texts.append(data)
        if self.open[-1:] == ["dt"]:
            self._tile = data
            self.tiles[data] = ""
        elif "dd" in self.open:
            self.tiles[self._tile] += f"{data} "
        if {"td", "th"} & set(self.open[-2:]):
            self.tables[self._table][-1][-1] += data

    def number(self, label: str) -> str:
        return ({row[0]: row[1] for row in self.tables["numbers"]} | self.tiles)[label]
