"""Figures for papers, and pictures by the ends of their names."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pypdf
import pytest
from PIL import Image
from support.command_line import spacerobot
from support.flight_bags import GOAL, Story, tell
from support.html_page import present
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.report import write_figures
from spacerobot_ros.report.figures import (
    PictureFormat,
    ReportFigure,
    TraceGroup,
    angle_unit,
    drawing,
    letter_panels,
    sheet,
)
from spacerobot_ros.report.figures_over_time import (
    figure_of_flights,
    range_without_peaks,
    time_figure,
)
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.writing import FIGURES

MAGIC = {"png": b"\x89PNG", "pdf": b"%PDF-", "svg": b"<?xml"}


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    t = np.linspace(0.0, 1.0, 60)[:, np.newaxis]
    story = Story(np.sin(t * np.arange(1, 4)), goals=[(0.0, *GOAL)])
    return tell(tmp_path_factory.mktemp("paper") / "flight.mcap", story)


@pytest.mark.slow
def test_text_in_a_pdf_can_be_read_and_edited(bag: Path, tmp_path: Path) -> None:
    made = write_figures(bag, tmp_path, ["pose", "joints"], width=120.0)
    assert made == {name: tmp_path / f"{name}.pdf" for name in ("pose", "joints")}
    page = pypdf.PdfReader(tmp_path / "pose.pdf").pages[0]
    text = page.extract_text()
    for label in ("base position (m)", "rotation vector (rad)", "time (s)"):
        assert label in text
    assert float(page.mediabox.width) == pytest.approx(120.0 / 25.4 * 72, abs=0.01)
    fonts: Any = page["/Resources"]["/Font"]  # type: ignore[index]
    # TrueType in the PDF's own sense: Type 3 fonts are shapes, which editors cannot change.
    kinds = {fonts[name]["/Subtype"] for name in fonts}
    assert kinds == {"/Type0"}
    assert "joint_0" in pypdf.PdfReader(tmp_path / "joints.pdf").pages[0].extract_text()


def test_text_in_an_svg_is_text_of_the_size_of_a_style_file(bag: Path, tmp_path: Path) -> None:
    style = tmp_path / "own.mplstyle"
    style.write_text("font.size: 11\naxes.labelsize: 11\nfont.family: serif\n")
    sizes = {}
    for name, own in (("shipped", None), ("own", style)):
        write_figures(bag, tmp_path / name, ["pose"], format=PictureFormat.SVG, style=own)
        text = (tmp_path / name / "pose.svg").read_text("utf-8")
        (label,) = re.findall(r"<text ([^>]*)>base position \(m\)</text>", text)
        size = re.search(r"([\d.]+)px", label)
        assert size is not None
        sizes[name] = float(size[1])
        assert f'width="{88 / 25.4 * 72:.6f}' in text
        assert ("serif" in label) == (name == "own")
    assert sizes == {"shipped": 7.0, "own": 11.0}


@pytest.mark.slow
def test_all_figures_of_a_bag_by_the_command(bag: Path, tmp_path: Path) -> None:
    words = ["figures", str(bag), "--format", "png", "--width", "3.5in", "--out", str(tmp_path)]
    spacerobot(*words)
    names = {path.stem for path in tmp_path.iterdir()}
    assert names >= {"robot", "pose", "joints", "velocities", "momentum", "path"}
    assert not names & {"position", "attitude", "efforts"}
    assert all(path.read_bytes().startswith(MAGIC["png"]) for path in tmp_path.iterdir())
    words = ["figures", str(bag), "--only", "efforts", "-o", str(tmp_path)]
    asked = spacerobot(*words, code=1)
    assert_one_sentence(asked.stderr, "efforts", "none")


def test_two_flights_are_drawn_into_the_same_panels(tmp_path: Path) -> None:
    """Each line is one of the motions that the bags tell, the shorter one over its own time."""
    t = np.linspace(0.0, 3.0, 60)
    motions = [
        0.4 * np.sin(np.outer(t, [1.0, 2.0, 3.0])),
        0.3 * np.cos(np.outer(t[:40], [3.0, 1.0, 2.0])),
    ]
    bags = [tell(tmp_path / f"{n}.mcap", Story(x)) for n, x in zip("ab", motions, strict=True)]
    with drawing():
        flights = [read_report(bag) for bag in bags]
        figure = figure_of_flights(flights, [FIGURES["joints"](each) for each in flights])
    assert isinstance(figure, ReportFigure)
    sliders, hinges = figure.figure.axes
    for axes, joints in ((sliders, [0]), (hinges, [1, 2])):
        lines = [line for line in axes.get_lines() if len(line.get_path()) > 2]
        expected = [(motion[:, i], k) for k, motion in enumerate(motions) for i in joints]
        for line, (values, number) in zip(lines, expected, strict=True):
            time = 0.05 * np.arange(len(values))
            x, y = (np.asarray(each, float) for each in line.get_data())
            assert (x[0], x[-1]) == pytest.approx((0.0, time[-1]))
            np.testing.assert_allclose(np.interp(time, x, y), values, atol=2e-3)
            assert (line.get_linestyle() == "-") == (number == 0)
        assert axes.get_xlim() == pytest.approx((0.0, 0.05 * 59))
    (legend,) = figure.figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b"]


def test_tolerances_of_all_flights_are_drawn(bag: Path) -> None:
    falling = Signal(np.linspace(0.0, 3.0, 60), np.geomspace(1.0, 1e-3, 60)[:, np.newaxis])
    with drawing():
        flight = read_report(bag)
        group = TraceGroup(falling, ["d"], "distance", "m", limit_name="tolerance", decades=4)
        groups = [replace(group, limits=[(0, most)]) for most in (0.05, 0.05, 0.002)]
        drawn = [time_figure(flight, "errors", "Errors", "Errors", [each]) for each in groups]
        figure = figure_of_flights([flight] * 3, drawn)
    assert isinstance(figure, ReportFigure)
    heights = [np.unique(line.get_ydata()) for line in figure.figure.axes[0].get_lines()]
    assert sorted(float(y[0]) for y in heights if len(y) == 1) == [0.002, 0.05]


def test_figures_of_several_bags_by_the_command(bag: Path, tmp_path: Path) -> None:
    other = tell(tmp_path / "other.mcap", Story(np.zeros((30, 3))))
    names = "pose,path,robot,momentum"
    words = ["figures", str(bag), str(other), "--format", "svg", "--only", names]
    result = spacerobot(*words, "--out", tmp_path / "out", code=1)
    assert_one_sentence(
        result.stderr, "robot", "none: This figure shows a single flight: specify one bag"
    )
    for name in ("pose", "path", "momentum"):
        text = (tmp_path / "out" / f"{name}.svg").read_text("utf-8")
        for label in ("flight", "other"):
            assert f">{label}</text>" in text


def test_help_and_documents_name_every_figure() -> None:
    text = " ".join(spacerobot("figures", "--help").stdout.split())
    known = list(FIGURES)
    assert f"Available: {', '.join(known[:-1])} and {known[-1]}." in text
    page = (Path(__file__).parents[2] / "docs" / "report.md").read_text("utf-8")
    (row,) = (line for line in page.splitlines() if line.startswith("| `--only` |"))
    assert re.findall(r"`(\w+)`", row) == known


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--only", "pose,magic"), "magic"),
        (("--width", "wide"), "'wide'"),
        (("--width", "2mm"), "2 mm"),
        (("--style", "nowhere.mplstyle"), "nowhere.mplstyle"),
        (("--width", "nan"), "'nan'"),
        (("--only", "joint"), "Did you mean 'joints'?"),
        (("--out", "pose.pdf"), "'pose.pdf'"),
    ],
)
def test_what_is_refused_is_named(
    words: tuple[str, ...], named: str, bag: Path, tmp_path: Path
) -> None:
    result = spacerobot("figures", bag, "-o", tmp_path / "x", *words, code=2)
    assert named in result.stderr
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("content", "mention"),
    [
        ("font.size large\n", "is refused"),
        ("no.such.key: 1\n", "is refused"),
        ("font.size: red\n", "is refused"),
        ("font.size: 0\n", "font.size is 0"),
        ("font.size: nan\n", "font.size is nan"),
        ("text.usetex: True\n", "text.usetex"),
        ("font.family: Nowhere Sans\n", "none of its fonts (Nowhere Sans) is installed"),
        ("figure.subplot.left: 2\nlines.dashed_pattern: 0, 0\n", "Figures cannot be drawn"),
    ],
)
def test_a_style_file_with_a_mistake_is_one_sentence(
    content: str, mention: str, bag: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    style = tmp_path / "own.mplstyle"
    style.write_text(content)
    with pytest.raises(SpaceRobotError, match="style file") as refused:
        write_figures(bag, tmp_path / "x", ["pose"], style=style, width=40.0)
    assert_one_sentence(str(refused.value), mention, str(style))
    assert not (tmp_path / "x").exists()
    assert not caplog.records


def test_a_style_changes_neither_the_width_nor_who_places_the_panels(
    bag: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    style = tmp_path / "own.mplstyle"
    style.write_text(
        "savefig.bbox: tight\nfigure.autolayout: True\nfigure.constrained_layout.use: True\n"
        "font.family: Nowhere Sans, DejaVu Serif\ntext.parse_math: True\n"
    )
    write_figures(bag, tmp_path, ["pose"], width=100.0, style=style)
    page = pypdf.PdfReader(tmp_path / "pose.pdf").pages[0]
    assert float(page.mediabox.width) == pytest.approx(100.0 / 25.4 * 72, abs=0.01)
    fonts: Any = page["/Resources"]["/Font"]  # type: ignore[index]
    assert all("DejaVuSerif" in fonts[name]["/BaseFont"] for name in fonts)
    # A font that is not there is passed over without a line for each letter.
    assert not caplog.records


def test_signs_that_a_font_lacks_are_those_of_another(bag: Path, tmp_path: Path) -> None:
    """STIXGeneral, which comes with matplotlib, has no superscript minus: 10⁻¹⁵."""
    style = tmp_path / "own.mplstyle"
    style.write_text("font.family: STIXGeneral\n")
    write_figures(bag, tmp_path, ["momentum"], style=style)
    page = pypdf.PdfReader(tmp_path / "momentum.pdf").pages[0]
    found: Any = page["/Resources"]["/Font"]  # type: ignore[index]
    fonts = {found[name]["/BaseFont"].partition("+")[2] for name in found}
    assert {"STIXGeneral-Regular", "DejaVuSans"} == fonts, "no boxes in the place of signs"
    assert re.search("10⁻¹[0-9⁰¹²³⁴⁵⁶⁷⁸⁹]", page.extract_text())


def test_a_style_of_matplotlib_is_known_by_its_name(bag: Path, tmp_path: Path) -> None:
    """ggplot has ticks and axes in white and grey on its own grey."""
    write_figures(bag, tmp_path, ["pose"], format=PictureFormat.SVG, style=Path("ggplot"))
    assert "#e5e5e5" in (tmp_path / "pose.svg").read_text("utf-8").lower()


def test_a_bag_without_a_flight_has_no_figures_and_says_so(tmp_path: Path) -> None:
    bag = tell(tmp_path / "bare.mcap", Story(np.zeros((2, 1)), topics=()))
    result = spacerobot("figures", bag, code=1)
    assert result.stdout == ""
    lines = result.stderr.splitlines()
    assert len(lines) > 10
    assert all("none: " in line and line.endswith(".") for line in lines)
    assert "pose        none: The bag contains no base poses (odom)" in result.stderr
    assert list(tmp_path.iterdir()) == [bag]


def test_letters_leave_room_for_panels(bag: Path, tmp_path: Path) -> None:
    style = tmp_path / "own.mplstyle"
    style.write_text("font.size: 29\n")
    with pytest.raises(SpaceRobotError, match="no room for the panels in a figure 40 mm wide"):
        write_figures(bag, tmp_path, ["pose"], style=style, width=40.0)


def test_what_is_made_stands_beside_a_bag_that_is_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As ``ros2 bag record`` makes it: a folder with a file, whose name may have dots."""
    folder = tmp_path / "Flug 22.11"
    folder.mkdir()
    bag = tell(folder / "flight_0.mcap", Story(np.zeros((3, 1)), urdf=None, topics=("odom",)))
    before = bag.read_bytes()
    monkeypatch.chdir(folder)
    words = ["figures", ".", "--only", " Pose ,", "--format", "SVG", "--width", "3.5IN"]
    spacerobot(*words)
    assert (tmp_path / "Flug 22.11_figures" / "pose.svg").is_file()
    spacerobot("report", ".")
    assert (tmp_path / "Flug 22.11.html").is_file()
    # The one record of a flight is not taken for an older report.
    result = spacerobot("report", ".", "-o", "flight_0.mcap", code=2)
    assert_one_sentence(result.stderr, "flight_0.mcap", "is a bag")
    assert bag.read_bytes() == before


