"""Weights, resampling and the bootstrap filter against closed forms and an exact Kalman filter."""

import functools

import numpy as np
import pytest
from scipy import special, stats

from pftrack import smc

SCHEMES = [smc.multinomial, smc.stratified, smc.systematic, smc.residual]
each_scheme = pytest.mark.parametrize("scheme", SCHEMES, ids=lambda scheme: scheme.__name__)

BAD_WEIGHTS = [
    pytest.param([], "non-empty", id="empty"),
    pytest.param([[0.5, 0.5]], "one-dimensional", id="two-dimensional"),
    pytest.param(0.5, "one-dimensional", id="scalar"),
    pytest.param([-0.5, 1.5], "negative", id="negative"),
    pytest.param([np.nan, 1.0], "NaN", id="NaN"),
    pytest.param([0.5, 0.6], "use normalize", id="sum above 1"),
    pytest.param([0.5, 0.50001], "use normalize", id="sum a little above 1"),
    pytest.param([0.0, 0.0], "use normalize", id="sum 0"),
    pytest.param([np.inf, 0.0], "use normalize", id="infinite"),
]

# ---------------------------------------------------------------------------------------------------------------------
# Log-weights
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base", [0.0, 1e5, -1e5, 1e-5])
def test_normalising_forgets_a_common_factor_however_large_or_small(base):
    weights = np.random.default_rng(1).dirichlet(np.ones(20))
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        result = smc.normalize(base + np.log(3 * weights))
    np.testing.assert_allclose(result, weights, rtol=1e-9)  # 1e5 carries its logarithms to 1.5e-11


def test_normalising_gives_everything_to_a_weight_that_dwarfs_the_others():
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        result = smc.normalize([-1e5, 1e5, -np.inf, 0.0])
    np.testing.assert_array_equal(result, [0.0, 1.0, 0.0, 0.0])


def test_normalised_weights_sum_to_one():
    log_weights = np.random.default_rng(2).uniform(-1e5, 1e5, size=(200, 30))
    for row in log_weights:
        weights = smc.normalize(row)
        assert weights.sum() == pytest.approx(1.0, abs=1e-14)
        assert np.all(weights >= 0)


@pytest.mark.parametrize("n", [1, 3, 100])
def test_no_weight_at_all_becomes_equal_weights(n):
    np.testing.assert_array_equal(smc.normalize(np.full(n, -np.inf)), np.full(n, 1 / n))
    assert smc.log_sum_exp(np.full(n, -np.inf)) == -np.inf


@pytest.mark.parametrize("base", [0.0, 1e5, -1e5, 700.0, -800.0])
def test_log_sum_exp_of_shifted_log_weights_is_the_shifted_log_of_their_sum(base):
    weights = np.random.default_rng(3).gamma(2.0, size=50)
    with np.errstate(over="raise", divide="raise", invalid="raise"):
        result = smc.log_sum_exp(base + np.log(weights))
    assert result == pytest.approx(base + np.log(weights.sum()), rel=1e-12, abs=1e-12)


def test_log_sum_exp_agrees_with_scipy():
    log_weights = np.random.default_rng(4).normal(scale=300, size=(100, 20))
    log_weights[:, 0] = -np.inf
    for row in log_weights:
        assert smc.log_sum_exp(row) == pytest.approx(special.logsumexp(row), rel=1e-14)


@pytest.mark.parametrize("function", [smc.normalize, smc.log_sum_exp])
@pytest.mark.parametrize(
    ("log_weights", "message"),
    [
        pytest.param([0.0, np.nan], "NaN", id="NaN"),
        pytest.param([0.0, np.inf], r"\+inf; a weight of zero is -inf", id="inf"),
        pytest.param([], "non-empty", id="empty"),
        pytest.param([[0.0, 0.0]], "one-dimensional", id="two-dimensional"),
        pytest.param(0.0, "one-dimensional", id="scalar"),
    ],
)
def test_meaningless_log_weights_are_rejected(function, log_weights, message):
    with pytest.raises(ValueError, match=message):
        function(log_weights)


