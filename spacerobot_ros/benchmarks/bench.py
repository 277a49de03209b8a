"""Speed of the stack as ratios to peers measured in the same run.

Machines differ and are shared: the ratios say more than the figures. The peer of the lockstep
run is the least that ROS can do with as many topics: one node publishes ready-made bytes on the
plant's topics, one answers with a command, and raw subscriptions write it all into an MCAP file.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

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
from spacerobot_ros.benchmarks.dynamics import dynamics_benchmark
from spacerobot_ros.flight.scenario import load_scenario
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import c_compiler
from spacerobot_ros.nodes import ReplayNode
from spacerobot_ros.nodes.common.node import STREAM
from spacerobot_ros.nodes.common.process import spin_until
from spacerobot_ros.planning import PlanRequest
from spacerobot_ros.resources import share_directory
from spacerobot_ros.session.run import ros
from spacerobot_ros.session.stack import InProcessStack
from spacerobot_ros.simulation import VelocityPlant
from spacerobot_ros.simulation.trials import state_of
from spacerobot_ros.times import SECOND

_ROUNDS = 5
_TOPICS: tuple[tuple[str, type[Any], int, int], ...] = (
    ("/clock", Clock, 0, 1),
    ("base_pose", PoseStamped, 0, 20),
    ("momentum", Float64MultiArray, 7, 1),
    ("odom", Odometry, 0, 1),
    ("joint_states", JointState, 3, 1),
)
"""The plant's topics: name, type, length of its lists, and how many ticks from one to the next."""

_GAITS = (
    ("sliding_masses", "lie_bracket"),
    ("arm_attitude", "area_loop"),
    ("planar_chain", "square_path"),
)
"""Scenarios of the papers, and the methods that are theirs."""

_PLANS = 5

_PERIOD = 0.01
_MESSAGES = 500
_PATIENCE = 2.0
"""Wall s for what is on its way when the replay has ended."""

_REPLAYED = "/bench/joint_states"


def run_benchmark(ticks: int, show: Callable[[str], None]) -> dict[str, float | str]:
    """Measure, show lines for people and return the figures by name.

    The stack and its peer take turns, and medians are compared: what else the machine does then
    falls on both.
    """
    stack_rates, bare_stack_rates, peer_rates = [], [], []
    with ros(private=True), tempfile.TemporaryDirectory() as folder:
        bag = Path(folder, "bench.mcap")
        for _ in range(_ROUNDS):
            peer_rates.append(_peer_rate(ticks, bag))
            bag.unlink()
            stack_rates.append(_stack_rate(ticks, bag))
            bag.unlink()
            bare_stack_rates.append(_stack_rate(ticks, None))
            show(
                f"round: {stack_rates[-1]:8.0f} ticks/s with plant, planner and recorder, "
                f"{peer_rates[-1]:8.0f} bare"
            )
        spacing, worst_spacing = _replay_spacing(Path(folder))
    stack_rate, peer_rate = statistics.median(stack_rates), statistics.median(peer_rates)
    unrecorded = statistics.median(bare_stack_rates)
    tick = _plant_tick()
    figures: dict[str, float | str] = {
        "ticks_per_s": stack_rate,
        "bare_ticks_per_s": peer_rate,
        "unrecorded_ticks_per_s": unrecorded,
        "recorder_cost": 1 - stack_rate / unrecorded,
        "ratio_to_bare": stack_rate / peer_rate,
        "replay_spacing_error_s": spacing,
        "plant_tick_us": 1e6 * tick,
        "compiler": c_compiler() or "none (virtual machine)",
    }
    show(f"lockstep, recorded: {stack_rate:.0f} ticks/s (median of {_ROUNDS})")
    show(f"bare ping-pong with as many topics and a raw recorder: {peer_rate:.0f} ticks/s")
    show(f"ratio: {100 * stack_rate / peer_rate:.0f} %")
    cost = 100 * (1 - stack_rate / unrecorded)
    show(f"without the recorder: {unrecorded:.0f} ticks/s; recording costs {cost:.0f} % of them")
    show(
        f"replay at rate 1, 100 messages a second: spacing off by {1e3 * spacing:.2f} ms (median), "
        f"{1e3 * worst_spacing:.1f} ms at most"
    )
    show(f"one plant tick alone: {1e6 * tick:.1f} us (compiler: {figures['compiler']})")
    for name, first, later in _planning_times():
        figures |= {f"plan_{name}_first_s": first, f"plan_{name}_s": later}
        show(f"planning by {name}: {1e3 * later:.0f} ms, the first time {1e3 * first:.0f} ms")
    dynamics = dynamics_benchmark()
    figures |= dynamics
    for line in _dynamics_lines(dynamics):
        show(line)
    return figures


def _dynamics_lines(figures: dict[str, float | str]) -> Iterator[str]:
    """Yield how the dynamics of the six-joint robot compare with MuJoCo's."""
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


