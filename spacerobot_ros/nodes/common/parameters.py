"""Declared parameters: type, range, unit and meaning; a bad one is refused with a sentence."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from spacerobot_ros.errors import ParameterError

Value = bool | int | float | str | list[float] | list[str]


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter of a node; the type of ``default`` is the type of the parameter.

    ``choices`` limits a string, ``minimum`` and ``maximum`` a number, ``length`` an array (None:
    any). ``live`` ones may change while the node runs. ``texts``: an array of texts, also taken as
    one text whose parts stand on lines of their own or between semicolons.
    """

    name: str
    default: Value
    unit: str
    meaning: str
    minimum: float = -math.inf
    maximum: float = math.inf
    choices: Sequence[str] = ()
    length: int | None = None
    live: bool = False
    texts: bool = False

    def descriptor(self) -> ParameterDescriptor:
        """Return what ``ros2 param describe`` shows."""
        unit = f" [{self.unit}]" if self.unit else ""
        descriptor = ParameterDescriptor(
            name=self.name,
            description=f"{self.meaning}{unit}",
            read_only=not self.live,
            additional_constraints=f"one of: {', '.join(self.choices)}" if self.choices else "",
        )
        bounds = max(self.minimum, -1e300), min(self.maximum, 1e300)
        if bounds != (-1e300, 1e300):
            if isinstance(self.default, float):
                descriptor.floating_point_range = [
                    FloatingPointRange(from_value=float(bounds[0]), to_value=float(bounds[1]))
                ]
            elif isinstance(self.default, int) and not isinstance(self.default, bool):
                low, high = (int(max(min(b, 2**62), -(2**62))) for b in bounds)
                descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
        return descriptor

    def checked(self, value: Any) -> Value:
        """Return the value in the parameter's own type.

        Raises
        ------
        ParameterError
            It has another type, is out of range, or is not one of the choices.
        """
        wanted = self.default
        if isinstance(wanted, bool):
            if not isinstance(value, bool):
                raise self._refusal(value, "true or false")
            return value
        if isinstance(wanted, (int, float)):
            return self._number(value, isinstance(wanted, int))
        if isinstance(wanted, str):
            if not isinstance(value, str):
                raise self._refusal(value, "a text")
            if self.choices and value not in self.choices:
                raise self._refusal(value, f"one of {', '.join(self.choices)}")
            return value
        if self.texts:
            return self._lines(value)
        try:
            numbers = [float(x) for x in value]
        except (TypeError, ValueError, OverflowError):
            raise self._refusal(value, "a list of numbers") from None
        if self.length is not None and len(numbers) not in (0, self.length):
            raise self._refusal(value, f"a list of {self.length} numbers")
        if not all(math.isfinite(x) and self.minimum <= x <= self.maximum for x in numbers):
            raise self._refusal(value, f"finite numbers{self._range()}")
        return numbers

    def _lines(self, value: Any) -> list[str]:
        if isinstance(value, str):
            value = value.replace("\n", ";").split(";")
        if not isinstance(value, Sequence) or not all(isinstance(line, str) for line in value):
            raise self._refusal(value, "a list of texts")
        return [line.strip() for line in value if line.strip()]

    def _number(self, value: Any, whole: bool) -> int | float:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self._refusal(value, "a number")
        if not -sys.float_info.max <= value <= sys.float_info.max:  # Whole numbers are larger.
            raise self._refusal(value, "a finite number")
        if whole and value != int(value):
            raise self._refusal(value, "a whole number")
        if not self.minimum <= value <= self.maximum:
            raise self._refusal(value, f"a number{self._range()}")
        return int(value) if whole else float(value)

    def _range(self) -> str:
        if math.isinf(self.maximum):
            return "" if math.isinf(self.minimum) else f" of at least {self.minimum:g}"
        return f" from {self.minimum:g} to {self.maximum:g}"

    def _refusal(self, value: Any, wanted: str) -> ParameterError:
        unit = f" ({self.unit})" if self.unit else ""
        shown = value if not isinstance(value, str) else f"'{value[:60]}'"
        return ParameterError(f"Parameter '{self.name}' is {shown}; it must be {wanted}{unit}.")


class _Optioned(Protocol):
    """A method or a law: its options have the fields of a :class:`ParameterSpec`."""

    options: ClassVar[tuple[Any, ...]]


def option_specs(registry: Mapping[str, type[_Optioned]]) -> tuple[ParameterSpec, ...]:
    """Return the parameters ``<name>.<option>`` of everything in a registry."""
    specs = []
    for name, entry in registry.items():
        for option in entry.options:
            specs.append(
                ParameterSpec(
                    f"{name}.{option.name}",
                    option.default,
                    option.unit,
                    option.meaning,
                    option.minimum,
                    option.maximum,
                )
            )
    return tuple(specs)


def declare(node: Node, specs: Sequence[ParameterSpec]) -> dict[str, Value]:
    """Declare parameters on a node and return their checked values.

    A whole number is accepted where a real one is wanted (``rate: 20``).

    Raises
    ------
    ParameterError
        A given value is refused; the sentence names the parameter.
    """
    values = {}
    for spec in specs:
        # First without a type, to see what was given whatever its type; then as it should be.
        node.declare_parameter(spec.name, None, ParameterDescriptor(dynamic_typing=True))
        given = node.get_parameter(spec.name).value
        node.undeclare_parameter(spec.name)
        value = spec.default if given is None else spec.checked(given)
        # rclpy cannot tell the type of an empty list: declare the type and leave it unset.
        empty = Parameter.Type.STRING_ARRAY if spec.texts else Parameter.Type.DOUBLE_ARRAY
        stored = empty if value == [] else value
        node.declare_parameter(spec.name, stored, spec.descriptor(), ignore_override=True)
        values[spec.name] = value
    return values


def check_changes(specs: Sequence[ParameterSpec], changes: Sequence[Parameter]) -> str:
    """Return why a change while running is refused, or an empty text."""
    by_name = {spec.name: spec for spec in specs}
    for change in changes:
        if change.name in by_name:
            try:
                by_name[change.name].checked(change.value)
            except ParameterError as error:
                return str(error)
    return ""
