r"""The bag-of-features particle filter of Li et al. 2012, section 4: several targets, each by the words of its patches.

In some training frames a detector finds the targets. From the patches of each (:mod:`pftrack.patches`) two codebooks
are made, one of colour and one of texture (:mod:`pftrack.codebook`), and the bag of the training boxes is the target's
template. From then on every target has a particle filter of its own. Its particles are rectangles ``[x, y, w, h]`` that
move by random perturbation; each is weighed by how much its two bags look like the template's, with weights of the two
features that follow from how well each tells the particles apart; and where nothing looks like the target, because it
is hidden, its state is held while the particles go on.

The display equations of the paper are lost from its text. Those below come from the methods it descends from and from
its successor: the intersection of bags from Swain and Ballard (1991), the likelihood from eq. 7 and the weights from
eq. 9 of Li et al. 2016,

.. math::

    p_f(z \mid x) \propto e^{-(1 - s_f)^2 / 2 \sigma^2}, \qquad
    p = a\, p_{\text{colour}} + b\, p_{\text{texture}}, \qquad
    a = \frac{\Delta_{\text{colour}}}{\Delta_{\text{colour}} + \Delta_{\text{texture}}}, \quad b = 1 - a,

with :math:`\Delta_f` the difference of the greatest and the least :math:`p_f` among the particles. What we added is
said at each argument, and ``results/bof-ablation.csv`` has what it is worth. Chapter 10 builds the filter.
"""

from __future__ import annotations

import math

import numpy as np

from pftrack import codebook, motion, patches, smc, superpixels
from pftrack.checks import check_box, check_picture, check_same_size, check_seed, is_shown
from pftrack.detection import PedestrianDetector
from pftrack.multi.base import Track, check_training, link, stream

FEATURES = ("color", "texture")
"""The two kinds of patches, in the order in which everything here has them."""

UNKNOWN = 1.5
"""Distance from the nearest word, in bandwidths, beyond which a patch is like none of them."""

N_RECENT = 5
"""Updates over which the worth of the words is remembered."""

FOUND_IN = 0.8
"""Share of the training frames in which a target must be found."""

SHARE_SEEN = 0.8
"""Share of a target that must be seen for anything to be learnt from it."""


