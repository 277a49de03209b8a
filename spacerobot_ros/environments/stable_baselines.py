"""Many robots in SIMD lanes for stable-baselines3."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from spacerobot_ros.environments import register
from spacerobot_ros.resources import optional_module

optional_module("stable_baselines3", "sb3", "This adapter needs")

from stable_baselines3.common.vec_env import VecEnv  # noqa: E402


class SpaceRobotVecEnv(VecEnv):
    """A vector environment from `gymnasium.make_vec` as a stable-baselines3 `VecEnv`.

    Parameters
    ----------
    name
        Name of the environment.
    num_envs
        Number of robots.
    arguments
        Environment arguments; see `EpisodeConfig`.
    """

    def __init__(self, name: str, num_envs: int, **arguments: Any) -> None:
        register()
        made = gymnasium.make_vec(name, num_envs, autoreset_mode="SameStep", **arguments)
        self.env: Any = made.unwrapped
        super().__init__(num_envs, made.single_observation_space, made.single_action_space)

    def reset(self) -> Any:
        """Start all episodes with the seeds and options set previously."""
        options = {name: [each[name] for each in self._options] for name in self._options[0]}
        seen, infos = self.env.reset(seed=self._seeds, options=options)
        self.reset_infos = [{"error": error} for error in infos["error"]]
        self._reset_seeds()
        self._reset_options()
        return seen

    def step_async(self, actions: Any) -> None:
        """Step all environments; those whose episode has ended are reset."""
        self._stepped = self.env.step(actions)

    def step_wait(self) -> tuple[Any, Any, Any, list[dict[str, Any]]]:
        """Return observations, rewards, end flags, and information about ended episodes."""
        seen, rewards, terminated, truncated, infos = self._stepped
        told: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in np.flatnonzero(ended := terminated | truncated):
            told[row] = {
                "is_success": infos["final_info"]["is_success"][row],
                "terminal_observation": infos["final_obs"][row],
                "TimeLimit.truncated": truncated[row],
            }
        return seen, rewards, ended, told

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute for each robot; see `SpaceRobotVectorEnv.get_attr`."""
        if attr_name == "render_mode":
            return [self.env.render_mode] * self.num_envs
        return [self.env.get_attr(attr_name)[0]] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Change an attribute that is shared by all robots."""
        self.env.set_attr(attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **named: Any) -> Any:
        """Call a method of the vector environment."""
        return [getattr(self.env, method_name)(*args, **named)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """Return False for every robot, because no robot is wrapped."""
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self) -> Any:
        """Return a picture of each robot."""
        return self.env.render()

    def close(self) -> None:
        """Close the environment."""
        self.env.close()
