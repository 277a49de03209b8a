"""Parameters of a configuration as ROS parameters of a node."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from spacerobot_ros.parameters import Parameter, Value

_LARGEST_FLOAT = sys.float_info.max
_INTEGERS = -(2**63), 2**63 - 1
"""Bounds that descriptors can hold."""


def _descriptor(parameter: Parameter) -> ParameterDescriptor:
    """Return what ``ros2 param describe`` shows."""
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
        least, most = (int(min(max(b, _INTEGERS[0]), _INTEGERS[1])) for b in (low, high))
        described.integer_range = [IntegerRange(from_value=least, to_value=most)]
    return described


def declare(node: Node, parameters: Sequence[Parameter]) -> dict[str, Value]:
    """Declare parameters on a node and return their checked values.

    A whole number is accepted where a real one is wanted (``rate: 20``).

    Raises
    ------
    ParameterError
        A given value is refused; the sentence names the parameter.
    """
    values = {}
    for parameter in parameters:
        name = parameter.name
        given = _given(node, name)
        value = parameter.default if given is None else parameter.checked(given)
        stored = _ros_parameter(parameter, value)
        if value == ():
            # By its type, because rclpy cannot tell that of an empty list. One parameter that is
            # left unset would have get_parameters answer nothing, whatever else it is asked for.
            node.declare_parameter(name, stored.type_, _descriptor(parameter), ignore_override=True)
            Node.set_parameters(node, [stored])
        else:
            node.declare_parameter(name, stored.value, _descriptor(parameter), ignore_override=True)
        values[name] = value
    return values


def _given(node: Node, name: str) -> Any:
    """Return the value that was given for a parameter, of any type; None without."""
    overrides = getattr(node, "_parameter_overrides", None)
    if isinstance(overrides, dict):
        return overrides[name].value if name in overrides else None
    # Another rclpy: declared without a type, at three times the cost.
    node.declare_parameter(name, None, ParameterDescriptor(dynamic_typing=True))
    value = node.get_parameter(name).value
    node.undeclare_parameter(name)
    return value


def fix(node: Node, parameters: Iterable[Parameter], *, fixed: bool) -> None:
    """Have ``ros2 param describe`` say whether parameters keep their values now."""
    for parameter in parameters:
        # Node.set_descriptor never makes a parameter writable again.
        node.describe_parameter(parameter.name).read_only = fixed


def typed(
    parameters: Mapping[str, Parameter], changes: Iterable[RosParameter]
) -> list[RosParameter]:
    """Return what a user wants to set, in the types of the declarations; others as they are.

    So a whole number does for a real one (``ros2 param set /plant tick_rate 50``), and an empty
    list for any.

    Raises
    ------
    ParameterError
        A value is refused; the sentence names the parameter.
    """
    known = [(parameters.get(change.name), change) for change in changes]
    return [
        change if parameter is None else _ros_parameter(parameter, parameter.checked(change.value))
        for parameter, change in known
    ]


def _ros_parameter(parameter: Parameter, value: Value) -> RosParameter:
    kind = RosParameter.Type
    if isinstance(value, tuple):
        of_texts = parameter.texts
        return RosParameter(
            parameter.name, kind.STRING_ARRAY if of_texts else kind.DOUBLE_ARRAY, list(value)
        )
    return RosParameter(parameter.name, value=value)
