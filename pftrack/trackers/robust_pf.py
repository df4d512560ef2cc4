r"""The robust particle filter: the colour particle filter of Owczarek et al. 2015, with its weaknesses mended.

Our own, not in any paper. Chapter 7 adds one step at a time and measures it. What differs from
:class:`~pftrack.trackers.color_pf.ColorParticleFilter`:

- *Where the colours are.* Six bands, from head to feet, each have their own histogram; a margin at both sides, which
  shows mostly background, is left out.
- *Shape.* A linear template (:mod:`pftrack.template`) predicts from gradients and colours how well a box fits. With
  the mean squared distance :math:`\bar d^2` of the bands and the template's prediction `f`, a particle's likelihood is
  :math:`\exp(-\bar d^2 / 2\sigma^2 + \lambda f)`.
- *Learning.* Both models follow the target's looks in frames in which the estimate is good by both cues; half of what
  the colours say, and a part of the template, stays with the first frame, the only one whose box is known to be true.
- *The camera.* The cloud moves with the background before the noise is added, a random walk in units of the target's
  own size.
- *Loss.* The target is lost when both cues have stayed well below their own recent levels for some frames. A quarter of
  the particles is then drawn anew, half of them near, half anywhere, with weights that make up for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from pftrack import color, kernels, motion, smc, template
from pftrack.checks import check_box, check_seed
from pftrack.trackers.base import Estimate, Prepared, check_frame, check_started

SCALE_LIMITS = 0.3, 3.0
"""Bounds of the scale, relative to the first frame."""

FRESH_SCALES = 0.5, 1.5
"""Scales of particles drawn anywhere in the image."""

NEAR = np.array([1.0, 0.2, 0.2])
"""Spread of particles drawn near: in widths, in heights, and of the logarithm of the scale."""

JUMP = 0.01
"""Prior probability, in each frame while it is lost, that the target is where no particle has followed it."""

BAD_COLOR, BAD_TEMPLATE = 1.25, 0.7
"""A frame is bad when the distance is above, and the template below, these multiples of their running levels."""

GOOD_COLOR, GOOD_TEMPLATE = 1.1, 0.85
"""A frame is good enough to learn from when the distance is below, and the template above, these multiples."""

LEVEL_RATE, BAD_LEVEL_RATE = 0.05, 0.01
"""Share of the newest frame in the running levels, and its share in a bad frame."""

KEPT = 0.5
"""Share of the first frame's histograms that is never forgotten."""

TEMPLATE_PERIOD = 5
"""Frames between two lessons of the template."""


@dataclass(frozen=True)
class Description(Prepared):
    """What the filter derives from a frame alone; see :meth:`RobustParticleFilter.prepare`.

    Attributes
    ----------
    bins : ndarray, shape (H, W), uint8, or None
        Histogram bin of every pixel; None where bins and channels are made only of the parts that are asked for.
    frame : ndarray, shape (H, W, 3), uint8
        The frame itself.
    gray : ndarray, uint8
        A reduced grey copy, to see how the camera moves.
    shift : ndarray, shape (2,)
        How far the background has moved since the frame before, in pixels.
    """

    frame: np.ndarray
    gray: np.ndarray
    shift: np.ndarray
    _channels: dict = field(default_factory=dict)

    @property
    def picture(self) -> np.ndarray:
        """The bin image, or the frame where there is none."""
        return self.frame if self.bins is None else self.bins

    def channels(self, width: float) -> tuple[np.ndarray | template.PartialChannels, int]:
        """Return the channels for a target of a given width, and the side of their pixels."""
        if width not in self._channels:
            if self.bins is None:
                part = template.PartialChannels(self.frame, width)
                self._channels[width] = part, part.side
            else:
                self._channels[width] = template.reduced_channels(self.frame, width)
        return self._channels[width]


