"""Earlier location of :mod:`spacerobot_ros.scenario`; deprecated after version 0.2."""

from spacerobot_ros.scenario import (
    COMMANDERS,
    Kill,
    Published,
    Scenario,
    load_scenario,
    parse_kills,
    scenario_names,
    scenario_of,
    scenario_or_robot,
    scenario_text,
)

__all__ = [
    "COMMANDERS",
    "Kill",
    "Published",
    "Scenario",
    "load_scenario",
    "parse_kills",
    "scenario_names",
    "scenario_of",
    "scenario_or_robot",
    "scenario_text",
]
