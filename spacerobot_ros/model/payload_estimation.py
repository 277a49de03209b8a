"""Estimates the ten inertial parameters of a held body from motion and momentum conservation.

The momentum of a body is linear in its parameters ``phi = [m, m c, I]`` (10,): mass, first moment
and moments of inertia about the origin of its frame L (Atkeson, An and Hollerbach, 1986). The
least-squares problem is described in docs/theory/capture.md. If columns of the regressor are
constant along a motion (such as a planar motion), that motion does not determine all parameters;
the undetermined parameters are reported. The estimated parameters are physically consistent: their
pseudo-inertia matrix is positive definite (Wensing, Kim and Slotine, 2018), which a Cholesky factor
with logarithms on the diagonal ensures (Rucker and Wensing, 2022). The sources are cited from
memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.fft import dct
from scipy.optimize import least_squares, minimize

from spacerobot_ros.model.description import Array, Inertia
from spacerobot_ros.model.grasp import BodyMotion, Payload
from spacerobot_ros.model.inertial_parameters import INERTIA_ENTRIES, symmetric_of_entries
from spacerobot_ros.model.rotations import hat

PAYLOAD_PARAMETERS = ("m", "m cx", "m cy", "m cz", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
"""Parameter names: kg, kg m, and kg m^2 about the origin of L."""

_SMALLEST_SINGULAR_VALUE = 1e-7
"""Smallest singular value, relative to the largest, at which a direction is considered determined
by the motion."""

_MIN_SIGNAL_TO_NOISE = 10.0
"""Smallest signal power, relative to the error power, at which a direction is considered
determined."""

_MIN_JERK_RATIO = 3.0
"""Second difference, relative to the median, above which it is attributed to jerk."""

_WALK_SHARES = np.append(0.0, np.geomspace(1e-6, 1e6, 73))
"""Tested power ratios of random walk to white noise."""

_ROUNDS = 4
"""Number of fits, alternating between the parameters and the scatter of the momenta."""

_MIN_UNDETERMINED_SHARE = 0.2
"""Fraction of a parameter in the undetermined directions above which the parameter is
undetermined."""

_ROUNDING = 1e-11
"""Smallest relative momentum error; impulses are sums over ticks."""

_PRIOR_WEIGHT = 1e-6
"""Prior weight of undetermined directions, relative to the largest singular value."""

_MAX_NOISE_DISTANCE = 1.0
"""Largest distance from a physical body that is attributed to noise, in standard deviations."""


@dataclass(frozen=True)
class PayloadEstimate:
    """Estimated parameters of a body held by a link, in the link frame.

    Attributes
    ----------
    link
        Name of the link.
    parameters
        (10,) of :data:`PAYLOAD_PARAMETERS`; a parameter that the motion does not determine is NaN.
    deviations
        (10,) standard deviations, estimated from the scatter of the momenta.
    directions
        (k, 10) orthonormal combinations of parameters that are not determined, with each parameter
        in units of the robot's mass and radius of gyration.
    corrected
        Whether the best fit was not physical, so that the nearest physical parameters are returned.
    """

    link: str
    parameters: Array
    deviations: Array
    directions: Array
    corrected: bool

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Names of the parameters that the motion does not determine."""
        pairs = zip(PAYLOAD_PARAMETERS, self.parameters, strict=True)
        return tuple(name for name, value in pairs if np.isnan(value))

    @property
    def payload(self) -> Payload | None:
        """The body; None if a parameter is not determined."""
        if self.undetermined:
            return None
        mass = float(self.parameters[0])
        com, about = self.parameters[1:4] / mass, symmetric_of_entries(self.parameters[4:])
        about_com = about - mass * (com @ com * np.eye(3) - np.outer(com, com))
        return Payload(self.link, Inertia(mass, com, about_com))


def momentum_regressor(motion: BodyMotion, about: Array) -> Array:
    """Return A (6, 10), which maps a body's parameters to its momenta.

    Parameters
    ----------
    motion
        Motion of the parameter frame L.
    about
        (3,) reference point of the angular momentum in W, m.
    """
    R = motion.R_WT
    v, omega = R.T @ motion.v, R.T @ motion.omega
    A = np.zeros((6, 10))
    A[:3, 0], A[:3, 1:4] = v, hat(omega)
    A[3:, 1:4] = -hat(v)
    for column, (i, j) in enumerate(INERTIA_ENTRIES, 4):
        A[3 + i, column] += omega[j]
        if i != j:
            A[3 + j, column] += omega[i]
    A[:3], A[3:] = R @ A[:3], R @ A[3:]
    A[3:] += hat(motion.r_WT - about) @ A[:3]
    return A


