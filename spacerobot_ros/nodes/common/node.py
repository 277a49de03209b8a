"""What all nodes of the stack share: managed life, parameters, services, a clean end."""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from typing import Any, ClassVar

import rclpy
from lifecycle_msgs.msg import State
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleState
from rclpy.parameter import Parameter as RosParameter
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes.common.parameters import check_changes, declare
from spacerobot_ros.nodes.common.raw_stream import RawInput, RawOutput, RawStream, Take
from spacerobot_ros.parameters import Parameter, Value, configured, declared

STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""State and commands: reliable, deep enough for a reader that is briefly busy."""

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""What a late subscriber must still get: reliable, transient local, depth 1."""

AUTOSTART = Parameter(
    "autostart",
    True,
    description="configure and activate at once; false: wait for a supervisor",
)
"""A parameter of every node."""


_LONGEST_DELIVERY = 1.0
"""Wall s after a signal in which readers may still confirm what they were sent."""

_DISCOVERY_CHOICES = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY")


class FlightNode(LifecycleNode):
    """A managed node whose parameters are declared, checked and named in every refusal.

    Subclasses give ``Config``, the declaration of their parameters, and the four hooks
    :meth:`configure`, :meth:`activate`, :meth:`deactivate` and :meth:`cleanup`, which raise
    :class:`SpaceRobotError` with a sentence when they cannot.

    Parameters
    ----------
    name
        Node name; ``kwargs`` are those of ``rclpy.node.Node`` (namespace, context,
        parameter_overrides, cli_args, ...).
    autostart
        Overrides the parameter of that name.

    Raises
    ------
    SpaceRobotError
        A parameter is refused, or ``autostart`` is on and the node cannot be configured.
    """

    Config: ClassVar[type[Any]]
    """The frozen dataclass that declares the node's parameters."""

    def __init__(self, name: str, *, autostart: bool | None = None, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self._declared = (AUTOSTART, *declared(self.Config))
        self.fault: SpaceRobotError | None = None
        self.on_end: Callable[[int], None] = lambda code: None
        """Called with an exit code by a node that has nothing left to do."""
        self.raw_streams: list[RawStream] = []
        """What passes through the node as bytes, from its configuration to its cleanup."""
        self._raising = False
        try:
            self.parameters: dict[str, Value] = declare(self, self._declared)
            self._configured()
            self.add_on_set_parameters_callback(self._on_set_parameters)
            self._permanent = set(self._entities())
            if self.parameters["autostart"] if autostart is None else autostart:
                self.start()
        except SpaceRobotError:
            self.destroy_node()
            raise

    def start(self) -> None:
        """Configure and activate.

        Raises
        ------
        SpaceRobotError
            A transition failed; the sentence says why.
        """
        self.require(self.trigger_configure)
        self.require(self.trigger_activate)

    def require(self, trigger: Callable[[], TransitionCallbackReturn]) -> None:
        """Take a transition (``trigger_configure``, ...) that must succeed.

        Raises
        ------
        SpaceRobotError
            It failed; the sentence, which is not logged as well, says why.
        """
        self._raising = True
        try:
            if trigger() is not TransitionCallbackReturn.SUCCESS:
                raise self.fault or SpaceRobotError(
                    f"Node '{self.get_name()}' refused to {trigger.__name__.split('_')[-1]}."
                )
        finally:
            self._raising = False

    def send_raw(self, kind: type[Any], topic: str, qos: QoSProfile = STREAM) -> RawOutput:
        """Return a new stream whose ``take`` publishes serialised messages."""
        stream = RawOutput(self.create_publisher(kind, topic, qos))
        self.raw_streams.append(stream)
        return stream

    def take_raw(self, kind: type[Any], topic: str, callback: Take) -> None:
        """Subscribe to serialised messages, for whoever listens to the stream as well."""
        stream = RawInput(self.resolve_topic_name(topic), callback)
        # Looked up for every message: a listener may come and go.
        self.create_subscription(kind, topic, lambda raw: stream.take(raw), STREAM, raw=True)
        self.raw_streams.append(stream)

    @property
    def is_active(self) -> bool:
        """Whether the node is in its active state."""
        machine = self._state_machine
        return bool(machine and machine.current_state[0] == State.PRIMARY_STATE_ACTIVE)

    def destroy_node(self) -> None:
        """Destroy the node and let go of its state machine, which would keep it in the graph."""
        super().destroy_node()
        self._state_machine = None

    # -- hooks --------------------------------------------------------------------------------

    def configure(self) -> None:
        """Create what the node needs: model, publishers, subscriptions."""

    def activate(self) -> None:
        """Begin to work."""

    def deactivate(self) -> None:
        """Stop working, keeping everything."""

    def cleanup(self) -> None:
        """Give up what configure created."""

    def drain(self, executor: EventsExecutor) -> None:
        """Take in what is still on its way before the node ends."""

    def parameters_changed(self) -> None:
        """React to a change of live parameters; ``self.parameters`` has the new values."""

    # -- life cycle ---------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run the hook."""
        return self._run(self.configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run the hook."""
        return self._run(self.activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run the hook."""
        return self._run(self.deactivate)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Run the hook and destroy the publishers, subscriptions and timers it leaves."""
        result = self._run(self.cleanup)
        self.raw_streams.clear()
        self._destroy_configured()
        return result

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working and give everything up."""
        self._run(self.deactivate)
        return self._run(self.cleanup)

    def _run(self, hook: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            hook()
        except SpaceRobotError as error:
            self.fault = error
            if not self._raising:
                self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            # rclpy drops what a transition raises; a defect must at least be seen.
            self.fault = SpaceRobotError(f"Node '{self.get_name()}' failed: {error!r}.")
            self.get_logger().error(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        self.fault = None
        return TransitionCallbackReturn.SUCCESS

    def _configured(self) -> None:
        self.config = configured(self.Config, self.parameters)

    def _entities(self) -> list[Any]:
        return [*self.timers, *self.subscriptions, *self.services, *self.publishers]

    def _destroy_configured(self) -> None:
        """Destroy what configure made; the services of every ROS node stay for the next start."""
        destroy = {
            Timer: self.destroy_timer,
            Subscription: self.destroy_subscription,
            Service: self.destroy_service,
            Publisher: self.destroy_publisher,
        }
        for entity in self._entities():
            if entity not in self._permanent:
                next(act for kind, act in destroy.items() if isinstance(entity, kind))(entity)

    def _on_set_parameters(self, changes: list[RosParameter]) -> SetParametersResult:
        reason = check_changes(self._declared, changes)
        if reason:
            return SetParametersResult(successful=False, reason=reason)
        for change in changes:
            if change.name in self.parameters:
                self.parameters[change.name] = change.value
        self._configured()
        self.parameters_changed()
        return SetParametersResult(successful=True)


def use_loopback_discovery() -> None:
    """Keep discovery on this machine unless the user chose otherwise."""
    if not any(os.environ.get(name) for name in _DISCOVERY_CHOICES):
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


def use_private_discovery() -> None:
    """Keep discovery in this process unless the user chose a range or a domain.

    Two lockstep stacks that hear each other would refuse each other's commands.
    """
    if not any(os.environ.get(name) for name in (*_DISCOVERY_CHOICES, "ROS_DOMAIN_ID")):
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "OFF"
    use_loopback_discovery()


def run_node(factory: Callable[[], FlightNode], arguments: list[str] | None = None) -> int:
    """Run one node in its own process until SIGINT or SIGTERM.

    Returns the exit code: 0 after a signal, 2 when the node cannot start (the sentence is on
    standard error), the node's own when it ends by itself.
    """
    use_loopback_discovery()
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:  # The middleware's errors: arguments, parameter files.
        print(f"ROS 2 does not start: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    stop = rclpy.task.Future()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set_result(None))
    node = None
    try:
        try:
            node = factory()
        except SpaceRobotError as error:
            print(f"{error}", file=sys.stderr)
            return 2
        node.on_end = stop.set_result
        # What is there now stays; going through it again in flight would take tens of ms.
        gc.collect()
        gc.freeze()
        executor = EventsExecutor()
        executor.add_node(node)
        spin_until(executor, stop)
        node.drain(executor)
        _deliver(node)
        node.trigger_shutdown()
        return stop.result() or 0
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


def _deliver(node: FlightNode) -> None:
    """Wait until readers have what was published: it would go with the process."""
    end = time.monotonic() + _LONGEST_DELIVERY
    for publisher in node.publishers:
        left = end - time.monotonic()
        if left > 0 and publisher.get_subscription_count():
            publisher.wait_for_all_acked(Duration(seconds=left))


def spin_until(executor: EventsExecutor, done: rclpy.task.Future) -> None:
    """Spin until the future is done, letting Python's signal handlers run.

    The events executor is deaf to signals in a spin without a time limit.
    """
    while not done.done():
        executor.spin_until_future_complete(done, timeout_sec=0.5)
