"""Environments of Gymnasium: its own checks, wrappers, autoreset modes, and the plant."""

from __future__ import annotations

import copy
import pickle
import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import Error, ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics
from scipy.spatial.transform import Rotation

import spacerobot_ros.environments
from spacerobot_ros.environments import import_gymnasium
from spacerobot_ros.environments.episodes import EpisodeConfig, Episodes
from spacerobot_ros.environments.tasks import (
    TASKS,
    Reach,
    Reorient,
    RewardWeights,
    RobotStates,
    Task,
    command_of,
)
from spacerobot_ros.errors import CommandError, ParameterError, SpaceRobotError
from spacerobot_ros.model import SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_rotvec
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.simulation.actuators import build_plant

MODES = "NextStep", "SameStep", "Disabled"
ARM, OWN = "spacerobot/ReorientArm-v0", "spacerobot/Task-v0"
SHORT = {"scenario": "planar_chain", "hold": 2, "time_limit": 0.5, "spread": 0.02}

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/environments.md").read_text("utf-8")


@pytest.fixture(autouse=True)
def interpreted(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interpret the models, which a small robot is faster with; without a compiler are no lanes."""
    if "slow" not in request.keywords:
        monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


@pytest.fixture
def strict() -> Iterator[None]:
    """Let every warning of Gymnasium be an error."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*sre_.*:DeprecationWarning")
        yield


@pytest.mark.usefixtures("strict")
@pytest.mark.parametrize(
    ("name", "arguments", "sizes"),
    [
        (ARM, {"scenario": "planar_chain"}, (13, 2)),
        ("spacerobot/Reach-v0", {"scenario": "planar_chain", "link": "segment_2"}, (13, 2)),
        (ARM, {"scenario": "faults/noisy_sensors", "render_mode": "rgb_array"}, (15, 3)),
        (OWN, {"task": "point", "scenario": "planar_chain"}, (13, 2)),
    ],
)
def test_gymnasium_checks_the_environments(
    name: str, arguments: dict[str, Any], sizes: tuple[int, int]
) -> None:
    environment = gymnasium.make(name, **arguments)
    assert environment.observation_space.shape == sizes[:1]
    assert environment.action_space.shape == sizes[1:]
    check_env(environment.unwrapped)


def fly_beside_single_ones(name: str, mode: str, arguments: dict[str, Any], steps: int) -> int:
    """Step a vector environment, wrapped, beside Gymnasium's vector of single ones; count ends."""
    count, ends = 5, 0
    there = gymnasium.vector.SyncVectorEnv(
        [lambda: gymnasium.make(name, **arguments)] * count, autoreset_mode=mode
    )
    here = RecordEpisodeStatistics(
        gymnasium.make_vec(name, num_envs=count, autoreset_mode=mode, **arguments)
    )
    assert here.observation_space == there.observation_space
    assert here.action_space == there.action_space
    rng = np.random.default_rng(0)
    states = here.reset(seed=7)[0], there.reset(seed=7)[0]
    assert here.unwrapped.np_random_seed == tuple(range(7, 12))
    for _ in range(steps):
        np.testing.assert_allclose(*states, atol=1e-12)
        actions = rng.uniform(-1.2, 1.2, (count, *here.single_action_space.shape))
        *mine, infos = here.step(actions)
        *wanted, others = there.step(actions)
        for one, two in zip(mine, wanted, strict=True):
            np.testing.assert_allclose(one, two, atol=1e-12)
        states = mine[0], wanted[0]
        ended = mine[2] | mine[3]
        ends += int(ended.sum())
        if ended.any():
            assert infos["episode"]["l"][ended].all()
        if ended.any() and mode == "SameStep":
            assert infos["_final_obs"].tolist() == others["_final_obs"].tolist() == ended.tolist()
            for row in np.flatnonzero(ended):
                np.testing.assert_allclose(
                    infos["final_obs"][row], others["final_obs"][row], atol=1e-12
                )
            for key in ("error", "is_success"):
                np.testing.assert_allclose(
                    infos["final_info"][key], others["final_info"][key], atol=1e-12
                )
        elif ended.any():
            assert infos["_is_success"].tolist() == others["_is_success"].tolist()
            assert infos["is_success"].tolist() == others["is_success"].tolist()
        if mode == "Disabled" and ended.any():
            with pytest.raises(ResetNeeded, match=f"{int(ended.sum())} episodes have ended"):
                here.step(actions)
            states = (
                here.reset(options={"reset_mask": ended.copy()})[0],
                there.reset(options={"reset_mask": ended.copy()})[0],
            )
    return ends


