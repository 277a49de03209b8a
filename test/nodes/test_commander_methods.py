"""Methods of commander nodes and reports of the plant, with stand-ins for node and streams."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.exceptions import InvalidHandle
from std_srvs.srv import Trigger
from support.ros_harness import Harness

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import EventKind
from spacerobot_ros.nodes.common import commander
from spacerobot_ros.nodes.common import node as common_node
from spacerobot_ros.nodes.common.commander import CommanderNode
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.plant import publisher
from spacerobot_ros.nodes.plant.node import PlantNode
from spacerobot_ros.nodes.plant.publisher import PlantReport, timing_status

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Log:
    """Keeps lines and the periods by which they are throttled."""

    def __init__(self) -> None:
        self.lines: list[Any] = []

    def __getattr__(self, level: str) -> Callable[..., None]:
        def log(message: str, **options: float) -> None:
            self.lines.append((level, message, *options.values()))

        return log


def endpoint(name: str, namespace: str = "/") -> Any:
    return SimpleNamespace(node_name=name, node_namespace=namespace)


@pytest.mark.parametrize(
    ("statuses", "odoms", "foreign"),
    [
        (["plant"], ["plant"], []),
        (["plant", "tool", "a"], ["plant", "camera"], ["/a", "/tool"]),
        (["tool"], [], []),
        (["_NODE_NAME_UNKNOWN_", "plant"], ["plant"], []),
        (["tool"], ["_NODE_NAME_UNKNOWN_"], []),
    ],
)
def test_foreign_plants_publish_a_status_and_no_pose(
    statuses: list[str], odoms: list[str], foreign: list[str]
) -> None:
    known = {"/plant/status": statuses, "/odom": odoms}
    node: Any = SimpleNamespace(
        resolve_topic_name=lambda topic: f"/{topic}",
        get_publishers_info_by_topic=lambda topic: [endpoint(name) for name in known[topic]],
    )
    assert CommanderNode._other_status_publishers(node) == foreign


class Plant:
    """A commander's node that hears statuses of the plant, and keeps those that count."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.foreign, self.said = 100.0, [], []  # type: ignore[var-annotated]
        self.taken: list[Any] = []
        self.node: Any = SimpleNamespace(
            _status_number=None, _doubted=False, _last_complaint=-1e9,
            _other_status_publishers=lambda: self.foreign,
            _subscribe_plant_status=lambda: self.taken.append("anew"),
            log=lambda *words: self.said.append(words),
            commander=SimpleNamespace(
                receive_plant_status=lambda status, name: self.taken.append((status, name))
            ),
        )  # fmt: skip
        monkeypatch.setattr(commander, "time", SimpleNamespace(monotonic=lambda: self.now))
        monkeypatch.setattr(
            commander, "PlantStatus", SimpleNamespace(from_values=lambda values, text: text)
        )

    def hear(self, text: str, number: int | None, name: str = "/plant") -> None:
        message = DiagnosticStatus(name=name, message=text)
        CommanderNode._on_plant_status(self.node, message, {"publication_sequence_number": number})


def test_statuses_count_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    plant = Plant(monkeypatch)
    plant.hear("first", 7)
    plant.hear("second", 8)
    plant.hear("unnumbered", None, name="")
    plant.hear("after", 1)
    assert plant.taken == [
        ("first", "/plant"), ("second", "/plant"), ("unnumbered", "plant"), ("after", "/plant"),
    ]  # fmt: skip
    plant.hear("lost", 3)
    plant.hear("again", 1)
    assert plant.taken[4:] == ["anew", "anew"]
    assert plant.node._status_number == 1


def test_no_status_counts_beside_a_foreign_one_which_is_told_every_five_seconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plant = Plant(monkeypatch)
    plant.foreign = ["/a", "/b"]
    for now in (100.0, 104.0, 105.0, 105.5, 110.5, 110.625):
        plant.now = now
        plant.hear("foreign", 1)
    assert not plant.taken
    assert plant.node._doubted
    assert len(plant.said) == 3
    level, text = plant.said[0]
    assert level == "error"
    assert text.startswith("plant/status: /a, /b publishes it beside the plant")
    assert plant.node._status_number is None


