"""A small campaign from Python, in the words of a flight."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.campaign import running as module
from spacerobot_ros.campaign.running import sweep
from spacerobot_ros.errors import ParameterError

NOISE = {"plant.sensors.position_noise": {"uniform": [0.001, 0.003]}}


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, Path]]:
    """Campaigns and folders of sweeps, which are not flown."""
    found: list[tuple[Any, Path]] = []

    class Rows:
        def __init__(self, folder: Path) -> None:
            self.folder = folder

        def table(self) -> str:
            return f"rows of {self.folder.name}"

    monkeypatch.setattr(module, "run_campaign", lambda *given: found.append(given))
    monkeypatch.setattr(module, "Dataset", Rows)
    return found


def test_a_sweep_is_a_campaign(run: list[tuple[Any, Path]], tmp_path: Path) -> None:
    at = (0.25, -0.5, 0.125)
    rows = sweep(
        "sliding_masses",
        NOISE,
        position=at,
        method="lie_bracket",
        parameters={"planner.position_tolerance": 0.0125},
        seed=5,
        flights=7,
        folder=tmp_path / "kept",
        sampler="sobol",
        criteria={"position_error_m": {"max": 0.02}},
    )
    assert rows == "rows of kept"
    ((campaign, folder),) = run
    assert folder == tmp_path / "kept"
    assert (campaign.name, campaign.flights, campaign.seed) == ("sliding_masses", 7, 5)
    assert campaign.sampler == "sobol"
    assert campaign.names[0] == "plant.sensors.position_noise"
    assert campaign.scenario.planner.method == "lie_bracket"
    np.testing.assert_allclose(campaign.scenario.goal.position, at)
    assert campaign.scenario.planner.position_tolerance == 0.0125
    assert [each.metric for each in campaign.criteria] == ["position_error_m"]


def test_a_sweep_takes_goals_of_end_effectors_and_refuses_unknown_parameters(
    run: list[tuple[Any, Path]],
) -> None:
    place = (1.0, 0.6, 0.7)
    sweep("reach", NOISE, end_effector_position=place, end_effector="link_7")
    (aim,) = run[0][0].scenario.goal.end_effectors
    assert aim.link == "link_7"
    np.testing.assert_allclose(aim.position, place)
    with pytest.raises(ParameterError, match="position_toleranse"):
        sweep("sliding_masses", NOISE, parameters={"planner.position_toleranse": 0.1})


def test_a_sweep_without_a_folder_leaves_nothing(run: list[tuple[Any, Path]]) -> None:
    sweep("sliding_masses", NOISE)
    ((campaign, folder),) = run
    assert (campaign.flights, campaign.seed) == (100, 0)
    assert not folder.parent.exists()


def test_a_robot_without_a_goal_and_an_unknown_key_are_refused() -> None:
    with pytest.raises(ParameterError, match="goal"):
        sweep("surveyor", NOISE)
    with pytest.raises(ParameterError, match="there is no key 'flight'"):
        sweep("sliding_masses", NOISE, flight=3)


@pytest.mark.slow
def test_a_sweep_is_flown() -> None:
    table = sweep("coordinated_control", NOISE, flights=3, engine="flights").to_pandas()
    assert list(table["flight"]) == [0, 1, 2]
    assert table["draw.plant.sensors.position_noise"].between(0.001, 0.004).all()