def _stack_rate(ticks: int, bag: Path | None) -> float:
    """Ticks a second of the first ``ticks`` of the sliding-mass flight, planning left out."""
    scenario = load_scenario("sliding_masses").with_overrides("planner", {"method": "lie_bracket"})
    stack = InProcessStack(scenario, bag)
    try:
        stack.start(stack.scenario.goal)
        first, began = 0, 0.0

        def look() -> bool:
            nonlocal first, began
            if not first:
                first, began = stack.plant.tick, time.perf_counter()
            return stack.plant.tick >= first + ticks

        stack.spin(look)
        rate = (stack.plant.tick - first) / (time.perf_counter() - began)
        stack.finish()
    finally:
        stack.close()
    return rate


def _peer_rate(ticks: int, path: Path) -> float:
    """Ticks a second of the bare ping-pong."""
    qos = QoSProfile(depth=1000)
    a, b, recorder = (rclpy.create_node(name) for name in ("ping", "pong", "raw_recorder"))
    executor = EventsExecutor()
    done = rclpy.task.Future()
    count = 0
    command = serialize_message(_filled(JointState, 3))
    publishers = [
        (a.create_publisher(kind, topic, qos), serialize_message(_filled(kind, n)), period)
        for topic, kind, n, period in _TOPICS
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
        for topic, kind, _, _ in (*_TOPICS, ("joint_commands", JointState, 3, 1)):
            channel = writer.register_channel(topic, "cdr", schema)
            recorder.create_subscription(kind, topic, _writing(writer, channel), qos, raw=True)
        a.create_subscription(JointState, "joint_commands", on_command, qos, raw=True)
        b.create_subscription(
            JointState, "joint_states", lambda _: reply.publish(command), qos, raw=True
        )
        for node in (a, b, recorder):
            executor.add_node(node)
        while not all(p.get_subscription_count() for p in (*(p for p, *_ in publishers), reply)):
            executor.spin_once(timeout_sec=0.01)
        began = time.perf_counter()
        ping()
        executor.spin_until_future_complete(done, timeout_sec=1e6)
        elapsed = time.perf_counter() - began
        writer.finish()
    executor.shutdown()
    for node in (a, b, recorder):
        node.destroy_node()
    return ticks / elapsed


def _writing(writer: Writer, channel: int) -> Callable[[bytes], None]:
    return lambda raw: writer.add_message(channel, 0, raw, 0)


def _filled(kind: type[Any], n: int) -> Any:
    """Return a message with its lists as long as the stack's are."""
    message = kind()
    if kind is JointState:
        message.name = [f"slider_{i}" for i in range(1, n + 1)]
        message.position = message.velocity = message.effort = [0.0] * n
    elif kind is Float64MultiArray:
        message.data = [0.0] * n
    return message


def _plant_tick() -> float:
    """Duration of one tick of the sliding-mass plant without ROS, s."""
    robot = SpaceRobot.from_file(share_directory() / "urdf" / "sliding_masses.urdf")
    plant = VelocityPlant(robot, 0.05)
    command = np.full(robot.n, 1e-6)
    repeats = 20_000
    began = time.perf_counter()
    for _ in range(repeats):
        plant.step(command)
    return (time.perf_counter() - began) / repeats


def _planning_times() -> Iterator[tuple[str, float, float]]:
    """Yield for each method its name, and the first and the median time of a plan, s.

    ``area_loop`` plans one cycle at a time.
    """
    for scenario, name in _GAITS:
        problem = load_scenario(scenario).problem()
        method = problem.method(name)
        request = PlanRequest(state_of(problem.plant()), problem.goal, problem.config.tolerance)
        times = []
        for _ in range(1 + _PLANS):
            began = time.perf_counter()
            method.plan(request)
            times.append(time.perf_counter() - began)
        yield name, times[0], statistics.median(times[1:])


def _replay_spacing(folder: Path) -> tuple[float, float]:
    """Return by how much the spacing of 500 messages, 100 a second, is missed at rate 1.

    Returns the median and the largest error of the time from one message to the next, s.
    """
    bag = folder / "spacing.mcap"
    with BagWriter(bag) as writer:
        channel = writer.add_topic(_REPLAYED, "sensor_msgs/msg/JointState")
        raw = serialize_message(JointState(name=["a", "b", "c"], position=[0.0] * 3))
        for k in range(_MESSAGES):
            stamp = round(k * _PERIOD * SECOND)
            writer.write(channel, raw, stamp, stamp)
    arrivals: list[float] = []
    executor = EventsExecutor()
    listener = rclpy.create_node("listener")
    listener.create_subscription(
        JointState, _REPLAYED, lambda _: arrivals.append(time.perf_counter()), STREAM, raw=True
    )
    replay = ReplayNode("replay", parameter_overrides=[Parameter("bag", value=str(bag))])
    done = rclpy.task.Future()
    replay.on_end = done.set_result
    try:
        for node in (listener, replay):
            executor.add_node(node)
        spin_until(executor, done)
        patience = time.perf_counter() + _PATIENCE
        while len(arrivals) < _MESSAGES and time.perf_counter() < patience:
            executor.spin_once(timeout_sec=0.1)
    finally:
        for node in (listener, replay):
            node.destroy_node()
        executor.shutdown()
    errors = [abs(later - earlier - _PERIOD) for earlier, later in pairwise(arrivals)]
    return statistics.median(errors), max(errors)
