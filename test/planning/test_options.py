"""Goals and options of the gait methods: what they are, and what is refused by name."""

from __future__ import annotations

import inspect
import itertools
import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from rclpy.parameter import Parameter as RosParameter
from support.effort_flights import robot_of
from support.planner_loop import robot_of as looped_robot

from spacerobot_ros.errors import GoalError, ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.nodes.common.ros_parameters import typed
from spacerobot_ros.parameters import Parameter, configured, declared
from spacerobot_ros.planning import METHODS, Goal, PoseError, RobotState, Tolerance, plan
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.optimal.held_commands import LimitedEfforts
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits, OptimalOptions
from spacerobot_ros.planning.methods.square_path import PlanarPhase
from spacerobot_ros.resources import robot_file, share_directory

PARTS: tuple[str, ...] = ("position", "attitude", "shape")


@pytest.mark.parametrize("part", PARTS)
def test_each_part_of_a_goal_has_a_tolerance_of_its_own(part: str) -> None:
    """It counts where it is controlled, and whether the other parts are or not."""
    controlled = [set(each) for k in range(4) for each in itertools.combinations(PARTS, k)]
    # Each tolerance is once the smallest, once in the middle, once the largest of the three.
    for turn in range(3):
        values = np.roll([1e-3, 4e-3, 16e-3], turn)
        tolerance = Tolerance(**dict(zip(PARTS, values.tolist(), strict=True)))
        for share, controls in itertools.product((0.99, 1.01), controlled):
            by = share * getattr(tolerance, part)
            error = {name: by * np.array([0.0, 0.0, name == part]) for name in PARTS}
            remaining = PoseError(error["position"], error["attitude"], error["shape"])
            parts: Any = frozenset(controls)
            admitted = share < 1 or part not in controls
            assert tolerance.admits(remaining, parts) is admitted, (tolerance, share, controls)


def test_errors_of_a_goal_are_those_of_base_and_joints() -> None:
    goal = Goal.checked([1, 0, 0], quaternion_from_rotvec([0, 0, 0.2]), [0.5, -0.5])
    here = np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
    error = PoseError.between(*here, goal, np.array([0.5, -0.4]))
    found = error.distance, error.angle, error.max_joint_error
    assert found == pytest.approx((1.0, 0.2, 0.1))
    # Without a shape in the goal, or measured, no joint is wrong.
    assert PoseError.between(*here, goal).max_joint_error == 0.0
    unshaped = replace(goal, joint_positions=None)
    assert PoseError.between(*here, unshaped, np.ones(2)).max_joint_error == 0.0
    assert not Tolerance(0.5, 0.21).admits(error)


def test_tolerances_are_those_of_the_planner_where_none_are_given() -> None:
    assert Tolerance(1.0, 1.0).shape == PlannerConfig().joint_tolerance == 1e-3
    given = inspect.signature(plan).parameters["tolerance"].default
    assert given == Tolerance(1e-6, 1e-6, 1e-6), "who calls the API wants what the method can do"


@pytest.mark.parametrize(
    ("position", "quaternion", "mention"),
    [
        ([np.nan, 0, 0], [0, 0, 0, 1], "position"),
        ([0, 0, np.inf], [0, 0, 0, 1], "position"),
        ([0, 0, 0], [0, 0, np.nan, 1], "orientation"),
        ([0, 0, 0], [0, 0, 0, 0], "zero quaternion"),
        ([0, 0], [0, 0, 0, 1], "three position"),
        ([0, 0, 0], [0, 0, 1], "four"),
    ],
)
def test_what_is_no_pose_is_refused(
    position: list[float], quaternion: list[float], mention: str
) -> None:
    with pytest.raises(PlanningError, match=mention):
        Goal.checked(position, quaternion)


@pytest.mark.parametrize("shape", [[0.0, np.nan], [[0.0, 1.0]], 0.5])
def test_what_is_no_shape_is_refused(shape: npt.ArrayLike) -> None:
    with pytest.raises(PlanningError, match="goal shape"):
        Goal.checked([0, 0, 0], [0, 0, 0, 1], shape)


