"""Findings of `analyze`, plans and flights as lines, from results made by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.command_line import CliRunner

from spacerobot_ros.cli import flights, plan, robots
from spacerobot_ros.cli.main import main
from spacerobot_ros.model.description import JointKind
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.planning.core.workspaces import Workspaces


def workspaces(*rings: tuple[float, float], **given: Any) -> Workspaces:
    wanted: dict[str, Any] = {
        "link": "hand",
        "within_limits": True,
        "distance_range": (0.25, 1.5),
        "path_independent": ((0.0, 0.123456),),
        "path_dependent": rings,
        "dimensions": 2,
        "singular_shapes": 0,
    }
    wanted |= given
    names = (
        "link",
        "within_limits",
        "distance_range",
        "path_dependent",
        "dimensions",
        "singular_shapes",
    )
    made: Any = SimpleNamespace(**{name: wanted[name] for name in names})
    made.path_independent = wanted["path_independent"]
    return made


def lines_of(*each: Workspaces, end_effector: str = "hand") -> list[str]:
    found: Any = SimpleNamespace(workspaces=each, end_effector=end_effector)
    return robots.workspace_lines(found)


def test_workspaces_are_three_lines_each() -> None:
    found = lines_of(
        workspaces((0.3, 0.5), (0.75, 0.75), singular_shapes=12),
        workspaces(within_limits=False, dimensions=3, path_independent=()),
    )
    assert found == [
        "workspaces   'hand', within joint limits: 0.25 to 1.5 m from the centre of mass in a "
        "plane",
        "               path-dependent    0.3 to 0.5 and 0.75 m, from 12 singular shapes",
        "               path-independent  0 to 0.12346 m",
        "             'hand', joints turn freely: 0.25 to 1.5 m from the centre of mass",
        "               path-dependent    none found",
        "               path-independent  none found",
    ]


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (4, "0 to 0.5 and 1 to 1.5 and 2 to 2.5 and 3 to 3.5 m"),
        (5, "5 intervals from 0 to 4.5 m, together 2.5 m"),
    ],
)
def test_many_intervals_are_counted(count: int, text: str) -> None:
    assert robots._intervals_text([(k, k + 0.5) for k in range(count)]) == text


def test_robots_without_workspaces_say_why() -> None:
    assert lines_of() == ["workspaces   none: the robot has no joints"]
    assert lines_of(end_effector="") == [
        "workspaces   none: no link is called 'end_effector': name one with --end-effector"
    ]


def joint(name: str, kind: JointKind, lower: float = -1.0, mimic: Any = None) -> Any:
    limits = SimpleNamespace(lower=lower, upper=2.5, velocity=0.125, effort=12.5)
    return SimpleNamespace(name=name, kind=kind, parent="a" * 20, limits=limits, mimic=mimic)


def rows_of(*joints: Any) -> list[str]:
    body = SimpleNamespace(inertia=SimpleNamespace(mass=1.5))
    description = SimpleNamespace(moving_joints=joints, bodies=[None] + [body] * len(joints))
    robot: Any = SimpleNamespace(description=description)
    return robots._joint_rows(robot)


def test_joints_are_rows() -> None:
    head, slider, free, follower = rows_of(
        joint("a", JointKind.PRISMATIC),
        joint("long_name", JointKind.CONTINUOUS, -math.inf),
        joint("c", JointKind.REVOLUTE, mimic=SimpleNamespace(joint="a")),
    )
    assert head == (
        "joint      kind       on                                limits       speed    effort"
        "        mass"
    )
    assert slider == (
        "a          prismatic  aaaaaaaaaaaaaaaaaaaa         -1 .. 2.5 m   0.125 m/s    12.5 N"
        "      1.5 kg"
    )
    assert free == (
        "long_name  continuous aaaaaaaaaaaaaaaaaaaa                free 0.125 rad/s  12.5 N m"
        "      1.5 kg  7.16 deg/s"
    )
    assert follower.endswith("12.5 N m      1.5 kg  -57.3 .. 143.2 deg  7.16 deg/s  follows a")


def test_joints_beyond_twelve_are_counted() -> None:
    twelve = [joint(f"j{k}", JointKind.REVOLUTE) for k in range(12)]
    assert len(rows_of(*twelve)) == 13
    more = rows_of(*twelve, joint("much_longer_name", JointKind.REVOLUTE))
    assert (len(more), more[-1]) == (14, "and 1 more")
    assert more[0].startswith("joint  kind")


def distances(count: int, exact: bool = True, **ignored: str) -> list[str]:
    pairs = {f"'a' and 'b{k}'": 0.25 * k for k in range(count)}
    geometry = SimpleNamespace(
        distances_of_links=lambda shape: pairs if shape == "shape" else {},
        ignored_pairs=ignored,
        notes=["A note."],
        exact=exact,
    )
    found: Any = SimpleNamespace(geometry=geometry, shape="shape")
    return robots._distance_lines(found)


def test_the_nearest_pairs_of_links_are_listed() -> None:
    assert distances(0, exact=False) == [
        "distances    0 pairs of links may come into contact",
        "             A note.",
    ]
    one = distances(1, exact=False)
    assert one[:2] == [
        "distances    1 pair of links may come into contact, with a distance at this shape of",
        "               0 m  'a' and 'b0'",
    ]
    three = distances(3, c="disabled")
    assert three == [
        "distances    3 pairs of links may come into contact, with distances at this shape of",
        "               0 m  'a' and 'b0'",
        "               0.25 m  'a' and 'b1'",
        "               0.5 m  'a' and 'b2'",
        "             not counted: c (disabled)",
        "             A note.",
    ]
    five = distances(5, exact=False)
    assert five[4:] == [
        "               and more of 2 others",
        "             A note.",
        "             Distances are bounds, since the package coal is not installed.",
    ]


def test_the_position_of_a_base(monkeypatch: pytest.MonkeyPatch) -> None:
    import spacerobot_ros.planning.core.controllability as controllability

    monkeypatch.setattr(controllability, "sliders_of", lambda robot: [1, 2, 3])
    for slides, text in (
        (True, "3 sliders with independent slots put the base where it is to be (paper 1)"),
        (False, "follows from attitude and shape: the centre of mass rests"),
    ):
        sliding = SimpleNamespace(controllable=slides)
        found: Any = SimpleNamespace(robot=None, sliding=sliding)
        assert robots._position_text(found) == text


def test_numbers_that_are_not_finite_are_none() -> None:
    assert [robots._finite_or_none(x) for x in (1.5, math.inf, math.nan)] == [1.5, None, None]
    found: Any = SimpleNamespace(conditions=np.array([1.0, math.inf, 3.0]))
    assert robots._finite_conditions(found) == [1.0, 3.0]
    assert robots._parse_shape("1, 2.5  -3") == [1.0, 2.5, -3.0]


# -- plans ----------------------------------------------------------------------------------------


def test_the_distance_of_a_plan_from_its_goal() -> None:
    error = PoseError(np.array([0.0, 0.0, 0.5]), np.array([0.25, 0.0, 0.0]))
    trial: Any = SimpleNamespace(error=error, controls=frozenset(("attitude", "shape")))
    goal = Goal.checked([0, 0, 0], [0, 0, 0, 1])
    assert plan._distance_from(goal, trial) == "0.25 rad and 0.5 m from the goal"
    hands: Any = SimpleNamespace(end_effectors=(1,))
    assert plan._distance_from(hands, trial) == "0.25 rad from the goal"


def test_the_warning_about_efforts(monkeypatch: pytest.MonkeyPatch) -> None:
    from spacerobot_ros.flight import trials
    from spacerobot_ros.planning.core.method import BEYOND_EFFORT_LIMITS

    class Evaluation:
        def __init__(self) -> None:
            clauses = ("joint a by 3 N m", "", "joint a by 3 N m", "joint b by 2 N")
            self.pieces = [
                SimpleNamespace(notes={BEYOND_EFFORT_LIMITS: clause, "stopped": "It stopped."})
                for clause in clauses
            ]
            self.duration, self.plan_time, self.reached = 1.5, 0.25, False
            self.error = PoseError(np.zeros(3), np.array([0.0, 0.5, 0.0]))

    monkeypatch.setattr(trials, "PlanEvaluation", Evaluation)
    monkeypatch.setattr(trials, "try_method", lambda problem, method: Evaluation())
    words = ["plan", "sliding_masses", "--set", "planner.clearance=0"]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 1
    assert result.stdout.splitlines()[1:] == [
        "planned in 0.250 s",
        "warning     Efforts are beyond limits: joint a by 3 N m.",
        "warning     Efforts are beyond limits: joint b by 2 N.",
    ]
    assert result.stderr == (
        "The goal is not reached within the planner's tolerance: 0.5 rad and 0 m from the goal. "
        "It stopped.\n"
    )


# -- flights --------------------------------------------------------------------------------------


def test_lines_of_end_effectors() -> None:
    found = flights._end_effector_line(
        {
            "end_effectors": {
                "left": {"position_error_m": 0.0123456, "attitude_error_rad": 0.5},
                "right": {"position_error_m": 1.0, "attitude_error_rad": 0.0},
            },
            "position_tolerance_m": 0.02,
            "attitude_tolerance_rad": 0.3,
        }
    )
    assert found == [
        "left: 0.0123 m and 0.5 rad from its goal (tolerance 0.02 m, 0.3 rad)",
        "right: 1 m and 0 rad from its goal (tolerance 0.02 m, 0.3 rad)",
    ]
    assert flights._end_effector_line({}) == []


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["run", "sliding_masses", "--view"],
            "--view needs --realtime: a flight in lockstep is over soon.",
        ),
        (
            ["goal", "1", "2", "3", "--goal-rotvec", *"001", "--goal-rpy-deg", *"001"],
            "The attitude is given twice, in radians and in degrees.",
        ),
        (
            ["goal", "--goal-rotvec", *"001", "--end-effector-position", *"123"],
            "An attitude of the base is sent with its position X Y Z.",
        ),
        (["goal", "1", "2"], "A goal is X Y Z, or X Y Z QX QY QZ QW."),
        (["goal"], "A goal is X Y Z, or X Y Z QX QY QZ QW."),
    ],
)
def test_goals_and_flights_that_are_refused(words: list[str], sentence: str) -> None:
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 2
    assert sentence in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    "words", [("campaign", "fly"), ("campaign", "fly", "a.yaml", "--compare", "b.yaml", "c.yaml")]
)
def test_a_campaign_is_of_one_file_or_two(words: tuple[str, ...]) -> None:
    result = CliRunner().invoke(main, list(words))
    assert result.exit_code == 2
    assert result.stderr == "Give the FILE of a campaign, or two after --compare, not both.\n"
