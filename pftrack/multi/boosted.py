r"""The boosted particle filter of Okuma et al. 2004: a mixture of particle filters that detections start and steer.

The *mixture particle filter* (Vermaak et al. 2003) keeps one filtering distribution for all targets together, with one
component for each,

.. math::

    p(x_t \mid y_{1:t}) = \sum_j \pi_{j,t}\, p_j(x_t \mid y_{1:t}), \qquad
    \pi_{j,t} = \frac{\pi_{j,t-1}\, \tilde w_{j,t}}{\sum_k \pi_{k,t-1}\, \tilde w_{k,t}}, \qquad
    \tilde w_{j,t} = \sum_{i \in I_j} \tilde w_t^{(i)} .

Each component is a particle filter by itself, and particles are resampled within their component, so that no target
starves another. The components meet only in their shares :math:`\pi_j`, where :math:`\tilde w_{j,t}` estimates the
evidence of a component, and where two of them come to the same place.

The state :math:`x = (x, y, s)` is the centre and the scale of a box, which move by second-order autoregression (Perez
et al. 2002). The likelihood compares the colours of :math:`r = 2` halves of the box with those that the target had when
it was found, by the Hellinger distance :math:`\xi_r` of histograms with 10 x 10 bins of hue and saturation and 10 of
value:

.. math::

    x_t = x_{t-1} + A (x_{t-1} - x_{t-2}) + C v_t, \quad v_t \sim N(0, I), \qquad
    p(y \mid x) \propto \exp \Big( -\lambda \sum_r \xi_r^2 \Big), \quad \lambda = 20 .

*Boosting* is a better guess. Where detections are near a component, a share :math:`\alpha` of its particles is drawn
about them, and the weights are divided by the density of the whole proposal, so that detections change where the filter
looks, but not what it believes:

.. math::

    q_B(x_t \mid x_{t-1}, y_t) = \alpha\, q_{\text{ada}}(x_t \mid y_t) + (1 - \alpha)\, p(x_t \mid x_{t-1}), \qquad
    \tilde w_t^{(i)} = w_{t-1}^{(i)}\,
        \frac{p(y_t \mid x_t^{(i)})\, p(x_t^{(i)} \mid x_{t-1}^{(i)})}{q_B(x_t^{(i)} \mid x_{t-1}^{(i)}, y_t)} .

Detections that no component explains start new ones. ``pftrack reproduce comparison`` compares.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from pftrack import color, kernels, smc
from pftrack.adaboost import AdaBoostDetector
from pftrack.checks import check_picture, check_same_size, check_seed, is_shown
from pftrack.detection import merge
from pftrack.metrics import pairwise_overlap
from pftrack.multi.base import Track, check_detections, stream

N_LEVELS = 10
"""Levels of hue, of saturation and of value; 10 x 10 + 10 bins in all."""

FAINT, DARK = 0.1, 0.2
"""Saturation and value, from 0 to 1, up to which a pixel's hue means nothing."""

SCALES = (1 / 3, 3.0)
"""Smallest and largest scale of a target that can be believed."""


