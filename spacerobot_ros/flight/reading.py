"""Reads a flight from its bag; data missing from the bag are empty.

:func:`read_flight` reads bags from any stack; :func:`read_run` reads complete bags recorded by
``spacerobot run``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag import Bag, RecordedRobot, TopicSeries, read_bag
from spacerobot_ros.commanding.goal_follower import STATUS_TOPICS, GoalFollower, Status
from spacerobot_ros.errors import (
    GoalError,
    PlanningError,
    RecordingError,
    RobotDescriptionError,
    SpaceRobotError,
)
from spacerobot_ros.events import Event
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.series import (
    Commands,
    SentGoal,
    Signal,
    goal_at_end,
    with_reported_goals,
)
from spacerobot_ros.measures import Outcome
from spacerobot_ros.messages.diagnostics import read_status
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, Array, RobotDescription
from spacerobot_ros.model.thrusters import IN_URDF, find_thrusters
from spacerobot_ros.model.urdf import obstacles_from_topic, parse_robot, with_world
from spacerobot_ros.parameters import declared, known_values
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import POSE, EndEffectorGoal
from spacerobot_ros.planning.execution.goal_file import GoalIds
from spacerobot_ros.scenario import COMMANDERS, CONFIGS, Published, Scenario
from spacerobot_ros.simulation.capture import target_parameters
from spacerobot_ros.times import SECOND
from spacerobot_ros.topics import TOPICS, StateField, link_topic, topic_named

_SAME_CLOCK_TOLERANCE = 1.0
"""If stamps differ from log times by less than this value (s), both come from the same clock."""

_QUANTITY_TOPICS = (
    *("momentum", "end_effector_pose", "momentum_expected"),
    *("base_wrench_realised", "thrusters", "target/odom", "target/odom_true"),
)
"""Topics whose fields are flight quantities, except those with true and measured variants."""

_FLIGHT_TOPICS = (
    *("odom", "odom_true", "joint_states", "joint_states_true"),
    *_QUANTITY_TOPICS,
    *("joint_commands", "base_wrench", "joint_reference"),
    *(topic for topic, _ in STATUS_TOPICS.values()),
    *("events", "clearance"),
)
"""Topics read together for every flight, so that the bag is unpacked only once."""

_NO_GOAL = Goal.checked([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
"""Base goal if a bag contains no goal, or a goal that leaves the base free."""

_ABSENT_MEANS_ZERO = (("planner", "clearance"), ("plant", "clearance_period"))
"""Parameters missing from bags recorded by earlier versions, by node; the features that these
parameters control did not exist."""


class FlightBag(RecordedRobot):
    """One robot's topics in a bag as signals over time.

    Times are stamps (s), or log times if stamps come from another clock. If that clock runs at
    another rate, such as simulated time beside the wall clock, log times are converted to stamps.

    Parameters
    ----------
    bag
        The recording.
    namespace
        Namespace of the robot's topics, such as ``/robot_1``; empty if there is no namespace.
    from_start
        Whether times begin at the first state.
    """

    def __init__(self, bag: Bag, namespace: str = "", *, from_start: bool = False) -> None:
        super().__init__(bag, namespace)
        self.path = bag.path
        self.load(_FLIGHT_TOPICS)
        states = [s for name in ("odom", "joint_states", "momentum") if (s := self.get(name))]
        self.stamped = all(abs(s.stamp[0] - s.time[0]) < _SAME_CLOCK_TOLERANCE for s in states)
        self._clock: tuple[NDArray[np.int64], NDArray[np.int64]] | None = None
        """Log times and stamps of states, ns, if their clocks run at different rates, without
        jumps."""
        with_stamps = [each for each in states if each.stamped]
        if with_stamps and not self.stamped:
            first, times = with_stamps[0], (with_stamps[0].time_ns, with_stamps[0].stamp_ns)
            near = np.ptp([each.stamp[0] for each in with_stamps]) < _SAME_CLOCK_TOLERANCE
            jumps = any(np.any(np.diff(each) <= 0) for each in times)
            drift = abs(np.ptp(first.time) - np.ptp(first.stamp))
            if near and not jumps and drift >= _SAME_CLOCK_TOLERANCE:
                self.stamped, self._clock = True, times
        self._zero = 0.0
        self.began = min((self._times(s)[0] for s in states), default=bag.start_time)
        """Time of the first state according to the bag's clock, s."""
        if from_start:
            self._zero = self.began

    def messages(self, name: str) -> Iterator[tuple[int, Any]]:
        """Iterate over the messages of a topic, each with its log time in ns."""
        series = self.get(name)
        return iter(()) if series is None else series.messages()

    @property
    def message_count(self) -> int:
        """Number of messages on all topics."""
        return self.bag.message_count()

    @property
    def description(self) -> RobotDescription | None:
        """The first readable robot description, with the last received obstacles; None if no
        description is readable.
        """
        for text in self.bag.robot_descriptions(self.namespace):
            try:
                found = parse_robot(text.decode())
            except (RobotDescriptionError, UnicodeDecodeError):
                continue
            came = self.obstacles
            return with_world(found, came[-1][1]) if came else found
        return None

    @cached_property
    def obstacles(self) -> list[tuple[int, RobotDescription | None]]:
        """The messages on the topic obstacles, with their log times, ns; None: no obstacles.
        Messages that the nodes would reject are omitted.
        """
        came = []
        for time_ns, message in self.messages("obstacles"):
            with suppress(RobotDescriptionError):
                came.append((time_ns, obstacles_from_topic(message.data)))
        return came

    @property
    def obstacles_change(self) -> bool:
        """Whether obstacles were published after the first state."""
        states = self.get("odom")
        return states is not None and any(t / SECOND > states.time[0] for t, _ in self.obstacles)

    # -- signals ------------------------------------------------------------------------------

    def signal(
        self, name: str, fields: Sequence[str], width: int, joints: Sequence[str] | None = None
    ) -> Signal:
        """Return fields of a topic over time, omitting messages that lack a field.

        Parameters
        ----------
        name
            The topic.
        fields
            Paths of numbers, or of one array.
        width
            Number of columns.
        joints
            Names of the joints or thrusters, in the order of the columns; None: those in the first
            message.
        """
        series = self.get(name)
        if series is None:
            return Signal.empty(width)
        if topic_named(name).type == TOPICS["joint_states"].type:
            names = self.names(name) if joints is None else joints
            values = np.hstack([series.of_joints(path, names) for path in fields])
        else:
            values = series.table(fields, width)
        whole = np.isfinite(values).all(axis=1)
        time, values = self._times(series)[whole], values[whole]
        order = np.argsort(time, kind="stable")
        return Signal(time[order], values[order])

    def quantity(self, name: str, field: StateField) -> Signal:
        """Return the values of a state topic's field over time."""
        width = len(field.members) or len(field.array_entry_names) or len(self.names(name))
        return self.signal(name, field.columns, width)

    def series(self) -> dict[str, Signal]:
        """Return all quantities in :attr:`Flight.series` that the bag contains.

        While sensors have errors, true states are on ``odom_true`` and ``joint_states_true``.
        """
        found: dict[str, Signal] = {}
        for name in ("odom", "joint_states"):
            variants = name, f"{name}_true"
            if not any(each in self for each in variants):
                continue
            for field in TOPICS[name].state:
                quantity = field.quantity.removeprefix("measured_")
                measured, true = (self.quantity(each, field) for each in variants)
                found[quantity] = _completed(true, measured)
                if len(true) and quantity != "effort":
                    found[f"measured_{quantity}"] = measured.between(*true.time[[0, -1]].tolist())
        prefix = f"{self.namespace}/"
        poses = (
            name.removeprefix(prefix)
            for name in self.bag.topics
            if name.startswith(prefix) and name.endswith("/pose")
        )
        for name in filter(self.__contains__, (*_QUANTITY_TOPICS, *poses)):
            for field in topic_named(name).state:
                found[field.quantity] = self.quantity(name, field)
        return found

    def _times(self, series: TopicSeries) -> Array:
        if self._clock is not None and not series.stamped:
            return np.interp(series.time_ns, *self._clock) / SECOND - self._zero
        return (series.stamp if self.stamped else series.time) - self._zero

    def _by_stamps(self, log_time_ns: int) -> int:
        if self._clock is None:
            return log_time_ns
        return round(float(np.interp(log_time_ns, *self._clock)))

    # -- reports ------------------------------------------------------------------------------

    def statuses(self, commander: str) -> Iterator[tuple[int, Status | str]]:
        """Yield a commander's statuses with their times, ns.

        For a status from another package, only the message is returned.
        """
        topic, read = STATUS_TOPICS[commander]
        for log_time_ns, recorded in self.messages(topic):
            time_ns = self._by_stamps(log_time_ns) - round(self._zero * SECOND)
            message = read_status(recorded)
            try:
                yield time_ns, read(message.values, message.message)
            except SpaceRobotError:
                yield time_ns, message.message

    def events(self) -> Iterator[tuple[int, Event]]:
        """Yield the events as published, with their log times, ns."""
        for time_ns, recorded in self.messages("events"):
            message = read_status(recorded)
            try:
                event = Event.from_values(message.values, message.message, message.level)
            except SpaceRobotError:
                continue  # The event is from a later version.
            yield time_ns, replace(event, node=message.name.strip("/"))

    def timed_events(self) -> Iterator[Event]:
        """Yield the events with times like those of the signals; an event without a time has its
        log time."""
        for time_ns, event in self.events():
            time = event.time_s if self.stamped else None
            time = self._by_stamps(time_ns) / SECOND if time is None else time
            yield replace(event, time_s=time - self._zero)

    def goals(self, link: str = "") -> tuple[SentGoal, ...]:
        """Return the valid goals of the base, or of an end-effector, in the odometry frame; for a
        path, the last pose is the goal."""
        odom = next(self.messages("odom"), None)
        world = odom[1].header.frame_id if odom is not None else ""
        goals, shapes = list[SentGoal](), [] if link else self._goal_shapes()
        for topic, time_ns, goal_id, message in self._goal_messages(link):
            poses = getattr(message, "poses", [message])
            if not poses:
                continue
            shape = None
            if topic == "goal_pose":
                shape = next((each for since, each in reversed(shapes) if since <= time_ns), None)
            frame = poses[-1].header.frame_id or message.header.frame_id
            *through, (position, attitude) = map(pose_of, poses)
            if topic != "goal_pose" and not any(attitude):
                # Zeros request only the position of an end-effector.
                attitude = _NO_GOAL.quaternion.tolist()
            time = self._by_stamps(time_ns) / SECOND - self._zero
            try:
                goal = Goal.received(position, attitude, shape)
                if goal.asked != POSE and len(self._poses):
                    row = max(int(np.searchsorted(self._poses.time, time, side="right")) - 1, 0)
                    goal = goal.kept_at(*np.split(self._poses.values[row], [3]))
                if topic == "goal_path" and through:
                    goal = replace(goal, waypoints=np.array([x + q for x, q in through]))
            except PlanningError:
                continue
            if not world or frame in ("", world):
                goals.append(SentGoal(time, goal, goal_id))
        return tuple(sorted(goals, key=lambda sent: sent.time))

    @cached_property
    def _poses(self) -> Signal:
        """Measured base poses (N, 7)."""
        return self.quantity("odom", TOPICS["odom"].state[0])

    def goal_ids(self, links: Iterable[str]) -> set[str]:
        """Return the ids of the goals of the base and of links; a goal may be invalid."""
        return {goal_id for link in ("", *links) for _, _, goal_id, _ in self._goal_messages(link)}

    def _goal_messages(self, link: str) -> Iterator[tuple[str, int, str, Any]]:
        """Yield the topics, log times (ns), ids and messages of goals of the base or of a link."""
        topics = ["goal_pose", "goal_path"]
        if link:
            topics = [link_topic(link, kind) for kind in ("goal_pose", "path")]
        for topic in topics:
            ids = GoalIds()
            for time_ns, message in self.messages(topic):
                stamp = message.header.stamp
                yield topic, time_ns, ids.of(stamp.sec, stamp.nanosec), message

    def _goal_shapes(self) -> list[tuple[int, list[float] | None]]:
        """Return the final shapes required of goals after a time (ns); None: any."""
        names = self.names("joint_states")
        shapes: list[tuple[int, list[float] | None]] = []
        for time_ns, message in self.messages("goal_joint_states"):
            given = dict(zip(message.name, map(float, message.position), strict=False))
            if not given:
                shapes.append((time_ns, None))
            elif given.keys() == set(names):
                shapes.append((time_ns, [given[name] for name in names]))
        return shapes

    def commands(self, actuation: str) -> dict[str, Commands]:
        """Return the commands by topic, for a plant with an actuation."""
        joints, found = self.names("joint_states"), {}
        for name, paths in (
            ("joint_commands", ["velocity" if actuation == "velocity" else "effort"]),
            ("base_wrench", TOPICS["base_wrench_realised"].state[0].columns),
            ("joint_reference", ["velocity"]),
        ):
            if name in self:
                width = 6 if name == "base_wrench" else len(joints)
                signal = self.signal(name, paths, width, joints)
                found[name] = Commands(signal.time, signal.values)
        return found


