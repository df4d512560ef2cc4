r"""Superpixels: small regions of one colour, and how much each belongs to the target (Li et al. 2016, section 3).

A superpixel is a patch that keeps to the edges of things. In some first frames, in which the target's box is known, the
surroundings of the box are cut into superpixels, and their colour histograms clustered (:mod:`pftrack.codebook`). A
cluster that lies mostly inside the box is the target's, one that lies mostly beside it is background:

.. math:: C_i = \frac{a_i^{\text{ob}} - a_i^{\text{bg}}}{a_i^{\text{ob}} + a_i^{\text{bg}}} \in [-1, 1],

with :math:`a_i` the cluster's pixels inside and outside (eq. 1). In a new frame each superpixel takes the confidence of
the cluster it is nearest to, the less the farther away it is (eq. 2),

.. math:: C_s = e^{-\lambda \lVert f_s - c_i \rVert / r_i}\; C_i ,

and painted over its pixels this is a *confidence map*. Wang et al. (2011) track by it. Chapter 9 builds it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pftrack import codebook, color

FACTOR = 1.5
"""Sides of the surroundings, relative to those of the box."""


def surroundings(box, shape, factor: float = FACTOR, square: bool = False) -> tuple[int, int, int, int]:
    """Part of a frame around a box (Li et al. 2016, the region R2).

    Parameters
    ----------
    box : array_like, shape (4,)
        ``(x, y, w, h)`` in pixels.
    shape : tuple of int
        Shape of the frame, ``(H, W, ...)``.
    factor : float
        Its sides relative to those of the box, at least 1.
    square : bool
        Whether to take a square, its side relative to the diagonal of the box, as Wang et al. (2011) do.

    Returns
    -------
    tuple of int
        ``(left, top, right, bottom)``, cut to the frame, right and bottom exclusive.

    Raises
    ------
    ValueError
        If `factor` is below 1, or less than 2x2 pixels would be left.

    Examples
    --------
    >>> surroundings((40, 20, 20, 40), shape=(100, 100, 3))
    (35, 10, 65, 70)
    >>> surroundings((40, 35, 30, 40), shape=(100, 100, 3), square=True)  # the diagonal is 50
    (18, 18, 93, 93)
    """
    if not factor >= 1:
        raise ValueError(f"factor must be at least 1, got {factor}")
    x, y, w, h = np.asarray(box, dtype=float)
    width, height = (factor * np.hypot(w, h),) * 2 if square else (factor * w, factor * h)
    corner = x - (width - w) / 2, y - (height - h) / 2
    ((left, top, right, bottom),) = color.pixel_edges([[*corner, width, height]]).tolist()
    left, top, right, bottom = max(left, 0), max(top, 0), min(right, shape[1]), min(bottom, shape[0])
    if right - left < 2 or bottom - top < 2:
        raise ValueError(f"the surroundings of the box {list(box)} show less than 2x2 pixels of the frame")
    return left, top, right, bottom


def segment(picture: np.ndarray, n_segments: int = 200, compactness: float = 10.0, n_steps: int = 10) -> np.ndarray:
    """Cut a picture into superpixels by SLIC, scikit-image's.

    Parameters
    ----------
    picture : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.
    n_segments : int
        About how many, at least 1; the paper's is 200. Of a small picture fewer are made, of nine pixels at least.
    compactness : float
        How much nearness counts against colour, above 0.
    n_steps : int
        Rounds of SLIC's clustering, at least 1.

    Returns
    -------
    ndarray, shape (H, W), int
        Label of every pixel: 0 to the number of superpixels less 1, and each one occurs.

    Raises
    ------
    ValueError
        If an argument is out of its range.

    Examples
    --------
    >>> halves = np.zeros((20, 40, 3), dtype=np.uint8)
    >>> halves[:, 20:] = 255
    >>> segment(halves, n_segments=2)[10, [0, 19, 20, 39]]
    array([0, 0, 1, 1])
    """
    from skimage.segmentation import slic  # takes a second to import

    if n_segments < 1 or not compactness > 0 or picture.ndim != 3 or picture.size == 0:
        raise ValueError(
            "need a colour picture, at least 1 segment and a positive compactness, "
            f"got shape {picture.shape}, {n_segments} and {compactness}"
        )
    n_segments = max(min(n_segments, picture.shape[0] * picture.shape[1] // 9), 1)
    rgb = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_BGR2RGB)
    labels = slic(rgb, n_segments=n_segments, compactness=compactness, max_num_iter=n_steps, start_label=0)
    return (np.cumsum(np.bincount(labels.ravel()) > 0) - 1)[labels]  # without gaps


def histograms(bins: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Normalised histogram of every superpixel.

    Parameters
    ----------
    bins : ndarray, shape (H, W), uint8
        Histogram bin of every pixel, from :func:`pftrack.color.hsv_bins` or :func:`pftrack.texture.pattern_bins`.
    labels : ndarray, shape (H, W), int
        From :func:`segment`.

    Returns
    -------
    ndarray, shape (S, 256)
        Shares of its pixels in each bin.

    Raises
    ------
    ValueError
        If the shapes differ.

    Examples
    --------
    >>> features = histograms(np.uint8([[5, 5, 7, 9]]), np.array([[0, 0, 0, 1]]))
    >>> print(features[0, [5, 7]].round(3), features[1, 9])
    [0.667 0.333] 1.0
    """
    if bins.shape != labels.shape:
        raise ValueError(f"bins and labels must have one shape, got {bins.shape} and {labels.shape}")
    n = labels.max() + 1
    counts = np.bincount(labels.ravel() * 256 + bins.ravel(), minlength=256 * n).reshape(n, 256)
    return counts / counts.sum(axis=1, keepdims=True)


