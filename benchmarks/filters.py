"""The same resampling schemes, and the same bootstrap filter, by the Python packages that have them."""

import datetime
from functools import partial

import numpy as np
import particles
import pfilter
from filterpy import monte_carlo
from particles import distributions, resampling, state_space_models
from particles.collectors import Moments
from stonesoup.base import Property
from stonesoup.models.measurement.base import MeasurementModel
from stonesoup.models.transition.base import TransitionModel
from stonesoup.predictor.particle import ParticlePredictor
from stonesoup.resampler.particle import ESSResampler, SystematicResampler
from stonesoup.types.array import StateVectors
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.state import ParticleState
from stonesoup.updater.particle import ParticleUpdater

from pftrack import smc

VARIANCE = 10.0
"""Of the noise of the growth model; that of the observation is 1, that of the first state 4."""


def resamplers(n: int) -> dict[str, dict]:
    """Functions that draw `n` ancestors from `n` weights, by scheme and package."""
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(n))
    state = ParticleState(StateVectors(np.zeros((1, n))), log_weight=np.log(weights))
    stonesoup = SystematicResampler()
    schemes = {
        name: {
            "pftrack": partial(getattr(smc, name), weights, rng),
            "particles": partial(getattr(resampling, name), weights),
        }
        for name in ("systematic", "stratified", "multinomial", "residual")
    }
    schemes["systematic"] |= {
        "filterpy": lambda: monte_carlo.systematic_resample(weights),
        "pfilter": lambda: pfilter.systematic_resample(weights),
        "stonesoup": lambda: stonesoup.resample(state),
    }
    return schemes


def grow(x, t: int):
    """Where the growth model goes without noise (Gordon et al. 1993)."""
    return x / 2 + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * t)


def growth_filters(n_particles: int, n_steps: int, n_runs: int = 20):
    """Bootstrap filters of one simulated series, by package, and their mean errors over some seeds."""
    rng = np.random.default_rng(1)
    truth = np.empty(n_steps)
    truth[0] = 2 * rng.standard_normal()
    for t in range(1, n_steps):
        truth[t] = grow(truth[t - 1], t) + np.sqrt(VARIANCE) * rng.standard_normal()
    series = truth**2 / 20 + rng.standard_normal(n_steps)
    filters = {
        "pftrack": lambda: with_pftrack(series, n_particles, rng),
        "particles": lambda: with_particles(series, n_particles),
        "pfilter": lambda: with_pfilter(series, n_particles),
        "stonesoup": lambda: with_stonesoup(series, n_particles),
    }
    np.random.seed(0)  # noqa: NPY002  the other packages draw from NumPy's global generator
    errors = {}
    for name, run in filters.items():
        errors[name] = np.mean([np.sqrt(np.mean((run() - truth) ** 2)) for _ in range(n_runs)])
    return filters, errors


def with_pftrack(series, n_particles, rng):
    """Means by :func:`pftrack.smc.bootstrap_filter`."""
    steps = iter(range(1, len(series)))
    return smc.bootstrap_filter(
        series,
        initial=lambda n, rng: 2 * rng.standard_normal((n, 1)),
        transition=lambda x, rng: grow(x, next(steps)) + np.sqrt(VARIANCE) * rng.standard_normal(x.shape),
        log_likelihood=lambda x, y: -0.5 * (y - x[:, 0] ** 2 / 20) ** 2,
        n_particles=n_particles,
        rng=rng,
    ).means[:, 0]


class Growth(state_space_models.StateSpaceModel):
    """The growth model, for `particles`."""

    def PX0(self):
        """Distribution of the first state."""
        return distributions.Normal(scale=2.0)

    def PX(self, t, xp):
        """Distribution of the next state."""
        return distributions.Normal(loc=grow(xp, t), scale=np.sqrt(VARIANCE))

    def PY(self, t, xp, x):
        """Distribution of an observation."""
        return distributions.Normal(loc=x**2 / 20, scale=1.0)


