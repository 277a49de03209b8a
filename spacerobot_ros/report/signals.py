"""Arithmetic on recorded time series: fewer samples, continuous attitude, repeated cycles."""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spacerobot_ros.flight.series import Signal
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.rotations import rotvecs_from_quaternions

Indices = npt.NDArray[np.int64]

_MIN_CYCLES = 12
_INITIAL_STRETCHES = 64
"""Number of parts into which a recording is split before simplification, to limit the computing
time."""

_MAX_PERIOD_SAMPLES = 1 << 14
"""Number of samples at the end of a gait that are searched for a period."""


@dataclass(frozen=True)
class Cycles:
    """A segment of a flight, ``start`` to ``end`` in s, that repeats every ``period`` s."""

    start: float
    end: float
    period: float

    @property
    def count(self) -> int:
        """Number of whole cycles."""
        return int((self.end - self.start) / self.period + 0.05)

    def last(self, count: int) -> tuple[float, float]:
        """Return the start and end of the last few cycles."""
        return self.end - count * self.period, self.end


def thinned(signal: Signal, slices: int) -> Signal:
    """Return the samples with the smallest and the largest value of a trace in a time slice, and
    the first and last sample.

    Lines through them cover the same pixels as those through all samples if a slice is as wide as a
    pixel (Jugel et al., "M4: a visualization-oriented time series data aggregation", VLDB 2014).
    """
    if len(signal) <= 4 * slices:
        return signal
    gaps = np.flatnonzero(np.isnan(signal.values).any(axis=1))
    edges = np.linspace(0, len(signal), slices + 1).astype(int)
    edges = np.unique(np.concatenate([edges, gaps, gaps + 1]))
    kept = [edges[:-1], edges[1:] - 1]
    for a, b in itertools.pairwise(edges.tolist()):
        part = signal.values[a:b]
        kept += [a + part.argmin(axis=0), a + part.argmax(axis=0)]
    rows = np.unique(np.concatenate(kept))
    return Signal(signal.time[rows], signal.values[rows])


def simplified(motion: Signal, most: int) -> tuple[Indices, float]:
    """Drop samples that lie on lines between other samples (Douglas-Peucker); the samples farthest
    from such lines are kept first.

    Parameters
    ----------
    motion
        The motion, with each column divided by its tolerance.
    most
        Largest number of samples to keep, in addition to a few dozen that are always kept.

    Returns
    -------
    The kept samples, and the largest distance of a dropped sample, in tolerances.
    """
    bounds = np.unique(np.linspace(0, len(motion) - 1, _INITIAL_STRETCHES + 1).astype(int)).tolist()
    if len(bounds) < 2:
        return np.array(bounds, np.int64), 0.0
    kept = set(bounds)
    heap = [_farthest_sample(motion, a, b) for a, b in itertools.pairwise(bounds)]
    heapq.heapify(heap)
    while -heap[0][0] > 1.0 and len(kept) < most:
        _, a, b, k = heapq.heappop(heap)
        kept.add(k)
        heapq.heappush(heap, _farthest_sample(motion, a, k))
        heapq.heappush(heap, _farthest_sample(motion, k, b))
    return np.array(sorted(kept), np.int64), -heap[0][0]


def _farthest_sample(motion: Signal, a: int, b: int) -> tuple[float, int, int, int]:
    """The negative largest distance from the line between samples a and b, a, b, and its sample."""
    if b - a < 2:
        return 0.0, a, b, a
    time, values = motion.time[a : b + 1], motion.values[a : b + 1]
    span = float(time[-1] - time[0])  # Negative if a plant was restarted.
    share: Array = ((time - time[0]) / (span if abs(span) > 1e-12 else np.inf))[:, np.newaxis]
    off = np.abs(values - values[0] - share * (values[-1] - values[0])).max(axis=1, initial=0.0)
    k = 1 + int(np.argmax(off[1:-1]))
    return -float(off[k]), a, b, a + k


def rotvecs(quaternions: Array) -> Array:
    """Return attitudes (N, 4) as rotation vectors (N, 3), continuous beyond half revolutions.

    The first vector has a length of at most pi; each later vector is the equivalent vector nearest
    to the previous vector.
    """
    wrapped = rotvecs_from_quaternions(quaternions)
    lengths = np.linalg.norm(wrapped, axis=1)
    # The axis flips at half revolutions and at zero, where the angle about it changes sign.
    turned_over = np.einsum("ij,ij->i", wrapped[1:], wrapped[:-1]) < 0
    signs = np.append(1, np.cumprod(1 - 2 * turned_over))[: len(wrapped)]
    added = signs * np.unwrap(signs * lengths) - lengths
    return wrapped + added[:, np.newaxis] * wrapped / np.maximum(lengths, 1e-12)[:, np.newaxis]


