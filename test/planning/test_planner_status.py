"""Statuses and statistics of the planner as values of messages; goals on file with ids."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.planning.core.goal import EndEffectorGoal, Tolerance, uncontrolled_parts
from spacerobot_ros.planning.execution.goal_file import (
    BASE_GOAL_KEY,
    GoalFile,
    GoalIds,
    IdentifiedGoal,
    PursuedGoals,
)
from spacerobot_ros.planning.execution.status import (
    PlannerState,
    PlannerStatistics,
    PlannerStatus,
    describe_remaining_error,
)

GOAL = Goal(np.array([0.1, -2.0, 3.5]), np.array([0.0, 0.6, 0.0, 0.8]), np.array([0.25, -0.5]))
POSE_OF_GOAL = (*GOAL.position.tolist(), *GOAL.quaternion.tolist())

# Numbers that nine digits hold.
numbers = st.integers(-(10**8), 10**8).map(lambda n: n / 1000)
words = st.text("abcdefgh ", min_size=1, max_size=12).filter(lambda text: text.strip() == text)
# A list of one number reads as that number, a text that is a number as the number.
notes = st.dictionaries(
    st.text("klmnop", min_size=1, max_size=6),
    st.one_of(numbers, st.lists(numbers, min_size=2, max_size=4), words.map(lambda w: f"x {w}")),
    max_size=3,
)


@given(
    st.sampled_from(PlannerState),
    st.sampled_from(["", "12.000000345", "unstamped-1"]),
    st.sampled_from([(), POSE_OF_GOAL]),
    st.integers(0, 9),
    st.one_of(st.none(), numbers),
    st.one_of(st.none(), numbers),
    numbers.filter(bool),
    notes,
)
def test_a_status_survives_its_message(
    state: PlannerState,
    goal_id: str,
    goal: tuple[float, ...],
    corrections: int,
    position: float | None,
    attitude: float | None,
    time: float,
    notes: dict[str, list[float] | float | str],
) -> None:
    status = PlannerStatus(
        state=state,
        message="So it is.",
        goal_id=goal_id,
        goal=goal,
        corrections=corrections,
        position_error_m=position,
        attitude_error_rad=attitude,
        manoeuvre_time_s=time,
        ends_at_s=time,
        remaining_s=2 * time,
        method="optimal",
        duration_s=time,
        notes=notes,
    )
    values = status.to_values()
    assert all(isinstance(text, str) for text in values.values())
    assert PlannerStatus.from_values(values, "So it is.") == status


def test_a_status_has_the_keys_that_belong_to_it() -> None:
    assert PlannerStatus(PlannerState.IDLE).to_values() == {"state": "idle", "corrections": "0"}
    refused = PlannerStatus(PlannerState.REFUSED, "No.", goal_id="3.000000000", goal=POSE_OF_GOAL)
    # Where a schedule begins or has ended its times are there, also those that are not given.
    assert PlannerStatus(PlannerState.EXECUTING, ends_at_s=2.5, method="stub").to_values() == {
        "state": "executing",
        "corrections": "0",
        "manoeuvre_time_s": "0",
        "ends_at_s": "2.5",
        "method": "stub",
        "duration_s": "0",
    }
    assert refused.to_values() == {
        "state": "refused",
        "corrections": "0",
        "goal_id": "3.000000000",
        "goal": "0.1 -2 3.5 0 0.6 0 0.8",
    }
    assert [state.value for state in PlannerState if state.decided] == [
        *("reached", "reached_partly", "failed", "refused", "aborted")
    ]


@pytest.mark.parametrize("values", [{}, {"state": "asleep"}, {"state": "idle", "goal": "a b"}])
def test_what_is_no_status_is_refused(values: dict[str, str]) -> None:
    with pytest.raises(SpaceRobotError, match="No status of a planner"):
        PlannerStatus.from_values(values)


def test_statistics_survive_their_message() -> None:
    statistics = PlannerStatistics(1.25, 3, 98_001)
    assert json.loads(statistics.to_json()) == {
        "plan_time_s": 1.25,
        "plans": 3,
        "commands_published": 98_001,
    }
    assert PlannerStatistics.from_json(statistics.to_json()) == statistics
    assert PlannerStatistics() == PlannerStatistics(0.0, 0, 0)


def test_goal_ids_are_the_stamps() -> None:
    ids = GoalIds()
    stamps = [(12, 345), (0, 0), (0, 1), (0, 0)]
    assert [ids.of(*stamp) for stamp in stamps] == [
        "12.000000345",
        "unstamped-1",
        "0.000000001",
        "unstamped-2",
    ]


TWO_POSES = [np.array([1, 2, 3, 0, 0, 0.6, 0.8]), np.array([4, 5, 6, 0, 0, 0, 1.0])]
HANDS = (
    EndEffectorGoal.checked("left", [0.1, -0.2, 0.3]),
    EndEffectorGoal.checked("right", [1.0, 2.0, 3.0, 0.0, 0.6, 0.0, 0.8]),
    EndEffectorGoal.along("foot", TWO_POSES),
)


@pytest.mark.parametrize(
    "goal",
    [
        GOAL,
        Goal.of_end_effectors(HANDS),
        Goal.of_end_effectors(HANDS[:1], quaternion=[0.0, 0.0, 0.6, 0.8]),
        Goal.of_end_effectors(HANDS[1:2], joint_positions=[0.5, -0.75]),
        Goal.through(TWO_POSES),
    ],
)
def test_a_goal_survives_its_file(tmp_path: Path, goal: Goal) -> None:
    file = GoalFile(str(tmp_path / "goal.json"))
    assert file.load() == {}
    for goal_id in ("", "7.000000001"):
        file.pursue(PursuedGoals({BASE_GOAL_KEY: IdentifiedGoal(goal, goal_id)}))
        loaded = file.load()[BASE_GOAL_KEY]
        assert loaded.goal_id == goal_id
        assert loaded.goal.equals(goal)
        assert loaded.goal.equals(GOAL) == (goal is GOAL)
    file.delete()
    assert file.load() == {}
    assert not list(tmp_path.iterdir())


def test_a_goal_file_without_ids_is_read(tmp_path: Path) -> None:
    path = tmp_path / "goal.json"
    entry = {"position": [1, 2, 3], "quaternion": [0, 0, 0, 1], "joint_positions": None}
    path.write_text(json.dumps({BASE_GOAL_KEY: entry}))
    loaded = GoalFile(str(path)).load()[BASE_GOAL_KEY]
    assert loaded.goal_id == ""
    assert loaded.goal.joint_positions is None


def goal_text(position: str = "[0, 0, 0]", quaternion: str = "[0, 0, 0, 1]") -> bytes:
    entry = f'"position": {position}, "quaternion": {quaternion}, "joint_positions": null'
    return f'{{"base": {{{entry}}}}}'.encode()


NO_GOALS = {
    "empty": b"",
    "cut": goal_text()[:-5],
    "no text": b"\xff\xfe\x00",
    "no object": b"[]",
    "no goal": b"{}",
    "another name": goal_text().replace(b"base", b"arm"),
    "a number": b'{"base": 3}',
    "no attitude": b'{"base": {"position": [1]}}',
    "not finite": goal_text(position="[0, NaN, 0]"),
    "no rotation": goal_text(quaternion="[0, 0, 0, 0]"),
    "deep": b"[" * 100_000,
}


@pytest.mark.parametrize("content", NO_GOALS.values(), ids=NO_GOALS)
def test_a_file_that_holds_no_goal_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "goal.json"
    path.write_bytes(content)
    with pytest.raises(ParameterError, match="contains no valid goals"):
        GoalFile(str(path)).load()
    assert path.read_bytes() == content


def test_a_goal_that_others_could_have_written_is_not_flown_to(tmp_path: Path) -> None:
    path = tmp_path / "goal.json"
    file = GoalFile(str(path))
    before = os.umask(0)
    try:
        file.pursue(PursuedGoals({BASE_GOAL_KEY: IdentifiedGoal(GOAL)}))
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o600
    path.chmod(0o602)
    with pytest.raises(ParameterError, match="is invalid: others can write") as refusal:
        file.load()
    assert f"chmod go-w '{path}'" in str(refusal.value)
    path.chmod(0o644)
    assert BASE_GOAL_KEY in file.load()


def test_a_goal_stays_on_file_until_it_is_decided(tmp_path: Path) -> None:
    path = tmp_path / "goal.json"
    file = GoalFile(str(path))
    assert not file.pursue(PursuedGoals({BASE_GOAL_KEY: IdentifiedGoal(GOAL, "1.0")}))
    file.end("2.0", refused=True)
    assert path.exists()
    file.end("1.0", refused=True)
    assert not path.exists()
    file.pursue(PursuedGoals({BASE_GOAL_KEY: IdentifiedGoal(GOAL, "3.0")}))
    file.add_waiting(BASE_GOAL_KEY, IdentifiedGoal(GOAL, "4.0"))
    assert file.load()[BASE_GOAL_KEY].goal_id == "3.0"
    restarted = GoalFile(str(path))
    restarted.load()
    restarted.end("2.0", refused=True)
    assert path.exists()
    # An abort is about all goals, also under the id of one that waits.
    restarted.end("2.0", refused=False)
    assert not path.exists()


def test_a_goal_file_is_replaced_as_a_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody foresees the name that it is written under, and a failure leaves the goal before."""
    path = tmp_path / "goal.json"
    file = GoalFile(str(path))
    file.pursue(PursuedGoals({BASE_GOAL_KEY: IdentifiedGoal(GOAL, "1.0")}))
    (tmp_path / "goal.json.new").symlink_to(tmp_path / "victim")

    def failing(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as broken:
        broken.setattr("os.replace", failing)
        problem = file.pursue(PursuedGoals({BASE_GOAL_KEY: IdentifiedGoal(GOAL, "2.0")}))
        assert "No space left" in problem
    assert file.load()[BASE_GOAL_KEY].goal_id == "1.0"
    file.pursue(PursuedGoals({BASE_GOAL_KEY: IdentifiedGoal(GOAL, "2.0")}))
    assert file.load()[BASE_GOAL_KEY].goal_id == "2.0"
    assert {each.name for each in tmp_path.iterdir()} == {"goal.json", "goal.json.new"}


def test_parts_that_are_not_controlled_end_effectors_and_notes_survive_a_message() -> None:
    status = PlannerStatus(
        PlannerState.REACHED,
        "There.",
        "1.5",
        end_effector_goals={"left": (0.1, -0.2, 0.3), "right": (1.0, 2.0, 3.0, 0.0, 0.6, 0.0, 0.8)},
        end_effector_waypoints={"right": 12},
        end_effector_position_error_m=1.25e-7,
        end_effector_attitude_error_rad=0.0,
        not_controlled=("position", "shape"),
    )
    values = status.to_values()
    assert values["not_controlled"] == "position shape"
    assert values["waypoints_of_right"] == "12"
    assert not {"goal", "position_error_m"} & values.keys()
    assert PlannerStatus.from_values(values, "There.") == status
    notes: dict[str, list[float] | float | str] = {"one": 0.123456789123, "many": [1.0, -2.5]}
    values = PlannerStatus(PlannerState.EXECUTING, method="stub", notes=notes).to_values()
    assert [values[key] for key in notes] == ["0.123456789", "1 -2.5"]
    assert "not_controlled" not in values


def test_a_goal_that_is_not_asked_for_in_the_base_leaves_nothing_of_it_out() -> None:
    turned = Goal.of_end_effectors(
        [EndEffectorGoal.checked("tip", [1, 2, 3])], quaternion=[0, 0, 0, 1]
    )
    assert uncontrolled_parts(turned, frozenset({"end_effectors"})) == ("attitude",)
    assert uncontrolled_parts(turned, frozenset({"attitude"})) == ()
    assert uncontrolled_parts(GOAL, frozenset({"attitude"}))[0] == "position"


def test_a_remaining_error_names_what_is_controlled() -> None:
    error = PoseError(
        np.array([0.03, 0.04, 0.0]), np.array([0.0, 0.0, -0.2]), np.array([0.5, -0.75])
    )
    for controls, words in (
        ({"position"}, "50 mm from the goal"),
        ({"attitude"}, "0.2 rad from the goal"),
        ({"position", "attitude"}, "50 mm and 0.2 rad from the goal"),
        ({"attitude", "shape"}, "0.2 rad and 0.75 m or rad at the joints from the goal"),
    ):
        assert describe_remaining_error(error, frozenset(controls)) == words  # type: ignore[arg-type]
    hand = PoseError(np.array([0.0, 0.3, -0.4]), np.zeros(3))
    for hands, words in (
        ((hand,), "end-effector 0.5 m from the goal"),
        ((hand, error), "end-effectors at most 0.5 m and 0.2 rad from the goal"),
    ):
        of_hands = PoseError(error.position, error.rotvec, end_effectors=hands)
        assert describe_remaining_error(of_hands, frozenset({"end_effectors"})) == words
    within, goal = Tolerance(0.02, 0.06, 0.3), Goal.checked([1, 2, 3], [0, 0, 0, 1], [0.5, 0.25])
    for controls, words in (
        ({"position"}, "tolerance 20 mm; attitude and shape not controlled"),
        (
            {"attitude", "shape"},
            "tolerance 60 mrad, 0.3 m or rad at the joints; position not controlled",
        ),
        ({"position", "attitude", "shape"}, "tolerance 20 mm, 60 mrad, 0.3 m or rad at the joints"),
    ):
        told = describe_remaining_error(error, frozenset(controls), within, goal)  # type: ignore[arg-type]
        assert told.endswith(f" from the goal ({words})")
    told = describe_remaining_error(of_hands, frozenset({"end_effectors"}), within)
    hands_words = "end-effectors at most 0.5 m and 0.2 rad from"
    assert told == f"{hands_words} the goal (tolerance 20 mm, 60 mrad)"
    told = describe_remaining_error(of_hands, frozenset({"position", "end_effectors"}), within)
    assert told.startswith(f"50 mm from the goal, {hands_words} theirs (")
    one_hand = PoseError(error.position, error.rotvec, end_effectors=(hand,))
    told = describe_remaining_error(one_hand, frozenset({"position", "end_effectors"}))
    assert told == "50 mm from the goal, end-effector 0.5 m from its goal"
    unshaped = PoseError(error.position, error.rotvec)
    told = describe_remaining_error(unshaped, frozenset({"position", "shape"}), within)
    assert told == "50 mm from the goal (tolerance 20 mm)"
    assert (
        describe_remaining_error(unshaped, frozenset({"attitude", "shape"}))
        == "0.2 rad from the goal"
    )
    assert PoseError(error.position, error.rotvec, np.zeros(0)).max_joint_error == 0.0


def test_goals_are_joined_part_by_part() -> None:
    left, other = (EndEffectorGoal.checked("left", [x, 0.0, 0.0]) for x in (1.0, 2.0))
    right = EndEffectorGoal.checked("right", [3.0, 0.0, 0.0])
    first = Goal.of_end_effectors([left])
    assert first.joined_with(Goal.of_end_effectors([right])).end_effectors == (left, right)
    assert first.joined_with(Goal.of_end_effectors([other])).end_effectors == (other,)
    both = first.joined_with(GOAL)
    assert both.equals(GOAL.joined_with(first))
    assert both.base == {"position", "attitude"}
    assert GOAL.joined_with(GOAL) is GOAL