def with_particles(series, n_particles):
    """Means by `particles`."""
    model = state_space_models.Bootstrap(ssm=Growth(), data=series)
    run = particles.SMC(fk=model, N=n_particles, resampling="systematic", ESSrmin=0.5, collect=[Moments()])
    run.run()
    return np.array([moment["mean"] for moment in run.summaries.moments])


def with_pfilter(series, n_particles):
    """Means by `pfilter`; it predicts before the first observation too, so its first state is drawn without noise."""
    clock = iter(range(len(series)))

    def dynamics(x):
        t = next(clock)
        return grow(x, t) if t else x

    def noise(x):
        return x + (np.sqrt(VARIANCE) * np.random.randn(*x.shape) if noise.begun else 0)  # noqa: NPY002

    noise.begun = False
    run = pfilter.ParticleFilter(
        prior_fn=lambda n: 2 * np.random.randn(n, 1),  # noqa: NPY002
        observe_fn=lambda x: x**2 / 20,
        dynamics_fn=dynamics,
        noise_fn=noise,
        weight_fn=lambda seen, y: np.exp(-0.5 * (y - seen) ** 2)[:, 0],
        n_particles=n_particles,
        n_eff_threshold=0.5,
        resample_proportion=0.0,
    )
    means = []
    for y in series:
        run.update(np.array([y]))
        noise.begun = True
        means.append(run.mean_state[0])
    return np.array(means)


class StoneSoupGrowth(TransitionModel):
    """The growth model, for Stone Soup; a second is a step."""

    start: datetime.datetime = Property()

    @property
    def ndim_state(self):
        """Dimension of the state."""
        return 1

    def function(self, state, noise=False, time_interval=None, **_):
        """Move all particles."""
        t = round((state.timestamp - self.start + time_interval).total_seconds())
        moved = grow(np.asarray(state.state_vector, dtype=float), t)
        return StateVectors(moved + np.sqrt(VARIANCE) * np.random.randn(*moved.shape))  # noqa: NPY002

    def rvs(self, *_, **__):
        """Not needed."""
        raise NotImplementedError

    def pdf(self, *_, **__):
        """Not needed."""
        raise NotImplementedError


class StoneSoupSquare(MeasurementModel):
    """The observation of the growth model, for Stone Soup."""

    @property
    def ndim_meas(self):
        """Dimension of an observation."""
        return 1

    def function(self, state, noise=False, **_):
        """Observe all particles."""
        return np.asarray(state.state_vector, dtype=float) ** 2 / 20

    def logpdf(self, detection, state, **_):
        """Weigh all particles."""
        return -0.5 * (float(detection.state_vector[0, 0]) - self.function(state)[0]) ** 2

    def rvs(self, *_, **__):
        """Not needed."""
        raise NotImplementedError

    def pdf(self, *_, **__):
        """Not needed."""
        raise NotImplementedError


def with_stonesoup(series, n_particles):
    """Means by Stone Soup, which returns the particles after resampling."""
    start = datetime.datetime(2000, 1, 1)
    predictor = ParticlePredictor(StoneSoupGrowth(start=start))
    updater = ParticleUpdater(StoneSoupSquare(ndim_state=1, mapping=[0]), ESSResampler(resampler=SystematicResampler()))
    vectors = StateVectors(2 * np.random.randn(1, n_particles))  # noqa: NPY002
    weights = np.full(n_particles, -np.log(n_particles))
    state, means = ParticleState(vectors, log_weight=weights, timestamp=start), []
    for t, y in enumerate(series):
        now = start + datetime.timedelta(seconds=t)
        prediction = predictor.predict(state, timestamp=now) if t else state
        state = updater.update(SingleHypothesis(prediction, Detection(np.array([[y]]), timestamp=now)))
        means.append(float(np.asarray(state.mean, dtype=float)[0, 0]))
    return np.array(means)
