"""Methods of the plant's node and its publishers, with stand-ins for plant, clock and streams."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import CommandError, ParameterError, SpaceRobotError
from spacerobot_ros.nodes.common.node import STREAM
from spacerobot_ros.nodes.plant import node as plant_node
from spacerobot_ros.nodes.plant import publisher
from spacerobot_ros.nodes.plant.node import PlantNode
from spacerobot_ros.nodes.plant.publisher import ClearancePublisher, StatePublisher
from spacerobot_ros.simulation.status import PlantState
from spacerobot_ros.times import stamp_bytes

S = 10**9
PERIOD = 50_000_000
RUNNING, PAUSED, INACTIVE = PlantState.RUNNING, PlantState.PAUSED, PlantState.INACTIVE


class Kept:
    """Keeps every call of its methods, by their names, in ``done``; ``answers`` are returned."""

    def __init__(self, done: list[Any], name: str, **answers: Any) -> None:
        self._done, self._name, self._answers = done, name, answers
        for key, value in answers.items():
            if not callable(value):
                setattr(self, key, value)

    def __getattr__(self, action: str) -> Callable[..., Any]:
        if action.startswith("__"):
            raise AttributeError(action)

        def call(*given: Any, **named: Any) -> Any:
            self._done.append((f"{self._name}.{action}", *given, *named.values()))
            answer = self._answers.get(action)
            return answer(*given) if callable(answer) else None

        return call


def plant(own: str, **changes: Any) -> Any:
    """Return a stand-in for a plant's node in lockstep at tick 40, for its method ``own``."""
    done: list[Any] = []
    node: Any = SimpleNamespace(
        done=done,
        config=SimpleNamespace(
            real_time_factor=2.0, command_timeout=0.5, watchdog_action="latch", actuation="effort"
        ),
        plant=Kept(done, "plant", step=lambda *_: False, injected="none"),
        status=SimpleNamespace(state=RUNNING),
        time_ns=40 * PERIOD,
        _tick=40,
        _period_ns=PERIOD,
        _active=RUNNING,
        _when_active=RUNNING,
        _injected_seen="none",
        _commands=Kept(done, "commands", begin_step=lambda: ("tau",), fault=""),
        _lockstep=Kept(done, "lockstep"),
        _real_time=None,
        _capturing=None,
        _monitor=SimpleNamespace(rearms=2, resets=5, failure=None),
        _report=Kept(done, "report"),
        _publisher=Kept(done, "publisher"),
        _reported=Kept(done, "reported", update=lambda: False),
        _markers=Kept(done, "markers"),
        _clearance=Kept(done, "clearance"),
        _transforms=Kept(done, "transforms"),
        _pose_ticks=4, _marker_ticks=5, _clearance_ticks=8, _tf_ticks=10, _report_ticks=20,
        _steady=SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=7 * S)),
        _reported_ns=0,
    )  # fmt: skip
    vars(node).update(changes)
    node._is_running_or_paused = node._active in (RUNNING, PAUSED)
    names = [
        "_publish_changed_status", "_step", "_publish", "_publish_report", "_report_on_wall_clock",
        "_check_for_commanders", "_step_if_complete", "_count_commanders", "get_logger",
    ]  # fmt: skip
    log = Kept(done, "log")
    for name in names:
        if name != own and name not in changes:
            setattr(node, name, lambda name=name: done.append(name))
    node.get_logger = lambda: log
    return node


def ticks(node: Any, seconds: float) -> int:
    return PlantNode._ticks(node, seconds)


@pytest.mark.parametrize(
    ("seconds", "count"), [(0.0, 0), (1e-6, 1), (0.07, 1), (0.08, 2), (0.5, 10), (3.0, 60)]
)
def test_periods_are_whole_ticks_and_one_at_least(seconds: float, count: int) -> None:
    assert ticks(plant(""), seconds) == count


