"""MuJoCo flies the commands of bags to the same states, and says where it cannot."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from support.command_line import CliRunner
from support.sentences import assert_one_sentence
from support.slow import some_fast

from spacerobot_ros import fly
from spacerobot_ros.cli.main import main
from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.flight.second_opinion import SecondOpinion
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.model import parse_robot
from spacerobot_ros.resources import resource_names, robot_file
from spacerobot_ros.simulation import mujoco_engine

pytest.importorskip("mujoco")

BAGS = Path(__file__).resolve().parents[2] / "bags"
QUICK = ("coordinated_control",)
LARGEST = {"reach": 2e-10, "two_hands": 5e-11}
"""Errors of the position, m, by steps of 10 ms in fast motions; all others are below 2e-11."""


def opinion_of(path: Path) -> SecondOpinion:
    found = verify_bag(path, mujoco=True)
    assert found.difference is None
    assert found.second_opinion is not None
    return found.second_opinion


def verify(path: Path) -> Result:
    return CliRunner().invoke(main, ["verify", str(path), "--engine", "mujoco"])


LOADED = ("capture", "gravity_gradient", "servicing")
"""Bags with a target, or with loads from outside, which MuJoCo does not model."""


@pytest.mark.parametrize(
    "name",
    some_fast([each for each in resource_names("bags", ".mcap") if each not in LOADED], *QUICK),
)
def test_mujoco_flies_reference_bags_to_the_same_states(name: str) -> None:
    path = BAGS / f"{name}.mcap"
    found = opinion_of(path)
    assert (found.agrees, found.until) == (True, "")
    assert max(found.position, found.attitude, found.joints) <= LARGEST.get(name, 2e-11)
    assert found.ticks == verify_bag(path).ticks
    assert found.engine.startswith("MuJoCo ")


@pytest.mark.parametrize(("name", "link"), [("coordinated_control", "link_1"), ("reach", "link_2")])
def test_a_thousandth_of_a_mass_is_noticed(
    name: str, link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_urdf = mujoco_engine.mujoco_spec

    def heavier(mujoco: Any, description: Any) -> Any:
        spec = of_urdf(mujoco, description)
        (body,) = (each for each in spec.bodies if each.name == link)
        body.mass *= 1.001
        return spec

    monkeypatch.setattr(mujoco_engine, "mujoco_spec", heavier)
    result = verify(BAGS / f"{name}.mcap")
    assert result.exit_code == 1
    assert_one_sentence(result.stderr, "differs by more than 1e-08 m or rad")


def flown(tmp_path: Path, duration: float, **plant: Any) -> Path:
    """Fly paper 4's robot; return its bag."""
    path = tmp_path / "flown.mcap"
    settings = {f"plant.{name}": value for name, value in plant.items()}
    limit = {"coordinated_control.time_limit": duration}
    fly("coordinated_control", parameters={**settings, **limit}).save(path)
    return path


def test_faults_are_flown_and_held_joints_end_the_comparison(tmp_path: Path) -> None:
    """A slow joint moves as its actuator realises it; a brake is a force that nobody commands."""
    faults = ["joint_slow elbow 0.6 at 0.1", "joint_stuck shoulder at 0.47"]
    turned = [0.0, 0.0, 0.6, 0.8]
    path = flown(tmp_path, 0.8, faults=faults, initial_orientation=turned)
    result = verify(path)
    assert result.exit_code == 0, result.output
    note = result.stdout.splitlines()[-1]
    assert note.startswith("note        compared until joint 'shoulder' is held at 0.4")
    found = opinion_of(path)
    assert 40 <= found.ticks <= 48
    assert max(found.position, found.attitude, found.joints) < 1e-10


def test_a_disturbance_ends_the_comparison(tmp_path: Path) -> None:
    pushed = ["link_1 force 0 2 0 at 0.3"]
    found = opinion_of(flown(tmp_path, 0.5, disturbances=pushed))
    assert found.until == "external loads act at 0.3 s, which the engine does not model"
    assert found.ticks == 29
    assert found.joints < 1e-10


def test_a_joint_at_its_stop_ends_the_comparison(tmp_path: Path) -> None:
    pushed = ["actuator_bias elbow 20 at 0"]
    found = opinion_of(flown(tmp_path, 1.2, faults=pushed, initial_joint_positions=[-1.0, 2.78]))
    assert found.until.startswith("joint 'elbow' is at its stop at ")
    assert found.ticks > 20
    assert found.joints < 1e-8


def test_without_mujoco_one_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    result = verify(BAGS / "reach.mcap")
    assert result.exit_code == 2
    assert_one_sentence(result.stderr, "pip install '.[mujoco]' in the clone")


def test_joints_that_follow_others_are_refused() -> None:
    text = robot_file("planar_chain").read_text("utf-8")
    mimic = '<mimic joint="pin_1" multiplier="-0.5"/>'
    before, joint, after = text.partition('<joint name="pin_2" type="continuous">')
    robot = parse_robot(f"{before}{joint}{mimic}{after}")
    assert robot.has_mimic_joints
    with pytest.raises(RobotDescriptionError, match="<mimic>"):
        mujoco_engine.MujocoEngine(robot, np.array([0, 0, 0, 0, 0, 0, 1.0]), np.zeros(1))
