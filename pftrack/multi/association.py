r"""The association particle filter of Li et al. 2016: many targets, who come and go.

Every target has particles of its own. In each frame they move (eq. 4), what is found in the frame is compared with all
of them in an *incidence matrix* (eq. 6), and from its entries

.. math::

    \mathrm{sim}^f_{ij} = e^{-d_f^2[y_i, y_j] / 2 \sigma_f^2}, \qquad
    c_{ij} = \max\left(a\, \mathrm{sim}^{\text{colour}}_{ij} + b\, \mathrm{sim}^{\text{LBP}}_{ij}\right)

(eqs 7 and 8) follows which observation :math:`i` is whose state :math:`j`. A state without an observation for three
frames has disappeared (eq. 10); an observation without a state for three frames is somebody new (eq. 11).

The filter as printed is :class:`~pftrack.multi.printed.PrintedTarget`, and loses most people: nothing in eqs 6 to 11
remembers how anybody looked. The default keeps the paper's steps, and changes what they rest on. A target has
:class:`~pftrack.multi.looks.Looks`, learnt while it is seen. Its likelihood is the *product* of those of the two
features. Its state has a velocity, and the entry of the matrix says besides how well the detection :math:`z_i` was
predicted, the logarithm of

.. math::

    p(z_i \mid j) = \frac{1}{N} \sum_{k=1}^{N} \mathcal{N}\left(z_i;\; x_j^k + \dot x_j^k,\; Q + R\right),

with the covariances :math:`Q` of the motion and :math:`R` of the detector. As both are Gaussian, the particles of a
target that was found can be drawn from :math:`p(x_t \mid x_{t-1}, z_t)` itself, the optimal proposal (Doucet et al.
2000); each is then weighted by how well *it* predicted :math:`z`, and by the likelihood of the looks where it is now.
The particles of who is absent only move, as in section 4.3. :data:`ADDITIONS` lists what was added, and
``results/association-ablation.csv`` has what each is worth. Chapter 11 builds the filter.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from pftrack import motion, patches, smc
from pftrack.checks import check_picture, check_same_size, check_seed
from pftrack.detection import PedestrianDetector
from pftrack.metrics import pairwise_overlap
from pftrack.multi.base import Track, check_detections, check_training, link, stream
from pftrack.multi.looks import Looks, Picture
from pftrack.multi.printed import PrintedTarget, feature_weights

ADDITIONS = (
    "product",
    "gate",
    "one to one",
    "proposal",
    "velocity",
    "camera",
    "mutual occlusion",
    "surroundings",
    "re-finding",
    "border",
    "parts",
)
"""What the default adds to the paper's filter.

product
    the likelihood is the product of those of colour and texture, not their weighted sum;
gate
    the incidence matrix counts how well a detection was predicted, not only how it looks;
one to one
    no detection belongs to two targets: the assignment of the greatest sum, by SciPy;
proposal
    particles are drawn with the detection in view, not from the motion alone;
velocity
    the state has a velocity;
camera
    particles move along with the background, :func:`pftrack.motion.camera_shift`;
mutual occlusion
    what a nearer target covers, one whose feet are lower in the picture, says nothing about those behind it;
surroundings
    colours that are seen beside the target too count less;
re-finding
    who has disappeared is looked for, for two seconds or so, before the number is given up;
border
    who reaches the border of the picture has left it;
parts
    a detection inside a larger one, or inside a target, is a part of that person and nobody new.
"""

MOTION_NOISE = (0.02, 0.015)
"""Standard deviations of a frame's change of position and of velocity, relative to the target's height."""

WALK_NOISE = 0.08
"""The same of the position where the state has no velocity."""

SIZE_NOISE = 0.02
"""Standard deviation of the logarithm of a frame's change of width and of height."""

DETECTION_NOISE = (0.06, 0.1)
"""Standard deviations of a detection's centre, relative to the height, and of the logarithm of its size."""

START_SPEED = 0.03
"""Standard deviation of the velocity of somebody new, in heights a frame."""

FADING = 0.9
"""What is left of a velocity after a frame without a detection, from the fifth on, or where little of the target is
seen."""

LOOKS_COUNT = 2.0
"""Weight of the logarithm of the looks' likelihood in the incidence matrix, against that of the place."""

UNMATCHED = -10.0
"""Entry of the incidence matrix below which a target is rather not observed at all."""

