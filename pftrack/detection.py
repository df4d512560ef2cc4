r"""Finding pedestrians: motion first, then gradients where it moves, then what sizes people have (Li et al. 2012, 3.1).

A detector answers for every frame where there are people, without knowing who they are. The one of Li et al. has two
parts. *Background subtraction* or *frame difference* marks the pixels that move, and these make up motion regions. The
*histogram of oriented gradients* (HOG) with a linear support vector machine (Dalal and Triggs 2005) then slides a
window over the motion regions only, at many sizes, and says how much each window looks like a person.

One person answers to many windows. They are merged, trimmed to the person, and held against a *size prior*: on level
ground, seen by a camera at rest, a person's height in pixels is a linear function of where the feet are,

.. math:: h = a + b\, y_{\text{foot}} ,

and the detections themselves teach it. Chapter 8 builds the detector; what each part is worth is in
``results/detection.csv``.
"""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from tqdm.auto import tqdm

from pftrack.checks import check_picture, check_same_size
from pftrack.color import pixel_edges
from pftrack.files import replacing
from pftrack.metrics import pairwise_overlap

WINDOW = (64, 128)
"""Width and height of OpenCV's people window, in pixels."""

TRIM = (0.2, 0.1, 0.6, 0.77)
"""Where in a window the person stands, by the shares of it that are left, top, width and height."""

ASPECT = 0.36
"""Width of a person, relative to the height."""

BACKGROUNDS = ("knn", "mog2", "difference", "none")
"""Ways to tell what moves."""

SURE = 0.5
"""Score from which a detection teaches the size prior."""

BLOCK = 50
"""Frames whose windows are kept in one file of a store."""


# ---------------------------------------------------------------------------------------------------------------------
# What moves
# ---------------------------------------------------------------------------------------------------------------------


class MotionMask:
    """Tell in every frame which pixels move (Li et al. 2012, Fig. 3).

    Parameters
    ----------
    method : {"knn", "mog2", "difference", "none"}
        OpenCV's background subtraction by k nearest neighbours or by a mixture of Gaussians (Zivkovic and van der
        Heijden 2006), the difference to the frame before, or all pixels in every frame. *The paper does not say which
        background subtraction it uses.*
    history : int
        Frames over which a background is learnt.
    threshold : float
        Difference in one of the colours, from 0 to 255, that is motion for the frame difference.

    Raises
    ------
    ValueError
        If `method` is unknown.

    Notes
    -----
    In the first frame, and until a background is known, everything moves.

    OpenCV's k nearest neighbours draw which pixels to remember from OpenCV's one global generator, and take no other.
    So that a film has one answer, that generator is set to the frame's number before each frame.

    Examples
    --------
    >>> motion = MotionMask("difference")
    >>> frame = np.zeros((40, 60, 3), dtype=np.uint8)
    >>> bool(motion(frame).all()), bool(motion(frame).any())
    (True, False)
    """

    def __init__(self, method: str = "knn", history: int = 500, threshold: float = 20.0):
        if method not in BACKGROUNDS:
            raise ValueError(f"unknown method {method!r}; choose one of {', '.join(BACKGROUNDS)}")
        self.method, self.threshold = method, threshold
        if method == "knn":
            self._model = cv2.createBackgroundSubtractorKNN(history, dist2Threshold=400.0, detectShadows=False)
        elif method == "mog2":
            self._model = cv2.createBackgroundSubtractorMOG2(history, varThreshold=25.0, detectShadows=False)
        self._before, self._n_frames = None, 0

    def __call__(self, frame: np.ndarray) -> np.ndarray:
        """Learn from the next frame and return its mask.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The next frame.

        Returns
        -------
        ndarray, shape (H, W), bool
            True where it moves; single pixels are cleaned away.
        """
        if self.method == "none":
            return np.ones(frame.shape[:2], dtype=bool)
        first, self._before, before = self._before is None, frame, self._before
        self._n_frames += 1
        if self.method == "difference":
            if first:
                return np.ones(frame.shape[:2], dtype=bool)
            mask = (cv2.absdiff(frame, before).max(axis=2) > self.threshold).astype(np.uint8)
        else:
            cv2.setRNGSeed(self._n_frames)
            mask = self._model.apply(frame)
            if first:
                return np.ones(frame.shape[:2], dtype=bool)
        return cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