def color_bins(frame: np.ndarray) -> np.ndarray:
    """Histogram bin of every pixel by the scheme of Perez et al. 2002.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.

    Returns
    -------
    ndarray, shape (H, W), uint8
        ``10 * hue_level + saturation_level`` of a pixel with colour enough, from 0 to 99; ``100 + value_level`` of one
        that is pale or dark, from 100 to 109.

    Examples
    --------
    Pure blue has OpenCV hue 120 of 180; grey has none:

    >>> color_bins(np.uint8([[[255, 0, 0], [128, 128, 128]]]))
    array([[ 69, 105]], dtype=uint8)
    """
    hue, saturation, value = cv2.split(cv2.cvtColor(frame, cv2.COLOR_BGR2HSV))
    levels = np.arange(256) * N_LEVELS
    hues = cv2.LUT(hue, np.minimum(levels // 180, N_LEVELS - 1).astype(np.uint8))
    saturations, values = (cv2.LUT(channel, (levels // 256).astype(np.uint8)) for channel in (saturation, value))
    colored = (saturation > FAINT * 255) & (value > DARK * 255)
    return np.where(colored, hues * np.uint8(N_LEVELS) + saturations, values + np.uint8(N_LEVELS**2))


def _halves(boxes) -> np.ndarray:
    """Return the upper half of each box, followed by the lower; shape (2 N, 4)."""
    x, y, w, h = np.asarray(boxes, dtype=float).T
    return np.stack([x, y, w, h / 2, x, y + h / 2, w, h / 2], axis=1).reshape(-1, 4)


# ---------------------------------------------------------------------------------------------------------------------
# The proposal, and what it costs
# ---------------------------------------------------------------------------------------------------------------------


def propose(predicted, noise, centers, spread, alpha: float, rng: np.random.Generator) -> np.ndarray:
    r"""Draw particles from the proposal :math:`q_B`.

    Parameters
    ----------
    predicted : ndarray, shape (N, d)
        Mean of the transition of each particle.
    noise : ndarray, shape (d,)
        Standard deviations of the transition, above 0.
    centers : ndarray, shape (D, d)
        States that the detections propose; with several, each has the same share of :math:`q_{\text{ada}}`.
    spread : ndarray, shape (d,)
        Standard deviations about them, above 0.
    alpha : float
        Share of the detections in the proposal, from 0 to below 1; 0 where there are none.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    ndarray, shape (N, d)
        The particles.
    """
    steps = rng.standard_normal(predicted.shape)
    moved = predicted + noise * steps
    if alpha > 0:
        boosted = rng.random(len(moved)) < alpha
        chosen = rng.integers(len(centers), size=boosted.sum())
        moved[boosted] = centers[chosen] + spread * steps[boosted]
    return moved


def log_importance(states, predicted, noise, centers, spread, alpha: float) -> np.ndarray:
    r"""Logarithm of :math:`p(x_t \mid x_{t-1}) / q_B(x_t \mid x_{t-1}, y_t)` of particles drawn by :func:`propose`.

    Parameters
    ----------
    states : ndarray, shape (N, d)
        The particles.
    predicted, noise, centers, spread, alpha
        As for :func:`propose`.

    Returns
    -------
    ndarray, shape (N,)
        Log-ratios, at most ``-log(1 - alpha)``: however wrong the detections are, no weight explodes.

    Examples
    --------
    Where the transition would have gone anyway, detections far away make particles rarer, and so heavier; where it
    would not, particles drawn there weigh nothing:

    >>> there, zero, one = np.array([[0.0], [9.0]]), np.zeros((2, 1)), np.ones(1)
    >>> np.exp(log_importance(there, zero, one, np.array([[9.0]]), one, alpha=0.5)).round(6)
    array([2., 0.])
    """
    if alpha == 0:
        return np.zeros(len(states))
    log_transition = _log_normal(states, predicted, noise)
    log_each = _log_normal(states[:, None], centers, spread)
    log_detections = np.logaddexp.reduce(log_each, axis=1) - math.log(len(centers))
    return log_transition - np.logaddexp(math.log(alpha) + log_detections, math.log1p(-alpha) + log_transition)


def _log_normal(states, means, deviations) -> np.ndarray:
    """Return the logarithm of the density of independent Gaussians, summed over the last axis."""
    return (-0.5 * ((states - means) / deviations) ** 2 - np.log(deviations * math.sqrt(2 * math.pi))).sum(axis=-1)


def update_shares(log_shares, log_evidences) -> np.ndarray:
    r"""Shares :math:`\pi_{j,t}` of the components, from those before and the evidence of each.

    Parameters
    ----------
    log_shares : array_like, shape (M,)
        Logarithms of the shares before.
    log_evidences : array_like, shape (M,)
        Logarithms of :math:`\tilde w_{j,t}`, the sum of the unnormalised weights of each component.

    Returns
    -------
    ndarray, shape (M,)
        Logarithms of the shares, which sum to one.

    Examples
    --------
    >>> np.exp(update_shares(np.log([0.5, 0.5]), np.log([0.1, 0.3]))).round(6)
    array([0.25, 0.75])
    """
    total = np.add(log_shares, log_evidences)
    return total - smc.log_sum_exp(total)


# ---------------------------------------------------------------------------------------------------------------------
# The filter
# ---------------------------------------------------------------------------------------------------------------------


class BoostedParticleFilter:
    """Follow a varying number of targets by colour, with detections in the proposal (Okuma et al. 2004).

    Parameters
    ----------
    n_particles : int
        Particles of each target, at least 1.
    seed : int
        Seed of the random numbers; every target has its own stream.
    alpha : float
        Share of the proposal that is about detections, from 0 to below 1, where there are any near a target; without
        them, and with 0, the filter is the mixture particle filter. *Our choice.*
    noise : array_like, shape (3,)
        Standard deviations of the transition for one frame, above 0: of ``x`` and ``y`` relative to the target's
        height, and of its scale relative to itself. *Our choice.*
    detection_noise : array_like, shape (3,)
        The same of detections about the truth. *Our choice.*
    inertia : array_like, shape (3,)
        How much of the last step the next one repeats, from 0, a random walk, to 1, constant velocity; of ``x``, ``y``
        and the scale. *Our choice.*
    sharpness : float
        The factor of the squared distances in the likelihood, above 0; the paper's lambda.
    min_overlap : float
        Overlap from which a detection and a target belong together, above 0 and at most 1. *Our choice.*
    merge_overlap : float
        Overlap of two targets from which they are one, above 0; above 1 nobody is ever merged. *Our choice.*
    patience : int
        A target is given up after so many frames without a detection near it, at least 1. *Our choice.*
    detector : optional
        What finds pedestrians: anything with the method ``detect`` of
        :class:`~pftrack.detection.PedestrianDetector`; an :class:`~pftrack.adaboost.AdaBoostDetector` if not given.

    Raises
    ------
    ValueError
        If an argument is out of its range.

    Notes
    -----
    The score of a track is the likelihood of its best particle relative to a perfect match.

    Shares multiply up from frame to frame, so after some time one component has them all: it is the one that looks
    most like its template, and the others are no less real. They are kept as logarithms, and nobody dies of a small
    one; nor of a low score, since what is no pedestrian looks as much like its template as a pedestrian does.

    A target's colours are those of the detection that started it, for good. When two targets are merged, the younger
    ends; when they part, a detection starts a new one. There is no other splitting of components.

    The text of the paper was not at hand: what is called our choice may be printed there.

    Examples
    --------
    >>> import pftrack
    >>> scene = pftrack.datasets.load("synthetic-crossing")
    >>> tracker = BoostedParticleFilter(n_particles=50, seed=0)
    >>> found = [[*scene.target(id)[0], 1.0] for id in scene.ids]
    >>> [track.id for track in tracker.update(scene.frames[0], found)]
    [1, 2]
    >>> [track.id for track in tracker.update(scene.frames[1], [])]
    [1, 2]
    """

    def __init__(
        self,
        n_particles: int = 300,
        seed: int = 0,
        *,
        alpha: float = 0.5,
        noise=(0.03, 0.015, 0.01),
        detection_noise=(0.05, 0.05, 0.05),
        inertia=(1.0, 1.0, 0.0),
        sharpness: float = 20.0,
        min_overlap: float = 0.3,
        merge_overlap: float = 0.7,
        patience: int = 25,
        detector=None,
    ):
        if n_particles < 1 or patience < 1:
            raise ValueError(f"n_particles and patience must be at least 1, got {n_particles} and {patience}")
        check_seed(seed)
        if not 0 <= alpha < 1 or not 0 < sharpness < np.inf or not 0 < min_overlap <= 1 or not merge_overlap > 0:
            raise ValueError(
                "alpha must lie in [0, 1), min_overlap in (0, 1], and sharpness and merge_overlap must be positive, "
                f"got {alpha}, {min_overlap}, {sharpness} and {merge_overlap}"
            )
        self.noise, self.detection_noise = (_three(given, "noise") for given in (noise, detection_noise))
        self.inertia = _three(inertia, "inertia")
        if not (self.noise.min() > 0 and self.detection_noise.min() > 0):
            raise ValueError("standard deviations must be positive, or their density is none")
        if not 0 <= self.inertia.min() <= self.inertia.max() <= 1:
            raise ValueError(f"inertia must lie between 0 and 1, got {self.inertia.tolist()}")
        self.n_particles, self.seed, self.alpha, self.sharpness = int(n_particles), seed, alpha, sharpness
        self.min_overlap, self.merge_overlap, self.patience = min_overlap, merge_overlap, patience
        self.detector = AdaBoostDetector() if detector is None else detector
        self._components: list[_Component] = []
        self._shape, self._n_born = None, 0

    @property
    def shares(self) -> dict[int, float]:
        """Share of each target in the mixture, by its number; together 1."""
        return {each.track.id: math.exp(each.log_share) for each in self._components}

    def update(self, frame: np.ndarray, detections=None) -> list[Track]:
        """Follow all targets into the next frame.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The next frame.
        detections : array_like, shape (D, 5), optional
            ``x, y, w, h, score`` of the pedestrians in it; all are believed, whatever their score. By default the
            detector looks for them.

        Returns
        -------
        list of Track
            All targets, in the order of their numbers.

        Raises
        ------
        ValueError
            If the frame is no colour image, or not of the size of those before, or the detections are no boxes.
        """
        check_same_size(check_picture(frame).shape, self._shape)
        found = check_detections(self.detector.detect(frame) if detections is None else detections)[:, :4]
        self._shape = frame.shape
        bins = color_bins(frame)
        explained = np.zeros(len(found), dtype=bool)
        log_evidences = []
        for component in self._components:
            near = component.overlaps(found) >= self.min_overlap
            log_evidences.append(component.update(bins, found[near]))
            explained |= near | (pairwise_overlap([component.track.box], found)[0] >= self.min_overlap)
        if self._components:
            self._set_shares(update_shares([each.log_share for each in self._components], log_evidences))
        self._merge()
        self._bury(frame)
        self._bear(frame, bins, found[~explained])
        return [component.track for component in self._components]

    def _set_shares(self, log_shares) -> None:
        for component, log_share in zip(self._components, log_shares, strict=True):
            component.log_share = float(log_share)

    def _merge(self) -> None:
        """End components that have come to the place of an elder one, who inherits their shares."""
        kept: list[_Component] = []
        for component in self._components:
            overlaps = [pairwise_overlap([component.track.box], [elder.track.box])[0, 0] for elder in kept]
            if max(overlaps, default=0.0) < self.merge_overlap:
                kept.append(component)
            else:
                elder = kept[int(np.argmax(overlaps))]
                elder.log_share = float(np.logaddexp(elder.log_share, component.log_share))
        self._components = kept

    def _bury(self, frame) -> None:
        """End components that no detection was near for long, or that have left the frame."""
        self._components = [
            each for each in self._components if each.n_unsupported < self.patience and is_shown(each.track.box, frame)
        ]
        if self._components:
            self._set_shares(update_shares([each.log_share for each in self._components], 0.0))

    def _bear(self, frame, bins, found) -> None:
        """Start a component with each detection that none explains; all newcomers get an average share."""
        boxes, _, _ = merge(found, np.ones(len(found)), overlap=self.min_overlap)
        for box in boxes:
            if is_shown(box, frame):
                self._n_born += 1
                newcomer = _Component(self._n_born, box, bins, self)
                self._components.append(newcomer)
                n = len(self._components)
                log_shares = [each.log_share + math.log1p(-1 / n) if n > 1 else 0 for each in self._components[:-1]]
                self._set_shares([*log_shares, -math.log(n)])


class _Component:
    """One component of the mixture: a target's colours, its particles and its share."""

    def __init__(self, number: int, box: np.ndarray, bins: np.ndarray, settings: BoostedParticleFilter):
        self.settings = settings
        self.rng = stream(settings.seed, number)
        x, y, w, h = box
        self.size = np.array([w, h])
        self.colors = kernels.palette(color.histograms(bins, _halves([box]), outside="ignore"))
        spread = settings.detection_noise * [h, h, 1.0]
        self.previous = np.tile([x + w / 2, y + h / 2, 1.0], (settings.n_particles, 1))
        self.states = self.previous + spread * self.rng.standard_normal(self.previous.shape)
        self.log_share, self.n_unsupported = 0.0, 0
        self.track = Track(number, box, 1.0)
        self._predict()

    def _predict(self) -> None:
        """Find the mean of the transition of each particle."""
        self.predicted = self.states + self.settings.inertia * (self.states - self.previous)

    def overlaps(self, boxes) -> np.ndarray:
        """Return the overlap of boxes with where the target is expected."""
        x, y, w, h = self._rectangles(self.predicted).mean(axis=0)
        return pairwise_overlap([[x - w / 2, y - h / 2, w, h]], boxes)[0]

    def _rectangles(self, states) -> np.ndarray:
        """Return the rectangles of states, ``[x, y, w, h]`` with `x` and `y` of the centre."""
        return np.hstack([states[:, :2], states[:, 2:] * self.size])

    def update(self, bins: np.ndarray, found: np.ndarray) -> float:
        """Propose, weigh, estimate and resample, with the detections that are near; return the log-evidence."""
        settings = self.settings
        height = self.track.box[3]
        unit = np.array([height, height, height / self.size[1]])
        centers = np.column_stack([found[:, :2] + found[:, 2:] / 2, found[:, 3] / self.size[1]])
        alpha = settings.alpha if len(found) else 0.0
        proposal = self.predicted, settings.noise * unit, centers, settings.detection_noise * unit, alpha
        moved = propose(*proposal, self.rng)
        particles = self._rectangles(moved)
        log_likelihoods = self._log_likelihoods(bins, particles, moved[:, 2])
        log_weights = log_likelihoods + log_importance(moved, *proposal) - math.log(len(moved))
        weights = smc.normalize(log_weights)
        x, y, w, h = smc.weighted_mean(particles, weights)
        box, score = np.array([x - w / 2, y - h / 2, w, h]), math.exp(log_likelihoods.max())
        self.track = Track(self.track.id, box, score, particles=particles, weights=weights)
        self.n_unsupported = 0 if len(found) else self.n_unsupported + 1
        ancestors = smc.systematic(weights, self.rng)
        self.states, self.previous = moved[ancestors], self.states[ancestors]
        self._predict()
        return smc.log_sum_exp(log_weights)

    def _log_likelihoods(self, bins, particles, scales) -> np.ndarray:
        """Compare the colours of both halves of many rectangles with the target's (Perez et al. 2002)."""
        x, y, w, h = particles.T
        edges = color.pixel_edges(_halves(np.column_stack([x - w / 2, y - h / 2, w, h])))
        squares = 1 - kernels.similarities(bins, edges, self.colors).reshape(-1, 2)
        squares[(scales < SCALES[0]) | (scales > SCALES[1])] = 1  # like nothing at all
        return -self.settings.sharpness * squares.sum(axis=1)


def _three(given, name: str) -> np.ndarray:
    given = np.asarray(given, dtype=float)
    if given.shape != (3,) or not np.isfinite(given).all():
        raise ValueError(f"{name} must be three finite numbers, of x, y and scale, got {given.tolist()}")
    return given
