"""Base class of all nodes: life cycle, parameters, raw streams, events, failures."""

from __future__ import annotations

import json
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import SetParametersResult
from rclpy._rclpy_pybind11 import RCLError
from rclpy.exceptions import InvalidHandle
from rclpy.experimental import EventsExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleState
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from spacerobot_ros.errors import (
    CommandError,
    ParameterError,
    SpaceRobotError,
    counted,
    describe_exception,
    printable,
)
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.messages.diagnostics import StatusRecord
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes.common.ros_parameters import declare, fix, typed, unknown_parameters
from spacerobot_ros.nodes.common.watchdog import Liveness, Role, SilenceReport
from spacerobot_ros.parameters import Parameter, configured, declared, values_of

STREAM = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""QoS for states, commands and events: reliable, with a queue for readers that are busy for a
short time.
"""

BEST_EFFORT = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
"""QoS for state topics from sensor drivers, which do not resend lost messages."""

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""QoS with which a late subscriber receives the last message: reliable, transient local, depth
1."""

LATCHED_QUEUE = QoSProfile(
    depth=STREAM.depth, reliability=LATCHED.reliability, durability=LATCHED.durability
)
"""QoS of subscriptions to latched topics of which no message may be lost, or with several
publishers.
"""

AUTOSTART = Parameter(
    "autostart",
    True,
    description="configure and activate immediately; false: wait for a supervisor",
)
"""Parameter of every node: whether it starts automatically."""

_MIDDLEWARE_TOPICS = ("/rosout", "/parameter_events")

UNKNOWN_NODE = "_NODE_NAME_UNKNOWN_"
"""Node name that rmw_dds_common gives to an endpoint discovered before its node."""


class Endpoint(NamedTuple):
    """A publisher or subscription of a node, and the number of endpoints matched with it."""

    topic: str
    publishes: bool
    matched: int


def endpoints_of(node: Node) -> list[Endpoint]:
    """Return the endpoints of a node in this process, except those of the middleware."""
    writers = [
        Endpoint(each.topic_name, True, each.get_subscription_count()) for each in node.publishers
    ]
    readers = [
        Endpoint(each.topic_name, False, each.get_publisher_count()) for each in node.subscriptions
    ]
    return [each for each in (*writers, *readers) if each.topic not in _MIDDLEWARE_TOPICS]


def topics_without_all_matches(endpoints: Sequence[Endpoint]) -> set[str]:
    """Return the topics on which some endpoints of these nodes have not been matched yet."""
    counts = Counter((topic, publishes) for topic, publishes, _ in endpoints)
    return {topic for topic, publishes, met in endpoints if met < counts[topic, not publishes]}


