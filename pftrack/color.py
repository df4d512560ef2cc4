r"""What a target looks like: colour histograms, the distance between them, and back-projection.

Owczarek et al. 2015 describe a pedestrian by the histogram of the HSV colours inside a rectangle, with 8 levels of
hue, 8 of saturation and 4 of value: 256 bins, so that the bin of a pixel fits in one byte. Two histograms are compared
by the Hellinger distance (eq. 11), and the distance becomes a likelihood (eq. 13). CAMSHIFT reads the same kind of
histogram backwards: the *back-projection* gives every pixel of a frame the height of its bin. Chapter 3 builds all of
this; chapters 4 and 5 track with it.

Frames are ``(H, W, 3)`` uint8 in OpenCV's BGR order, and OpenCV's 8-bit hue runs from 0 to 179.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from pftrack import kernels

HSV_BINS = (8, 8, 4)
"""Levels of hue, saturation and value."""

N_BINS = math.prod(HSV_BINS)
"""Number of histogram bins, 256."""


def hsv_bins(frame: np.ndarray) -> np.ndarray:
    """Histogram bin of every pixel of a frame (Owczarek et al. 2015, section III-B).

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.

    Returns
    -------
    ndarray, shape (H, W), uint8
        The index of the pixel's bin, ``32 * hue_level + 4 * saturation_level + value_level``, from 0 to 255.

    Examples
    --------
    Pure blue has OpenCV hue 120 (level 5 of 0 to 7) and the highest saturation and value:

    >>> hsv_bins(np.full((1, 1, 3), (255, 0, 0), dtype=np.uint8))
    array([[191]], dtype=uint8)
    >>> 32 * 5 + 4 * 7 + 3
    191
    """
    if frame.size == 0:
        return np.zeros(frame.shape[:2], dtype=np.uint8)
    in_one_row = np.ascontiguousarray(frame).reshape(1, -1, 3)  # OpenCV is slow on short rows
    return kernels.bin_image(cv2.cvtColor(in_one_row, cv2.COLOR_BGR2HSV)).reshape(frame.shape[:2])


def pixel_edges(boxes) -> np.ndarray:
    """Whole-pixel edges of boxes: which pixels a rectangle covers.

    Parameters
    ----------
    boxes : array_like, shape (N, 4)
        Boxes ``(x, y, w, h)`` in pixels, not NaN.

    Returns
    -------
    ndarray of int, shape (N, 4)
        ``(left, top, right, bottom)``: each edge rounded to the nearest whole pixel, right and bottom exclusive.
        Edges may lie outside the image.

    Examples
    --------
    >>> pixel_edges([[10.4, 20.6, 5.0, 5.0]])
    array([[10, 21, 15, 26]])
    """
    edges = np.array(boxes, dtype=float)
    edges[:, 2:] += edges[:, :2]
    return np.floor(edges + 0.5).astype(int)  # np.rint rounds halves to even: a box would change its width as it moves


def histograms(frame: np.ndarray, boxes, outside: str = "mismatch") -> np.ndarray:
    """Normalised HSV histogram of each of many rectangles in one frame.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order; or its bin image from :func:`hsv_bins`, shape (H, W), to save computing it again.
    boxes : array_like, shape (N, 4)
        Rectangles ``(x, y, w, h)`` in pixels; they may reach over the image border.
    outside : {"mismatch", "ignore"}
        What becomes of pixels beyond the border, which the paper leaves open. ``"ignore"`` divides the counts by the
        number of visible pixels, so a histogram always sums to one; ``"mismatch"`` divides by the full area, so that
        the part outside counts as a colour the target does not have.

    Returns
    -------
    ndarray, shape (N, 256)
        Shares of the pixels in each bin. A rectangle with no visible pixel has all zeros.

    Raises
    ------
    ValueError
        If `outside` is not one of the two words.

    Examples
    --------
    >>> frame = np.full((10, 10, 3), (255, 0, 0), dtype=np.uint8)
    >>> inside, half_out = histograms(frame, [[0, 0, 4, 4], [8, 0, 4, 4]])[:, 191]
    >>> print(inside, half_out)
    1.0 0.5
    """
    if outside not in ("mismatch", "ignore"):
        raise ValueError(f'outside must be "mismatch" or "ignore", got {outside!r}')
    edges = pixel_edges(boxes)
    bins, (x0, y0) = covered_bins(frame, edges)
    height, width = bins.shape
    visible = np.clip(edges - [x0, y0, x0, y0], 0, [width, height, width, height])
    counted = edges if outside == "mismatch" else visible
    areas = np.maximum(np.prod(counted[:, 2:] - counted[:, :2], axis=1), 1)
    counts = np.zeros((len(edges), N_BINS))
    for n, (left, top, right, bottom) in enumerate(visible.tolist()):
        if right > left and bottom > top:
            counts[n] = cv2.calcHist([bins[top:bottom, left:right]], [0], None, [N_BINS], [0, N_BINS])[:, 0]
    return counts / areas[:, None]


def covered_bins(frame: np.ndarray, edges) -> tuple[np.ndarray, tuple[int, int]]:
    """Bin image of only that part of a frame which some rectangle covers.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order; or its bin image from :func:`hsv_bins`, shape (H, W), which is returned whole.
    edges : array_like of int, shape (N, 4)
        ``(left, top, right, bottom)`` of the rectangles, from :func:`pixel_edges`.

    Returns
    -------
    bins : ndarray, shape (h, w), uint8
        The bins of the part, one pixel wider on all sides; empty if no rectangle shows a pixel.
    origin : tuple of int
        Position ``(x, y)`` of its first pixel in the frame.

    Examples
    --------
    >>> bins, origin = covered_bins(np.zeros((60, 80, 3), dtype=np.uint8), [[10, 10, 20, 30], [15, 20, 22, 40]])
    >>> bins.shape, origin
    ((32, 14), (9, 9))
    """
    if frame.ndim == 2:
        return frame, (0, 0)
    left, top, right, bottom = kernels.cover(edges, *frame.shape[:2])
    return hsv_bins(frame[top:bottom, left:right]), (left, top)


def bhattacharyya(p, q) -> np.ndarray:
    r"""Bhattacharyya coefficient :math:`\rho = \sum_u \sqrt{p(u)\,q(u)}` of normalised histograms.

    Parameters
    ----------
    p, q : array_like, shape (..., M)
        Histograms that sum to one (or to less, where part of the mass is missing); the last axes are compared.

    Returns
    -------
    ndarray, shape (...)
        Similarity from 0 (no bin in common) to 1 (identical).

    Examples
    --------
    >>> print(bhattacharyya([0.5, 0.5], [0.5, 0.5]), bhattacharyya([1.0, 0.0], [0.0, 1.0]))
    1.0 0.0
    """
    return np.minimum(np.einsum("...u,...u->...", np.sqrt(p), np.sqrt(q)), 1.0)


def hellinger(p, q) -> np.ndarray:
    r"""Hellinger distance between histograms of counts or shares (Owczarek et al. 2015, eq. 11, corrected).

    .. math:: d = \sqrt{1 - \frac{1}{M\sqrt{\bar p\,\bar q}} \sum_{u=1}^{M} \sqrt{p(u)\,q(u)}},
              \qquad \bar p = \frac{1}{M}\sum_u p(u)

    The paper prints the sum without the inner square root; then identical histograms would not be at distance 0 (see
    the errata). With it, this is what OpenCV calls ``HISTCMP_BHATTACHARYYA``.

    Parameters
    ----------
    p, q : array_like, shape (..., M)
        Histograms with positive sums; they need not be normalised.

    Returns
    -------
    ndarray, shape (...)
        Distance from 0 (same shares) to 1 (no bin in common).

    Examples
    --------
    >>> print(hellinger([1, 1], [5, 5]), hellinger([1, 0], [0, 1]), round(float(hellinger([1, 0], [1, 1])), 4))
    0.0 1.0 0.5412
    """
    p, q = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    rho = bhattacharyya(p / p.sum(axis=-1, keepdims=True), q / q.sum(axis=-1, keepdims=True))
    return np.sqrt(1.0 - rho)


def distances(frame: np.ndarray, boxes, target: np.ndarray, outside: str = "mismatch") -> np.ndarray:
    """Hellinger distance of the colours in each of many rectangles to those of the target (eq. 11).

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order; or its bin image from :func:`hsv_bins`, shape (H, W).
    boxes : array_like, shape (N, 4)
        Rectangles ``(x, y, w, h)`` in pixels.
    target : ndarray, shape (256,)
        The target's normalised histogram.
    outside : {"mismatch", "ignore"}
        What pixels beyond the border count as; see :func:`histograms`.

    Returns
    -------
    ndarray, shape (N,)
        Distances from 0 (a perfect match) to 1 (nothing in common, or nothing visible).

    Examples
    --------
    >>> frame = np.zeros((10, 10, 3), dtype=np.uint8)
    >>> frame[:, :5] = (255, 0, 0)
    >>> target = histograms(frame, [[0, 0, 5, 10]])[0]
    >>> print(distances(frame, [[0, 0, 5, 10], [5, 0, 5, 10]], target))
    [0. 1.]
    """
    edges = pixel_edges(boxes)
    bins, origin = covered_bins(frame, edges)
    return np.sqrt(1.0 - kernels.similarities(bins, edges, target, outside, origin))


def log_likelihood(frame: np.ndarray, boxes, target: np.ndarray, sigma: float, outside: str = "mismatch") -> np.ndarray:
    r"""Log-likelihood of each of many rectangles in a frame (Owczarek et al. 2015, eq. 13).

    .. math:: \log p(z_t \mid s_t^{(n)}) = -\frac{(d_t^{(n)})^2}{2\sigma^2} - \log(\sigma\sqrt{2\pi})

    Chapter 5 weighs its particles with it; its tracker does the same in :func:`pftrack.kernels.observe`.

    Parameters
    ----------
    frame, boxes, target, outside
        As for :func:`distances`.
    sigma : float
        Standard deviation of the distance, above 0; smaller is pickier. The paper does not print its value.

    Returns
    -------
    ndarray, shape (N,)
        Natural logarithms of the likelihoods.

    Raises
    ------
    ValueError
        If `sigma` is not positive.

    Examples
    --------
    >>> frame = np.zeros((10, 10, 3), dtype=np.uint8)
    >>> target = histograms(frame, [[0, 0, 5, 10]])[0]
    >>> print(log_likelihood(frame, [[2, 0, 5, 10]], target, sigma=0.1).round(3))
    [1.384]
    """
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    return -(distances(frame, boxes, target, outside) ** 2) / (2 * sigma**2) - math.log(sigma * math.sqrt(2 * math.pi))


def masked_histogram(
    frame: np.ndarray,
    box,
    saturation: tuple[int, int] = (60, 255),
    value: tuple[int, int] = (32, 255),
    n_hues: int = 16,
) -> np.ndarray:
    """Hue histogram of those pixels of a box whose saturation and value lie in given intervals.

    Pale and dark pixels have a meaningless hue; the mask leaves them out. This is the model of OpenCV's CAMSHIFT
    sample, with the sample's values as defaults.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.
    box : array_like, shape (4,)
        ``(x, y, w, h)`` in pixels.
    saturation, value : tuple of int
        Lowest and highest admitted level, both inclusive, from 0 to 255.
    n_hues : int
        Number of hue bins over OpenCV's 180 hues.

    Returns
    -------
    ndarray, shape (n_hues, 1), float32
        The histogram, stretched so that its lowest bin is 0 and its highest 255; all zeros if the mask admits no pixel
        or nothing of the box is visible.

    Examples
    --------
    >>> blue = np.full((8, 8, 3), (255, 0, 0), dtype=np.uint8)
    >>> int(masked_histogram(blue, (0, 0, 4, 4)).argmax())
    10
    """
    height, width = frame.shape[:2]
    left, top, right, bottom = np.clip(pixel_edges([box])[0], 0, [width, height, width, height])
    if right <= left or bottom <= top:
        return np.zeros((n_hues, 1), dtype=np.float32)
    hsv = cv2.cvtColor(frame[top:bottom, left:right], cv2.COLOR_BGR2HSV)
    mask = cv2.inRange(hsv, (0, saturation[0], value[0]), (180, saturation[1], value[1]))
    histogram = cv2.calcHist([hsv], [0], mask, [n_hues], [0, 180])
    return cv2.normalize(histogram, None, 0, 255, cv2.NORM_MINMAX) if histogram.any() else histogram


def back_projection(
    frame: np.ndarray,
    histogram: np.ndarray,
    saturation: tuple[int, int] = (60, 255),
    value: tuple[int, int] = (32, 255),
) -> np.ndarray:
    """Height of every pixel's hue bin: an image of how target-like each pixel is.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.
    histogram : ndarray, shape (n_hues, 1), float32
        From :func:`masked_histogram`.
    saturation, value : tuple of int
        The mask, as there; pixels outside it get 0.

    Returns
    -------
    ndarray, shape (H, W), uint8
        0 (not a colour of the target) to 255 (its commonest colour).

    Examples
    --------
    >>> frame = np.zeros((4, 8, 3), dtype=np.uint8)
    >>> frame[:, :4] = (255, 0, 0)
    >>> back_projection(frame, masked_histogram(frame, (0, 0, 4, 4)))[0]
    array([255, 255, 255, 255,   0,   0,   0,   0], dtype=uint8)
    """
    hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
    probability = cv2.calcBackProject([hsv], [0], histogram, [0, 180], 1)
    return probability & cv2.inRange(hsv, (0, saturation[0], value[0]), (180, saturation[1], value[1]))
