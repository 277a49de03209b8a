"""Control laws, gait methods and metrics of users: by installed packages, files, and in scripts."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from support.campaigns import campaign
from support.command_line import finished
from support.sentences import assert_one_sentence

from spacerobot_ros import fly
from spacerobot_ros.campaign.dataset import Dataset
from spacerobot_ros.campaign.metrics import OWN_METRICS
from spacerobot_ros.campaign.report import write_campaign_report
from spacerobot_ros.campaign.running import rerun_flight, run_campaign
from spacerobot_ros.control import ControlState, Reference
from spacerobot_ros.control.laws.numpy_law import NumpyLaw
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw
from spacerobot_ros.errors import ParameterError, PlanningError, SpaceRobotError
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.methods.registry import METHODS
from spacerobot_ros.registry import PLUGINS_VARIABLE, add_plugin

EXAMPLES = Path(__file__).parents[1] / "examples"

_ENTRY_POINTS = """
[spacerobot_ros.control_laws]
lqr = strangers.law:LqrLaw
lost = strangers.nowhere:Law
transposed_jacobian = strangers.law:Clash
[spacerobot_ros.gait_methods]
stow = strangers.method:StowGait
"""


def _run(words: list[str], folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return finished(
        [sys.executable, "-m", "spacerobot_ros", *words],
        cwd=folder,
        env=os.environ | environment,
        timeout=300,
    )


def _poses(bag: Path) -> list[tuple[list[float], list[float]]]:
    found = []
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        connections = [c for c in reader.connections if c.topic == "/base_pose"]
        for connection, _, data in reader.messages(connections):
            message: Any = reader.deserialize(data, connection.msgtype)
            p, o = message.pose.position, message.pose.orientation
            found.append(([p.x, p.y, p.z], [o.x, o.y, o.z, o.w]))
    return found


def _last_pose(bag: Path) -> tuple[list[float], list[float]]:
    return _poses(bag)[-1]


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """Return a folder with an installed package that has laws and a method."""
    package = tmp_path / "site" / "strangers"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    shutil.copy(EXAMPLES / "lqr_law.py", package / "law.py")
    shutil.copy(EXAMPLES / "own_gait_method.py", package / "method.py")
    clash = "\n\nclass Clash(LqrLaw):\n    name = 'transposed_jacobian'\n"
    (package / "law.py").write_text((package / "law.py").read_text() + clash)
    information = tmp_path / "site" / "strangers-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: strangers\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(_ENTRY_POINTS)
    return tmp_path / "site"


@pytest.mark.slow
def test_a_law_of_an_installed_package_flies_by_its_name(tmp_path: Path, installed: Path) -> None:
    """A robot alone has a controller then; entry points that are refused end no flight."""
    words = ["run", "servicer_thrusters", "--method", "lqr"]
    path = os.pathsep.join([str(installed), *sys.path])
    refused = _run(words, tmp_path, PYTHONPATH=path)
    assert refused.returncode == 1
    assert "The law 'lqr' does not control the end-effector" in refused.stderr

    words = ["run", "planar_manipulator", "--method", "lqr", "--set", "plant.tick_rate=50"]
    words += ["--set", "coordinated_control.lqr.response_time=1.0"]
    goal = [0.3, -0.2, 0.0, 0.0, 0.0, 0.3826834323650898, 0.9238795325112867]
    flown = _run([*words, "--goal", *map(str, goal), "--json", "-"], tmp_path, PYTHONPATH=path)
    assert flown.returncode == 0, flown.stderr
    assert flown.stderr.count("It is omitted.") == 2
    assert "'lost = strangers.nowhere:Law' of the package 'strangers' cannot be" in flown.stderr
    assert "has the same name as the package's own 'transposed_jacobian'" in flown.stderr
    result = json.loads(flown.stdout)
    assert result["method"] == "lqr"
    position, quaternion = _last_pose(tmp_path / result["bag"])
    np.testing.assert_allclose(position, goal[:3], atol=1e-3)
    assert abs(np.dot(quaternion, goal[3:])) > np.cos(1e-3 / 2)


@pytest.mark.slow
def test_a_plugin_flies_by_nodes_and_in_the_workers_of_a_campaign(tmp_path: Path) -> None:
    plugin = ["--plugin", str(EXAMPLES / "own_control_law.py")]
    words = ["run", "coordinated_control", "--method", "soft"]
    by_loop = _run([*plugin, *words, "--bag", "loop.mcap"], tmp_path)
    both = os.pathsep.join(str(EXAMPLES / f"{name}.py") for name in ("lqr_law", "own_control_law"))
    by_nodes = _run([*words, "--bag", "nodes.mcap", "--nodes"], tmp_path, SPACEROBOT_PLUGINS=both)
    assert (by_loop.returncode, by_nodes.returncode) == (0, 0), by_nodes.stderr
    assert _last_pose(tmp_path / "loop.mcap") == _last_pose(tmp_path / "nodes.mcap")

    campaign = tmp_path / "two.yaml"
    campaign.write_text(
        "campaign:\n  scenario: coordinated_control\n  flights: 3\n  engine: flights\n"
        "  method: soft\n  disperse:\n"
        "    coordinated_control.soft.reach: {uniform: [0.1, 0.3]}\n"
    )
    flown = _run([*plugin, "campaign", "fly", str(campaign), "--workers", "2"], tmp_path)
    assert flown.returncode == 0, flown.stderr
    assert "3 of 3" in flown.stdout


class _Plain(NumpyLaw):
    """A law that lacks its command."""

    name = "plain"


class _Unnamed(TransposedJacobianLaw):
    name = "two words"


class _Clash(TransposedJacobianLaw):
    pass


class _Mapped(TransposedJacobianLaw):
    name = "mapped"
    Options = dict


@dataclass(frozen=True)
class _OptionsWithoutDefault:
    reach: float


class _Open(TransposedJacobianLaw):
    name = "open"
    Options = _OptionsWithoutDefault


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        (_Plain, "The control law '_Plain' lacks compute."),
        (_Unnamed, "needs a name of letters, digits and underscores"),
        (_Clash, "has the same name as the package's own 'transposed_jacobian'"),
        (_Mapped, "'_Mapped' needs Options that are a dataclass with defaults"),
        (_Open, "'_Open' needs Options that are a dataclass with defaults: .*'reach'"),
        (METHODS["optimal"], "'OptimalGait' is not a class derived from ControlLaw."),
        ("lqr", "'lqr' is not a class derived from ControlLaw."),
    ],
)
def test_a_class_that_is_no_law_is_refused(entry: Any, sentence: str) -> None:
    before = dict(LAWS)
    with pytest.raises(ParameterError, match=sentence):
        LAWS.register(entry)
    assert before == LAWS


@pytest.fixture
def plugins(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Leave the registries and the environment as they were."""
    monkeypatch.setenv(PLUGINS_VARIABLE, "")
    registries: tuple[dict[str, Any], ...] = LAWS, METHODS, OWN_METRICS
    before = [dict(each) for each in registries]
    yield
    for each, entries in zip(registries, before, strict=True):
        each.clear()
        each.update(entries)


