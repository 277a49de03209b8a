"""The environments as Gymnasium knows them: one robot in a plant, or many in SIMD lanes."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spacerobot_ros.environments import import_gymnasium
from spacerobot_ros.environments.episodes import EpisodeConfig, Episodes
from spacerobot_ros.errors import ParameterError

import_gymnasium()  # Says how to install it where it is missing.

import gymnasium  # noqa: E402
from gymnasium.error import Error, ResetNeeded  # noqa: E402
from gymnasium.spaces import Box  # noqa: E402
from gymnasium.utils import EzPickle  # noqa: E402
from gymnasium.utils.seeding import np_random  # noqa: E402
from gymnasium.vector import AutoresetMode, VectorEnv  # noqa: E402
from gymnasium.vector.utils import batch_space  # noqa: E402


def _spaces(episodes: Episodes) -> tuple[Any, Any]:
    low, high = episodes.task.observation_bounds()
    size = (episodes.action_size,)
    return Box(low, high, dtype=np.float64), Box(-1.0, 1.0, size, dtype=np.float64)


def _require_no_rendering(render_mode: str | None) -> None:
    """Refuse a render mode by the error after which libraries make environments without one."""
    if render_mode is not None:
        raise TypeError(
            f"There is no render_mode '{render_mode}': environments are not rendered; leave it out."
        )


def _goal_in(options: Mapping[str, Any] | None) -> Any:
    """Return the goal of options of a reset, which are refused if there are others."""
    if options is None:
        return None
    if not isinstance(options, Mapping):
        raise ParameterError(f"The options of a reset are {options!r}: give a dictionary.")
    for name in options:
        if name not in ("goal", "reset_mask"):
            raise ParameterError(
                f"There is no option '{name}' of a reset; there are goal, and of vectors "
                "reset_mask."
            )
    return options.get("goal")


def _seeds_of(seed: Any, count: int) -> list[int | None]:
    """Return a seed for each environment: those of a list, or s + i of a number s."""
    try:
        if seed is None or isinstance(seed, int | np.integer):
            seeds = [None if seed is None else int(seed) + i for i in range(count)]
        else:
            seeds = [None if each is None else operator.index(each) for each in seed]
    except TypeError:
        raise Error(
            f"The seed is {seed!r}: give a whole number, or a list of {count} of them or None."
        ) from None
    if len(seeds) != count:
        raise ValueError(f"There are {len(seeds)} seeds of {count} environments.")
    if any(each is not None and each < 0 for each in seeds):
        raise Error(f"The seed is {seed!r}: seeds are whole numbers from 0.")
    return seeds


class SpaceRobotEnv(gymnasium.Env, EzPickle):
    """One robot; its step is that of the plant. The arguments are those of `EpisodeConfig`.

    A copy, by pickle too, has the arguments and begins again.

    Raises
    ------
    ParameterError
        An argument is refused.
    TypeError
        A render mode is given.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(self, *, render_mode: str | None = None, **arguments: Any) -> None:
        _require_no_rendering(render_mode)
        EzPickle.__init__(self, **arguments)
        self.episodes = Episodes(EpisodeConfig.of(arguments), 1, in_lanes=False)
        self.observation_space, self.action_space = _spaces(self.episodes)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; ``options["goal"]`` replaces the goal that is drawn."""
        super().reset(seed=seed)
        self.episodes.begin([0], [self.np_random], _goal_in(options))
        return self.episodes.observations[0], self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step for the ticks of an action."""
        episodes = self.episodes
        episodes.step(np.asarray(action)[np.newaxis])
        ended = bool(episodes.terminations[0]), bool(episodes.truncations[0])
        info = self._info()
        if any(ended):
            info["is_success"] = bool(episodes.reached[0])
        return episodes.observations[0], float(episodes.rewards[0]), *ended, info

    def _info(self) -> dict[str, Any]:
        return {"error": float(self.episodes.errors[0])}


