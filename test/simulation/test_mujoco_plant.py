"""The plant in MuJoCo flies as the exact one in free motion, and pushes where bodies touch."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulation.test_capture import SPATIAL, capturing_of, relative_change, total_momentum
from support.effort_flights import random_urdf, robot_of, thrusts, tumbling
from support.oracles import Array
from support.slow import some_fast

from spacerobot_ros.errors import (
    CommandError,
    ParameterError,
    RobotDescriptionError,
    SpaceRobotError,
)
from spacerobot_ros.model import SpaceRobot, parse_robot
from spacerobot_ros.model.urdf import parse_world
from spacerobot_ros.parameters import configured
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import PlantWithFaults, build_plant
from spacerobot_ros.simulation.capture import capture_values
from spacerobot_ros.simulation.config import PlantConfig

pytest.importorskip("mujoco")

ARM: dict[str, Any] = {
    "robot": "three_joint_arm",
    "tick_rate": 40.0,
    "initial_position": [0.3, -0.2, 0.5],
    "initial_orientation": [0.1, -0.3, 0.2, 0.9],
    "initial_joint_positions": [0.3, -0.5, 0.4],
    "linear_momentum": [3.0, -2.0, 1.0],
    "angular_momentum": [1.0, 2.0, -1.5],
}

PUCKS = """<robot name="pucks">
  <link name="base"><inertial><mass value="6"/>
    <inertia ixx="0.5" iyy="0.6" izz="0.7" ixy="0" ixz="0" iyz="0"/></inertial></link>
  {sliders}
