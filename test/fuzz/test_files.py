"""Scenario files, settings and tables of thrusters with any YAML in them."""

from __future__ import annotations

import copy
import random
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hypothesis import strategies as st
from support.fuzzing import NUMBERS, TEXTS, VALUES, attempt, damaged, fuzz

from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.thrusters import load_thrusters
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.resources import resource_names, robot_file, share_directory
from spacerobot_ros.scenario import NODES, Scenario, load_scenario, parse_setting

FILES = [
    (share_directory() / "config" / f"{name}.yaml").read_text(encoding="utf-8")
    for name in resource_names("config", ".yaml")
]
TABLE = {
    "defaults": {"isp": 220.0, "force": 10.0},
    "thrusters": [
        {"name": "a", "position": [1.0, 0.0, 0.0], "direction": [0.0, 1.0, 0.0]},
        {"name": "b", "position": [1.0, 0.0, 0.0], "rpy": [0.0, 1.5, 0.0], "min_on_time": 0.01},
    ],
}


def places(content: Any) -> list[tuple[Any, Any]]:
    """Return every container of a YAML document with every key or index in it."""
    if isinstance(content, dict):
        keys: list[Any] = list(content)
    elif isinstance(content, list):
        keys = list(range(len(content)))
    else:
        return []
    found = [(content, key) for key in keys]
    for key in keys:
        found += places(content[key])
    return found


def with_changes(content: Any, changes: list[tuple[int, bool, Any]]) -> Any:
    """Return a document with values replaced, or with their keys gone."""
    content = copy.deepcopy(content)
    for seed, drop, value in changes:
        found = places(content)
        if not found:
            break
        container, key = random.Random(seed).choice(found)
        if drop:
            del container[key]
        else:
            container[key] = copy.deepcopy(value)
    return content


CHANGES = st.lists(
    st.tuples(
        st.integers(0, 10_000),
        st.booleans(),
        st.one_of(VALUES, st.lists(NUMBERS, min_size=3, max_size=4)),
    ),
    min_size=1,
    max_size=3,
)


def write(path: Path, content: Any) -> str:
    # Dates, sets and tags are YAML too, and what is written here is read as what it was.
    path.write_text(yaml.safe_dump(content, allow_unicode=True), encoding="utf-8")
    return str(path)


def use(scenario: Scenario | None) -> None:
    """Look at what a run looks at."""
    if scenario is None:
        return
    assert np.all(np.isfinite(scenario.goal.position))
    assert np.all(np.isfinite(scenario.goal.quaternion))
    for node in NODES:
        attempt("scenario", scenario.config, node)


@fuzz("scenario", st.sampled_from(FILES), CHANGES, fast=30, long=800)
def test_a_changed_scenario(tmp_path: Path, text: str, changes: Any) -> None:
    file = write(tmp_path / "s.yaml", with_changes(yaml.safe_load(text), changes))
    use(attempt("scenario", load_scenario, file))


@fuzz(
    "damaged scenario",
    st.sampled_from(FILES).flatmap(lambda text: damaged(text.encode())),
    fast=20,
    long=500,
)
def test_a_damaged_scenario(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "s.yaml"
    path.write_bytes(raw)
    use(attempt("damaged scenario", load_scenario, str(path)))


@fuzz("scenario name", TEXTS, fast=15, long=200)
def test_a_scenario_of_any_name(name: str) -> None:
    attempt("scenario name", load_scenario, name)


@fuzz(
    "setting",
    st.one_of(
        TEXTS,
        st.builds(
            "{}.{}={}".format,
            st.sampled_from(NODES),
            TEXTS,
            st.one_of(TEXTS, NUMBERS.map(str), VALUES.map(str)),
        ),
        st.text(max_size=20).map(lambda text: f"plant.robot={text}"),
    ),
    fast=40,
    long=1000,
)
def test_a_setting(text: str) -> None:
    setting = attempt("setting", parse_setting, text)
    assert setting is None or setting[0] in NODES


@lru_cache
def robot() -> RobotDescription:
    return load_robot(robot_file("servicer"))


@fuzz("thruster table", CHANGES, fast=40, long=800)
def test_a_changed_table_of_thrusters(tmp_path: Path, changes: Any) -> None:
    file = write(tmp_path / "t.yaml", with_changes(TABLE, changes))
    table = attempt("thruster table", load_thrusters, file, robot())
    if table is not None:
        assert np.all(np.isfinite(table.wrenches))
        assert np.all(np.isfinite(table.mass_flow))
        table.missing()


@fuzz("damaged thruster table", damaged(yaml.safe_dump(TABLE).encode()), fast=20, long=400)
def test_a_damaged_table_of_thrusters(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "t.yaml"
    path.write_bytes(raw)
    attempt("damaged thruster table", load_thrusters, path, robot())
