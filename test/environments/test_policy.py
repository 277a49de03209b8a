"""Policies: the network that NumPy evaluates, its file, and the one that is in the repository."""

from __future__ import annotations

from math import tanh
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from spacerobot_ros.environments.policy import Policy
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.compilation import cxx_compiler

ROOT = Path(__file__).resolve().parents[2]
SMALL = Policy(
    [np.array([[1.0, -2.0], [0.5, 0.25], [0.0, 3.0]]), np.array([[2.0, 0.0, -1.0]])],
    [np.array([0.1, -0.2, 0.3]), np.array([0.4])],
)


def test_hidden_layers_end_in_tanh_and_actions_are_clipped() -> None:
    x, y = 0.3, -0.1
    hidden = tanh(x - 2 * y + 0.1), tanh(0.5 * x + 0.25 * y - 0.2), tanh(3 * y + 0.3)
    wanted = 2 * hidden[0] - hidden[2] + 0.4
    assert wanted > 1.0
    assert SMALL([x, y]) == pytest.approx([1.0], rel=0, abs=0)
    far = Policy(SMALL.weights, [SMALL.biases[0], np.array([-0.6])])
    assert far([[x, y], [-9.0, 9.0]]) == pytest.approx(
        np.array([[wanted - 1.0], [-1.0]]), rel=1e-14
    )
    one_layer = Policy([np.array([[0.5]])], [np.array([0.25])])
    assert one_layer([[0.5]]) == pytest.approx(np.array([[0.5]]), rel=0, abs=0)


def test_a_policy_is_the_same_from_its_file(tmp_path: Path) -> None:
    SMALL.save(tmp_path / "small.npz")
    read = Policy.load(tmp_path / "small.npz")
    for part in ("weights", "biases"):
        for one, other in zip(getattr(read, part), getattr(SMALL, part), strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("weights", "biases", "message"),
    [
        ([], [], "the outputs of the one before"),
        ([np.ones((2, 3)), np.ones((1, 3))], [np.ones(2), np.ones(1)], "before"),
        ([np.ones((2, 3))], [np.ones(3)], "before"),
        ([np.ones((2, 3))], [], "before"),
        ([np.ones(3)], [np.ones(3)], "before"),
        ([np.array(1.0)], [np.array(1.0)], "before"),
        ([np.array([[np.nan]])], [np.ones(1)], "not finite"),
        ([np.ones((1, 1))], [np.array([np.inf])], "not finite"),
    ],
)
def test_layers_that_make_no_network_are_refused(weights: Any, biases: Any, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        Policy(weights, biases)


def test_a_file_that_is_no_policy_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "policy.npz"
    with pytest.raises(ParameterError, match=r"policy\.npz is no policy: .*No such file"):
        Policy.load(file)
    file.write_text("1.0 2.0\n")
    with pytest.raises(ParameterError, match="is no policy"):
        Policy.load(file)
    file.write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(ParameterError, match="is no policy"):
        Policy.load(file)
    np.save(tmp_path / "array.npy", np.ones((2, 2)))
    with pytest.raises(ParameterError, match="is no policy"):
        Policy.load(tmp_path / "array.npy")
    for arrays in ({"other": np.ones((2, 2))}, {"layer_0": np.ones(3)}, {}):
        np.savez(file, **arrays)
        with pytest.raises(ParameterError, match=r"polic"):
            Policy.load(file)
    np.savez(file, layer_0=np.array([["a", "b"]]))
    with pytest.raises(ParameterError, match="is no policy"):
        Policy.load(file)
    np.savez(file, layer_0=np.array([[{}]]))
    with pytest.raises(ParameterError, match="is no policy"):
        Policy.load(file)


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