@pytest.mark.usefixtures("strict")
def test_a_wrapper_that_needs_one_mode_of_resets_is_told_the_mode() -> None:
    for mode in ("SameStep", "Disabled"):
        with pytest.raises(ValueError, match="NEXT_STEP"):
            NormalizeObservation(gymnasium.make_vec(ARM, num_envs=3, autoreset_mode=mode, **SHORT))
    plain = gymnasium.make_vec(ARM, num_envs=3, autoreset_mode="NextStep", **SHORT)
    vector: Any = NormalizeObservation(RecordEpisodeStatistics(plain))
    vector.reset(seed=1)
    rng = np.random.default_rng(2)
    ended = [vector.step(rng.uniform(-1.0, 1.0, (3, 2)))[2:4] for _ in range(14)]
    assert np.sum(ended) > 4


def test_a_step_is_that_of_the_plant_of_the_scenario() -> None:
    environment: Any = gymnasium.make(ARM, scenario="sliding_masses", hold=3).unwrapped
    scenario = load_scenario("sliding_masses")
    robot = SpaceRobot(load_robot(robot_file("sliding_masses")))
    plant = build_plant(robot, scenario.plant)
    goal = quaternion_from_rotvec([0.0, 0.0, 0.3])
    observation, info = environment.reset(options={"goal": 2.0 * goal})
    before = info["error"]
    assert before == pytest.approx(0.3)
    np.testing.assert_allclose(observation[:3], [0, 0, 0.3], atol=1e-12)
    np.testing.assert_array_equal(observation[3:6], plant.q)
    action = np.array([0.25, -1.5, 3.0])
    observation, reward, terminated, truncated, info = environment.step(action)
    for _ in range(3):
        plant.step(np.array([0.25, -1.0, 1.0]) * robot.velocity_limit)
    for part, wanted in zip(
        np.split(observation[3:], [3, 6]), (plant.q, plant.qdot, plant.twist), strict=True
    ):
        np.testing.assert_array_equal(part, wanted)
    R_BG = matrix_from_quaternion(plant.pose[3:]).T @ matrix_from_quaternion(goal)
    assert info["error"] == pytest.approx(np.arccos((np.trace(R_BG) - 1) / 2), abs=1e-9)
    seconds = 3 * scenario.plant.control_period
    assert reward == pytest.approx(
        10 * (before - info["error"]) - seconds * (0.02 + 0.01 * (0.0625 + 1 + 1) / 3)
    )
    assert (terminated, truncated) == (False, False)


def test_a_goal_that_is_reached_ends_the_episode_and_is_rewarded() -> None:
    environment: Any = gymnasium.make(
        ARM, scenario="planar_chain", tolerance=0.05, reward={"reached": 7.0, "time": 0.0}
    ).unwrapped
    environment.reset(options={"goal": quaternion_from_rotvec([0.0, 0.0, 0.04])})
    _, reward, terminated, truncated, info = environment.step(np.zeros(2))
    assert (reward, terminated, truncated) == (pytest.approx(7.0), True, False)
    assert info["is_success"] is True


def test_time_truncates() -> None:
    environment: Any = gymnasium.make(
        ARM, scenario="sliding_masses", time_limit=0.4, hold=2
    ).unwrapped
    environment.reset(options={"goal": quaternion_from_rotvec([0.0, 0.0, 0.5])})
    last = round(0.4 / (2 * environment.episodes.flights.control_period)) - 1
    assert last > 1
    ends = [environment.step(np.zeros(3))[2:5] for _ in range(last + 1)]
    assert [truncated for _, truncated, _ in ends] == [False] * last + [True]
    assert ends[last][2]["is_success"] is False


CAMPAIGN = """
campaign:
  scenario: planar_chain
  flights: 5
  seed: 2
  set: {plant.linear_momentum: [2.0, 0.0, 0.0]}
  disperse:
    mass.*: {uniform: {loc: 0.8, scale: 0.4}}
    goal.rotvec.z: {uniform: [-0.2, 0.2]}
    initial.joints.pin_1: {uniform: [-0.1, 0.1]}
"""


def test_draws_of_a_campaign_are_starts_masses_and_goals(tmp_path: Path) -> None:
    file = tmp_path / "draws.yaml"
    file.write_text(CAMPAIGN)
    config = EpisodeConfig("reorient", campaign=str(file))
    episodes = Episodes(config, 4, in_lanes=False)
    generators = [np.random.default_rng(seed) for seed in range(4)]
    seen = set()
    for _ in range(6):
        episodes.begin(range(4), generators)
        # Under one momentum a robot drifts by its mass.
        drift = episodes.flights.twist[:, 0]
        for row in range(4):
            seen.add((drift[row], episodes.goals[row, 2], episodes.flights.q[row, 0]))
    # Five draws, each with a mass, a goal and a start of its own.
    assert len(seen) == 5
    for column in range(3):
        assert len({each[column] for each in seen}) == 5
    repeated = [np.random.default_rng(seed) for seed in range(4)]
    episodes.begin(range(4), repeated)
    first = episodes.goals.copy()
    episodes.begin(range(4), [np.random.default_rng(seed) for seed in range(4)])
    np.testing.assert_array_equal(first, episodes.goals)


SLIDING = """
campaign:
  scenario: sliding_masses
  flights: 40
  disperse:
    {}
"""


