"""Messages of any type with random values in every field."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from rosidl_parser.definition import (
    AbstractGenericString,
    AbstractSequence,
    Array,
    BasicType,
    NamespacedType,
)

TEXTS = ("", "a", "base_link", "µ", "slider_1 ", "Δq > 1 m")

few = settings(
    derandomize=True,
    deadline=None,
    max_examples=25,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


def random_number(rng: np.random.Generator, typename: str) -> Any:
    if typename == "boolean":
        return bool(rng.integers(2))
    if typename == "octet":
        return rng.bytes(1)
    if typename == "float":
        return float(np.float32(rng.normal()))
    if typename == "double":
        return float(rng.normal() * 10.0 ** rng.integers(-300, 300))
    limits = np.iinfo(typename)
    return int(rng.integers(limits.min, limits.max, endpoint=True, dtype=limits.dtype))


def random_field(draw: Any, rng: np.random.Generator, kind: Any, default: Any) -> Any:
    """Return a random value of a field of a type; what has a length is for hypothesis to choose."""
    if isinstance(kind, BasicType):
        return random_number(rng, kind.typename)
    if isinstance(kind, AbstractGenericString):
        return draw(st.sampled_from(TEXTS))
    if isinstance(kind, NamespacedType):
        return random_message(draw, rng, type(default))
    assert isinstance(kind, (AbstractSequence, Array))
    if isinstance(kind, Array):
        return np.array([random_field(draw, rng, kind.value_type, None) for _ in range(kind.size)])
    count = draw(st.integers(0, 3))
    inner = kind.value_type
    if not isinstance(inner, NamespacedType):
        return [random_field(draw, rng, inner, None) for _ in range(count)]
    element = getattr(import_module(".".join(inner.namespaces)), inner.name)
    return [random_message(draw, rng, element) for _ in range(count)]


def random_message(draw: Any, rng: np.random.Generator, message_type: Any) -> Any:
    """Return a message with a random value in every field."""
    message = message_type()
    for name, kind in zip(
        message.get_fields_and_field_types(), message_type.SLOT_TYPES, strict=True
    ):
        setattr(message, name, random_field(draw, rng, kind, getattr(message, name)))
    return message


@st.composite
def messages(draw: Any, message_type: Any) -> Any:
    return random_message(draw, np.random.default_rng(draw(st.integers(0, 999))), message_type)
