"""Engines by name; all engines fly the same flight for the same draw."""

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
    reasons = []
    for name in ENGINE_FACTORIES if engine_name == "auto" else (engine_name,):
        engine = engine_by_name(name)
        reason = engine.refusal(campaign)
        if not reason:
            return engine
        reasons.append(f"The engine '{name}' cannot fly this campaign: {reason}")
    raise SpaceRobotError(" ".join(reasons))


@cache
def engine_by_name(name: str) -> Engine:
    """Return an engine by name: one instance per process, so that its models are reused."""
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