@pytest.mark.parametrize(
    ("changed", "refusal"),
    [
        ("initial.joints.slider_1: {uniform: [-5.0, 5.0]}", "slider_1.*outside its limits"),
        pytest.param("mass.*: {uniform: [-0.5, 1.0]}", "mass", marks=pytest.mark.slow),
        ("plant.initial_joint_velocities[0]: {choice: [0.0, 0.1]}", "must start at rest"),
    ],
)
def test_draws_that_are_refused_are_left_out_with_one_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, changed: str, refusal: str
) -> None:
    file = tmp_path / "draws.yaml"
    file.write_text(SLIDING.format(changed))
    vector: Any = gymnasium.make_vec(ARM, num_envs=4, campaign=str(file))
    single: Any = gymnasium.make(ARM, campaign=str(file))
    caplog.clear()
    for seed in range(12):
        observations, _ = vector.reset(seed=seed)
        np.testing.assert_array_equal(observations[0], single.reset(seed=seed)[0])
    (record,) = [each for each in caplog.records if "is omitted" in each.message]
    assert re.search(f"Campaign draw .* is omitted, as are other .*{refusal}", record.message)


def test_a_campaign_whose_draws_are_all_refused_says_so(tmp_path: Path) -> None:
    file = tmp_path / "draws.yaml"
    file.write_text(SLIDING.format("initial.joints.slider_1: {uniform: [3.0, 4.0]}"))
    environment = gymnasium.make(ARM, campaign=str(file))
    with pytest.raises(ParameterError, match="100 successive campaign draws were rejected"):
        environment.reset(seed=1)


@pytest.mark.slow
def test_wheels_turn_the_base() -> None:
    environment: Any = gymnasium.make(ARM, scenario="wheels").unwrapped
    robot = environment.episodes.robot
    environment.reset(seed=1, options={"goal": quaternion_from_rotvec([0.0, 0.0, 0.5])})
    before = environment.episodes.flights.momentum[0, 3:6].copy()
    action = np.zeros(environment.action_space.shape)
    wheels = [name in robot.description.wheel_names for name in robot.joint_names]
    action[: robot.n][wheels] = -1.0
    for _ in range(5):
        observation, *_ = environment.step(action)
    # The wheels' axes have a common direction: the base turns against it, without momentum.
    momentum = environment.episodes.flights.momentum[0, 3:6]
    np.testing.assert_allclose(momentum, before, atol=1e-12)
    assert np.abs(observation[-3:]).max() > 1e-3


def test_goals_of_a_scenario() -> None:
    config = EpisodeConfig("reorient", scenario="planar_chain", goals="scenario")
    episodes = Episodes(config, 2, in_lanes=False)
    assert episodes.flights.engine == "scalar"
    episodes.begin([1], [np.random.default_rng(0)] * 2)
    wanted = load_scenario("planar_chain").goal.quaternion
    np.testing.assert_array_equal(episodes.goals, [[0, 0, 0, 1], wanted])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"ticks": 3}, "An environment has no argument 'ticks'; it has task, scenario, "),
        ({"goals": "far"}, "Parameter 'goals' is 'far'; it must be one of random, scenario"),
        ({"hold": 0}, "Parameter 'hold' is 0; it must be a number of at least 1 .ticks."),
        ({"link": "segment_2"}, "Argument 'link' is 'segment_2', but task 'reorient' has no link"),
        ({"reward": {"time": np.nan}}, "The reward weight 'time' is nan: use a finite"),
        ({"time_limit": np.inf}, "Parameter 'time_limit' is inf; it must be a finite"),
        ({"scenario": "a", "campaign": "b"}, "both given: a campaign file already names"),
        ({"reward": {"speed": 1}}, "The reward has no weight 'speed'; it has progress"),
        ({"scenario": "faults/late_poses"}, "has faults of sensors, which environments do not"),
        ({"task": "hover"}, "Argument 'task' is 'hover'; it may be reorient, reach"),
        ({"task": Task}, "The task 'Task' lacks .*random_goal.*remaining"),
        ({"scenario": "capture"}, "has a target, which environments do not support"),
        ({"action_scale": [1.0]}, r"'action_scale' is \(1.0,\); robot .* takes a list of 8 finite"),
        ({"action_scale": 1.0}, "'action_scale' is 1.0; it must be a list of numbers"),
        ({"action_scale": np.zeros(8)}, "'action_scale' is all zeros, so no action moves"),
        ({"reward": 3}, "Argument 'reward' is 3; it must be a dictionary of weights"),
    ],
)
def test_bad_arguments_are_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        gymnasium.make(ARM, **{"scenario": "planar_chain", **arguments})


def test_a_plant_in_mujoco_is_refused(tmp_path: Path) -> None:
    folder = share_directory() / "config"
    text = (folder / "planar_chain.yaml").read_text("utf-8")
    given = tmp_path / "pushing.yaml"
    given.write_text(text.replace("/**/plant:\n  ros__parameters:\n", _IN_MUJOCO), "utf-8")
    with pytest.raises(ParameterError, match="'pushing' has a plant in MuJoCo, which environments"):
        gymnasium.make(ARM, scenario=str(given))


