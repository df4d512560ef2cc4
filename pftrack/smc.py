r"""Sequential Monte Carlo: weights, resampling and the bootstrap particle filter.

A particle filter represents what is known about a hidden state :math:`s_t` by :math:`N` weighted guesses, the
*particles* (Owczarek et al. 2015, eqs 1 and 2):

.. math:: p(s_t \mid y_{0:t}) \approx \sum_{n=1}^{N} \pi_t^{(n)} \, \delta(s - s_t^{(n)}), \qquad \sum_n \pi_t^{(n)} = 1

Each new observation goes round one loop: **predict** (move every particle through the transition, eq. 3), **update**
(multiply its weight by the likelihood, eq. 4, and normalise, eq. 5), **estimate** (the weighted mean, eq. 6) and,
when too few particles carry the weight (eq. 7), **resample**. :func:`bootstrap_filter` is that loop.

Two conventions hold throughout. Weights are multiplied in the log domain, where a product of many small numbers is a
sum that cannot underflow. And randomness comes from an explicit ``numpy.random.Generator``, so that the same seed
gives the same result. Chapters 1 and 2 derive everything here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pftrack import kernels


def _one_dimensional(weights) -> np.ndarray:
    weights = np.asarray(weights, dtype=float)
    if weights.ndim != 1 or weights.size == 0:
        raise ValueError(f"weights must be a non-empty one-dimensional array, got shape {weights.shape}")
    return weights


def _check_weights(weights) -> np.ndarray:
    weights = _one_dimensional(weights)
    if not weights.min() >= 0:  # also catches NaN
        raise ValueError("weights must not be negative or NaN")
    total = weights.sum()
    if abs(total - 1.0) > 1e-6:
        raise ValueError(f"weights must sum to 1, got {total:.6g}; use normalize on log-weights first")
    return weights / total


def _check_log_weights(log_weights) -> np.ndarray:
    log_weights = np.asarray(log_weights, dtype=float)
    if log_weights.ndim != 1 or log_weights.size == 0:
        raise ValueError(f"log_weights must be a non-empty one-dimensional array, got shape {log_weights.shape}")
    if not log_weights.max() < np.inf:  # also catches NaN
        raise ValueError("log_weights must not hold NaN or +inf; a weight of zero is -inf")
    return log_weights


def normalize(log_weights) -> np.ndarray:
    """Weights that sum to one from unnormalised log-weights (Owczarek et al. 2015, eq. 5).

    The largest log-weight is subtracted before the exponential is taken, so that neither very small nor very large
    log-weights under- or overflow.

    Parameters
    ----------
    log_weights : array_like, shape (N,)
        Unnormalised log-weights; ``-inf`` is a weight of zero.

    Returns
    -------
    ndarray, shape (N,)
        Non-negative weights with sum 1. If *every* log-weight is ``-inf``, no particle explains the observation and
        the weights say nothing: they are defined to be equal, ``1/N``.

    Raises
    ------
    ValueError
        If `log_weights` is empty, not one-dimensional, or holds NaN or ``+inf``.

    Examples
    --------
    The ratio of two weights survives where ``exp`` alone would give 0/0:

    >>> normalize([-1000.0, -1000.0 + np.log(3)]).round(6)
    array([0.25, 0.75])
    >>> normalize([-np.inf, -np.inf])
    array([0.5, 0.5])
    """
    log_weights = _check_log_weights(log_weights)
    largest = log_weights.max()
    if np.isneginf(largest):
        return np.full(log_weights.size, 1.0 / log_weights.size)
    weights = np.exp(log_weights - largest)
    return weights / weights.sum()


def log_sum_exp(log_weights) -> float:
    """Logarithm of a sum of weights, from their logarithms.

    With log-weights ``log W[n] + log p(y | s[n])``, where the ``W`` are normalised, this is the increment of the
    log-evidence: the filter's estimate of ``log p(y_t | y_{0:t-1})``.

    Parameters
    ----------
    log_weights : array_like, shape (N,)
        Log-weights; ``-inf`` is a weight of zero.

    Returns
    -------
    float
        ``log(sum(exp(log_weights)))``, or ``-inf`` when every weight is zero.

    Raises
    ------
    ValueError
        As :func:`normalize`.

    Examples
    --------
    >>> print(round(np.exp(log_sum_exp(np.log([0.1, 0.2]))), 6))
    0.3
    >>> log_sum_exp([-np.inf, -np.inf])
    -inf
    """
    log_weights = _check_log_weights(log_weights)
    largest = log_weights.max()
    if np.isneginf(largest):
        return float("-inf")
    return float(largest + np.log(np.exp(log_weights - largest).sum()))


def effective_sample_size(weights) -> float:
    r"""How many equally weighted particles the weights are worth: :math:`1 / \sum_n (\pi^{(n)})^2`.

    `N` when all weights are equal, 1 when a single particle holds all the weight. The *degeneration indicator* of
    Owczarek et al. 2015, eq. 7, is this number divided by `N`.

    Parameters
    ----------
    weights : array_like, shape (N,)
        Normalised weights.

    Returns
    -------
    float
        The effective sample size, between 1 and `N`.

    Raises
    ------
    ValueError
        If the weights are empty, negative, NaN or do not sum to one.

    Examples
    --------
    >>> effective_sample_size([0.25, 0.25, 0.25, 0.25])
    4.0
    >>> effective_sample_size([1.0, 0.0, 0.0, 0.0])
    1.0
    """
    weights = _check_weights(weights)
    return float(1.0 / (weights @ weights))


# ---------------------------------------------------------------------------------------------------------------------
# Resampling: four ways to draw ancestors, one signature. Each is unbiased, E[offspring of n] = n_draws * W[n];
# they differ in how much the number of offspring scatters about that mean.
# ---------------------------------------------------------------------------------------------------------------------


def _invert(weights: np.ndarray, uniforms: np.ndarray) -> np.ndarray:
    """Indices at which the cumulative weights pass each of the `uniforms` in [0, 1)."""
    indices = np.searchsorted(np.cumsum(weights), uniforms, side="right")
    return np.minimum(indices, np.flatnonzero(weights)[-1])  # rounding must never pick a particle of weight zero


def _comb(weights: np.ndarray, shifts: np.ndarray, n_draws: int) -> np.ndarray:
    """Indices at which the cumulative weights pass the teeth of a comb; the weights are checked on the way."""
    ancestors, smallest, total = kernels.comb(weights, shifts, n_draws)
    if not (smallest >= 0 and abs(total - 1.0) <= 1e-6):
        _check_weights(weights)  # says what is wrong
    return ancestors


def _check_n_draws(n_draws, weights) -> int:
    n_draws = weights.size if n_draws is None else n_draws
    if n_draws < 1:
        raise ValueError(f"n_draws must be at least 1, got {n_draws}")
    return int(n_draws)


def multinomial(weights, rng: np.random.Generator, n_draws: int | None = None) -> np.ndarray:
    """Draw ancestors independently, each with probability equal to its weight.

    The plainest scheme (Gordon et al. 1993) and the noisiest: offspring of particle `n` are
    ``Binomial(n_draws, W[n])``.

    Parameters
    ----------
    weights : array_like, shape (N,)
        Normalised weights.
    rng : numpy.random.Generator
        Source of randomness.
    n_draws : int, optional
        How many ancestors to draw; `N` if not given.

    Returns
    -------
    ndarray of int, shape (n_draws,)
        Indices of the ancestors, in increasing order.

    Raises
    ------
    ValueError
        If the weights are not normalised, or `n_draws` is below 1.

    Examples
    --------
    >>> multinomial([0.0, 1.0, 0.0], np.random.default_rng(0))
    array([1, 1, 1])
    """
    weights = _check_weights(weights)
    n_draws = _check_n_draws(n_draws, weights)
    return _invert(weights, np.sort(rng.random(n_draws)))


def stratified(weights, rng: np.random.Generator, n_draws: int | None = None) -> np.ndarray:
    """Draw one ancestor from each of `n_draws` equal slices of the cumulative weights (Kitagawa 1996).

    Parameters, returned value and errors are those of :func:`multinomial`.

    Examples
    --------
    >>> stratified([0.5, 0.5], np.random.default_rng(0), n_draws=4)
    array([0, 0, 1, 1])
    """
    weights = _one_dimensional(weights)
    n_draws = _check_n_draws(n_draws, weights)
    return _comb(weights, rng.random(n_draws), n_draws)


def systematic(weights, rng: np.random.Generator, n_draws: int | None = None) -> np.ndarray:
    """Draw ancestors with a comb of `n_draws` equally spaced teeth and one random shift (Carpenter et al. 1999).

    The cheapest scheme: a single random number. Particle `n` gets ``floor(n_draws * W[n])`` or one more.

    Parameters, returned value and errors are those of :func:`multinomial`.

    Examples
    --------
    >>> systematic([0.25, 0.5, 0.25], np.random.default_rng(0), n_draws=4)
    array([0, 1, 1, 2])
    """
    weights = _one_dimensional(weights)
    n_draws = _check_n_draws(n_draws, weights)
    return _comb(weights, rng.random(1), n_draws)


def residual(weights, rng: np.random.Generator, n_draws: int | None = None) -> np.ndarray:
    """Give each particle ``floor(n_draws * W[n])`` offspring and draw the rest from the remainders (Liu & Chen 1998).

    The remaining draws are multinomial with probabilities proportional to ``n_draws * W[n] - floor(n_draws * W[n])``.
    (A widely copied slip subtracts from ``W[n]`` instead and makes the scheme biased; chapter 2 shows it.)

    Parameters, returned value and errors are those of :func:`multinomial`.

    Examples
    --------
    >>> residual([0.25, 0.5, 0.25], np.random.default_rng(0), n_draws=4)
    array([0, 1, 1, 2])
    """
    weights = _check_weights(weights)
    n_draws = _check_n_draws(n_draws, weights)
    expected = n_draws * weights
    copies = np.floor(expected + 1e-9).astype(int)  # 4 * 0.25 counts as 1, though rounding may leave it just below
    n_left = n_draws - copies.sum()
    if n_left > 0:
        remainder = np.maximum(expected - copies, 0.0)
        drawn = multinomial(remainder / remainder.sum(), rng, n_left)
        copies += np.bincount(drawn, minlength=weights.size)
    return np.repeat(np.arange(weights.size), copies)


RESAMPLERS: dict[str, Callable] = {
    "multinomial": multinomial,
    "stratified": stratified,
    "systematic": systematic,
    "residual": residual,
}
"""The resampling schemes by name."""


# ---------------------------------------------------------------------------------------------------------------------
# Moments of a weighted set
# ---------------------------------------------------------------------------------------------------------------------


def weighted_mean(states, weights) -> np.ndarray:
    """Mean of a weighted particle set (Owczarek et al. 2015, eqs 6 and 14).

    Parameters
    ----------
    states : array_like, shape (N, d)
        One particle a row.
    weights : array_like, shape (N,)
        Normalised weights.

    Returns
    -------
    ndarray, shape (d,)
        The estimate of the state. Take it *before* resampling, which only adds noise.

    Raises
    ------
    ValueError
        If the weights are not normalised, or their number is not that of the states.

    Examples
    --------
    >>> weighted_mean([[0.0, 10.0], [4.0, 10.0]], [0.75, 0.25])
    array([ 1., 10.])
    """
    states, weights = _check_states(states, weights)
    return weights @ states


def weighted_covariance(states, weights) -> np.ndarray:
    """Covariance matrix of a weighted particle set, about its own weighted mean.

    Parameters
    ----------
    states : array_like, shape (N, d)
        One particle a row.
    weights : array_like, shape (N,)
        Normalised weights.

    Returns
    -------
    ndarray, shape (d, d)
        The covariance, in the units of the states squared.

    Raises
    ------
    ValueError
        As :func:`weighted_mean`.

    Examples
    --------
    >>> weighted_covariance([[0.0], [2.0]], [0.5, 0.5])
    array([[1.]])
    """
    states, weights = _check_states(states, weights)
    centered = states - weights @ states
    return (weights[:, None] * centered).T @ centered


def _check_states(states, weights) -> tuple[np.ndarray, np.ndarray]:
    states, weights = np.asarray(states, dtype=float), _check_weights(weights)
    if states.ndim != 2 or len(states) != weights.size:
        raise ValueError(f"states must have shape (N, d) with N = {weights.size} weights, got {states.shape}")
    return states, weights


# ---------------------------------------------------------------------------------------------------------------------
# The filter
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FilterResult:
    """What :func:`bootstrap_filter` returns, for `T` observations, `N` particles and a state of dimension `d`.

    Attributes
    ----------
    means : ndarray, shape (T, d)
        Posterior mean of each state, given the observations so far (eq. 6), taken before resampling.
    covariances : ndarray, shape (T, d, d)
        Posterior covariance of each state.
    effective_sample_sizes : ndarray, shape (T,)
        Effective sample size after each update; divided by `N` it is the degeneration indicator of eq. 7.
    log_evidence_increments : ndarray, shape (T,)
        Estimates of ``log p(y_t | y_{0:t-1})``; ``-inf`` where no particle explained the observation.
    resampled : ndarray of bool, shape (T,)
        Whether the particles were resampled after each update.
    states : ndarray, shape (N, d)
        The particles after the last update, before any resampling.
    weights : ndarray, shape (N,)
        Their normalised weights.
    """

    means: np.ndarray
    covariances: np.ndarray
    effective_sample_sizes: np.ndarray
    log_evidence_increments: np.ndarray
    resampled: np.ndarray
    states: np.ndarray
    weights: np.ndarray

    @property
    def log_evidence(self) -> float:
        """Estimate of ``log p(y_{0:T-1})``; its exponential is unbiased for the evidence."""
        return float(self.log_evidence_increments.sum())


def bootstrap_filter(
    observations,
    initial: Callable[[int, np.random.Generator], np.ndarray],
    transition: Callable[[np.ndarray, np.random.Generator], np.ndarray],
    log_likelihood: Callable[[np.ndarray, object], np.ndarray],
    n_particles: int,
    rng: np.random.Generator | int,
    resample_threshold: float = 0.5,
    resampler: Callable = systematic,
) -> FilterResult:
    """Track a hidden state through observations with the bootstrap particle filter.

    The steps 1 to 7 of Owczarek et al. 2015, section III-A (Gordon et al. 1993): the proposal is the transition
    itself, so the weights need nothing but the likelihood. The first observation updates the initial particles
    directly; each later one is preceded by a prediction.

    Parameters
    ----------
    observations : iterable of length T
        What was seen; each item is handed to `log_likelihood` as it is.
    initial : callable
        ``initial(n_particles, rng)`` draws the particles of the first time step, shape (N, d).
    transition : callable
        ``transition(states, rng)`` moves every particle one step (eq. 3), shape (N, d) to (N, d).
    log_likelihood : callable
        ``log_likelihood(states, observation)`` gives ``log p(y_t | s_t)`` of every particle, shape (N,).
    n_particles : int
        `N`, at least 1.
    rng : numpy.random.Generator or int
        Source of randomness, or a seed for one.
    resample_threshold : float
        Resample when the effective sample size falls below this share of `N`. 0 never resamples (sequential
        importance sampling); anything above 1 resamples at every step.
    resampler : callable
        One of the schemes of this module.

    Returns
    -------
    FilterResult
        Means, covariances, effective sample sizes and log-evidence, step by step. An observation that no particle
        explains (all weights zero) leaves the particles with equal weights and adds ``-inf`` to the log-evidence.

    Raises
    ------
    ValueError
        If `n_particles` is below 1, there are no observations, or a callable returns an array of the wrong shape.

    Examples
    --------
    A random walk seen through noise of unit variance:

    >>> result = bootstrap_filter(
    ...     observations=[0.0, 1.0, 2.0],
    ...     initial=lambda n, rng: rng.normal(size=(n, 1)),
    ...     transition=lambda states, rng: states + rng.normal(size=states.shape),
    ...     log_likelihood=lambda states, y: -0.5 * (y - states[:, 0]) ** 2,
    ...     n_particles=1000,
    ...     rng=0,
    ... )
    >>> result.means.shape
    (3, 1)
    """
    if n_particles < 1:
        raise ValueError(f"n_particles must be at least 1, got {n_particles}")
    rng = np.random.default_rng(rng)
    states = np.asarray(initial(n_particles, rng), dtype=float)
    if states.ndim != 2 or len(states) != n_particles:
        raise ValueError(f"initial must return shape ({n_particles}, d), got {states.shape}")
    shape = states.shape
    equal = np.full(n_particles, -np.log(n_particles))
    log_weights = equal
    steps = []
    for t, observation in enumerate(observations):
        if t > 0:
            states = np.asarray(transition(states, rng), dtype=float)  # predict
        if states.shape != shape:
            raise ValueError(f"at step {t} the transition returned shape {states.shape}, expected {shape}")
        log_likelihoods = np.asarray(log_likelihood(states, observation), dtype=float)
        if log_likelihoods.shape != (n_particles,):
            raise ValueError(
                f"at step {t} log_likelihood returned shape {log_likelihoods.shape}, expected ({n_particles},)"
            )
        log_weights = log_weights + log_likelihoods  # update
        weights, mean, n_effective, increment = kernels.weigh(log_weights, states)  # and estimate
        centered = states - mean
        covariance = (weights[:, None] * centered).T @ centered
        resample = n_effective < resample_threshold * n_particles
        steps.append((mean, covariance, n_effective, increment, resample))
        updated = states, weights
        if resample:
            states = states[resampler(weights, rng)]
        log_weights = equal if resample or np.isneginf(increment) else log_weights - increment
    if not steps:
        raise ValueError("observations is empty")
    means, covariances, sizes, increments, resampled = (np.array(column) for column in zip(*steps, strict=True))
    return FilterResult(means, covariances, sizes, increments, resampled, *updated)