class BagOfFeaturesParticleFilter:
    """Follow several targets by bags of colour and texture words (Li et al. 2012).

    Parameters
    ----------
    n_particles : int
        Particles of each target, at least 1. Li et al. 2016 print 300.
    seed : int
        Seed of the random numbers; every target has its own stream.
    n_training : int
        Training frames, at least 1. Li et al. 2016 print 5.
    noise : array_like, shape (4,)
        Standard deviations of the random perturbation for one frame: of ``x`` and ``y`` relative to the target's
        height, of ``w`` and ``h`` relative to themselves. *Not printed.*
    sigma : float
        Standard deviation of the distance of two bags, above 0. *Not printed.*
    bandwidths : tuple of float
        Of the clustering of colour and of texture. *Not printed.*
    features : {"both", "color", "texture"}
        What the likelihood is made of.
    adapt_weights : bool
        Whether the weights of the features follow from the particles; both one half if not.
    n_bands : int
        Bands of equal height, each with a bag of its own; the paper's filter has 1, and cannot tell where in a box a
        word is. *Our addition.*
    discriminative : bool
        Whether the codebooks hold the words of the surroundings too, and a word counts for as much as it is the
        target's, by eq. 1 of Li et al. 2016. To the letter, codebooks are made of the target's box alone, and all words
        count. *Our addition.*
    mutual_occlusion : bool
        Whether patches that a nearer target covers, one whose feet are lower in the picture, say nothing about those
        behind it. *Our addition.*
    follow_camera : bool
        Whether particles move along with the background, :func:`pftrack.motion.camera_shift`. *Our addition.*
    occlusion_drop : float
        The state is held when the best log-likelihood of the particles is lower by so much than is usual for this
        target, or less than a quarter of the target is seen. *The paper's threshold is not printed.*
    learn : {"bags", "codebook", "nothing"}
        What follows the target's looks: the template bags, the codebooks as in section 3.2.3 of the
        paper (:func:`pftrack.codebook.update_codebook`), or nothing.
    forget : float
        The forget factor, from 0 to 1: share of the old when something new is learnt.
    update_every : int
        Frames from one learning to the next. *Not printed.*
    n_superpixels, n_patches : int
        About how many superpixels the surroundings of a target have, and how many patches of texture are drawn from
        the region of its particles; see :func:`pftrack.patches.describe`. *Not printed.*
    detector : PedestrianDetector, optional
        What finds the targets in the training frames; one with the default settings if not given.

    Raises
    ------
    ValueError
        If an argument is out of its range.

    Notes
    -----
    The score of a track is the likelihood of its best particle relative to a perfect match.

    Nobody is added after the training frames, and nobody removed: the paper assumes that their number is constant.
    While nobody is found, training goes on with the latest frames.

    Examples
    --------
    >>> import pftrack
    >>> scene = pftrack.datasets.load("synthetic-crossing")
    >>> tracker = BagOfFeaturesParticleFilter(n_particles=50, seed=0)
    >>> tracker.init(scene.frames[:5], [[scene.target(id)[t] for id in scene.ids] for t in range(5)])
    >>> [track.id for track in tracker.update(scene.frames[5])]
    [1, 2]
    """

    def __init__(
        self,
        n_particles: int = 300,
        seed: int = 0,
        *,
        n_training: int = 5,
        noise=(0.1, 0.03, 0.015, 0.015),
        sigma: float = 0.2,
        bandwidths: tuple[float, float] = (0.3, 0.12),
        features: str = "both",
        adapt_weights: bool = True,
        n_bands: int = 3,
        discriminative: bool = True,
        mutual_occlusion: bool = True,
        follow_camera: bool = True,
        occlusion_drop: float = 6.0,
        learn: str = "bags",
        forget: float = 0.9,
        update_every: int = 5,
        n_superpixels: int = 100,
        n_patches: int = 150,
        detector: PedestrianDetector | None = None,
    ):
        if min(n_particles, n_training, n_bands, update_every, n_superpixels, n_patches) < 1:
            raise ValueError("all numbers of things (n_particles, n_training, n_bands, ...) must be at least 1")
        check_seed(seed)
        noise = np.asarray(noise, dtype=float)
        if noise.shape != (4,) or not np.all((noise >= 0) & np.isfinite(noise)):
            raise ValueError(f"noise must be four standard deviations, none negative, got {noise.tolist()}")
        if not 0 < sigma < np.inf or not min(bandwidths) > 0 or not occlusion_drop > 0 or not 0 <= forget <= 1:
            raise ValueError(
                "sigma, bandwidths and occlusion_drop must be positive and forget lie between 0 and 1, "
                f"got {sigma}, {bandwidths}, {occlusion_drop} and {forget}"
            )
        if features not in ("both", *FEATURES) or learn not in ("bags", "codebook", "nothing"):
            raise ValueError(
                'features must be "both", "color" or "texture", and learn "bags", "codebook" or "nothing", '
                f"got {features!r} and {learn!r}"
            )
        self.n_particles, self.seed, self.n_training = int(n_particles), seed, int(n_training)
        self.noise, self.sigma, self.bandwidths = noise, sigma, bandwidths
        self.features, self.adapt_weights, self.n_bands = features, adapt_weights, n_bands
        self.discriminative, self.mutual_occlusion = discriminative, mutual_occlusion
        self.follow_camera, self.occlusion_drop = follow_camera, occlusion_drop
        self.learn, self.forget, self.update_every = learn, forget, update_every
        self.n_superpixels, self.n_patches = n_superpixels, n_patches
        self.detector = PedestrianDetector() if detector is None else detector
        self._targets: list[_Target] = []
        self._training: list[tuple[np.ndarray, np.ndarray]] = []
        self._shape, self._gray, self._n_updates = None, None, 0

    def init(self, frames, boxes) -> None:
        """Learn targets that are known, instead of finding them.

        Parameters
        ----------
        frames : sequence of ndarray, shape (H, W, 3), uint8
            The training frames. Tracking goes on with the frame after the last.
        boxes : array_like, shape (M, K, 4)
            Box of each of `K` targets in each frame, NaN where it is hidden; each is seen in one frame at least.

        Raises
        ------
        ValueError
            If there are no frames or targets, a frame or box is unusable, or a target is never seen.
        """
        known = check_training(frames, boxes)
        self._train(list(frames), known)

    def _train(self, frames: list[np.ndarray], known: list[dict[int, np.ndarray]]) -> None:
        self._shape, self._n_updates = frames[-1].shape, 0
        self._gray = motion.reduced_gray(frames[-1]) if self.follow_camera else None
        self._targets = []
        for number, boxes in enumerate(known, start=1):
            seen = [(frames[t], check_box(box, frames[t])) for t, box in boxes.items()]
            self._targets.append(_Target(number, seen, self))

    def update(self, frame: np.ndarray, detections=None) -> list[Track]:
        """Follow all targets into the next frame.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The next frame.
        detections : array_like, shape (D, 5), optional
            ``x, y, w, h, score`` of the pedestrians in a training frame; later ones are not looked at.

        Returns
        -------
        list of Track
            All targets, in the order of their numbers; none before the last training frame.

        Raises
        ------
        ValueError
            If the frame is no colour image, or not of the size of those before.
        """
        check_same_size(check_picture(frame).shape, self._shape)
        self._shape = frame.shape
        if not self._targets:
            return self._look(frame, detections)
        shift = np.zeros(2)
        if self.follow_camera:
            before, self._gray = self._gray, motion.reduced_gray(frame)
            shift = motion.camera_shift(before, self._gray) * frame.shape[1] / self._gray.shape[1]
        self._n_updates += 1
        learn = self._n_updates % self.update_every == 0
        nearer = np.empty((0, 4))
        for target in sorted(self._targets, key=lambda target: -(target.box[1] + target.box[3])):
            target.update(frame, shift, nearer)
            if learn:
                target.learn()
            if self.mutual_occlusion:
                nearer = np.vstack([nearer, _middle(target.box)])
        return [target.track for target in self._targets]

    def _look(self, frame, detections) -> list[Track]:
        """Collect what is found in the training frames, and learn the targets when there are enough frames."""
        found = self.detector.detect(frame) if detections is None else np.asarray(detections, dtype=float)
        self._training = [*self._training, (frame, found.reshape(-1, 5))][-self.n_training :]
        if len(self._training) < self.n_training:
            return []
        frames, detections = zip(*self._training, strict=True)
        known = link(detections, min_frames=math.ceil(FOUND_IN * self.n_training))
        usable = [target for target in known if all(is_shown(box, frame) for box in target.values())]
        if not usable:
            return []
        self._train(list(frames), usable)
        self._training = []
        return [target.track for target in self._targets]