@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("law.py", "import nowhere_at_all", "cannot be imported: ModuleNotFoundError: No module"),
        ("law.py", "def f(:", "cannot be imported: SyntaxError"),
        ("law.txt", "", "its name must end in .py"),
        ("law.py", None, "cannot be imported: FileNotFoundError"),
    ],
)
def test_a_plugin_that_is_none_is_refused(
    tmp_path: Path, name: str, text: str | None, sentence: str
) -> None:
    file = tmp_path / name
    if text is not None:
        file.write_text(text)
    with pytest.raises(ParameterError, match=f"^The plugin '{file}' .*{sentence}"):
        add_plugin(file)


_LAW = """
from spacerobot_ros.control.laws.numpy_law import NumpyLaw
class {}({}):
    name = "pd"
"""
_COMPUTE = "    def compute(self, state, reference):\n        {}\n"


@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            _LAW.format("Pd", "NumpyLaw") + "    compute = 5\n",
            "The control law 'Pd' lacks compute.",
        ),
        (
            _LAW.format("Pd", "object") + _COMPUTE.format("return 1"),
            "The class 'Pd' of the plugin .* is neither a control law nor a gait method: derive",
        ),
    ],
)
def test_a_plugin_whose_law_cannot_work_is_refused(
    tmp_path: Path, text: str, sentence: str
) -> None:
    (tmp_path / "mine.py").write_text(text)
    for _ in range(2):  # Also once it is imported.
        with pytest.raises(ParameterError, match=sentence) as refused:
            add_plugin(tmp_path / "mine.py")
        assert_one_sentence(str(refused.value))