class SpaceRobotVectorEnv(VectorEnv, EzPickle):
    """Many robots in SIMD lanes, each with the episodes of :class:`SpaceRobotEnv`.

    Lane i of a seed s has the episodes of one environment with the seed s + i. A copy, by pickle
    too, has the arguments and begins again.

    Parameters
    ----------
    num_envs
        Number of robots.
    autoreset_mode
        When episodes that have ended begin again: ``NextStep``, ``SameStep`` or ``Disabled``.
    arguments
        Those of `EpisodeConfig`.

    Raises
    ------
    ParameterError
        An argument is refused.
    TypeError
        A render mode is given.
    """

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: Any = AutoresetMode.NEXT_STEP,
        *,
        render_mode: str | None = None,
        **arguments: Any,
    ) -> None:
        _require_no_rendering(render_mode)
        EzPickle.__init__(self, num_envs, autoreset_mode, **arguments)
        self.num_envs, self.render_mode = num_envs, None
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.episodes = Episodes(EpisodeConfig.of(arguments), num_envs, in_lanes=True)
        self.single_observation_space, self.single_action_space = _spaces(self.episodes)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        seeded = [np_random(None) for _ in range(num_envs)]
        self._generators = [generator for generator, _ in seeded]
        self._seeds = [seed for _, seed in seeded]
        self._begun = np.zeros(num_envs, dtype=np.bool_)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        """Episodes that have ended and not begun again."""

    @property
    def np_random_seed(self) -> tuple[int, ...]:
        """Seeds of the robots' random generators."""
        return tuple(self._seeds)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """Random generators of the robots."""
        return tuple(self._generators)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin all episodes, or those of ``options["reset_mask"]`` (num_envs,) alone.

        ``options["goal"]``, one for all or one for each robot, replaces the goals that are drawn.
        """
        mask, goal = np.ones(self.num_envs, dtype=np.bool_), _goal_in(options)
        if options is not None and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise ValueError(
                    f"options['reset_mask'] must be {self.num_envs} booleans, at least one true."
                )
        seeds, rows = _seeds_of(seed, self.num_envs), np.flatnonzero(mask)
        for row in rows.tolist():
            if (own := seeds[row]) is not None:
                self._generators[row], self._seeds[row] = np_random(own)
        self._begin(rows, goal)
        self._begun |= mask
        return self.episodes.observations.copy(), self._info(mask)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all episodes; those that have ended begin again by the autoreset mode."""
        episodes, mode = self.episodes, self.autoreset_mode
        if not self._begun.all():
            raise ResetNeeded(
                f"{int((~self._begun).sum())} robots have no episode yet: reset them before the "
                "first step."
            )
        if mode is AutoresetMode.DISABLED and self._ended.any():
            raise ResetNeeded(
                f"{int(self._ended.sum())} episodes have ended: reset them by options['reset_mask']"
                " before the next step."
            )
        again = np.flatnonzero(self._ended)
        if again.size:
            episodes.end(again)
        episodes.step(actions)
        if again.size:
            self._begin(again)
        terminations, truncations = episodes.terminations.copy(), episodes.truncations.copy()
        rewards, self._ended = episodes.rewards.copy(), terminations | truncations
        infos: dict[str, Any] = {}
        ended = np.flatnonzero(self._ended)
        if mode is AutoresetMode.SAME_STEP and ended.size:
            last, errors = episodes.observations.copy(), episodes.errors.copy()
            reached = episodes.reached.copy()
            for row in ended.tolist():
                info = {"error": float(errors[row]), "is_success": bool(reached[row])}
                infos = self._add_info(infos, {"final_obs": last[row], "final_info": info}, row)
            self._begin(ended)
        elif ended.size:
            infos["is_success"] = episodes.reached & self._ended
            infos["_is_success"] = self._ended.copy()
        infos |= self._info(np.ones(self.num_envs, dtype=np.bool_))
        return episodes.observations.copy(), rewards, terminations, truncations, infos

    def _begin(self, rows: Any, goal: Any = None) -> None:
        self.episodes.begin(rows, self._generators, goal)
        self._ended[rows] = False

    def _info(self, mask: Any) -> dict[str, Any]:
        return {"error": np.where(mask, self.episodes.errors, 0.0), "_error": mask}
