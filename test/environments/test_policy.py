"""The policy of the examples reaches its goals."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from policies.network import Policy

import spacerobot_ros.environments  # noqa: F401 - registers the environments
from spacerobot_ros.model.compilation import find_compiler

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.skipif(find_compiler("cpp") is None, reason="there is no C++ compiler")
def test_the_policy_of_the_examples_reaches_its_goals() -> None:
    policy = Policy.load(ROOT / "examples" / "policies" / "reorient_arm.npz")
    env = gymnasium.make_vec(
        "spacerobot/ReorientArm-v0", 256, hold=5, time_limit=30.0, autoreset_mode="Disabled"
    )
    seen, _ = env.reset(seed=12_345)
    episodes = env.unwrapped.episodes
    reached = np.zeros(256, dtype=bool)
    for _ in range(120):
        episodes.step(policy(seen))
        reached |= episodes.reached
        episodes.flights.end(np.flatnonzero(reached))
        seen = episodes.observations
    # A policy that does nothing reaches the goals that are within the tolerance, 7 % of these.
    assert reached.mean() >= 0.98


def test_the_adapter_of_stable_baselines_has_the_episodes_of_the_vector() -> None:
    """Terminal observations, successes and truncations arrive in the shape of that library."""
    pytest.importorskip("stable_baselines3")
    from spacerobot_ros.environments.stable_baselines import SpaceRobotVecEnv

    name, arguments = "spacerobot/ReorientArm-v0", {"scenario": "planar_chain", "time_limit": 0.03}
    there = gymnasium.make_vec(name, 3, autoreset_mode="SameStep", **arguments)
    here = SpaceRobotVecEnv(name, 3, **arguments)
    here.seed(5)
    goals = [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.2, 1.0], [0.0, 0.0, 0.3, 1.0]]
    here.set_options([{"goal": goal} for goal in goals])
    wanted, _ = there.reset(seed=5, options={"goal": goals})
    np.testing.assert_array_equal(here.reset(), wanted)
    for step in range(1, 4):
        seen, rewards, ended, told = here.step(np.zeros((3, 2)))
        *wanted, infos = there.step(np.zeros((3, 2)))
        np.testing.assert_array_equal(seen, wanted[0])
        np.testing.assert_array_equal(rewards, wanted[1])
        assert ended.tolist() == (wanted[2] | wanted[3]).tolist()
        assert step > 1 or told[0]["is_success"]
    assert [each["TimeLimit.truncated"] for each in told[1:]] == [True, True]
    np.testing.assert_array_equal(told[1]["terminal_observation"], infos["final_obs"][1])
    here.set_attr("spread", 0.4)
    assert here.get_attr("spread", [0, 2]) == [0.4, 0.4]