_IN_MUJOCO = "/**/plant:\n  ros__parameters:\n    engine: mujoco\n"


def test_bad_actions_goals_and_masks_are_refused() -> None:
    vector: Any = gymnasium.make_vec(ARM, num_envs=2, scenario="planar_chain")
    vector.reset(seed=[3, 4])
    assert vector.np_random_seed == (3, 4)
    for actions, message in (
        (np.zeros((2, 3)), r"The actions have shape \(2, 3\), not \(2, 2\)"),
        (np.full((2, 2), np.nan), "not finite"),
        (np.full((2, 2), "right"), "is not a list of numbers"),
        (np.full((2, 2), 1j), "is not a list of numbers"),
        ([[1, 2], [3]], "is not a list of numbers"),
    ):
        with pytest.raises(CommandError, match=message):
            vector.step(actions)
    for goal in ([0, 0, 0], np.ones((3, 4)), [0, 0, 0, np.nan]):
        with pytest.raises(
            ParameterError, match=r"The goal has shape .*; task 'reorient' takes 4 finite"
        ):
            vector.reset(options={"goal": goal})
    for given in ("up", {"x": 1.0}, [[0, 0, 0, 1], [1]]):
        with pytest.raises(ParameterError, match=r"The goal .* is not a list of numbers\."):
            vector.reset(options={"goal": given})
    for options, message in (
        ({"gaol": [0, 0, 0, 1]}, "A reset has no option 'gaol'; it has goal, start"),
        ({"start": [{}]}, r"The start is \[{}\]: pass a dictionary, or a list of 2 dictionaries"),
        ({"start": {"q": [0, 0]}}, "A start has no 'q'; it has position, quaternion, "),
        ({"start": {"position": [0, 0]}}, r"The start's position is \[0, 0\]; it must be 3 finite"),
        ("goal", "The reset options are 'goal': pass a dictionary"),
    ):
        with pytest.raises(ParameterError, match=message):
            vector.reset(options=options)
    for count in (0, 1.5, "2"):
        with pytest.raises(ParameterError, match=f"number of environments is {count!r}"):
            gymnasium.make_vec(ARM, num_envs=count, scenario="planar_chain")
    with pytest.raises(ParameterError, match="The goal quaternion is zero"):
        vector.reset(options={"goal": [0, 0, 0, 0]})
    for mask in (np.zeros(2, dtype=bool), np.ones(3, dtype=bool), np.ones(2)):
        with pytest.raises(ValueError, match="must be 2 booleans, at least one true"):
            vector.reset(options={"reset_mask": mask})
    with pytest.raises(ValueError, match="There are 3 seeds for 2 environments"):
        vector.reset(seed=[1, 2, 3])
    for seed in (1.5, "x", [1, "x"], [1.5, 2]):
        with pytest.raises(Error, match="give a nonnegative integer, or a list of 2"):
            vector.reset(seed=seed)
    with pytest.raises(Error, match="give a nonnegative integer"):
        vector.reset(seed=[4, -1])
    assert vector.np_random_seed == (3, 4)


def test_robots_are_reset_before_they_are_stepped() -> None:
    vector: Any = gymnasium.make_vec(ARM, num_envs=3, scenario="planar_chain")
    with pytest.raises(ResetNeeded, match="3 robots have no episode yet: reset them before"):
        vector.step(np.zeros((3, 2)))
    vector.reset(options={"reset_mask": np.array([True, False, True])})
    with pytest.raises(ResetNeeded, match="1 robots have no episode yet"):
        vector.step(np.zeros((3, 2)))
    vector.reset(seed=1)
    vector.step(np.zeros((3, 2)))


# -- tasks of one's own ------------------------------------------------------------------------


(_SOURCE,) = re.findall(r"```python file=point.py\n(.*?)```", PAGE, re.DOTALL)
_OF_PAGE: dict[str, Any] = {"__name__": __name__}
exec(compile(_SOURCE, "point.py", "exec"), _OF_PAGE)
Point: type[Task] = TASKS.register(_OF_PAGE["Point"])