COMMANDS = {
    "plan": ["plan", "planar_chain"],
    "analyze": ["analyze", "planar_chain"],
    "report": ["report"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_picture_of_another_kind_is_refused_before_anything_is_done(
    command: str, bag: Path, tmp_path: Path
) -> None:
    words = [*COMMANDS[command], *([str(bag)] if command == "report" else [])]
    result = spacerobot(*words, "--picture", tmp_path / "a.jpg", code=2)
    assert_one_sentence(result.stderr, ".png, .svg or .pdf", "a.jpg")
    assert list(tmp_path.iterdir()) == []
    assert not bag.with_suffix(".html").exists()


@pytest.mark.parametrize(
    ("command", "kind"),
    [
        pytest.param("plan", "pdf", marks=pytest.mark.slow),
        ("analyze", "svg"),
        pytest.param("report", "pdf", marks=pytest.mark.slow),
    ],
)
def test_a_picture_is_what_its_name_says(
    command: str, kind: str, bag: Path, tmp_path: Path
) -> None:
    page = ["-o", str(tmp_path / "a.html")]
    words = [*COMMANDS[command], *([str(bag), *page] if command == "report" else [])]
    picture = tmp_path / f"deep/a.{kind}"
    spacerobot(*words, "--picture", picture)
    data = picture.read_bytes()
    assert data.startswith(MAGIC[kind])
    if kind == "pdf":
        label = {"plan": "time (s)", "report": "base position (m)"}[command]
        assert label in pypdf.PdfReader(picture).pages[0].extract_text()


def test_an_axis_is_for_what_can_be_read_beside_a_peak() -> None:
    time = np.linspace(0.0, 10.0, 1001)
    calm = np.sin(time)
    peaked = calm + 70.0 * np.exp(-time / 0.01)
    assert range_without_peaks(Signal(time, calm[:, np.newaxis])) is None
    window = present(range_without_peaks(Signal(time, peaked[:, np.newaxis])))
    assert window[0] == pytest.approx(-1.0, abs=0.01)
    assert 1.0 < window[1] < 2.0
    # A flight that is mostly rest has no peaks: what happens is what is to be seen.
    resting = np.where(np.abs(time - 5.0) < 0.05, 1.0, 1e-9 * calm)
    assert range_without_peaks(Signal(time, resting[:, np.newaxis])) is None
    assert range_without_peaks(Signal(time[:0], np.empty((0, 1)))) is None


def test_angles_of_a_paper_are_in_degrees_if_asked_and_panels_have_letters(
    bag: Path, tmp_path: Path
) -> None:
    texts = {}
    for name, words in (("rad", ()), ("deg", ("--degrees", "--style", "serif"))):
        out = tmp_path / name
        command = ["figures", str(bag), "--only", "pose", "--format", "svg", "-o", str(out), *words]
        spacerobot(*command)
        texts[name] = (out / "pose.svg").read_text("utf-8")
    for name, text in texts.items():
        assert f">rotation vector ({name})<" in text
        assert re.findall(r">\(([a-z])\)<", text) == ["a", "b"]
        assert ("STIXGeneral" in text) == (name == "deg")


def test_traces_in_degrees_have_goals_limits_and_window_in_degrees() -> None:
    time = np.array([0.0, 1.0])
    radian = Signal(time, np.array([[0.1], [np.pi]]))
    goals, limits = [(0.0, 1.0, 0, np.pi / 2)], [(0, np.pi / 6)]
    group = TraceGroup(radian, ["a"], "rate", "rad/s", ["red"], goals, limits, window=(-np.pi, 1.0))
    metre = TraceGroup(radian, ["a"], "way", "m", ["red"], goals)
    assert group.in_unit_of_angles() is group
    with drawing(degrees=True):
        found = group.in_unit_of_angles()
        assert metre.in_unit_of_angles() is metre
        assert replace(group, window=None).in_unit_of_angles().window is None
        assert angle_unit()[0] == pytest.approx(57.29578)
    assert angle_unit()[0] == 1.0
    assert found.unit == "deg/s"
    np.testing.assert_allclose(found.signal.values, [[5.729578], [180.0]], rtol=1e-6)
    assert found.signal.time is time
    np.testing.assert_allclose(found.goals, [[0.0, 1.0, 0, 90.0]])
    np.testing.assert_allclose(found.limits, [[0, 30.0]])
    np.testing.assert_allclose(found.window or (), [-180.0, 57.29578], rtol=1e-6)


def test_panels_have_letters_if_there_are_several() -> None:
    def titles(rows: list[list[float]]) -> list[str]:
        with drawing():
            figure, panels = sheet(rows, [1.0] * len(rows))
            panels[0][0].set_title("first")
            letter_panels(figure)
            return [axes.get_title("left") for axes in figure.axes]

    assert titles([[1.0, 2.0], [1.0, 2.0]]) == ["(a) first", "(b)", "(c)", "(d)"]
    assert titles([[1.0]]) == ["first"]


def test_panels_of_a_column_reach_its_left_edge(tmp_path: Path) -> None:
    """Ink, as Pillow sees it, begins near the left edge of every figure, and not on it."""
    words = ("--only", "attitude,joints,cycles", "--style", "serif", "--degrees")
    for width, bag in (("88mm", "arm_attitude"), ("120mm", "sliding_masses")):
        out = tmp_path / width
        source = str(Path(__file__).parents[2] / "bags" / f"{bag}.mcap")
        options = ("--width", width, "--format", "png", "--out", str(out))
        result = spacerobot("figures", source, *words, *options, code=None)
        assert result.exit_code in (0, 1), result.output
        drawn = sorted(out.glob("*.png"))
        assert drawn
        for path in drawn:
            with Image.open(path) as picture:
                ink = np.asarray(picture.convert("L")) < 128
            first = float(np.argmax(ink.any(axis=0))) / ink.shape[1]
            assert 0.0005 < first < 0.04, (path.name, first)


@pytest.mark.slow
def test_keys_of_events_and_traces_end_before_the_right_edge(tmp_path: Path) -> None:
    source = str(Path(__file__).parents[2] / "bags" / "servicing.mcap")
    words = ("--events", "--format", "png", "--only", "joints,momentum,robot", "-o", str(tmp_path))
    spacerobot("figures", source, *words)
    for path in tmp_path.glob("*.png"):
        with Image.open(path) as picture:
            ink = np.asarray(picture.convert("L")) < 200
        assert not ink[:, -3:].any(), path.name
