"""Parts of a flight by themselves: its loop, its bag, and what is read of it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight import lockstep, reading, saved
from spacerobot_ros.flight.flight import Signal
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import load_robot
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.topics import state_topics

BEFORE, AFTER = lockstep._DecisionState


# -- the loop ------------------------------------------------------------------------------------


def loop(**parts: Any) -> Any:
    """Return a flight of which only the given parts are there."""
    made: Any = object.__new__(lockstep._LockstepFlight)
    made._tick, made._period_ns, made._decided, made._moment = 6, 250_000_000, None, BEFORE
    made._planner = made._controller = made._status = None
    made.log = SimpleNamespace(events=[], statuses=[], commands=[], refusals=[])
    made.log.add_command = lambda *given: made.log.commands.append(given)
    made._commanders = []
    vars(made).update(parts)
    return made


def test_commanders_hear_of_the_plant_when_its_status_changes() -> None:
    first, second = PlantStatus(PlantState.RUNNING), PlantStatus(PlantState.FAILED)
    monitor, heard = SimpleNamespace(status=first), list[Any]()

    def update(activity: PlantState, time: float) -> list[Any]:
        assert time == 1.5
        monitor.status = {PlantState.FAILED: second}.get(activity, first)
        return [activity]

    monitor.update = update
    commander = SimpleNamespace(receive_plant_status=heard.append)
    made = loop(_monitor=monitor, _plant=SimpleNamespace(injected=(1,)), _commanders=[commander])
    made._report_plant_status(PlantState.RUNNING)
    assert heard == []
    assert (made._moment, made._injected_seen) == (AFTER, (1,))
    made._report_plant_status(PlantState.FAILED)
    assert heard == [second]
    assert made.log.events == [PlantState.RUNNING, PlantState.FAILED]


@pytest.mark.parametrize("decided", [None, BEFORE, AFTER])
@pytest.mark.parametrize("latches", [None, False, True])
def test_commands_after_a_decision_before_them_are_logged_alone(
    decided: Any, latches: bool | None
) -> None:
    offered, reported = list[Any](), list[Any]()
    refusal = None if latches is None else SimpleNamespace(latches=latches)

    def offer(*given: Any) -> Any:
        offered.append(given)
        return refusal

    source: Any = SimpleNamespace(topic="joint_commands")
    made = loop(_commands=SimpleNamespace(accept_or_refuse=offer), _decided=decided)
    made._report_plant_status = reported.append
    made._offer_command(source, "values", 17)
    assert made.log.commands == [("joint_commands", 6, "values")]
    if decided is BEFORE:
        assert (offered, made.log.refusals) == ([], [])
        return
    assert offered == [(source, 17, "values", 17)]
    assert made.log.refusals == ([] if refusal is None else [(1.5, "joint_commands", refusal)])
    assert reported == ([PlantState.RUNNING] if latches else [])


def test_the_decision_is_that_of_the_commander_that_has_the_goal() -> None:
    taken: list[Any] = []

    def take(status: Any) -> bool:
        taken.append(status)
        return len(taken) == 2

    planned = PlannerStatus(PlannerState.IDLE, "")
    controlled = ControllerStatus(next(iter(ControllerState)), "")
    made = loop(_follower=SimpleNamespace(update=take), _planner=object())
    assert made._expected_end == 0.0
    for status in (planned, controlled, planned, planned):
        made.take_status(status)
    assert [at for at, _ in made.log.statuses] == [1_500_000_000] * 4
    assert taken == [planned, planned]
    assert made._decided is BEFORE
    assert made._expected_end == planned.ends_at_s
    taken.clear()
    alone = loop(_follower=SimpleNamespace(update=take), _moment=AFTER)
    for status in (planned, controlled, controlled):
        alone.take_status(status)
    assert taken == [controlled, controlled]
    assert (alone._decided, alone._expected_end) == (AFTER, 0.0)


def test_events_without_a_time_are_of_now() -> None:
    made = loop()
    for time in (None, 0.25, 0.0):
        made.take_event(Event(EventKind.RUNNING, "", time_s=time))
    assert [event.time_s for event in made.log.events] == [1.5, 0.25, 0.0]


@pytest.mark.parametrize(
    ("decision", "interrupted", "plant", "own", "outcome", "message"),
    [
        (None, "Stop.", "p", "s", Outcome.INTERRUPTED, "Stop."),
        (None, "", "p", "s", Outcome.INTERRUPTED, "p"),
        (None, "", "", "s", Outcome.INTERRUPTED, "s"),
        (None, "", "", None, Outcome.INTERRUPTED, ""),
        (("reached", "Done."), "Stop.", "p", "s", Outcome.REACHED, "Done."),
    ],
)
def test_a_result_says_how_the_flight_ended(
    decision: Any, interrupted: str, plant: str, own: str | None, outcome: Outcome, message: str
) -> None:
    made = loop(_scenario="scenario", _status=None if own is None else SimpleNamespace(message=own))
    found = decision and SimpleNamespace(state=SimpleNamespace(value=decision[0]), message="Done.")
    made._follower = SimpleNamespace(decision=found, gait="gait")
    made._monitor = SimpleNamespace(status=SimpleNamespace(message=plant))
    made._robots = SimpleNamespace(description=None, plant=SimpleNamespace(description="robot"))
    made.log.flight = lambda *given, **named: (given, named)
    given, named = made._result(2.5, interrupted)
    assert given == ("scenario", "robot")
    assert (named["outcome"], named["message"]) == (outcome, message)
    assert (named["plan_time"], named["wall_time"], named["gait"]) == (0.0, 2.5, "gait")
    made._planner = SimpleNamespace(statistics=SimpleNamespace(plan_time_s=0.75))
    assert made._result(2.5, interrupted)[1]["plan_time"] == 0.75


def test_a_step_that_the_plant_cannot_take_ends_the_flight() -> None:
    def refuse(*commands: Any) -> None:
        raise SpaceRobotError("it spins")

    calls: list[Any] = []
    commands = SimpleNamespace(begin_step=lambda: ["c"], rest=lambda: calls.append("rest"))
    plant = SimpleNamespace(step=lambda *given: calls.append(given), capturing=None)
    made = loop(_plant=plant, _commands=commands, _monitor=SimpleNamespace(failure=("", "")))
    made._report_plant_status = calls.append
    assert made._step()
    assert (calls, made._tick) == ([("c",)], 7)
    plant.capturing = SimpleNamespace(reports=["captured"])
    assert made._step()
    assert calls[2:] == [PlantState.RUNNING]
    plant.step = refuse
    assert not made._step()
    assert made._tick == 8
    assert made._monitor.failure == ("model", "The plant stops at 2 s: it spins")
    assert calls[3:] == ["rest", PlantState.FAILED]


@pytest.mark.parametrize("engine", ["exact", "mujoco"])
def test_contacts_are_among_the_events_of_their_time(engine: str) -> None:
    def event(kind: EventKind, time: float | None) -> Event:
        return Event(kind, "", time_s=time)

    contact = next(iter(cast(Any, lockstep).CONTACTS))
    events = [
        event(EventKind.RUNNING, 0.5),
        event(EventKind.LATCHED, None),
        event(EventKind.LATCHED, 0.5),
        event(EventKind.REARMED, 1.0),
    ]
    asked: list[tuple[int, bool]] = []

    def contacts(every: int, *, has_contact_forces: bool) -> list[Event]:
        asked.append((every, has_contact_forces))
        return [event(contact, 0.5), event(contact, 0.75), event(contact, 2.0)]

    flight: Any = SimpleNamespace(clearance=None)
    assert lockstep._with_contacts(flight) is flight
    made = cast(Any, lockstep)._with_contacts
    recorded: list[Any] = []

    def replaced(_: Any, *, events: Any) -> Any:
        recorded.extend(events)
        return "flight"

    given: Any = SimpleNamespace(
        clearance=SimpleNamespace(contacts=contacts),
        events=events,
        scenario=SimpleNamespace(plant=SimpleNamespace(clearance_ticks=3, engine=engine)),
    )
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(lockstep, "replace", replaced)
        assert made(given) == "flight"
    assert asked == [(3, engine == "mujoco")]
    # That of 0.5 s comes before the answers to the state of that time.
    assert [each.time_s for each in recorded] == [0.5, None, 0.5, 0.5, 0.75, 1.0, 2.0]
    assert [each.kind for each in recorded][2:5] == [contact, EventKind.LATCHED, contact]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, ""),
        ({"lockstep": False}, "plant.time_mode is realtime"),
        ({"kills": (1,)}, "it kills nodes on the way"),
        ({"resume_bag": "a.mcap"}, "plant.resume_bag is set"),
        ({"output": "trajectory"}, "planner.output is trajectory"),
        ({"resume_file": "a"}, "a resume_file is set"),
        ({"output": "commands"}, "planner and controller both command the joints"),
        ({"output": "commands", "commanders": ("planner",)}, ""),
    ],
)
def test_flights_that_need_nodes_say_why(changes: dict[str, Any], why: str) -> None:
    given = {
        **{"lockstep": True, "kills": (), "resume_bag": ""},
        **{
            "resume_file": "",
            "output": "reference",
            "commanders": ("planner", "coordinated_control"),
        },
        **changes,
    }
    scenario: Any = SimpleNamespace(
        name="made",
        lockstep=given["lockstep"],
        kills=given["kills"],
        commanders=given["commanders"],
        plant=SimpleNamespace(resume_bag=given["resume_bag"]),
        planner=SimpleNamespace(output=given["output"]),
        config=lambda name: SimpleNamespace(
            resume_file=given["resume_file"] if name == given["commanders"][-1] else ""
        ),
    )
    if not why:
        lockstep.require_flyable(scenario)
        return
    with pytest.raises(ParameterError) as refusal:
        lockstep.require_flyable(scenario)
    assert str(refusal.value) == (
        f"The scenario 'made' cannot be flown without ROS, because {why}; "
        "`spacerobot run` flies it."
    )


# -- what is saved -------------------------------------------------------------------------------


def test_states_are_saved_at_the_ticks_at_which_they_are_published() -> None:
    robot = load_robot(robot_file("sliding_masses"))
    rng, count, n = np.random.default_rng(3), 7, 3
    pose = np.hstack([rng.normal(size=(count, 3)), np.tile([0.0, 0.0, 0.0, 1.0], (count, 1))])
    lost = np.array([0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0])[:, None]
    flight: Any = SimpleNamespace(
        control_period=0.25,
        time=0.25 * np.arange(count),
        scenario=SimpleNamespace(
            plant=PlantConfig(robot="sliding_masses", tick_rate=4.0, base_pose_period=0.75)
        ),
        required_robot=lambda: robot,
        joint_names=tuple(robot.joint_names),
        target=None,
        quantities={"pose_lost": lost},
        **{"pose": pose, "twist": rng.normal(size=(count, 6)), "q": rng.normal(size=(count, n))},
        **{"qdot": rng.normal(size=(count, n)), "effort": rng.normal(size=(count, n))},
        momentum=rng.normal(size=(count, 7)),
    )
    streams = {each.topic.name: each for each in saved._state_streams(flight)}
    stamps = [250_000_000 * k for k in range(count)]
    assert streams["/clock"].time_ns.tolist() == stamps
    assert streams["odom"].time_ns.tolist() == [stamps[k] for k in (0, 1, 3, 5, 6)]
    for topic in state_topics(()):
        if topic.name in streams and topic.name != "odom":
            wanted = stamps if topic.every_tick else stamps[::3]
            assert streams[topic.name].time_ns.tolist() == wanted, topic.name
    assert all(len(each.time_ns) == len(each.messages) for each in streams.values())
    assert "odom_true" not in streams
    assert any(len(each.messages) == 3 for each in streams.values())


@pytest.mark.parametrize("joints", [0, 2])
def test_commands_of_joints_are_saved_where_there_are_joints(joints: int) -> None:
    command = SimpleNamespace(tick=np.arange(3), values=np.ones((3, joints)))
    flight: Any = SimpleNamespace(
        control_period=0.25,
        scenario=SimpleNamespace(plant=PlantConfig(actuation="effort")),
        commands={"joint_commands": command},
        joint_names=("hip", "knee")[:joints],
    )
    streams = list(saved._command_streams(flight))
    assert [each.time_ns.tolist() for each in streams] == [[0, 250_000_000, 500_000_000]][:joints]


def test_measured_quantities_are_the_true_ones_where_no_sensor_errs() -> None:
    true = {name: object() for name in ("pose", "twist", "q", "qdot")}
    rest = {"effort": object(), "momentum": object()}
    plain: Any = SimpleNamespace(**true, **rest, quantities={})
    found: dict[str, Any] = dict(saved.topic_quantities(plain))
    assert {name: found[f"measured_{name}"] for name in true} == true
    assert found["pose"] is true["pose"]
    assert not any(name.startswith("true_") for name in found)
    erring: Any = SimpleNamespace(**true, **rest, quantities={"measured_pose": 1, "measured_q": 2})
    found = dict(saved.topic_quantities(erring))
    assert (found["measured_pose"], found["measured_q"]) == (1, 2)
    assert found["measured_twist"] is true["twist"]
    assert {name: found[f"true_{name}"] for name in true} == true


# -- what a bag holds ----------------------------------------------------------------------------


def bag_of(metadata: dict[str, Any], target: str = "", urdf: bytes | None = b"<robot/>") -> Any:
    def get(name: str) -> Any:
        assert name in ("target/robot_description", "plant/status", "base_wrench")
        if name != "target/robot_description" or not target:
            return None
        said = SimpleNamespace(data=target)
        return SimpleNamespace(messages=lambda: iter([(0, said), (1, SimpleNamespace(data="x"))]))

    part = SimpleNamespace(get=get, urdf=urdf)
    return SimpleNamespace(
        metadata=metadata, parts=[part], path=Path("dir/flown.mcap"), messages=lambda _: iter(())
    )


def test_a_scenario_is_what_its_bag_holds_of_it() -> None:
    plant = {"robot": '"a.urdf"', "tick_rate": "20.0", "clearance_period": "0.5", "faults": "{"}
    plant["of_a_newer_version"] = "1"
    own = {"robot": '"other.urdf"'}
    about = {
        "name": "named",
        "description": "about it",
        "goal_position": "1 2.5 -3",
        "goal_orientation": "0 0 0 1",
        "published": '[{"quantity": "time", "printed": [1, "2.5"], "note": "a"}]',
    }
    found = reading._scenario_in_bag(
        bag_of(
            {
                "scenario": about,
                "parameters/plant": plant,
                "parameters/planner": {"robot": '""'},
                "parameters/coordinated_control": own,
            },
            target="<target/>",
        )
    )
    assert (found.name, found.description, found.has_goal) == ("named", "about it", True)
    assert found.goal.position.tolist() == [1.0, 2.5, -3.0]
    assert found.end_effector_goal is None
    ((quantity, printed, note),) = [(p.quantity, p.printed, p.note) for p in found.published]
    assert (quantity, list(printed), note) == ("time", [1.0, 2.5], "a")
    nodes = {name: dict(values) for name, values in found.in_file.items()}
    assert nodes["plant"]["target.robot_description"] == "<target/>"
    assert (nodes["plant"]["clearance_period"], nodes["planner"]["clearance"]) == (0.5, 0.0)
    assert (nodes["plant"]["tick_rate"], nodes["plant"]["faults"]) == (20.0, None)
    assert "of_a_newer_version" not in nodes["plant"]
    assert nodes["plant"]["robot_description"] == nodes["planner"]["robot_description"]
    assert nodes["plant"]["robot_description"] == "<robot/>"
    assert "robot_description" not in nodes["coordinated_control"]
    assert set(found.commanders) == {"planner", "coordinated_control"}
    # Of a bag without parameters there is next to nothing, nor does its target matter.
    bare = reading._scenario_in_bag(bag_of({}, target="<target/>"))
    assert (bare.name, bare.has_goal, dict(bare.in_file)) == ("flown", False, {})
    assert len(bare.commanders) == 1
    without = reading._scenario_in_bag(bag_of({"parameters/plant": {}}))
    assert dict(without.in_file["plant"]).get("clearance_period") == 0.0
    assert "target.robot_description" not in without.in_file["plant"]


def test_topics_of_poses_are_found_once() -> None:
    parts = [
        SimpleNamespace(topic_names=lambda: ["a/pose", "odom", "empty/pose"]),
        SimpleNamespace(topic_names=lambda: ["b/pose", "a/pose", "pose", "a/posed"]),
    ]
    bag: Any = object.__new__(reading.FlightBag)
    bag.parts, bag.series_of = parts, lambda name: [] if name == "empty/pose" else [name]
    assert [topic.name for topic in bag._poses_of_end_effectors()] == ["a/pose", "b/pose"]


def test_a_lazy_mapping_makes_each_value_once() -> None:
    made: list[str] = []

    def make(name: str) -> str:
        made.append(name)
        return name

    mapping = reading._LazyMapping({name: partial(make, name) for name in ("a", "b")})
    assert (len(mapping), list(mapping), made) == (2, ["a", "b"], [])
    assert mapping["b"] == mapping["b"] == "b"
    assert made == ["b"]


def test_joints_are_sorted_by_the_names_of_each_message() -> None:
    values = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    series: Any = SimpleNamespace(
        has_constant_texts=lambda _: False,
        field=lambda _: [["a", "b", "c"], ["c", "a", "b"], ["a", "b", "d"]],
    )
    found = reading._sort_by_name(values, series, ["b", "c", "a"])
    assert found[:2].tolist() == [[2.0, 3.0, 1.0], [6.0, 4.0, 5.0]]
    assert np.isnan(found[2]).all()
    series.has_constant_texts = lambda _: True
    assert reading._sort_by_name(values, series, ["b", "c", "a"]) is values


def test_an_impulse_is_the_sum_of_thrusts_times_the_ticks_before_them() -> None:
    thrust = Signal(np.array([0.5, 1.0, 3.0]), np.array([[9.0, 9.0], [1.0, 2.0], [3.0, 0.0]]))
    found = reading.impulse(thrust, np.array([2.0, 10.0]))
    assert found.time.tolist() == [0.5, 1.0, 3.0]
    # 0, then half a second of 22, then two seconds of 6.
    assert found.values.tolist() == [[0.0], [11.0], [23.0]]


def test_files_of_a_bag_and_its_robots_are_found_by_name(tmp_path: Path) -> None:
    for name in ("b_0.mcap", "b_1.mcap", "b_3.mcap", "c_1.mcap"):
        (tmp_path / name).touch()
    for name, found in (
        ("b.mcap", ["b_0.mcap", "b_1.mcap"]),
        ("c.mcap", ["c.mcap"]),
        ("b_3.mcap", ["b_3.mcap"]),
    ):
        assert [path.name for path in reading._bag_files(tmp_path / name)] == found
    kind = "nav_msgs/msg/Odometry"
    topics = {f"/{name}odom": kind for name in ("", "z/", "a/", "a/target/", "deep/b/")}
    bag: Any = SimpleNamespace(topics={**topics, "/text/odom": "std_msgs/msg/String"})
    assert reading.namespaces(bag) == ["", "/a", "/deep/b", "/z"]


def test_unreadable_values_and_goals_that_were_not_sent_are_none() -> None:
    assert [reading._parse_json(text) for text in ("1.5", "[", '{"a": 2}')] == [1.5, None, {"a": 2}]
    about = {"g_position": "1 2 3", "g_orientation": "0 0.6 0 0.8", "h_orientation": "0 0 0 1"}
    goal = reading._sent_goal(about, "g")
    assert goal is not None
    assert [*goal.position, *goal.quaternion] == [1, 2, 3, 0, 0.6, 0, 0.8]
    assert reading._sent_goal(about, "h") is None
    assert replace(goal).position.tolist() == [1, 2, 3]
