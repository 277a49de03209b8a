"""Parameters, which are declared once, as configuration fields, and are checked on input.

A configuration is a frozen dataclass whose fields are created by :func:`parameter`, :func:`group`
and :func:`registered`. Everything else is derived from the configuration: ROS parameters, input
checks on the command line and in :func:`spacerobot_ros.plan`, and the tables in the documentation.
"""

from __future__ import annotations

import math
import reprlib
import sys
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError, SpaceRobotError

Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]
"""Type of a parameter's value."""

C = TypeVar("C")
V = TypeVar("V")

_OF_EVERY_NODE = ("autostart", "start_type_description_service", "use_sim_time")
_GROUP_OF_EVERY_NODE = "qos_overrides."


def is_of_every_node(name: str) -> bool:
    """Whether a parameter is common to all nodes rather than part of a node's configuration.

    rclpy declares such parameters, and they appear in `ros2 param dump` and in bags; this package
    adds ``autostart``. Such parameters are irrelevant to a flight.
    """
    return name in _OF_EVERY_NODE or name.startswith(_GROUP_OF_EVERY_NODE)


def as_numbers(
    given: Any, name: str, error: type[SpaceRobotError] = ParameterError
) -> npt.NDArray[np.float64]:
    """Return given numbers as an array of any shape.

    Raises
    ------
    SpaceRobotError
        The values are not real numbers. The exception has type ``error``, and its message begins
        with ``name``.
    """
    try:
        numbers = np.asarray(given)
        if numbers.dtype.kind == "c":
            raise TypeError
        return numbers.astype(float)
    except (TypeError, ValueError, OverflowError):
        raise error(f"{name} {given!r} is not a list of numbers.") from None


_PARAMETER, _GROUP, _REGISTERED = "parameter", "group", "registered"
"""Metadata keys of dataclass fields, one for each function that creates a field."""


@dataclass(frozen=True)
class Parameter:
    """The declaration of one parameter; the type of ``default`` is the parameter type.

    Attributes
    ----------
    name
        Full name, including its groups: ``sensors.joint_noise``.
    default
        Value that is used if the parameter is not set.
    unit, description
        SI unit and a short description for the user.
    minimum, maximum
        Bounds on a number, or on every array entry.
    choices
        Allowed strings; empty: any string.
    length
        Length of a non-empty array; None: any length.
    read_only
        Whether the value is fixed while the node is configured.
    texts
        Whether the array consists of strings; a single string with entries separated by line breaks
        or semicolons is also accepted.
    of_joints
        Whether the array has one entry per joint, or the string is a list of joints.
    by_name
        Whether such an array may be given for only some joints, by name, as a mapping or as
        strings ``NAME:VALUE``. In that case, the value consists of such strings.
    """

    name: str
    default: Value
    unit: str = ""
    description: str = ""
    minimum: float = -math.inf
    maximum: float = math.inf
    choices: Collection[str] = ()
    length: int | None = None
    read_only: bool = True
    texts: bool = False
    of_joints: bool = False
    by_name: bool = False

    def checked(self, value: Any) -> Value:
        """Return a value converted to the parameter's type.

        Raises
        ------
        ParameterError
            The value has another type, is out of range, or is not one of the choices.
        """
        default = self.default
        if isinstance(default, bool):
            if not isinstance(value, bool):
                raise self._refusal(value, "true or false")
            return value
        if isinstance(default, (int, float)):
            return self._check_number(value, isinstance(default, int))
        if isinstance(default, str):
            if not isinstance(value, str):
                raise self._refusal(value, "a text")
            if "\0" in value:
                raise self._refusal(value.replace("\0", "\\0"), "a string without NUL characters")
            if self.excludes(value):
                raise self._refusal(value, f"one of {', '.join(self.choices)}")
            return value
        if not self.texts:
            return self._check_numbers(value)
        lines = value.replace("\n", ";").split(";") if isinstance(value, str) else value
        if not isinstance(lines, Sequence) or not all(isinstance(line, str) for line in lines):
            raise self._refusal(lines, "a list of texts")
        return tuple(line.strip() for line in lines if line.strip())

    def excludes(self, text: str) -> bool:
        """Whether there are choices and the string is not one of them."""
        return bool(self.choices) and text not in self.choices

    def _check_number(self, value: Any, whole: bool) -> int | float:
        if isinstance(value, bool) or not isinstance(value, (int, float, np.integer, np.floating)):
            raise self._refusal(value, "a number")
        if isinstance(value, np.generic):
            value = value.item()  # Numbers of 32 bits would overflow in the next line.
        if not -sys.float_info.max <= value <= sys.float_info.max:  # An int may be larger.
            raise self._refusal(value, "a finite number")
        if whole and value != int(value):
            raise self._refusal(value, "a whole number")
        if whole and not -(2**63) <= value < 2**63:  # ROS parameters have 64 bits.
            raise self._refusal(float(value), "a 64-bit integer")
        if not self.minimum <= value <= self.maximum:
            raise self._refusal(value, f"a number{self._range_text()}")
        if not whole and not _is_moderate(value):
            raise self._refusal(value, _MODERATE)
        return int(value) if whole else float(value)

    def _check_numbers(self, value: Any) -> tuple[float, ...] | tuple[str, ...]:
        named = _named_entries(value) if self.by_name else None
        if named is not None:
            numbers = replace(self, by_name=False)._check_numbers(list(named.values()))
            return tuple(f"{name}:{x!r}" for name, x in zip(named, numbers, strict=True))
        try:
            numbers = tuple(float(x) for x in value)
        except (TypeError, ValueError, OverflowError):
            by_name = ", or of strings NAME:VALUE with joint names" if self.by_name else ""
            raise self._refusal(value, f"a list of numbers{by_name}") from None
        if self.length is not None and len(numbers) not in (0, self.length):
            raise self._refusal(value, f"a list of {self.length} numbers")
        if not all(math.isfinite(x) and self.minimum <= x <= self.maximum for x in numbers):
            raise self._refusal(value, f"finite numbers{self._range_text()}")
        if not all(map(_is_moderate, numbers)):
            raise self._refusal(value, _MODERATE)
        return numbers

    def _range_text(self) -> str:
        if math.isinf(self.maximum):
            return "" if math.isinf(self.minimum) else f" of at least {self.minimum:g}"
        return f" from {self.minimum:g} to {self.maximum:g}"

    def _refusal(self, value: Any, expected: str) -> ParameterError:
        unit = f" ({self.unit})" if self.unit else ""
        plain = value.tolist() if isinstance(value, array) else value
        shown = f"'{value[:60]}'" if isinstance(value, str) else reprlib.repr(plain)
        return ParameterError(f"Parameter '{self.name}' is {shown}; it must be {expected}{unit}.")