def estimate_payload(
    link: str, regressors: Array, known: Array, mass: float, radius: float
) -> PayloadEstimate:
    """Return the parameters of a held body, by errors-in-variables least squares.

    Errors in the measured velocities enter both sides of the equation; their covariance, from
    second differences, is subtracted from the normal equations (docs/theory/capture.md). Errors of
    successive states are not independent: impulse errors accumulate. In a cosine transform over
    time, the modes of white noise and of a random walk are independent; each mode is weighted by
    its inverse variance. The mean, which contains the unknown P_0, is omitted.

    Parameters
    ----------
    link
        Link that holds it.
    regressors
        (T, 3, 6, 10) from :func:`momentum_regressor` for T disjoint triples of successive states,
        equally spaced in time.
    known
        (T, 3, 6) robot momenta without the body, minus the impulse since the first state.
    mass, radius
        Mass (kg) and radius of gyration (m) of the robot, used as units to compare parameters.
    """
    unit = mass * np.array([1.0, *[radius] * 3, *[radius**2] * 6])
    rows = np.concatenate([regressors * unit, -known[..., np.newaxis]], axis=-1)
    modes = dct(rows.mean(axis=1), axis=0, norm="ortho")[1:]
    usual = _usual_differences(rows)
    # Covariances (6, 11, 11) of the errors in means of triples, by component.
    errors = np.einsum("tci,tcj->cij", usual, usual) / (3 * len(usual))
    rows = rows - rows.mean(axis=(0, 1))
    least = _ROUNDING * max(np.abs(known).max(initial=0.0), float(np.finfo(float).tiny))
    weights = np.array([1.0] * 3 + [1.0 / radius] * 3)
    for _ in range(2):
        # Linear and angular momenta scatter differently; the first fit shows by how much.
        fit = _fit(rows * weights[:, np.newaxis])
        left = rows[..., :10] @ fit.x - rows[..., 10]
        scatter = [np.sqrt(np.mean(left[..., part] ** 2)) for part in (slice(3), slice(3, 6))]
        weights = 1.0 / np.maximum(np.repeat(scatter, 3), least)
    fit = _fit(rows * weights[:, np.newaxis])
    if len(fit.determined) and len(modes) > len(fit.determined):
        fit = _weighted_by_modes(fit, modes, errors, least)
    x, corrected = _nearest_physical_parameters(fit)
    shares = np.sqrt(np.sum(fit.undetermined**2, axis=0))
    spread = np.sqrt(
        np.sum((fit.determined * fit.deviations[:, np.newaxis]) ** 2, axis=0)
        # The part in undetermined directions is omitted; it is about as large as the others.
        + (shares * np.linalg.norm(x)) ** 2
    )
    unknown = shares > _MIN_UNDETERMINED_SHARE
    return PayloadEstimate(
        link,
        np.where(unknown, np.nan, unit * x),
        np.where(unknown, np.nan, unit * spread),
        fit.undetermined,
        corrected,
    )


@dataclass(frozen=True)
class _Fit:
    """A least-squares fit: ``x`` (10,), in ``determined`` directions (r, 10) with standard
    ``deviations`` (r,); the ``undetermined`` (10 - r, 10) are orthogonal to x.
    """

    x: Array
    determined: Array
    deviations: Array
    undetermined: Array


