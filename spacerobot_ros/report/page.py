"""The page of a report: HTML that stands alone, without anything to fetch."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape

from spacerobot_ros.report.charts import chart_numbers, charts_of
from spacerobot_ros.report.events import FlightEvent
from spacerobot_ros.report.flight import Flight
from spacerobot_ros.report.live import Live, notices_of, own_file, policy_of, scripts_of
from spacerobot_ros.report.plates import Plate
from spacerobot_ros.report.tables import (
    Table,
    headline,
    joint_table,
    published_table,
    result_table,
    runs_table,
)

_SCROLL = '<div class="scroll">'
_HINT = '<p class="hint">Wider than this screen: scroll sideways →</p>'
_USE = (
    '<p class="facts" id="use">Drag across a chart to look at a part of the time in all of them, '
    "click twice for the whole flight. Click once to see the robot at that instant above; the "
    "upright line is the instant that is shown there. Click a name to hide its trace.</p>"
)
_MOST_ROWS, _MOST_OPEN = 200, 20
"""Rows of what happened that are on the page, and that need not be unfolded."""
_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"


def page(
    flight: Flight,
    player: Live,
    plates: Sequence[Plate | str | None],
    beside: Sequence[Flight] = (),
) -> str:
    """Return the whole page; flights ``beside`` this one get a row in a table."""
    charts, controls = charts_of(flight, plates), Live(programs=(own_file("page.js"),))
    parts = (player, charts, controls)
    name = flight.scenario
    title = ", ".join(filter(None, (name, flight.method, flight.robot_name)))
    body = [
        "<header>",
        '<button id="theme" type="button" hidden>Dark</button>',
        f"<h1>{escape(name)}</h1>",
        f"<p>{escape(flight.description)}</p>" if flight.description else "",
        _facts(flight),
        _outcome(flight),
        _tiles(flight),
        "</header>",
        *_runs(flight, beside),
        player.markup,
        *_numbers(flight),
        *_published(flight),
        *_events(flight.events),
        "<h2>Figures</h2>",
        _USE if charts.data else "",
        *_figures(plates),
        *_parameters(flight),
        notices_of(parts),
        _footer(flight),
    ]
    css = charts.style + own_file("page.css")
    policy = "; ".join(filter(None, (_POLICY, policy_of(parts))))
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{escape(policy)}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<link rel="icon" href="data:,">\n'
        f"<title>{escape(title)}</title>\n<style>\n{css}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(part for part in body if part)
        + f"\n</main>\n{scripts_of(parts)}\n</body>\n</html>\n"
    )


def _facts(flight: Flight) -> str:
    facts = []
    if flight.method:
        facts.append(f"method {flight.method}")
    if flight.robot is not None:
        count = len(flight.robot.joint_names)
        joints = "1 joint" if count == 1 else f"{count} joints"
        facts.append(f"robot {flight.robot_name}: {joints}, {flight.robot.total_mass:.5g} kg")
    if flight.namespace:
        facts.append(f"namespace {flight.namespace}")
    if flight.other_robots:
        facts.append(f"the bag also has {', '.join(flight.other_robots)}")
    spans = "".join(f"<span>{escape(fact)}</span>" for fact in facts)
    return f'<p class="facts">{spans}</p>' if facts else ""


def _outcome(flight: Flight) -> str:
    if not flight.statuses:
        return (
            '<p class="outcome">The bag holds no status of a planner or a controller '
            "(planner/status, controller/status).</p>"
        )
    last = flight.statuses[-1]
    sentence = last.sentence
    if last.executing:
        sentence += " The recording ends before that is decided."
    state = f"<b>{escape(last.state.capitalize())}</b>" if last.state else ""
    return f'<p class="outcome {escape(last.state)}">{state}{escape(sentence)}</p>'


def _tiles(flight: Flight) -> str:
    """The numbers of the run that are looked for first."""
    made = []
    for label, value, note in headline(flight):
        small = f"<small>{escape(note)}</small>" if note else ""
        # Names of methods may be broken where they have an underscore.
        shown = escape(value).replace("_", "_<wbr>")
        made.append(f"<div><dt>{escape(label)}</dt><dd>{shown}{small}</dd></div>")
    return f'<dl class="tiles">{"".join(made)}</dl>' if made else ""


def _runs(flight: Flight, beside: Sequence[Flight]) -> list[str]:
    if not beside:
        return []
    return ["<h2>Runs side by side</h2>", _table("runs", runs_table([flight, *beside]))]


def _numbers(flight: Flight) -> list[str]:
    result, joints = result_table(flight), joint_table(flight)
    parts = ["<h2>Numbers of the run</h2>"]
    if flight.goal is None:
        parts.append('<p class="missing">The bag holds no goal pose.</p>')
    if result.rows:
        rows = "".join(
            f'<tr><th scope="row">{escape(label)}</th><td>{escape(value)}</td></tr>\n'
            for label, value in result.rows
        )
        parts.append(f'{_HINT}{_SCROLL}<table id="numbers"><tbody>\n{rows}</tbody></table></div>')
    if joints is not None:
        parts.append(_table("joints", joints))
    return parts


def _published(flight: Flight) -> list[str]:
    table = published_table(flight)
    if table is None:
        return []
    return [
        "<h2>Published figures beside measured ones</h2>",
        _table("published", table),
        '<p class="facts">Source: “planner”, what the planner gave with its first schedule; '
        "“flight”, what was measured.</p>",
    ]


def _table(identity: str, table: Table) -> str:
    def row(cells: Sequence[str], tag: str) -> str:
        made = []
        for column, cell in enumerate(cells):
            name, scope = ("th", ' scope="row"') if tag == "td" and column == 0 else (tag, "")
            kind = ' class="number"' if column in table.numeric else ""
            made.append(f"<{name}{scope}{kind}>{escape(cell)}</{name}>")
        return f"<tr>{''.join(made)}</tr>\n"

    body = "".join(row(cells, "td") for cells in table.rows)
    return (
        f'{_HINT}{_SCROLL}<table id="{identity}"><thead>\n{row(table.head, "th")}</thead>'
        f"<tbody>\n{body}</tbody></table></div>"
    )


def _figures(plates: Sequence[Plate | str | None]) -> list[str]:
    parts, number, numbers = [], 0, chart_numbers(plates)
    for sentence in dict.fromkeys(plate for plate in plates if isinstance(plate, str)):
        parts.append(f'<p class="missing">{escape(sentence)}</p>')
    for plate in plates:
        if not isinstance(plate, Plate):
            continue
        number += 1
        data = base64.b64encode(plate.svg).decode()
        parts.append(
            f'<figure id="{plate.name}"{_charts(numbers.get(plate.name))}>{_HINT}'
            f'<div class="scroll"><img src="data:image/svg+xml;base64,{data}" '
            f'alt="{escape(plate.heading)}"></div>\n'
            f"<figcaption><b>Figure {number}. {escape(plate.heading)}.</b> {_caption(plate)}"
            "</figcaption></figure>"
        )
    return parts


def _caption(plate: Plate) -> str:
    if not plate.of_picture:
        return escape(plate.caption)
    before, aside, after = plate.caption.partition(plate.of_picture)
    return f'{escape(before)}<span class="still">{escape(aside)}</span>{escape(after)}'


def _charts(numbers: str | None) -> str:
    return "" if numbers is None else f' data-charts="{numbers}"'


def _events(events: Sequence[FlightEvent]) -> list[str]:
    """What happened, in the order of time: all of it, or the first rows of very much."""
    if not events:
        return []
    rows = [
        (f"{each.time:.6g}", each.text, each.event.sentence, each.node.strip("/"))
        for each in sorted(events, key=lambda each: each.time)
    ]
    more = len(rows) - _MOST_ROWS
    table = Table(("Time (s)", "What", "In words", "Node"), rows[:_MOST_ROWS], (0,))
    note = f'<p class="facts">{more} more are in the bag.</p>' if more > 0 else ""
    shown = _table("events", table) + note
    if len(rows) > _MOST_OPEN:
        shown = f"<details><summary>{len(rows)} events</summary>{shown}</details>"
    return ["<h2>What happened</h2>", shown]


def _parameters(flight: Flight) -> list[str]:
    nodes = {
        name.partition("/")[2]: values
        for name, values in flight.metadata.items()
        if name.startswith("parameters/")
    }
    if not nodes:
        return []
    parts = ["<h2>Parameters</h2>"]
    for node, values in nodes.items():
        rows = "".join(
            f"<tr><td><code>{escape(key)}</code></td><td><code>{escape(value)}</code></td></tr>\n"
            for key, value in values.items()
        )
        parts.append(
            f"<details><summary>{escape(node)}</summary><table><tbody>\n{rows}</tbody></table></details>"
        )
    return parts


def _footer(flight: Flight) -> str:
    version = flight.metadata.get("spacerobot", {}).get("version", "")
    by = f", recorded by spacerobot_ros {version}" if version else ""
    text = f"Made from the bag {flight.file_name} alone: {flight.message_count} messages{by}."
    return f"<footer><p>{escape(text)}</p></footer>"
