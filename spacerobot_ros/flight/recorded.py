"""A flight as a bag holds it: its scenario, and its arrays."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from spacerobot_ros.bag import Bag, RecordedRobot, TopicSeries, read_bag
from spacerobot_ros.bag.recorded_robot import columns
from spacerobot_ros.commanding.goal_follower import STATUS_TOPICS, GoalFollower, Status
from spacerobot_ros.control.thrusters import find_thrusters
from spacerobot_ros.errors import RecordingError, SpaceRobotError
from spacerobot_ros.events import Event
from spacerobot_ros.flight.arrays import Commands, Outcome
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.parameter_files import CONFIGS
from spacerobot_ros.flight.scenario import COMMANDERS, Scenario
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import GoalIds
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.times import SECOND
from spacerobot_ros.topics import TOPICS


def recorded_scenario(bag: Bag) -> Scenario:
    """Return the scenario of a flight, as its bag has it: parameters, goals, robot.

    Raises
    ------
    RecordingError
        The bag does not say what was flown.
    """
    robot = RecordedRobot(bag)
    about = bag.metadata.get("scenario", {})
    nodes = {
        node: bag.metadata[f"parameters/{node}"]
        for node in CONFIGS
        if f"parameters/{node}" in bag.metadata
    }
    if "plant" not in nodes or "goal_position" not in about:
        raise RecordingError(
            f"The bag {bag.path} does not say what was flown: bags of 'spacerobot run' hold the "
            "goal and all parameters."
        )
    try:
        values = {
            node: {name: json.loads(text) for name, text in texts.items()}
            for node, texts in nodes.items()
        }
        urdf = robot.urdf
        if urdf is not None:
            for given in values.values():
                if "robot" in given and given["robot"] in ("", values["plant"]["robot"]):
                    given["robot_description"] = urdf.decode()
        shapes = robot.get("goal_joint_states")
        goal = _goal(about, "goal")
        assert goal is not None
        if shapes is not None:
            first = next(shapes.messages())[1]
            if len(first.position):  # Without any, the shape was free.
                goal = Goal(goal.position, goal.quaternion, np.array(first.position))
        end_effector_goal = _goal(about, "end_effector_goal")
    except (ValueError, KeyError, RecursionError) as error:
        raise RecordingError(
            f"What the bag {bag.path} says of its flight cannot be read: {error!r}."
        ) from error
    return Scenario(
        name=about.get("name", bag.path.stem),
        path=bag.path,
        description=about.get("description", ""),
        goal=goal,
        end_effector_goal=end_effector_goal,
        commanders=tuple(name for name in COMMANDERS if name in values),
        published=(),
        published_method="",
        kills=(),
        in_file=values,
        overrides={},
    )


def _goal(about: Mapping[str, str], name: str) -> Goal | None:
    """Return a goal exactly as it was sent."""
    if f"{name}_position" not in about:
        return None
    position, quaternion = (
        np.array([float(word) for word in about[f"{name}_{part}"].split()])
        for part in ("position", "orientation")
    )
    return Goal(position, quaternion)


def recorded_flight(path: str | os.PathLike[str]) -> Flight:
    """Return the flight in a bag of ``spacerobot run``, with the same arrays as without ROS.

    Raises
    ------
    RecordingError
        There is no such bag, it is damaged, or it holds no flight in lockstep.
    SpaceRobotError
        Its robot is refused.
    """
    bag = read_bag(path)
    robot, scenario = RecordedRobot(bag), recorded_scenario(bag)
    config = scenario.plant
    urdf = robot.urdf
    if urdf is None:
        raise RecordingError(f"The bag {bag.path} holds no description of its robot.")
    description = config.believed(parse_robot(urdf.decode(errors="replace")))
    n = len(description.joint_names)
    _, base = robot.truth("odom", [*columns("odom", "pose.pose"), *columns("odom", "twist.twist")])
    stamps, joints = robot.truth("joint_states", ["position", "velocity", "effort"], 3 * n)
    if len(base) != len(joints):
        raise RecordingError(
            f"The bag {bag.path} has {len(base)} poses of the base and {len(joints)} states of the "
            "joints: its flight is not whole."
        )
    quantities = _quantities(robot, n)
    thrust = quantities.get("thruster_force")
    if thrust is not None:
        table = find_thrusters(config.thrusters, description)
        used = config.control_period * (thrust / table.force) @ table.mass_flow
        quantities["propellant"] = np.cumsum(used)[:, np.newaxis]
    statuses = {name: _statuses(robot, name) for name in scenario.commanders}
    decision, status, gait = _decision(robot, statuses[scenario.commanders[0]])
    return Flight(
        scenario=scenario,
        robot=description,
        outcome=Outcome.INTERRUPTED if decision is None else Outcome(decision.state.value),
        sentence=status.message if status is not None else "",
        control_period=config.control_period,
        time=stamps,
        pose=base[:, :7],
        twist=base[:, 7:],
        q=joints[:, :n],
        qdot=joints[:, n : 2 * n],
        effort=joints[:, 2 * n :],
        momentum=robot["momentum"].table(["data"], 7),
        quantities=quantities,
        commands=_commands(robot, config, n),
        statuses=tuple(
            sorted((each for found in statuses.values() for each in found), key=lambda s: s[0])
        ),
        schedules=(),
        events=_events(robot),
        status=status,
        gait=gait,
        plan_time=float("nan"),
        wall_time=float("nan"),
    )


def _quantities(robot: RecordedRobot, n: int) -> dict[str, Array]:
    """Return the recorded quantities beside base and joints, by the table of topics."""
    found: dict[str, Array] = {}
    for name in ("end_effector_pose", "momentum_expected", "base_wrench_realised", "thrusters"):
        series = robot.get(name)
        for field in TOPICS[name].state if series is not None else ():
            assert series is not None
            width = len(field.members) or len(field.entries) or None
            if width is None:
                width = len(np.asarray(next(series.messages())[1].name))
            found[field.quantity] = series.table(field.columns, width)
    if robot.get("odom_true") is not None:
        for name, width in (("odom", None), ("joint_states", 3 * n)):
            series = robot.get(name)
            for field in TOPICS[name].state if series is not None else ():
                assert series is not None
                size = None if width is None else n
                found[field.quantity] = series.table(field.columns, size)
        found.pop("effort", None)
    return found


def _commands(robot: RecordedRobot, config: PlantConfig, n: int) -> dict[str, Commands]:
    """Return the commands by topic."""
    velocity = config.actuation == "velocity"
    found = {}
    wrench = [f"wrench.{part}.{axis}" for part in ("force", "torque") for axis in "xyz"]
    for name, paths, width in (
        ("joint_commands", ["velocity" if velocity else "effort"], n),
        ("base_wrench", wrench, 6),
        ("joint_reference", ["velocity"], n),
    ):
        series = robot.get(name)
        if series is not None:
            ticks = series.stamp_ns // config.period_ns
            found[name] = Commands(ticks, series.table(paths, width))
    return found


def _statuses(robot: RecordedRobot, commander: str) -> list[tuple[int, Status]]:
    topic, read = STATUS_TOPICS[commander]
    series = robot.get(topic)
    found = []
    for time_ns, message in series.messages() if series is not None else ():
        found.append((time_ns, read(_values(message), message.message)))
    return found


def _decision(
    robot: RecordedRobot, statuses: list[tuple[int, Status]]
) -> tuple[Status | None, Status | None, PlannerStatus | None]:
    """Return the status that decides the goal, the last one until then, and that of the gait."""
    goals = robot.get("goal_pose")
    if goals is None:
        raise RecordingError(f"The bag {robot.bag.path} holds no goal pose.")
    goal_id = GoalIds().of(*divmod(int(goals.stamp_ns[0]), SECOND))
    follower, status = GoalFollower(goal_id, unnamed=True), None
    for _, status in statuses:
        if follower.take(status):
            break
    return follower.decision, status, follower.gait


def _events(robot: RecordedRobot) -> tuple[Event, ...]:
    series: TopicSeries | None = robot.get("events")
    found = []
    for _, message in series.messages() if series is not None else ():
        try:
            level = int.from_bytes(bytes([message.level]), "little")
            found.append(Event.from_values(_values(message), message.message, level))
        except SpaceRobotError:
            continue  # Of a later version.
    return tuple(found)


def _values(message: Any) -> dict[str, str]:
    return {pair.key: pair.value for pair in message.values}
