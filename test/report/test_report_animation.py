"""The 3D view of a report: which states it shows, where it puts the links, and a browser's view."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.chromium import Browser, browser, chromium
from support.flight_bags import FINAL, GOAL, Story, cyclic_shapes, tell, urdf_of
from support.html_page import leave_blank, present, write_blank_report
from support.oracles import PinocchioOracle

from spacerobot_ros.flight.series import Signal
from spacerobot_ros.model.description import Array, Pose, Shape
from spacerobot_ros.model.meshes import solid_mesh
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_rotvec
from spacerobot_ros.report import player, write_report
from spacerobot_ros.report.flight import Cycles, FlightReport, read_report
from spacerobot_ros.report.player import WORLD, key_frames, view_of_flight
from spacerobot_ros.report.scene import bodies_of

N = 6


def wander(count: int = 400) -> Array:
    """Smooth positions of six joints that end elsewhere than they begin."""
    t = np.linspace(0.0, 1.0, count)[:, np.newaxis]
    return 0.9 * np.sin(2.0 * t * np.arange(1, N + 1)) + 0.1 * t


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    story = Story(wander(), goals=[(0.0, *GOAL)])
    return tell(tmp_path_factory.mktemp("animation") / "flight.mcap", story)


@pytest.fixture(scope="module")
def flight(bag: Path) -> FlightReport:
    return read_report(bag)


def test_key_frames_follow_a_slow_motion() -> None:
    rng = np.random.default_rng(3)
    time = np.array(np.cumsum(rng.uniform(0.01, 0.03, 20_000)), np.float64)
    phases = rng.uniform(0, 2 * np.pi, 4)
    motion = 300.0 * np.sin(2 * np.pi * time[:, np.newaxis] / time[-1] * np.arange(1, 5) + phases)
    frames = key_frames(Signal(time, motion), None)
    assert (frames.indices[0], frames.indices[-1]) == (0, len(time) - 1)
    assert len(frames.indices) < 400
    for column in motion.T:
        between = np.interp(time, time[frames.indices], column[frames.indices])
        assert np.abs(between - column).max() <= 1.0 + 1e-9


def test_key_frames_are_few_and_say_what_they_miss() -> None:
    time = np.linspace(0.0, 2499.95, 50_000)
    motion = 100.0 * np.sin(2 * np.pi * time / 1.7)[:, np.newaxis]
    frames = key_frames(Signal(time, motion), None)
    assert len(frames.indices) < 1100
    between = np.interp(time, time[frames.indices], motion[frames.indices, 0])
    assert np.abs(between - motion[:, 0]).max() == pytest.approx(frames.error)
    assert frames.error > 10.0


def test_fast_cycles_are_shown_at_one_phase() -> None:
    tick, period, slide, count = 0.05, 3.0, 100.0, 1600
    end = slide + count * period
    time = np.linspace(0.0, end, round(end / tick) + 1)
    drift = np.maximum(time - slide, 0.0)
    motion = np.column_stack(
        [300.0 * np.sin(2 * np.pi * drift / period) + 0.1 * drift, 0.2 * drift]
    )
    cycles = Cycles(slide, float(time[-1]), period)
    frames = key_frames(Signal(time, motion), cycles)
    shown = time[frames.indices]
    between = shown[(shown > slide + 9.0 + tick) & (shown < time[-1] - 9.0 - tick)]
    phase = np.mod(between - slide + tick / 4, period)
    assert phase.max() < tick
    assert frames.every == 6
    # What is drawn between them is the drift alone.
    line = np.interp(time, shown, motion[frames.indices, 0])
    inside = (time > slide + 9.0) & (time < time[-1] - 9.0)
    np.testing.assert_allclose(line[inside], 0.1 * drift[inside], atol=5.0)


def test_links_are_where_pinocchio_has_them(flight: FlightReport) -> None:
    view = present(view_of_flight(flight))
    (animation,) = [each for each in view.commands if each["type"] == "set_animation"]
    oracle = PinocchioOracle(urdf_of(N), flight.joint_names)
    moved = {each["path"]: each["clip"]["tracks"] for each in animation["animations"]}
    assert moved.keys() == {f"{WORLD}/base_link", *(f"{WORLD}/link_{i}" for i in range(N))}
    for path, (position, quaternion) in moved.items():
        assert (position["name"], quaternion["name"]) == (".position", ".quaternion")
        places = np.reshape(position["values"], (-1, 3))
        turns = np.reshape(quaternion["values"], (-1, 4))
        for time, r, attitude in zip(position["times"], places, turns, strict=True):
            index = int(np.argmin(np.abs(flight.time - time)))
            link = path.rpartition("/")[2]
            R_WL, r_WL_W = oracle.link_pose(link, flight.q[index], flight.pose[index])
            np.testing.assert_allclose(r, r_WL_W, atol=2e-5)
            np.testing.assert_allclose(matrix_from_quaternion(attitude), R_WL, atol=5e-5)


def test_a_gait_can_be_looked_at_in_parts(tmp_path: Path) -> None:
    shapes = cyclic_shapes(slide=100, cycles=40)
    view = present(view_of_flight(read_report(tell(tmp_path / "flight.mcap", Story(shapes)))))
    names = [name for name, _, _ in view.parts]
    assert names == ["whole flight", "first 5 s", "first 3 cycles", "last 3 cycles"]
    assert [end - start for _, start, end in view.parts[2:]] == pytest.approx([4.5, 4.5])
    assert "always at the same phase" in view.caption


def test_meshes_that_a_bag_carries_are_drawn(tmp_path: Path) -> None:
    mesh = solid_mesh(Shape("box", (1.0, 2.0, 3.0), Pose()))
    told = tell(tmp_path / "flight.mcap", Story(wander(20)))
    bare = read_report(told)
    assert "Meshes are not drawn." in bare.missing_meshes
    carried = replace(bare, meshes={"package://robot/dish.stl": mesh})
    assert carried.missing_meshes == ""
    drawn = []
    for each in (bare, carried):
        bodies = bodies_of(each, [0], 10_000)
        view = present(view_of_flight(each))
        objects = [c["object"] for c in view.commands if c["type"] == "set_object"]
        geometries = [o["geometries"][0] for o in objects if o["object"]["type"] == "Mesh"]
        drawn.append((sum(len(body.visuals) for body in bodies), geometries))
    # The ghost at the goal, too, has the mesh.
    assert drawn[1][0] == drawn[0][0] + 1
    more = [each for each in drawn[1][1] if each["uuid"] not in {g["uuid"] for g in drawn[0][1]}]
    (geometry,) = more
    corners = np.reshape(geometry["data"]["attributes"]["position"]["array"], (-1, 3))
    index = np.reshape(geometry["data"]["index"]["array"], (-1, 3))
    np.testing.assert_allclose(corners[index], mesh.vertices[mesh.faces], atol=1e-5)


@pytest.mark.slow
def test_without_the_viewer_a_sentence_says_so(
    bag: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(player, "viewer_script", lambda: None)
    leave_blank(monkeypatch)
    write_report(bag, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "pip install meshcat" in text
    assert "MeshCat.Viewer" not in text
    assert 'id="flight"' not in text


# -- in a browser -----------------------------------------------------------------------------

with_browser = pytest.mark.skipif(chromium() is None, reason="no Chromium to look at the page with")


@pytest.fixture(scope="module")
def page(bag: Path) -> Path:
    return write_blank_report(bag)


@pytest.fixture
def window(tmp_path: Path) -> Iterator[Browser]:
    with browser(tmp_path) as opened:
        yield opened


def slide_to(window: Browser, share: float) -> None:
    """Move the time slider and wait until that is drawn."""
    slider = "document.getElementById('time')"
    window.evaluate(f"{slider}.value = {share}; {slider}.dispatchEvent(new Event('input'))")
    window.evaluate("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")


@pytest.mark.slow
@with_browser
def test_the_robot_is_seen_to_move(page: Path, window: Browser) -> None:
    window.open(page, 420, 640)
    window.wait_for("document.getElementById('animation').className !== 'loading'")
    assert window.evaluate("document.getElementById('animation').className") == "ready"
    pictures = []
    for share in (0.0, 1.0):
        slide_to(window, share)
        pictures.append(window.picture("#pane"))
    start, end = pictures
    colors = np.unique((start.reshape(-1, 3) * 255).astype(int), axis=0)
    assert len(colors) > 50
    assert np.mean(np.abs(start - end).max(axis=2) > 0.05) > 0.01
    # A phone's page does not scroll sideways.
    assert window.evaluate("document.documentElement.scrollWidth") <= 420
    assert "19.95 s" in window.evaluate("document.getElementById('now').textContent")
    final = np.eye(4)
    final[:3, :3] = matrix_from_quaternion(quaternion_from_rotvec(FINAL[1]))
    final[:3, 3] = FINAL[0]
    np.testing.assert_allclose(base_in(window), final, atol=1e-4)
    # The page has one player: that of the viewer does not show.
    assert window.evaluate("[...document.querySelectorAll('.dg')].every(e => !e.offsetHeight)")
    assert window.complaints == []
    assert [url for url in window.requests if not url.startswith("data:")] == [page.as_uri()]


def base_in(window: Browser) -> Any:
    """Pose of the base link in the world frame, as the viewer has it."""
    matrix = window.evaluate(
        "(() => { const at = (path) => flightViewer.scene_tree.find(path).object.matrixWorld;"
        "return at(['flight']).clone().invert()"
        ".multiply(at(['flight', 'base_link'])).toArray(); })()"
    )
    return np.reshape(matrix, (4, 4)).T


@pytest.mark.slow
@with_browser
def test_play_runs_to_the_end(page: Path, window: Browser) -> None:
    window.open(page, 420, 640)
    window.wait_for("document.getElementById('animation').className === 'ready'")
    slide_to(window, 0.98)
    window.evaluate("document.getElementById('play').click()")
    window.wait_for("document.getElementById('time').value === '1'")
    window.wait_for("document.getElementById('play').textContent === 'Play'")


@pytest.mark.slow
@with_browser
def test_without_webgl_a_sentence_says_so(page: Path, tmp_path: Path) -> None:
    with browser(tmp_path, "--disable-3d-apis") as window:
        window.open(page)
        window.wait_for("document.getElementById('animation').className === 'without'")
        text = window.evaluate("document.getElementById('animation').innerText")
        assert text.startswith("The 3D view needs WebGL")
        assert window.evaluate("document.getElementById('pane').clientHeight") == 0
