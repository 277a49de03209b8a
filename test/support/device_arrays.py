"""Arrays that are kept apart from NumPy's as those of CuPy are, on a machine without a device.

NumPy's functions work on them and return such arrays (as CuPy has it by the protocols
``__array_ufunc__`` and ``__array_function__``); what would copy between host and device by itself
raises TypeError.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from spacerobot_ros.batch.targets import THREADS_OF_HOST, Target


def _inner(value: Any, *, foreign: bool = False) -> Any:
    """Return what NumPy computes with; arrays of NumPy are refused unless ``foreign``."""
    if isinstance(value, DeviceArray):
        return value.numbers
    if isinstance(value, np.ndarray) and not foreign:
        raise TypeError("an array of NumPy among arrays of a device")
    if isinstance(value, list | tuple):
        return type(value)([_inner(each, foreign=foreign) for each in value])
    return value


def _outer(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return DeviceArray(np.asarray(value))
    if isinstance(value, list | tuple):
        return type(value)([_outer(each) for each in value])
    return value


class DeviceArray(NDArrayOperatorsMixin):
    """An array of a device that is none."""

    def __init__(self, numbers: Any) -> None:
        self.numbers = numbers

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError("Implicit conversion to a NumPy array is not allowed.")

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **named: Any) -> Any:
        to = named.pop("out", None)
        if to is not None:
            named["out"] = tuple(_inner(each) for each in to)
        result = getattr(ufunc, method)(*map(_inner, inputs), **named)
        return _outer(result) if to is None else to[0]

    def __array_function__(self, function: Any, types: Any, inputs: Any, named: Any) -> Any:
        foreign = function is np.asarray  # With like=: a copy to the device.
        given = [_inner(each, foreign=foreign) for each in inputs]
        return _outer(function(*given, **{name: _inner(x) for name, x in named.items()}))

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.numbers, name)
        if not callable(found) or isinstance(found, type):
            return _outer(found) if isinstance(found, np.ndarray) else found

        def method(*inputs: Any, **named: Any) -> Any:
            return _outer(found(*map(_inner, inputs), **named))

        return found if name in ("tolist", "item") else method

    def __len__(self) -> int:
        return len(self.numbers)

    def __bool__(self) -> bool:
        return bool(self.numbers)

    def __iter__(self) -> Any:
        return iter([_outer(each) for each in self.numbers])

    def __getitem__(self, at: Any) -> Any:
        return _outer(self.numbers[_inner(at)])

    def __setitem__(self, at: Any, value: Any) -> None:
        self.numbers[_inner(at)] = _inner(value)


class _Generator:
    def __init__(self, seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def __getattr__(self, name: str) -> Any:
        return lambda *inputs, **named: _outer(getattr(self._rng, name)(*inputs, **named))


class _Random:
    default_rng = _Generator


class _Arrays:
    """The module of these arrays; functions of CuPy's take arrays of NumPy only to copy them."""

    random = _Random

    def __getattr__(self, name: str) -> Any:
        function = getattr(np, name)

        def of_device(*inputs: Any, **named: Any) -> Any:
            foreign = name in ("asarray", "array")
            given = [_inner(each, foreign=foreign) for each in inputs]
            return _outer(function(*given, **{key: _inner(x) for key, x in named.items()}))

        return of_device


@dataclass(frozen=True)
class KeptApart(Target):
    """The program of a device on this processor, with such arrays."""

    @classmethod
    def of_host(cls) -> KeptApart:
        """Return it."""
        return cls(**{x.name: getattr(THREADS_OF_HOST, x.name) for x in fields(Target)})

    @property
    def arrays(self) -> Any:
        return _Arrays()

    def zeros(self, shape: tuple[int, ...]) -> Any:
        return DeviceArray(super().zeros(shape))

    def address(self, array: Any) -> int:
        return super().address(array.numbers)

    def to_numpy(self, array: Any) -> Any:
        return array.numbers
