r"""A target of Li et al. 2016 to the letter: observed in a confidence map, and associated by looks of the same frame.

Each target has prior knowledge of its own (section 3): superpixels of its latest five frames, clustered, with the
confidence of eq. 1. In a new frame its surroundings are cut into superpixels, painted with their confidences (eq. 2),
and boxes of the last size drawn at random; the one with the most confident centre is what is *observed* of it. Then
every particle is compared with every observation, feature by feature,

.. math:: \mathrm{sim}^f_{ij} = \frac{1}{\sqrt{2\pi}\,\sigma^2} e^{-d^2[y_{it}, y_{jt}] / 2\sigma^2}

(eq. 7, with :math:`d` one less the intersection of the histograms), the features are weighed by how widely their
similarities spread over the particles (eq. 9),

.. math::

    a = \frac{w_{\text{colour}}}{w_{\text{colour}} + w_{\text{LBP}}}, \quad b = 1 - a, \qquad
    w_f = \max_k \mathrm{sim}^f_{ij} - \min_k \mathrm{sim}^f_{ij},

and :math:`c_{ij}` is the largest weighted sum among the particles (eq. 8). The constant in front of eq. 7 is left out:
it is printed with :math:`\sigma^2` where a normal density has :math:`\sigma`, is the same in all entries, and is 1
where two histograms agree without it, which lets "approximately zero" mean something.

The histograms of eq. 7 are both of the present frame. So :math:`c_{ij}` is large wherever a particle lies on the
observation, whoever that is: the matrix says who is *near*, and remembers no looks at all.
"""

from __future__ import annotations

import numpy as np

from pftrack import codebook, motion, smc, superpixels
from pftrack.multi.base import Track
from pftrack.multi.looks import Picture, bands

CLUSTER_EVERY = 25
"""Frames from one clustering of the prior knowledge to the next; it takes longer than all the rest."""


def similarities(squared_distances, sigma: float) -> np.ndarray:
    """Similarity of features, from their distance (Li et al. 2016, eq. 7 without its constant).

    Parameters
    ----------
    squared_distances : array_like
        Squares of distances, 0 or more.
    sigma : float
        Standard deviation, above 0.

    Returns
    -------
    ndarray
        From 0 to 1, of the same shape.

    Examples
    --------
    >>> similarities([0.0, 0.04], sigma=0.2).round(3)
    array([1.   , 0.607])
    """
    return np.exp(-np.asarray(squared_distances, dtype=float) / (2 * sigma**2))


def feature_weights(similarities) -> np.ndarray:
    """Weights `a` and `b` of the features, from how well each tells the particles apart (Li et al. 2016, eq. 9).

    Parameters
    ----------
    similarities : array_like, shape (2, ..., N)
        Of colour and of texture, for each of `N` particles.

    Returns
    -------
    ndarray, shape (2, ...)
        They are at least 0, and together 1; one half each where neither feature tells anything.

    Examples
    --------
    >>> feature_weights([[0.2, 0.8], [0.5, 0.7]])
    array([0.75, 0.25])
    """
    ranges = np.ptp(np.asarray(similarities, dtype=float), axis=-1)
    total = ranges.sum(axis=0)
    return np.where(total > 1e-12, ranges / np.maximum(total, 1e-12), 0.5)


