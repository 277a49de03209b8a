"""A node's parameters as ROS parameters, and the parameters of other nodes, read through their
services.
"""

from __future__ import annotations

import difflib
import json
import math
import sys
from collections.abc import Generator, Iterable, Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.parameter import parameter_value_to_python

from spacerobot_ros.parameters import Parameter, Value

_MAX_CHECKS_FOR_ANSWER = 200
"""Number of checks after which a silent node is assumed to have no parameter services."""

_CHECKS_UNTIL_CONNECTED = 3
"""Number of checks before a request, during which the node discovers the client. An earlier
response would block the node for 0.1 s and be lost."""

_CHECKS_UNTIL_LOST = 50
"""Number of checks after which a response is considered lost by the middleware."""


class RemoteParameters:
    """All parameters of another node, given its full name; call :meth:`look` until it returns
    True."""

    def __init__(self, node: Node, name: str) -> None:
        self._node, self.name = node, name
        self.values: dict[str, str] | None = None
        """JSON string of every set parameter, by full name; None before the answer."""
        self._steps = self._request_values()

    def look(self) -> bool:
        """Return whether the request is complete: the node has responded, or no response is
        expected any more.
        """
        return next(self._steps, True)

    def close(self) -> None:
        """Cancel the request."""
        self._steps.close()

    def _request_values(self) -> Generator[bool, None, None]:
        everything = ListParameters.Request(depth=ListParameters.Request.DEPTH_RECURSIVE)
        listed = yield from self._call(ListParameters, "list_parameters", everything)
        if listed is None:
            return
        names = list(listed.result.names)
        these = GetParameters.Request(names=names)
        got = yield from self._call(GetParameters, "get_parameters", these)
        if got is not None and len(got.values) == len(names):
            values = zip(names, map(parameter_value_to_python, got.values), strict=True)
            self.values = {name: json.dumps(value, default=list) for name, value in values}

    def _call(self, kind: Any, service: str, request: Any) -> Generator[bool, None, Any]:
        client: Client = self._node.create_client(kind, f"{self.name}/{service}")
        try:
            future, asked_at, ready = None, 0, 0
            for look in range(_MAX_CHECKS_FOR_ANSWER):
                if future is not None and future.done():
                    return future.result()
                ready = ready + 1 if client.service_is_ready() else 0
                lost = future is None or look - asked_at >= _CHECKS_UNTIL_LOST
                if lost and ready > _CHECKS_UNTIL_CONNECTED:
                    future, asked_at = client.call_async(request), look
                yield False
            return None
        finally:
            self._node.destroy_client(client)


_QOS_OVERRIDES = "qos_overrides."
"""Prefix of the parameters that rclpy declares for some publishers and subscriptions."""

_LARGEST_FLOAT = sys.float_info.max
_INTEGER_BOUNDS = -(2**63), 2**63 - 1


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    unit = f" [{parameter.unit}]" if parameter.unit else ""
    choices = ", ".join(parameter.choices)
    described = ParameterDescriptor(
        name=parameter.name,
        description=f"{parameter.description}{unit}",
        additional_constraints=f"one of: {choices}" if choices else "",
    )
    low = max(parameter.minimum, -_LARGEST_FLOAT)
    high = min(parameter.maximum, _LARGEST_FLOAT)
    if math.isinf(parameter.minimum) and math.isinf(parameter.maximum):
        return described
    if isinstance(parameter.default, float):
        described.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high))
        ]
    elif isinstance(parameter.default, int) and not isinstance(parameter.default, bool):
        least, most = (
            int(min(max(b, _INTEGER_BOUNDS[0]), _INTEGER_BOUNDS[1])) for b in (low, high)
        )
        described.integer_range = [IntegerRange(from_value=least, to_value=most)]
    return described


def declare(node: Node, parameters: Sequence[Parameter]) -> dict[str, Value]:
    """Declare parameters on a node and return their checked values.

    An integer is accepted for a float parameter (``rate: 20``).

    Raises
    ------
    ParameterError
        A given value is invalid; the message names the parameter.
    """
    values = {}
    for parameter in parameters:
        name = parameter.name
        override = node._parameter_overrides.get(name)
        given = None if override is None else override.value
        value = parameter.default if given is None else parameter.checked(given)
        stored = _ros_parameter(parameter, value)
        if value == ():
            # By its type, because rclpy cannot infer the type of an empty list. With one unset
            # parameter, get_parameters would return nothing, not even the other parameters.
            node.declare_parameter(name, stored.type_, _descriptor(parameter), ignore_override=True)
            Node.set_parameters(node, [stored])
        else:
            node.declare_parameter(name, stored.value, _descriptor(parameter), ignore_override=True)
        values[name] = value
    return values


def unknown_parameters(node: Node, names: Iterable[str]) -> str:
    """Return a clause that names the parameters that do not exist on a node.

    The clause suggests the most similar existing name for each; it is empty if all parameters
    exist.
    """
    unknown = [
        name
        for name in names
        if not node.has_parameter(name) and not name.startswith(_QOS_OVERRIDES)
    ]
    if not unknown:
        return ""
    known = node.list_parameters([], 0).names
    nearest = [difflib.get_close_matches(name, known, 1) for name in unknown]
    hints = [f" (did you mean '{each[0]}'?)" if each else "" for each in nearest]
    listed = ", ".join(f"'{name}'{hint}" for name, hint in zip(unknown, hints, strict=True))
    return f"Node '{node.get_name()}' has no parameter {listed}"


def fix(node: Node, parameters: Iterable[Parameter], *, fixed: bool) -> None:
    """Let ``ros2 param describe`` report whether parameters are currently read-only."""
    for parameter in parameters:
        # Node.set_descriptor never makes a parameter writable again.
        node.describe_parameter(parameter.name).read_only = fixed


def typed(
    parameters: Mapping[str, Parameter], changes: Iterable[RosParameter]
) -> list[RosParameter]:
    """Return parameter changes converted to the declared types; undeclared parameters are
    unchanged.

    An integer is accepted for a float parameter (``ros2 param set /plant tick_rate 50``), and an
    empty list for a list of any type.

    Raises
    ------
    ParameterError
        A value is invalid; the message names the parameter.
    """
    known = [(parameters.get(change.name), change) for change in changes]
    return [
        change if parameter is None else _ros_parameter(parameter, parameter.checked(change.value))
        for parameter, change in known
    ]


def _ros_parameter(parameter: Parameter, value: Value) -> RosParameter:
    kind = RosParameter.Type
    if isinstance(value, tuple):
        of_texts = parameter.texts or any(isinstance(each, str) for each in value)
        return RosParameter(
            parameter.name, kind.STRING_ARRAY if of_texts else kind.DOUBLE_ARRAY, list(value)
        )
    return RosParameter(parameter.name, value=value)