def _completed(true: Signal, measured: Signal) -> Signal:
    """Return the true values, with measured values before the first and after the last one."""
    if not (len(true) and len(measured)):
        return true if len(true) else measured
    before, after = measured.time < true.time[0], measured.time > true.time[-1]
    time = [measured.time[before], true.time, measured.time[after]]
    values = [measured.values[before], true.values, measured.values[after]]
    return Signal(np.concatenate(time), np.concatenate(values))


# -- any bag ----------------------------------------------------------------------------------


def open_flight_bag(
    path: str | os.PathLike[str], namespace: str | None = None, *, from_start: bool = False
) -> FlightBag:
    """Open a bag.

    Parameters
    ----------
    path
        As for :func:`~spacerobot_ros.bag.read_bag`.
    namespace
        Namespace of the robot's topics, with or without the leading slash; None selects the first
        namespace with an ``odom`` topic, in alphabetical order.
    from_start
        Whether times begin at the first state.

    Raises
    ------
    RecordingError
        The bag or the robot does not exist, or the bag is damaged.
    """
    bag = read_bag(path)
    prefixes = namespaces(bag)
    chosen = prefixes[0] if prefixes else ""
    if namespace is not None:
        chosen = f"/{namespace.strip('/')}".rstrip("/")
        if chosen not in prefixes:
            known = ", ".join(name or "/" for name in prefixes)
            known = known or f"no robot{RecordedRobot(bag, chosen).instead_of('odom')}"
            raise RecordingError(
                f"The bag {bag.path} has no robot in the namespace '{namespace}': it has {known}."
            )
    return FlightBag(bag, chosen, from_start=from_start)


