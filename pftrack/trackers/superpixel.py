r"""Superpixel tracking (Wang, Lu, Yang and Yang, ICCV 2011), the tracker with which both papers of Li et al. compare.

A square around the last box is cut into superpixels. Each takes the confidence of the cluster of training superpixels
that it is nearest to, from 1 for the target to -1 for background, a third of it where it is negative
(:mod:`pftrack.superpixels`); painted, they are a *confidence map*. Then boxes are drawn around the last one, the
*candidates*. With :math:`m` the mean confidence in a candidate, :math:`a` its area and :math:`a_0` that of the last
box, its score is

.. math:: s = m\, a_0 \cdot \begin{cases} a / a_0 & m > 0 \\ a_0 / a & m \le 0 \end{cases}

so that of two candidates full of target the larger wins, and adding background makes a score fall. The scores, shifted
and scaled to :math:`\tilde s \in [0, 1]`, are multiplied by a prior of the motion since the last box, whose centre was
:math:`c_0` and whose size was :math:`d_0 = (w_0, h_0)`,

.. math:: p \propto \tilde s \; e^{-\lVert c - c_0 \rVert^2 / 2 \sigma_c \lambda}
                            \; e^{-\lVert d - d_0 \rVert^2 / 2 \sigma_s \lambda},
          \qquad \lambda = \frac{\text{frame's width} + \text{height}}{2},

and the greatest :math:`p` is the estimate. It has candidates with weights, but is *no particle filter*: nothing of a
candidate but the best one is carried to the next frame.

The target is severely occluded where even the best candidate shows hardly anything of it,
:math:`O = 0.5 - \max(m\, a_0) / a_{\text{square}} > 0.515`. Then the prior is left out, candidates go on to be drawn
where the target was last seen, and nothing is learnt. Else the frame joins a window of the latest 15, from which the
clusters are made anew every 10 frames.

Where the paper is silent, its authors' code (``huchuanlu/11_1``) speaks.
"""

from __future__ import annotations

import dataclasses
from collections import deque

import numpy as np

from pftrack import codebook, superpixels
from pftrack.checks import check_box, check_same_size, check_seed
from pftrack.superpixels import PriorKnowledge, Superpixels
from pftrack.trackers.base import Estimate, check_frame, check_started

N_STEPS = 4
"""Rounds of SLIC's clustering, fewer than usual, for speed."""

SIZE_LIMIT = 3.0
"""How many times larger or smaller than at first the sides of a candidate may be. *Ours.*"""


def scores(sums, areas, reference: float) -> np.ndarray:
    """Score of candidates of different sizes, the code's relation of areas.

    Parameters
    ----------
    sums : array_like, shape (N,)
        Sum of the confidences in each, from :func:`pftrack.superpixels.box_confidences`.
    areas : array_like, shape (N,)
        Their areas in pixels, above 0.
    reference : float
        Area of the last box in pixels, above 0.

    Returns
    -------
    ndarray, shape (N,)
        A positive sum itself, for the mean times the area is the sum; a negative one times ``(reference / area) ** 2``.

    Examples
    --------
    >>> scores([60, -60, -60], areas=[200, 100, 200], reference=100)
    array([ 60., -60., -15.])
    """
    sums, areas = np.asarray(sums, dtype=float), np.asarray(areas, dtype=float)
    return np.where(sums > 0, sums, sums * (reference / areas) ** 2)


def motion_log_prior(particles, state, variances) -> np.ndarray:
    """Logarithm of the prior of candidates, but for a constant.

    Parameters
    ----------
    particles : array_like, shape (N, 4)
        Candidates ``[x, y, w, h]``, with ``(x, y)`` the centre, in pixels.
    state : array_like, shape (4,)
        The last estimate, likewise.
    variances : tuple of float
        Of the centre and of the size, in squared pixels, above 0.

    Returns
    -------
    ndarray, shape (N,)
        0 for a candidate that equals the last estimate, and less for any other.

    Examples
    --------
    >>> motion_log_prior([[10, 10, 4, 8], [13, 14, 4, 8]], [10, 10, 4, 8], variances=(25.0, 1.0))
    array([-0. , -0.5])
    """
    steps = np.asarray(particles, dtype=float) - state
    return -(steps[:, :2] ** 2).sum(axis=1) / (2 * variances[0]) - (steps[:, 2:] ** 2).sum(axis=1) / (2 * variances[1])


