"""Charts of a report in a browser: values, events, zoom, the instant that is shown, dark, phone."""

from __future__ import annotations

import base64
import io
import json
import re
import unicodedata
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pypdf
import pytest
from support.chromium import Browser, browser, chromium
from support.command_line import spacerobot
from support.flight_bags import GOAL, TICK, Story, goal_value, tell
from support.html_page import leave_blank, present, write_blank_report

from spacerobot_ros.flight.series import Signal
from spacerobot_ros.report import write_report
from spacerobot_ros.report.figures_over_time import shape_figure
from spacerobot_ros.report.flight import FlightReport, read_report
from spacerobot_ros.report.player import View3D, player_of
from spacerobot_ros.report.writing import charts_of

with_browser = pytest.mark.skipif(chromium() is None, reason="no Chromium to look at the page with")

COUNT = 400
END = TICK * (COUNT - 1)
EVENTS = [
    (0.5, {"event": "goal_accepted", "time": "0.5"}, "goal"),
    (4.0, {"event": "fault_injected", "time": "4", "fault": "joint_stuck j at 4"}, "fault on"),
    (6.0, {"event": "stuck_joint", "time": "6", "joints": "j"}, "stuck joint: j"),
    (7.0, {"event": "plan_taken_over", "time": "7", "reason": "stuck joints"}, "takeover"),
    (9.0, {"event": "fault_ended", "time": "9", "fault": "joint_stuck j at 4"}, "fault off"),
    (11.0, {"event": "correction", "time": "11"}, "correction"),
    (12.0, {"event": "goal_aborted", "time": "12"}, "aborted"),
]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    t = np.linspace(0.0, 1.0, COUNT)[:, np.newaxis]
    executing = {"state": "executing", "method": "lie_bracket", **goal_value()}
    story = Story(
        0.9 * np.sin(2.0 * t * np.arange(1, 4)) + 0.1 * t,
        statuses=[(0.1, "Executing.", executing)],
        goals=[(0.0, *GOAL)],
        events=[(time, values) for time, values, _ in EVENTS],
        metadata={"parameters/planner": {"position_tolerance": "0.017", "method": '"lie_bracket"'}},
    )
    return tell(tmp_path_factory.mktemp("charts") / "flight.mcap", story)


@pytest.fixture(scope="module")
def flight(bag: Path) -> FlightReport:
    return read_report(bag)


