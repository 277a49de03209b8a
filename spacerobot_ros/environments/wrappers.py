"""Wrappers of vector environments, for autoreset modes that those of Gymnasium do not take."""

from __future__ import annotations

from typing import Any

import numpy as np

from spacerobot_ros.environments import import_gymnasium

import_gymnasium()  # Says how to install it where it is missing.

from gymnasium.spaces import Box  # noqa: E402
from gymnasium.vector import VectorEnv, VectorWrapper  # noqa: E402
from gymnasium.vector.utils import batch_space  # noqa: E402
from gymnasium.wrappers.utils import RunningMeanStd  # noqa: E402


class NormalizeObservation(VectorWrapper):
    """Observations less their running mean, over their running standard deviation.

    That of Gymnasium, in every autoreset mode: its own takes ``NextStep`` alone, with the same
    numbers. Each observation is counted once: the last ones of episodes that begin anew in the same
    step (``final_obs``, which are normalised too) are, and those of robots that a reset leaves out
    are not. ``update_running_mean = False`` keeps the statistics as they are.

    Parameters
    ----------
    env
        The vector environment.
    epsilon
        Positive number that is added to the variance.
    """

    def __init__(self, env: VectorEnv, epsilon: float = 1e-8) -> None:
        super().__init__(env)
        shape: Any = env.single_observation_space.shape
        self.single_observation_space = Box(-np.inf, np.inf, shape, dtype=np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.obs_rms = RunningMeanStd(shape=shape)
        self.epsilon = epsilon
        self.update_running_mean = True

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment; observations that are new are counted."""
        # Read before it is taken out of the options.
        mask = (options or {}).get("reset_mask", slice(None))
        observations, infos = self.env.reset(seed=seed, options=options)
        self._count(observations[mask])
        return self._normalized(observations), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step the environment; its observations are counted."""
        observations, *rest, infos = self.env.step(actions)
        last = infos.get("final_obs")
        if last is None:
            self._count(observations)
        else:
            ended = np.flatnonzero(infos["_final_obs"])
            self._count(np.concatenate([np.stack(last[ended].tolist()), observations]))
            normalized = last.copy()
            for row in ended.tolist():
                normalized[row] = self._normalized(last[row])
            infos["final_obs"] = normalized
        rewards, terminations, truncations = rest
        return self._normalized(observations), rewards, terminations, truncations, infos

    def _count(self, observations: Any) -> None:
        if self.update_running_mean:
            self.obs_rms.update(observations)

    def _normalized(self, observations: Any) -> Any:
        deviation = np.sqrt(self.obs_rms.var + self.epsilon)
        return ((observations - self.obs_rms.mean) / deviation).astype(np.float32)