def test_a_goal_of_the_end_effector_without_a_name_is_refused_by_that() -> None:
    with pytest.raises(GoalError, match=r"^The goal of the end-effector has 2 numbers; give 3"):
        EndEffectorGoal.checked("", [1.0, 0.0])
    with pytest.raises(GoalError, match=r"^The end-effector has 2 goals; only one is allowed\.$"):
        Goal.of_end_effectors([EndEffectorGoal.checked("", np.ones(3))] * 2)


# -- options of the gait methods: unknown ones and numbers out of range are refused by name ------


ARM = (share_directory() / "urdf" / "three_joint_arm.urdf").read_text("utf-8")
OPTIONED = [name for name, method in METHODS.items() if declared(method.Options)]
NUMBERS = [
    (name, option)
    for name in OPTIONED
    for option in declared(METHODS[name].Options)
    if not isinstance(option.default, str)
]


@pytest.mark.parametrize("method", [*OPTIONED, "auto"])
def test_an_option_that_no_method_has_is_refused(method: str) -> None:
    with pytest.raises(ParameterError, match=rf"^{method} has no option 'thrust'; it has "):
        plan(robot_of(ARM), method=method, thrust=1.0)


@pytest.mark.parametrize(
    ("method", "option"), [pytest.param(*x, id=f"{x[0]}.{x[1].name}") for x in NUMBERS]
)
def test_numbers_out_of_range_are_refused(method: str, option: Parameter) -> None:
    for number in (option.minimum - 1.0, option.maximum * 2 + 1.0, math.nan):
        value = [number] if isinstance(option.default, tuple) else number
        options: dict[str, Any] = {option.name: value}
        with pytest.raises(ParameterError, match=f"'{option.name}' is .* it must be "):
            plan(robot_of(ARM), method=method, **options)


def test_a_start_has_a_position_for_every_joint_and_a_method_is_one_of_the_registry() -> None:
    with pytest.raises(ParameterError, match=r"start has 2 joint positions, .* has 3 joints"):
        plan(robot_of(ARM), start=(0.1, 0.2))
    for outside in (9.0, np.nan):
        with pytest.raises(ParameterError, match=r"start of joint '\w+', (9|nan), is outside its"):
            plan(robot_of(ARM), start=(0.1, outside, 0.2))
    with pytest.raises(
        ParameterError, match="no gait method 'magic'; the methods are: lie_bracket, "
    ):
        plan(robot_of(ARM), method="magic")