@pytest.fixture(scope="module")
def window(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """One browser for all these tests, on the page."""
    html = write_blank_report(bag)
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        opened.open(html, 1280, 900)
        opened.wait_for("document.getElementById('animation').className === 'ready'")
        yield opened
        assert opened.complaints == []
        outside = [url for url in opened.requests if not url.startswith("data:")]
        assert outside == [html.as_uri()]


@pytest.mark.slow
@with_browser
def test_the_capture_has_a_label_and_its_message_fits_a_phone(tmp_path: Path) -> None:
    html = tmp_path / "servicing.html"
    write_report(Path(__file__).parents[2] / "bags" / "servicing.mcap", html)
    with browser(tmp_path / "profile") as opened:
        opened.open(html, 1440, 900)
        opened.wait_for("document.getElementById('animation').className === 'ready'")
        seen = opened.evaluate("document.querySelector('.lane').innerText.split('\\n')")
        assert {"approach", "captured", "detumbled", "goal reached"} <= set(seen)
        opened.open(html, 390, 844)
        box = "document.getElementById('events').closest('.scroll')"
        assert opened.evaluate(f"{box}.scrollWidth - {box}.clientWidth") <= 0
        assert opened.complaints == []


def chart(window: Browser, number: int, expression: str) -> Any:
    return window.evaluate(f"(chart => {expression})(flightCharts.charts[{number}])")


@pytest.mark.slow
@with_browser
def test_charts_have_the_numbers_of_the_bag(window: Browser, flight: FlightReport) -> None:
    assert window.evaluate("flightCharts.charts.length") == 10
    assert window.evaluate("document.querySelectorAll('figure.live').length") == 6
    assert window.evaluate("getComputedStyle(document.querySelector('.live .scroll')).display") == (
        "none"
    )
    time, *columns = chart(window, 0, "chart.plot.data")
    np.testing.assert_allclose(time, flight.time, atol=1e-12)
    np.testing.assert_allclose(np.transpose(columns), flight.pose[:, :3], rtol=1e-6, atol=1e-7)
    # What stands below a chart when the cursor is on it.
    chart(window, 0, "chart.plot.setCursor({left: chart.plot.valToPos(4.0, 'x'), top: 5})")
    words = window.evaluate("document.querySelector('.u-legend').innerText")
    k = int(np.argmin(np.abs(flight.time - 4.0)))
    for value in flight.pose[k, :3]:
        assert f"{float(f'{value:.4g}'):g}"[:5] in words


def test_events_of_one_kind_at_once_are_counted(tmp_path: Path) -> None:
    faults = ("joint_slow j 0.5 at 1", "actuator_bias j 0.01 at 1", "joint_stuck j at 2")
    events = [
        (float(fault[-1]), {"event": "fault_injected", "time": fault[-1], "fault": fault})
        for fault in faults
    ]
    events += [(1.0, {"event": "stuck_joint", "time": "1", "joints": "j"})]
    story = Story(np.zeros((60, 3)), events=sorted(events, key=lambda event: event[0]))
    flight = read_report(tell(tmp_path / "faults.mcap", story))
    figure = shape_figure(flight)
    data = charts_of(flight, [figure]).data["charts"]["events"]
    assert [event["text"] for event in data] == [
        "fault on: joint_slow j 0.5 at 1 s",
        "fault on: actuator_bias j 0.01 at 1 s (+1)",
        "stuck joint: j",
        "fault on: joint_stuck j at 2 s",
    ]


def test_charts_have_the_traces_of_a_flight_beside(
    flight: FlightReport, bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_blank(monkeypatch)
    shapes = 0.3 * np.cos(np.linspace(0.0, 5.0, COUNT // 2))[:, np.newaxis] * np.ones((1, 3))
    other = tell(tmp_path / "other.mcap", Story(shapes))
    words = ["report", str(bag), str(other), "--out", str(tmp_path / "both.html")]
    spacerobot(*words)
    text = (tmp_path / "both.html").read_text("utf-8")
    (data,) = re.findall(r'<script[^>]*id="charts"[^>]*>(.*?)</script>', text, re.DOTALL)
    given = json.loads(data)
    assert given["end"] == pytest.approx(END)
    charts = [each for each in given["charts"] if each["label"] == "joint position"]
    assert sum(chart["own"] for chart in charts) == len(flight.joint_names)
    for chart in charts:
        named = [each.split(", ") for each in chart["names"]]
        own = [name for name, _ in named[: chart["own"]]]
        assert named == [[name, file] for file in (bag.stem, "other") for name in own]
        time = np.frombuffer(base64.b64decode(chart["time"]), "<f8")
        found = [np.frombuffer(base64.b64decode(each), "<f4") for each in chart["values"]]
        there = time < TICK * (len(shapes) - 0.5)
        for k, name in enumerate(own):
            joint, other_time = flight.joint_names.index(name), TICK * np.arange(len(shapes))
            first = np.interp(time, flight.time, flight.q[:, joint])
            second = np.interp(time[there], other_time, shapes[:, joint])
            np.testing.assert_allclose(found[k], first, atol=1e-6)
            np.testing.assert_allclose(found[len(own) + k][there], second, atol=1e-6)
            assert np.isnan(found[len(own) + k][~there]).all()


@with_browser
def test_the_legend_tells_flights_apart(bag: Path, tmp_path: Path) -> None:
    html, marks = tmp_path / "all.html", "[...document.querySelectorAll('.u-legend .u-marker')]"
    others = [tell(tmp_path / f"{k}.mcap", Story(np.zeros((5, 3)))) for k in range(3)]
    spacerobot("report", bag, *others, "--out", html)
    with browser(tmp_path / "profile") as opened:
        opened.open(html, 1280, 900)
        opened.wait_for("window.flightCharts !== undefined")
        found = opened.evaluate(f"{marks}.slice(0, 13).map(e => getComputedStyle(e).borderStyle)")
    assert found[-12:] == np.repeat(["solid", "dashed", "dotted", "double"], 3).tolist()


@with_browser
@pytest.mark.parametrize("width", [1280, 420])
def test_labels_of_events_stay_in_their_strip_and_apart(tmp_path: Path, width: int) -> None:
    plans = [
        (t, {"event": "plan_ready", "time": f"{t}", "method": "area_loop"}) for t in (6.3, 7.5, 8.7)
    ]
    begun = [(t - 0.01, {"event": "plan_started", "time": f"{t - 0.01}"}) for t, _ in plans]
    fault = {"event": "fault_injected", "time": "9.6", "fault": "joint_stuck elbow at 9.6"}
    ended = {"event": "goal_reached", "time": "9.95"}
    events = sorted([*plans, *begun, (9.6, fault), (9.95, ended)], key=lambda event: event[0])
    bag = tell(tmp_path / "late.mcap", Story(np.zeros((200, 3)), events=events))
    html = write_blank_report(bag)
    with browser(tmp_path / "profile") as opened:
        opened.open(html, width, 900)
        opened.wait_for("document.querySelector('.lane') !== null")
        left, right = opened.evaluate(
            "(lane => [lane.left, lane.right])"
            "(document.querySelector('.lane').getBoundingClientRect())"
        )
        words = opened.evaluate(
            "[...document.querySelectorAll('.mark i')].filter(each => each.offsetWidth)"
            ".map(each => [each.getBoundingClientRect(), each.innerText])"
            ".map(([box, text]) => [box.top, box.left, box.right, text])"
        )
    shown = {text.partition(":")[0] for *_, text in words}
    assert {"plan", "fault on"} | ({"goal reached"} if width > 1000 else set()) <= shown
    for row in {top for top, *_ in words}:
        spans = sorted((begin, end) for top, begin, end, _ in words if top == row)
        edges = [left, *(edge for span in spans for edge in span), right]
        assert edges == sorted(edges), words


@with_browser
def test_what_happened_stands_once_below_the_first_chart(window: Browser) -> None:
    left, width = chart(window, 0, "[0, chart.lane.clientWidth]")
    marks = chart(
        window,
        0,
        "chart.marks.map(({event, mark, words}) => "
        "[event.time, words.textContent, parseFloat(mark.style.left), event.row])",
    )
    assert [mark[0] for mark in marks] == [time for time, _, _ in EVENTS]
    for (_, _, words), (time, text, x, _) in zip(EVENTS, marks, strict=True):
        assert words in text
        assert x == pytest.approx(left + width * time / END, abs=0.5)
    assert window.evaluate("document.querySelectorAll('.lane').length") == 1
    assert chart(window, 8, "chart.lane === null && chart.marks.length === 0")
    rows = {mark[1].split(":")[0]: mark[3] for mark in marks}
    assert rows["fault on"] == rows["fault off"] != rows["stuck joint"] != rows["takeover"]
    seen = window.evaluate("document.querySelector('.lane').innerText")
    for words in ("fault on: joint_stuck j at 4 s", "stuck joint: j", "fault off", "takeover"):
        assert words in seen
    table = window.evaluate("document.getElementById('events').innerText")
    assert all(words in table for _, _, words in EVENTS)


@with_browser
def test_the_instant_of_the_3d_view_is_that_of_the_charts(window: Browser) -> None:
    slider = "document.getElementById('time')"
    window.evaluate(f"{slider}.value = 0.25; {slider}.dispatchEvent(new Event('input'))")
    assert window.evaluate("flightCharts.now") == pytest.approx(END / 4)
    for number in (0, 8):
        x, width = chart(
            window, number, "[parseFloat(chart.hand.style.left), chart.plot.over.clientWidth]"
        )
        assert x == pytest.approx(width / 4, abs=0.5)
    press(window, 0, 0.5)
    assert window.evaluate("flightCharts.now") == pytest.approx(END / 2, abs=0.02)
    assert window.evaluate(f"Number({slider}.value)") == pytest.approx(0.5, abs=2e-3)
    assert window.evaluate("document.getElementById('now').textContent").startswith("9.9")


def press(window: Browser, number: int, *shares: float, clicks: int = 1) -> None:
    """Press the mouse on a chart at a part of its width, and let it go at the last one given."""
    window.evaluate(
        f"flightCharts.charts[{number}].plot.root.scrollIntoView({{block: 'center'}});"
        "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
    )
    box = "chart.plot.over.getBoundingClientRect()"
    x, y, width = chart(window, number, f"(b => [b.x, b.y + b.height / 2, b.width])({box})")
    kinds = ["mousePressed", *["mouseMoved"] * (len(shares) - 1), "mouseReleased"]
    places = [shares[0], *shares[1:], shares[-1]]
    move = {"type": "mouseMoved", "x": x + width * shares[0], "y": y, "button": "none"}
    window.call("Input.dispatchMouseEvent", **move)
    for kind, share in zip(kinds, places, strict=True):
        event = {"type": kind, "x": x + width * share, "y": y, "button": "left"}
        window.call("Input.dispatchMouseEvent", **event, clickCount=clicks, buttons=1)


@with_browser
def test_a_drag_zooms_all_charts_and_two_clicks_show_all(window: Browser) -> None:
    press(window, 1, 0.25, 0.4, 0.5)
    low, high = window.evaluate("flightCharts.span")
    shown = chart(window, 0, "chart.marks.filter(m => !m.mark.hidden).length")
    assert shown == sum(low <= time <= high for time, _, _ in EVENTS)
    assert (low, high) == (pytest.approx(END / 4, abs=0.1), pytest.approx(END / 2, abs=0.1))
    for number in (0, 1, 8):
        scale = "[chart.plot.scales.x.min, chart.plot.scales.x.max, chart.reset.hidden]"
        assert chart(window, number, scale) == [low, high, False]
    press(window, 1, 0.5, clicks=1)
    press(window, 1, 0.5, clicks=2)
    assert window.evaluate("flightCharts.span") == [0, pytest.approx(END)]
    assert chart(window, 0, "chart.reset.hidden")


@pytest.mark.slow
@with_browser
def test_dark_and_light(window: Browser) -> None:
    def brightness(of: str) -> float:
        text = window.evaluate(f"getComputedStyle(document.body).{of}")
        return float(np.mean([float(x) for x in text[4:-1].split(",")]))

    assert brightness("backgroundColor") == 255.0
    window.evaluate("document.getElementById('theme').click()")
    assert brightness("backgroundColor") < 30.0
    assert brightness("color") > 200.0
    assert window.evaluate("document.getElementById('theme').textContent") == "Light"
    assert window.picture("#pane").mean() < 0.5
    assert window.picture(".uplot").mean() < 0.3
    window.evaluate("document.getElementById('theme').click()")
    assert window.picture("#pane").mean() > 0.7
    dark = [{"name": "prefers-color-scheme", "value": "dark"}]
    window.call("Emulation.setEmulatedMedia", features=dark)
    # Chosen by hand counts more than what the system wishes.
    assert brightness("backgroundColor") == 255.0
    window.evaluate("delete document.documentElement.dataset.theme")
    assert brightness("backgroundColor") < 30.0
    window.call("Emulation.setEmulatedMedia", features=[])


@with_browser
def test_on_a_phone_what_is_wide_says_so(window: Browser) -> None:
    window.resize(390, 800)
    window.wait_for("document.querySelector('.hint.needed') !== null")
    assert window.evaluate("document.documentElement.scrollWidth") <= 390
    shown = window.evaluate(
        "[...document.querySelectorAll('.hint')].filter(h => h.offsetHeight > 0).map(h => "
        "h.nextElementSibling.scrollWidth > h.nextElementSibling.clientWidth)"
    )
    assert len(shown) >= 2
    assert all(shown)
    window.wait_for("flightCharts.charts[0].plot.width < 390")
    assert "stuck joint: j" in window.evaluate("document.querySelector('.lane').innerText")


@pytest.mark.slow
@with_browser
def test_on_paper_everything_is_unfolded_and_headings_stay_with_their_parts(
    window: Browser, flight: FlightReport
) -> None:
    made = base64.b64decode(window.call("Page.printToPDF", preferCSSPageSize=True)["data"])
    pages = [page.extract_text() for page in pypdf.PdfReader(io.BytesIO(made)).pages]
    assert all(len(text.split()) > 10 for text in pages)
    words = " ".join(" ".join(pages).split())
    headings = window.evaluate("[...document.querySelectorAll('h2')].map(each => each.innerText)")
    assert not any(text.strip().endswith(tuple(headings)) for text in pages)
    for key, value in flight.bag.metadata["parameters/planner"].items():
        assert f"{key} {value}" in words
    # Of tables that are no list of parameters no word is broken; charts are not printed.
    cells = window.evaluate(
        "[...document.querySelectorAll('td')].filter(each => !each.closest('details, .charts'))"
        ".map(each => each.innerText)"
    )
    # Paper has ligatures.
    whole = set(unicodedata.normalize("NFKC", words).split())
    told = unicodedata.normalize("NFKC", " ".join(cells)).split()
    shown = {word for word in told if re.search(r"\w", word)}
    assert "prismatic" in shown
    assert shown <= whole
    assert "Permission is hereby granted" not in words
    assert window.evaluate("[...document.querySelectorAll('details')].every(each => !each.open)")


def test_every_licence_is_there_once_with_its_words() -> None:
    """And not its name alone, with who has the copyright."""
    found = player_of(View3D([], [], "")).notices
    assert len({name for name, _ in found}) == len(found) >= 9
    for name, licence in found:
        assert len(licence) > 600, name
        assert "Copyright" in licence, name
    (isarray,) = (licence for name, licence in found if name.startswith("isarray"))
    assert "Julian Gruber" in isarray
    assert "Permission is hereby granted" in isarray


def test_a_break_is_wide_enough_to_be_seen(flight: FlightReport) -> None:
    """uPlot draws a line across a break between samples of one time."""
    figure = present(shape_figure(flight))
    group = figure.groups[0]
    at = float(group.signal.time[len(group.signal) // 3])
    broken = replace(group, signal=group.signal.broken_at([at]))
    part = charts_of(flight, [replace(figure, groups=[broken])])
    (chart,) = part.data["charts"]["charts"]
    time = np.frombuffer(base64.b64decode(chart["time"]), "<f8")
    for column in chart["values"]:
        values = np.frombuffer(base64.b64decode(column), "<f4")
        (gap,) = np.flatnonzero(np.isnan(values))
        assert time[gap + 1] - time[gap - 1] >= 0.004 * (time[-1] - time[0])


def test_fewer_samples_look_alike() -> None:
    time = np.linspace(0.0, 100.0, 30_001)
    smooth = Signal(time, np.column_stack([np.sin(time), np.exp(-time)]))
    few = smooth.thinned(500)
    assert len(few) < 3000
    for k in range(2):
        between = np.interp(time, few.time, few.values[:, k])
        assert np.abs(between - smooth.values[:, k]).max() < 6e-3
    noise = np.random.default_rng(1).normal(size=(30_001, 3))
    few = Signal(time, noise).thinned(500)
    assert len(few) < 4001
    assert (few.time[0], few.time[-1]) == (0.0, 100.0)
    for low in np.arange(0.0, 100.0, 0.2).tolist():
        part, all_of = (each.between(low, low + 0.2).values for each in (few, Signal(time, noise)))
        np.testing.assert_array_equal(part.max(axis=0), all_of.max(axis=0))
        np.testing.assert_array_equal(part.min(axis=0), all_of.min(axis=0))
    short = Signal(time[:50], noise[:50])
    assert short.thinned(500) is short
