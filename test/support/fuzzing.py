"""Inputs that nobody would send, how many of them are tried, and what must come of each."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable
from functools import wraps
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import SpaceRobotError

LONG = os.environ.get("SPACEROBOT_FUZZ") == "long"
"""Whether this is the long run, `make fuzz`, of more than ten thousand inputs."""

TRIED: Counter[str] = Counter()
"""How many inputs were tried in this process, by kind."""

SENTENCES: Counter[str] = Counter()
"""How many of them were refused, by kind."""

FINITE = st.floats(allow_nan=False, allow_infinity=False)
MODEST = st.floats(-10.0, 10.0)
EXTREME = st.sampled_from(
    [math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, -1e-310, 1e308, -1.7e308, 1e-12, 1e12, -1.0]
)
NUMBERS = st.one_of(MODEST, EXTREME, st.floats())
"""What a message or a program may hold in a float64."""

TEXTS = st.one_of(
    st.sampled_from(
        ["", "x", "nan", "world", "base_link", "../..", "a b", "é", "\U0001f680", "-1"]
    ),
    st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12),
)
"""What a message may hold in a string: Unicode without zero bytes."""

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    NUMBERS,
    TEXTS,
    st.sampled_from([0, 1, -1, 7, 2**31, -(2**63), 2**63 - 1, 10**30, 10**400]),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(st.lists(inner, max_size=7), st.dictionaries(TEXTS, inner, max_size=3)),
    max_leaves=8,
)
"""What YAML or JSON may hold."""


def fuzz(
    kind: str, *strategies: Any, fast: int, long: int, **named: Any
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a test inputs, the same in every run, and count them as of one kind.

    Arguments are those of :func:`hypothesis.given`; ``fast`` inputs are tried with all tests,
    ``long`` in the long run.
    """

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        @wraps(test)
        def counted(*arguments: Any, **options: Any) -> None:
            TRIED[kind] += 1
            test(*arguments, **options)

        profile: Any = settings(
            max_examples=long if LONG else fast,
            derandomize=True,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        )
        give: Any = given(*strategies, **named)
        decorated: Callable[..., None] = profile(give(counted))
        return decorated

    return decorate


def attempt(kind: str, function: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Return what a function makes of an input, or None if it is refused with one sentence.

    Any other exception than a :class:`SpaceRobotError` is a bug, and passes.
    """
    try:
        return function(*arguments, **options)
    except SpaceRobotError as error:
        sentence = str(error)
    SENTENCES[kind] += 1
    assert_one_sentence(sentence)
    assert len(sentence) > 20, sentence
    return None


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """Return some bytes cut, with flipped, inserted or missing bytes, or none of them left."""
    kind = draw(st.sampled_from(["flip", "flip", "cut", "insert", "remove", "noise"]))
    if kind == "noise":
        return draw(st.binary(max_size=200))
    if kind == "cut":
        return whole[: draw(st.integers(0, len(whole)))]
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(len(data) - 1, 0)))
        if kind == "flip" and data:
            data[place] = draw(st.one_of(st.integers(0, 255), st.sampled_from([0, 1, 127, 255])))
        elif kind == "insert":
            data[place:place] = draw(st.binary(min_size=1, max_size=8))
        else:
            del data[place : place + draw(st.integers(1, 8))]
    return bytes(data)
