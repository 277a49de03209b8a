"""Parameters, plans and reports stay what users' files and earlier flights rely on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from support.expected import (
    ANALYSED,
    BAGS,
    CAMPAIGN_PAGES,
    COMMAND_TABLE,
    PARAMETERS,
    PLANS,
    REPORTS,
    TOPIC_TABLE,
    VIEWER,
    command_prints,
    differences,
    parameters,
    plans,
    topic_prints,
)
from support.figure_prints import PARTS, analysis_prints, report_part
from support.page_prints import CAMPAIGNS
from support.slow import some_fast
from support.viewer_prints import SITUATIONS, viewer_prints

WRITE = "If this is wanted, `make expected` writes the file anew."


def kept_in(file: Path) -> Any:
    return json.loads(file.read_text("utf-8"))


def as_kept(found: dict[str, Any]) -> Any:
    return json.loads(json.dumps(found))


def check(found: Any, kept: Any) -> None:
    problems = differences(found, kept)
    assert not problems, "\n".join([*problems[:40], WRITE])


def test_parameters_keep_names_types_defaults_and_limits() -> None:
    kept = kept_in(PARAMETERS)
    found = as_kept(parameters())
    assert {node: sorted(kept[node].keys() - found[node].keys()) for node in kept} == {
        node: [] for node in kept
    }, "parameters are gone"
    # New ones are no difference for anybody's files.
    listed = {node: {name: found[node][name] for name in kept[node]} for node in kept}
    assert listed == kept, f"Defaults and limits have no rounding. {WRITE}"
    for node, entries in kept.items():
        for name, entry in entries.items():
            assert type(found[node][name]["default"]) is type(entry["default"]), (node, name)


def test_every_parameter_is_kept() -> None:
    kept = kept_in(PARAMETERS)
    new = {node: sorted(set(found) - set(kept[node])) for node, found in parameters().items()}
    assert not any(new.values()), f"New parameters have no expectation. {WRITE}"


def known_to(kept: Any, found: Any) -> Any:
    """Return what is found without what is new, which is no difference for anybody."""
    if not (isinstance(kept, dict) and isinstance(found, dict)):
        return found
    return {key: known_to(kept[key], value) for key, value in found.items() if key in kept}


@pytest.mark.parametrize(
    ("file", "prints"),
    [(COMMAND_TABLE, command_prints), (TOPIC_TABLE, topic_prints)],
    ids=["options", "topics"],
)
def test_commands_and_topics_stay_as_they_are(
    file: Path, prints: Callable[[], dict[str, Any]]
) -> None:
    kept = kept_in(file)
    found = known_to(kept, as_kept(prints()))
    check(found, kept)
    assert list(found) == list(kept), "the plant publishes in this order"


def test_plans_stay_as_they_are() -> None:
    check(as_kept(plans()), kept_in(PLANS))


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("name", some_fast(BAGS, "servicer_thrusters", "sliding_masses"))
def test_reports_stay_as_they_are(name: str, part: str) -> None:
    check(report_part(name, part), kept_in(REPORTS)[name].get(part))


@pytest.mark.parametrize("name", SITUATIONS)
def test_the_page_of_the_viewer_stays_as_it_is(name: str) -> None:
    pytest.importorskip("viser")
    check(viewer_prints(name), kept_in(VIEWER)[name])


@pytest.mark.parametrize("name", CAMPAIGNS)
def test_pages_of_campaigns_stay_as_they_are(name: str) -> None:
    pytest.importorskip("pyarrow")
    check(CAMPAIGNS[name](), kept_in(CAMPAIGN_PAGES)[name])


@pytest.mark.parametrize("name", some_fast(ANALYSED, "planar_chain"))
def test_pictures_of_robots_stay_as_they_are(name: str) -> None:
    check(analysis_prints(name), kept_in(REPORTS)[f"analysis of {name}"])
