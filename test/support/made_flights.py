"""Flights for reports, made of numbers in memory: no bag is written, and no flight is flown.

Together they have whatever a report shows: cycles, new schedules, named outputs of a controller,
thrusters, sensors that err, peaks, joints of both kinds with and without limits, and robots and
parts that are missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from support.flight_bags import cyclic_shapes, urdf_of

from spacerobot_ros.collision.geometry import LinkPair
from spacerobot_ros.collision.nearest import Approach
from spacerobot_ros.control.status import CommandReport, ControllerState, ControllerStatus
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.series import SentGoal, Signal
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.report.flight import FlightReport
from spacerobot_ros.scenario import Published, Scenario

BEGAN = 5.0
"""Time of the first state, s."""

Statuses = Sequence[tuple[float, PlannerStatus | ControllerStatus | str]]
AT_REST = Goal.checked([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])


def turned(x: float, y: float, z: float, *position: float) -> Goal:
    """Return a goal by its rotation vector and position."""
    return Goal.checked(position, Rotation.from_rotvec([x, y, z]).as_quat())


def _report(
    name: str,
    series: Mapping[str, Array],
    *,
    period: float = 0.125,
    urdf: str = "",
    joints: Sequence[str] = (),
    thrusters: Sequence[str] = (),
    statuses: Mapping[str, Statuses] = {},
    goals: Sequence[tuple[float, Goal]] = (),
    tool_goals: Sequence[tuple[float, Goal]] = (),
    events: Sequence[Event] = (),
    topics: Mapping[str, Array] = {},
    in_file: Mapping[str, Any] = {},
    metadata: Mapping[str, Any] = {},
    description: str = "",
    published: tuple[Published, ...] = (),
    namespace: str = "",
    others: Sequence[str] = (),
    planned: Sequence[Array] = (),
    clearance: Array | None = None,
) -> FlightReport:
    """Return the report of a flight whose arrays have a row every ``period`` s.

    Arrays of fewer rows than the first one are of its last rows. ``topics`` are what else the bag
    holds: ``base_wrench``, ``joint_commands``. ``clearance`` are smallest distances between links.
    """
    count = len(next(iter(series.values())))

    def over_time(values: Array) -> Signal:
        ticks = np.arange(count - len(values), count, dtype=np.float64)
        return Signal(BEGAN + period * ticks, values)

    def path(points: Array) -> Any:
        places = [dict(zip("xyz", point, strict=True)) for point in points.tolist()]
        return SimpleNamespace(
            poses=[
                SimpleNamespace(pose=SimpleNamespace(position=SimpleNamespace(**x))) for x in places
            ]
        )

    named = {"joint_states": list(joints), "joint_commands": list(joints)[::-1]}
    named["thrusters"] = list(thrusters)
    kinds = {f"{each}/odom": "nav_msgs/msg/Odometry" for each in (namespace, *others)}
    bag: Any = SimpleNamespace(
        began=BEGAN,
        stamped=True,
        path=Path(f"{name}.mcap"),
        namespace=namespace,
        bag=SimpleNamespace(topics=kinds, attachments={}),
        metadata=metadata,
        message_count=1234,
        names=lambda topic: named[topic],
        messages=lambda topic: [(0, path(points)) for points in planned],
        events=lambda: [],
        statuses=lambda node: [(round(1e9 * t), each) for t, each in statuses.get(node, ())],
        signal=lambda topic, _, width: (
            over_time(topics[topic]) if topic in topics else Signal.empty(width)
        ),
    )
    sent = tuple(SentGoal(t, goal, f"{t:.9f}") for t, goal in goals)
    tool_sent = tuple(SentGoal(t, goal, f"{t:.9f}") for t, goal in tool_goals)
    scenario = Scenario(name, Path(), description, AT_REST, in_file=in_file, published=published)
    told = [each for all_of in statuses.values() for _, each in all_of if not isinstance(each, str)]
    flight = Flight(
        scenario=scenario,
        robot=parse_robot(urdf) if urdf else None,
        joint_names=tuple(joints),
        series={key: over_time(values) for key, values in series.items()},
        commands={},
        statuses=(),
        events=(),
        outcome=Outcome.REACHED,
        message="",
        goal=sent[-1].goal if sent else None,
        end_effector_goal=tool_sent[-1].goal if tool_sent else None,
        goals=sent,
        end_effector_goals=tool_sent,
        status=told[-1] if told else None,
        gait=next((each for each in told if isinstance(each, PlannerStatus) and each.method), None),
    )
    report = replace(FlightReport.of(bag, flight), events=tuple(events))

    least = np.inf if clearance is None else float(clearance.min())
    vars(report)["clearance"] = (
        clearance
        if clearance is None
        else SimpleNamespace(
            geometry=SimpleNamespace(exact=least > 0),
            nearest=Approach(LinkPair("link_0", "link_1"), 0, least, 20.0, np.zeros(3)),
            nearest_time=1.25,
            over_time=lambda most: (report.time[:most], clearance[:most]),
        )
    )
    return report


def _event(time: float, kind: EventKind, **about: str) -> Event:
    return Event(kind, f"It is {kind.value}.", time_s=time, about=about, node="plant")


def _poses(end: Sequence[float], turn: Sequence[float], count: int) -> Array:
    """Return poses (count, 7) from rest to a position and a rotation vector, not evenly."""
    share = np.linspace(0.0, 1.0, count)[:, np.newaxis] ** 2
    turns = Rotation.from_rotvec(share * np.array(turn)).as_quat()
    return np.hstack([share * np.array(end), turns])


def _momenta(count: int, energy: float, drift: float) -> Array:
    k = np.arange(count)
    columns = [
        drift * np.sin(0.5 * k),
        0 * k,
        drift * k / count,
        0 * k,
        -3 * drift * (k % 7),
        0 * k,
    ]
    return np.column_stack([*columns, energy * (k % 5)])


def _cycles() -> FlightReport:
    """A slide and equal loops of three joints, by two schedules, nearly to a goal."""
    shapes = cyclic_shapes(28, 15, 16)
    count = len(shapes)
    # No loop is a figure of eight, whose area is a rounding error.
    phase = 0.5 + 2 * np.pi * np.arange(1, 15 * 16 + 1) / 16
    shapes[28:, 2] = shapes[27, 2] + 0.05 * (np.sin(phase) - np.sin(0.5))
    pose = _poses([0.3125, -0.25, 0.125], [0.5, -0.125, 0.0625], count)
    tool = _poses([0.5, 1.25, -0.125], [0.0, 0.25, 0.375], count)
    tool[:, 0] += 1.0
    end = BEGAN + 0.125 * (count - 1)
    goal = turned(0.515625, -0.140625, 0.09375, 0.296875, -0.265625, 0.140625)
    schedule: dict[str, Any] = {"method": "lie_bracket", "goal_id": f"{BEGAN:.9f}"}
    notes: dict[str, Any] = {"zf": [1.5, -2.25]}
    statuses: Statuses = [
        (BEGAN, PlannerStatus(PlannerState.EXECUTING, "Flying.", notes=notes, **schedule)),
        (BEGAN + 1.5, PlannerStatus(PlannerState.EXECUTING, "Corrects.", **schedule)),
        (end, PlannerStatus(PlannerState.REACHED, "Met: <b> & done.", **schedule)),
    ]
    events = [
        _event(0.0, EventKind.GOAL_ACCEPTED),
        _event(1.5, EventKind.CORRECTION, reason="off"),
        _event(1.5, EventKind.CORRECTION, reason="off again"),
        _event(9.25, EventKind.FAULT_INJECTED, fault="joint_slow joint_1 0.5 at 9.25"),
        _event(20.0, EventKind.STUCK_JOINT, joints="joint_1"),
        _event(end - BEGAN, EventKind.GOAL_REACHED),
    ]
    return _report(
        "cycles",
        {
            "pose": pose,
            "q": shapes,
            "qdot": np.diff(shapes, axis=0, prepend=shapes[:1]) / 0.125,
            "momentum": _momenta(count, 0.25, 2.0**-50),
            "end_effector_pose": tool,
            "twist": np.ones((count, 6)),
        },
        urdf=urdf_of(3).replace('sphere radius=".1"', 'box size=".3 .2 .1"'),
        joints=["joint_0", "joint_1", "joint_2"],
        statuses={"planner": statuses},
        goals=[(BEGAN, goal)],
        tool_goals=[(BEGAN, turned(0.0, 0.0, 0.0, 1.0, 1.0, 0.0)), (BEGAN + 9, goal)],
        events=events,
        in_file={"planner": {"position_tolerance": 0.0625, "attitude_tolerance": 0.125}},
        metadata={
            "parameters/planner": {"method": '"lie_bracket"', "averaging": "3"},
            "spacerobot": {"version": "1.2.3"},
        },
        description="Loops & <more>.",
        published=(Published("zf", [1.25, -2.0], "a note"), Published("nothing", [1e-7])),
        planned=[pose[::20, :3] + [0.0, 0.03125, 0.0], pose[100::40, :3]],
        clearance=0.5 * np.cos(0.25 * np.arange(count)),
    )


CHAIN = """<robot name="chain"><link name="base"><inertial><mass value="16"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<visual><origin xyz="0 .125 0"/><geometry><box size="1 .5 .25"/></geometry></visual></link>{}
</robot>"""
PART = """<link name="link_{0}"><inertial><mass value="2"/>
<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial>
<visual><origin xyz="0 0 .125" rpy="0 .25 0"/><geometry><{1}/></geometry></visual></link>
<joint name="{2}" type="{3}"><parent link="{4}"/><child link="link_{0}"/><origin xyz=".5 {0} .25"/>
<axis xyz="{5}"/>{6}</joint>"""
CHAIN_JOINTS = ("a/slide", "turn", "a_joint_with_a_very_long_name", "b", "c", "d", "e", "f")


def _chain() -> str:
    """A slider, a joint without ends and six of unequal limits, one after the other."""
    shapes = ('box size=".25 .5 .125"', 'cylinder radius=".125" length=".5"', 'sphere radius=".25"')
    parts = []
    for k, name in enumerate(CHAIN_JOINTS):
        kind, limit = (
            "revolute",
            f'lower="-{1 + k}" upper="{2 + k}" velocity="{0.5 * k}" effort="{k}"',
        )
        if k == 0:
            kind, limit = "prismatic", 'lower="-0.375" upper="4" velocity="0.25" effort="9"'
        elif k == 1:
            kind, limit = "continuous", 'velocity="1.5" effort="7"'
        parent = "base" if k in (0, 5) else f"link_{k - 1}"
        axis = "1 0 0" if k == 0 else ("0 0 1", "0 1 0")[k % 2]
        more = f"<limit {limit}/>"
        parts.append(PART.format(k, shapes[k % 3], name, kind, parent, axis, more))
    return CHAIN.format("".join(parts))


def _controlled() -> FlightReport:
    """A controller of some outputs; thrusters, peaks of efforts, and sensors that err."""
    count, n = 121, len(CHAIN_JOINTS)
    k = np.arange(count)[:, np.newaxis]
    q = np.sin(0.0625 * k * np.arange(1, n + 1)) * np.linspace(0.5, 2.0, n)
    qdot = np.cos(0.0625 * k * np.arange(1, n + 1)) * 0.125 * np.arange(1, n + 1)
    pose = _poses([-2.0, 1.5, 0.25], [0.25, -0.5, 4.0], count)
    tool = _poses([3.0, 0.5, -1.0], [0.0, 0.75, 0.25], count)
    sensed = pose[5:].copy()
    sensed[:, :3] += [0.03125, -0.0625, 0.015625]
    duty = np.column_stack([(k[:, 0] % 9 < 4) * 0.75, 0.0 * k[:, 0], (k[:, 0] > 40) * 0.5])
    force = duty * [12.0, 10.0, 8.0]
    wrench = np.column_stack([0.5 * np.sin(0.25 * k * np.arange(1, 4)), 0.0 * k, 0.0 * k, 0.0 * k])
    efforts = 0.25 * np.cos(0.5 * k * np.arange(1, n + 1))
    efforts[30, 2] = 40.0
    expected = np.zeros((count, 6))
    expected[:, 0] = 0.5 * k[:, 0]
    momentum = _momenta(count, 2.0, 2.0**-14)
    momentum[:, 0] += 0.5 * k[:, 0]
    errors = ("base.x", "base.z", "base.ry", "end_effector.y", "end_effector.rz")

    def status(state: ControllerState, goal_id: str) -> ControllerStatus:
        command = CommandReport("a_law", False, 1.0, 0.0, 0.0, 0.0, 0.0, dict.fromkeys(errors, 0.1))
        return ControllerStatus(state, "It is <so>.", goal_id, command)

    goal_id = f"{BEGAN + 1:.9f}"
    statuses: Statuses = [
        (BEGAN, status(ControllerState.HOLDING, "")),
        (BEGAN + 1.0, status(ControllerState.TRACKING, goal_id)),
        (BEGAN + 7.0, status(ControllerState.FAILED, goal_id)),
        (BEGAN + 7.25, "Of another package."),
    ]
    goals = [(BEGAN + 1.0, turned(0.25, -0.25, 3.5, -2.25, 1.25, 0.5))]
    return _report(
        "controlled",
        {
            "pose": pose,
            "q": q,
            "qdot": qdot,
            "momentum": momentum,
            "expected_momenta": expected,
            "end_effector_pose": tool,
            "twist": np.sin(0.125 * k * np.arange(1, 7)),
            "measured_pose": sensed,
            "measured_q": q[5:] + 0.0078125 * np.sin(k[5:] * np.arange(n)),
            "thruster_duty": duty,
            "thruster_force": force,
            "propellant": 0.001953125 * np.cumsum(duty.sum(axis=1))[:, np.newaxis],
        },
        urdf=_chain(),
        joints=CHAIN_JOINTS,
        thrusters=("up", "a_thruster_with_a_very_long_name", "down"),
        statuses={"coordinated_control": statuses},
        goals=goals,
        tool_goals=[
            (BEGAN + 1.0, turned(0.0, 0.5, 0.0, 2.5, 0.25, -0.5)),
            (BEGAN + 5.0, turned(0.0, 0.75, 0.5, 2.75, 0.5, -0.75)),
        ],
        topics={"base_wrench": wrench, "joint_commands": efforts[:, ::-1]},
        in_file={"plant": {"actuation": "effort"}},
        period=0.0625,
        namespace="/left",
        others=("/right", ""),
        events=[_event(2.5, EventKind.LATCHED), _event(3.5, EventKind.REARMED)],
        clearance=0.5 + 0.25 * np.cos(0.25 * np.arange(count)),
    )


def _planar() -> FlightReport:
    """Two joints in a plane that turn the base alone, over loops that close."""
    count = 49
    phase = 2 * np.pi * np.arange(count)[:, np.newaxis] / 8
    q = np.hstack([0.5 - 0.5 * np.cos(phase), 0.25 * np.sin(phase)])
    pose = _poses([0.25, 0.5, 0.0], [0.0, 0.0, 1.0], count)
    parts = [
        PART.format(k, 'box size=".5 .25 .25"', f"joint_{k}", "revolute", parent, "0 0 1", limit)
        for k, parent, limit in (
            (0, "base", '<limit lower="-3" upper="1.0625" velocity="0.75" effort="1"/>'),
            (1, "link_0", '<limit lower="-1" upper="1" velocity="2" effort="1"/>'),
        )
    ]
    urdf = CHAIN.format("".join(parts)).replace(' rpy="0 .25 0"', "")
    statuses: Statuses = [
        (BEGAN + 0.5, PlannerStatus(PlannerState.EXECUTING, "Flies.", method="square_path")),
    ]
    return _report(
        "planar",
        {"pose": pose, "q": q, "qdot": np.gradient(q, 0.25, axis=0)},
        period=0.25,
        urdf=urdf,
        joints=["joint_0", "joint_1"],
        statuses={"planner": statuses},
        goals=[(BEGAN, turned(0.0, 0.0, 1.5, 3.0, 0.0, 0.0))],
        metadata={"parameters/plant": {"tick_rate": "4.0"}},
    )


def _bare() -> FlightReport:
    """One state of two joints that nobody describes."""
    pose = np.array([[0.25, -0.5, 0.75, 0.0, 0.0, 0.0, 1.0]])
    return _report(
        "bare",
        {"pose": pose, "q": np.array([[0.5, -0.25]]), "qdot": np.array([[0.0, 0.125]])},
        joints=["one", "two"],
    )


_MAKERS: dict[str, Callable[[], FlightReport]] = {
    "cycles": _cycles,
    "controlled": _controlled,
    "planar": _planar,
    "bare": _bare,
}
MADE = tuple(_MAKERS)


@cache
def made_flight(name: str) -> FlightReport:
    """Return a flight by its name."""
    return _MAKERS[name]()
