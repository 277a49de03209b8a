"""Engines by name; each flies the same flight for the same draw."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache

from spacerobot_ros.campaign.config import Campaign
from spacerobot_ros.campaign.draws import Draw
from spacerobot_ros.campaign.lanes import LanesEngine
from spacerobot_ros.campaign.one_by_one import FlightsEngine
from spacerobot_ros.campaign.rows import FLIGHTS, Engine, Fallback, Row
from spacerobot_ros.errors import SpaceRobotError

ENGINE_FACTORIES: Mapping[str, Callable[[], Engine]] = {
    "lanes": LanesEngine,
    "flights": FlightsEngine,
}
"""Engines by name, in order of preference."""


def select_engine(campaign: Campaign, engine_name: str) -> Engine:
    """Return the engine ``engine_name``; ``auto`` selects the first engine that can fly the
    campaign.

    Raises
    ------
    SpaceRobotError
        The engine cannot fly the campaign, or no engine can; the message states the reason.
    """
    if engine_name != "auto":
        engine = ENGINE_FACTORIES[engine_name]()
        reason = engine.refusal(campaign)
        if reason:
            raise SpaceRobotError(f"The engine '{engine_name}' cannot fly this campaign: {reason}")
        return engine
    reasons = []
    for name, make in ENGINE_FACTORIES.items():
        engine = make()
        reason = engine.refusal(campaign)
        if not reason:
            return engine
        reasons.append(f"{name}: {reason}")
    raise SpaceRobotError(f"No engine can fly this campaign. {' '.join(reasons)}")


@cache
def engine_by_name(name: str) -> Engine:
    """Return an engine by name, one instance per process, which reuses its models."""
    return ENGINE_FACTORIES[name]()


def fly_all(
    engine: Engine, campaign: Campaign, draws: Iterable[Draw], stopped: Callable[[], bool]
) -> Iterator[Row]:
    """Yield a row for each draw; fallbacks are flown last."""
    fallbacks: list[Fallback] = []
    for made in engine.fly(campaign, draws, stopped):
        if isinstance(made, Fallback):
            fallbacks.append(made)
        else:
            yield made
    reasons = {each.draw.number: each.reason for each in fallbacks}
    for row in engine_by_name(FLIGHTS).fly(campaign, [each.draw for each in fallbacks], stopped):
        assert isinstance(row, Row), "the engine 'flights' has no fallbacks"
        yield replace(row, fallback=reasons[row.draw.number])