class RobustParticleFilter:
    """Track one target by its colours and its shape, through occlusions and camera motion.

    Parameters
    ----------
    n_particles : int
        Number of particles `N`, at least 1.
    seed : int or numpy.random.Generator
        Seed of the random numbers; every call of `init` starts again from it. A generator is used as it is.
    sigma : float
        Standard deviation of the root mean square distance of the bands, above 0.
    noise : array_like, shape (3,)
        Standard deviations of a frame's random step: along x in widths of the target, along y in its heights, and of
        the logarithm of its scale.
    n_bands : int
        Number of horizontal bands with a histogram each, at least 1.
    side_margin : float
        Share of the width left out at either side, from 0 to below 0.5.
    template_weight : float
        Weight of the template's prediction in the log-likelihood; 0 leaves the template out.
    learning_rate : float
        Share of a good frame in the running histograms, from 0 (never learn) to 1.
    follow_camera : bool
        Whether the particles move with the background.
    redraw : float
        Share of the particles drawn anew in each frame while the target is lost, from 0 (none) to below 1.
    patience : int
        Bad frames in a row after which the target is lost.
    resample_threshold : float
        Resample when the effective sample size falls below this share of `N`, from 0 (never) to 1.

    Raises
    ------
    ValueError
        If an argument is out of its range.

    Notes
    -----
    Particles are ``[x, y, k]``: the centre in pixels and the scale relative to the first box. The score of an estimate
    is 1 minus the distance of the colours at the mean state, from 0 to 1. All settings are relative to the size of the
    target, and one set of defaults serves all sequences.

    Examples
    --------
    >>> from pftrack import datasets, track
    >>> scene = datasets.load("synthetic-occlusion")
    >>> boxes = track(RobustParticleFilter(seed=0), scene.frames[:10], scene.boxes[0])
    >>> bool(np.abs(boxes - scene.boxes[:10]).max() < 5)
    True
    """

    def __init__(
        self,
        n_particles: int = 100,
        seed: int | np.random.Generator = 0,
        *,
        sigma: float = 0.1,
        noise=(0.2, 0.05, 0.02),
        n_bands: int = 6,
        side_margin: float = 0.15,
        template_weight: float = 20.0,
        learning_rate: float = 0.05,
        follow_camera: bool = True,
        redraw: float = 0.25,
        patience: int = 3,
        resample_threshold: float = 0.5,
    ):
        if n_particles < 1 or n_bands < 1 or patience < 1:
            raise ValueError(
                f"n_particles, n_bands and patience must be at least 1, got {n_particles}, {n_bands} and {patience}"
            )
        check_seed(seed)
        if not 0 < sigma < np.inf or not 0 <= template_weight < np.inf:
            raise ValueError(
                f"sigma must be positive and template_weight not negative, got {sigma} and {template_weight}"
            )
        noise = np.asarray(noise, dtype=float)
        if noise.shape != (3,) or not np.all((noise >= 0) & np.isfinite(noise)):
            raise ValueError(f"noise must be three standard deviations, none negative or NaN, got {noise.tolist()}")
        if not 0 <= side_margin < 0.5 or not 0 <= redraw < 1:
            raise ValueError(
                f"side_margin must lie in 0 to 0.5 and redraw in 0 to 1, below the end, got {side_margin} and {redraw}"
            )
        if not 0 <= learning_rate <= 1 or not 0 <= resample_threshold <= 1:
            raise ValueError(
                "learning_rate and resample_threshold must lie between 0 and 1, "
                f"got {learning_rate} and {resample_threshold}"
            )
        self.n_particles, self.seed, self.sigma, self.noise = int(n_particles), seed, sigma, noise
        self.n_bands, self.side_margin = int(n_bands), side_margin
        self.template_weight, self.learning_rate = template_weight, learning_rate
        self.follow_camera, self.redraw, self.patience = follow_camera, redraw, patience
        self.resample_threshold = resample_threshold
        self._shape = self._gray = None

    def prepare(self, frame: np.ndarray) -> Description:
        """Compute what depends on the film alone; call it once for each frame, in order.

        Trackers that differ in their seed or settings can share it when they see the same film: `init` and `update`
        take it in place of the frame, with the same result.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The next frame.

        Returns
        -------
        Description
            Bins, camera shift, and channels on demand.

        Raises
        ------
        ValueError
            If the frame is unusable.
        """
        return self._describe(frame, whole=True)

    def _describe(self, frame: np.ndarray, whole: bool) -> Description:
        frame = check_frame(frame)
        before, self._gray = self._gray, motion.reduced_gray(frame)
        shift = np.zeros(2)
        if before is not None and before.shape == self._gray.shape:
            shift = motion.camera_shift(before, self._gray) * frame.shape[1] / self._gray.shape[1]
        bins = color.hsv_bins(frame) if whole else None
        return Description(frame.shape, bins, frame, self._gray, shift)

    def init(self, frame: np.ndarray | Description, box) -> Estimate:
        """Learn the target's colours and shape, and place all particles on it.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The first frame.
        box : array_like, shape (4,)
            The target in it, ``(x, y, w, h)`` in pixels.

        Returns
        -------
        Estimate
            The given box, with score 1.

        Raises
        ------
        ValueError
            If the frame or the box is unusable.
        """
        look = self._look(frame)
        box = check_box(box, look)
        self.rng = np.random.default_rng(self.seed)
        self.size, self._shape, self._n_updates, self._n_bad = box[2:], look.shape, 0, 0
        self._first_targets = self._running_targets = self._histograms(look, box)
        self.palette = kernels.palette(self._first_targets)
        self.template = template.RidgeTemplate(self.rng) if self.template_weight else None
        if self.template:
            self._learn_template(look, box)
        distance, fit = self._cues(look, box[None])
        self._color_level, self._template_level = max(distance[0], 0.2), fit[0]
        self.particles = np.tile([*(box[:2] + box[2:] / 2), 1.0], (self.n_particles, 1))
        self.log_weights = np.zeros(self.n_particles)
        self._mean = self._last_seen = self.particles[0]
        return Estimate(box, 1.0, lost=False, particles=self.particles, weights=smc.normalize(self.log_weights))

    def update(self, frame: np.ndarray | Description) -> Estimate:
        """Predict, weigh, estimate, judge, learn and, where needed, resample.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The next frame, of the size of the first.

        Returns
        -------
        Estimate
            The rectangle of the mean state, its score, whether the target is lost, and the weighted particles before
            any resampling.

        Raises
        ------
        ValueError
            If the frame is unusable, or `init` was not called.
        """
        look = check_frame(self._look(frame), check_started(self._shape))
        particles, log_weights = self._predict(look)
        distances, fits = self._cues(look, self._boxes(particles))
        log_weights = log_weights - distances**2 / (2 * self.sigma**2) + self.template_weight * fits
        weights, self._mean, n_effective, _ = kernels.weigh(log_weights, particles)
        box = self._boxes(self._mean[None])[0]
        (distance,), (fit,) = self._cues(look, box[None])
        self._judge_and_learn(look, box, distance, fit)
        estimate = Estimate(box, float(1 - distance), self._is_lost, particles, weights)
        if n_effective < self.resample_threshold * self.n_particles:
            particles = particles.take(smc.systematic(weights, self.rng), axis=0)
            log_weights = np.zeros(self.n_particles)
        self.particles, self.log_weights = particles, log_weights
        return estimate

    @property
    def _is_lost(self) -> bool:
        return self._n_bad >= self.patience

    def _look(self, frame) -> Description:
        return frame if isinstance(frame, Description) else self._describe(frame, whole=False)

    def _boxes(self, particles: np.ndarray) -> np.ndarray:
        sizes = particles[:, 2:] * self.size
        return np.concatenate([particles[:, :2] - sizes / 2, sizes], axis=1)

    def _predict(self, look: Description) -> tuple[np.ndarray, np.ndarray]:
        """Move the particles with the camera and at random; draw some anew while the target is lost."""
        particles = self.particles.copy()
        if self.follow_camera:
            particles[:, :2] += look.shift
            self._last_seen = self._last_seen + [*look.shift, 0]
        steps = self.noise * self.rng.standard_normal(particles.shape)
        particles[:, :2] += steps[:, :2] * self.size * particles[:, 2:]
        particles[:, 2] = np.clip(particles[:, 2] * np.exp(steps[:, 2]), *SCALE_LIMITS)
        n_new = int(self.redraw * self.n_particles)
        if not self._is_lost or n_new == 0:
            return particles, self.log_weights
        order = self.rng.permutation(self.n_particles)
        new, kept = order[:n_new], order[n_new:]
        particles[new] = self._redrawn(n_new)
        share = n_new / self.n_particles  # of the proposal; the prior has JUMP
        log_weights = np.log(smc.normalize(self.log_weights) * self.n_particles)
        log_weights[kept] += math.log((1 - JUMP) / (1 - share))
        log_weights[new] = math.log(JUMP / share)
        return particles, log_weights

    def _redrawn(self, n: int) -> np.ndarray:
        """Draw `n` particles, half of them near where the target was last seen, half anywhere in the image."""
        height, width = self._shape[:2]
        n_near = n // 2
        steps = NEAR * self.rng.standard_normal((n_near, 3))
        near = self._last_seen + steps * [*self.size, 0]
        near[:, 2] = np.clip(self._last_seen[2] * np.exp(steps[:, 2]), *SCALE_LIMITS)
        low, high = zip((0, width), (0, height), FRESH_SCALES, strict=True)
        return np.concatenate([near, self.rng.uniform(low, high, (n - n_near, 3))])

    def _bands(self, boxes: np.ndarray) -> np.ndarray:
        """Edges of the bands of boxes, shape (N * n_bands, 4), from head to feet."""
        x, y, w, h = boxes.T[..., None]
        left, tops = x + self.side_margin * w, y + h * np.arange(self.n_bands) / self.n_bands
        edges = np.empty((len(boxes), self.n_bands, 4))
        edges[..., 0], edges[..., 2] = left, left + (1 - 2 * self.side_margin) * w
        edges[..., 1], edges[..., 3] = tops, tops + h / self.n_bands
        return np.floor(edges.reshape(-1, 4) + 0.5).astype(int)  # each to the nearest pixel, as color.pixel_edges

    def _histograms(self, look: Description, box: np.ndarray) -> np.ndarray:
        """Histogram of each band of one box, shape (n_bands, 256)."""
        edges = self._bands(box[None])
        return color.histograms(look.picture, np.column_stack([edges[:, :2], edges[:, 2:] - edges[:, :2]]), "ignore")

    def _cues(self, look: Description, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Root mean square Hellinger distance of the bands, and the template's prediction, of each box."""
        edges = self._bands(boxes)
        bins, origin = color.covered_bins(look.picture, edges)
        similarity = kernels.similarities(bins, edges, self.palette, origin=origin)
        distances = np.sqrt(1 - similarity.reshape(len(boxes), -1).mean(axis=1))
        if self.template is None:
            return distances, np.zeros(len(boxes))
        channels, side = look.channels(self.size[0])
        return distances, self.template.predict(channels, boxes / side)

    def _judge_and_learn(self, look: Description, box: np.ndarray, distance: float, fit: float) -> None:
        """Compare both cues at the estimate with their running levels, and learn from a good frame."""
        height, width = self._shape[:2]
        shape_known = self.template is not None
        bad = distance > BAD_COLOR * self._color_level and not (
            shape_known and fit > BAD_TEMPLATE * self._template_level
        )
        off = not (0 <= self._mean[0] < width and 0 <= self._mean[1] < height)
        good = distance < GOOD_COLOR * self._color_level and not (
            shape_known and fit < GOOD_TEMPLATE * self._template_level
        )
        self._n_bad = self._n_bad + 1 if bad or off else 0
        if not self._n_bad:
            self._last_seen = self._mean
        rate = BAD_LEVEL_RATE if bad else LEVEL_RATE
        self._color_level += rate * (distance - self._color_level)
        self._template_level = max(self._template_level + rate * (fit - self._template_level), 0.35)
        self._n_updates += 1
        if good and shape_known and self._n_updates % TEMPLATE_PERIOD == 0:
            self._learn_template(look, box)
        if good and self.learning_rate:
            step = self.learning_rate * (self._histograms(look, box) - self._running_targets)
            self._running_targets = self._running_targets + step
            self.palette = kernels.palette(KEPT * self._first_targets + (1 - KEPT) * self._running_targets)

    def _learn_template(self, look: Description, box: np.ndarray) -> None:
        channels, side = look.channels(self.size[0])
        self.template.learn(channels, box / side)
