"""A small campaign from Python: one function, in the words of ``fly``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy.typing as npt

from spacerobot_ros.campaign.config import parse_campaign
from spacerobot_ros.campaign.dataset import Dataset
from spacerobot_ros.campaign.running import run_campaign
from spacerobot_ros.flight.api import scenario_to_fly
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal
from spacerobot_ros.scenario import Scenario


def sweep(
    what: SpaceRobot | Scenario | str | Path,
    disperse: Mapping[str, Any],
    goal: Goal | npt.ArrayLike | None = None,
    *,
    position: npt.ArrayLike | None = None,
    rotvec: npt.ArrayLike | None = None,
    method: str | None = None,
    seed: int = 0,
    flights: int = 100,
    folder: Path | None = None,
    **section: Any,
) -> Any:
    """Fly a small campaign, and return a row for each flight.

    ``sweep("coordinated_control", {"plant.sensors.position_noise": {"uniform": [0, 0.01]}})``.

    Parameters
    ----------
    what, goal, position, rotvec, method
        As for :func:`~spacerobot_ros.flight.api.fly`.
    disperse
        Distributions by the name of the quantity, as in a file of a campaign.
    seed, flights
        Seed of the draws, and their number.
    folder
        Where the dataset is kept, which a later call goes on with; None: nowhere.
    section
        Other keys of a file of a campaign: ``sampler``, ``criteria``, ``engine``, ``longest``.

    Returns
    -------
    A table of pyarrow, whose ``to_pandas`` makes a data frame: the columns of a dataset.

    Raises
    ------
    SpaceRobotError
        A key or value is refused, or pyarrow or scipy is not installed.
    """
    scenario = scenario_to_fly(what, goal, position, rotvec)
    scenario.require_goal()
    if method is not None:
        scenario = scenario.with_method(method)
    given = {**section, "disperse": dict(disperse), "flights": flights, "seed": seed}
    campaign = parse_campaign(scenario.name, given, scenario=scenario)
    with TemporaryDirectory() as left_nowhere:
        kept = Path(left_nowhere) / "sweep" if folder is None else folder
        run_campaign(campaign, kept)
        return Dataset(kept).table()