def pose_of(stamped: Any) -> tuple[list[float], list[float]]:
    """Return the position and quaternion of a message with a pose."""
    p, o = stamped.pose.position, stamped.pose.orientation
    return [p.x, p.y, p.z], [o.x, o.y, o.z, o.w]


def namespaces(bag: Bag) -> list[str]:
    """Return the namespaces with an ``odom`` topic in a bag, in alphabetical order."""
    found = {
        topic.rpartition("/")[0]
        for topic, kind in bag.topics.items()
        if topic.endswith("/odom") and kind == TOPICS["odom"].type
    }
    # A robot's target also has odometry.
    return sorted(found - {f"{name}/target" for name in found})


def read_flight(bag: FlightBag) -> Flight:
    """Return a flight with all the data in its bag.

    Raises
    ------
    RecordingError
        A message is damaged.
    """
    description, names = bag.description, bag.names("joint_states")
    if not names and description is not None:
        names = list(description.joint_names)
    scenario = _scenario_in_bag(bag)
    statuses = {
        name: [(time, status) for time, status in bag.statuses(name) if not isinstance(status, str)]
        for name in COMMANDERS
    }
    decider = next((name for name in COMMANDERS if statuses[name]), COMMANDERS[0])
    goals, tool_goals = bag.goals(), bag.goals(DEFAULT_END_EFFECTOR)
    link = scenario.in_file.get("coordinated_control", {}).get("end_effector_frame")
    if link and not tool_goals and "planner" not in scenario.commanders:
        tool_goals = bag.goals(link)
    reports = [status for _, status in statuses[decider]]
    sent = goals or next(filter(None, map(bag.goals, scenario.goal_links)), ())
    # Bags from version 0.1 have no ids.
    goal_id = sent[-1].goal_id if sent else ""
    known = bag.goal_ids({DEFAULT_END_EFFECTOR, link or DEFAULT_END_EFFECTOR, *scenario.goal_links})
    # Some goals are sent before the recorder has discovered their sender.
    missed = [each for each in statuses[decider] if each[1].goal_id not in {"", *known}]
    if missed and (not sent or missed[-1][0] > sent[-1].time * SECOND):
        goal_id = missed[-1][1].goal_id
    goals = with_reported_goals(goals, missed)
    # Bags from earlier versions lack the poses of a controller's goals.
    is_unknown = goal_id not in {"", *known, *(each.goal_id for each in goals)}
    follower, status = GoalFollower(goal_id, unnamed=True), None
    for status in reports:
        if follower.update(status):
            break
    decision = follower.decision
    flight = Flight(
        scenario=scenario,
        robot=description,
        joint_names=tuple(names),
        series=bag.series(),
        commands=bag.commands(scenario.plant.actuation),
        statuses=tuple(sorted((s for each in statuses.values() for s in each), key=lambda s: s[0])),
        events=tuple(bag.timed_events()),
        outcome=Outcome.INTERRUPTED if decision is None else Outcome(decision.state.value),
        message=_last_message(status, decided=decision is not None),
        goal=None if is_unknown else goal_at_end(reports, goals),
        end_effector_goal=tool_goals[-1].goal if tool_goals else None,
        goals=goals,
        end_effector_goals=tool_goals,
        status=status,
        gait=follower.gait,
        # Clearances refer to a single set of obstacles.
        measures_clearance="clearance" in bag and not bag.obstacles_change,
    )
    # A thruster table in a separate file is not read, because a bag may name any file.
    in_urdf = scenario.in_file.get("plant", {}).get("thrusters") == IN_URDF
    return _with_propellant(flight, IN_URDF, bag.names("thrusters")) if in_urdf else flight