# ---------------------------------------------------------------------------------------------------------------------
# Effective sample size
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_carrying", [1, 2, 7, 100])
def test_equal_weights_on_some_particles_are_worth_as_many_particles(n_carrying):
    weights = np.zeros(100)
    weights[:n_carrying] = 1 / n_carrying
    assert smc.effective_sample_size(weights) == pytest.approx(n_carrying)


@pytest.mark.parametrize("ratio", [0.1, 0.5, 0.9, 0.99])
def test_effective_sample_size_of_geometric_weights(ratio):
    n = 40
    powers = ratio ** np.arange(n)
    series = (1 + ratio) * (1 - ratio**n) / ((1 - ratio) * (1 + ratio**n))  # two geometric series, squared and not
    assert smc.effective_sample_size(powers / powers.sum()) == pytest.approx(series)


def test_effective_sample_size_is_n_over_one_plus_the_squared_coefficient_of_variation():
    for weights in np.random.default_rng(5).dirichlet(np.full(30, 0.3), size=50):
        assert smc.effective_sample_size(weights) == pytest.approx(30 / (1 + stats.variation(weights) ** 2))


@pytest.mark.parametrize(("weights", "message"), BAD_WEIGHTS)
def test_effective_sample_size_rejects_bad_weights(weights, message):
    with pytest.raises(ValueError, match=message):
        smc.effective_sample_size(weights)


# ---------------------------------------------------------------------------------------------------------------------
# Resampling. The law of the offspring numbers is worked out here from each scheme's definition, by integrating over
# its uniform numbers, without drawing anything.
# ---------------------------------------------------------------------------------------------------------------------

N_REPEATS = 1000

PUBLISHED = (0.3, 0.3, 0.2, 0.1, 0.1)  # on which filterpy 1.4.5 is biased (its issue 290)
UNEVEN = tuple(np.random.default_rng(6).dirichlet(np.ones(8)))
CASES = [
    pytest.param(PUBLISHED, 5, id="published"),
    pytest.param(PUBLISHED, 13, id="more draws than particles"),
    pytest.param((0.0, 0.5, 0.0, 0.15, 0.35, 0.0), 6, id="zeros"),
    pytest.param((0.0, 0.5, 0.0, 0.15, 0.35, 0.0), 2, id="fewer draws than particles"),
    pytest.param((0.01, 0.01, 0.97, 0.01), 4, id="one dominates"),
    pytest.param(UNEVEN, 8, id="random"),
]
each_case = pytest.mark.parametrize(("weights", "n_draws"), CASES)


@functools.cache
def offspring(scheme, weights, n_draws):
    """Offspring numbers of every particle in repeated draws, shape (N_REPEATS, N)."""
    rng = np.random.default_rng(7)
    draws = (scheme(weights, rng, n_draws) for _ in range(N_REPEATS))
    return np.array([np.bincount(drawn, minlength=len(weights)) for drawn in draws])


def offspring_covariance(scheme, weights, n_draws):
    """Exact covariance matrix of the offspring numbers."""

    def categorical(p):
        return np.diag(p) - np.outer(p, p)

    weights = np.asarray(weights)
    edges = n_draws * np.concatenate([[0.0], np.cumsum(weights)])
    if scheme is smc.multinomial:
        return n_draws * categorical(weights)
    if scheme is smc.residual:
        left = n_draws * weights - np.floor(n_draws * weights + 1e-12)
        n_left = round(left.sum())
        return n_left * categorical(left / n_left) if n_left else np.zeros((len(weights),) * 2)
    if scheme is smc.stratified:  # one categorical draw from each slice [k, k + 1) of the scaled cumulative weights
        slices = (np.diff(np.clip(edges, k, k + 1)) for k in range(n_draws))
        return sum(categorical(p) for p in slices)
    # Systematic: teeth at k + U. Between the fractional parts of the edges the counts do not depend on U.
    breaks = np.unique(np.concatenate([[0.0, 1.0], edges % 1]))
    lengths, middles = np.diff(breaks), (breaks[:-1] + breaks[1:]) / 2
    counts = np.array([np.diff(np.ceil(edges - u)) for u in middles])
    return (lengths[:, None] * counts).T @ counts - np.outer(n_draws * weights, n_draws * weights)


