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


def surroundings(box, shape, factor: float = FACTOR) -> tuple[int, int, int, int]:
    """Part of a frame around a box (Li et al. 2016, the region R2).

    Parameters
    ----------
    box : array_like, shape (4,)
        ``(x, y, w, h)`` in pixels.
    shape : tuple of int
        Shape of the frame, ``(H, W, ...)``.
    factor : float
        Its sides relative to those of the box, at least 1.

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
    """
    if not factor >= 1:
        raise ValueError(f"factor must be at least 1, got {factor}")
    x, y, w, h = np.asarray(box, dtype=float)
    wider, higher = (factor - 1) * w / 2, (factor - 1) * h / 2
    ((left, top, right, bottom),) = color.pixel_edges([[x - wider, y - higher, factor * w, factor * h]]).tolist()
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
    features, inside, outside = [], [], []
    for frame, box in zip(frames, boxes, strict=True):
        left, top, right, bottom = surroundings(box, frame.shape)
        part = frame[top:bottom, left:right]
        labels = segment(part, n_segments, compactness)
        features.append(histograms(color.hsv_bins(part), labels))
        ((x0, y0, x1, y1),) = np.maximum(color.pixel_edges([box]) - [left, top, left, top], 0).tolist()
        of_target = np.bincount(labels[y0:y1, x0:x1].ravel(), minlength=len(features[-1]))
        inside.append(of_target)
        outside.append(np.bincount(labels.ravel()) - of_target)
    features, inside, outside = (np.concatenate(parts) for parts in (features, inside, outside))
    centers = codebook.mean_shift(features, bandwidth)
    cluster = codebook.nearest_words(features, centers)
    occupied, cluster = np.unique(cluster, return_inverse=True)  # a mode may be the nearest to none
    centers = centers[occupied]
    distances = np.linalg.norm(features - centers[cluster], axis=1)
    radii = np.zeros(len(centers))
    np.maximum.at(radii, cluster, distances)
    radii[radii < 1e-9] = bandwidth
    target, background = np.bincount(cluster, inside), np.bincount(cluster, outside)
    return PriorKnowledge(centers, radii, (target - background) / (target + background))


def confidences(features, prior: PriorKnowledge, spread: float = 2.0) -> np.ndarray:
    """How much superpixels belong to the target (Li et al. 2016, eq. 2).

    Parameters
    ----------
    features : array_like, shape (S, 256)
        From :func:`histograms`.
    prior : PriorKnowledge
        From :func:`learn`.
    spread : float
        The factor lambda of eq. 2, not negative; the paper's is 2.

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
    cluster = squares.argmin(axis=1)
    distances = np.sqrt(squares.min(axis=1))
    return np.exp(-spread * distances / prior.radii[cluster]) * prior.confidences[cluster]


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
    left, top, right, bottom = surroundings(box, frame.shape)
    part = frame[top:bottom, left:right]
    labels = segment(part, n_segments, compactness)
    painted = np.full(frame.shape[:2], -1.0)
    of_superpixels = confidences(histograms(color.hsv_bins(part), labels), prior, spread)
    painted[top:bottom, left:right] = of_superpixels[labels]
    return painted


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
