"""Disturbances: their lines, their times, and what a plant reports of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import PlantWithFaults, build_plant
from spacerobot_ros.simulation.commands import CommandValidator
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.faults import (
    Disturbance,
    disturbance_timeline,
    parse_disturbance,
)
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.simulation.status import PlantMonitor, PlantState, PlantStatus

LINKS = ("base", "hand")
SLIDERS = SpaceRobot.from_file(robot_file("sliding_masses"))
LINK = SLIDERS.link_names[-1]


def plant_with(*disturbances: str, **parameters: Any) -> PlantWithFaults:
    return build_plant(SLIDERS, PlantConfig(disturbances=disturbances, **parameters))


@pytest.mark.parametrize(
    ("line", "expected", "text"),
    [
        (
            "hand force 1 -2 0.5",
            Disturbance("hand", force=(1.0, -2.0, 0.5), start=3.0),
            "hand force 1 -2 0.5 in world at 3",
        ),
        (
            "base torque 0 0 0.25 in link at 10 until 50",
            Disturbance("base", torque=(0.0, 0.0, 0.25), in_link=True, start=10.0, end=50.0),
            "base torque 0 0 0.25 in link at 10 until 50",
        ),
        (
            "  hand torque 1 2 3 force 4 5 6 in world until 7.5",
            Disturbance("hand", (4.0, 5.0, 6.0), (1.0, 2.0, 3.0), start=3.0, end=7.5),
            "hand force 4 5 6 torque 1 2 3 in world at 3 until 7.5",
        ),
        ("hand force 1e6 0 0 at 0", Disturbance("hand", (1e6, 0.0, 0.0)), None),
    ],
)
def test_a_line_is_a_disturbance(line: str, expected: Disturbance, text: str | None) -> None:
    found = parse_disturbance(line, LINKS, now=3.0)
    assert found == expected
    assert parse_disturbance(str(found), LINKS) == found
    assert text is None or str(found) == text


FORM = (
    "it must be LINK [force X Y Z] [torque X Y Z] [in world|link] [at SECONDS] [until SECONDS], "
    "with a force or a torque"
)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("", FORM),
        ("hand", FORM),
        ("hand at 3", FORM),
        ("hand force 1 2", FORM),
        ("nose force 1 2 3", "the robot has no link 'nose'; it has base, hand"),
        ("hand force 1 2 nan", "'nan' is not a finite number"),
        ("hand force 1 2 at 4", "'at' is not a finite number"),
        ("hand torque 1 inf 2", "'inf' is not a finite number"),
        ("hand force 1 -2e6 0", "components of its force must be at most 1e+06"),
        ("hand force 1 2 3 torque 0 0 -1.1e6", "components of its torque must be at most 1e+06"),
        ("hand force 1 2 3 in space", "its frame is world or link"),
        ("hand force 1 2 3 in", "its frame is world or link"),
        ("hand force 1 2 3 at -1", "it begins at -1 s, before the simulation does"),
        ("hand force 1 2 3 at 5 until 5", "it ends at 5 s and begins at 5 s"),
        ("hand force 1 2 3 at nan", "'nan' is not a finite number"),
        ("hand force 1 2 3 until 2e9", "its time is 2e+09 s and must be at most 1e+09 s"),
        (
            "hand torque 1 2 3 for 5",
            "after the torque come only 'at SECONDS' and 'until SECONDS'",
        ),
        (
            "hand force 1 2 3 force 1 2 3",
            "after the force come only 'at SECONDS' and 'until SECONDS'",
        ),
    ],
)
def test_a_bad_line_is_refused_with_a_sentence(line: str, reason: str) -> None:
    with pytest.raises(ParameterError) as refused:
        parse_disturbance(line, LINKS)
    assert str(refused.value) == f"The disturbance '{line}' is refused: {reason}."


def test_too_many_disturbances_are_refused_together() -> None:
    timeline = disturbance_timeline(["hand force 1 0 0"] * 999, LINKS)
    with pytest.raises(ParameterError) as refused:
        timeline.read(["base force 0 1 0", " ", "base force 0 2 0"])
    assert str(refused.value) == (
        "2 more disturbance(s) are refused: there are 999, and at most 1000; inject 'clear' first."
    )
    timeline.read(["base force 0 1 0"], now=2.5)
    assert (len(timeline.entries), timeline.entries[-1].start) == (1000, 2.5)


@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_a_disturbance_acts_from_its_begin_to_its_end(actuation: str) -> None:
    """At 20 ticks a second, ticks 3 to 6 begin within [0.15, 0.35) s."""
    plant = plant_with(f"{LINK} force 0.5 -1 2 at 0.15 until 0.35", actuation=actuation)
    commands = (np.zeros(3), np.zeros(6)) if actuation == "effort" else (np.zeros(3),)
    momenta, seen = [], []
    for _ in range(10):
        seen.append(bool(plant.disturbances))
        plant.step(*commands)
        momenta.append(plant.momentum[:3].copy())
    acted = np.clip(np.arange(1, 11) - 3, 0, 4)
    np.testing.assert_allclose(momenta, 0.05 * acted[:, None] * [0.5, -1.0, 2.0], atol=1e-14)
    assert seen == [k in range(3, 7) for k in range(10)]


def test_disturbances_of_a_link_add_up_and_are_injected_and_cleared() -> None:
    plant = plant_with(f"{LINK} force 1 0 0 at 0")
    assert plant.loads is not None
    plant.step(np.zeros(3))
    before = plant.injected
    plant.disturb(f"{LINK} force 2 3 0 torque 0 0 1\n{LINK} torque 0.5 0 0 in link at 0.1")
    assert plant.injected is not before
    assert [str(each) for each in plant.disturbances] == [
        f"{LINK} force 1 0 0 in world at 0",
        f"{LINK} force 2 3 0 torque 0 0 1 in world at 0.05",
    ]
    np.testing.assert_array_equal(plant.loads.in_world[-1], [3, 3, 0, 0, 0, 1])
    plant.step(np.zeros(3))
    np.testing.assert_array_equal(plant.loads.in_link[-1], [0, 0, 0, 0.5, 0, 0])
    with pytest.raises(ParameterError, match="no link 'nose'"):
        plant.disturb(f"{LINK} force 9 9 9\nnose force 1 0 0")
    assert len(plant.disturbances) == 3
    plant.inject("joint_stuck slider_1")
    assert len(plant.injected) == 4
    plant.disturb("clear")
    assert not plant.disturbances
    assert not plant.loads.in_link.any()
    assert not plant.loads.in_world.any()
    assert [str(each) for each in plant.injected] == ["joint_stuck slider_1 at 0.1"]
    momentum = plant.momentum[:6].copy()
    plant.step(np.zeros(3))
    np.testing.assert_allclose(plant.momentum[:6], momentum, atol=1e-14)


def test_a_plant_that_is_disturbed_later_goes_on_as_it_was() -> None:
    """Arrays stay the same objects, and what was, is kept to the last bit."""
    plain, disturbed = plant_with(), plant_with()
    pose, momentum = disturbed.pose, disturbed.momentum
    rates = np.array([0.1, -0.2, 0.3])
    for _ in range(3):
        plain.step(rates)
        disturbed.step(rates)
    assert disturbed.loads is None
    disturbed.disturb(f"{LINK} force 0 0 1 at 100")
    for _ in range(3):
        plain.step(rates)
        disturbed.step(rates)
    assert disturbed.pose is pose
    assert disturbed.momentum is momentum
    np.testing.assert_allclose(disturbed.pose, plain.pose, atol=1e-15)
    np.testing.assert_allclose(disturbed.effort, plain.effort, atol=1e-15)


def test_a_tick_that_the_owner_sets_is_the_time_of_disturbances() -> None:
    plant = plant_with(f"{LINK} force 1 0 0 at 10 until 20")
    plant.tick = 20 * 15
    plant.step(np.zeros(3))
    assert plant.momentum[0] == pytest.approx(0.05)
    assert plant.loads is not None
    assert plant.loads.time == pytest.approx(15.0)


def test_a_reset_keeps_time_and_disturbances() -> None:
    plant = plant_with(f"{LINK} force 1 0 0")
    plant.step(np.zeros(3))
    plant.reset()
    np.testing.assert_array_equal(plant.expected_momenta, 0.0)
    plant.step(np.zeros(3))
    assert plant.expected_momenta[0] == pytest.approx(0.05)
    assert plant.tick == 2


# -- reports ----------------------------------------------------------------------------------


def test_status_and_events_name_disturbances() -> None:
    config = PlantConfig(time_mode="lockstep", disturbances=(f"{LINK} torque 0 0 0.5 until 0.1",))
    plant = build_plant(SLIDERS, config)
    monitor = PlantMonitor(CommandValidator(plant, config), plant, config)
    line = f"{LINK} torque 0 0 0.5 in world at 0 until 0.1"
    event, running = monitor.update(PlantState.RUNNING, 0.0)
    assert (event.kind, event.level) == (EventKind.DISTURBANCE, 1)
    assert event.message == f"A disturbance begins: {line}."
    assert event.about == {"disturbance": line}
    assert running.kind is EventKind.RUNNING
    status = monitor.status
    assert (status.disturbances, status.level) == ((line,), 1)
    assert PlantStatus.from_values(status.to_values(), status.message) == status
    plant.step(np.zeros(3))
    plant.step(np.zeros(3))
    (ended,) = monitor.update(PlantState.RUNNING, 0.1)
    assert (ended.kind, ended.level) == (EventKind.DISTURBANCE_ENDED, 0)
    assert ended.message == f"A disturbance has ended: {line}."
    assert monitor.status.level == 0
    assert "disturbances" not in monitor.status.to_values()


def test_expected_momenta_are_published_as_soon_as_loads_act() -> None:
    plant = plant_with()
    reported = ReportedState(plant, PlantConfig())
    assert "expected_momenta" not in reported.quantities
    assert not reported.update()
    plant.disturb(f"{LINK} force 1 0 0")
    assert reported.update()
    assert reported.quantities["expected_momenta"] is plant.expected_momenta
    assert not reported.update()
    assert math.isfinite(plant.expected_momenta.sum())
