"""The picture report, from bags of a few hundred states written for the purpose."""

from __future__ import annotations

import base64
import math
import re
import struct
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator
from hashlib import sha256
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.altered_bags import altered
from support.flight_bags import (
    EXECUTING,
    FINAL,
    GOAL,
    REACHED,
    TICK,
    Story,
    cyclic_shapes,
    goal_value,
    still,
    tell,
    urdf_of,
)
from support.html_page import Page, leave_blank

from spacerobot_ros import load_scenario, read_run
from spacerobot_ros.bag import RecordingError, read_bag
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.flight.reading import FlightBag
from spacerobot_ros.report import figures_space, write_picture, write_report
from spacerobot_ros.report.figures import ReportFigure, drawing
from spacerobot_ros.report.figures_over_time import shape_figure
from spacerobot_ros.report.flight import read_report

FIGURES = [
    "configurations",
    "position",
    "attitude",
    "shape",
    "velocities",
    "loops",
    "errors",
    "momentum",
    "path",
]


def numbers_in(text: str) -> list[float]:
    return [float(x) for x in re.findall(r"-?\d+\.?\d*(?:e[-+]?\d+)?", text)]


@pytest.fixture(scope="module", autouse=True)
def _coarse_pictures() -> Iterator[None]:
    """Draw robots with few pixels: what is tested is that they are drawn."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures_space, "PIXELS", 120)
        yield


@pytest.fixture
def blank(monkeypatch: pytest.MonkeyPatch) -> None:
    leave_blank(monkeypatch)


def report_of(tmp_path: Path, story: Story) -> Page:
    html = tmp_path / "out" / "report.html"
    write_report(tell(tmp_path / "flight.mcap", story), html)
    return Page(html.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def story() -> Story:
    """A slide and twenty cycles that reach a goal."""
    end = TICK * (len(cyclic_shapes()) - 1)
    return Story(
        cyclic_shapes(),
        statuses=[
            (0.0, "Waiting for a goal pose.", {"state": "idle"}),
            (0.0, "Flying.", EXECUTING | goal_value()),
            (end, "The goal is reached.", REACHED | goal_value()),
        ],
        goals=[(0.0, *GOAL)],
        metadata={
            "scenario": {"name": "test_flight", "description": "A flight & more"},
            "parameters/planner": {"position_tolerance": "0.02", "method": '"lie_bracket"'},
        },
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="module")
def flown(folder: Path, story: Story) -> Page:
    return report_of(folder, story)


def test_has_every_figure_in_order(flown: Page) -> None:
    assert list(flown.figures) == [*FIGURES[:3], "cycles", *FIGURES[3:]]
    assert "Meshes are not drawn." in flown.text
    assert "last 3 of 20 cycles" in flown.text
    for svg in flown.figures.values():
        assert ET.fromstring(svg).tag.endswith("svg")


def test_needs_nothing_besides_itself(flown: Page) -> None:
    for tag, key, value in flown.attributes:
        assert tag not in ("iframe", "object", "embed", "base")
        if value.startswith("default-src"):
            policy = dict(rule.split(" ", 1) for rule in value.split("; "))
            assert policy["default-src"] == "'none'"
            # The two scripts of the page and no other.
            allowed = policy["script-src"].split()
            texts = [text for text in flown.scripts if not text.startswith("{")]
            hashes = [base64.b64encode(sha256(text.encode()).digest()).decode() for text in texts]
            assert allowed == [f"'sha256-{digest}'" for digest in hashes]
            continue
        if key in ("src", "href", "srcset", "data", "action", "poster"):
            assert value.startswith("data:"), (tag, key)
        assert not re.search(r"https?:|file:|//", value.partition(";base64,")[0])
    for svg in flown.figures.values():
        for element in ET.fromstring(svg).iter():
            for key, value in element.attrib.items():
                if key.endswith("href"):
                    assert value.startswith(("#", "data:"))
                assert not re.search(r"https?:|file:", value.partition(";base64,")[0])


def test_pictures_of_dense_traces_stay_small(tmp_path: Path) -> None:
    bag = tell(tmp_path / "flight.mcap", Story(cyclic_shapes(cycles=70)))
    with drawing():
        figure = shape_figure(read_report(bag))
    assert isinstance(figure, ReportFigure)
    assert len(figure.svg) < 250_000


def figures_without(*names: str) -> list[str]:
    return [name for name in FIGURES if name not in names]


NO_GOAL = "The bag contains no goal pose."
UNDESCRIBED = "The bag contains no robot description"
NO_JOINTS = "The bag contains no positions of joint 'joint_0' and 2 more"


@pytest.mark.parametrize(
    ("story", "figures", "said", "unsaid"),
    [
        (
            Story(np.empty((50, 0)), goals=[(0.0, *GOAL)]),
            figures_without("shape", "velocities", "loops"),
            ["The robot has no joints."],
            ["Peak velocity"],
        ),
        (
            Story(still(), prefix="/free_flyer"),
            figures_without("errors"),
            [NO_GOAL, "no planner or controller status"],
            ["Position error"],
        ),
        (
            Story(still(2), goals=[(0.0, [math.nan, 0.0, 0.0], [0.0] * 3)], urdf="<robot/>"),
            figures_without("configurations", "errors"),
            [NO_GOAL],
            ["nan"],
        ),
        (
            Story(still(), topics=("odom",)),
            ["position", "attitude", "path"],
            [
                f"{NO_JOINTS} (joint_states): the robot is not drawn.",
                "The bag contains no joint positions (joint_states).",
            ],
            ["has no joints"],
        ),
        (
            Story(still(), name="other_"),
            figures_without("configurations", "errors"),
            [NO_JOINTS],
            ["has no joints"],
        ),
        (
            Story(still(), topics=(), urdf=None),
            [],
            [f"{UNDESCRIBED} (robot_description) and no base poses (odom): the robot is not drawn"],
            ["has no joints"],
        ),
        (
            Story(still(), topics=("odom",), urdf=None),
            ["position", "attitude", "path"],
            [UNDESCRIBED],
            [],
        ),
        (
            Story(still(), topics=("joint_states",), urdf=None),
            ["shape", "velocities", "loops"],
            [UNDESCRIBED],
            [],
        ),
        (Story(still(), topics=("momentum",), urdf=None), ["momentum"], [UNDESCRIBED], []),
    ],
)
@pytest.mark.usefixtures("blank")
def test_what_a_bag_lacks_is_named_and_left_out(
    story: Story, figures: list[str], said: list[str], unsaid: list[str], tmp_path: Path
) -> None:
    page = report_of(tmp_path, story)
    assert list(page.figures) == figures
    assert [sentence for sentence in said if sentence not in page.text] == []
    assert [sentence for sentence in unsaid if sentence in page.text] == []


@pytest.mark.usefixtures("blank")
def test_the_head_says_that_the_goal_is_not_that_of_the_scenario(tmp_path: Path) -> None:
    position, rotvec = GOAL
    pose = {
        "goal_position": " ".join(map(str, position)),
        "goal_orientation": " ".join(map(str, Rotation.from_rotvec(rotvec).as_quat())),
    }
    record = {"scenario": {"name": "test", "description": "It turns by 30 degrees.", **pose}}
    own, other = "It turns by 30 degrees.", "Flown to a goal other than the scenario's"
    for goals, shown, hidden in (([(0.0, *GOAL)], own, other), ([(0.0, *FINAL)], other, own)):
        folder = tmp_path / f"{len(shown)}"
        folder.mkdir()
        page = report_of(folder, Story(still(), goals=goals, metadata=record))
        assert f"{shown}\n" in page.text
        assert hidden not in page.text


@pytest.mark.usefixtures("blank")
def test_the_goal_of_a_status_is_found_by_its_id(tmp_path: Path) -> None:
    other = ([0.0, 0.0, 1.0], [0.0, 0.0, 0.1])
    statuses = [
        (0.0, "Flying.", EXECUTING | {"goal_id": "unstamped-1"}),
        (10.0, "The goal is out of reach.", {"state": "refused", "goal_id": "10.000000000"}),
        (30.0, "The goal is reached.", {"state": "reached", "goal_id": "unstamped-1"}),
        (40.0, "This is no status.", {"state": "lost"}),
    ]
    goals = [(0.0, *GOAL), (10.0, *other)]
    page = report_of(tmp_path, Story(still(), statuses, goals))
    assert numbers_in(page.number("Goal position")) == GOAL[0]
    assert numbers_in(page.number("Manoeuvre")) == [30.0]
    assert "This is no status." in page.text


@pytest.mark.usefixtures("blank")
@pytest.mark.parametrize(
    "log_time",
    [lambda t: round(t, -8) // 2 * 2, lambda _: 0, lambda t: -t],
    ids=["rounded", "equal", "decreasing"],
)
def test_log_times_that_are_no_clock_make_a_page(
    tmp_path: Path, folder: Path, flown: Page, log_time: Callable[[int], int]
) -> None:
    """Stamps are of another clock, so that log times count; cycles have no period then."""
    offset = 10**18
    bag, html = tmp_path / "odd.mcap", tmp_path / "odd.html"
    altered(folder / "flight.mcap", bag, log_time=lambda t: offset + log_time(t))
    write_report(bag, html)
    page = Page(html.read_text(encoding="utf-8"))
    assert page.figures.keys() <= flown.figures.keys()
    assert "shape" in page.figures


def test_log_times_of_the_wall_clock_give_the_times_of_the_stamps(
    tmp_path: Path, folder: Path, flown: Page
) -> None:
    """As recorded beside a plant in four times real time whose clock is not recorded."""
    bag, html = tmp_path / "wall.mcap", tmp_path / "wall.html"
    altered(folder / "flight.mcap", bag, log_time=lambda t: 10**18 + t // 4)
    write_report(bag, html)
    page = Page(html.read_text(encoding="utf-8"))
    assert page.figures.keys() == flown.figures.keys()
    for number in ("Recorded", "Manoeuvre", "Goal position"):
        assert page.number(number) == flown.number(number)
    files = bag, folder / "flight.mcap"
    sent, given = ([goal.time for goal in FlightBag(read_bag(each)).goals()] for each in files)
    np.testing.assert_allclose(sent, given, atol=1e-6)


@pytest.mark.slow
def test_cut_short_right_after_the_start(tmp_path: Path) -> None:
    statuses = [(0.0, "Flying a gait.", EXECUTING | goal_value())]
    page = report_of(tmp_path, Story(still(count=1), statuses, goals=[(0.0, *GOAL)]))
    assert list(page.figures) == ["configurations"]
    assert "The bag contains only one state: there are no figures over time." in page.text
    assert "Momentum drift" not in page.text
    assert "Drag across a chart" not in page.text
    assert "key frames" not in page.text
    assert "Flying a gait. The recording ends before the outcome is known." in page.text


def test_a_cut_flight_has_no_errors_of_its_last_status(tmp_path: Path, blank: None) -> None:
    bag, html = tmp_path / "cut.mcap", tmp_path / "cut.html"
    fly_scenario(load_scenario("coordinated_control"), longest=2.0).save(bag)
    write_report(bag, html)
    text, told = Page(html.read_text(encoding="utf-8")).text, read_run(bag).verdict.sentence
    assert told == "Flying to the goal. The recording ends before the outcome is known."
    assert told in text
    assert "from the reference" not in text


@pytest.mark.slow
def test_a_robot_without_shapes_and_with_odd_names(tmp_path: Path) -> None:
    bare = re.sub(r"<visual>.*?</visual>", "", urdf_of(2), flags=re.DOTALL)
    story = Story(still(2), urdf=bare.replace("joint_", "a$^_ジ$" * 8), name="a$^_ジ$" * 8)
    page = report_of(tmp_path, story)
    assert list(page.figures) == [name for name in FIGURES if name != "errors"]
    assert page.tables["joints"][1][0] == "a$^_ジ$" * 8 + "0"


@pytest.mark.slow
@pytest.mark.usefixtures("blank")
def test_runs_stand_side_by_side(folder: Path, flown: Page, tmp_path: Path) -> None:
    assert flown.figures
    farther = [(0.0, [0.5, *GOAL[0][1:]], GOAL[1])]
    metadata = {"parameters/planner": {"position_tolerance": "0.03"}}
    other = tell(tmp_path / "other.mcap", Story(still(count=3), goals=farther, metadata=metadata))
    write_report(folder / "flight.mcap", tmp_path / "both.html", beside=[other])
    page = Page((tmp_path / "both.html").read_text(encoding="utf-8"))
    (_, *runs), *rows = page.tables["runs"]
    values = {name: each for name, *each in rows}
    assert runs == ["flight", "other"]
    assert values["Recorded"] == [f"{len(cyclic_shapes()) - 1} ticks", "2 ticks"]
    # The second bag does not give the method, which is not the default in the first.
    parameters = [["planner.position_tolerance (m)", "0.02", "0.03"]]
    parameters += [["planner.method", "lie_bracket", "–"]]
    assert page.tables["different"][1:] == parameters
    ((name, here, there),) = page.tables["goals"][1:]
    assert name == "position"
    assert (numbers_in(here)[0], numbers_in(there)[0]) == (GOAL[0][0], 0.5)


def test_picture(tmp_path: Path, folder: Path, flown: Page) -> None:
    assert flown.figures
    png = tmp_path / "deep" / "picture.png"
    write_picture(folder / "flight.mcap", png)
    data = png.read_bytes()
    assert data.startswith(b"\x89PNG")
    assert struct.unpack(">I", data[16:20])[0] == 1000
    assert len(data) < 300_000
    bare = tell(tmp_path / "bare.mcap", Story(still(1), topics=("momentum",)))
    with pytest.raises(SpaceRobotError, match="no base poses"):
        write_picture(bare, png)


def test_refusals(tmp_path: Path) -> None:
    with pytest.raises(RecordingError):
        write_report(tmp_path / "none.mcap", tmp_path / "report.html")
    bag = tell(tmp_path / "flight.mcap", Story(still(1), topics=()))
    with pytest.raises(SpaceRobotError, match="cannot be written"):
        write_report(bag, bag / "report.html")


def test_leaves_the_style_of_others_alone(folder: Path, flown: Page) -> None:
    before = dict(mpl.rcParams)
    assert flown.figures
    with drawing():
        assert isinstance(shape_figure(read_report(folder / "flight.mcap")), ReportFigure)
    assert dict(mpl.rcParams) == before