def _middle(box) -> np.ndarray:
    """Return the part of a box that a person fills."""
    x, y, w, h = box
    return np.array([x + 0.1 * w, y, 0.8 * w, h])


class _Target:
    """One target: its codebooks, its template and its particles."""

    def __init__(self, number: int, seen: list[tuple[np.ndarray, np.ndarray]], settings: BagOfFeaturesParticleFilter):
        self.settings = settings
        self.rng = stream(settings.seed, number)
        self.box = seen[-1][1]
        factor = superpixels.FACTOR if settings.discriminative else 1.0
        self.training = []
        for frame, box in seen:
            region = superpixels.surroundings(box, frame.shape, factor)
            self.training.append((self._describe(frame, region, box[3]), box))
        kinds = zip(*(found for found, _ in self.training), strict=True)
        self.codebooks = [
            _words(np.concatenate([of_one.features for of_one in kind]), bandwidth)
            for kind, bandwidth in zip(kinds, settings.bandwidths, strict=True)
        ]
        self.recent, self.worth = [], [None, None]
        self._learn_words()
        x, y, w, h = self.box
        self.first_size = np.array([w, h])
        self.particles = np.tile([x + w / 2, y + h / 2, w, h], (settings.n_particles, 1))
        self.usual, self.seen = None, 1.0
        self.track = Track(number, self.box, 1.0)

    def _describe(self, frame, region, height) -> tuple[patches.Patches, patches.Patches]:
        settings = self.settings
        return patches.describe(frame, region, height, settings.n_superpixels, settings.n_patches, self.rng)

    def _which(self, found, feature: int) -> np.ndarray:
        """Return the nearest word of every patch, in one-hot form; all zeros if it is like none."""
        words = self.codebooks[feature]
        if len(found) == 0 or len(words) == 0:
            return np.zeros((len(found), len(words)))
        squares = codebook.squared_distances(found.features, words)
        nearest = np.eye(len(words))[squares.argmin(axis=1)]
        nearest[squares.min(axis=1) > (UNKNOWN * self.settings.bandwidths[feature]) ** 2] = 0
        return nearest

    def _tally(self, found, box) -> list[np.ndarray]:
        """Return for each feature the area of each word inside a box, and everywhere in its surroundings."""
        tallies = []
        for feature, of_one in enumerate(found):
            areas = of_one.areas[:, None] * self._which(of_one, feature)
            inside = patches.coverage([box], of_one.edges)[0, 0] @ areas
            tallies.append(np.array([inside, areas.sum(axis=0)]))
        return tallies

    def _weigh_words(self) -> None:
        """Say how much each word is the target's, from 0 to 1 (Li et al. 2016, eq. 1)."""
        for feature in range(len(FEATURES)):
            inside, everywhere = np.sum([tally[feature] for tally in self.tallies + self.recent], axis=0)
            balance = (2 * inside - everywhere) / np.maximum(everywhere, 1e-9)
            self.worth[feature] = np.maximum(balance, 0.0) if self.settings.discriminative else np.ones(len(balance))

    def _learn_words(self) -> None:
        """Weigh the words of new codebooks, and make the template of the training boxes with them."""
        self.tallies = [self._tally(found, box) for found, box in self.training]
        self._weigh_words()
        bags = [self._bags(found, [box])[0] for found, box in self.training]
        self.templates = [np.mean([bag[feature][0] for bag in bags], axis=0) for feature in range(len(FEATURES))]

    def _bags(self, found, boxes, nearer=None) -> tuple[list[np.ndarray], np.ndarray]:
        """Return the bags of every band of many boxes for each feature, and how much of each band is seen."""
        bags, n_bands = [], self.settings.n_bands
        for feature, of_one in enumerate(found):
            visible = of_one.areas
            if nearer is not None and len(nearer):
                visible = visible * np.prod(1 - patches.coverage(nearer, of_one.edges)[:, 0], axis=0)
            summed = np.column_stack([visible[:, None] * self._which(of_one, feature), visible, of_one.areas])
            covered = patches.coverage(boxes, of_one.edges, n_bands).reshape(len(boxes) * n_bands, len(of_one))
            sums = (covered @ summed).reshape(len(boxes), n_bands, -1)  # all bands of all boxes in one product
            total = sums[..., -2]
            if feature == 0:
                seen = total / np.maximum(sums[..., -1], 1e-9)
            bags.append(sums[..., :-2] / np.maximum(total, 1e-9)[..., None])
        return bags, seen

    def _similarity(self, bags, seen, feature: int) -> np.ndarray:
        """Return the intersection of bags with the template's, from 0 to 1, the mean over the bands that are seen."""
        template, worth = self.templates[feature], self.worth[feature]
        common = np.minimum(bags, template) @ worth / np.maximum(template @ worth, 1e-3)
        return (common * seen).sum(axis=1) / np.maximum(seen.sum(axis=1), 1e-9)

    def update(self, frame: np.ndarray, shift: np.ndarray, nearer: np.ndarray) -> None:
        """Predict, weigh, estimate and resample."""
        self.predict(shift, frame.shape)
        x, y, w, h = self.particles.T
        boxes = np.column_stack([x - w / 2, y - h / 2, w, h])
        self.found = self._describe(frame, _region(boxes, frame.shape), self.box[3])
        log_weights, color_weight, best = self.weigh(boxes, nearer)
        weights = smc.normalize(log_weights)
        held = self.seen < 0.25 or self.usual - best > self.settings.occlusion_drop
        if self.seen > SHARE_SEEN:  # slowly where nothing looks like the target
            self.usual += (0.02 if held else 0.1) * (best - self.usual)
        moved = self.particles
        if not held:
            x, y, w, h = smc.weighted_mean(moved, weights)
            self.box = np.array([x - w / 2, y - h / 2, w, h])
            self.particles = moved[smc.systematic(weights, self.rng)]
        score = float(np.exp(best))
        self.track = Track(self.track.id, self.box, score, bool(held), moved, weights, float(color_weight))

    def predict(self, shift, shape) -> None:
        """Move the particles by random perturbation (Li et al. 2012, section 4.1)."""
        _, _, w, h = self.box
        spread = self.settings.noise * [h, h, w, h]
        self.particles = self.particles + np.append(shift, [0, 0]) + spread * self.rng.normal(size=self.particles.shape)
        height, width = shape[:2]
        lowest = np.array([0, 0, *self.first_size / 3])
        highest = np.array([width, height, *self.first_size * 3])
        self.particles = self.particles.clip(lowest, highest)

    def weigh(self, boxes, nearer) -> tuple[np.ndarray, float, float]:
        """Return the log-likelihoods of boxes, the weight of colour in them, and the best where all is seen."""
        settings = self.settings
        bags, seen = self._bags(self.found, boxes, nearer)
        similarities = [self._similarity(bags[feature], seen, feature) for feature in range(len(FEATURES))]
        log_each = -((1 - np.array(similarities)) ** 2) / (2 * settings.sigma**2)
        color_weight = self._color_weight(np.ptp(np.exp(log_each), axis=1))
        with np.errstate(divide="ignore"):  # the logarithm of a weight of zero
            log_weights = np.logaddexp(*(log_each + np.log([[color_weight], [1 - color_weight]])))
        shares = seen.mean(axis=1)
        self.seen = float(shares.mean())
        best = float(log_weights[shares >= shares.max() - 1e-9].max())
        if self.usual is None:
            self.usual = best
        hidden = self.usual - 1.0  # what is behind somebody is a little less likely than what is seen to match
        log_weights = shares * log_weights + (1 - shares) * hidden
        return log_weights, color_weight, best

    def _color_weight(self, ranges) -> float:
        """Return the weight of colour from how widely each feature's likelihoods spread (Li et al. 2016, eq. 9)."""
        if self.settings.features != "both":
            return float(self.settings.features == "color")
        if not self.settings.adapt_weights or ranges.sum() < 1e-12:
            return 0.5
        return float(ranges[0] / ranges.sum())

    def learn(self) -> None:
        """Follow the target's looks, where it is seen well (Li et al. 2012, section 3.2.3)."""
        settings = self.settings
        if settings.learn == "nothing" or self.track.held or self.seen < SHARE_SEEN:
            return
        if settings.learn == "codebook":
            self.codebooks = [
                codebook.update_codebook(words, of_one.features, bandwidth, settings.forget) if len(of_one) else words
                for words, of_one, bandwidth in zip(self.codebooks, self.found, settings.bandwidths, strict=True)
            ]
            self._learn_words()
            return
        self.recent = [*self.recent, self._tally(self.found, self.box)][-N_RECENT:]
        self._weigh_words()
        bags, _ = self._bags(self.found, [self.box])
        self.templates = [
            settings.forget * old + (1 - settings.forget) * bag[0]
            for old, bag in zip(self.templates, bags, strict=True)
        ]


def _words(features, bandwidth: float) -> np.ndarray:
    """Return the codebook of some patches, empty if there are none."""
    return codebook.mean_shift(features, bandwidth) if len(features) else features


def _region(boxes, shape) -> tuple[int, int, int, int]:
    """Return ``(left, top, right, bottom)`` of what boxes cover of a frame, of 20 pixels a side at least."""
    low = np.floor(boxes[:, :2].min(axis=0)).astype(int) - 6
    high = np.ceil((boxes[:, :2] + boxes[:, 2:]).max(axis=0)).astype(int) + 6
    limits = np.array(shape[1::-1])
    low = np.clip(low, 0, np.maximum(limits - 20, 0))
    high = np.minimum(np.maximum(high, low + 20), limits)
    return (*low.tolist(), *high.tolist())