@pytest.mark.usefixtures("plugins")
def test_a_class_moves_from_a_session_to_a_file(tmp_path: Path) -> None:
    text = _LAW.format("Pd", "NumpyLaw") + _COMPUTE.format("return None")
    session: dict[str, Any] = {"__name__": "__main__"}
    exec(text, session)
    LAWS.register(session["Pd"])
    (tmp_path / "mine.py").write_text(text)
    add_plugin(tmp_path / "mine.py")
    assert LAWS["pd"] is not session["Pd"]
    with pytest.raises(ParameterError, match="Two classes define the control law 'pd'"):
        LAWS.register(session["Pd"])


@pytest.mark.usefixtures("plugins")
def test_two_plugins_of_one_name_are_refused_with_their_files(tmp_path: Path) -> None:
    text = _LAW.format("Pd", "NumpyLaw") + _COMPUTE.format("return None")
    for name in ("one.py", "other.py"):
        (tmp_path / name).write_text(text)
    add_plugin(tmp_path / "one.py")
    add_plugin(tmp_path / "one.py")
    with pytest.raises(ParameterError, match="Two classes define the control law 'pd'") as refused:
        add_plugin(tmp_path / "other.py")
    for name in ("one.py", "other.py"):
        assert f"'{tmp_path / name}'" in str(refused.value)


@pytest.mark.usefixtures("plugins")
def test_a_name_that_is_none_is_answered_with_those_there_are() -> None:
    with pytest.raises(ParameterError, match=r"no gait method or control law 'pd'. .*computed_tor"):
        fly("coordinated_control", method="pd")


@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize("ends", ["raise OSError('no model')", "sys.exit(3)"])
def test_a_law_that_fails_or_ends_python_is_named(tmp_path: Path, ends: str) -> None:
    body = f"import sys; {ends}"
    (tmp_path / "mine.py").write_text(_LAW.format("Pd", "NumpyLaw") + _COMPUTE.format(body))
    add_plugin(tmp_path / "mine.py")
    with pytest.raises(SpaceRobotError, match=r"^The law 'pd' has failed at 0 s: .*mine\.py, line"):
        fly("planar_manipulator", (0.1, 0.0, 0.0), method="pd")


@pytest.mark.usefixtures("plugins")
def test_a_plugin_adds_what_it_defines_and_not_what_it_imports(tmp_path: Path) -> None:
    for name in ("lqr_law.py", "own_gait_method.py"):
        add_plugin(EXAMPLES / name)
    assert list(LAWS) == ["transposed_jacobian", "model_based", "computed_torque", "lqr"]
    assert METHODS["stow"].controls == {"shape"}
    assert os.environ[PLUGINS_VARIABLE].split(os.pathsep) == [
        str(EXAMPLES / "lqr_law.py"),
        str(EXAMPLES / "own_gait_method.py"),
    ]


@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize(
    ("member", "sentence"),
    [
        ({"controls": frozenset({"shpae"})}, "controls 'shpae', but goals have only position"),
        ({"plan": lambda *given: None}, "The method 'mine' returned no GaitSchedule"),
    ],
)
def test_a_method_whose_plan_cannot_be_judged_flies_no_goal(
    member: dict[str, Any], sentence: str
) -> None:
    add_plugin(EXAMPLES / "own_gait_method.py")
    METHODS.register(type("Mine", (METHODS["stow"],), {"name": "mine", **member}))
    goal = Goal(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.1, -0.2, 0.3]))
    with pytest.raises(PlanningError, match=sentence):
        fly("three_joint_arm", goal, method="mine")


_METRIC = """
import numpy as np

from spacerobot_ros.campaign.metrics import FlightMetric


class Farthest(FlightMetric):
    name = "farthest_m"
    unit = "m"

    def evaluate(self, flight):
        return np.linalg.norm(flight.pose[:, :3] - flight.pose[0, :3], axis=1).max()
"""


