"""Speed of the stack in lockstep, beside a minimal exchange of messages in the same run.

Machines differ and are shared: the ratio says more than the figures. The minimal exchange is the
least that ROS can do with as many topics: one node publishes ready-made bytes on the plant's
topics, one answers with a command, and raw subscriptions write all of it into an MCAP file.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from mcap.writer import CompressionType, Writer
from nav_msgs.msg import Odometry
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from spacerobot_ros.bag import BagWriter
from spacerobot_ros.benchmarks.engines import dynamics_benchmark, median_cpu_times
from spacerobot_ros.benchmarks.measurements import import_time
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import c_compiler
from spacerobot_ros.nodes import ReplayNode
from spacerobot_ros.nodes.common.node import STREAM
from spacerobot_ros.nodes.common.process import spin_until
from spacerobot_ros.planning import PlanRequest
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import ros
from spacerobot_ros.session.stack import InProcessStack
from spacerobot_ros.simulation import VelocityPlant
from spacerobot_ros.simulation.trials import robot_state_of
from spacerobot_ros.times import SECOND

_DYNAMICS_ROUNDS = 5
_EXCHANGED_TOPICS: tuple[tuple[str, type[Any], int, int], ...] = (
    ("/clock", Clock, 0, 1),
    ("base_pose", PoseStamped, 0, 20),
    ("momentum", Float64MultiArray, 7, 1),
    ("odom", Odometry, 0, 1),
    ("joint_states", JointState, 3, 1),
)
"""The plant's topics: name, type, length of its lists, and how many ticks from one to the next."""

_SCENARIOS_AND_METHODS = (
    ("sliding_masses", "lie_bracket"),
    ("arm_attitude", "area_loop"),
    ("planar_chain", "square_path"),
)
"""Scenarios of the papers with their methods."""

_SERVICER_TICKS = 2_000
"""Most ticks of a flight of the servicer, which is at its goal later."""

_PLANS_PER_MEDIAN = 5
_PLANT_TICKS = 5_000

_REPLAY_PERIOD = 0.01
_REPLAYED_MESSAGES = 500
_REPLAY_TIMEOUT = 2.0
"""Wall time for the messages that are still under way when the replay has ended, s."""

_REPLAYED_TOPIC = "/bench/joint_states"


def ticks_benchmark(ticks: int, show: Callable[[str], None]) -> dict[str, float | str]:
    """Measure, show lines for the user and return the figures by name.

    The stack and the minimal exchange take turns, and medians are compared, so that the machine's
    other load affects both alike.
    """
    names = ("recorded", "unrecorded", "minimal", "servicer")
    flights: dict[str, list[_Speed]] = {name: [] for name in names}
    with ros(private=True), tempfile.TemporaryDirectory() as folder:
        bag = Path(folder, "bench.mcap")
        for _ in range(_DYNAMICS_ROUNDS):
            flights["minimal"].append(_exchange_speed(ticks, bag))
            bag.unlink()
            flights["recorded"].append(_stack_speed(ticks, bag))
            bag.unlink()
            flights["unrecorded"].append(_stack_speed(ticks, None))
            few = min(ticks, _SERVICER_TICKS)
            flights["servicer"].append(_stack_speed(few, bag, scenario="servicer"))
            bag.unlink()
            show(
                f"round: {flights['recorded'][-1].cpu_us:.1f} us of CPU time a tick with plant, "
                f"planner and recorder, {flights['minimal'][-1].cpu_us:.1f} us minimal exchange"
            )
        spacing, worst_spacing = _replay_spacing(Path(folder))
    stack, unrecorded, minimal, servicer = (
        _Speed(*np.median(speeds, axis=0).tolist()) for speeds in flights.values()
    )
    recorder_share = 1 - unrecorded.cpu_us / stack.cpu_us
    tick = _plant_tick_cpu_time()
    importing = import_time("spacerobot_ros.nodes.plant.node")
    figures: dict[str, float | str] = {
        "ticks_per_s": stack.ticks_per_s,
        "bare_ticks_per_s": minimal.ticks_per_s,
        "unrecorded_ticks_per_s": unrecorded.ticks_per_s,
        "tick_cpu_us": stack.cpu_us,
        "bare_tick_cpu_us": minimal.cpu_us,
        "recorder_cost": recorder_share,
        "ratio_to_bare": minimal.cpu_us / stack.cpu_us,
        "servicer_tick_cpu_us": servicer.cpu_us,
        "plant_import_cpu_s": importing,
        "replay_spacing_error_s": spacing,
        "plant_tick_us": tick,
        "compiler": c_compiler() or "none (virtual machine)",
    }
    show(
        f"lockstep, recorded: {stack.ticks_per_s:.0f} ticks/s, {stack.cpu_us:.1f} us of CPU time a "
        f"tick (medians of {_DYNAMICS_ROUNDS})"
    )
    show(
        f"minimal exchange with as many topics and a raw recorder: {minimal.ticks_per_s:.0f} "
        f"ticks/s, {minimal.cpu_us:.1f} us of CPU time a tick"
    )
    show(f"ratio of the CPU times: {minimal.cpu_us / stack.cpu_us:.2f}")
    show(f"the recorder takes {100 * recorder_share:.0f} % of the CPU time")
    show(f"the servicer under control, recorded: {servicer.cpu_us:.1f} us of CPU time a tick")
    show(f"the import of the plant's node: {importing:.2f} s of CPU time")
    show(
        f"replay at rate 1, 100 messages a second: spacing off by {1e3 * spacing:.2f} ms (median), "
        f"{1e3 * worst_spacing:.1f} ms at most"
    )
    show(f"one plant tick alone: {tick:.1f} us (compiler: {figures['compiler']})")
    for name, first, later in _planning_times():
        figures |= {f"plan_{name}_first_s": first, f"plan_{name}_s": later}
        show(f"planning by {name}: {1e3 * later:.0f} ms, the first time {1e3 * first:.0f} ms")
    dynamics = dynamics_benchmark()
    figures |= dynamics
    for line in _dynamics_lines(dynamics):
        show(line)
    return figures


