"""Gymnasium environments: one robot in a plant, or many in SIMD lanes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from spacerobot_ros.environments import import_gymnasium
from spacerobot_ros.environments.episodes import ARGUMENTS, EpisodeConfig, Episodes
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.parameters import require_names

import_gymnasium()  # States how to install it if it is missing.

import gymnasium  # noqa: E402
from gymnasium.error import Error, ResetNeeded  # noqa: E402
from gymnasium.spaces import Box  # noqa: E402
from gymnasium.utils import EzPickle  # noqa: E402
from gymnasium.utils.seeding import np_random  # noqa: E402
from gymnasium.vector import AutoresetMode, VectorEnv  # noqa: E402
from gymnasium.vector.utils import batch_space  # noqa: E402


def _prepare(
    environment: Any, count: int, arguments: Mapping[str, Any], render_mode: str | None, lanes: bool
) -> tuple[Any, Any]:
    if render_mode not in (None, "rgb_array"):
        # After this type of error, libraries create environments without render_mode.
        raise TypeError(f"There is no render_mode '{render_mode}': use 'rgb_array', or omit it.")
    if render_mode and arguments.get("device"):
        raise TypeError("Environments on a device have no pictures: omit render_mode.")
    episodes = Episodes(EpisodeConfig.of(arguments), count, in_lanes=lanes)
    environment.episodes, environment.render_mode = episodes, render_mode
    fps = {"render_modes": ["rgb_array"], "render_fps": 1.0 / episodes.step_duration}
    environment.metadata = {**environment.metadata, **fps}
    dtype = episodes.observations.dtype.type
    low, high = (bound.astype(dtype) for bound in episodes.task.observation_bounds())
    return Box(low, high, dtype=dtype), Box(-1.0, 1.0, (len(episodes.taken),), dtype=dtype)


def _begin_options(options: Mapping[str, Any] | None) -> dict[str, Any]:
    if not isinstance(options, Mapping | None):
        raise ParameterError(f"The reset options are {options!r}: pass a dictionary.")
    require_names("A reset has no option", options or {}, ("goal", "start", "reset_mask"))
    return {name: value for name, value in (options or {}).items() if name != "reset_mask"}


def _seeds_of(seed: Any, count: int) -> list[int | None]:
    """Return a seed for each environment: those of a list, or s + i for a number s."""
    alone = not isinstance(seed, list | tuple | np.ndarray)
    each = [seed] * count if alone else list(seed)
    if len(each) != count:
        raise ValueError(f"There are {len(each)} seeds for {count} environments.")
    if not all(one is None or (isinstance(one, int | np.integer) and one >= 0) for one in each):
        raise Error(
            f"The seed is {seed!r}: give a nonnegative integer, or a list of {count} of them or "
            "None."
        )
    return [None if one is None else int(one) + alone * i for i, one in enumerate(each)]


class SpaceRobotEnv(gymnasium.Env, EzPickle):
    """One robot, stepped by a plant. The arguments are those of `EpisodeConfig`.

    A copy (also by pickling) has the same arguments but a new state.
    `get_wrapper_attr` and `set_wrapper_attr` read and change arguments and task attributes; see
    `Episodes.change`.

    Raises
    ------
    ParameterError
        An argument is refused.
    TypeError
        There is no such render mode.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(self, *, render_mode: str | None = None, **arguments: Any) -> None:
        EzPickle.__init__(self, render_mode=render_mode, **arguments)
        self.episodes: Episodes
        self.observation_space, self.action_space = _prepare(
            self, 1, arguments, render_mode, lanes=False
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode; options ``goal`` and ``start`` override the drawn values."""
        super().reset(seed=seed)
        self.episodes.begin([0], [self.np_random], **_begin_options(options))
        return self.episodes.observations[0].copy(), self._info()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Step by the ticks of one action."""
        episodes = self.episodes
        episodes.step(np.asarray(action)[np.newaxis])
        ended = bool(episodes.terminations[0]), bool(episodes.truncations[0])
        info = self._info()
        if any(ended):
            info["is_success"] = bool(episodes.reached[0])
        return episodes.observations[0].copy(), float(episodes.rewards[0]), *ended, info

    def render(self) -> Any:
        """Return a picture (480, 640, 3) of the robot and its goal; None without a render mode."""
        return self.episodes.picture(0) if self.render_mode else None

    def has_wrapper_attr(self, name: str) -> bool:
        """Return whether this environment or its episodes have an attribute with this name."""
        return hasattr(self, name) or self.episodes.has_attribute(name)

    def get_wrapper_attr(self, name: str) -> Any:
        """Return an attribute."""
        return getattr(self, name) if hasattr(self, name) else self.episodes.attribute(name)

    def set_wrapper_attr(self, name: str, value: Any, *, force: bool = True) -> bool:
        """Change an attribute; see `Episodes.change`."""
        if name not in ARGUMENTS and not self.episodes.has_attribute(name):
            return bool(super().set_wrapper_attr(name, value, force=force))
        self.episodes.change(name, value)
        return True

    def _info(self) -> dict[str, Any]:
        return {"error": float(self.episodes.errors[0])}


class SpaceRobotVectorEnv(VectorEnv, EzPickle):
    """Many robots in SIMD lanes, with the same episodes as :class:`SpaceRobotEnv`.

    With seed s, lane i has the same episodes as a single environment with seed s + i. A copy
    (also by pickling) has the same arguments but a new state. On a device, all arrays are device
    arrays, one generator serves all robots, and ``final_obs`` is one array.

    Parameters
    ----------
    num_envs
        Number of robots.
    autoreset_mode
        When ended episodes are restarted: ``NextStep``, ``SameStep`` or ``Disabled``.
    arguments
        Those of `EpisodeConfig`.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        autoreset_mode: Any = AutoresetMode.NEXT_STEP,
        *,
        render_mode: str | None = None,
        **arguments: Any,
    ) -> None:
        EzPickle.__init__(self, num_envs, autoreset_mode, render_mode=render_mode, **arguments)
        self.episodes: Episodes
        self.num_envs, self.autoreset_mode = num_envs, AutoresetMode(autoreset_mode)
        self.single_observation_space, self.single_action_space = _prepare(
            self, num_envs, arguments, render_mode, lanes=True
        )
        self.metadata["autoreset_mode"] = self.autoreset_mode
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._arrays = self.episodes.flights.arrays
        self._on_device = bool(arguments.get("device"))
        self._generators: Any = []
        if self._on_device:
            self._seed_device(None)
        else:
            seeded = [np_random(None) for _ in range(num_envs)]
            self._generators = [generator for generator, _ in seeded]
            self._seeds = [seed for _, seed in seeded]
        self._begun = self._arrays.zeros(num_envs, dtype=np.bool_)
        self._ended = self._arrays.zeros(num_envs, dtype=np.bool_)
        """Episodes that have ended and have not been restarted."""

    @property
    def np_random_seed(self) -> tuple[int, ...]:
        """Seeds of the robots' random generators."""
        return tuple(self._seeds)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """Random generators of the robots; on a device, the generator for all."""
        return (self._generators,) if self._on_device else tuple(self._generators)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Start all episodes, or only those in ``options["reset_mask"]`` (num_envs,).

        Options ``goal`` and ``start``, each given once for all robots or once per robot, override
        the drawn values.
        """
        mask, begin = self._arrays.ones(self.num_envs, dtype=np.bool_), _begin_options(options)
        if options is not None and "reset_mask" in options:
            mask = self._arrays.asarray(options["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise ValueError(
                    f"options['reset_mask'] must be {self.num_envs} booleans, at least one true."
                )
        rows = self._arrays.flatnonzero(mask)
        if self._on_device:
            if seed is not None:
                self._seed_device(seed)
        else:
            seeds = _seeds_of(seed, self.num_envs)
            for row in rows.tolist():
                if (own := seeds[row]) is not None:
                    self._generators[row], self._seeds[row] = np_random(own)
        self._begin(rows, **begin)
        self._begun |= mask
        return self.episodes.observations.copy(), self._info(mask)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Step all environments; ended episodes are reset according to the autoreset mode."""
        episodes, mode = self.episodes, self.autoreset_mode
        if not self._begun.all():
            raise ResetNeeded(
                f"{int((~self._begun).sum())} robots have no episode yet: reset them before the "
                "first step."
            )
        if mode is AutoresetMode.DISABLED and self._ended.any():
            raise ResetNeeded(
                f"{int(self._ended.sum())} episodes have ended: reset them with "
                "options['reset_mask'] before the next step."
            )
        again = self._arrays.flatnonzero(self._ended)
        if again.size:
            episodes.flights.end(again)
        episodes.step(actions)
        if again.size:
            self._begin(again)
        ended = episodes.terminations | episodes.truncations
        infos: dict[str, Any] = {}
        if ended.any():
            infos = {"is_success": episodes.reached & ended, "_is_success": ended.copy()}
        self._ended = ended.copy()
        if mode is AutoresetMode.SAME_STEP and ended.any():
            rows = self._arrays.flatnonzero(ended)
            last = episodes.observations.copy()
            if not self._on_device:
                seen, last = last, np.full(self.num_envs, None, dtype=object)
                for row in rows.tolist():
                    last[row] = seen[row]
            infos = {"final_info": infos | self._info(ended), "_final_info": ended.copy()}
            infos |= {"final_obs": last, "_final_obs": ended.copy()}
            self._begin(rows)
        infos |= self._info(self._arrays.ones(self.num_envs, dtype=np.bool_))
        results = episodes.rewards, episodes.terminations, episodes.truncations
        return episodes.observations.copy(), *results, infos

    def render(self) -> Any:
        """Return a picture (480, 640, 3) of each robot and its goal; None without a render mode."""
        if self.render_mode is None:
            return None
        return tuple(self.episodes.picture(row) for row in range(self.num_envs))

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """Return the value of an attribute that all robots share, repeated for each robot; see
        `Episodes.change`.
        """
        return (self.episodes.attribute(name),) * self.num_envs

    def set_attr(self, name: str, values: Any) -> None:
        """Change an attribute of all robots; see `Episodes.change`."""
        self.episodes.change(name, values)

    def _seed_device(self, seed: Any) -> None:
        (checked,) = _seeds_of(seed if seed is None else [seed], 1)
        self._seeds = [np_random(checked)[1]]
        self._generators = self._arrays.random.default_rng(self._seeds[0])

    def _begin(self, rows: Any, **options: Any) -> None:
        self.episodes.begin(rows, self._generators, **options)
        self._ended[rows] = False

    def _info(self, mask: Any) -> dict[str, Any]:
        return {"error": np.where(mask, self.episodes.errors, 0.0), "_error": mask}