@pytest.mark.parametrize(
    ("seconds", "real_time", "count"),
    [(3.0, None, 60), (3.0, object(), 24), (0.8, object(), 16), (0.0, object(), 0)],
)
def test_real_time_shortens_the_periods_of_viewers(
    seconds: float, real_time: object, count: int
) -> None:
    node = plant("", _real_time=real_time)
    node._ticks = lambda seconds: ticks(node, seconds)
    assert PlantNode._ticks_for_viewers(node, seconds, 0.6) == count, "0.6 wall s are 1.2 s here"


ALL = ("clearance", "transforms", "markers")


@pytest.mark.parametrize(
    ("tick", "whole", "published"),
    [
        (40, True, [*ALL, "report"]),
        (20, True, ["transforms", "markers", "report"]),
        (41, False, []), (39, False, []),
        (4, True, []), (5, False, ["markers"]), (8, True, ["clearance"]),
        (30, False, ["transforms", "markers"]),
    ],
)  # fmt: skip
def test_every_topic_has_its_own_period(tick: int, whole: bool, published: list[str]) -> None:
    node = plant("_publish", _tick=tick)
    PlantNode._publish(node)
    now = tick * PERIOD
    rest = ["_publish_report" if each == "report" else (f"{each}.publish", now)
            for each in published]  # fmt: skip
    assert node.done == [("reported.update",), ("publisher.publish", now, whole), *rest]


def test_what_has_no_period_is_not_published_and_new_quantities_get_messages() -> None:
    node = plant(
        "_publish", _marker_ticks=0, _clearance=None, _tf_ticks=0, _report_ticks=0,
        _reported=SimpleNamespace(update=lambda: True),
    )  # fmt: skip
    PlantNode._publish(node)
    assert node.done == [("publisher.rebuild",), ("publisher.publish", 40 * PERIOD, True)]


@pytest.mark.parametrize(
    ("tick", "changes", "after"),
    [
        (40, {}, ["_publish"]),
        (40, {"_injected_seen": "a fault"}, ["_publish", "_publish_changed_status"]),
        (40, {"_capturing": SimpleNamespace(reports=[1])}, ["_publish_changed_status", "_publish"]),
        (40, {"_capturing": SimpleNamespace(reports=[])}, ["_publish"]),
        (plant_node._MAX_UNCONFIRMED_TICKS - 1, {}, ["_publish", ("publisher.await_readers",)]),
        (plant_node._MAX_UNCONFIRMED_TICKS, {}, ["_publish"]),
        (plant_node._MAX_UNCONFIRMED_TICKS - 1, {"_lockstep": None}, ["_publish"]),
    ],
)
def test_a_step_is_one_tick(tick: int, changes: dict[str, Any], after: list[Any]) -> None:
    node = plant("_step", _tick=tick, **changes)
    PlantNode._step(node)
    assert node.done == [("commands.begin_step",), ("plant.step", "tau"), *after]
    assert node._tick == tick + 1


def test_limited_commands_are_counted_and_a_model_that_fails_names_its_time() -> None:
    node = plant("_step")
    node.plant = SimpleNamespace(step=lambda tau: True, injected="none")
    PlantNode._step(node)
    assert node.done == [("commands.begin_step",), ("report.limited",), "_publish"]

    def fail(tau: str) -> None:
        raise SpaceRobotError("it is not finite.")

    node.plant.step = fail
    with pytest.raises(SpaceRobotError, match=r"^The plant stops at 2 s: it is not finite.$"):
        PlantNode._step(node)
    assert node._tick == 41


def test_a_publisher_keeps_half_of_its_states_for_slow_readers() -> None:
    assert 2 * plant_node._MAX_UNCONFIRMED_TICKS == STREAM.depth


@pytest.mark.parametrize(("since", "due"), [(949_999_999, False), (950_000_000, True)])
def test_diagnostics_come_every_second_of_wall_time(since: int, due: bool) -> None:
    node = plant("_report_on_wall_clock", _reported_ns=7 * S - since)
    PlantNode._report_on_wall_clock(node)
    assert node.done == ["_publish_report"] * due
    PlantNode._publish_report(node)
    assert node._reported_ns == 7 * S
    assert node.done[-1] == ("report.publish", 40 * PERIOD)