def _last_message(status: Status | None, decided: bool) -> str:
    if status is None:
        return ""
    if decided or status.state.value not in ("executing", "tracking"):
        return status.message
    # The distances after the semicolon are older than the last recorded state.
    doing = status.message.partition(";")[0].removesuffix(".")
    return f"{doing}. The recording ends before the outcome is known."


def read_flown(bag: FlightBag, scenario: Scenario) -> Flight:
    """Return the flight in the bag of a scenario, with the goals of the scenario.

    Raises
    ------
    RecordingError
        A message is damaged, or there are no poses, joint states or momenta.
    """
    flight = read_flight(bag)
    for topic, quantity in (("odom", "pose"), ("joint_states", "q"), ("momentum", "momentum")):
        if not len(flight.signal(quantity)):
            raise RecordingError(
                f"The bag {bag.path} contains no states: there are no messages on /{topic}."
            )
    flight = replace(
        flight,
        scenario=scenario,
        goal=scenario.goal.kept_at(*np.split(flight.pose[0], [3])),
        end_effector_goal=scenario.end_effector_goal,
    )
    return _with_propellant(flight, scenario.plant.thrusters, bag.names("thrusters"))


def _with_propellant(flight: Flight, thrusters: str, names: Sequence[str]) -> Flight:
    """Return a flight with the quantity ``propellant`` (N, 1), kg, integrated from its thrusts, if
    the table of ``thrusters`` (as in the plant's parameters) has the given names."""
    robot, series = flight.robot, flight.series
    if robot is None or "thruster_force" not in series or "propellant" in series:
        return flight
    try:
        table = find_thrusters(thrusters, robot)
    except SpaceRobotError:
        return flight
    if list(table.names) != list(names):
        return flight
    thrust = flight.signal("thruster_force")
    used = impulse(thrust, table.mass_flow / table.force, flight.resets)
    return replace(flight, series={**series, "propellant": used})