@pytest.mark.parametrize(
    ("diagnosed", "now", "due"),
    [(3_000, 3_999, False), (3_000, 4_000, True), (3_000, 2_999, True), (3_000, 3_000, False)],
)
def test_diagnostics_are_due_after_a_period_or_when_time_goes_back(
    monkeypatch: pytest.MonkeyPatch, diagnosed: int, now: int, due: bool
) -> None:
    done: list[Any] = []
    monkeypatch.setattr(commander, "first_time_ns", lambda raw: 77)
    node: Any = SimpleNamespace(
        commander=SimpleNamespace(
            stamps=SimpleNamespace(now_ns=now),
            receive_joints=lambda *given: done.append(given),
            receive_odom=lambda *given: done.append(("odom", *given)),
        ),
        _diagnosed_ns=diagnosed, _diagnostics_period_ns=1_000,
        _publish_diagnostics=lambda: done.append("diagnostics"),
    )  # fmt: skip
    CommanderNode._on_joints(node, b"raw")
    assert done == [(77, b"raw"), *(["diagnostics"] if due else [])]
    done.clear()
    CommanderNode._on_odom(node, b"odom")
    assert done == [("odom", 77, b"odom")]


@pytest.mark.parametrize("answer", [None, "", "The robot holds."])
def test_an_abort_tells_whether_there_was_a_goal(answer: str | None) -> None:
    node: Any = SimpleNamespace(commander=SimpleNamespace(abort=lambda: answer))
    response = CommanderNode._on_abort(node, Trigger.Request(), Trigger.Response())
    assert response.success is (answer is not None)
    assert response.message == (answer or "There is no goal to abort.")


@pytest.mark.parametrize(("now_ns", "seconds"), [(0, None), (1_500_000_000, 1.5)])
def test_the_time_is_known_from_the_first_state_on(now_ns: int, seconds: float | None) -> None:
    node: Any = SimpleNamespace(
        commander=SimpleNamespace(stamps=SimpleNamespace(now_ns=now_ns)),
        _inputs={"odom": SimpleNamespace(has_publisher=now_ns > 0)},
    )
    time: Any = vars(CommanderNode)["simulated_time_s"]
    assert time.fget(node) == seconds
    assert CommanderNode.has_publisher(node, "odom") is (now_ns > 0)


def test_lines_have_the_levels_that_commanders_give_them() -> None:
    log = Log()
    node: Any = SimpleNamespace(get_logger=lambda: log)
    for level in ("debug", "info", "warning", "error"):
        CommanderNode.log(node, level, f"a {level}")
    assert log.lines == [(each, f"a {each}") for each in ("debug", "info", "warning", "error")]