class SuperpixelTracker:
    """Track one target by a confidence map of superpixels (Wang et al. 2011).

    Parameters
    ----------
    n_candidates : int
        Candidates in each frame, at least 1; the code's is 600.
    seed : int or numpy.random.Generator
        Seed of the random numbers; every call of `init` starts again from it. A generator is used as it is.
    noise : array_like, shape (4,)
        Standard deviations of the candidates around the last box: along x in its widths, along y in its heights, and of
        the logarithms of its scale and of its aspect. The code has others for each film, in pixels; ours are near those
        for its films of pedestrians.
    sigma_center, sigma_size : float
        The constants of the prior, above 0. Their comment says standard deviations; the code takes variances.
    bandwidth : float
        Of the clustering, above 0; see :func:`pftrack.superpixels.learn`.
    n_superpixels : int
        About how many there are in the square, at least 1. The code's are 300; ours are fewer for speed.
    spread : float
        The factor 2 of a superpixel's weight ``exp(-2 * distance / r)``, not negative.
    distance_scale : {"farthest", "cluster"}
        What `r` is: in the code the largest *squared* distance of the superpixel from any training superpixel, in the
        paper the radius of the cluster. The threshold of the occlusion goes with the code's.
    penalty : float
        Negative confidences are divided by it, at least 1; the code's is 3.
    occlusion : float
        Threshold of severe occlusion.
    n_training : int
        Frames to learn from before the window counts, at least 1. While there are fewer, the clusters are made anew
        after each. (The authors find the target in these frames with another tracker, by a template.)
    window, update_every : int
        Frames of which is learnt, at least `n_training`, and frames from one learning to the next, at least 1.

    Raises
    ------
    ValueError
        If an argument is out of its range.

    Notes
    -----
    The score of an estimate is the mean confidence in its box, 0 if negative; then the target is `lost`, as it always
    is when severely occluded. The particles are the candidates ``[x, y, w, h]``, with ``(x, y)`` the centre, in pixels.

    What differs from the code: superpixels are scikit-image's; their colours are in the house's 256 bins of HSV in
    place of 512 of HSI; boxes do not turn; a cluster is found by its centre, not by its nearest member; there is no
    first tracker; and of an occluded frame nothing is learnt, where the code takes all it shows for background.

    Examples
    --------
    >>> from pftrack import datasets, track
    >>> scene = datasets.load("synthetic-walk")
    >>> boxes = track(SuperpixelTracker(seed=0), scene.frames[:5], scene.boxes[0])
    >>> bool(np.abs(boxes - scene.boxes[:5]).max() < 10)
    True
    """

    def __init__(
        self,
        n_candidates: int = 600,
        seed: int | np.random.Generator = 0,
        *,
        noise=(0.2, 0.05, 0.005, 0.005),
        sigma_center: float = 7.6,
        sigma_size: float = 7.0,
        bandwidth: float = 0.18,
        n_superpixels: int = 100,
        spread: float = 2.0,
        distance_scale: str = "farthest",
        penalty: float = 3.0,
        occlusion: float = 0.515,
        n_training: int = 4,
        window: int = 15,
        update_every: int = 10,
    ):
        if min(n_candidates, n_superpixels, n_training, update_every) < 1 or window < n_training:
            raise ValueError(
                "n_candidates, n_superpixels, n_training and update_every must be at least 1, and window at least "
                f"n_training, got {n_candidates}, {n_superpixels}, {n_training}, {update_every} and {window}"
            )
        check_seed(seed)
        noise = np.asarray(noise, dtype=float)
        if noise.shape != (4,) or not np.all((noise >= 0) & np.isfinite(noise)):
            raise ValueError(f"noise must be four standard deviations, none negative or NaN, got {noise.tolist()}")
        if not all(0 < value < np.inf for value in (sigma_center, sigma_size, bandwidth)):
            raise ValueError(
                "sigma_center, sigma_size and bandwidth must be positive, "
                f"got {sigma_center}, {sigma_size} and {bandwidth}"
            )
        if not 0 <= spread < np.inf or not 1 <= penalty < np.inf or not np.isfinite(occlusion):
            raise ValueError(
                "spread must not be negative, penalty at least 1 and occlusion a number, "
                f"got {spread}, {penalty} and {occlusion}"
            )
        if distance_scale not in ("farthest", "cluster"):
            raise ValueError(f'distance_scale must be "farthest" or "cluster", got {distance_scale!r}')
        self.n_candidates, self.seed, self.noise = int(n_candidates), seed, noise
        self.sigma_center, self.sigma_size = sigma_center, sigma_size
        self.bandwidth, self.n_superpixels = bandwidth, int(n_superpixels)
        self.spread, self.distance_scale, self.penalty = spread, distance_scale, penalty
        self.occlusion, self.n_training = occlusion, int(n_training)
        self.window, self.update_every = int(window), int(update_every)
        self._shape = None

    def init(self, frame: np.ndarray, box) -> Estimate:
        """Learn from one frame what is the target and what is around it.

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
        frame = check_frame(frame)
        return self._begin([frame], [check_box(box, frame)])

    def init_from(self, frames, boxes) -> Estimate:
        """Learn from several frames in which the target is known, as the paper does.

        Parameters
        ----------
        frames : sequence of ndarray, shape (H, W, 3), uint8
            The training frames. Tracking goes on with the frame after the last.
        boxes : array_like, shape (M, 4)
            The target in each, ``(x, y, w, h)`` in pixels; NaN where it is hidden, which is not in all of them.

        Returns
        -------
        Estimate
            The last of the given boxes, with score 1.

        Raises
        ------
        ValueError
            If there are no frames or not as many boxes, one of them is unusable, or the target is never seen.
        """
        boxes = np.asarray(boxes, dtype=float)
        if len(frames) == 0 or boxes.shape != (len(frames), 4):
            raise ValueError(
                f"need training frames and a box for each, got {len(frames)} frames and boxes {boxes.shape}"
            )
        for frame in frames:
            check_same_size(check_frame(frame).shape, frames[0].shape)
        seen = np.flatnonzero(~np.isnan(boxes).any(axis=1))
        if len(seen) == 0:
            raise ValueError("the target is hidden in all training frames, so nothing can be learnt of it")
        return self._begin([frames[t] for t in seen], [check_box(boxes[t], frames[t]) for t in seen])

    def _begin(self, frames, boxes) -> Estimate:
        self.rng = np.random.default_rng(self.seed)
        self._shape, self._first_size = frames[-1].shape, boxes[0][2:]
        self._lessons: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=self.window)
        for frame, box in zip(frames, boxes, strict=True):
            found = self._cut(frame, box)
            self._lessons.append((found.features, superpixels.areas(found, box)))
        self._learn()
        self.box = self._seen = boxes[-1]
        return Estimate(self.box, 1.0, lost=False)

    def update(self, frame: np.ndarray) -> Estimate:
        """Paint the map, draw candidates, take the best, and learn if it is not occluded.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The next frame, of the size of the first.

        Returns
        -------
        Estimate
            The best candidate, its score, whether it is lost, and all candidates with their weights.

        Raises
        ------
        ValueError
            If the frame is unusable, or `init` was not called.
        """
        frame = check_frame(frame, check_started(self._shape))
        found = self._cut(frame, self.box)
        painted = superpixels.paint(found, self._confidences(found), frame.shape)
        candidates = self._draw()
        boxes = _as_boxes(candidates)
        areas, reference = candidates[:, 2] * candidates[:, 3], self._seen[2:].prod()
        sums = superpixels.box_confidences(painted, boxes)
        occluded = 0.5 - (sums / areas).max() * reference / found.labels.size > self.occlusion
        weights = _scaled(scores(sums, areas, reference))
        if not occluded:
            side = (frame.shape[0] + frame.shape[1]) / 2
            variances = self.sigma_center * side, self.sigma_size * side
            x, y, w, h = self.box
            log_prior = motion_log_prior(candidates, (x + w / 2, y + h / 2, w, h), variances)
            weights = weights * np.exp(log_prior - log_prior.max())
        best = int(weights.argmax())
        self.box = boxes[best]
        self._n_since += 1
        if not occluded:
            self._seen = self.box
            self._lessons.append((found.features, superpixels.areas(found, self.box)))
            full = len(self._lessons) == self.window and self._n_since >= self.update_every
            if full or len(self._lessons) <= self.n_training:
                self._learn()
        score = float(np.clip(sums[best] / areas[best], 0.0, 1.0))
        return Estimate(self.box, score, score == 0, candidates, weights / weights.sum())

    def _cut(self, frame: np.ndarray, box) -> Superpixels:
        region = superpixels.surroundings(box, frame.shape, square=True)
        return superpixels.cut(frame, region, self.n_superpixels, n_steps=N_STEPS)

    def _learn(self) -> None:
        """Make the clusters anew from the lessons."""
        features, areas = zip(*self._lessons, strict=True)
        self._features = np.concatenate(features)
        prior = superpixels.cluster(self._features, np.concatenate(areas, axis=1), self.bandwidth)
        milder = np.where(prior.confidences < 0, prior.confidences / self.penalty, prior.confidences)
        self.prior: PriorKnowledge = dataclasses.replace(prior, confidences=milder)
        self._n_since = 0

    def _confidences(self, found: Superpixels) -> np.ndarray:
        scale = None
        if self.distance_scale == "farthest":
            scale = np.maximum(codebook.squared_distances(found.features, self._features).max(axis=1), 1e-9)
        return superpixels.confidences(found.features, self.prior, self.spread, scale)

    def _draw(self) -> np.ndarray:
        """Draw candidates ``[x, y, w, h]`` around where the target was last seen, their centres in the frame."""
        x, y, w, h = self._seen
        steps = self.noise * self.rng.standard_normal((self.n_candidates, 4))
        sizes = [w, h] * np.exp(steps[:, 2:3] + steps[:, 3:] * [0.5, -0.5])
        sizes = sizes.clip(self._first_size / SIZE_LIMIT, self._first_size * SIZE_LIMIT)
        centers = ([x + w / 2, y + h / 2] + steps[:, :2] * [w, h]).clip(0, self._shape[1::-1])
        return np.hstack([centers, sizes])


def _as_boxes(candidates: np.ndarray) -> np.ndarray:
    return np.hstack([candidates[:, :2] - candidates[:, 2:] / 2, candidates[:, 2:]])


def _scaled(values: np.ndarray) -> np.ndarray:
    """Shift and scale values to 0 to 1; equal ones are all 1."""
    extent = np.ptp(values)
    return (values - values.min()) / extent if extent > 0 else np.ones(len(values))