</robot>"""

SLIDER = """<joint name="{name}_slide" type="prismatic"><parent link="base"/><child link="{name}"/>
    <origin xyz="0 {y} 0.3"/><axis xyz="1 0 0"/>
    <limit lower="-0.4" upper="{upper}" velocity="2" effort="{effort}"/></joint>
  <link name="{name}"><inertial><mass value="{mass}"/>
    <inertia ixx="0.01" iyy="0.02" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry>{shape}</geometry></collision></link>"""


def pucks(effort: float = 30.0, upper: float = 0.45) -> SpaceRobot:
    """A base with a ball and a box on parallel rails, 0.02 m apart across them."""
    parts = (
        ("ball", 0.0, 1.5, '<sphere radius="0.1"/>'),
        ("block", 0.02, 2.5, '<box size="0.2 0.16 0.1"/>'),
    )
    sliders = "".join(
        SLIDER.format(name=name, y=y, mass=mass, shape=shape, effort=effort, upper=upper)
        for name, y, mass, shape in parts
    )
    return SpaceRobot(parse_robot(PUCKS.format(sliders=sliders)))


def plant(model: SpaceRobot | None = None, **values: Any) -> PlantWithFaults:
    config = configured(PlantConfig, {"engine": "mujoco", **values})
    return build_plant(model or SpaceRobot.from_file(robot_file(config.robot)), config)


def pair(model: SpaceRobot | None = None, **values: Any) -> tuple[PlantWithFaults, PlantWithFaults]:
    """Return a plant in MuJoCo and the exact one."""
    return plant(model, **values), plant(model, **{**values, "engine": "exact"})


def step_both(plants: Iterable[PlantWithFaults], ticks: int, *commands: Any) -> None:
    for _ in range(ticks):
        for flown in plants:
            flown.step(*map(np.array, commands))


def state_of(flown: PlantWithFaults) -> Array:
    return np.concatenate([flown.pose, flown.twist, flown.q, flown.qdot])


@pytest.mark.parametrize("seed", some_fast(range(4), 2, 3))
def test_random_robots_fly_as_in_the_exact_plant(seed: int) -> None:
    """With joints of all kinds, in free motion under efforts and wrenches held for 0.2 s."""
    robot, rng = robot_of(random_urdf(seed)), np.random.default_rng(40 + seed)
    start = tumbling(robot, rng)
    values = {"actuation": "effort", "tick_rate": 100.0, "integration_step": 0.001}
    ours, exact = both = [
        build_plant(robot, configured(PlantConfig, {**values, "engine": engine}), start)
        for engine in ("mujoco", "exact")
    ]
    q = exact.q.copy()
    for effort, wrench in thrusts(rng, robot.n, 20):
        step_both(both, 20, effort, wrench)
        np.testing.assert_array_equal(ours.effort, exact.effort)
        np.testing.assert_allclose(state_of(ours), state_of(exact), rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.link_r, exact.link_r, rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.link_R, exact.link_R, rtol=0, atol=1e-9)
        np.testing.assert_allclose(ours.momentum, exact.momentum, rtol=0, atol=1e-8)
        ledger = ours.expected_momenta, exact.expected_momenta
        np.testing.assert_allclose(*ledger, rtol=0, atol=1e-6)
    assert np.abs(exact.q - q).min() > 0.01


def test_servos_move_it_as_the_exact_plant() -> None:
    """Rates jump within a step of 1 ms in place of at once; efforts are those of the motion."""
    ours, exact = pair(**ARM)
    for tick in range(40):
        rates = 0.3 * np.sin(0.15 * tick + np.array([0.0, 1.0, 2.5]))
        for flown in (ours, exact):
            assert not flown.step(rates)
        np.testing.assert_allclose(ours.qdot, rates, rtol=0, atol=2e-5)
        np.testing.assert_allclose(ours.effort, exact.effort, rtol=0.02, atol=0.5)
    np.testing.assert_allclose(ours.q, exact.q, rtol=0, atol=5e-4)
    np.testing.assert_allclose(ours.pose, exact.pose, rtol=0, atol=2e-4)
    np.testing.assert_allclose(ours.momentum[:6], exact.expected_momenta, rtol=0, atol=1e-8)


def test_limits_are_kept_and_counted() -> None:
    robot = pucks()
    start = {"initial_joint_positions": [0.2, -0.2], "tick_rate": 50.0}
    ours = plant(robot, **start)
    assert ours.step(np.array([3.0, 0.5]))
    np.testing.assert_allclose(ours.qdot, [2.0, 0.5], atol=1e-6)
    for _ in range(20):
        ours.step(np.array([2.0, 0.0]))
    # It ends on its stop, as in the exact plant.
    assert ours.q[0] == pytest.approx(0.45, abs=1e-6)
    assert ours.limit_counts["rate"].tolist() == [1, 0]
    assert ours.limit_counts["stroke"][0] > 5
    pushed = plant(robot, **start, actuation="effort")
    for _ in range(60):
        pushed.step(np.array([90.0, 0.0]), np.zeros(6))
    assert pushed.limit_counts["effort"].tolist() == [60, 0]
    np.testing.assert_array_equal(pushed.effort, [30.0, 0.0])
    assert 0.45 - 1e-6 < pushed.q[0] < 0.451
    # Runge-Kutta steps over the impact.
    np.testing.assert_allclose(pushed.momentum[:6], 0.0, atol=1e-3)


def test_links_push_each_other_where_the_exact_plant_goes_through() -> None:
    """The ball runs at the block, which it takes along; a servo stalls at its limit of effort."""
    robot = pucks()
    start = {"initial_joint_positions": [-0.35, 0.1], "tick_rate": 50.0}
    ours, free = both = pair(robot, **start, actuation="effort")
    step_both(both, 70, [2.0, 0.0], np.zeros(6))
    # Ball and block overlap along x from a distance of 0.2 m of their centres, in the exact plant.
    assert free.q[0] - free.q[1] > 0.0
    assert ours.q[1] - ours.q[0] > 0.2 - 0.02
    assert ours.q[1] > 0.15
    np.testing.assert_allclose(ours.momentum[:6], 0.0, atol=2e-4)
    held = plant(robot, **start)
    for _ in range(40):
        held.step(np.array([1.0, 0.0]))
    assert held.q[1] - held.q[0] > 0.2 - 0.02
    np.testing.assert_allclose(held.effort, [30.0, -30.0], rtol=0.2)
    np.testing.assert_allclose(held.momentum[:6], 0.0, atol=2e-4)


def test_a_robot_that_drifts_against_an_obstacle_is_stopped_by_it() -> None:
    wall = parse_world(
        """<robot name="wall"><link name="world"/><link name="wall"><collision><geometry>
        <box size="0.2 4 4"/></geometry></collision></link><joint name="at" type="fixed">
        <parent link="world"/><child link="wall"/><origin xyz="1 0 0"/></joint></robot>"""
    )
    robot = pucks()
    among = SpaceRobot(replace(robot.description, world=wall))
    ours = plant(among, tick_rate=50.0, linear_momentum=[3.0, 0.0, 0.0])
    ball = among.link_names.index("ball")
    nearest = []
    for _ in range(150):
        ours.step(np.zeros(2))
        R_WB = Rotation.from_quat(ours.pose[3:]).as_matrix()
        nearest.append((ours.pose[:3] + R_WB @ ours.link_r[:, ball])[0])
    # Its surface stays before the wall's, 0.9 m away.
    assert 0.8 - 0.01 < max(nearest) < 0.8 + 0.005
    assert ours.momentum[0] < 1.0, "the wall has taken momentum"
    # The ledger knows of thrust alone: the difference is the impulse of the wall.
    assert ours.expected_momenta[0] == 3.0


def test_a_grasp_is_a_weld_and_a_release_ends_it() -> None:
    ours, exact = both = pair(**{**SPATIAL, "integration_step": 0.001}, actuation="effort")
    before = total_momentum(ours)
    np.testing.assert_allclose(before, total_momentum(exact), rtol=1e-12)
    step_both(both, 1, np.zeros(3), np.zeros(6))
    for flown in both:
        assert capture_values(capturing_of(flown).capture().about)["requested"]
    step_both(both, 20, [1.0, -2.0, 0.5], [3.0, 0, 0, 0, 0.5, 0])
    held, reference = capturing_of(ours), capturing_of(exact)
    assert held.payload is not None
    assert reference.payload is not None
    assert held.payload.inertia.mass == reference.payload.inertia.mass
    # The impulse takes some milliseconds.
    np.testing.assert_allclose(state_of(ours), state_of(exact), rtol=0, atol=2e-2)
    np.testing.assert_allclose(held.target_pose, reference.target_pose, rtol=0, atol=1e-2)
    np.testing.assert_allclose(ours.momentum[:6], ours.expected_momenta, rtol=0, atol=2e-3)
    momentum = total_momentum(ours)
    held.release()
    for _ in range(10):
        ours.step(np.zeros(3), np.zeros(6))
    assert held.payload is None
    assert relative_change(total_momentum(ours), momentum) < 1e-6
    with pytest.raises(CommandError, match="does not hold a target"):
        held.release()
    ours.plant.reset()
    np.testing.assert_allclose(total_momentum(ours), before, rtol=1e-12)


def test_loads_act_as_in_the_exact_plant() -> None:
    values = {
        **ARM,
        "actuation": "effort",
        "orbit.mean_motion": 0.3,
        "orbit.orientation": [0.1, 0.2, -0.3, 0.9],
        "disturbances": ["link_2 force 1 -2 0.5 in world", "base_link torque 0.3 0 0.2 in link"],
    }
    ours, exact = both = pair(**values)
    step_both(both, 40, [0.5, -0.3, 0.2], [1.0, 0, 0, 0, 0, 0.1])
    np.testing.assert_allclose(state_of(ours), state_of(exact), rtol=0, atol=1e-4)
    np.testing.assert_allclose(ours.momentum, exact.momentum, rtol=0, atol=2e-3)
    np.testing.assert_allclose(ours.expected_momenta, exact.expected_momenta, rtol=0, atol=2e-3)
    assert np.abs(exact.expected_momenta - exact.initial.momenta()).max() > 0.5


def test_a_table_with_friction_acts_as_in_the_exact_plant() -> None:
    values: dict[str, Any] = {
        "robot": "planar_manipulator",
        "tick_rate": 50.0,
        "table.tilt": 0.02,
        "table.direction": 0.7,
        "table.friction": 0.4,
        "linear_momentum": [20.0, -5.0, 0.0],
    }
    ours, exact = both = pair(**values)
    step_both(both, 50, [0.1, -0.2])
    np.testing.assert_allclose(ours.pose, exact.pose, rtol=0, atol=5e-4)
    np.testing.assert_allclose(ours.momentum[:2], exact.momentum[:2], rtol=2e-3)


def test_a_stuck_joint_is_held_and_let_go() -> None:
    flown = plant(
        **ARM, actuation="effort", faults=["joint_stuck shoulder_pitch at 0.25 until 0.75"]
    )
    places = []
    for _ in range(40):
        flown.step(np.array([0.0, 3.0, 0.0]), np.zeros(6))
        places.append(flown.q[1])
    stuck = np.array(places[11:29])
    assert np.ptp(stuck) < 1e-3
    assert abs(places[-1] - stuck[-1]) > 0.01
    np.testing.assert_allclose(flown.momentum[:6], flown.expected_momenta, rtol=0, atol=1e-4)


def test_servos_leave_a_stuck_joint_alone_and_turn_the_others() -> None:
    rates = np.array([0.2, 0.4, -0.3])
    flown = plant(**ARM, faults=["joint_stuck shoulder_pitch at 0.25"])
    places = []
    for _ in range(30):
        flown.step(rates)
        places.append(flown.q.copy())
    moved = np.array(places[29]) - places[14]
    np.testing.assert_allclose(moved[[0, 2]], 15 / 40 * rates[[0, 2]], atol=1e-4)
    assert np.ptp(np.array(places[10:])[:, 1]) < 1e-5


def test_a_wheel_at_its_largest_rate_gets_no_faster() -> None:
    robot = SpaceRobot.from_file(robot_file("servicer_wheels"))
    wheel = robot.joint_names.index(robot.description.wheel_names[1])
    limit = robot.velocity_limit[wheel]
    effort, rates = np.zeros((2, robot.n))
    effort[wheel], rates[wheel] = 1e6, 0.999 * limit
    fast = plant(robot, actuation="effort", tick_rate=10.0, initial_joint_velocities=rates.tolist())
    for _ in range(30):
        fast.step(effort, np.zeros(6))
    assert fast.qdot[wheel] < 1.01 * limit
    assert fast.effort[wheel] == 0.0
    fast.step(-effort, np.zeros(6))
    assert fast.effort[wheel] < 0.0


def test_a_reset_begins_the_same_flight_again() -> None:
    flown = plant(**ARM)
    rates = np.array([0.2, -0.3, 0.1])
    ends = []
    for _ in range(2):
        for _ in range(10):
            flown.step(rates)
        ends.append(state_of(flown))
        flown.plant.reset()
    np.testing.assert_array_equal(ends[0], ends[1])


def test_masses_are_those_of_the_model_and_not_of_the_urdf() -> None:
    robot = SpaceRobot.from_file(robot_file("three_joint_arm"))
    heavy = robot.with_inertial(robot.inertial.scaled(np.array([1.0, 1.7, 0.6, 1.3])))
    ours, exact = both = pair(heavy, **ARM, actuation="effort")
    step_both(both, 20, [1.0, -2.0, 0.7], np.zeros(6))
    np.testing.assert_allclose(state_of(ours), state_of(exact), rtol=0, atol=1e-9)


def test_meshes_collide_by_their_hulls() -> None:
    surveyor = SpaceRobot.from_file(robot_file("surveyor"))
    assert any(s.kind == "mesh" for link in surveyor.description.links for s in link.shapes)
    flown = plant(surveyor, tick_rate=20.0)
    flown.step(np.full(surveyor.n, 0.05))
    np.testing.assert_allclose(flown.qdot, 0.05, atol=1e-4)


def test_bad_commands_and_robots_have_their_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    flown = plant(**ARM)
    with pytest.raises(CommandError, match="not finite"):
        flown.step(np.array([0.0, np.nan, 0.0]))
    with pytest.raises(ParameterError, match="Joints under velocity commands start at rest"):
        plant(**ARM, actuation="velocity", initial_joint_velocities=[0.1, 0.0, 0.0])
    text = PUCKS.format(
        sliders="".join(
            SLIDER.format(name=n, y=0, mass=1, shape='<sphere radius="0.1"/>', effort=1, upper=1)
            for n in ("a", "b")
        ).replace('<axis xyz="1 0 0"/>', '<axis xyz="1 0 0"/><mimic joint="b_slide"/>', 1)
    )
    with pytest.raises(RobotDescriptionError, match=r"has mimic joints \(<mimic>\)"):
        plant(SpaceRobot(parse_robot(text)))
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(
        SpaceRobotError, match=r"need mujoco, which is not installed: pip install '\.\[mujoco\]'"
    ):
        plant(**ARM)