@pytest.mark.parametrize(
    ("active", "due", "silent", "done"),
    [
        (PAUSED, 3, [], []),
        (RUNNING, 0, [], []),
        (RUNNING, 2, [], ["_step"] * 2),
        (RUNNING, 1, ["a", "b"], [("report.timed_out", "a", 0.5), ("report.timed_out", "b", 0.5),
                                  "_publish_changed_status", "_step"]),
    ],
)  # fmt: skip
def test_wall_time_steps_as_often_as_is_due(
    active: PlantState, due: int, silent: list[str], done: list[Any]
) -> None:
    asked: list[Any] = []
    real_time = Kept(asked, "time", due_ticks=lambda *_: due)
    commands = SimpleNamespace(drop_old=lambda time_ns: silent if time_ns == 2 * S else None)
    node = plant("_on_wall_tick", _active=active, _real_time=real_time, _commands=commands)
    PlantNode._on_wall_tick(node)
    assert node.done == done
    if active is RUNNING:
        assert asked == [("time.due_ticks", 7 * S, 40), *[("time.count_tick", 7 * S, 40)] * due]


@pytest.mark.parametrize(
    ("changes", "must", "waits", "new", "done"),
    [
        ({"_active": PAUSED}, True, True, True, ["_report_on_wall_clock"]),
        ({"_active": PAUSED, "_report_ticks": 0}, True, True, True, []),
        ({}, True, True, True, ["_check_for_commanders", "_step"]),
        ({}, False, True, True, ["_check_for_commanders", ("publisher.publish", 2 * S, True)]),
        ({}, False, True, False, ["_check_for_commanders"]),
        ({}, False, False, True, ["_check_for_commanders"]),
    ],
)
def test_new_readers_get_the_state_that_the_plant_waits_with(
    changes: dict[str, Any], must: bool, waits: bool, new: bool, done: list[Any]
) -> None:
    node = plant("_on_subscriber_check", **changes)
    node._reported = SimpleNamespace(sensors=SimpleNamespace(dropout="lost"))
    asked: list[Any] = []

    def must_step(tick: int, *, pose_lost: str) -> bool:
        asked.append((tick, pose_lost))
        return must

    node._lockstep = SimpleNamespace(must_step_at_check=must_step, waits=waits)
    node._publisher.has_new_readers = lambda: new
    PlantNode._on_subscriber_check(node)
    assert node.done == done
    assert asked == [(40, "lost")] * (node._active is RUNNING)


@pytest.mark.parametrize(
    ("active", "refusal", "state", "done"),
    [
        (INACTIVE, None, RUNNING, []),
        (PlantState.FAILED, None, RUNNING, []),
        (RUNNING, None, RUNNING, ["_step_if_complete"]),
        (PAUSED, None, RUNNING, ["_step_if_complete"]),
        (RUNNING, None, PlantState.RESTING, ["_publish_changed_status", "_step_if_complete"]),
        (RUNNING, False, PlantState.RESTING, ["refused", "_step_if_complete"]),
        (RUNNING, True, RUNNING, ["refused", "_publish_changed_status", "_step_if_complete"]),
    ],
)
def test_commands_are_offered_reported_and_completed(
    active: PlantState, refusal: bool | None, state: PlantState, done: list[Any]
) -> None:
    found = None if refusal is None else SimpleNamespace(latches=refusal)
    node = plant("_on_command", _active=active, status=SimpleNamespace(state=state))
    offered: list[Any] = []

    def offer(*given: Any) -> Any:
        offered.append(given)
        return found

    reader: Any = SimpleNamespace(source="source", offer=offer)
    PlantNode._on_command(node, reader, b"raw")
    said = ("report.refused", "source", found)
    assert node.done == [said if each == "refused" else each for each in done]
    assert offered == [(node._commands, b"raw", 2 * S)] * (active in (RUNNING, PAUSED))