class PrintedTarget:
    """Somebody who is followed as Li et al. 2016 print it; what their paper leaves open is said at the constants.

    Parameters
    ----------
    number : int
        Number of the target.
    boxes : sequence of array_like, shape (4,)
        Where it was in the latest frames, ``(x, y, w, h)`` in pixels.
    frames : sequence of ndarray, shape (H, W, 3), uint8
        These frames.
    settings : AssociationParticleFilter
        The tracker; its number of particles and its first `sigma`, for both features, are used.
    rng : numpy.random.Generator
        Source of randomness.
    """

    N_TRAINING = 5
    """Frames that prior knowledge is made of (Table 1)."""

    N_SUPERPIXELS = 200
    """About how many superpixels the surroundings have (Table 1)."""

    N_SAMPLES = 300
    """Boxes drawn from the confidence map. *Not printed.*"""

    NOISE = (0.05, 0.02, 0.01, 0.01)
    """Standard deviations of eq. 4, of the centre relative to the height and of the size to itself. *Not printed.*"""

    LEAST = 0.05
    """What is "approximately zero", and the threshold TH of Algorithm 1. *Not printed.*"""

    def __init__(self, number: int, boxes, frames, settings, rng: np.random.Generator):
        self.settings, self.rng = settings, rng
        self.box = np.array(boxes[-1], dtype=float)
        self.known: list[tuple[np.ndarray, np.ndarray]] = []
        for frame, box in zip(frames, boxes, strict=True):
            found = superpixels.cut(frame, superpixels.surroundings(box, frame.shape), self.N_SUPERPIXELS)
            self._remember(found, box)
        self.prior, self.n_since = self._cluster(), 0
        x, y, w, h = self.box
        self.states = np.tile([x + w / 2, y + h / 2, w, h], (settings.n_particles, 1))
        self.n_absent, self.missing, self.trust = 0, False, settings.n_frames
        self.track = Track(number, self.box, 1.0)

    @property
    def feet(self) -> float:
        """Lower edge of the box."""
        return self.box[1] + self.box[3]

    def _remember(self, found: superpixels.Superpixels, box) -> None:
        of_one = found.features, superpixels.areas(found, box)
        self.known = [*self.known, of_one][-self.N_TRAINING :]

    def _cluster(self) -> superpixels.PriorKnowledge:
        features, areas = zip(*self.known, strict=True)
        return superpixels.cluster(np.concatenate(features), np.concatenate(areas, axis=1))

    def predict(self, shift: np.ndarray) -> None:
        """Move the particles by random perturbation alone (eq. 4)."""
        _, _, w, h = self.box
        self.states = motion.random_walk(self.states, np.array(self.NOISE) * [h, h, w, h], self.rng)
        self.states[:, 2:] = self.states[:, 2:].clip([w / 3, h / 3], [3 * w, 3 * h])

    def observe(self, frame: np.ndarray) -> np.ndarray | None:
        """Find the target in its confidence map, and update its prior knowledge (Algorithm 1, steps 1.5 to 1.8).

        Returns
        -------
        ndarray, shape (5,), or None
            ``x, y, w, h, confidence``; None where everything is rather background, or outside the frame.
        """
        try:
            region = superpixels.surroundings(self.box, frame.shape)
        except ValueError:  # out of the frame
            return None
        found = superpixels.cut(frame, region, self.N_SUPERPIXELS)
        painted = superpixels.paint(found, superpixels.confidences(found.features, self.prior), frame.shape)
        boxes = superpixels.sample_boxes(self.box, frame.shape, self.N_SAMPLES, self.rng)
        values = superpixels.box_confidences(painted, boxes, at_center=True)
        best = values.argmax()
        if values[best] <= 0:
            return None
        self._remember(found, boxes[best])
        self.n_since += 1
        if self.n_since % CLUSTER_EVERY == 0:
            self.prior = self._cluster()
        return np.append(boxes[best], values[best])

    def associate(self, picture: Picture, observations: np.ndarray) -> np.ndarray:
        """Compare all particles with all observations, and return the column of the incidence matrix (eqs 7 to 9)."""
        x, y, w, h = self.states.T
        of_particles = picture.histograms(bands(np.column_stack([x - w / 2, y - h / 2, w, h]), 1, middle=1.0))
        of_observations = picture.histograms(bands(observations[:, :4], 1, middle=1.0))
        alike = [
            [codebook.intersection(observed, particles) for observed in each]
            for each, particles in zip(of_observations, of_particles, strict=True)
        ]
        squares = (1 - np.reshape(alike, (2, len(observations), len(self.states)))) ** 2
        found = similarities(squares, self.settings.sigma[0])
        self.shares = feature_weights(found)
        self.likelihoods = (self.shares[..., None] * found).sum(axis=0)
        self.observations = observations
        return self.likelihoods.max(axis=1, initial=0)

    def update(self, picture: Picture, observation) -> None:
        """Weigh the particles by their similarity with the observation; hold the state where there is none (4.3)."""
        moved = self.states
        if observation is None:
            self.n_absent += 1
            self.track = Track(self.track.id, self.box, 0.0, True, moved)
            return
        self.n_absent = 0
        (i,) = np.flatnonzero((self.observations == observation).all(axis=1))[:1]
        weights = self.likelihoods[i] / self.likelihoods[i].sum()
        x, y, w, h = smc.weighted_mean(moved, weights)
        self.box = np.array([x - w / 2, y - h / 2, w, h])
        self.states = moved[smc.systematic(weights, self.rng)]
        score, color_weight = float(self.likelihoods[i].max()), float(self.shares[0, i])
        self.track = Track(self.track.id, self.box, score, False, moved, weights, color_weight)