@dataclass(frozen=True)
class Superpixels:
    """A part of a frame, cut into superpixels.

    Attributes
    ----------
    origin : tuple of int
        Its first pixel in the frame, ``(x, y)``.
    labels : ndarray, shape (H, W), int
        Superpixel of every pixel, from :func:`segment`.
    features : ndarray, shape (S, 256)
        Colours of the superpixels, from :func:`histograms`.
    """

    origin: tuple[int, int]
    labels: np.ndarray
    features: np.ndarray


def cut(frame: np.ndarray, region, n_segments: int = 200, compactness: float = 10.0, n_steps: int = 10) -> Superpixels:
    """Cut a part of a frame into superpixels and describe their colours.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.
    region : tuple of int
        ``(left, top, right, bottom)`` of the part, from :func:`surroundings`.
    n_segments, compactness, n_steps
        As for :func:`segment`.

    Returns
    -------
    Superpixels
        Labels and histograms.

    Raises
    ------
    ValueError
        As :func:`segment`.

    Examples
    --------
    >>> frame = np.full((60, 80, 3), (0, 160, 0), dtype=np.uint8)
    >>> found = cut(frame, (20, 10, 50, 40), n_segments=9)
    >>> found.origin, found.labels.shape, found.features.shape
    ((20, 10), (30, 30), (9, 256))
    """
    left, top, right, bottom = region
    part = frame[top:bottom, left:right]
    labels = segment(part, n_segments, compactness, n_steps)
    return Superpixels((left, top), labels, histograms(color.hsv_bins(part), labels))