def test_in_real_time_the_delay_of_the_first_source_is_measured() -> None:
    first, second = SimpleNamespace(stamp_ns=11), SimpleNamespace(stamp_ns=12)
    done: list[Any] = []
    commands = SimpleNamespace(sources=[first, second])
    node = plant("_on_command", _real_time=Kept(done, "time"), _commands=commands)
    for source in (second, first):
        reader: Any = SimpleNamespace(source=source, offer=lambda *_: None)
        PlantNode._on_command(node, reader, b"raw")
    assert done == [("time.count_command", 7 * S, 11)]
    assert not node.done


@pytest.mark.parametrize("active", [RUNNING, PAUSED])
@pytest.mark.parametrize("complete", [False, True])
def test_only_a_running_plant_with_all_commands_steps(active: PlantState, complete: bool) -> None:
    commands = SimpleNamespace(complete=complete)
    node = plant("_step_if_complete", _active=active, _commands=commands)
    PlantNode._step_if_complete(node)
    assert node.done == ["_step"] * (complete and active is RUNNING)


def test_injections_that_are_refused_change_nothing() -> None:
    node = plant("_on_injection")
    PlantNode._on_injection(node, node.done.append, String(data="clear"))
    assert node.done == ["clear", "_publish_changed_status"]

    def refuse(text: str) -> None:
        raise ParameterError(f"There is no fault '{text}'.")

    node.done.clear()
    PlantNode._on_injection(node, refuse, String(data="x"))
    assert node.done == [("log.warning", "There is no fault 'x'.")]


def answer(method: Any, node: Any, request: Any = None) -> tuple[bool, str]:
    if isinstance(request, SetBool.Request):
        response = method(node, request, SetBool.Response())
    else:
        response = method(node, Trigger.Request(), Trigger.Response())
    return response.success, response.message


@pytest.mark.parametrize("active", [RUNNING, PAUSED, INACTIVE])
def test_a_reset_is_known_before_the_next_state(active: PlantState) -> None:
    node = plant("_on_reset", _active=active)
    said = (True, "The robot is back in its initial state; time goes on.")
    assert answer(PlantNode._on_reset, node) == said
    first = [("plant.reset",), ("commands.reset", 2 * S), "_publish_changed_status"]
    assert node.done == first + ["_publish"] * (active is not INACTIVE)
    assert (node._monitor.resets, node._monitor.rearms) == (6, 2)


@pytest.mark.parametrize(
    ("fault", "message", "rearms"),
    [("aborted", "Commands pass again after: aborted.", 3), ("", "No fault was latched.", 2)],
)
def test_a_plant_is_stopped_and_armed_again(fault: str, message: str, rearms: int) -> None:
    node = plant("_on_abort")
    stopped = (True, "The joints come to rest; nothing moves until '~/rearm' is called.")
    assert answer(PlantNode._on_abort, node) == stopped
    latched = ("commands.latch", "abort", "stopped on request", 2 * S)
    assert node.done == [latched, ("report.latched",), "_publish_changed_status"]
    node.done.clear()
    node._commands = SimpleNamespace(rearm=lambda: fault)
    assert answer(PlantNode._on_rearm, node) == (True, message)
    assert node.done == ["_publish_changed_status"] * bool(fault)
    assert (node._monitor.resets, node._monitor.rearms) == (5, rearms)


@pytest.mark.parametrize(
    ("changes", "fault", "words"),
    [
        ({"_capturing": None}, "", ("There is no target", "target.robot")),
        ({"_active": INACTIVE}, "", ("The plant is inactive", "nothing moves")),
        ({}, "aborted", ("A fault is latched: aborted", "~/rearm")),
        ({}, "", ("It is too far.",)),
    ],
)
def test_a_capture_that_cannot_be_is_refused(
    changes: dict[str, Any], fault: str, words: tuple[str, ...]
) -> None:
    def refuse() -> None:
        raise CommandError("It is too far.")

    capturing = SimpleNamespace(capture=refuse, release=refuse)
    node = plant("", **{"_capturing": capturing, **changes})
    node._commands = SimpleNamespace(fault=fault)
    node._grasp = lambda response, act: PlantNode._grasp(node, response, act)
    for method in (PlantNode._on_capture, PlantNode._on_release):
        success, message = answer(method, node)
        assert not success
        assert_one_sentence(message, *words)
    assert not node.done