def nearest_rotvec(rotvec: Array, near: Array) -> Array:
    """Return the rotation vector (3,) of the same attitude that is nearest to ``near`` (3,)."""
    length = float(np.linalg.norm(rotvec))
    if length < 1e-12:
        return rotvec
    turns = round((float(near @ rotvec) / length - length) / (2 * np.pi))
    return rotvec * (1 + 2 * np.pi * turns / length)


def continuous(poses: Array) -> Array:
    """Return poses (N, 7) with sign-continuous quaternions."""
    flips = np.cumsum((poses[1:, 3:] * poses[:-1, 3:]).sum(axis=1) < 0) % 2
    signs = np.append(1, 1 - 2 * flips)[: len(poses), np.newaxis]
    return np.hstack([poses[:, :3], poses[:, 3:] * signs])


def link_poses(robot: RobotDescription, base: Array, q: Array) -> dict[str, Array]:
    """Return the world poses (K, 7) of all links, with the base link first.

    Link quaternions are continuous if the base quaternions are.

    Parameters
    ----------
    robot
        The robot.
    base, q
        (K, 7) base poses in the world, and (K, n) joint positions, m or rad.
    """
    from scipy.spatial.transform import Rotation

    kinematics = ForwardKinematics(robot)
    R_WL, r_WL = kinematics.poses_in_world(base, q)
    attitudes = Rotation.from_matrix(R_WL.reshape(-1, 3, 3)).as_quat().reshape(*r_WL.shape[:2], 4)
    poses = np.concatenate([r_WL, attitudes], axis=2)
    return {link: continuous(poses[:, k]) for k, link in enumerate(kinematics.links)}


def find_cycles(rates: Signal) -> Cycles | None:
    """Return the equal cycles at the end of a gait, detected from its joint velocities.

    None if there are fewer than twelve cycles that agree to within a tenth of the peak velocity.
    """
    peak = np.abs(rates.values).max(axis=0, initial=0.0)
    moving = np.flatnonzero((np.abs(rates.values) > 1e-6 * peak).any(axis=1))
    if len(moving) < 4 * _MIN_CYCLES:
        return None
    values = rates.values[: int(moving[-1]) + 1] / np.where(peak > 0, peak, 1.0)
    # The cycles may be preceded by a large part of the gait.
    looks = (values[-min(_MAX_PERIOD_SAMPLES, len(values) // part) :] for part in (1, 2, 4))
    lag = next((lag for look in looks if (lag := _period_in_samples(look))), None)
    if lag is None:
        return None
    different = np.abs(values[lag:] - values[:-lag]).max(axis=1) > 0.1
    # The last stretch between differing samples that contains enough cycles.
    bounds = np.concatenate([[-1], np.flatnonzero(different), [len(different)]])
    enough = np.flatnonzero(np.diff(bounds) - 1 >= (_MIN_CYCLES - 1) * lag)
    if not len(enough):
        return None
    first, stop = int(bounds[enough[-1]]) + 1, int(bounds[enough[-1] + 1]) + lag
    last = min(stop, len(rates) - 1)
    start, end = float(rates.time[first]), float(rates.time[last])
    if end <= start:
        return None  # All messages have the same log time.
    return Cycles(start, end, lag * (end - start) / (last - first))


def _period_in_samples(values: Array) -> int | None:
    """Shortest shift, in samples, at which the columns match themselves; None if there is none."""
    n = len(values)
    spectrum = np.fft.rfft(values, 2 * n, axis=0)
    product = np.fft.irfft((spectrum * spectrum.conj()).sum(axis=1))[:n]
    energy = np.cumsum((values**2).sum(axis=1))
    # Energy of the overlapping parts: the first and the last n - lag samples.
    lags = np.arange(n // 3)
    first, last = energy[n - 1 - lags], energy[-1] - np.append(0.0, energy)[lags]
    match = product[lags] / np.maximum(np.sqrt(first * last), 1e-300)
    below = np.flatnonzero(match < 0.9)
    if not len(below):
        return None
    good = np.flatnonzero(match[below[0] :] > 0.97) + below[0]
    if not len(good):
        return None
    # The maximum of the first peak that is high enough.
    hill = np.split(good, np.flatnonzero(np.diff(good) > 1) + 1)[0]
    return int(hill[np.argmax(match[hill])])