def motion_regions(mask: np.ndarray, padding: float = 0.2, min_pixels: int = 80) -> np.ndarray:
    """Rectangles around what moves, large enough for the HOG window to see the surroundings of a person.

    Parameters
    ----------
    mask : ndarray, shape (H, W), bool
        From :class:`MotionMask`.
    padding : float
        What is added on every side, relative to the height; at least 24 pixels are. A window has such a margin about
        the person.
    min_pixels : int
        Parts of the mask that are smaller, after gaps of a few pixels were closed, are left out.

    Returns
    -------
    ndarray of int, shape (R, 4)
        ``(left, top, right, bottom)``, right and bottom exclusive, inside the image. Two that overlap are merged where
        that saves pixels.

    Examples
    --------
    >>> mask = np.zeros((200, 300), dtype=bool)
    >>> mask[60:140, 50:80] = mask[100:110, 200:230] = True
    >>> motion_regions(mask)
    array([[ 24,  32, 106, 168],
           [174,  57, 256, 153]])
    """
    closed = cv2.dilate(mask.astype(np.uint8), np.ones((9, 5), np.uint8))
    _, _, parts, _ = cv2.connectedComponentsWithStats(closed)
    x, y, w, h = parts[1:][parts[1:, cv2.CC_STAT_AREA] >= min_pixels, :4].T
    margin = np.maximum(np.rint(padding * h).astype(int), 24)
    wider, higher = np.maximum(margin, [(WINDOW[0] * 0.75 - w) // 2, (WINDOW[1] * 0.75 - h) // 2])
    regions = np.stack([x - wider, y - higher, x + w + wider, y + h + higher], axis=1)
    regions = regions.clip(0, [*mask.shape[::-1]] * 2).tolist()
    n = 0
    while n < len(regions):
        for m in range(n + 1, len(regions)):
            union = [*np.minimum(regions[n], regions[m])[:2], *np.maximum(regions[n], regions[m])[2:]]
            if _touch(regions[n], regions[m]) and _area(union) <= _area(regions[n]) + _area(regions[m]):
                regions[n] = union
                del regions[m]
                n = -1  # the union may touch one that was passed
                break
        n += 1
    return np.array(regions, dtype=int).reshape(-1, 4)


def _area(edges) -> int:
    return (edges[2] - edges[0]) * (edges[3] - edges[1])


def _touch(a, b) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


# ---------------------------------------------------------------------------------------------------------------------
# What looks like a person
# ---------------------------------------------------------------------------------------------------------------------


def hog_windows(frame: np.ndarray, regions, scale: float = 2.0, threshold: float = 0.0) -> np.ndarray:
    """Windows that look like a person to OpenCV's people detector (Dalal and Triggs 2005), before any merging.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A frame.
    regions : array_like of int, shape (R, 4)
        ``(left, top, right, bottom)`` of where to look, from :func:`motion_regions`.
    scale : float
        How much the picture is enlarged first: at 2, the window of 64x128 pixels finds people of about 50 pixels.
    threshold : float
        Lowest score; 0 is the decision boundary of the support vector machine.

    Returns
    -------
    ndarray, shape (N, 5)
        ``x, y, w, h, score``: windows in pixels of the frame, and their distance from the decision boundary, the least
        first. OpenCV cuts those that reach over the border of a region.

    Raises
    ------
    ValueError
        If `scale` is not positive.

    Examples
    --------
    >>> hog_windows(np.zeros((200, 200, 3), dtype=np.uint8), [[0, 0, 200, 200]]).shape
    (0, 5)
    """
    if not scale > 0:
        raise ValueError(f"scale must be positive, got {scale}")
    hog = cv2.HOGDescriptor()
    hog.setSVMDetector(cv2.HOGDescriptor_getDefaultPeopleDetector())
    found = [np.empty((0, 5))]
    for left, top, right, bottom in np.asarray(regions, dtype=int).tolist():
        part = cv2.resize(frame[top:bottom, left:right], None, fx=scale, fy=scale, interpolation=cv2.INTER_LINEAR)
        if part.shape[1] + 32 < WINDOW[0] or part.shape[0] + 32 < WINDOW[1]:
            continue  # smaller than a window, even with the padding
        windows, scores = hog.detectMultiScale(
            part, hitThreshold=threshold, winStride=(8, 8), padding=(16, 16), scale=1.05, groupThreshold=0
        )
        if len(windows):
            found.append(np.column_stack([windows / scale + [left, top, 0, 0], np.ravel(scores)]))
    found = np.concatenate(found)
    return found[np.lexsort(found.T)]  # OpenCV's threads hand them in in any order


def trim(windows, shares=TRIM) -> np.ndarray:
    """Cut windows down to the person in the middle: the detector was trained with a margin.

    Parameters
    ----------
    windows : array_like, shape (N, 4)
        ``(x, y, w, h)`` in pixels.
    shares : tuple of float
        Left, top, width and height of the person, as shares of the window.

    Returns
    -------
    ndarray, shape (N, 4)
        Boxes of the persons.

    Examples
    --------
    >>> trim([[100, 50, 64, 128]]).round(1)
    array([[112.8,  62.8,  38.4,  98.6]])
    """
    x, y, w, h = np.asarray(windows, dtype=float).T
    left, top, width, height = shares
    return np.column_stack([x + left * w, y + top * h, width * w, height * h])


def merge(
    boxes, scores, overlap: float = 0.4, min_boxes: int = 1, weighted: bool = True
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Merge boxes that mean the same person, each with a weight that grows with its score.

    Plain non-maximum suppression keeps the best box of a heap and drops the others. But the best box is often a little
    off, and the others know it: here their weighted mean is taken, and a box that stands alone is not believed.

    Parameters
    ----------
    boxes : array_like, shape (N, 4)
        ``(x, y, w, h)`` in pixels.
    scores : array_like, shape (N,)
        Scores of at least 0.
    overlap : float
        Least intersection over union with the best box of a heap to belong to it.
    min_boxes : int
        Heaps of fewer boxes are dropped.
    weighted : bool
        Whether to take the mean; the best box if not.

    Returns
    -------
    merged : ndarray, shape (M, 4)
        One box for each heap, that of the best score first.
    best : ndarray, shape (M,)
        The best score of each.
    members : list of ndarray of int
        Which boxes each is made of.

    Examples
    --------
    >>> merged, best, members = merge([[0, 0, 10, 20], [2, 0, 10, 20], [50, 0, 10, 20]], [3.0, 1.0, 2.0], min_boxes=2)
    >>> merged.round(2), best, members
    (array([[ 0.5,  0. , 10. , 20. ]]), array([3.]), [array([0, 1])])
    """
    boxes, scores = np.asarray(boxes, dtype=float).reshape(-1, 4), np.asarray(scores, dtype=float)
    overlaps = pairwise_overlap(boxes, boxes)
    left = np.ones(len(boxes), dtype=bool)
    merged, best, members = [], [], []
    for n in np.argsort(-scores, kind="stable"):
        if not left[n]:
            continue
        (heap,) = np.nonzero(left & (overlaps[n] >= overlap))
        left[heap] = False
        if len(heap) >= min_boxes:
            merged.append(np.average(boxes[heap], axis=0, weights=scores[heap] + 1e-6) if weighted else boxes[n])
            best.append(scores[n])
            members.append(heap)
    return np.array(merged).reshape(-1, 4), np.array(best), members


# ---------------------------------------------------------------------------------------------------------------------
# What sizes people have
# ---------------------------------------------------------------------------------------------------------------------


class SizePrior:
    """Height of a person as a linear function of the feet's position, learnt from detections as they come.

    Parameters
    ----------
    min_boxes : int
        Number of boxes from which it is used.
    max_boxes : int
        Number of latest boxes that it is fitted to.

    Attributes
    ----------
    line : ndarray, shape (2,), or None
        Intercept `a` and slope `b` of the height in pixels; None until enough is known.
    spread : float
        Robust standard deviation of the logarithm of people's heights about the line.

    Examples
    --------
    People of 40, 60 and 80 pixels, and a pillar that was taken for one:

    >>> prior = SizePrior()
    >>> prior.learn([[0, 60, 20, 40], [0, 100, 30, 60], [0, 140, 40, 80]] * 20 + [[0, 0, 30, 160]])
    >>> prior.heights([160.0]).round()
    array([60.])
    """

    def __init__(self, min_boxes: int = 30, max_boxes: int = 1000):
        self.min_boxes, self.max_boxes = min_boxes, max_boxes
        self.line, self.spread = None, np.inf
        self._boxes = np.empty((0, 2))

    def learn(self, boxes) -> None:
        """Take in new boxes, and fit the line again with a loss that outliers cannot bend (Huber 1964).

        Parameters
        ----------
        boxes : array_like, shape (N, 4)
            Boxes of people seen from head to foot, ``(x, y, w, h)`` in pixels.
        """
        from scipy.optimize import least_squares

        _, y, _, h = np.asarray(boxes, dtype=float).reshape(-1, 4).T
        self._boxes = np.concatenate([self._boxes, np.column_stack([y + h, h])])[-self.max_boxes :]
        if len(y) == 0 or len(self._boxes) < self.min_boxes:
            return
        feet, heights = self._boxes.T
        middle, typical = feet.mean(), np.median(heights)
        steadier = 0.1 * typical  # a slope is believed as far as feet at different places show it

        def residuals(line):
            off = (line[0] + line[1] * (feet - middle)) / heights - 1
            return np.append(off, line[1] * steadier / typical)

        start = [typical, 0.0] if self.line is None else [self.line @ [1, middle], self.line[1]]
        fitted = least_squares(residuals, start, loss="huber", f_scale=0.05).x
        self.line = np.array([fitted[0] - fitted[1] * middle, fitted[1]])
        self.spread = 1.4826 * np.median(np.abs(np.log(heights / self.heights(feet))))

    def heights(self, feet) -> np.ndarray:
        """Heights to be expected.

        Parameters
        ----------
        feet : array_like, shape (N,)
            Lower edges of boxes, in pixels.

        Returns
        -------
        ndarray, shape (N,)
            Heights in pixels, at least 10.

        Raises
        ------
        ValueError
            If too few boxes were seen.
        """
        if self.line is None:
            raise ValueError(f"the size prior needs {self.min_boxes} boxes before it can tell a height")
        return np.maximum(self.line[0] + self.line[1] * np.asarray(feet, dtype=float), 10.0)


# ---------------------------------------------------------------------------------------------------------------------
# The detector
# ---------------------------------------------------------------------------------------------------------------------


class PedestrianDetector:
    """Find pedestrians in the frames of a film, one after the other (Li et al. 2012, Fig. 2).

    The detector remembers the background and the sizes of people, so it must see the frames in their order, and a new
    film needs a new detector.

    Parameters
    ----------
    background : {"knn", "mog2", "difference", "none"}
        How motion is told, see :class:`MotionMask`; ``"none"`` searches the whole frame.
    scale, threshold
        As for :func:`hog_windows`.
    trimmed : bool
        Whether to cut windows down to the person; HOG's own windows are left if not.
    weighted : bool
        Whether to take the weighted mean of windows that mean the same person, see :func:`merge`.
    min_windows : int
        Windows of which a detection must at least consist; 1 believes each.
    min_foreground : float
        Least share of a detection's pixels that must move, from 0 to 1.
    size_prior : bool
        Whether to learn the sizes of people, drop detections of other sizes, and correct the rest. It needs `trimmed`.
    gate : float
        Largest logarithm of a height's ratio to the expected one, above 0; or three standard deviations of the prior
        where that is more, so that a prior that knows little drops little.
    height_noise : float
        Relative standard deviation of a detection's own height, above 0. It and the prior's spread say how far a height
        is moved towards the expected one.

    Raises
    ------
    ValueError
        If an argument is out of its range.

    Examples
    --------
    >>> detector = PedestrianDetector()
    >>> detector.detect(np.zeros((240, 320, 3), dtype=np.uint8)).shape
    (0, 5)
    """

    def __init__(
        self,
        background: str = "knn",
        *,
        scale: float = 2.0,
        threshold: float = 0.0,
        trimmed: bool = True,
        weighted: bool = True,
        min_windows: int = 2,
        min_foreground: float = 0.2,
        size_prior: bool = True,
        gate: float = 0.3,
        height_noise: float = 0.06,
    ):
        if not scale > 0 or not threshold >= 0 or min_windows < 1 or not 0 <= min_foreground <= 1:
            raise ValueError(
                "need a positive scale, a threshold and min_foreground of 0 or more, and at least 1 window, "
                f"got {scale}, {threshold}, {min_foreground} and {min_windows}"
            )
        if not gate > 0 or not height_noise > 0:
            raise ValueError(f"gate and height_noise must be positive, got {gate} and {height_noise}")
        self.motion = MotionMask(background)
        self.prior = SizePrior() if size_prior else None
        self.scale, self.threshold = scale, threshold
        self.trimmed, self.weighted = trimmed, weighted
        self.min_windows, self.min_foreground = min_windows, min_foreground
        self.gate, self.height_noise = gate, height_noise
        self._shape = None

    def detect(self, frame: np.ndarray) -> np.ndarray:
        """Find the pedestrians in the next frame.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            A colour image in BGR order.

        Returns
        -------
        ndarray, shape (D, 5)
            ``x, y, w, h, score``: boxes in pixels, best score first. The score is the distance from the support vector
            machine's decision boundary, 0 or more.

        Raises
        ------
        ValueError
            If the frame is no colour image, or not of the size of those before.
        """
        return self.refine(self.propose(frame), frame.shape)

    def propose(self, frame: np.ndarray) -> np.ndarray:
        """Do the first and slow part of :meth:`detect`: find the windows that look like a person and move.

        Returns
        -------
        ndarray, shape (N, 6)
            ``x, y, w, h, score, foreground``: windows of :func:`hog_windows`, and the share of moving pixels where the
            person stands, 0 to 1.

        Raises
        ------
        ValueError
            As for :meth:`detect`.
        """
        check_same_size(check_picture(frame).shape, self._shape)
        self._shape = frame.shape
        mask = self.motion(frame)
        windows = hog_windows(frame, motion_regions(mask), self.scale, self.threshold)
        sums = cv2.integral(mask.astype(np.uint8))
        edges = pixel_edges(trim(windows[:, :4]))
        left, top, right, bottom = edges.clip(0, [*mask.shape[::-1]] * 2).T
        moving = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        return np.column_stack([windows, moving / np.maximum((right - left) * (bottom - top), 1)])

    def refine(self, windows, shape) -> np.ndarray:
        """Do the second and quick part of :meth:`detect`: make boxes of people out of windows.

        Parameters
        ----------
        windows : array_like, shape (N, 6)
            From :meth:`propose`, of the next frame.
        shape : tuple of int
            Shape of the frame, ``(H, W, ...)``.

        Returns
        -------
        ndarray, shape (D, 5)
            As for :meth:`detect`.
        """
        windows = np.asarray(windows, dtype=float).reshape(-1, 6)
        boxes, scores, members = merge(
            windows[:, :4], windows[:, 4], min_boxes=self.min_windows, weighted=self.weighted
        )
        moving = np.array([windows[heap, 5].mean() for heap in members]) >= self.min_foreground
        boxes, scores = boxes[moving], scores[moving]
        if not self.trimmed:
            return np.column_stack([boxes, scores])
        boxes = trim(boxes)
        boxes = _resize(boxes, boxes[:, 3])
        if self.prior is not None:
            boxes, scores = self._believe(boxes, scores, shape[0])
        boxes, scores, _ = merge(boxes, scores)
        return np.column_stack([boxes, scores])

    def _believe(self, boxes, scores, height: int) -> tuple[np.ndarray, np.ndarray]:
        """Let boxes teach the size prior, drop those of unusual size, and correct the others."""
        self.prior.learn(boxes[(boxes[:, 1] > 0) & (boxes[:, 1] + boxes[:, 3] < height) & (scores > SURE)])
        if self.prior.line is None:
            return boxes, scores
        expected = self.prior.heights(boxes[:, 1] + boxes[:, 3])
        usual = np.abs(np.log(boxes[:, 3] / expected)) < max(self.gate, 3 * self.prior.spread)
        boxes, expected = boxes[usual], expected[usual]
        pull = self.height_noise**2 / (self.height_noise**2 + self.prior.spread**2)
        return _resize(boxes, (1 - pull) * boxes[:, 3] + pull * expected), scores[usual]


def _resize(boxes, heights) -> np.ndarray:
    """Give boxes other heights, and the width that belongs to them, about the same centres."""
    sizes = np.column_stack([ASPECT * heights, heights])
    return np.column_stack([boxes[:, :2] + boxes[:, 2:] / 2 - sizes / 2, sizes])


def detect(
    frames: Sequence[np.ndarray],
    detector: PedestrianDetector | None = None,
    *,
    store: str | os.PathLike | None = None,
    progress: bool = False,
) -> np.ndarray:
    """Find the pedestrians in all frames of a film.

    Parameters
    ----------
    frames : sequence of ndarray, shape (H, W, 3), uint8
        The frames; read one at a time.
    detector : PedestrianDetector, optional
        A new detector; one with the default settings if not given.
    store : path, optional
        A folder, made if need be, in which the windows of every fifty frames are kept, under a name that depends on the
        content of all frames so far and on the settings. Interrupted work goes on where it stopped.
    progress : bool
        Whether to show a progress bar.

    Returns
    -------
    ndarray, shape (R, 7)
        A table of detections, see :mod:`pftrack.datasets.readers`: ``frame, id, x, y, w, h, score`` with id -1.

    Raises
    ------
    ValueError
        If a frame is no colour image, or they differ in size.

    Examples
    --------
    >>> import pftrack
    >>> scene = pftrack.datasets.load("synthetic-walk")
    >>> detect(scene.frames[:3]).shape[1]
    7
    """
    detector = PedestrianDetector() if detector is None else detector
    rows = [np.empty((0, 7))]
    for t, (windows, shape) in enumerate(_proposals(frames, detector, store, progress)):
        found = detector.refine(windows, shape)
        rows.append(np.column_stack([np.full(len(found), t), np.full(len(found), -1), found]))
    return np.concatenate(rows)


def _proposals(frames, detector: PedestrianDetector, store, progress: bool):
    """Yield the windows and the shape of every frame, from the store where they are there."""
    with tqdm(total=len(frames), unit="frame", disable=not progress) as bar:
        if store is None:
            for frame in frames:
                yield detector.propose(frame), frame.shape
                bar.update()
            return
        folder = Path(store)
        folder.mkdir(parents=True, exist_ok=True)
        settings = detector.motion.method, detector.scale, detector.threshold, cv2.__version__
        digest, n_seen, start = hashlib.sha256(repr(settings).encode()), 0, 0
        remaining = iter(frames)
        while block := list(itertools.islice(remaining, BLOCK)):
            for frame in block:
                digest.update(np.ascontiguousarray(check_picture(frame)))
            path = folder / f"{digest.hexdigest()[:32]}.npy"
            table = _read(path)
            if table is None:
                for frame in itertools.islice(frames, n_seen, start):  # those that the store spared it
                    detector.motion(frame)
                found = [detector.propose(frame) for frame in block]
                n_seen = start + len(block)
                table = np.concatenate([np.column_stack([np.full(len(w), t), w]) for t, w in enumerate(found)])
                with replacing(path) as temporary, temporary.open("wb") as file:
                    np.save(file, table)
            for t, frame in enumerate(block):
                yield table[table[:, 0] == t, 1:], frame.shape
            start += len(block)
            bar.update(len(block))


def _read(path: Path) -> np.ndarray | None:
    """Return a table of the store, or None if it is not there or was damaged by other hands."""
    try:
        return np.load(path)
    except (OSError, ValueError, EOFError):
        return None
