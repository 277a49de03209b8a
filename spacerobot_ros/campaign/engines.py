"""Engines by name; all engines fly the same flight for the same draw."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import cache
from importlib.util import find_spec

from spacerobot_ros.batch.targets import device_named
from spacerobot_ros.campaign.config import FLIGHTS, Campaign
from spacerobot_ros.campaign.dataset import Row
from spacerobot_ros.campaign.draws import Draw
from spacerobot_ros.campaign.lanes import LanesEngine
from spacerobot_ros.campaign.one_by_one import FlightsEngine
from spacerobot_ros.errors import SpaceRobotError

_FLIGHTS_WORTH_A_DEVICE = 100_000
"""Minimum number of flights under coordinated control for which a device saves more time than its
program takes to compile; other campaigns spend most of their time planning."""


Engine = LanesEngine | FlightsEngine


def select_engine(campaign: Campaign, engine_name: str, *, local: bool = True) -> Engine:
    """Return the engine ``engine_name``; ``auto`` selects the first engine that can fly the
    campaign, including devices if the flights are ``local``.

    Raises
    ------
    SpaceRobotError
        The engine cannot fly the campaign, or no engine can; the message states the reason.
    """
    reasons, names = [], [engine_name]
    if engine_name == "auto":
        names = [*["cuda"] * (local and _is_worth_a_device(campaign)), "lanes", FLIGHTS]
    for name in names:
        engine = engine_by_name(name)
        reason = engine.refusal(campaign)
        if not reason:
            return engine
        reasons.append(f"The engine '{name}' cannot fly this campaign: {reason}")
    raise SpaceRobotError(" ".join(reasons))


def _is_worth_a_device(campaign: Campaign) -> bool:
    is_large = campaign.flights >= _FLIGHTS_WORTH_A_DEVICE
    if not is_large or "planner" in campaign.scenario.commanders or not find_spec("cupy"):
        return False
    try:
        device_named("cuda")
    except SpaceRobotError:
        return False
    return True


@cache
def engine_by_name(name: str) -> Engine:
    """Return an engine by name: one instance per process, so that its models are reused."""
    return FlightsEngine() if name == FLIGHTS else LanesEngine(name)


def fly_all(
    engine: Engine, campaign: Campaign, draws: Iterable[Draw], stopped: Callable[[], bool]
) -> Iterator[Row]:
    """Yield a row for each draw; fallbacks are flown last."""
    fallbacks: list[Draw] = []
    for made in engine.fly(campaign, draws, stopped):
        if isinstance(made, Row):
            yield made
        else:
            fallbacks.append(made)
    yield from FlightsEngine().fly(campaign, fallbacks, stopped)