def test_a_start_is_a_shape_or_a_state_and_otherwise_the_shape_nearest_to_zero() -> None:
    robot = SpaceRobot.from_urdf(
        ARM.replace('lower="-2.9" upper="0.4"', 'lower="-2.9" upper="-0.1"')
    )
    options: dict[str, Any] = {"method": "area_loop", "joint_positions": (0.0, -0.5, 1.0)}
    loose: dict[str, Any] = {"tolerance": Tolerance(9.0, 3.0, 1e-6)}
    np.testing.assert_array_equal(plan(robot, **options, **loose).positions[0], [0.0, -0.1, 0.0])
    shape = (0.2, -0.3, 0.4)
    np.testing.assert_array_equal(plan(robot, start=shape, **options, **loose).positions[0], shape)
    turned = np.array([0.0, 0.0, 0.6, 0.8])
    state = RobotState(np.array([1.0, 2.0, 3.0]), turned, np.array(shape))
    path = plan(robot, start=state, **options, **loose).path
    np.testing.assert_allclose(path.position[0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(path.quaternion[0], turned)


def test_a_goal_shape_may_lie_beyond_a_limit_by_rounding_alone() -> None:
    loose: dict[str, Any] = {
        "method": "area_loop",
        "tolerance": Tolerance(9.0, 3.0, 1e-6),
        "start": (0.0, 0.3, 0.0),
    }
    schedule = plan(robot_of(ARM), joint_positions=(0.0, 0.4 + 1e-10, 0.5), **loose)
    assert schedule.positions[-1].tolist() == [0.0, 0.4, 0.5]
    with pytest.raises(PlanningError, match=r"'shoulder_pitch' at 0\.41 rad"):
        plan(robot_of(ARM), joint_positions=(0.0, 0.41, 0.5), **loose)


# -- options with a number a joint that are given by the names of joints -------------------------


NAMED_ARM = SpaceRobot.from_file(robot_file("three_joint_arm"))
FIRST, SECOND, THIRD = NAMED_ARM.joint_names


def option(name: str) -> Parameter:
    return next(each for each in declared(OptimalOptions) if each.name == name)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"a": 1, "b": 0.25}, ("a:1.0", "b:0.25")),
        (["a:1", "b: 0.25"], ("a:1.0", "b:0.25")),
        ("b:0.25; a:1e-3", ("b:0.25", "a:0.001")),
        (("b:0.25",), ("b:0.25",)),
        ([0.5, 2], (0.5, 2.0)),
        (["0.5", "2"], (0.5, 2.0)),
        ([], ()),
    ],
)
def test_values_by_name_become_texts(given: Any, expected: tuple[Any, ...]) -> None:
    declaration = option("max_velocity")
    assert declaration.by_name
    assert declaration.checked(given) == expected
    assert declaration.checked(expected) == expected


OF_BOTH_FORMS = "must be a list of numbers, or of strings NAME:VALUE with joint names"
OUT_OF_RANGE = r"finite numbers from 0 to 1e\+09"