@pytest.mark.usefixtures("plugins")
def test_a_metric_of_a_plugin_is_measured_and_required(tmp_path: Path) -> None:
    """The number is that of the flight's bag as another library reads it."""
    with pytest.raises(ParameterError, match=r"no metric 'farthest_m'.*and metrics from --plugin"):
        campaign(metrics=["farthest_m"])
    (tmp_path / "farthest.py").write_text(_METRIC)
    add_plugin(tmp_path / "farthest.py")
    drawn = {"goal.position.x": {"choice": [0.0, 0.02]}}
    given = {"flights": 2, "disperse": drawn, "sampler": "latin_hypercube"}
    run_campaign(campaign(**given, metrics=["farthest_m"]), tmp_path / "made")
    found = Dataset(tmp_path / "made").table().to_pylist()
    assert [(row["passed"], row["engine"]) for row in found] == [(True, "flights")] * 2
    for row in found:
        bag = tmp_path / f"{row['flight']}.mcap"
        assert rerun_flight(tmp_path / "made", row["flight"], bag).agrees
        positions = np.array([position for position, _ in _poses(bag)])
        farthest = max(np.linalg.norm(positions - positions[0], axis=1))
        assert row["farthest_m"] == pytest.approx(farthest, rel=1e-12)
    low, high = sorted(row["farthest_m"] for row in found)
    write_campaign_report(tmp_path / "made", tmp_path / "page.html")
    mean = f"farthest_m</th><td>{low:.4g}</td>"
    assert mean in (tmp_path / "page.html").read_text("utf-8")
    assert high > 1.1 * low
    bounds = {"farthest_m": {"max": 0.5 * (low + high)}}
    run_campaign(campaign(**given, criteria=bounds), tmp_path / "bounded")
    table = Dataset(tmp_path / "bounded").table(["passed", "farthest_m"]).to_pylist()
    assert sorted((row["farthest_m"], row["passed"]) for row in table) == [
        (low, True),
        (high, False),
    ]
    with pytest.raises(SpaceRobotError, match="the metric 'farthest_m' requires whole flights"):
        run_campaign(campaign(**given, criteria=bounds), tmp_path / "lanes", engine="lanes")


@pytest.mark.usefixtures("plugins")
def test_a_metric_that_fails_is_named_and_takes_no_name_of_the_package(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(_METRIC.replace("flight.pose[:, :3]", "flight.nowhere"))
    add_plugin(tmp_path / "bad.py")
    run_campaign(campaign(flights=1, metrics=["farthest_m"]), tmp_path / "made")
    (row,) = Dataset(tmp_path / "made").table().to_pylist()
    sentence = "The metric 'farthest_m' cannot be computed: AttributeError: 'Flight'"
    assert row["outcome"] == "error"
    assert row["reason"].startswith(sentence)
    (tmp_path / "clash.py").write_text(_METRIC.replace("farthest_m", "duration_s"))
    with pytest.raises(ParameterError, match="has the same name as the package's own 'duration_s'"):
        add_plugin(tmp_path / "clash.py")


class _Told(NumpyLaw):
    """A law that returns what it is told to."""

    name = "told"
    answer: Any = None

    def compute(self, state: ControlState, reference: Reference) -> Any:
        return self.answer


@pytest.mark.usefixtures("plugins")
@pytest.mark.parametrize(
    "answer",
    [
        None,
        (np.zeros(6), np.zeros(1)),
        (np.zeros((6, 1)), np.zeros(2)),
        (np.full(6, np.nan), np.zeros(2)),
        (np.zeros(6), ["a", "b"]),
        (np.zeros(6), [0.0, np.inf]),
    ],
)
def test_a_law_that_returns_no_command_is_named(
    answer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_Told, "answer", answer)
    with pytest.raises(SpaceRobotError) as refused:
        fly("planar_manipulator", (0.1, 0.0, 0.0), law=_Told)
    assert_one_sentence(str(refused.value), "The law 'told' returned", "with 6 and 2 finite")


@pytest.mark.usefixtures("plugins")
def test_a_law_that_cannot_be_built_is_named() -> None:
    class Narrow(_Told):
        name = "narrow"

        def __init__(self, robot: Any) -> None:
            super().__init__(robot)  # type: ignore[call-arg]

    with pytest.raises(SpaceRobotError, match="The control law 'narrow' cannot be built: TypeErr"):
        fly("planar_manipulator", (0.1, 0.0, 0.0), law=Narrow)


def test_a_node_names_a_plugin_that_is_not_there(tmp_path: Path) -> None:
    done = finished(
        [sys.executable, EXAMPLES.parent / "scripts" / "coordinated_control"],
        cwd=tmp_path,
        env=os.environ | {PLUGINS_VARIABLE: "nowhere.py"},
        timeout=120,
    )
    assert done.returncode == 2
    assert_one_sentence(done.stderr.strip(), f"The plugin '{tmp_path}/nowhere.py' cannot be")