_SMALLEST, _LARGEST = 1e-100, 1e100
_MODERATE = f"0 or from {_SMALLEST:g} to {_LARGEST:g} in magnitude"


def _is_moderate(number: float) -> bool:
    """Whether the square of a number, and its products with others, are finite and nonzero."""
    return number == 0 or _SMALLEST <= abs(number) <= _LARGEST


def _named_entries(value: Any) -> dict[str, Any] | None:
    """Return the values of a mapping or of strings ``NAME:VALUE`` by name; otherwise None."""
    if isinstance(value, Mapping):
        return {str(name): entry for name, entry in value.items()}
    if isinstance(value, str):
        value = value.replace(";", " ").split()
    if not isinstance(value, Sequence) or not value:
        return None
    if not all(isinstance(entry, str) and ":" in entry for entry in value):
        return None
    pairs = [entry.rpartition(":") for entry in value]
    named = {name.strip(): number for name, _, number in pairs}
    return named if len(named) == len(pairs) else None


def parameter(default: Value, description: str, unit: str = "", **attributes: Any) -> Any:
    """Return a field of a configuration; ``attributes`` are additional attributes
    of :class:`Parameter`."""
    declaration = Parameter("", default, unit, description, **attributes)
    return field(default=default, metadata={_PARAMETER: declaration})


def nonnegative(default: Value, description: str, unit: str = "", **attributes: Any) -> Any:
    """Return a :func:`parameter` whose value is, or whose entries are, at least 0."""
    return parameter(default, description, unit, minimum=0.0, **attributes)


def for_each_joint(description: str, unit: str, maximum: float = 1e9) -> Any:
    """Return a :func:`nonnegative` array with one entry per joint, also accepted by joint name."""
    return nonnegative((), description, unit, maximum=maximum, of_joints=True, by_name=True)


def group(default: Any) -> Any:
    """Return a field that contains a configuration: its parameters are ``<field>.<parameter>``.

    ``default`` is an instance whose values are the group's defaults.
    """
    return field(default=default, metadata={_GROUP: True})