def areas(found: Superpixels, box) -> np.ndarray:
    """How many pixels of each superpixel lie inside a box, and how many outside.

    Parameters
    ----------
    found : Superpixels
        From :func:`cut`.
    box : array_like, shape (4,)
        ``(x, y, w, h)`` in pixels of the frame.

    Returns
    -------
    ndarray of int, shape (2, S)
        Pixels inside and outside.

    Examples
    --------
    >>> halves = Superpixels((10, 0), np.repeat([[0, 1]], 4, axis=0), np.eye(2))
    >>> areas(halves, [11, 1, 5, 2])
    array([[0, 2],
           [4, 2]])
    """
    ((x0, y0, x1, y1),) = np.maximum(color.pixel_edges([box]) - [*found.origin, *found.origin], 0).tolist()
    inside = np.bincount(found.labels[y0:y1, x0:x1].ravel(), minlength=len(found.features))
    return np.array([inside, np.bincount(found.labels.ravel()) - inside])


def paint(found: Superpixels, values, shape) -> np.ndarray:
    """Paint a value over the pixels of each superpixel.

    Parameters
    ----------
    found : Superpixels
        From :func:`cut`.
    values : array_like, shape (S,)
        One for each superpixel, such as its confidence.
    shape : tuple of int
        Shape of the frame, ``(H, W, ...)``.

    Returns
    -------
    ndarray, shape (H, W)
        The values, and -1, background, where the frame was not cut.

    Examples
    --------
    >>> halves = Superpixels((1, 0), np.array([[0, 1]]), np.eye(2))
    >>> paint(halves, [0.5, 1.0], shape=(2, 4, 3))
    array([[-1. ,  0.5,  1. , -1. ],
           [-1. , -1. , -1. , -1. ]])
    """
    (left, top), (height, width) = found.origin, found.labels.shape
    painted = np.full(shape[:2], -1.0)
    painted[top : top + height, left : left + width] = np.asarray(values)[found.labels]
    return painted


@dataclass(frozen=True)
class PriorKnowledge:
    """What the first frames taught about target and background.

    Attributes
    ----------
    centers : ndarray, shape (K, 256)
        Centres of the clusters.
    radii : ndarray, shape (K,)
        Largest distance of a member from its centre; for a cluster of one, the bandwidth.
    confidences : ndarray, shape (K,)
        From -1 (background) to 1 (target), eq. 1.
    """

    centers: np.ndarray
    radii: np.ndarray
    confidences: np.ndarray


def learn(frames, boxes, bandwidth: float = 0.18, n_segments: int = 200, compactness: float = 10.0) -> PriorKnowledge:
    """Learn from frames with known boxes what belongs to the target (Li et al. 2016, section 3.2).

    Parameters
    ----------
    frames : iterable of ndarray, shape (H, W, 3), uint8
        The first frames; the paper takes five.
    boxes : array_like, shape (M, 4)
        The target in each, ``(x, y, w, h)`` in pixels.
    bandwidth : float
        Of the clustering, :func:`pftrack.codebook.mean_shift`. *Not printed in the paper*; 0.18 is that of Wang et al.
    n_segments, compactness
        As for :func:`segment`.

    Returns
    -------
    PriorKnowledge
        Clusters and their confidences.

    Raises
    ------
    ValueError
        If there are no frames, or not as many boxes, or a box shows too little of its frame.

    Examples
    --------
    >>> frame = np.full((60, 80, 3), (0, 160, 0), dtype=np.uint8)
    >>> frame[20:40, 30:40] = (255, 0, 0)
    >>> learn([frame], [[30, 20, 10, 20]]).confidences
    array([-1.,  1.])
    """
    frames, boxes = list(frames), np.asarray(boxes, dtype=float)
    if not frames or boxes.shape != (len(frames), 4):
        raise ValueError(
            f"need at least one frame and one box for each, got {len(frames)} frames and boxes {boxes.shape}"
        )
    found = [
        cut(frame, surroundings(box, frame.shape), n_segments, compactness)
        for frame, box in zip(frames, boxes, strict=True)
    ]
    of_boxes = [areas(of_one, box) for of_one, box in zip(found, boxes, strict=True)]
    return cluster(np.concatenate([of_one.features for of_one in found]), np.concatenate(of_boxes, axis=1), bandwidth)