def _fit(rows: Array) -> _Fit:
    """Return the fit of the last column of rows (T, 3, 6, 11) of state triples by the others."""
    flat, between = rows.reshape(-1, 11), _usual_differences(rows).reshape(-1, 11)
    errors = len(flat) / len(between) * between.T @ between
    signal = flat.T @ flat - errors
    power, V = np.linalg.eigh(signal[:10, :10])
    noise = np.einsum("ik,ij,jk->k", V, errors[:10, :10], V)
    found = (power > _SMALLEST_SINGULAR_VALUE**2 * max(power[-1], 0.0)) & (
        power > _MIN_SIGNAL_TO_NOISE * noise
    )
    determined = V.T[found]
    inverse = determined.T / power[found]
    x = inverse @ (determined @ signal[:10, 10])
    left = rows[..., :10] @ x - rows[..., 10]
    # Each row is weighted by its own error.
    gains = (rows[..., :10] @ inverse) * left[..., np.newaxis]
    deviations = np.sqrt(np.sum(gains**2, axis=(0, 1, 2)))
    rounding = _ROUNDING * max(float(np.linalg.norm(x)), 1e-300)
    return _Fit(x, determined, np.maximum(deviations, rounding), V.T[~found])


def _usual_differences(rows: Array) -> Array:
    """Return the second differences (N, 6, 11) of triples of rows, with the variance of a row.

    Errors affect all states; jerks of the motion itself affect few, which are omitted.
    """
    differences = (rows[:, 0] - 2.0 * rows[:, 1] + rows[:, 2]) / np.sqrt(6.0)
    size = np.linalg.norm(differences, axis=(1, 2))
    return np.asarray(differences[size <= _MIN_JERK_RATIO * np.median(size)])


def _weighted_by_modes(fit: _Fit, modes: Array, errors: Array, least: float) -> _Fit:
    """Return the fit of modes (K, 6, 11) in the directions that another fit has determined.

    The undetermined part is about as large as the rest, and has no errors to subtract.
    ``errors`` (6, 11, 11) are error covariances of the modes, ``least`` is the smallest standard
    deviation of a momentum.
    """
    known, size = len(fit.determined), float(np.linalg.norm(fit.x))
    basis = np.eye(11)
    basis[:10, :10] = np.vstack([fit.determined, fit.undetermined])
    modes, errors = modes @ basis.T, basis @ errors @ basis.T
    errors[:, known:10] = errors[:, :, known:10] = 0.0
    prior = np.diag(np.r_[np.zeros(known), np.full(10 - known, size**-2.0)])
    combined = basis @ np.append(fit.x, -1.0)
    for _ in range(_ROUNDS):
        variances = _mode_variances(modes @ combined, least)
        # Second differences contain jerks of the motion besides noise, which affects all modes.
        noise = variances[-1] / (np.einsum("cij,i,j->c", errors, combined, combined) + least**2)
        of_errors = np.einsum("kc,cij->ij", np.minimum(noise, 1.0) / variances, errors)
        power = np.einsum("kci,kc,kcj->ij", modes, 1.0 / variances, modes)
        signal = (power - of_errors)[:10]
        signal[:, :10] += prior
        coupling = signal[:known, known:10] @ np.linalg.inv(signal[known:, known:10])
        free = np.hstack([np.eye(known), -coupling])
        inverse = np.linalg.solve(free @ signal[:, :known], free)
        combined[:known] = inverse @ signal[:, 10]
    spread, directions = np.linalg.eigh(inverse @ (power[:10, :10] + prior) @ inverse.T)
    deviations = np.maximum(np.sqrt(np.maximum(spread, 0.0)), _ROUNDING * size)
    determined = directions.T @ fit.determined
    return _Fit(combined[:known] @ fit.determined, determined, deviations, fit.undetermined)


def _mode_variances(left: Array, least: float) -> Array:
    """Return the variances (K, 6) of the momenta in K modes, of which ``left`` (K, 6) are samples.

    They are the most likely sums of white noise, equal in all modes, and a random walk, which falls
    with the square of the frequency.
    """
    frequency = 2.0 * np.sin(0.5 * np.pi * np.arange(1, len(left) + 1) / (len(left) + 1))
    shapes = 1.0 + _WALK_SHARES[:, np.newaxis] * frequency**-2
    scales = (1.0 / shapes) @ (left**2 + least**2) / len(left)
    costs = len(left) * np.log(scales) + np.log(shapes).sum(axis=1)[:, np.newaxis]
    best = costs.argmin(axis=0)
    return np.asarray((scales[best, range(6)][:, np.newaxis] * shapes[best]).T)