LEARNING_RATE = 0.05
"""Share of a frame in what is remembered of the looks, and twice that in how alike is usual."""

SEEN_WELL = 0.8
"""Share of a target that must be seen for anything to be learnt from it."""

SEEN_AT_ALL = 0.35
"""Share of a target that must be seen for its looks to confirm it; below, a box without a detection is *held*."""

HIDDEN_LIKE = 0.5
"""By how much what is hidden is less likely, in the logarithm, than what looks as usual."""

USUAL_DROP = 0.1
"""By how much a target that no detection confirms may look less like itself than usual."""

TRUST = 0.25
"""Frames for which a target is believed without a detection, for each in which it was detected."""

AT_MOST = 18
"""Most frames for which a target is believed without a detection."""

BORDER = 0.3
"""Distance from the sides of the picture, in heights, in which who is not found has left."""

BEYOND = {"sides": 0.05, "top": 0.9, "bottom": 0.4}
"""How far the middle of somebody may be beyond the sides, the head above and the feet below, in heights of a box."""

HEAD_ROOM, FEET_ROOM = 10, 2
"""Whose head is lower than so many pixels above the lower edge has left; whose feet are, is at the edge."""

INSIDE = 0.6
"""Share of a detection that must lie in another box to be a part of it."""

TALLER = 1.25
"""By which factor that other box must be taller; its score may be half as high."""

SAME = 0.3
"""Overlap from which two boxes mean the same person."""

TAKEN = 0.4
"""Overlap with somebody who is followed, above which a detection is nobody new."""