@pytest.mark.parametrize(
    ("name", "given", "message"),
    [
        ("joint_margin", "text", OF_BOTH_FORMS),
        *[("joint_margin", ["a:1", x], OF_BOTH_FORMS) for x in ("2", 2.0, "a:2")],
        *[("joint_margin", x, r"is \['x'\]; it must be a list") for x in ({"a": "x"}, ["a:x"])],
        ("joint_margin", {"a": [1]}, "a list of numbers"),
        *[("max_acceleration", {"a": x}, OUT_OF_RANGE) for x in (-1.0, 1e10, float("nan"))],
        # Without names of joints numbers alone will do.
        ("keep_out", {"a": 1.0}, r"it must be a list of numbers \(m or rad\)\.$"),
    ],
)
def test_other_values_are_refused(name: str, given: Any, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        option(name).checked(given)


def test_efforts_are_given_by_name_and_others_stay() -> None:
    options = configured(OptimalOptions, {"max_effort": {SECOND: 0.375}, "effort_limits": 1})
    efforts = LimitedEfforts.of(NAMED_ARM, options)
    assert efforts is not None
    expected = NAMED_ARM.effort_limit.copy()
    expected[1] = 0.375
    np.testing.assert_allclose(efforts.limit, 0.85 * expected)


@pytest.mark.parametrize("name", ["max_velocity", "max_acceleration"])
def test_an_unknown_joint_is_refused(name: str) -> None:
    options = configured(OptimalOptions, {name: {f"{FIRST}x": 1.0}})
    with pytest.raises(ParameterError) as refusal:
        MotionLimits.of(NAMED_ARM, options, "planned")
    assert str(refusal.value) == (
        f"planned.{name} names '{FIRST}x', which is not a joint of robot 'three_joint_arm'; its "
        f"joints are {FIRST}, {SECOND}, {THIRD}. Did you mean '{FIRST}'?"
    )


def test_options_by_name_are_ros_parameters_of_texts() -> None:
    declaration = option("max_velocity")
    changes = [RosParameter(declaration.name, value=each) for each in ([0.5], ["a: 0.5"])]
    numbers, named = typed({declaration.name: declaration}, changes)
    assert numbers.type_.name == "DOUBLE_ARRAY"
    assert (named.type_.name, named.value) == ("STRING_ARRAY", ["a:0.5"])


# -- limits of joints and constraints on paths --------------------------------------------------


def test_limits_are_the_robots_narrowed_by_options(arm: SpaceRobot) -> None:
    own = arm.velocity_limit
    plain = MotionLimits.of(arm, OptimalOptions(ramp_time=0.25))
    assert plain.velocity.tolist() == own.tolist()
    assert plain.acceleration == pytest.approx(own * 4.0)
    options = OptimalOptions(
        max_velocity=tuple(own * [0.5, 2.0, 1.0]), max_acceleration=(1.0, 2.0, 3.0)
    )
    found = MotionLimits.of(arm, options)
    assert found.velocity == pytest.approx(own * [0.5, 1.0, 1.0])
    assert found.acceleration.tolist() == [1.0, 2.0, 3.0]
    # By name, the others stay.
    slow = {"max_velocity": {THIRD: 0.125}, "max_acceleration": {SECOND: 0.0625, FIRST: 0.5}}
    named = MotionLimits.of(arm, configured(OptimalOptions, {**slow, "ramp_time": 0.25}))
    assert named.velocity.tolist() == [*own[:2], 0.125]
    assert named.acceleration.tolist() == [0.5, 0.0625, 0.125 / 0.25]
    for wrong, words in (
        ({"max_velocity": (1.0,)}, "1 number; robot 'three_joint_arm' has 3 joints ("),
        ({"max_velocity": (1.0, 0.0, 1.0)}, f"'{SECOND}' is limited to 0 per second"),
        ({"max_acceleration": (1.0, 0.0, 1.0)}, "and 0 per second squared; area_loop needs"),
    ):
        with pytest.raises(ParameterError, match=re.escape(words)):
            MotionLimits.of(arm, OptimalOptions(**wrong), "area_loop")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            {"keep_axis": (0.0, 0.0, 2.0)},
            "requires all of optimal.keep_axis, optimal.keep_direction",
        ),
        ({"keep_angle": 0.5}, "requires all of optimal.keep_axis"),
        (
            {"keep_axis": (0.0, 0.0, 0.0), "keep_direction": (1.0, 0.0, 0.0), "keep_angle": 0.5},
            "optimal.keep_axis is (0.0, 0.0, 0.0); it must be three numbers, not all zero.",
        ),
        (
            {"keep_axis": (1.0, 0.0, 0.0), "keep_direction": (1.0, 0.0), "keep_angle": 0.5},
            "optimal.keep_direction is (1.0, 0.0); it must be three numbers",
        ),
        (
            {"keep_out": (1.0, 2.0, 3.0)},
            "has 3 numbers; a shape box has 3 lower and 3 upper bounds.",
        ),
        ({"keep_out": (0.0, 0.0, 0.0, 1.0, 0.0, 1.0)}, "lower bound is not below its upper bound."),
        ({"keep_out": (-9e6,) * 3 + (9e6,) * 3}, "contains all shapes of the robot."),
    ],
)
def test_constraints_that_make_no_sense_are_refused(
    arm: SpaceRobot, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ParameterError, match=re.escape(words)):
        plan(arm, rotvec=[0, 0, 0.1], **options)


@pytest.mark.parametrize("profile", [lambda s: s, lambda s: s**2, lambda s: np.sin(np.pi * s / 2)])
def test_any_law_of_proportional_joints_turns_the_base_alike_in_step_1(profile: object) -> None:
    """The turn of paper 3's step 1 is that of the straight line, whatever its legible half is."""
    assert callable(profile)
    phase = PlanarPhase(looped_robot("planar_chain"))
    along = np.asarray(profile(np.linspace(0.0, 1.0, 400)))[:, np.newaxis]
    shapes = (1 - along) * [np.pi, -np.pi]
    turn = phase.turns_by_legs(shapes[:-1], shapes[1:]).sum()
    assert turn == pytest.approx(np.pi / 2 - 0.571293, abs=1e-6)
    assert abs(np.pi / 2 - turn - 0.39) > 0.1