@each_case
@each_scheme
def test_expected_offspring_is_n_draws_times_the_weight(scheme, weights, n_draws):
    variances = np.maximum(np.diag(offspring_covariance(scheme, weights, n_draws)), 0.0)
    standard_errors = np.sqrt(variances / N_REPEATS)
    error = offspring(scheme, weights, n_draws).mean(axis=0) - n_draws * np.array(weights)
    assert np.all(np.abs(error) <= 5 * standard_errors + 1e-6)


@each_case
@each_scheme
def test_offspring_scatter_as_the_scheme_prescribes(scheme, weights, n_draws):
    """Along every axis and some random directions, so that covariances count too."""
    counts = offspring(scheme, weights, n_draws)
    exact = offspring_covariance(scheme, weights, n_draws)
    for direction in [*np.eye(len(weights)), *np.random.default_rng(8).normal(size=(5, len(weights)))]:
        squares = (counts @ direction - n_draws * np.array(weights) @ direction) ** 2
        standard_error = squares.std() / np.sqrt(N_REPEATS)
        assert abs(squares.mean() - direction @ exact @ direction) <= 5 * standard_error + 1e-6


@each_case
@pytest.mark.parametrize("scheme", [smc.stratified, smc.residual], ids=lambda scheme: scheme.__name__)
def test_stratified_and_residual_never_add_more_noise_than_multinomial(scheme, weights, n_draws):
    """Douc and Cappé 2005: whatever function of the particles is averaged; here many random ones."""
    counts, weights = offspring(scheme, weights, n_draws), np.array(weights)
    for values in np.random.default_rng(9).normal(size=(50, len(weights))):
        multinomial_variance = n_draws * (weights @ values**2 - (weights @ values) ** 2)
        squares = (counts @ values - n_draws * weights @ values) ** 2
        assert squares.mean() <= multinomial_variance + 5 * squares.std() / np.sqrt(N_REPEATS)


def test_offspring_scatter_less_from_scheme_to_scheme_on_uneven_weights():
    """On these weights; there are others on which residual beats stratified."""
    total = [offspring(scheme, UNEVEN, 8).var(axis=0).sum() for scheme in SCHEMES]
    in_order = [smc.multinomial, smc.residual, smc.stratified, smc.systematic]
    assert np.all(np.diff([total[SCHEMES.index(scheme)] for scheme in in_order]) < 0)


def whole_number_shares():
    """Weights that are ratios of whole numbers, so that n_draws * W and its floor are exact: (shares, n_draws)."""
    rng = np.random.default_rng(10)
    for _ in range(150):
        shares = rng.integers(0, 10, size=rng.integers(1, 12))
        shares[rng.integers(len(shares))] += 1  # at least one is positive
        yield shares, int(rng.integers(1, 40))


def test_systematic_gives_each_particle_floor_or_ceil_of_its_share():
    rng = np.random.default_rng(11)
    for shares, n_draws in whole_number_shares():
        counts = np.bincount(smc.systematic(shares / shares.sum(), rng, n_draws), minlength=len(shares))
        assert np.all(np.abs(counts * shares.sum() - n_draws * shares) < shares.sum())