def test_a_task_of_ones_own_decides_starts_rewards_and_ends() -> None:
    environment: Any = gymnasium.make(
        OWN, task=Point, scenario="planar_chain", tolerance=0.2, reward={"time": 0.0, "spin": 2.0}
    ).unwrapped
    episodes = environment.episodes
    _, first = environment.reset(seed=3)
    goal, q = episodes.goals[0], episodes.flights.q[0].copy()
    assert (np.abs(q - load_scenario("planar_chain").plant.initial_joint_positions) <= 0.2).all()
    assert len(set(q.tolist())) == 2
    # The angle between the x axis of the base and the goal, by another formula.
    assert first["error"] == pytest.approx(np.arccos(goal[0]), abs=1e-9)
    seen, reward, *ends, info = environment.step([0.5, -0.5])
    axis = matrix_from_quaternion(episodes.flights.pose[0, 3:])[:, 0]
    assert info["error"] == pytest.approx(np.arccos(axis @ goal), abs=1e-9)
    spin = np.linalg.norm(episodes.flights.twist[0, 3:])
    assert spin > 1e-4
    wanted = 10.0 * (first["error"] - info["error"]) - 0.01 * (0.01 * 0.25 + 2.0 * spin)
    assert reward == pytest.approx(wanted, rel=1e-9)
    assert seen[3:5] == pytest.approx(episodes.flights.q[0])
    assert ends == [False, False]
    # Reached only if the base is nearly still; lost if it turns away.
    environment.reset(options={"goal": [1.0, 0.0, 0.0]})
    *_, reached, _, info = environment.step([0.0, 0.0])
    assert (reached, info["is_success"]) == (True, True)
    environment.reset(options={"goal": [-1.0, 0.0, 0.0]})
    _, reward, lost, _, info = environment.step([0.0, 0.0])
    assert (reward, lost, info["is_success"]) == (pytest.approx(-5.0), True, False)


@pytest.mark.parametrize(
    ("function", "found", "sentence"),
    [
        ("random_goal", np.zeros(4), r"random_goals .* of shape \(2, 4\); .* of shape \(2, 3\)"),
        ("remaining", np.zeros((2, 2)), r"remaining .* of shape \(2, 2\); .* of shape \(2, 3\)"),
        ("errors", np.zeros((2, 1)), r"of shape \(2, 1\); it must return an array of shape \(2,\)"),
        ("reached", np.array([True]), r"of shape \(1,\); it must return an array of shape \(2,\)"),
        ("failed", None, r"failed of task 'odd_failed' returned None; it must return an array"),
        ("reward", 3.0, r"reward of task 'odd_reward' returned 3.0; it must return an array"),
        (
            "observe",
            np.zeros((2, 3)),
            r"of shape \(2, 3\); it must return an array of shape \(2, 13",
        ),
    ],
)
def test_arrays_of_a_task_have_one_row_per_robot(function: str, found: Any, sentence: str) -> None:
    task = type("Odd", (Point,), {"name": f"odd_{function}", function: lambda *_: found})

    def step() -> None:
        vector: Any = gymnasium.make_vec(OWN, num_envs=2, task=task, scenario="planar_chain")
        vector.reset(seed=1)
        vector.step(np.zeros((2, 2)))

    with pytest.raises(ParameterError, match=sentence):
        step()


def test_arguments_change_from_episode_to_episode() -> None:
    vector: Any = gymnasium.make_vec(OWN, num_envs=3, task="point", scenario="planar_chain")
    single: Any = gymnasium.make(OWN, task="point", scenario="planar_chain")
    for angle in (0.1, 0.4):
        vector.set_attr("spread", angle)
        single.set_wrapper_attr("spread", angle)
        assert vector.get_attr("spread") == (angle,) * 3
        assert single.get_wrapper_attr("spread") == angle
        errors = [vector.reset(seed=seed)[1]["error"] for seed in range(20)]
        assert 0.7 * angle < np.max(errors) <= angle
        assert single.reset(seed=4)[1]["error"] == errors[4][0]
    vector.set_attr("time_limit", 0.02)
    vector.set_attr("reward", {"failed": 7.0})
    vector.set_attr("largest_angle", 0.0)  # An attribute of the task.
    *_, rewards, lost, truncated, _ = vector.step(np.zeros((3, 2)))
    assert lost.all()
    assert not truncated.any()
    np.testing.assert_allclose(rewards, -7.0 - 0.01 * 0.02, atol=1e-3)
    with pytest.raises(ParameterError, match="no changeable attribute 'speed'; it has reward, "):
        vector.set_attr("speed", 1.0)
    for change in vector.set_attr, single.set_wrapper_attr:
        for name in ("hold", "scenario"):
            with pytest.raises(ParameterError, match=f"no changeable attribute '{name}'; it has"):
                change(name, 5)
    with pytest.raises(ParameterError, match=r"'tolerance' is -1\.0; it must be a number of"):
        vector.set_attr("tolerance", -1.0)
    assert vector.get_attr("tolerance") == (0.05,) * 3


def test_starts_are_given() -> None:
    vector: Any = gymnasium.make_vec(ARM, num_envs=2, scenario="servicer")
    place, momentum = [0.5, 0.0, -1.0], [0.0, 3.0, 0.0]
    vector.reset(options={"start": [{"position": place}, {"angular_momentum": momentum}]})
    flights = vector.unwrapped.episodes.flights
    np.testing.assert_allclose(flights.pose[:, :3], np.array([place, np.zeros(3)]), atol=1e-12)
    np.testing.assert_allclose(
        flights.momentum[:, 3:6], np.array([np.zeros(3), momentum]), atol=1e-9
    )


# -- vectors, and what lanes lack --------------------------------------------------------------