def cluster(features, areas, bandwidth: float = 0.18) -> PriorKnowledge:
    """Cluster superpixels and say of each cluster how much it is the target's (Li et al. 2016, eq. 1).

    Parameters
    ----------
    features : array_like, shape (S, 256)
        Of all superpixels of all frames to learn from.
    areas : array_like, shape (2, S)
        Pixels of each inside and outside the target's box, from :func:`areas`; no superpixel is empty.
    bandwidth : float
        As for :func:`learn`.

    Returns
    -------
    PriorKnowledge
        Clusters and their confidences.

    Raises
    ------
    ValueError
        As :func:`pftrack.codebook.mean_shift`.

    Examples
    --------
    >>> cluster([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]], areas=[[30, 10, 0], [0, 10, 20]]).confidences
    array([ 0.6, -1. ])
    """
    features, (inside, outside) = np.asarray(features, dtype=float), np.asarray(areas)
    centers = codebook.mean_shift(features, bandwidth)
    member_of = codebook.nearest_words(features, centers)
    occupied, member_of = np.unique(member_of, return_inverse=True)  # a mode may be the nearest to none
    centers = centers[occupied]
    radii = np.zeros(len(centers))
    np.maximum.at(radii, member_of, np.linalg.norm(features - centers[member_of], axis=1))
    radii[radii < 1e-9] = bandwidth
    target, background = np.bincount(member_of, inside), np.bincount(member_of, outside)
    return PriorKnowledge(centers, radii, (target - background) / (target + background))


def confidences(features, prior: PriorKnowledge, spread: float = 2.0, scale=None) -> np.ndarray:
    """How much superpixels belong to the target (Li et al. 2016, eq. 2).

    Parameters
    ----------
    features : array_like, shape (S, 256)
        From :func:`histograms`.
    prior : PriorKnowledge
        From :func:`learn`.
    spread : float
        The factor lambda of eq. 2, not negative; the paper's is 2.
    scale : array_like, shape (S,), optional
        What the distance of each superpixel is divided by, above 0; the radius of the cluster if not given.

    Returns
    -------
    ndarray, shape (S,)
        From -1 (background) to 1 (target); near 0 for what looks like nothing that was seen.

    Raises
    ------
    ValueError
        If `spread` is negative.

    Examples
    --------
    >>> prior = PriorKnowledge(np.eye(2), radii=np.array([0.5, 0.5]), confidences=np.array([1.0, -0.5]))
    >>> confidences([[1.0, 0.0], [0.0, 1.0], [0.7, 0.3]], prior).round(3)
    array([ 1.   , -0.5  ,  0.183])
    """
    if not spread >= 0:
        raise ValueError(f"spread must not be negative, got {spread}")
    squares = codebook.squared_distances(features, prior.centers)
    nearest = squares.argmin(axis=1)
    scale = prior.radii[nearest] if scale is None else np.asarray(scale, dtype=float)
    return np.exp(-spread * np.sqrt(squares.min(axis=1)) / scale) * prior.confidences[nearest]


def confidence_map(
    frame: np.ndarray, box, prior: PriorKnowledge, n_segments: int = 200, compactness: float = 10.0, spread: float = 2.0
) -> np.ndarray:
    """Paint a frame with how much each pixel belongs to the target (Li et al. 2016, section 3.3).

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A new frame.
    box : array_like, shape (4,)
        Where the target was, ``(x, y, w, h)`` in pixels.
    prior : PriorKnowledge
        From :func:`learn`.
    n_segments, compactness, spread
        As for :func:`segment` and :func:`confidences`.

    Returns
    -------
    ndarray, shape (H, W)
        Confidences in the surroundings of the box, and -1 elsewhere.

    Raises
    ------
    ValueError
        If the box shows too little of the frame.

    Examples
    --------
    >>> frame = np.full((60, 80, 3), (0, 160, 0), dtype=np.uint8)
    >>> frame[20:40, 30:40] = (255, 0, 0)
    >>> prior = learn([frame], [[30, 20, 10, 20]])
    >>> confidence_map(np.roll(frame, 1, axis=1), [30, 20, 10, 20], prior)[30, [0, 29, 31, 40, 41]]
    array([-1., -1.,  1.,  1., -1.])
    """
    found = cut(frame, surroundings(box, frame.shape), n_segments, compactness)
    return paint(found, confidences(found.features, prior, spread), frame.shape)