def test_residual_gives_each_particle_at_least_floor_of_its_share():
    rng = np.random.default_rng(12)
    for shares, n_draws in whole_number_shares():
        counts = np.bincount(smc.residual(shares / shares.sum(), rng, n_draws), minlength=len(shares))
        assert np.all(counts >= n_draws * shares // shares.sum())


@pytest.mark.parametrize("scheme", [smc.systematic, smc.residual], ids=lambda scheme: scheme.__name__)
def test_whole_shares_are_given_out_without_chance(scheme):
    rng = np.random.default_rng(13)
    for shares, _ in whole_number_shares():
        drawn = scheme(shares / shares.sum(), rng, int(shares.sum()))
        np.testing.assert_array_equal(np.bincount(drawn, minlength=len(shares)), shares)


@each_scheme
def test_a_particle_of_weight_zero_is_never_picked(scheme):
    rng = np.random.default_rng(14)
    for shares, n_draws in whole_number_shares():
        assert np.all(shares[scheme(shares / shares.sum(), rng, n_draws)] > 0)


class Extreme:
    """A source of randomness whose every number is the same, here one of the ends of [0, 1)."""

    def __init__(self, number):
        self.number = number

    def random(self, size=None):
        return self.number if size is None else np.full(size, self.number)


@each_scheme
@pytest.mark.parametrize("number", [0.0, np.nextafter(1.0, 0.0)], ids=["lowest", "highest"])
@pytest.mark.parametrize("n_carrying", [1, 3, 10, 49, 1000])
def test_not_even_the_extremes_of_a_generator_pick_a_particle_of_weight_zero(scheme, number, n_carrying):
    """Sums of 1/10 or 1/49 miss 1 by rounding, where a scheme may run past the last particle that has weight."""
    weights = np.zeros(n_carrying + 2)
    weights[1:-1] = 1 / n_carrying
    drawn = scheme(weights, Extreme(number), 7)
    assert len(drawn) == 7
    assert np.all(weights[drawn] > 0)


@each_scheme
def test_same_seed_same_ancestors(scheme):
    weights = np.random.default_rng(15).dirichlet(np.ones(30))
    first, second, other = (scheme(weights, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert not np.array_equal(first, other)


@each_scheme
@pytest.mark.parametrize("n_draws", [None, 1, 10, 100])
def test_ancestors_are_sorted_indices_as_many_as_asked_for(scheme, n_draws):
    weights = np.random.default_rng(16).dirichlet(np.ones(30))
    drawn = scheme(weights, np.random.default_rng(17), n_draws)
    assert drawn.shape == (30 if n_draws is None else n_draws,)
    assert np.issubdtype(drawn.dtype, np.integer)
    assert np.all(np.diff(drawn) >= 0)
    assert drawn.min() >= 0
    assert drawn.max() < 30


@each_scheme
@pytest.mark.parametrize(("weights", "message"), BAD_WEIGHTS)
def test_resampling_rejects_bad_weights(scheme, weights, message):
    with pytest.raises(ValueError, match=message):
        scheme(weights, np.random.default_rng(0))


@each_scheme
@pytest.mark.parametrize("n_draws", [0, -3])
def test_resampling_rejects_fewer_than_one_draw(scheme, n_draws):
    with pytest.raises(ValueError, match="n_draws must be at least 1"):
        scheme([0.5, 0.5], np.random.default_rng(0), n_draws)


def test_every_scheme_is_found_by_its_name():
    assert {scheme.__name__: scheme for scheme in SCHEMES} == smc.RESAMPLERS


# ---------------------------------------------------------------------------------------------------------------------
# Moments
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [1, 2, 5])
def test_weighted_moments_agree_with_numpy(d):
    rng = np.random.default_rng(18)
    states, weights = rng.normal(loc=50, size=(40, d)), rng.dirichlet(np.full(40, 0.5))
    np.testing.assert_allclose(smc.weighted_mean(states, weights), np.average(states, axis=0, weights=weights))
    covariance = np.cov(states.T, aweights=weights, ddof=0).reshape(d, d)
    np.testing.assert_allclose(smc.weighted_covariance(states, weights), covariance, atol=1e-12)


@pytest.mark.parametrize("function", [smc.weighted_mean, smc.weighted_covariance])
@pytest.mark.parametrize(
    ("states", "weights", "message"),
    [
        ([1.0, 2.0], [0.5, 0.5], r"shape \(N, d\)"),
        ([[1.0], [2.0], [3.0]], [0.5, 0.5], "N = 2 weights"),
        *[([[1.0], [2.0]], *case.values) for case in BAD_WEIGHTS],
    ],
)
def test_moments_reject_bad_weights_and_shapes(function, states, weights, message):
    with pytest.raises(ValueError, match=message):
        function(states, weights)


# ---------------------------------------------------------------------------------------------------------------------
# The filter against an exact Kalman filter, on a position and a velocity of which only the position is seen
# ---------------------------------------------------------------------------------------------------------------------

A = np.array([[1.0, 1.0], [0.0, 0.9]])
Q = np.array([[0.3, 0.1], [0.1, 0.2]])
H = np.array([[1.0, 0.0]])
R = 0.5
PRIOR_MEAN, PRIOR_COVARIANCE = np.array([1.0, -0.5]), np.array([[1.0, 0.3], [0.3, 0.5]])
OBSERVATIONS = np.array([2.3, 1.4, 0.9, 2.1, 3.5])
Q_ROOT, PRIOR_ROOT = np.linalg.cholesky(Q), np.linalg.cholesky(PRIOR_COVARIANCE)


def draw_prior(n, rng):
    return PRIOR_MEAN + rng.standard_normal((n, 2)) @ PRIOR_ROOT.T


def move(states, rng):
    return states @ A.T + rng.standard_normal(states.shape) @ Q_ROOT.T


def log_density(states, y):
    return -0.5 * (y - states[:, 0]) ** 2 / R - 0.5 * np.log(2 * np.pi * R)


def kalman(observations):
    """Exact filtering means, covariances and log-evidence increments."""
    mean, covariance = PRIOR_MEAN, PRIOR_COVARIANCE
    means, covariances, increments = [], [], []
    for t, y in enumerate(observations):
        if t > 0:
            mean, covariance = A @ mean, A @ covariance @ A.T + Q
        innovation = H @ covariance @ H.T + R
        increments.append(stats.multivariate_normal.logpdf(y, H @ mean, innovation))
        gain = covariance @ H.T @ np.linalg.inv(innovation)
        mean = mean + gain @ (y - H @ mean)
        covariance = covariance - gain @ H @ covariance
        means.append(mean)
        covariances.append(covariance)
    return np.array(means), np.array(covariances), np.array(increments)


def run(seed, observations=OBSERVATIONS, n_particles=100, **options):
    return smc.bootstrap_filter(observations, draw_prior, move, log_density, n_particles, seed, **options)


each_way_to_resample = pytest.mark.parametrize(
    ("threshold", "resampler"),
    [pytest.param(0, smc.systematic, id="never")]
    + [pytest.param(0.5, f, id=f"half-{f.__name__}") for f in SCHEMES]
    + [pytest.param(1.1, f, id=f"always-{f.__name__}") for f in SCHEMES],
)


def test_the_kalman_filter_of_these_tests_gives_the_joint_density_of_all_observations():
    """The truth is checked too: the observations are jointly Gaussian with moments that follow from the model."""
    n = len(OBSERVATIONS)
    means, covariances = [PRIOR_MEAN], [PRIOR_COVARIANCE]
    for _ in range(n - 1):
        means.append(A @ means[-1])
        covariances.append(A @ covariances[-1] @ A.T + Q)
    joint = np.empty((n, n))
    for i in range(n):
        for j in range(i, n):
            joint[i, j] = joint[j, i] = (H @ np.linalg.matrix_power(A, j - i) @ covariances[i] @ H.T).item()
    joint += R * np.eye(n)
    exact = stats.multivariate_normal.logpdf(OBSERVATIONS, np.array(means)[:, 0], joint)
    assert kalman(OBSERVATIONS)[2].sum() == pytest.approx(exact)


@each_way_to_resample
def test_filter_finds_the_exact_posterior_mean_and_covariance(threshold, resampler):
    runs = [run(seed, n_particles=1000, resample_threshold=threshold, resampler=resampler) for seed in range(30)]
    means, covariances, _ = kalman(OBSERVATIONS)
    for estimates, exact in [
        (np.array([result.means for result in runs]), means),
        (np.array([result.covariances for result in runs]), covariances),
    ]:
        standard_errors = estimates.std(axis=0, ddof=1) / np.sqrt(len(runs))
        assert np.all(np.abs(estimates.mean(axis=0) - exact) <= 5 * standard_errors)
        assert np.all(5 * standard_errors < 0.15)  # or the line above would say little


@each_way_to_resample
def test_evidence_is_unbiased(threshold, resampler):
    """On the linear scale, for few particles; the logarithm of the estimate is biased, and is not tested."""
    observations = OBSERVATIONS[:3]
    options = {"n_particles": 50, "resample_threshold": threshold, "resampler": resampler}
    runs = [run(seed, observations, **options) for seed in range(400)]
    ratios = np.exp(np.array([result.log_evidence for result in runs]) - kalman(observations)[2].sum())
    standard_error = ratios.std(ddof=1) / np.sqrt(len(runs))
    assert abs(ratios.mean() - 1) <= 4 * standard_error
    assert 4 * standard_error < 0.15
    share = np.mean([result.resampled for result in runs])
    assert {0: share == 0, 0.5: 0 < share < 1, 1.1: share == 1}[threshold]


def test_without_resampling_the_filter_is_importance_sampling_on_whole_paths():
    """Particles that stand still keep their paths: weights and evidence follow from the summed log-likelihoods."""
    log_likelihoods = np.random.default_rng(19).normal(scale=3, size=(6, 25))
    result = smc.bootstrap_filter(
        log_likelihoods,
        initial=lambda n, rng: np.arange(n, dtype=float)[:, None],
        transition=lambda states, rng: states,
        log_likelihood=lambda states, y: y[states[:, 0].astype(int)],
        n_particles=25,
        rng=0,
        resample_threshold=0,
    )
    paths = np.cumsum(log_likelihoods, axis=0)
    np.testing.assert_allclose(result.weights, special.softmax(paths[-1]), rtol=1e-10)
    np.testing.assert_allclose(result.means[:, 0], special.softmax(paths, axis=1) @ np.arange(25), rtol=1e-10)
    evidence = special.logsumexp(paths, axis=1) - np.log(25)
    np.testing.assert_allclose(np.cumsum(result.log_evidence_increments), evidence, rtol=1e-10)


def test_without_resampling_a_particle_can_come_back_from_however_small_a_weight():
    """Either particle explains one observation and is exp(-800) worse at the other: they end equal."""
    result = smc.bootstrap_filter(
        np.array([[0.0, -800.0], [-800.0, 0.0]]),
        initial=lambda n, rng: np.arange(n, dtype=float)[:, None],
        transition=lambda states, rng: states,
        log_likelihood=lambda states, y: y[states[:, 0].astype(int)],
        n_particles=2,
        rng=0,
        resample_threshold=0,
    )
    np.testing.assert_allclose(result.weights, [0.5, 0.5])
    assert result.log_evidence == pytest.approx(-800.0)


@pytest.mark.parametrize("threshold", [0, 0.5, 1.1])
def test_same_seed_same_result_to_the_bit(threshold):
    def content(rng):
        result = run(rng, resample_threshold=threshold)
        return b"".join(np.asarray(value).tobytes() for value in vars(result).values())

    assert content(3) == content(3) == content(np.random.default_rng(3))
    assert content(3) != content(4)


@pytest.mark.parametrize("threshold", [0, 0.5, 1.1])
def test_what_the_filter_returns_fits_together(threshold):
    n = 100
    result = run(5, n_particles=n, resample_threshold=threshold)
    n_steps = len(OBSERVATIONS)
    assert result.means.shape == (n_steps, 2)
    assert result.covariances.shape == (n_steps, 2, 2)
    assert result.states.shape == (n, 2)
    np.testing.assert_array_equal(result.resampled, result.effective_sample_sizes < threshold * n)
    assert result.resampled.dtype == bool
    assert result.log_evidence == pytest.approx(result.log_evidence_increments.sum())
    assert result.weights.sum() == pytest.approx(1.0)
    assert np.ptp(result.weights) > 0  # the particles before resampling, which would have made the weights equal
    np.testing.assert_allclose(np.average(result.states, axis=0, weights=result.weights), result.means[-1])
    assert 1 / np.sum(result.weights**2) == pytest.approx(result.effective_sample_sizes[-1])


def test_the_first_observation_meets_the_initial_particles_and_each_later_one_a_prediction():
    log = []

    def note(name, value):
        log.append(name)
        return value

    smc.bootstrap_filter(
        iter(["a", "b", "c"]),  # any iterable of any objects, handed on as they are
        initial=lambda n, rng: note("initial", np.zeros((n, 1))),
        transition=lambda states, rng: note("move", states),
        log_likelihood=lambda states, y: note(y, np.zeros(len(states))),
        n_particles=4,
        rng=0,
    )
    assert log == ["initial", "a", "move", "b", "move", "c"]


def test_estimates_are_taken_before_resampling():
    def keep_only_the_first(weights, rng):
        return np.zeros(len(weights), dtype=int)

    options = {"observations": OBSERVATIONS[:1], "resample_threshold": 1.1}
    with_spoilt_resampling = run(6, resampler=keep_only_the_first, **options)
    assert with_spoilt_resampling.resampled.all()
    np.testing.assert_array_equal(with_spoilt_resampling.means, run(6, **options).means)
    assert np.linalg.matrix_rank(with_spoilt_resampling.covariances[0]) == 2


@pytest.mark.parametrize("threshold", [0, 1.1])
@each_scheme
def test_resampling_makes_weights_equal_and_nothing_else_does(scheme, threshold):
    """An observation that says nothing, after one that does, shows the weights that were carried over."""
    result = smc.bootstrap_filter(
        [1.0, 0.0],
        initial=draw_prior,
        transition=move,
        log_likelihood=lambda states, y: y * states[:, 0],
        n_particles=50,
        rng=9,
        resample_threshold=threshold,
        resampler=scheme,
    )
    before, after = result.effective_sample_sizes
    assert before < 40
    assert after == pytest.approx(50 if threshold else before)
    assert result.log_evidence_increments[1] == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("threshold", [0, 0.5, 1.1])
@pytest.mark.parametrize("impossible", [0, 2, 4])
def test_an_impossible_observation_leaves_finite_means_and_no_evidence(threshold, impossible):
    observations = OBSERVATIONS.copy()
    observations[impossible] = np.inf
    with np.errstate(over="raise", divide="raise"):
        result = run(7, observations, n_particles=200, resample_threshold=threshold)
    assert result.log_evidence == -np.inf
    np.testing.assert_array_equal(np.isneginf(result.log_evidence_increments), np.arange(5) == impossible)
    assert np.isfinite(result.means).all()
    assert np.isfinite(result.covariances).all()
    assert result.effective_sample_sizes[impossible] == pytest.approx(200)


def test_after_an_impossible_observation_the_particles_have_equal_weights():
    result = run(8, [np.inf])
    np.testing.assert_allclose(result.weights, 1 / 100)
    np.testing.assert_allclose(result.means[0], result.states.mean(axis=0))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        pytest.param({"observations": []}, "observations is empty", id="no observations"),
        pytest.param({"observations": iter(())}, "observations is empty", id="empty iterator"),
        pytest.param({"n_particles": 0}, "n_particles must be at least 1", id="no particles"),
        pytest.param({"n_particles": -5}, "n_particles must be at least 1", id="negative number of particles"),
        pytest.param({"initial": lambda n, rng: np.zeros(n)}, r"initial must return shape \(100, d\)", id="flat"),
        pytest.param({"initial": lambda n, rng: np.zeros((2, n))}, "initial must return shape", id="transposed"),
        pytest.param({"transition": lambda s, rng: s[:-1]}, "at step 1 the transition", id="a particle dropped"),
        pytest.param({"log_likelihood": lambda s, y: np.zeros((len(s), 1))}, "log_likelihood", id="column"),
        pytest.param({"log_likelihood": lambda s, y: 0.0}, "at step 0 log_likelihood", id="scalar"),
        pytest.param({"log_likelihood": lambda s, y: s[:, 0] * np.nan}, "NaN", id="NaN"),
    ],
)
def test_filter_rejects_what_it_cannot_work_with(changes, message):
    arguments = {
        "observations": OBSERVATIONS,
        "initial": draw_prior,
        "transition": move,
        "log_likelihood": log_density,
        "n_particles": 100,
        "rng": 0,
    }
    with pytest.raises(ValueError, match=message):
        smc.bootstrap_filter(**{**arguments, **changes})


@pytest.mark.parametrize(
    "transition",
    [
        pytest.param(lambda states, rng: None, id="forgot to return"),
        pytest.param(lambda states, rng: states[:, 0], id="flat"),
        pytest.param(lambda states, rng: states[:, :1], id="a dimension lost"),
    ],
)
def test_filter_names_the_transition_when_it_returns_the_wrong_shape(transition):
    with pytest.raises(ValueError, match="at step 1 the transition"):
        smc.bootstrap_filter(OBSERVATIONS, draw_prior, transition, log_density, 100, 0)