class AssociationParticleFilter:
    """Follow pedestrians who come and go, by associating detections with particles (Li et al. 2016).

    Parameters
    ----------
    n_particles : int
        Particles of each target, at least 1; the paper's number is 300 (Table 1).
    seed : int or numpy.random.Generator
        Seed of the random numbers; every target has its own stream.
    as_printed : bool
        Whether to follow the paper to the letter, where it can be followed; see :mod:`pftrack.multi.printed`.
    additions : collection of str
        Which of :data:`ADDITIONS` to make; of no account with `as_printed`.
    n_frames : int
        Frames after which somebody counts as new, or as gone, at least 1; the paper's number is 3.
    remember : int
        Frames for which who has disappeared is looked for, at least `n_frames`. *Our addition.*
    birth_score : float
        Least score of a detection that may be somebody new; the default suits
        :class:`~pftrack.detection.PedestrianDetector`, whose scores are distances from a decision boundary.
    sigma : tuple of float
        Standard deviations of the distance of colours and of patterns, above 0. *Not printed.*
    n_bands : int
        Bands of the looks, at least 1. *Our addition; the paper's have one.*
    detector : PedestrianDetector, optional
        What finds pedestrians; one with the default settings if not given. The paper has one only in its first five
        frames, though somebody new can be found by nothing else: we let it look at every frame.

    Attributes
    ----------
    incidence : ndarray, shape (F, N)
        The incidence matrix of the latest frame: one row for each observation, one column for each target.
    targets : list
        Everybody that the filter remembers, those who are missing too; ``track`` is the latest of each. In the order
        of the columns while the frame was taken in; those who have left and come since change the list at its end.

    Raises
    ------
    ValueError
        If an argument is out of its range.

    Notes
    -----
    The score of a track is the similarity of its colours with those remembered, from 0 to 1.

    Examples
    --------
    >>> import pftrack
    >>> scene = pftrack.datasets.load("synthetic-crossing")
    >>> tracker = AssociationParticleFilter(n_particles=50, seed=0)
    >>> for t in range(4):
    ...     truth = scene.tracks[scene.tracks[:, 0] == t]
    ...     tracks = tracker.update(scene.frames[t], truth[:, 2:])
    ...     print([track.id for track in tracks])
    []
    []
    [1, 2]
    [1, 2]
    """

    def __init__(
        self,
        n_particles: int = 300,
        seed: int = 0,
        *,
        as_printed: bool = False,
        additions: Collection[str] = ADDITIONS,
        n_frames: int = 3,
        remember: int = 60,
        birth_score: float = 0.8,
        sigma: tuple[float, float] = (0.2, 0.35),
        n_bands: int = 3,
        detector: PedestrianDetector | None = None,
    ):
        if min(n_particles, n_frames, n_bands) < 1 or remember < n_frames:
            raise ValueError(
                "n_particles, n_frames and n_bands must be at least 1, and remember at least n_frames, "
                f"got {n_particles}, {n_frames}, {n_bands} and {remember}"
            )
        if len(sigma) != 2 or not all(0 < each < np.inf for each in sigma):
            raise ValueError(f"sigma must be two positive numbers, of colours and of patterns, got {sigma}")
        if unknown := set(additions) - set(ADDITIONS):
            raise ValueError(f"unknown additions {sorted(unknown)}; choose from {', '.join(ADDITIONS)}")
        check_seed(seed)
        self.n_particles, self.seed, self.as_printed = int(n_particles), seed, as_printed
        self.additions = frozenset() if as_printed else frozenset(additions)
        self.n_frames, self.remember, self.birth_score = n_frames, remember, birth_score
        self.sigma, self.n_bands = tuple(sigma), n_bands
        self.detector = PedestrianDetector() if detector is None else detector
        self.incidence = np.empty((0, 0))
        self.targets, self._n_born = [], 0
        self._recent: list[tuple[np.ndarray, np.ndarray]] = []
        self._shape = self._gray = None

    def init(self, frames, boxes) -> None:
        """Learn targets that are known, instead of finding them.

        Parameters
        ----------
        frames : sequence of ndarray, shape (H, W, 3), uint8
            The training frames. Tracking goes on with the frame after the last.
        boxes : array_like, shape (M, K, 4)
            Box of each of `K` targets in each frame, NaN where it is hidden; each is seen in the last frame.

        Raises
        ------
        ValueError
            If there are no frames or targets, a frame or box is unusable, or a target is hidden in the last frame.
        """
        known = check_training(frames, boxes)
        if not all(len(frames) - 1 in of_one for of_one in known):
            raise ValueError("a target is hidden in the last training frame, so nobody knows where it is")
        self._shape, self.targets, self._n_born, self._recent = frames[-1].shape, [], 0, []
        self._camera_shift(frames[-1])
        picture = Picture(frames[-1])
        for of_one in known:
            self._start(of_one, frames, picture, np.zeros(2))

    def update(self, frame: np.ndarray, detections=None) -> list[Track]:
        """Follow all targets into the next frame, the first included; take leave of some, and welcome others.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The next frame.
        detections : array_like, shape (D, 5), optional
            ``x, y, w, h, score`` of the pedestrians in it; by default the detector looks for them.

        Returns
        -------
        list of Track
            The targets that are believed to be seen, in the order of their numbers.

        Raises
        ------
        ValueError
            If the frame is no colour image, or not of the size of those before, or the detections are no boxes.
        """
        check_same_size(check_picture(frame).shape, self._shape)
        found = check_detections(self.detector.detect(frame) if detections is None else detections)
        self._shape = frame.shape
        shift, picture = self._camera_shift(frame), Picture(frame)
        if "parts" in self.additions:
            found = found[~_parts(found)]
        for target in self.targets:
            target.predict(shift)
        observations = self._observe(frame, found)
        owners = self._associate(picture, observations)
        nearest_first = sorted(range(len(self.targets)), key=lambda j: -self.targets[j].feet)
        for target, i in [(self.targets[j], owners.get(j)) for j in nearest_first]:
            target.update(picture, None if i is None else observations[i])
            if "mutual occlusion" in self.additions and not target.missing:
                picture.cover(target.box)
        self._remove()
        free = np.setdiff1d(np.arange(len(observations)), list(owners.values()))
        self._add(frame, picture, observations[free], shift)
        return [target.track for target in self.targets if not target.missing]

    def _camera_shift(self, frame: np.ndarray) -> np.ndarray:
        """Return by how much the background has moved, in pixels."""
        if "camera" not in self.additions:
            return np.zeros(2)
        before, self._gray = self._gray, motion.reduced_gray(frame)
        if before is None:
            return np.zeros(2)
        return motion.camera_shift(before, self._gray) * frame.shape[1] / self._gray.shape[1]

    def _observe(self, frame: np.ndarray, found: np.ndarray) -> np.ndarray:
        """Return what is observed: detections, and as printed what the confidence maps of known people show first."""
        if not self.as_printed:
            return found
        known = np.array([box for each in self.targets if (box := each.observe(frame)) is not None]).reshape(-1, 5)
        new = pairwise_overlap(found[:, :4], known[:, :4]).max(axis=1, initial=0) < SAME
        return np.concatenate([known, found[new]])

    def _associate(self, picture: Picture, observations: np.ndarray) -> dict[int, int]:
        """Fill the incidence matrix (eq. 6), and return for each target that was observed by which observation."""
        from scipy.optimize import linear_sum_assignment  # takes a second to import

        least = PrintedTarget.LEAST if self.as_printed else UNMATCHED
        self.incidence = np.full((len(observations), len(self.targets)), least)
        for j, target in enumerate(self.targets):
            self.incidence[:, j] = np.maximum(target.associate(picture, observations), least)
        if "one to one" in self.additions:
            pairs = zip(*linear_sum_assignment(self.incidence, maximize=True), strict=True)
        else:
            pairs = [(column.argmax(), j) for j, column in enumerate(self.incidence.T) if len(column)]
        return {int(j): int(i) for i, j in pairs if self.incidence[i, j] > least}

    def _remove(self) -> None:
        """Take leave of those who have disappeared (section 4.2.3 and eq. 10)."""
        lasting = self.remember if "re-finding" in self.additions else self.n_frames
        for target in self.targets:
            target.missing = target.n_absent >= min(self.n_frames, target.trust)
        self.targets = [each for each in self.targets if each.n_absent < lasting and not self._has_left(each)]

    def _has_left(self, target) -> bool:
        """Tell whether somebody has gone out of the picture."""
        if "border" not in self.additions:
            return False
        height, width = self._shape[:2]
        x, y, w, h = target.box
        center = x + w / 2
        across = -BEYOND["sides"] * h <= center <= width + BEYOND["sides"] * h
        down = -BEYOND["top"] * h <= y <= height - HEAD_ROOM and target.feet <= height + BEYOND["bottom"] * h
        at_the_edge = not BORDER * h <= center <= width - BORDER * h or target.feet > height - FEET_ROOM
        return not (across and down) or (at_the_edge and target.n_absent >= self.n_frames)

    def _add(self, frame: np.ndarray, picture: Picture, free: np.ndarray, shift: np.ndarray) -> None:
        """Welcome those who were seen in so many frames in a row, and were nobody known (eq. 11)."""
        free = free[free[:, 4] >= self.birth_score]
        known = np.array([target.box for target in self.targets if not target.missing]).reshape(-1, 4)
        taken = pairwise_overlap(free[:, :4], known).max(axis=1, initial=0) > TAKEN
        if "parts" in self.additions:
            taken |= _shares_inside(free[:, :4], known).max(axis=1, initial=0) > INSIDE
        n_needed = PrintedTarget.N_TRAINING if self.as_printed and not self.targets else self.n_frames
        self._recent = [*self._recent, (frame, free[~taken])][-n_needed:]
        if len(self._recent) < n_needed:
            return
        for boxes in link([found for _, found in self._recent], min_frames=n_needed):
            self._start(boxes, [seen for seen, _ in self._recent], picture, shift)
        kept = [target.box for target in self.targets if not target.missing]
        self._recent = [(seen, found[~_near(found, kept)]) for seen, found in self._recent]

    def _start(self, boxes: dict[int, np.ndarray], frames, picture: Picture, shift: np.ndarray) -> None:
        """Begin to follow somebody, who was in these boxes of the latest frames."""
        self._n_born += 1
        rng = stream(self.seed, self._n_born)
        if self.as_printed:
            of_boxes = [frames[t] for t in boxes]
            newcomer = PrintedTarget(self._n_born, list(boxes.values()), of_boxes, self, rng)
        else:
            newcomer = _Target(self._n_born, boxes, picture, shift, self, rng)
        self.targets.append(newcomer)