def sample_boxes(box, shape, n_boxes: int, rng: np.random.Generator, factor: float = FACTOR) -> np.ndarray:
    """Draw boxes of one size at random in the surroundings of a box (Li et al. 2016, section 3.3).

    Parameters
    ----------
    box : array_like, shape (4,)
        Where the target was, ``(x, y, w, h)`` in pixels.
    shape : tuple of int
        Shape of the frame, ``(H, W, ...)``.
    n_boxes : int
        How many.
    rng : numpy.random.Generator
        Source of randomness.
    factor : float
        As for :func:`surroundings`.

    Returns
    -------
    ndarray, shape (n_boxes, 4)
        Boxes of the same width and height, uniformly placed, all inside the surroundings where these hold them.

    Raises
    ------
    ValueError
        As :func:`surroundings`.

    Examples
    --------
    >>> boxes = sample_boxes((40, 20, 20, 40), (100, 100, 3), n_boxes=500, rng=np.random.default_rng(0))
    >>> boxes.min(axis=0).round(), boxes.max(axis=0).round()
    (array([35., 10., 20., 40.]), array([45., 30., 20., 40.]))
    """
    left, top, right, bottom = surroundings(box, shape, factor)
    _, _, w, h = np.asarray(box, dtype=float)
    free = np.maximum([right - left - w, bottom - top - h], 0.0)
    corners = [left, top] + rng.random((n_boxes, 2)) * free
    return np.hstack([corners, np.tile([w, h], (n_boxes, 1))])


def box_confidences(painted: np.ndarray, boxes, at_center: bool = False) -> np.ndarray:
    """How much boxes on a confidence map look like the target; the greatest is its detection (Li et al. 2016, 3.3).

    The paper calculates "confidence values of pixel points in the locations of each sampling image block center". To
    the letter that is one pixel, and all boxes whose centres share a superpixel tie; so the default is the sum over the
    box, as in Wang et al. (2011).

    Parameters
    ----------
    painted : ndarray, shape (H, W)
        From :func:`confidence_map`.
    boxes : array_like, shape (N, 4)
        ``(x, y, w, h)`` in pixels; pixels beyond the frame count as -1, as background does.
    at_center : bool
        Whether to follow the letter.

    Returns
    -------
    ndarray, shape (N,)
        Sums of confidences over the pixels of each box, or the confidence of the pixel at its centre.

    Examples
    --------
    >>> painted = np.full((6, 8), -1.0)
    >>> painted[2:4, 2:6] = 1.0
    >>> boxes = [[2, 2, 4, 2], [3, 2, 4, 2], [6, 2, 4, 2]]
    >>> box_confidences(painted, boxes), box_confidences(painted, boxes, at_center=True)
    (array([ 8.,  4., -8.]), array([ 1.,  1., -1.]))
    """
    height, width = painted.shape
    boxes = np.asarray(boxes, dtype=float)
    if at_center:
        x, y = np.floor(boxes[:, :2] + boxes[:, 2:] / 2).astype(int).T
        seen = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return np.where(seen, painted[y.clip(0, height - 1), x.clip(0, width - 1)], -1.0)
    edges = color.pixel_edges(boxes)
    left, top, right, bottom = edges.clip(0, [width, height, width, height]).T
    sums = cv2.integral(painted)
    seen = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    hidden = np.prod(edges[:, 2:] - edges[:, :2], axis=1) - (right - left) * (bottom - top)
    return seen - hidden
