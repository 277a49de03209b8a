"""Parameters of a configuration as ROS parameters of a node."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence

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
        read_only=parameter.read_only,
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
        # First without a type, to see what was given whatever its type; then as it should be.
        node.declare_parameter(name, None, ParameterDescriptor(dynamic_typing=True))
        given = node.get_parameter(name).value
        node.undeclare_parameter(name)
        value = parameter.default if given is None else parameter.checked(given)
        stored = list(value) if isinstance(value, tuple) else value
        if value == ():
            # rclpy cannot tell the type of an empty list: declare the type and leave it unset.
            kind = RosParameter.Type
            stored = kind.STRING_ARRAY if parameter.texts else kind.DOUBLE_ARRAY
        node.declare_parameter(name, stored, _descriptor(parameter), ignore_override=True)
        values[name] = value
    return values
