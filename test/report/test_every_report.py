"""The report of every scenario and every fault scenario, opened at desktop and at phone width."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.chromium import Browser, browser, chromium, keep_picture

from spacerobot_ros.events import EventKind
from spacerobot_ros.report import write_report
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.scenario import load_scenario, scenario_names
from spacerobot_ros.session.run import run_scenario

pytestmark = [
    pytest.mark.study,
    pytest.mark.usefixtures("own_domain"),
    pytest.mark.skipif(chromium() is None, reason="no Chromium to look at the page with"),
]

LARGEST = 5_000_000
LONGEST = 10.0
"""Of a page, in bytes, and of making it, in s of CPU."""

FAULTS = {
    "stuck_elbow": {"fault on: joint_stuck elbow_pitch", "stuck joint: elbow_pitch"},
    "stuck_slider": {"fault on: joint_stuck", "stuck joint: slider_1", "goal failed"},
    "broken_thrusters": {"fault on: thruster_stuck force_y", "fault off: thruster_stuck force_y"},
    "closed_nozzle": {"fault on: nozzle_closed plus_y_2"},
    "late_poses": {"fault on: sensor_dropout odom", "fault off: sensor_dropout odom"},
    "weak_motors": {"fault on: joint_slow slider_1", "correction"},
    "wrong_masses": {"correction"},
    "wheel_failure": {"fault on: joint_slow wheel_plus_x", "wheel failed: wheel_plus_x"},
    "killed_nodes": {"node silent", "node back"},
}
"""What must stand below the charts of some: the fault, what found it, its end."""


@pytest.fixture(scope="module")
def window(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


@pytest.mark.parametrize("name", scenario_names())
def test_the_report_shows_what_happened(name: str, tmp_path: Path, window: Browser) -> None:
    scenario = load_scenario(name)
    nodes = bool(scenario.kills)
    if nodes:
        scenario = scenario.in_real_time(4.0)
    bag, page = tmp_path / "flight.mcap", tmp_path / "flight.html"
    summary = run_scenario(scenario, bag, nodes=nodes).summary
    bag = Path(summary["bag"])
    began = time.process_time()
    write_report(bag, page)
    spent, size = time.process_time() - began, page.stat().st_size
    print(f"{name}: {spent:.1f} s of CPU, {size / 1e6:.2f} MB")
    assert spent < LONGEST
    assert size < LARGEST
    flight = read_report(bag)
    # Terminal, JSON and report say the same.
    assert flight.time_flown == pytest.approx(summary["manoeuvre_time_s"], abs=1e-6)
    error = flight.error
    assert (error is None) is (not scenario.goal.base)
    if error is not None:
        assert error.distance == pytest.approx(summary["position_error_m"], rel=1e-9, abs=1e-12)
        assert error.angle == pytest.approx(summary["attitude_error_rad"], rel=1e-9, abs=1e-12)
    kinds = {each.kind for _, each in flight.timed_events}
    for width in (1280, 390):
        window.complaints.clear()
        window.requests.clear()
        window.open(page, width, 900)
        window.wait_for("document.getElementById('animation').className !== 'loading'")
        assert window.evaluate("document.getElementById('animation').className") == "ready"
        assert window.complaints == []
        outside = [url for url in window.requests if not url.startswith("data:")]
        assert outside == [page.as_uri()]
        assert window.evaluate("document.documentElement.scrollWidth") <= width
        keep_picture(window, f"{name.replace('/', '-')}-{width}")
        assert window.evaluate("flightCharts.charts.length") >= 5
        assert window.evaluate("document.querySelectorAll('.lane').length") == 1
        below = lanes(window)
        expected = {"goal", *FAULTS.get(Path(name).name, ())}
        expected |= {"fault on: "} if EventKind.FAULT_INJECTED in kinds else set()
        expected |= {"stuck joint: "} if EventKind.STUCK_JOINT in kinds else set()
        for words in expected:
            # The kind is shown, and the details beside it or, if they do not fit, on hovering.
            kind, _, details = words.partition(": ")
            found = any(kind in text and details in f"{text} {title}" for text, title in below)
            assert found, (width, words, below)


def lanes(window: Browser) -> list[tuple[str, str]]:
    """Return words and titles below the first chart; marks of faults and their finding are seen."""
    words = "flightCharts.charts[0].marks.map(({words, mark}) => [words.textContent, mark.title])"
    strong = "flightCharts.charts[0].marks.filter(({event}) => event.strong)"
    assert window.evaluate(f"{strong}.every(({{mark}}) => mark.firstChild.offsetHeight > 0)")
    return [(text, title) for text, title in window.evaluate(words)]