def _dynamics_lines(figures: dict[str, float | str]) -> Iterator[str]:
    """Yield lines that compare the dynamics of the six-joint robot with MuJoCo's."""
    if "step_us" in figures:
        yield f"one RK4 step of the servicer's dynamics: {figures['step_us']:.1f} us"
    yield f"... in the virtual machine: {figures['step_without_compiler_us']:.1f} us"
    if "mujoco_step_us" not in figures:
        yield f"MuJoCo: {figures['mujoco']}"
        return
    yield f"MuJoCo {figures['mujoco']}, mj_step with RK4: {figures['mujoco_step_us']:.1f} us"
    if "ratio_to_mujoco" in figures:
        yield f"times faster than MuJoCo: {figures['ratio_to_mujoco']:.1f}"
    without = figures["ratio_to_mujoco_without_compiler"]
    yield f"... without a compiler: {without:.2f}"


class _Speed(NamedTuple):
    """Ticks a second of wall time, and the CPU time of a tick, us."""

    ticks_per_s: float
    cpu_us: float


def _speed_of(ticks: int, wall: float, cpu: float) -> _Speed:
    """Return the speed of a number of ticks that took these times, s."""
    return _Speed(ticks / wall, 1e6 * cpu / ticks)


def _stack_speed(ticks: int, bag: Path | None, scenario: str = "sliding_masses") -> _Speed:
    """Return the speed of the first ``ticks`` of a scenario, without planning."""
    flown = load_scenario(scenario)
    if "planner" in flown.commanders:
        flown = flown.with_overrides("planner", {"method": "lie_bracket"})
    stack = InProcessStack(flown, bag)
    try:
        stack.start(stack.scenario.goal)
        first_tick, wall, cpu = 0, 0.0, 0.0

        def has_flown() -> bool:
            nonlocal first_tick, wall, cpu
            if not first_tick:
                first_tick, wall, cpu = stack.plant.tick, time.perf_counter(), time.process_time()
            return stack.plant.tick >= first_tick + ticks

        stack.spin(has_flown)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        speed = _speed_of(stack.plant.tick - first_tick, wall, cpu)
        stack.finish()
    finally:
        stack.close()
    return speed


