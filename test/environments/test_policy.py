"""The policy of the examples reaches its goals."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from policies.network import Policy

import spacerobot_ros.environments  # noqa: F401 - registers the environments
from spacerobot_ros.model.compilation import cxx_compiler

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.skipif(cxx_compiler() is None, reason="there is no C++ compiler")
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
        episodes.end(np.flatnonzero(reached))
        seen = episodes.observations
    # A policy that does nothing reaches the goals that are within the tolerance, 7 % of these.
    assert reached.mean() >= 0.98
