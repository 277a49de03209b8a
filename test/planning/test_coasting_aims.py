"""Where goals are aimed at while the centre of mass coasts, keys of plans, and notes of schedules.

Plans about the centre of mass are stand-ins of given durations.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import NotFoundError, PlanningError
from spacerobot_ros.planning import GaitSchedule, Goal, PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.methods.optimal import method as module
from spacerobot_ros.planning.methods.optimal.method import OptimalGait
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits, OptimalOptions

Array = npt.NDArray[np.float64]

PERIOD, MASS = 0.25, 40.0
P, L = np.array([2.0, -1.2, 0.8]), np.array([0.3, -0.1, 0.2])
VELOCITY = P / MASS
ATTITUDE = Rotation.from_rotvec([0.2, -0.3, 0.5]).as_quat()
STATE = RobotState(np.array([0.1, 0.2, -0.3]), ATTITUDE, np.array([0.4, -0.7, 1.1]), P, L)
GOAL = Goal(np.array([0.5, -0.4, 0.3]), Rotation.from_rotvec([0.1, 0.4, -0.2]).as_quat())
REQUEST = PlanRequest(STATE, GOAL, Tolerance(1e-3, 2e-3, 3e-3))


class Coasting:
    """A method whose plans about the centre of mass take scripted times, s; None: none is found."""

    def __init__(self, *durations: float | None, **options: Any) -> None:
        self.durations = list(durations)
        self.asked: list[tuple[PlanRequest, float | None]] = []
        self.control_period = PERIOD
        self.options = replace(OptimalOptions(), **options)
        self.robot = SimpleNamespace(total_mass=MASS)
        self._has_obstacles = False
        self._specification = SimpleNamespace(controls=frozenset({"attitude", "position"}))

    def _plan_about_center(
        self, request: PlanRequest, _: object, duration: float | None = None
    ) -> Any:
        self.asked.append((request, duration))
        found = self.durations.pop(0)
        if found is None:
            raise PlanningError(f"refusal {len(self.asked)}")
        return SimpleNamespace(duration=found)

    def plan(self, request: PlanRequest = REQUEST) -> Any:
        coasting: Any = OptimalGait._plan_while_coasting
        return coasting(self, request, None)

    def aims(self) -> list[float]:
        """Return the times at which goals were aimed at, by their displacements."""
        found = []
        for request, _ in self.asked:
            assert not request.state.linear_momentum.any()
            np.testing.assert_array_equal(request.state.angular_momentum, L)
            back = GOAL.position - request.goal.position
            found.append(float(back @ VELOCITY / (VELOCITY @ VELOCITY)))
            np.testing.assert_allclose(back, found[-1] * VELOCITY, atol=1e-12)
        return found


def test_the_aim_is_where_the_goal_is_at_the_end_of_the_manoeuvre_before() -> None:
    method = Coasting(8.0, 8.5, 8.25, 8.25)
    assert method.plan().duration == 8.25
    assert method.aims() == pytest.approx([0.0, 8.0, 8.5, 8.25])
    assert [duration for _, duration in method.asked] == [None] * 4


def test_a_time_is_given_where_durations_do_not_agree() -> None:
    method = Coasting(8.0, 8.5, 8.0, 8.5, None, None, 13.0)
    assert method.plan().duration == 13.0
    # 8.5 s by 1.05, 1.2 and 1.5, in whole periods.
    assert method.aims()[4:] == pytest.approx([9.0, 10.25, 12.75])
    assert [duration for _, duration in method.asked[4:]] == pytest.approx([9.0, 10.25, 12.75])


def test_short_manoeuvres_are_aimed_a_second_ahead_at_least() -> None:
    method = Coasting(0.25, 0.5, 0.25, 0.5, 9.0)
    method.plan()
    assert method.aims()[4:] == pytest.approx([1.0])


def test_the_last_refusal_is_told() -> None:
    for durations in ((8.0, None, None, None, None), (None, None, None, None)):
        method = Coasting(*durations)
        with pytest.raises(NotFoundError) as refusal:
            method.plan()
        assert str(refusal.value) == (
            "The robot drifts, and no manoeuvre was found that ends when the goal is where it "
            f"leads, seen from the centre of mass: refusal {len(durations)}"
        )


@pytest.mark.parametrize(("duration", "end"), [(6.1, 6.0), (6.2, 6.25), (0.01, 0.25)])
def test_a_given_duration_is_the_time_of_the_aim(duration: float, end: float) -> None:
    method = Coasting(9.0, duration=duration)
    method.plan()
    assert method.aims() == pytest.approx([end])
    assert method.asked[0][1] is None


def test_attitudes_alone_do_not_drift_away() -> None:
    method = Coasting(9.0)
    method._specification.controls = frozenset({"attitude"})
    method.plan()
    assert method.aims() == [0.0]
    hand = Goal.of_end_effectors([EndEffectorGoal("hand", np.array([1.0, 2.0, 3.0]))])
    both = Coasting(9.0, 9.0)
    both._specification.controls = frozenset({"attitude"})
    both.plan(replace(REQUEST, goal=hand))
    (_, (request, _)) = both.asked
    (moved,) = request.goal.end_effectors
    np.testing.assert_allclose(moved.position, [1.0, 2.0, 3.0] - 9.0 * VELOCITY)


def test_shapes_at_places_and_obstacles_are_refused_with_the_speed() -> None:
    speed = f"{np.linalg.norm(VELOCITY):.3g} m/s"
    with pytest.raises(PlanningError, match=f"moves at {speed}, so attitude and shape of the goal"):
        Coasting().plan(replace(REQUEST, goal=replace(GOAL, joint_positions=np.zeros(3))))
    walled = Coasting()
    walled._has_obstacles = True
    with pytest.raises(PlanningError, match=f"moves at {speed}, and among obstacles optimal plans"):
        walled.plan()


# -- keys of plans ------------------------------------------------------------------------------


class Keyed:
    """A method with all the parts that its plans depend on."""

    def __init__(self) -> None:
        self.control_period, self.integration_step = 0.05, 0.01
        self._limits = MotionLimits(-np.ones(3), np.ones(3), np.ones(3) / 2, np.ones(3) / 3)
        self._efforts: Any = SimpleNamespace(limit=np.array([1.0, 2.0, 3.0]))
        self.clearance: Any = SimpleNamespace(facts=np.array([0.01, 1.0]))
        self.options, self.robot = OptimalOptions(), "robot"


def key_of(monkeypatch: pytest.MonkeyPatch, made: Keyed, request: PlanRequest) -> tuple[Any, ...]:
    def key(robot: Any, numbers: dict[str, Array], options: object) -> tuple[Any, ...]:
        parts = ((name, tuple(np.ravel(x).tolist())) for name, x in sorted(numbers.items()))
        return robot, tuple(parts), str(options)

    monkeypatch.setattr(module, "plan_key", key)
    found: Any = OptimalGait._request_key(made, request)  # type: ignore[arg-type]
    return tuple(found)


def test_whatever_a_plan_depends_on_changes_its_key(monkeypatch: pytest.MonkeyPatch) -> None:
    hands = Goal.of_end_effectors(
        [EndEffectorGoal("left", np.ones(3)), EndEffectorGoal("right", np.zeros(3))]
    )
    requests = [
        REQUEST,
        replace(REQUEST, state=replace(STATE, position=np.array([0.1, 0.2, -0.31]))),
        replace(REQUEST, state=replace(STATE, quaternion=GOAL.quaternion)),
        replace(REQUEST, state=replace(STATE, q=np.array([0.4, -0.7, 1.2]))),
        replace(REQUEST, state=replace(STATE, linear_momentum=np.zeros(3))),
        replace(REQUEST, state=replace(STATE, angular_momentum=np.zeros(3))),
        replace(REQUEST, state=replace(STATE, linear_momentum=np.zeros(3), angular_momentum=P)),
        replace(REQUEST, goal=replace(GOAL, position=np.zeros(3))),
        replace(REQUEST, goal=replace(GOAL, quaternion=ATTITUDE)),
        replace(REQUEST, goal=replace(GOAL, joint_positions=np.zeros(3))),
        replace(REQUEST, tolerance=Tolerance(2e-3, 2e-3, 3e-3)),
        replace(REQUEST, tolerance=Tolerance(1e-3, 1e-3, 3e-3)),
        replace(REQUEST, goal=hands),
        replace(REQUEST, goal=replace(hands, base=frozenset({"attitude"}))),
        replace(REQUEST, goal=replace(hands, base=frozenset({"position"}))),
        replace(REQUEST, goal=Goal.of_end_effectors([EndEffectorGoal("left", np.ones(3))])),
    ]
    keys = [key_of(monkeypatch, Keyed(), request) for request in requests]
    changes: list[dict[str, Any]] = [
        {"control_period": 0.06},
        {"integration_step": 0.02},
        {"_efforts": None},
        {"_efforts": SimpleNamespace(limit=np.array([1.0, 2.0, 4.0]))},
        {"clearance": None},
        {"clearance": SimpleNamespace(facts=np.array([0.02, 1.0]))},
        {"options": replace(OptimalOptions(), starts=3)},
        {"robot": "another"},
    ]
    changes += [
        {"_limits": replace(Keyed()._limits, **{name: np.full(3, 0.9)})}
        for name in ("lower", "upper", "velocity", "acceleration")
    ]
    for change in changes:
        made = Keyed()
        vars(made).update(change)
        keys.append(key_of(monkeypatch, made, REQUEST))
    assert len(set(keys)) == len(keys)
    assert key_of(monkeypatch, Keyed(), REQUEST) == keys[0]


# -- notes of schedules -------------------------------------------------------------------------


class Built:
    """A method whose predictions are given: two poses, the second one at the end."""

    control_period = PERIOD
    END = np.array([0.6, -0.2, 0.1])
    TURNED = Rotation.from_rotvec([0.1, 0.4, -0.25])

    def __init__(self, *controls: str) -> None:
        self.robot: Any = SimpleNamespace(n=3, base_twist=self.base_twist)
        self.controls = frozenset(controls)
        poses = np.array([STATE.quaternion, self.TURNED.as_quat()])
        path = SimpleNamespace(position=np.array([STATE.position, self.END]), quaternion=poses)
        self._prediction = SimpleNamespace(attitudes=lambda *_: poses, path=lambda *_: path)
        self.momenta: list[Any] = []

    def base_twist(self, quaternion: Array, q: Array, rates: Array, p: Array, L: Array) -> Any:
        np.testing.assert_array_equal(quaternion, self.TURNED.as_quat())
        assert not rates.any()
        return np.zeros(3), np.concatenate([q[:1], p[:1], L[:1]])

    def _kind_of(self, goal: Goal) -> Any:
        return SimpleNamespace(specification=SimpleNamespace(controls=self.controls))

    def _list_active_limits(self, positions: Array, velocity: Any, L_B: Any, after: Any) -> str:
        self.momenta.append(L_B)
        return f"limits at {velocity}"

    def _schedule_of(
        self, goal: Goal, positions: Array, path: Any, notes: Any, **_: Any
    ) -> GaitSchedule:
        return GaitSchedule("optimal", ("a", "b", "c"), PERIOD, positions, path, goal, notes)

    def notes(self, state: RobotState, goal: Goal) -> dict[str, Any]:
        build: Any = OptimalGait._build_schedule
        shapes = np.array([STATE.q, STATE.q + 0.5])
        schedule = build(self, state, goal, shapes, {"starts": 3.0}, 0.7)
        assert schedule.controls == self.controls
        return dict(schedule.notes)


def test_notes_of_a_schedule_are_its_errors_and_where_it_ends() -> None:
    built = Built("attitude")
    notes = built.notes(replace(STATE, angular_momentum=np.zeros(3)), GOAL)
    turn = Rotation.from_quat(GOAL.quaternion).inv() * built.TURNED
    assert notes == {
        "starts": 3.0,
        "final_shape": pytest.approx(STATE.q + 0.5),
        "final_position": built.END.tolist(),
        "predicted_attitude_error": pytest.approx(turn.magnitude()),
        "predicted_position_error": pytest.approx(np.linalg.norm(built.END - GOAL.position)),
        "limited_by": "limits at 0.7",
    }
    assert built.momenta == [None]


def test_notes_of_a_drifting_robot_have_the_rate_at_the_end() -> None:
    built = Built("attitude", "position")
    notes = built.notes(STATE, GOAL)
    assert notes["final_base_rate"] == pytest.approx([STATE.q[0] + 0.5, P[0], L[0]])
    (momenta,) = built.momenta
    for L_B, quaternion in zip(momenta, [STATE.quaternion, built.TURNED.as_quat()], strict=True):
        np.testing.assert_allclose(L_B, Rotation.from_quat(quaternion).inv().apply(L))


@pytest.mark.parametrize("controls", [(), ("attitude",), ("position",), ("attitude", "position")])
def test_notes_of_goals_of_hands_have_the_errors_that_count(
    controls: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    places = {"left": np.array([1.0, 0.0, 0.5]), "right": np.array([0.0, -1.0, 0.2])}

    def pose(_: object, link: str, *__: object) -> tuple[Array, Array]:
        return places[link], ATTITUDE

    monkeypatch.setattr(module, "end_effector_pose", pose)
    errors = {
        "angle": 0.1,
        "distance": 0.2,
        "largest_end_effector_distance": 0.3,
        "largest_end_effector_angle": 0.4,
    }
    between = SimpleNamespace(between=lambda *_: SimpleNamespace(**errors))
    monkeypatch.setattr(module, "PoseError", between)
    hands = Goal.of_end_effectors([EndEffectorGoal(name, np.zeros(3)) for name in places])
    notes = Built(*controls).notes(STATE, hands)
    for name, place in places.items():
        assert notes[f"final_pose_of_{name}"] == pytest.approx([*place, *ATTITUDE])
    assert notes["predicted_end_effector_position_error"] == 0.3
    assert notes["predicted_end_effector_attitude_error"] == 0.4
    for part, value in (("attitude", 0.1), ("position", 0.2)):
        assert notes.get(f"predicted_{part}_error") == (value if part in controls else None)