def _exchange_speed(ticks: int, path: Path) -> _Speed:
    """Return the speed of an exchange of as many messages as the stack's, which is recorded."""
    qos = QoSProfile(depth=1000)
    a, b, recorder = (rclpy.create_node(name) for name in ("ping", "pong", "raw_recorder"))
    executor = EventsExecutor()
    done = rclpy.task.Future()
    count = 0
    command = serialize_message(_message_with_lists(JointState, 3))
    publishers = [
        (
            a.create_publisher(kind, topic, qos),
            serialize_message(_message_with_lists(kind, n)),
            period,
        )
        for topic, kind, n, period in _EXCHANGED_TOPICS
    ]
    reply = b.create_publisher(JointState, "joint_commands", qos)

    def ping() -> None:
        for publisher, raw, period in publishers:
            if count % period == 0:
                publisher.publish(raw)

    def on_command(_: bytes) -> None:
        nonlocal count
        count += 1
        if count < ticks:
            ping()
        elif not done.done():
            done.set_result(None)

    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=65536, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("bench", "ros2msg", b"")
        for topic, kind, _, _ in (*_EXCHANGED_TOPICS, ("joint_commands", JointState, 3, 1)):
            channel = writer.register_channel(topic, "cdr", schema)
            recorder.create_subscription(
                kind, topic, _recording_callback(writer, channel), qos, raw=True
            )
        a.create_subscription(JointState, "joint_commands", on_command, qos, raw=True)
        b.create_subscription(
            JointState, "joint_states", lambda _: reply.publish(command), qos, raw=True
        )
        for node in (a, b, recorder):
            executor.add_node(node)
        while not all(p.get_subscription_count() for p in (*(p for p, *_ in publishers), reply)):
            executor.spin_once(timeout_sec=0.01)
        began, used = time.perf_counter(), time.process_time()
        ping()
        executor.spin_until_future_complete(done, timeout_sec=1e6)
        speed = _speed_of(ticks, time.perf_counter() - began, time.process_time() - used)
        writer.finish()
    executor.shutdown()
    for node in (a, b, recorder):
        node.destroy_node()
    return speed


def _recording_callback(writer: Writer, channel: int) -> Callable[[bytes], None]:
    return lambda raw: writer.add_message(channel, 0, raw, 0)


def _message_with_lists(kind: type[Any], n: int) -> Any:
    """Return a message with its lists as long as the stack's are."""
    message = kind()
    if kind is JointState:
        message.name = [f"slider_{i}" for i in range(1, n + 1)]
        message.position = message.velocity = message.effort = [0.0] * n
    elif kind is Float64MultiArray:
        message.data = [0.0] * n
    return message


def _plant_tick_cpu_time() -> float:
    """Return the CPU time of one tick of the sliding-mass plant without ROS, us."""
    robot = SpaceRobot.from_file(robot_file("sliding_masses"))
    plant = VelocityPlant(robot, 0.05)
    command = np.full(robot.n, 1e-6)

    def run() -> None:
        for _ in range(_PLANT_TICKS):
            plant.step(command)

    return median_cpu_times({"tick": (run, _PLANT_TICKS)}, _DYNAMICS_ROUNDS)["tick"]


def _planning_times() -> Iterator[tuple[str, float, float]]:
    """Yield for each method its name, and the first and the median time of a plan, s.

    ``area_loop`` plans one cycle at a time.
    """
    for scenario, name in _SCENARIOS_AND_METHODS:
        problem = load_scenario(scenario).problem()
        method = problem.method(name)
        request = PlanRequest(
            robot_state_of(problem.plant()), problem.goal, problem.config.tolerance
        )
        times = []
        for _ in range(1 + _PLANS_PER_MEDIAN):
            began = time.perf_counter()
            method.plan(request)
            times.append(time.perf_counter() - began)
        yield name, times[0], statistics.median(times[1:])


def _replay_spacing(folder: Path) -> tuple[float, float]:
    """Replay 500 messages, 100 a second; return the errors of their spacing.

    They are the median and the largest error of the time from one message to the next, s.
    """
    bag = folder / "spacing.mcap"
    with BagWriter(bag) as writer:
        channel = writer.add_topic(_REPLAYED_TOPIC, "sensor_msgs/msg/JointState")
        raw = serialize_message(JointState(name=["a", "b", "c"], position=[0.0] * 3))
        for k in range(_REPLAYED_MESSAGES):
            stamp = round(k * _REPLAY_PERIOD * SECOND)
            writer.write(channel, raw, stamp, stamp)
    arrivals: list[float] = []
    executor = EventsExecutor()
    listener = rclpy.create_node("listener")
    listener.create_subscription(
        JointState,
        _REPLAYED_TOPIC,
        lambda _: arrivals.append(time.perf_counter()),
        STREAM,
        raw=True,
    )
    replay = ReplayNode("replay", parameter_overrides=[Parameter("bag", value=str(bag))])
    done = rclpy.task.Future()
    replay.on_end = done.set_result
    try:
        for node in (listener, replay):
            executor.add_node(node)
        spin_until(executor, done)
        deadline = time.perf_counter() + _REPLAY_TIMEOUT
        while len(arrivals) < _REPLAYED_MESSAGES and time.perf_counter() < deadline:
            executor.spin_once(timeout_sec=0.1)
    finally:
        for node in (listener, replay):
            node.destroy_node()
        executor.shutdown()
    errors = [abs(later - earlier - _REPLAY_PERIOD) for earlier, later in pairwise(arrivals)]
    return statistics.median(errors), max(errors)