def impulse(thrust: Signal, weights: Array, resets: Sequence[float] = ()) -> Signal:
    """Return the time integral (N, 1) of thrusts (N, m), N, with weights (m,), since the start or
    the last reset (s)."""
    ticks = np.diff(thrust.time, prepend=thrust.time[:1])
    total = np.cumsum(ticks * (thrust.values @ weights))
    for row in thrust.rows_after(resets):
        total[row:] -= total[row - 1]
    return Signal(thrust.time, total[:, np.newaxis])


def _scenario_in_bag(bag: FlightBag) -> Scenario:
    about = bag.metadata.get("scenario", {})
    nodes: dict[str, dict[str, Any]] = {
        node: _recorded_values(kind, bag.metadata[f"parameters/{node}"])
        for node, kind in CONFIGS.items()
        if f"parameters/{node}" in bag.metadata
    }
    for node, parameter in _ABSENT_MEANS_ZERO:
        if node in nodes:
            nodes[node].setdefault(parameter, 0.0)
    if nodes.get("plant", {}).get("actuation", "auto") == "auto" and "plant" in nodes:
        nodes["plant"]["actuation"] = recorded_actuation(bag)
    target = recorded_target(bag)
    if target and "plant" in nodes:
        nodes["plant"] |= target_parameters(target)
    urdf, own = bag.urdf, nodes.get("plant", {}).get("robot", "")
    for values in nodes.values():
        if urdf is not None and values.get("robot") in ("", own):
            # The robot's URDF contains its obstacles.
            values |= {"robot_description": urdf.decode(errors="replace"), "world": ""}
    published: tuple[Published, ...] = ()
    goal = end_effector_goal = None
    with suppress(KeyError, TypeError, ValueError):
        published = tuple(
            Published(str(r["quantity"]), [float(x) for x in r["printed"]], str(r["note"]))
            for r in _parse_json(about.get("published", "[]"))
        )
    with suppress(KeyError, ValueError):
        goal, end_effector_goal = _sent_goal(about, "goal"), _sent_goal(about, "end_effector_goal")
    shape = next(bag.messages("goal_joint_states"), None)
    # Without joint positions, the shape was free.
    if goal is not None and shape is not None and len(shape[1].position):
        goal = replace(goal, joint_positions=np.array(shape[1].position))
    links = _parse_json(about.get("end_effector_goals", "{}"))
    with suppress(GoalError, AttributeError):
        if links:
            free = goal is None
            goal = goal or _NO_GOAL
            aims = tuple(EndEffectorGoal.of_numbers(str(x), pose) for x, pose in links.items())
            goal = replace(goal, end_effectors=aims, base=frozenset() if free else POSE)
    return Scenario(
        name=about.get("name", "") or bag.path.stem,
        path=bag.path,
        description=about.get("description", ""),
        goal=goal or _NO_GOAL,
        end_effector_goal=end_effector_goal,
        commanders=tuple(name for name in COMMANDERS if name in nodes) or COMMANDERS[:1],
        published=published,
        published_method="",
        kills=(),
        in_file=nodes,
        overrides={},
        has_goal=goal is not None,
    )