def _near(found, boxes) -> np.ndarray:
    return pairwise_overlap(found[:, :4], np.reshape(boxes, (-1, 4))).max(axis=1, initial=0) > SAME


def _shares_inside(boxes, others) -> np.ndarray:
    """Return which share of each of some boxes lies in each of others, shape (M, K)."""
    x, y, w, h = np.reshape(boxes, (-1, 4)).T
    return patches.coverage(np.reshape(others, (-1, 4)), np.column_stack([x, y, x + w, y + h]))[:, 0].T


def _parts(found: np.ndarray) -> np.ndarray:
    """Tell which detections are parts of others: inside one that is taller, and not much less sure."""
    _, _, _, h, score = found.T
    bigger = (h > TALLER * h[:, None]) & (score >= score[:, None] / 2)
    return (bigger & (_shares_inside(found[:, :4], found[:, :4]) > INSIDE)).any(axis=1)


class _Target:
    """Somebody who is followed: looks, and particles ``[x, y, w, h, dx/dt, dy/dt]`` with `x` and `y` of the centre."""

    def __init__(self, number: int, boxes: dict[int, np.ndarray], picture: Picture, shift, settings, rng):
        self.settings, self.rng = settings, rng
        self.additions = settings.additions
        first, last = min(boxes), max(boxes)
        self.box = np.array(boxes[last], dtype=float)
        x, y, w, h = self.box
        moved = (boxes[last] - boxes[first])[:2] + (boxes[last] - boxes[first])[2:] / 2
        velocity = moved / (last - first) - shift if last > first else np.zeros(2)
        spread = [DETECTION_NOISE[0] * h] * 2 + [0, 0] + [START_SPEED * h] * 2
        start = [x + w / 2, y + h / 2, w, h, *velocity]
        self.states = start + spread * rng.standard_normal((settings.n_particles, 6))
        self.states[:, 2:4] *= np.exp(DETECTION_NOISE[1] / 2 * rng.standard_normal((settings.n_particles, 1)))
        self.looks = Looks(picture, self.box, settings.n_bands, "surroundings" in self.additions)
        self.shares = np.array([0.5, 0.5])
        alike, _ = self.looks.similarities(picture, self._boxes())
        self.usual = float(self._log_likelihood(alike).mean())  # how alike it looks where it is, and in colour alone
        self.usual_color = float(alike[0].mean())
        self.n_found, self.n_missed, self.n_absent, self.missing = len(boxes), 0, 0, False
        self.share_seen = 1.0
        self.track = Track(number, self.box, 1.0)

    @property
    def feet(self) -> float:
        """Lower edge of the box: the lower in the picture, the nearer to the camera."""
        return self.box[1] + self.box[3]

    @property
    def trust(self) -> float:
        """Frames without a detection for which the target is believed."""
        return TRUST * self.n_found

    def _boxes(self) -> np.ndarray:
        x, y, w, h = self.states[:, :4].T
        return np.column_stack([x - w / 2, y - h / 2, w, h])

    def predict(self, shift: np.ndarray) -> None:
        """Move the particles by their velocities and the camera's; the noise follows when it is known who is found."""
        if self.n_missed > 3 or self.share_seen < SEEN_AT_ALL:
            self.states[:, 4:] *= FADING
        self.states[:, :2] += shift
        if "velocity" in self.additions:
            self.states[:, :2] += self.states[:, 4:]

    def _variances(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the variances of motion and of detections, for ``x, y, log w, log h``."""
        h = self.box[3]
        step = np.hypot(*MOTION_NOISE) if "velocity" in self.additions else WALK_NOISE
        moving = np.array([step * h, step * h, SIZE_NOISE, SIZE_NOISE]) ** 2
        place, size = DETECTION_NOISE
        return moving, np.array([place * h, place * h, size, size]) ** 2

    def _surprise(self, observation) -> np.ndarray:
        """Return how far an observation is from where each particle expects it, in ``x, y, log w, log h``."""
        x, y, w, h = observation[:4]
        center = np.array([x + w / 2, y + h / 2]) - self.states[:, :2]
        return np.column_stack([center, np.log([w, h] / self.states[:, 2:4])])

    def associate(self, picture: Picture, observations: np.ndarray) -> np.ndarray:
        """Return the column of the incidence matrix: how well the target explains each observation."""
        if len(observations) == 0:
            return np.empty(0)
        looks = self._log_likelihood(self.looks.similarities(picture, observations[:, :4])[0])
        scores = LOOKS_COUNT * (looks - self.usual)
        if "gate" not in self.additions:
            return scores
        variance = np.sum(self._variances(), axis=0)[[0, 1, 3]]
        unit = [self.box[3], self.box[3], 1.0]  # a density per height squared, that near and far people compare
        constant = -0.5 * np.log(2 * np.pi * variance / np.square(unit)).sum()
        for i, observation in enumerate(observations):
            squares = (self._surprise(observation)[:, [0, 1, 3]] ** 2 / variance).sum(axis=1)
            scores[i] += constant + smc.log_sum_exp(-0.5 * squares) - np.log(len(squares))
        return scores

    def _log_similarities(self, similarities: np.ndarray) -> np.ndarray:
        """Return the logarithm of eq. 7 for both features; the squared distance is one less the coefficient."""
        return -(1 - similarities) / (2 * np.reshape(self.settings.sigma, (2, 1)) ** 2)

    def _log_likelihood(self, similarities: np.ndarray) -> np.ndarray:
        """Return the logarithm of the looks' likelihood: the product over features, or the sum of eq. 8."""
        log_each = self._log_similarities(similarities)
        if "product" in self.additions:
            return log_each.sum(axis=0)
        with np.errstate(divide="ignore"):
            return np.logaddexp(*(log_each + np.log(self.shares)[:, None]))

    def update(self, picture: Picture, observation) -> None:
        """Draw, weigh, estimate, resample and learn, with the observation of the target if there is one."""
        log_weights = self._draw(observation)
        similarities, seen = self.looks.similarities(picture, self._boxes())
        if "product" not in self.additions:
            self.shares = feature_weights(np.exp(self._log_similarities(similarities)))
        looks = self._log_likelihood(similarities)
        if observation is not None or self.n_absent == 0:  # who is absent only moves (section 4.3)
            log_weights += seen * looks + (1 - seen) * (self.usual - HIDDEN_LIKE)
        weights = smc.normalize(log_weights)
        x, y, w, h, _, _ = smc.weighted_mean(self.states, weights)
        self.box = np.array([x - w / 2, y - h / 2, w, h])
        self.share_seen = float(weights @ seen)
        likeness = float(weights @ (seen * similarities[0]) / max(self.share_seen, 1e-9))
        held = observation is None and self.share_seen < SEEN_AT_ALL
        self.track = Track(self.track.id, self.box, likeness, held, self.states[:, :4], weights, float(self.shares[0]))
        if observation is None:
            self._miss(likeness)
        else:
            self._find(picture, likeness, float(weights @ looks))
        self.states = self.states[smc.systematic(weights, self.rng)]

    def _draw(self, observation) -> np.ndarray:
        """Draw the particles from the optimal proposal, or the motion alone; return the logarithms of their weights."""
        moving, detecting = self._variances()
        n = len(self.states)
        log_weights, gain, surprise = np.zeros(n), np.zeros(4), np.zeros((n, 4))
        if observation is not None and "proposal" in self.additions:
            surprise = self._surprise(observation)
            gain = moving / (moving + detecting)
            log_weights -= 0.5 * (surprise**2 / (moving + detecting))[:, [0, 1, 3]].sum(axis=1)
        noise = self.rng.standard_normal((n, 3))[:, [0, 1, 2, 2]]  # width and height change together
        step = gain * surprise + np.sqrt((1 - gain) * moving) * noise
        self.states[:, :2] += step[:, :2]
        self.states[:, 2:4] *= np.exp(step[:, 2:])
        if "velocity" in self.additions:  # what is now known of the step tells something of the velocity
            place, speed = MOTION_NOISE
            part = speed**2 / (place**2 + speed**2)
            spread = speed * np.sqrt(1 - part) * self.box[3]
            self.states[:, 4:] += part * step[:, :2] + spread * self.rng.standard_normal((n, 2))
        return log_weights

    def _miss(self, likeness: float) -> None:
        """Count a frame without a detection; it is no absence while the target looks as usual where it should be."""
        self.n_missed += 1
        evident = self.share_seen > SEEN_AT_ALL and likeness > self.usual_color - USUAL_DROP
        self.n_absent = 0 if evident and self.n_missed < min(AT_MOST, self.trust) else self.n_absent + 1

    def _find(self, picture: Picture, likeness: float, log_likelihood: float) -> None:
        """Count a detection, and learn from it if the target is seen well."""
        self.n_found += 1
        self.n_missed = self.n_absent = 0
        self.missing = False
        if self.share_seen > SEEN_WELL:
            self.usual += 2 * LEARNING_RATE * (log_likelihood - self.usual)
            self.usual_color += 2 * LEARNING_RATE * (likeness - self.usual_color)
            self.looks.learn(picture, self.box, LEARNING_RATE)