def test_a_description_is_used_once_and_may_be_none(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[Any] = []
    log = Log()

    def read(text: str, config: object) -> str:
        if text == "none":
            raise SpaceRobotError("It is no robot.")
        return f"robot {text}"

    monkeypatch.setattr(commander, "robot_from_text", read)
    node: Any = SimpleNamespace(
        _description="", config=None, use=done.append, long_work=nullcontext,
        commander=SimpleNamespace(
            drop_robot=lambda why: done.append(why), answer=lambda: done.append("answer")
        ),
        get_logger=lambda: log,
    )  # fmt: skip
    why = "robot_description describes another robot now."
    for text in ("a", "a", "none", "none", "a"):
        CommanderNode._on_description(node, SimpleNamespace(data=text))
    used = [why, "robot a", "answer"]
    assert done == [*used, why, *used]
    assert log.lines == [("error", "robot_description: It is no robot.")]


# -- errors of callbacks --------------------------------------------------------------------------


def test_timers_that_are_destroyed_fire_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Any] = []
    fired: list[int] = []
    done: list[str] = []

    def create(period: float, call: Callable[[], None]) -> str:
        made.append((period, call))
        return f"timer {len(made)}"

    monkeypatch.setattr(
        common_node, "super",
        lambda: SimpleNamespace(create_timer=create, destroy_timer=lambda timer: True),
        raising=False,
    )  # fmt: skip
    node: Any = SimpleNamespace(_timers_alive={}, _fail=lambda what, error: done.append(what))
    node.guarded = lambda call, what: FlightNode.guarded(node, call, what)
    first = FlightNode.create_timer(node, 0.25, lambda: fired.append(1))
    FlightNode.create_timer(node, 0.5, lambda: fired.append(1 // 0))
    for _, call in made:
        call()
    assert (fired, done) == ([1], ["a timer"])
    assert FlightNode.destroy_timer(node, first) is True
    made[0][1]()
    assert fired == [1]
    assert len(node._timers_alive) == 1
    assert [period for period, _ in made] == [0.25, 0.5]


# -- reports of the plant -------------------------------------------------------------------------


def reporting(**changes: Any) -> Any:
    """Return a stand-in for the report of a plant with two joints, of 40 kg."""
    robot = SimpleNamespace(
        joint_names=["a", "b"], lower=np.array([-1.0, -2.0]), upper=np.array([2.0, 0.5]),
        total_mass=40.0,
    )  # fmt: skip
    plant = SimpleNamespace(
        robot=robot, q=np.array([0.25, -0.25]),
        limit_counts={"rates": np.array([3, 0]), "efforts": np.array([2, 1])},
        momentum=np.zeros(7), expected_momenta=np.zeros(6),
        injected=[], active=[], disturbances=[],
    )  # fmt: skip
    log = Log()
    report: Any = SimpleNamespace(
        log=log,
        _node=SimpleNamespace(get_logger=lambda: log),
        _plant=plant,
        _commands=SimpleNamespace(fault="", counts=Counter()),
        _real_time=None, _ticks_lost=4, _command_timeouts=1, _last_refusal="", _unmet_reported=2,
        _name=lambda part: f"plant: {part}",
    )  # fmt: skip
    vars(report).update(changes)
    return report


def values(status: Any) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


@pytest.mark.parametrize(
    ("fault", "refused", "last", "level", "message"),
    [
        ("", False, "A command was refused.", OK, "commands arrive"),
        ("", True, "", WARN, "commands arrive"),
        ("", True, "A command was refused.", WARN, "A command was refused."),
        ("abort", True, "A command", ERROR, "Nothing moves until '~/rearm' is called: abort."),
        ("abort", False, "", ERROR, "Nothing moves until '~/rearm' is called: abort."),
    ],
)
def test_the_commands_of_a_plant_are_told(
    fault: str, refused: bool, last: str, level: bytes, message: str
) -> None:
    report = reporting(_last_refusal=last)
    report._commands.fault = fault
    status = PlantReport._command_status(report, refused=refused)
    assert (status.name, status.level, status.message) == ("plant: commands", level, message)
    assert values(status) == {
        "refused": "0", "latched_fault": fault, "timeouts": "1", "deadlines_missed": "4",
    }  # fmt: skip


@pytest.mark.parametrize("limited", [False, True])
def test_joints_that_are_held_back_are_counted(limited: bool) -> None:
    status = PlantReport._actuator_status(reporting(), limited=limited)
    assert status.level == (WARN if limited else OK)
    assert ("hold joints back" in status.message) is limited
    assert values(status) == {
        "rates_limited.a": "3", "rates_limited.b": "0", "efforts_limited.a": "2",
        "efforts_limited.b": "1",
    }  # fmt: skip
    report = reporting()
    PlantReport.limited(report)
    (line,) = report.log.lines
    assert line == (
        "warning", "Limits of the URDF held joints back so far: rates of a; efforts of a, b.", 5.0,
    )  # fmt: skip


def test_strokes_are_to_the_nearer_limit() -> None:
    status = PlantReport._margin_status(reporting())
    assert (status.level, values(status)) == (OK, {"a": "1.25", "b": "0.75"})


@pytest.mark.parametrize("part", range(6))
@pytest.mark.parametrize("leaks", [False, True])
def test_momentum_that_nothing_accounts_for_is_an_error(part: int, leaks: bool) -> None:
    report = reporting()
    plant = report._plant
    plant.expected_momenta[:] = [1.0, -2.0, 3.0, 0.5, 0.25, -0.125]
    plant.momentum[:6] = plant.expected_momenta
    plant.momentum[6] = 2.5
    change = 40.0 * publisher._MOMENTUM_ROUNDING * (1.01 if leaks else 0.99)
    plant.momentum[part] += change
    status = PlantReport._momentum_status(report)
    assert status.level == (ERROR if leaks else OK)
    assert ("is accounted for" in status.message) is not leaks
    shown = values(status)
    assert shown["kinetic_energy_J"] == "2.500000e+00"
    changed, still = ("linear_change", "angular_change")[:: 1 if part < 3 else -1]
    assert float(shown[changed]) == pytest.approx(change, rel=1e-3)
    assert float(shown[still]) == 0.0


def test_faults_are_told_with_their_numbers() -> None:
    report = reporting()
    status = PlantReport._fault_status(report)
    assert (status.level, status.message, values(status)) == (OK, "no fault is injected", {})
    report._plant.injected, report._plant.active = ["x", "y"], ["x"]
    report._plant.disturbances = ["y", "z"]
    status = PlantReport._fault_status(report)
    assert (status.level, status.message) == (WARN, "injected: x; y")
    assert values(status) == {"fault_1": "x", "disturbance_1": "y", "disturbance_2": "z"}


@pytest.mark.parametrize(
    ("missing", "ticks", "level", "message"),
    [
        ("", 2, OK, "the wanted wrench is given"),
        ("", 3, WARN, "the wanted wrench is beyond them"),
        ("force x", 2, WARN, "they cannot give force x"),
        ("force x", 5, WARN, "they cannot give force x; the wanted wrench is beyond them"),
    ],
)
def test_thrusters_tell_wrenches_that_they_do_not_give(
    missing: str, ticks: int, level: bytes, message: str
) -> None:
    report = reporting()
    thrusters: Any = SimpleNamespace(
        unmet_ticks=ticks, missing=missing, unmet=np.array([3.0, 0.0, 4.0, 0.0, 5.0, 12.0]),
        propellant=0.125, pulses=np.array([7, 4]), table=SimpleNamespace(names=["u", "v"]),
    )  # fmt: skip
    status = PlantReport._thruster_status(report, thrusters)
    assert (status.level, status.message) == (level, message)
    shown = values(status)
    assert (shown["unmet_force_N"], shown["unmet_torque_Nm"]) == ("5", "13")
    assert (shown["pulses"], shown["pulses.u"], shown["pulses.v"]) == ("11", "7", "4")
    assert shown["unmet_ticks"] == str(ticks)
    assert report._unmet_reported == ticks
    assert "0.125" in shown.values()


@pytest.mark.parametrize("worse", [False, True])
def test_delays_are_in_milliseconds(worse: bool) -> None:
    timing = SimpleNamespace(
        worse=worse, tick_rate=19.5, ticks=100, ticks_late=3, worst_tick=0.0125, commands=90,
        commands_late=2, worst_command=0.25, command_age=1.5,
    )  # fmt: skip
    clock: Any = SimpleNamespace(report=lambda: timing)
    status = timing_status("plant: timing", clock)
    assert status.level == (WARN if worse else OK)
    assert status.message == ("deadlines were missed" if worse else "in time")
    assert {key: json.loads(value) for key, value in values(status).items()} == {
        "tick_rate_Hz": 19.5, "ticks": 100, "ticks_late": 3, "worst_tick_ms": 12.5, "commands": 90,
        "commands_late": 2, "worst_command_ms": 250.0, "command_age_s": 1.5,
    }  # fmt: skip


@pytest.mark.parametrize("latches", [False, True])
def test_refusals_are_logged_and_kept(latches: bool) -> None:
    report: Any = reporting(latched=lambda: report.log.lines.append("latched"))
    source: Any = SimpleNamespace(topic="joint_command")
    refusal: Any = SimpleNamespace(clause="it is late", latches=latches)
    PlantReport.refused(report, source, refusal)
    text = "A command on 'joint_command' was refused: it is late."
    assert report.log.lines == [("warning", text, 5.0), *(["latched"] if latches else [])]
    assert report._last_refusal == text
    report.log.lines.clear()
    PlantReport.timed_out(report, source, 0.5)
    (line,) = report.log.lines
    assert line[1].startswith("No command on 'joint_command' for 0.5 s: its actuators")
    assert (line[0], line[2], report._command_timeouts) == ("warning", 5.0, 2)


@pytest.mark.parametrize("thrusters", [False, True])
@pytest.mark.parametrize("real_time", [False, True])
def test_levels_are_of_what_has_happened_since_the_last_report(
    monkeypatch: pytest.MonkeyPatch, thrusters: bool, real_time: bool
) -> None:
    told: list[Any] = []
    published: list[Any] = []
    report = reporting(_reported=((1, 2, 3), (4, 5)), _real_time=real_time or None)
    report._plant.robot.description = SimpleNamespace(name="mine")
    counters = iter([((1, 2, 4), (4, 5)), ((1, 2, 4), (4, 6)), ((1, 2, 4), (4, 6))])
    report._counters = lambda: next(counters)

    def made(name: str) -> Any:
        return DiagnosticStatus(name=name)

    for part in ("command", "actuator", "margin", "momentum", "fault", "thruster"):

        def status(*_: Any, part: str = part, **about: bool) -> Any:
            if about:
                told.append(about)
            return made(part)

        setattr(report, f"_{part}_status", status)
    monkeypatch.setattr(publisher, "timing_status", lambda name, real_time: made(name))
    report._thrusters = object() if thrusters else None
    report._publisher = SimpleNamespace(publish=published.append)
    for time_ns in (3, 1_500_000_000, 5):
        PlantReport.publish(report, time_ns)
    yes, no = {"refused": True}, {"refused": False}
    assert told == [yes, {"limited": False}, no, {"limited": True}, no, {"limited": False}]
    names = ["command", "actuator", "margin", "momentum", "fault"]
    names += ["thruster"] * thrusters + ["plant: timing"] * real_time
    for array in published:
        assert [each.name for each in array.status] == names
        assert {each.hardware_id for each in array.status} == {"mine"}
    assert (published[1].header.stamp.sec, published[1].header.stamp.nanosec) == (1, 500_000_000)


# -- failures -------------------------------------------------------------------------------------


def failing(**changes: Any) -> Any:
    """Return a stand-in for an active node, which keeps its lines, events and calls."""
    log = Log()
    node: Any = SimpleNamespace(
        log=log, done=[], _destroyed=False, _has_entities=True, _failure="", fault=None,
        is_active=True, get_name=lambda: "plant", get_logger=lambda: log,
    )  # fmt: skip
    node.on_failure = lambda message, error: node.done.append(message)
    node.report_event = lambda event: node.done.append((event.kind, event.level, event.message))
    node.trigger_deactivate = lambda: node.done.append("deactivate")
    node._report_failure = lambda *given: FlightNode._report_failure(node, *given)
    vars(node).update(changes)
    return node


def error_lines(node: Any) -> list[str]:
    return [line[1] for line in node.log.lines if line[0] == "error"]


@pytest.mark.parametrize("active", [False, True])
def test_an_error_is_reported_once_and_stops_its_node(active: bool) -> None:
    node = failing(is_active=active)
    for _ in range(2):
        FlightNode._fail(node, "a timer", SpaceRobotError("It has failed."))
    event = (EventKind.FAILED, 2, "It has failed.")
    assert node.done == ["It has failed.", event, *(["deactivate"] if active else [])]
    assert error_lines(node) == ["It has failed."]
    assert str(node.fault) == "It has failed."


def test_an_unexpected_error_is_told_with_its_line() -> None:
    node = failing()

    def inner() -> None:
        raise ValueError(" it is\n odd. ")

    try:
        inner()
    except ValueError as error:
        line = error.__traceback__.tb_next.tb_lineno  # type: ignore[union-attr]
        FlightNode._fail(node, "a timer", error)
    place = f"(test_commander_methods.py, line {line})"
    said = f"Node 'plant' has failed at a timer: ValueError: it is odd {place}."
    assert error_lines(node) == [said]
    node = failing()
    FlightNode._fail(node, "a timer", KeyError())
    assert error_lines(node) == ["Node 'plant' has failed at a timer: KeyError."]


def test_a_second_failure_causes_no_third_one() -> None:
    def fail(*_: Any) -> None:
        raise ValueError("again")

    node = failing(trigger_deactivate=fail, on_failure=fail)
    FlightNode._fail(node, "a timer", SpaceRobotError("It has failed."))
    first, second, third = error_lines(node)
    assert first == "It has failed."
    assert second.startswith("Node 'plant': ValueError: again (")
    assert third.startswith("Node 'plant' cannot stop: ValueError: again (")
    assert node.done == [(EventKind.FAILED, 2, "It has failed.")]
    assert str(node.fault) == "It has failed."


@pytest.mark.parametrize(
    ("error", "entities", "destroyed", "told"),
    [
        (InvalidHandle("gone"), False, False, False), (InvalidHandle("gone"), True, False, True),
        (ValueError("odd"), False, False, True), (ValueError("odd"), True, True, False),
    ],
)  # fmt: skip
def test_callbacks_of_what_is_destroyed_are_no_failure(
    error: Exception, entities: bool, destroyed: bool, told: bool
) -> None:
    node = failing(_has_entities=entities, _destroyed=destroyed)
    FlightNode._fail(node, "a timer", error)
    assert (node.fault is not None) is told


# -- periods of a plant ---------------------------------------------------------------------------


PERIODS = ("base_pose_period", "marker_period", "clearance_period", "tf_period")


@pytest.mark.parametrize(
    ("given", "real_time", "ticks"),
    [
        (0.0, True, [1, 0, 0, 0]),
        (0.3, True, [3, 3, 3, 2]),
        (9.0, True, [10, 10, 10, 2]),
        (9.0, False, [90, 90, 90, 90]),
    ],
)
def test_viewers_of_a_plant_in_real_time_wait_for_half_a_second_at_most(
    harness: Harness, given: float, real_time: bool, ticks: list[int]
) -> None:
    settings: dict[str, Any] = {"robot": "planar_manipulator", "tick_rate": 10.0}
    settings |= dict.fromkeys(PERIODS, given) | {"time_mode": "lockstep"}
    if real_time:
        settings |= {"time_mode": "realtime", "real_time_factor": 2.0, "command_timeout": 5.0}
    plant = harness.make(PlantNode, settings, autostart=False)
    assert (plant.tick, plant.time_ns) == (0, 0)
    plant.trigger_configure()
    found = [plant._pose_ticks, plant._marker_ticks, plant._clearance_ticks, plant._tf_ticks]
    if not plant._transforms.publishes:
        ticks = [*ticks[:3], 0]
    assert found == ticks
    assert (plant._clearance is None) is (given == 0.0)
    assert (plant.tick, plant.simulated_time_s) == (0, 0.0)