def recorded_actuation(robot: FlightBag) -> str:
    """Return the commanded quantity for a robot in a bag: ``velocity`` or ``effort``.

    The quantity is read from the plant's status. In bags without a plant status, efforts are
    assumed if there are wrench commands.
    """
    for _, message in reversed(list(robot.messages("plant/status"))):
        actuation = read_status(message).values.get("actuation", "")
        if actuation in ("velocity", "effort"):
            return actuation
    return "effort" if robot.get("base_wrench") else "velocity"


def _recorded_values(kind: type[Any], texts: Mapping[str, str]) -> dict[str, Any]:
    """Return the recorded parameters of a node that this version can read."""
    values = known_values(kind, {name: _parse_json(text) for name, text in texts.items()})
    for parameter in declared(kind):
        value = values.get(parameter.name)
        if isinstance(value, str) and parameter.excludes(value):
            del values[parameter.name]
    return values


def recorded_target(robot: FlightBag) -> str:
    """Return the URDF of a robot's target in a bag; empty if there is no target."""
    described = next(robot.messages("target/robot_description"), None)
    return "" if described is None else str(described[1].data)


def _parse_json(text: str) -> Any:
    """Return a value that was written as JSON; None if it cannot be read."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


# -- a bag of spacerobot run ------------------------------------------------------------------


def _sent_goal(about: Mapping[str, str], name: str) -> Goal | None:
    """Return a recorded goal with all digits as sent."""
    if f"{name}_position" not in about:
        return None
    position, quaternion = (
        np.array([float(word) for word in about[f"{name}_{part}"].split()])
        for part in ("position", "orientation")
    )
    goal = Goal(position, quaternion)
    if name != "goal":
        return goal
    # Bags from earlier versions do not state what was requested: zero values were not.
    given = {"position": position.any(), "attitude": quaternion[:3].any()}
    parts = about.get("goal_asked", " ".join(part for part in given if given[part])).split()
    waypoints = about.get("goal_waypoints")
    return replace(
        goal,
        asked=frozenset(part for part in POSE if part in parts),
        waypoints=None if waypoints is None else np.array(_parse_json(waypoints)),
    )


def read_run(path: str | os.PathLike[str]) -> Flight:
    """Return the flight in a ``spacerobot run`` bag, with the same arrays as a flight without ROS.

    Raises
    ------
    RecordingError
        The bag does not exist, is damaged, or does not contain a complete lockstep flight.
    SpaceRobotError
        Its robot is invalid.
    """
    bag = open_flight_bag(path)
    scenario = _scenario_in_bag(bag)
    if not scenario.has_goal or "plant" not in scenario.in_file:
        raise RecordingError(
            f"The bag {bag.path} lacks the goal or the parameters of its flight; bags recorded "
            f"by 'spacerobot run' contain them."
        )
    urdf = bag.urdf
    if urdf is None:
        raise RecordingError(f"The bag {bag.path} contains no robot description.")
    robot = scenario.plant.assumed_robot(parse_robot(urdf.decode(errors="replace")))
    flight = _with_flown_goal(replace(read_flown(bag, scenario), robot=robot))
    if len(flight.pose) != len(flight.q):
        raise RecordingError(
            f"The bag {bag.path} has {len(flight.pose)} base poses and {len(flight.q)} "
            "joint states: the flight is incomplete."
        )
    if not flight.goals and not scenario.goal.end_effectors:
        raise RecordingError(f"The bag {bag.path} contains no goal pose.")
    return flight


def _with_flown_goal(flight: Flight) -> Flight:
    """Return a flight with the goal pursued at its end, unless that is the goal of its scenario:
    other goals are sent to a stack that ``spacerobot up`` keeps running."""
    own, flown = flight.goal, goal_at_end([each for _, each in flight.statuses], flight.goals)
    if own is None or flown is None:
        return flight
    aims = {each.link: each.position for each in flown.end_effectors}
    pairs = [(aims.get(each.link, each.position), each.position) for each in own.end_effectors]
    if flown.base >= own.base:
        pairs += [(flown.position, own.position)] if "position" in own.asked else []
        pairs += [(flown.quaternion, own.quaternion)] if "attitude" in own.asked else []
    if pairs and all(np.allclose(*pair, rtol=1e-6, atol=1e-6) for pair in pairs):
        return flight
    return replace(flight, goal=flown, scenario=flight.scenario.with_other_goal(flown))
