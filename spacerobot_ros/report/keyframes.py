"""Which recorded states an animation shows, so that fast motion does not become another motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spacerobot_ros.report.signals import Cycles, Indices, Signal, simplified

FULL_CYCLES = 3
"""Cycles at the beginning and at the end of a gait that are shown as they were."""

_MOST = 1000
_MOST_INSTANTS = 300
"""Instants of equal phase between the cycles that are shown in full."""


@dataclass(frozen=True)
class KeyFrames:
    """States to show: their ``indices``, ascending, with the first and the last of the recording.

    ``error``: how far, in tolerances, a state that is meant to be seen is from the line between
    the key frames around it. ``every``: between the cycles shown in full, one state is shown every
    so many cycles, always at the same phase; 0 where there are no such.
    """

    indices: Indices
    error: float
    every: int = 0


def key_frames(motion: Signal, cycles: Cycles | None) -> KeyFrames:
    """Choose at most a thousand key frames between which linear interpolation is good enough.

    Parameters
    ----------
    motion
        What is to be seen, (N, k), each column divided by its tolerance.
    cycles
        The equal cycles in it. Between the first and the last few of them, states of equal phase
        stand for the rest: sampled anyhow, fast loops would look like slow ones.
    """
    shown, every = np.arange(len(motion)), 0
    if cycles is not None and cycles.count > 2 * FULL_CYCLES:
        start = cycles.start + FULL_CYCLES * cycles.period
        count = cycles.count - 2 * FULL_CYCLES
        end = start + count * cycles.period
        every = max(1, -(-count // _MOST_INSTANTS))
        instants = start + cycles.period * np.arange(0, count + 1, every)
        full = (motion.time <= start) | (motion.time >= end - 1e-9)
        places = np.searchsorted(motion.time, instants - 1e-9)
        shown = np.union1d(np.flatnonzero(full), np.minimum(places, len(motion) - 1))
    chosen, error = simplified(Signal(motion.time[shown], motion.values[shown]), _MOST)
    return KeyFrames(shown[chosen], error, every)