def registered(registry: Mapping[str, Any]) -> Any:
    """Return a field that maps each name of a registry to the options of its entry.

    Every entry has a configuration ``Options``, whose parameters are ``<entry>.<parameter>``.
    """
    return field(
        default_factory=lambda: {name: entry.Options() for name, entry in registry.items()},
        metadata={_REGISTERED: registry},
    )


def declared(config: type[Any] | Any) -> tuple[Parameter, ...]:
    """Return the parameters of a configuration, in declaration order.

    ``config`` is the class, or an instance whose values are the defaults.
    """
    if isinstance(config, type):
        # Users may extend the registries of a configuration.
        defaults = config()
        registered_options = tuple(
            (entry, type(options))
            for each in fields(defaults)
            if _REGISTERED in each.metadata
            for entry, options in getattr(defaults, each.name).items()
        )
        return _declared_in_class(config, registered_options)
    return tuple(
        replace(declaration, name=name, default=value)
        for name, declaration, value in _parameters_with_values(config)
    )


@cache
def _declared_in_class(
    config: type[Any], registered_options: tuple[tuple[str, type[Any]], ...]
) -> tuple[Parameter, ...]:
    return declared(config())


def configured(kind: type[C], values: Mapping[str, Any]) -> C:
    """Return a configuration with these ``values``, given by full name; omitted parameters keep
    their defaults.

    Values with other names are ignored; see :func:`require_known`.

    Raises
    ------
    ParameterError
        A value is invalid; the message names the parameter.
    """
    return _configured(kind(), values, "")


def values_of(config: Any) -> dict[str, Value]:
    """Return the value of every parameter of a configuration by full name."""
    return {name: value for name, _, value in _parameters_with_values(config)}


def known_values(kind: type[Any], values: Mapping[str, V]) -> dict[str, V]:
    """Return the values whose names are parameters of a configuration."""
    known = {parameter.name for parameter in declared(kind)}
    return {name: value for name, value in values.items() if name in known}


def require_names(none: str, given: Iterable[str], known: Collection[str]) -> None:
    """For an unknown name, raise a ParameterError whose message begins with ``none``."""
    for name in given:
        if name not in known:
            raise ParameterError(f"{none} '{name}'; it has {', '.join(known) or 'none'}.")


def require_known(owner: str, config: type[Any], names: Iterable[str]) -> None:
    """Raise an error for names that are not parameters of a configuration.

    Raises
    ------
    ParameterError
        A name is unknown; the error message states which options ``owner`` has.
    """
    known = [parameter.name for parameter in declared(config)]
    require_names(f"{owner} has no option", sorted(names), known)


def _configured(defaults: Any, values: Mapping[str, Any], prefix: str) -> Any:
    chosen: dict[str, Any] = {}
    # Few of many fields change; the first words after the prefix show which.
    words = {name[len(prefix) :].partition(".")[0] for name in values if name.startswith(prefix)}
    for each in fields(defaults) if words else ():
        name, default = f"{prefix}{each.name}", getattr(defaults, each.name)
        if _PARAMETER in each.metadata:
            if name in values:
                declaration = replace(each.metadata[_PARAMETER], name=name, default=default)
                chosen[each.name] = declaration.checked(values[name])
        elif _GROUP in each.metadata and each.name in words:
            chosen[each.name] = _configured(default, values, f"{name}.")
        elif _REGISTERED in each.metadata:
            chosen[each.name] = {
                entry: _configured(options, values, f"{prefix}{entry}.")
                for entry, options in default.items()
            }
    return replace(defaults, **chosen) if chosen else defaults


def _parameters_with_values(config: Any) -> Iterator[tuple[str, Parameter, Value]]:
    for each in fields(config):
        value = getattr(config, each.name)
        if _PARAMETER in each.metadata:
            yield each.name, each.metadata[_PARAMETER], value
            continue
        groups = {each.name: value} if _GROUP in each.metadata else {}
        for prefix, part in (value if _REGISTERED in each.metadata else groups).items():
            for name, declaration, inner in _parameters_with_values(part):
                yield f"{prefix}.{name}", declaration, inner


@dataclass(frozen=True)
class WatchdogConfig:
    """Supervision of other nodes' heartbeats."""

    watchdog_timeout: float = nonnegative(
        0.8,
        "wall time without a heartbeat after which a required node is considered silent; 0: never",
        "s",
    )