@pytest.mark.parametrize("active", [RUNNING, PAUSED])
def test_a_capture_is_told_with_its_time(active: PlantState) -> None:
    def report(name: str) -> Any:
        return SimpleNamespace(event=lambda time: SimpleNamespace(message=f"{name} at {time:g} s"))

    capturing = SimpleNamespace(capture=lambda: report("caught"), release=lambda: report("freed"))
    node = plant("", _capturing=capturing, _active=active)
    node._grasp = lambda response, act: PlantNode._grasp(node, response, act)
    assert answer(PlantNode._on_capture, node) == (True, "caught at 2 s")
    assert answer(PlantNode._on_release, node) == (True, "freed at 2 s")
    assert node.done == ["_publish_changed_status"] * 2


@pytest.mark.parametrize("real", [False, True])
@pytest.mark.parametrize(
    ("before", "pause", "after", "goes_on"),
    [
        (RUNNING, True, PAUSED, False), (PAUSED, False, RUNNING, True),
        (RUNNING, False, RUNNING, False), (PAUSED, True, PAUSED, False),
        (INACTIVE, True, INACTIVE, False), (INACTIVE, False, INACTIVE, False),
    ],
)  # fmt: skip
def test_a_pause_ends_as_it_began(
    real: bool, before: PlantState, pause: bool, after: PlantState, goes_on: bool
) -> None:
    node = plant("_on_pause", _active=before)
    node._real_time = Kept(node.done, "time") if real else None
    wanted = "paused" if pause else "running"
    assert answer(PlantNode._on_pause, node, SetBool.Request(data=pause)) == (True, wanted)
    assert node._active is after
    more: list[Any] = [("time.start", 7 * S, 40) if real else "_step_if_complete"]
    assert node.done == ["_publish_changed_status", *(more if goes_on else [])]


def test_timers_are_destroyed_and_forgotten() -> None:
    node = plant("_stop_timers", _wall_timers=["a", "b"], destroyed=[])
    node.destroy_timer = node.destroyed.append
    PlantNode._stop_timers(node)
    PlantNode._stop_timers(node)
    assert (node.destroyed, node._wall_timers) == (["a", "b"], [])


@pytest.mark.parametrize("active", list(PlantState))
def test_a_plant_that_is_deactivated_drops_its_commands(active: PlantState) -> None:
    node = plant("deactivate", _active=active, _stop_timers=lambda: None)
    PlantNode.deactivate(node)
    ended = active in (INACTIVE, PlantState.FAILED)
    assert node._active is (active if ended else INACTIVE)
    assert node.done == ([] if ended else [("commands.rest",), "_publish_changed_status"])


@pytest.mark.parametrize(
    ("error", "reason"), [(SpaceRobotError("it"), "model"), (ValueError("it"), "exception")]
)
def test_a_failure_has_a_reason(error: Exception, reason: str) -> None:
    node = plant("on_failure", _stop_timers=lambda: None)
    PlantNode.on_failure(node, "It failed.", error)
    assert node._monitor.failure == (reason, "It failed.")
    assert node._active is PlantState.FAILED
    assert node.done == [("commands.rest",), "_publish_changed_status"]
    early = plant("on_failure", _stop_timers=lambda: None, _monitor=None)
    shown: list[Any] = []
    early._publish_status = shown.append
    PlantNode.on_failure(early, "It failed.", error)
    assert [(s.state, s.message, s.reason) for s in shown] == [
        (PlantState.FAILED, "It failed.", reason)
    ]


# -- publishers ---------------------------------------------------------------------------------


class Output:
    """A stream with its readers, of whom some are matched."""

    def __init__(self, topic: str, matched: int = 0) -> None:
        self.topic, self.matched, self.waits, self.taken = topic, matched, [], []  # type: ignore[var-annotated]
        self.received = True

    def readers(self) -> int:
        return self.matched

    def await_readers(self, duration: Any) -> bool:
        self.waits.append(duration.nanoseconds / 1e9)
        return self.received

    def take(self, raw: bytes) -> None:
        self.taken.append(raw)