class FlightNode(LifecycleNode):
    """A managed node with declared and checked parameters; every error message names the parameter.

    Subclasses define ``Config``, which declares their parameters, and the four hooks
    :meth:`configure`, :meth:`activate`, :meth:`deactivate` and :meth:`cleanup`, which raise
    :class:`SpaceRobotError` on failure.

    An exception in a callback (subscription, timer, service) does not end the process or the
    executor: the node is deactivated, calls :meth:`on_failure` and sends an event; a supervisor
    may activate or configure it again.

    Parameters
    ----------
    name
        Node name; ``kwargs`` are passed to ``rclpy.node.Node`` (namespace, context,
        parameter_overrides, cli_args, ...).
    autostart
        Value that overrides the parameter with the same name.

    Raises
    ------
    SpaceRobotError
        A parameter is invalid, or ``autostart`` is true and the node cannot be configured.
    """

    Config: ClassVar[type[Any]]
    """The frozen dataclass that declares the node's parameters."""

    role: ClassVar[Role | None] = None
    """Role of this node in the stack, used by other nodes."""

    depends_on: ClassVar[tuple[Role, ...]] = ()
    """Roles of the nodes that this node monitors."""

    default_name: ClassVar[str] = ""

    def __init__(self, name: str = "", *, autostart: bool | None = None, **kwargs: Any) -> None:
        super().__init__(name or self.default_name, **kwargs)
        self.fault: SpaceRobotError | None = None
        self.on_end: Callable[[int], None] = lambda code: None
        """Function that a finished node calls with its exit code."""
        self._failure, self._destroyed = "", False
        self._liveness = Liveness(self)
        self._event_stream = self.create_publisher(DiagnosticStatus, "events", STREAM)
        self._raising = False
        self._guard_transitions()
        try:
            self._parameters_declared = {each.name: each for each in declared(self.Config)}
            values = declare(self, (AUTOSTART, *self._parameters_declared.values()))
            fix(self, [AUTOSTART], fixed=True)
            self.config = configured(self.Config, values)
            self.add_on_set_parameters_callback(self._on_set_parameters)
            # A supervisor starts time once all nodes have met.
            self.offer("~/connections", lambda: json.dumps(endpoints_of(self)))
            self.prepare()
            self._permanent: set[Any] = {
                *(*self.timers, *self.subscriptions),
                *(*self.services, *self.publishers),
            }
            if values[AUTOSTART.name] if autostart is None else autostart:
                self.start()
        except SpaceRobotError:
            self.destroy_node()
            raise

    def start(self) -> None:
        """Configure and activate the node.

        Raises
        ------
        SpaceRobotError
            A transition failed; the message gives the reason.
        """
        self.require_transition(self.trigger_configure)
        self.require_transition(self.trigger_activate)

    def require_transition(self, trigger: Callable[[], TransitionCallbackReturn]) -> None:
        """Perform a transition (``trigger_configure``, ...) that must succeed.

        Raises
        ------
        SpaceRobotError
            The transition failed; the message, which is not logged, states the reason.
        """
        self._raising = True
        transition = trigger.__name__.split("_")[-1]
        try:
            if trigger() is not TransitionCallbackReturn.SUCCESS:
                raise self.fault or SpaceRobotError(
                    f"Node '{self.get_name()}' refused to {transition}."
                )
        except RCLError as error:
            machine: Any = self._state_machine
            raise SpaceRobotError(
                f"Node '{self.get_name()}' cannot {transition}: "
                f"its state is '{machine.current_state[1]}'."
            ) from error
        finally:
            self._raising = False

    def report_event(self, event: Event) -> None:
        """Publish an event of this node; if the event has no time, the time of the node is used."""
        if event.time_s is None:
            event = replace(event, time_s=self.simulated_time_s)
        values = event.to_values(time.time())
        name = self.get_fully_qualified_name()
        self._event_stream.publish(StatusRecord(name, event.level, event.message, values).encoded())

    @property
    def simulated_time_s(self) -> float | None:
        """Simulated time, s; None if unknown to the node."""
        return None

    # -- callbacks ----------------------------------------------------------------------------

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Callable[..., Any], *args: Any, **kwargs: Any
    ) -> Subscription:
        """Subscribe with a callback whose exceptions call :meth:`on_failure`."""
        guarded = self.guarded(callback, f"a message on '{topic}'")
        return super().create_subscription(msg_type, topic, guarded, *args, **kwargs)

    def create_timer(
        self, timer_period_sec: float, callback: Callable[[], Any], *args: Any, **kwargs: Any
    ) -> Timer:
        """Create a timer with a callback whose exceptions call :meth:`on_failure`."""
        guarded = self.guarded(callback, "a timer")

        def fire() -> None:
            # The executor may still have a destroyed timer in its queue.
            if timer in self.timers:
                guarded()

        timer = super().create_timer(timer_period_sec, fire, *args, **kwargs)
        return timer

    def create_service(
        self, srv_type: Any, srv_name: str, callback: Callable[..., Any], *args: Any, **kwargs: Any
    ) -> Service:
        """Create a service with a callback whose exceptions call :meth:`on_failure`."""

        def answer(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:
                self._fail(f"the service '{srv_name}'", error)
                if hasattr(response, "message"):
                    response.success, response.message = False, self._failure
                return response

        return super().create_service(srv_type, srv_name, answer, *args, **kwargs)

    def offer(self, name: str, act: Callable[[], str]) -> None:
        """Create a service that takes no arguments and responds with the string returned by a
        function.

        If the function raises CommandError, the response contains the error message, and
        ``success`` is false.
        """

        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.success, response.message = True, act()
            except CommandError as refusal:
                response.success, response.message = False, str(refusal)
            return response

        self.create_service(Trigger, name, answer)

    def guarded(self, callback: Callable[..., Any], what: str) -> Callable[..., None]:
        """Return a callback whose exceptions call :meth:`on_failure`."""

        def guarded(*given: Any) -> None:
            try:
                callback(*given)
            except Exception as error:
                self._fail(what, error)

        return guarded

    def _fail(self, what: str, error: Exception) -> None:
        """Stop working after an exception of a callback; the executor continues."""
        if self._destroyed or (isinstance(error, InvalidHandle) and not self.has_entities):
            return  # The executor may still call back for a destroyed entity.
        self.get_logger().debug("".join(traceback.format_exception(error)))
        if isinstance(error, SpaceRobotError):
            message = str(error)
        else:
            message = f"Node '{self.get_name()}' has failed at {what}: {describe_exception(error)}."
        if message == self._failure:
            return  # The failure is reported already, and may recur with every message.
        self._report_failure(message, error)
        try:
            if self.is_active:
                self.trigger_deactivate()
        except Exception as second:  # A second failure must not cause a third one.
            self.get_logger().error(
                f"Node '{self.get_name()}' cannot stop: {describe_exception(second)}."
            )
        self.fault = SpaceRobotError(message)

    def _report_failure(self, message: str, error: Exception) -> None:
        self._failure = message
        self.get_logger().error(message)
        try:
            self.on_failure(message, error)
        except Exception as second:
            self.get_logger().error(f"Node '{self.get_name()}': {describe_exception(second)}.")
        self.report_event(Event(EventKind.FAILED, message, level=2))

    def set_parameters(self, parameter_list: list[RosParameter]) -> list[SetParametersResult]:
        """Set parameters one by one; see :meth:`set_parameters_atomically`."""
        return [self.set_parameters_atomically([each]) for each in parameter_list]

    def set_parameters_atomically(self, parameter_list: list[RosParameter]) -> SetParametersResult:
        """Set all parameters or none; most can be set only while the node is unconfigured.

        Values are converted to the declared types if possible, such as an integer to a float. An
        unchanged value is always accepted, because loading a dump sets every parameter.
        """
        if unknown := unknown_parameters(self, [each.name for each in parameter_list]):
            return SetParametersResult(successful=False, reason=f"{unknown}.")
        try:
            changes = []
            for given in typed(self._parameters_declared, parameter_list):
                present = self.get_parameter_or(given.name)
                if (present.type_, present.value) != (given.type_, given.value):
                    changes.append(given)
            self._require_changeable(changes)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if not changes:
            return SetParametersResult(successful=True)
        return super().set_parameters_atomically(changes)

    @property
    def is_active(self) -> bool:
        """Whether the node is in its active state."""
        return self.lifecycle_state == State.PRIMARY_STATE_ACTIVE

    @property
    def lifecycle_state(self) -> int:
        """The current state, a constant of lifecycle_msgs/State."""
        machine = self._state_machine
        return machine.current_state[0] if machine else State.PRIMARY_STATE_UNKNOWN

    @property
    def has_entities(self) -> bool:
        """Whether entities created by ``configure`` exist, that is, the node is configured or in
        transition.
        """
        return self.lifecycle_state not in (
            State.PRIMARY_STATE_UNKNOWN,
            State.PRIMARY_STATE_UNCONFIGURED,
            State.PRIMARY_STATE_FINALIZED,
        )

    def finalize(self) -> None:
        """Shut the node down unless it is already shut down."""
        # Unconfigured, inactive and active lie in between; states of transitions come after.
        if State.PRIMARY_STATE_UNKNOWN < self.lifecycle_state < State.PRIMARY_STATE_FINALIZED:
            self.trigger_shutdown()

    def destroy_node(self) -> None:
        """Destroy the node and release its state machine, which would otherwise keep the node in
        the graph.
        """
        self._liveness.end()
        self._destroyed = True
        super().destroy_node()
        self._state_machine = None

    # -- hooks --------------------------------------------------------------------------------

    def prepare(self) -> None:
        """Create the entities that exist as long as the node, such as its status publisher."""

    def configure(self) -> None:
        """Create the model, publishers, subscriptions and services."""

    def activate(self) -> None:
        """Start the node's work."""

    def start_message(self) -> str:
        """Return the message that the node logs when it becomes active."""
        return f"Node '{self.get_name()}' is active."

    def deactivate(self) -> None:
        """Stop the node's work, but keep its resources."""

    def cleanup(self) -> None:
        """Release the resources created by :meth:`configure`."""

    def on_failure(self, message: str, error: Exception) -> None:
        """Report in the node's status that an error stopped the node; after that, the
        node is deactivated."""

    def interrupt(self) -> None:
        """Cancel a long computation; called when the process must end."""

    def on_silence(self, silence: SilenceReport) -> None:
        """React to a node that has become silent or has returned."""
        kind = EventKind.NODE_BACK if silence.over else EventKind.NODE_SILENT
        level, logger = (0 if silence.over else 2), self.get_logger()
        if silence.over:
            logger.info(silence.message)
        else:
            logger.error(silence.message)
        about = {"node": silence.name, "silent_s": f"{silence.seconds:.3f}"}
        self.report_event(Event(kind, silence.message, level, about=about))

    def long_work(self) -> AbstractContextManager[None]:
        """Announce a long computation to the nodes that depend on this node."""
        return self._liveness.busy()

    @property
    def exit_code(self) -> int:
        """Exit code of the process if the node ends on request."""
        return 0

    def drain(self, executor: EventsExecutor) -> None:
        """Complete pending work within about a second before the node ends."""

    def parameters_changed(self) -> None:
        """React to changed live parameters; ``self.config`` contains the new values."""

    # -- life cycle ---------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Call :meth:`configure`; if that fails, destroy the entities that were created."""
        self._liveness.configure(float(getattr(self.config, "watchdog_timeout", 0.0)))
        if unknown := unknown_parameters(self, self._parameter_overrides):
            self.get_logger().warning(printable(f"{unknown}: given values are ignored."), once=True)
        result = self._run(self.configure)
        if result is TransitionCallbackReturn.FAILURE:
            self._destroy_configured()
        if result is TransitionCallbackReturn.SUCCESS:
            self._set_parameters_read_only(fixed=True)
        return self._report_transition(result, EventKind.CONFIGURED)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Call :meth:`activate` and start the heartbeats."""
        result = self._run(self.activate)
        if result is TransitionCallbackReturn.SUCCESS:
            self._liveness.begin()
            self.get_logger().info(self.start_message())
        return self._report_transition(result, EventKind.ACTIVATED)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Call :meth:`deactivate`."""
        self._liveness.end()
        return self._report_transition(self._run(self.deactivate), EventKind.DEACTIVATED)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Call :meth:`cleanup`, and destroy remaining publishers, subscriptions and timers."""
        result = self._run(self.cleanup)
        self._destroy_configured()
        return self._report_transition(result, EventKind.CLEANED_UP)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop working and release all resources."""
        self._liveness.end()
        self._run(self.deactivate)
        return self._report_transition(self._run(self.cleanup), EventKind.SHUT_DOWN)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release all resources after a failed transition; the node may be configured again."""
        self._liveness.end()
        with suppress(Exception):  # A failed transition may have left entities behind.
            self.cleanup()
        self._destroy_configured()
        if self._failure and self.fault is not None:
            with suppress(Exception):
                self.on_failure(self._failure, self.fault)
        return TransitionCallbackReturn.SUCCESS

    def _run(self, hook: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            hook()
        except SpaceRobotError as error:
            self.fault = error
            if not self._raising:
                self._report_failure(str(error), error)
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            # rclpy drops exceptions of transitions, so they are logged here.
            message = f"Node '{self.get_name()}' has failed: {describe_exception(error)}."
            self.fault = SpaceRobotError(message)
            self.get_logger().debug(traceback.format_exc())
            self._report_failure(message, error)
            return TransitionCallbackReturn.ERROR
        self.fault = None
        return TransitionCallbackReturn.SUCCESS

    def _report_transition(
        self, result: TransitionCallbackReturn, kind: EventKind
    ) -> TransitionCallbackReturn:
        if result is TransitionCallbackReturn.SUCCESS:
            if kind in (EventKind.CONFIGURED, EventKind.ACTIVATED):
                self._failure = ""
            words = kind.value.replace("_", " ")
            self.report_event(Event(kind, f"Node '{self.get_name()}' is {words}."))
        return result

    def _guard_transitions(self) -> None:
        """Answer requests for impossible transitions, which otherwise end the process."""
        service = self._service_change_state
        change = service.callback

        def answer(
            request: ChangeState.Request, response: ChangeState.Response
        ) -> ChangeState.Response:
            machine: Any = self._state_machine
            possible = {str(each[0]): str(each[1]) for each in machine.available_transitions}
            wanted = request.transition.label or str(request.transition.id)
            if wanted in (*possible, *possible.values()):
                return change(request, response)
            listed = ", ".join(f"{label} ({number})" for number, label in possible.items())
            self.get_logger().warning(
                f"The transition {wanted} is not possible in the state "
                f"'{machine.current_state[1]}', which has {listed or 'none'}."
            )
            response.success = False
            return response

        service.callback = answer

    def _destroy_configured(self) -> None:
        """Destroy the entities created by configure; the services of every ROS node are kept."""
        self._set_parameters_read_only(fixed=False)
        for entities, destroy in (
            (self.timers, self.destroy_timer),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.publishers, self.destroy_publisher),
        ):
            for entity in (*entities,):
                if entity not in self._permanent:
                    destroy(entity)

    def _set_parameters_read_only(self, *, fixed: bool) -> None:
        """Make the parameters that :meth:`configure` reads constant, or writable again."""
        declared = self._parameters_declared.values()
        fix(self, (each for each in declared if each.read_only), fixed=fixed)

    def _require_changeable(self, changes: list[RosParameter]) -> None:
        for change in changes:
            if change.name == AUTOSTART.name:
                raise ParameterError(
                    "Parameter 'autostart' is read only once, when the node starts: change the "
                    "state of the node instead."
                )
            declaration = self._parameters_declared.get(change.name)
            configured_now = self.lifecycle_state != State.PRIMARY_STATE_UNCONFIGURED
            if declaration is not None and declaration.read_only and configured_now:
                name = self.get_fully_qualified_name()
                raise ParameterError(
                    f"Parameter '{change.name}' keeps its value while the node is configured: "
                    f"first deactivate and clean up the node (ros2 lifecycle set {name} "
                    f"deactivate, "
                    "then cleanup), set the parameter, and configure and activate the node again."
                )

    def _on_set_parameters(self, changes: list[RosParameter]) -> SetParametersResult:
        given, before = {change.name: change.value for change in changes}, self.config
        try:
            self.config = configured(self.Config, {**values_of(self.config), **given})
            self.parameters_changed()
        except ParameterError as error:
            self.config = before
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)


def described_robot(robot: SpaceRobot | None) -> str:
    """Return a phrase with a robot's name, number of joints and mass."""
    if robot is None:
        return "the robot expected on robot_description"
    mass = robot.description.total_mass
    return f"'{robot.description.name}' ({counted(robot.n, 'joint')}, {mass:.4g} kg)"