def _nearest_physical_parameters(fit: _Fit) -> tuple[Array, bool]:
    """Return parameters (10,) of a body near the fit, and whether the fit has been corrected."""
    if not len(fit.undetermined) and np.linalg.eigvalsh(_pseudo_inertia(fit.x)).min() > 0.0:
        return fit.x, False
    if not len(fit.deviations):
        return fit.x, False
    aim, weights = fit.determined @ fit.x, fit.deviations.min() / fit.deviations
    start = _initial_log_cholesky(_most_physical_parameters(fit))

    def left(theta: Array) -> Array:
        of_data = weights * (fit.determined @ _from_log_cholesky(theta) - aim)
        return np.concatenate([of_data, _PRIOR_WEIGHT * weights.min() * (theta - start)])

    def slopes(theta: Array) -> Array:
        of_data = weights[:, np.newaxis] * (fit.determined @ _log_cholesky_jacobian(theta))
        return np.vstack([of_data, _PRIOR_WEIGHT * weights.min() * np.eye(10)])

    result = least_squares(
        left, start, slopes, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-14, max_nfev=300
    )
    found = _from_log_cholesky(result.x)
    distance = float(np.linalg.norm((fit.determined @ found - aim) / fit.deviations))
    near = np.linalg.norm(fit.determined @ found - aim) <= 1e-6 * np.linalg.norm(aim)
    corrected = not (near or distance <= _MAX_NOISE_DISTANCE)
    return (found, True) if corrected else (fit.x, False)


def _most_physical_parameters(fit: _Fit) -> Array:
    """Return the fit with an undetermined part that makes it a body, or nearly one."""
    count, size = len(fit.undetermined), float(np.linalg.norm(fit.x))
    if not count:
        return fit.x

    def lack(part: Array) -> float:
        least = np.linalg.eigvalsh(_pseudo_inertia(fit.x + part @ fit.undetermined)).min()
        return -min(float(least), 1e-3 * size)

    simplex = np.vstack([np.zeros(count), size * np.eye(count)])
    found = minimize(lack, simplex[0], method="Nelder-Mead", options={"initial_simplex": simplex})
    return np.asarray(fit.x + found.x @ fit.undetermined)


def _pseudo_inertia(x: Array) -> Array:
    """Return the pseudo-inertia matrix (4, 4) of parameters (10,)."""
    about = symmetric_of_entries(x[4:])
    J = np.empty((4, 4))
    J[:3, :3] = np.trace(about) / 2 * np.eye(3) - about
    J[:3, 3] = J[3, :3] = x[1:4]
    J[3, 3] = x[0]
    return J


def _initial_log_cholesky(x: Array) -> Array:
    """Return the logarithmic Cholesky factor of a body near parameters (10,)."""
    values, vectors = np.linalg.eigh(_pseudo_inertia(x))
    size = max(float(np.abs(values).max()), 1e-12)
    L = np.linalg.cholesky((vectors * np.maximum(values, 1e-3 * size)) @ vectors.T)
    return np.concatenate([np.log(np.diag(L)), L[_LOWER_TRIANGLE]])


def _from_log_cholesky(theta: Array) -> Array:
    """Return the parameters (10,) of a body from its logarithmic Cholesky factor (10,)."""
    L = _factor(theta)
    return _parameters_of_pseudo_inertia(L @ L.T)


def _log_cholesky_jacobian(theta: Array) -> Array:
    """Return the derivatives (10, 10) of :func:`_from_log_cholesky`."""
    L, slopes = _factor(theta), np.empty((10, 10))
    rows, columns = (np.concatenate([range(4), each]).tolist() for each in _LOWER_TRIANGLE)
    for k, (i, j) in enumerate(zip(rows, columns, strict=True)):
        dL = np.zeros((4, 4))
        dL[i, j] = L[i, j] if i == j else 1.0
        slopes[:, k] = _parameters_of_pseudo_inertia(dL @ L.T + L @ dL.T)
    return slopes


def _factor(theta: Array) -> Array:
    L = np.diag(np.exp(theta[:4]))
    L[_LOWER_TRIANGLE] = theta[4:]
    return L


def _parameters_of_pseudo_inertia(J: Array) -> Array:
    """Return the parameters (10,) of a pseudo-inertia matrix (4, 4)."""
    about = np.trace(J[:3, :3]) * np.eye(3) - J[:3, :3]
    return np.array([J[3, 3], *J[:3, 3], *(about[i, j] for i, j in INERTIA_ENTRIES)])


_LOWER_TRIANGLE = np.tril_indices(4, -1)