def test_readers_are_new_by_their_identity_or_once_they_are_matched() -> None:
    known = {"a": [b"1"], "b": [b"2", b"3"]}
    outputs = {name: Output(name, 1) for name in known}

    def readers(topic: str) -> list[Any]:
        return [SimpleNamespace(endpoint_gid=gid) for gid in known[topic]]

    some: Any = SimpleNamespace(
        _outputs=outputs, _readers=frozenset(), _matched=0,
        _node=SimpleNamespace(get_subscriptions_info_by_topic=readers),
    )  # fmt: skip

    def new() -> bool:
        return StatePublisher.has_new_readers(some)

    assert [new(), new()] == [True, False]
    outputs["b"].matched = 2
    assert [new(), new()] == [True, False], "one that was known of is matched"
    known["a"] = [b"4"]
    assert [new(), new()] == [True, False], "another one in its place"
    known["b"], outputs["b"].matched = [b"2"], 1
    assert [new(), new()] == [False, False], "one has gone"


def test_readers_are_awaited_for_so_long_together(monkeypatch: pytest.MonkeyPatch) -> None:
    walls = iter([50.0, 50.0, 50.5, 99.0])
    monkeypatch.setattr(publisher, "time", SimpleNamespace(monotonic=lambda: next(walls)))
    longest = publisher._LONGEST_WAIT
    outputs = {name: Output(name, matched=name != "x") for name in "abxcd"}
    outputs["c"].received = False
    some: Any = SimpleNamespace(_outputs=outputs)
    StatePublisher.await_readers(some)
    waits = [output.waits for output in outputs.values()]
    assert waits == [[longest], [max(0.0, longest - 0.5)], [], [0.0], []], "x has no readers"


@pytest.mark.parametrize(("lost", "target_lost"), [(False, True), (True, False), (False, False)])
@pytest.mark.parametrize("everything", [False, True])
def test_a_lost_pose_is_not_published(lost: bool, target_lost: bool, everything: bool) -> None:
    outputs = {name: Output(name) for name in ("odom", "joints", "base_pose", "target_odom")}
    pairs = {
        name: (output, SimpleNamespace(serialised=lambda stamp, name=name: (name, stamp)))
        for name, output in outputs.items()
    }
    some: Any = SimpleNamespace(
        _all=list(pairs.values()),
        _every_tick=[pairs["odom"], pairs["joints"], pairs["target_odom"]],
        _of_measured_pose=[pairs["odom"][1]],
        _of_target=[pairs["target_odom"][1]],
        _state=SimpleNamespace(sensors=SimpleNamespace(dropout=lost), misses_target=target_lost),
    )
    StatePublisher.publish(some, 3 * S + 7, all_topics=everything)
    stamp = stamp_bytes(3 * S + 7)
    assert {name: output.taken for name, output in outputs.items()} == {
        "odom": [] if lost else [("odom", stamp)],
        "joints": [("joints", stamp)],
        "base_pose": [("base_pose", stamp)] if everything else [],
        "target_odom": [] if target_lost else [("target_odom", stamp)],
    }


def test_contacts_are_errors_and_their_end_is_told() -> None:
    events = [SimpleNamespace(level=2, message="touch"), SimpleNamespace(level=0, message="apart")]
    status = SimpleNamespace(level=1, message="0.01 m", to_values=lambda: {"distance": "0.01"})
    done: list[Any] = []
    log = Kept(done, "log")
    at: list[Any] = []

    def measure(*given: Any) -> Any:
        at.append(given[3])
        return status, events

    some: Any = SimpleNamespace(
        _plant=SimpleNamespace(link_R="R", link_r="r", pose=np.zeros(7)),
        _monitor=SimpleNamespace(measure=measure),
        _name="/plant",
        _stream=Output("clearance"),
        _node=SimpleNamespace(report_event=done.append, get_logger=lambda: log),
    )
    ClearancePublisher.publish(some, 2_500_000_000)
    assert at == [2.5]
    assert done == [events[0], ("log.error", "touch"), events[1], ("log.info", "apart")]
    assert len(some._stream.taken) == 1