OF_POINT = {**SHORT, "task": "point", "spread": 0.3, "time_limit": 0.1}
LACKING = {"hold": 2, "time_limit": 0.4}
NOISY = {**LACKING, "scenario": "faults/noisy_sensors"}


@pytest.mark.usefixtures("strict")
@pytest.mark.parametrize(
    ("name", "mode", "arguments"),
    [
        *((ARM, mode, SHORT) for mode in MODES),
        *((OWN, mode, OF_POINT) for mode in MODES),
        (ARM, "NextStep", {**LACKING, "scenario": "faults/weak_motors"}),
        (ARM, "NextStep", NOISY),
        ("spacerobot/Reach-v0", "NextStep", {**NOISY, "link": "mass_1"}),
        pytest.param(
            *(ARM, "NextStep", {"scenario": "servicer_thrusters", "hold": 2, "time_limit": 0.1}),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_vector_environment_is_as_many_single_ones(
    name: str, mode: str, arguments: dict[str, Any]
) -> None:
    assert fly_beside_single_ones(name, mode, arguments, 12) >= 5


def test_faults_and_thrusters_are_those_of_the_plant() -> None:
    for name in ("faults/weak_motors", "free_flyer"):
        environment: Any = gymnasium.make(ARM, scenario=name, hold=4).unwrapped
        environment.reset(seed=2)
        episodes, config = environment.episodes, load_scenario(name).plant
        seed = episodes._plants[0].sensors.seed
        config = replace(config, sensors=replace(config.sensors, seed=seed))
        plant = build_plant(SpaceRobot(load_robot(robot_file(config.robot))), config)
        action = np.linspace(-0.9, 0.7, environment.action_space.shape[0])
        environment.step(action)
        command = command_of(action[np.newaxis], episodes.scale, episodes.taken)[0]
        n = episodes.robot.n
        for _ in range(4):
            plant.step(*([command[:n], command[n:]] if plant.takes_wrench else [command]))
        np.testing.assert_array_equal(episodes.flights.twist[0], plant.twist)
        np.testing.assert_array_equal(episodes.flights.q[0], plant.q)
        # Another episode has other noise.
        environment.reset()
        assert episodes._plants[0].sensors.seed != seed


def test_sensors_err_by_their_noise_and_bias() -> None:
    count, sensors = 2000, load_scenario("faults/noisy_sensors").plant.sensors
    vector: Any = gymnasium.make_vec(ARM, num_envs=count, scenario="faults/noisy_sensors")
    seen, _ = vector.reset(seed=1, options={"goal": [0, 0, 0, 1]})
    flights = vector.unwrapped.episodes.flights
    parts = np.split(seen, [3, 6, 9, 12], axis=1)
    truths = 0.0, flights.q, flights.qdot, flights.twist[:, :3], flights.twist[:, 3:]
    names = "attitude", "joint", "joint_rate", "velocity", "angular_velocity"
    for name, part, truth in zip(names, parts, truths, strict=True):
        sigma = getattr(sensors, f"{name}_noise")
        error = part - truth
        assert sigma > 0
        assert np.std(error) == pytest.approx(sigma, rel=0.05)
        assert abs(np.mean(error)) < 0.05 * sigma
    # The error that rewards and ends depend on is the true one.
    np.testing.assert_allclose(vector.unwrapped.episodes.errors, 0.0, atol=1e-12)


def states(n: int) -> RobotStates:
    rng = np.random.default_rng(4)
    quaternion = rng.normal(size=(3, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    pose = np.hstack([rng.normal(size=(3, 3)), quaternion])
    parts = rng.normal(size=(3, 6)), rng.normal(size=(3, n)), rng.normal(size=(3, n))
    return RobotStates(pose, *parts, rng.normal(size=(3, 3)))


def test_the_way_of_a_link_is_in_the_frame_of_the_base() -> None:
    task = Reach(SpaceRobot(load_robot(robot_file("planar_chain"))), "segment_2", (True, False))
    given = states(2)
    assert given.link_r is not None
    goals = np.random.default_rng(5).normal(size=(3, 3))
    ways = task.remaining(given, goals)
    for row in range(3):
        R = matrix_from_quaternion(given.pose[row, 3:])
        link = given.pose[row, :3] + R @ given.link_r[row]
        np.testing.assert_allclose(ways[row], R.T @ (goals[row] - link))
        np.testing.assert_allclose(task.link_positions(given)[row], link)
    np.testing.assert_allclose(task.errors(ways), np.sqrt((ways**2).sum(axis=1)))


@pytest.mark.parametrize(("by_force", "dimensions"), [(False, 2), (True, 3)])
def test_random_places_fill_the_disc_or_the_ball_in_which_the_link_goes(
    by_force: bool, dimensions: int
) -> None:
    """Of places that fill it evenly, the shares (d / R)^k are even; a planar robot keeps to its
    plane, however it is turned in the world."""
    robot = SpaceRobot(load_robot(robot_file("planar_chain")))
    task, given, rng = (
        Reach(robot, "segment_2", (by_force, False)),
        states(2),
        np.random.default_rng(6),
    )
    link = task.link_positions(given)[0]
    ways = np.array([task.random_goal(given, 0.3, rng) - link for _ in range(400)])
    shares = (np.linalg.norm(ways, axis=1) / 0.3) ** dimensions
    assert shares.max() <= 1.0
    assert np.mean(shares) == pytest.approx(0.5, abs=0.06)
    in_base = ways @ matrix_from_quaternion(given.pose[0, 3:])
    assert bool(np.abs(in_base[:, 2]).max() < 1e-12) is (dimensions == 2)


def test_random_attitudes_are_within_their_spread() -> None:
    robot = SpaceRobot(load_robot(robot_file("planar_chain")))
    task, given = Reorient(robot), states(2)
    rng = np.random.default_rng(6)
    turns = []
    for _ in range(40):
        goal = task.random_goal(given, 0.3, rng)
        turns.append(task.remaining(given, goal[np.newaxis])[0])
    # A planar robot turns about the axis of its plane alone.
    np.testing.assert_allclose(np.array(turns)[:, :2], 0.0, atol=1e-12)
    assert 0.25 < np.abs(turns).max() <= 0.3
    assert min(turn[2] for turn in turns) < -0.1


def test_a_base_that_no_joint_turns_is_turned_by_torques_alone() -> None:
    hull = """<robot name="hull"><link name="hull"><inertial><mass value="20"/>
      <inertia ixx="1.5" iyy="2" izz="2.5" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
    robot, given = SpaceRobot(parse_robot(hull)), states(0)
    with pytest.raises(ParameterError, match=r"cannot rotate its base .* set 'max_torque'"):
        Reorient(robot, pushed=(True, False)).random_goal(given, 0.3, np.random.default_rng(6))
    task, rng = Reorient(robot, pushed=(False, True)), np.random.default_rng(6)
    start = Rotation.from_quat(given.pose[0, 3:])
    goals = Rotation.from_quat([task.random_goal(given, 0.3, rng) for _ in range(60)])
    turns = (start.inv() * goals).as_rotvec()
    assert 0.25 < np.linalg.norm(turns, axis=1).max() <= 0.3
    # About all axes: the turns span the space.
    assert np.linalg.svd(turns, compute_uv=False)[-1] > 0.5


def test_a_link_of_a_planar_robot_reaches_in_its_plane() -> None:
    for force, planar in ((0.0, True), (1.0, False)):
        environment: Any = gymnasium.make(
            "spacerobot/Reach-v0", scenario="coordinated_control", max_force=force
        ).unwrapped
        ways = np.array([environment.reset(seed=seed)[0][:3] for seed in range(20)])
        assert np.ptp(ways[:, :2], axis=0).min() > 0.3
        assert bool(np.abs(ways[:, 2]).max() < 1e-12) is planar


def test_a_force_on_the_base_is_an_action_where_there_is_one() -> None:
    for force, torque, taken in (
        (0.0, 0.0, [0, 1]),
        (5.0, 0.0, [0, 1, 2, 3, 4]),
        (5.0, 3.0, [0, 1, 2, 3, 4, 5, 6, 7]),
    ):
        config = EpisodeConfig(
            "reorient", scenario="planar_chain", max_force=force, max_torque=torque
        )
        assert Episodes(config, 1, in_lanes=False).taken.tolist() == taken
    # Without limits of its own, those of the controller of the scenario.
    config = EpisodeConfig("reorient", scenario="wheels")
    limits = load_scenario("wheels").controller
    episodes = Episodes(config, 1, in_lanes=False)
    scale, n = episodes.scale, episodes.robot.n
    np.testing.assert_array_equal(scale[:n], episodes.robot.effort_limit)
    assert scale[-6:].tolist() == [limits.max_force] * 3 + [limits.max_torque] * 3
    assert limits.max_force != limits.max_torque


def test_registering_twice_changes_nothing_and_a_missing_package_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spacerobot_ros.environments.register()
    assert ARM in gymnasium.registry
    monkeypatch.setitem(__import__("sys").modules, "gymnasium", None)
    with pytest.raises(SpaceRobotError, match=r"pip install '\.\[rl\]' in the clone"):
        import_gymnasium()


def test_a_robot_file_that_was_changed_is_another_robot(tmp_path: Path) -> None:
    file, text = tmp_path / "own.urdf", robot_file("planar_chain").read_text("utf-8")
    for digit in "", "1":
        file.write_text(text.replace('mass value="', f'mass value="{digit}'))
        config = EpisodeConfig("reorient", scenario=str(file))
        found = Episodes(config, 1, in_lanes=False).robot.total_mass
        assert found == SpaceRobot.from_file(file).total_mass


def test_each_robot_may_have_a_goal_of_its_own() -> None:
    vector: Any = gymnasium.make_vec(ARM, num_envs=3, scenario="planar_chain")
    angles = np.array([0.1, -0.2, 0.3])
    goals = [quaternion_from_rotvec([0.0, 0.0, angle]) for angle in angles]
    observations, infos = vector.reset(seed=1, options={"goal": goals})
    np.testing.assert_allclose(observations[:, 2], angles, atol=1e-12)
    mask = np.array([False, True, False])
    goals = [quaternion_from_rotvec([0.0, 0.0, angle]) for angle in (0.4, 0.5, 0.6)]
    observations, infos = vector.reset(options={"goal": goals, "reset_mask": mask})
    np.testing.assert_allclose(observations[:, 2], [0.1, 0.5, 0.3], atol=1e-12)
    assert infos["error"][1] == pytest.approx(0.5)


@pytest.mark.usefixtures("strict")
def test_copies_have_the_arguments_and_begin_anew() -> None:
    for environment in (gymnasium.make(ARM, **SHORT), gymnasium.make_vec(ARM, num_envs=2, **SHORT)):
        wanted = environment.reset(seed=3)[0]
        copies = copy.deepcopy(environment), pickle.loads(pickle.dumps(environment))
        for each in copies:
            np.testing.assert_array_equal(each.reset(seed=3)[0], wanted)
            here, there = (of.unwrapped.episodes for of in (each, environment))
            assert here.step_duration == there.step_duration
            assert here is not there


def test_pictures_show_the_robot_and_its_goal() -> None:
    arguments = {"scenario": "planar_chain", "render_mode": "rgb_array"}
    environment: Any = gymnasium.make(ARM, **arguments)
    pictures = []
    for angle, joint in ((0.0, 0.0), (0.5, 0.0), (0.5, 1.0)):
        start = {"joint_positions": [joint, 0.0]}
        goal = quaternion_from_rotvec([0.0, 0.0, angle])
        environment.reset(options={"goal": goal, "start": start})
        pictures.append(environment.render())
    assert {(each.shape, each.dtype.name) for each in pictures} == {((480, 640, 3), "uint8")}
    aligned, turned, bent = (each.astype(int) for each in pictures)
    # The lines of the goal move with it, the links with their joints.
    assert 500 < (np.abs(turned - aligned).max(axis=2) > 20).sum() < 20_000
    assert (np.abs(bent - turned).max(axis=2) > 20).sum() > 1000
    vector: Any = gymnasium.make_vec(ARM, num_envs=2, **arguments)
    vector.reset(options={"goal": goal, "start": [{"joint_positions": [0.0, 0.0]}, start]})
    for picture, wanted in zip(vector.render(), pictures[1:], strict=True):
        np.testing.assert_array_equal(picture, wanted)


def test_other_render_modes_are_refused() -> None:
    # Libraries pass it always, and leave it out after a TypeError.
    for make in (gymnasium.make, gymnasium.make_vec):
        assert make(ARM, scenario="planar_chain", render_mode=None).render_mode is None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Gymnasium may tell it before.
            with pytest.raises(TypeError, match="There is no render_mode 'ansi': use 'rgb_array'"):
                make(ARM, scenario="planar_chain", render_mode="ansi")


def test_the_defaults_are_those_of_the_page() -> None:
    config, weights = EpisodeConfig("reorient"), RewardWeights()
    told = re.findall(r"^\| `(hold|time_limit)` \| .* \| ([\d.]+) \|$", PAGE, re.MULTILINE)
    assert {name: getattr(config, name) for name in ("hold", "time_limit")} == {
        name: float(value) for name, value in told
    }
    told = re.findall(r"^\| `(\w+)` \| ([\d.]+) \| .* \|$", PAGE, re.MULTILINE)
    assert vars(weights) == {name: float(value) for name, value in told}


def test_the_campaign_of_the_page_draws_masses_starts_and_goals(tmp_path: Path) -> None:
    (text,) = re.findall(r"```yaml\n(campaign:.*?)```", PAGE, re.DOTALL)
    (file := tmp_path / "arm.yaml").write_text(text.replace("5000", "20"), "utf-8")
    config = EpisodeConfig("reorient", campaign=str(file))
    episodes = Episodes(config, 8, in_lanes=False)
    episodes.begin(range(8), [np.random.default_rng(seed) for seed in range(8)])
    robot, flights = episodes.robot, episodes.flights
    masses = flights._flights.inertial
    assert masses is not None
    share = masses.masses / robot.inertial.masses
    elbows = flights.q[:, robot.joint_names.index("elbow_pitch")] - np.pi / 2
    goal = Rotation.from_quat(load_scenario("arm_attitude").goal.quaternion)
    turns = (goal.inv() * Rotation.from_quat(episodes.goals)).as_rotvec()
    np.testing.assert_allclose(turns[:, :2], 0.0, atol=1e-12)
    for values, low, high in ((share, 0.9, 1.1), (elbows, -0.3, 0.3), (turns[:, 2], -0.05, 0.05)):
        assert low <= values.min() < low + (high - low) / 2 < values.max() <= high
