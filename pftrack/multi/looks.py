r"""What targets look like, and how much a box looks like one, where somebody may stand in front.

A target's looks are histograms of its colours and of its patterns (Li et al. 2016, section 4.2.1), two features that
make up for each other: colour tells a red coat from a blue one in any posture, texture a striped shirt from a plain
one in any light. Three things are added; what the last two are worth is in
``results/association-ablation.csv``, and on the films there it is little:

- *bands*. A box is divided into bands of equal height, for one histogram cannot tell a white shirt over black
  trousers from the reverse;
- *what is covered does not count*. Pixels that a nearer person covers are in no histogram, and a band counts for as
  much as can be seen of it;
- *the target's own colours count more*. By eq. 1 of the paper a colour that is seen inside the box as often as beside
  it says nothing. There it weighs clusters of superpixels, here the bins :math:`u` of the histograms :math:`q` inside
  and :math:`r` beside the box:

.. math::

    v_u = \tfrac{1}{2} \left(1 + \max\left(\frac{q_u - r_u}{q_u + r_u}, 0\right)\right), \qquad
    \rho = \frac{\sum_u v_u \sqrt{p_u q_u}}{\sum_u v_u q_u}.

Without :math:`v` this is the Bhattacharyya coefficient of the histograms :math:`p` of a box and :math:`q` of the
target.
"""

from __future__ import annotations

import cv2
import numpy as np

from pftrack import color, kernels, texture

FEATURES = ("color", "pattern")
"""The two features, in the order in which everything here has them."""

COVERED = (color.N_BINS - 1, texture.N_PATTERNS)
"""Bin of a pixel that is covered. No pattern has that number, and the last of the colours, the most saturated and
brightest of its hue, gives its own to the next darker one."""

MIDDLE = 0.6
"""Share of a box's width that is looked at, for people do not fill their boxes."""

BODY = (0.76, 0.95)
"""Share of a box's width and height, from the feet, that hides what is behind it."""

LEAST = 0.1
"""Share of a band that must be seen for it to count."""


class Picture:
    """A frame as it is compared with targets: the histogram bin of every pixel, and which are covered.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.

    Attributes
    ----------
    bins : tuple of ndarray, shape (H, W), uint8
        Bins of colour, :func:`pftrack.color.hsv_bins`, and of patterns, :func:`pftrack.texture.pattern_bins`; of
        covered pixels, :data:`COVERED`.
    """

    def __init__(self, frame: np.ndarray):
        self.bins = np.minimum(color.hsv_bins(frame), COVERED[0] - 1), texture.pattern_bins(frame)
        self._open = np.ones(frame.shape[:2], dtype=np.uint8)

    def cover(self, box) -> None:
        """Mark what a person in a box hides.

        Parameters
        ----------
        box : array_like, shape (4,)
            ``(x, y, w, h)`` in pixels.
        """
        x, y, w, h = box
        wide, high = BODY
        ((left, top, right, bottom),) = color.pixel_edges(
            [[x + (1 - wide) / 2 * w, y + (1 - high) * h, wide * w, high * h]]
        ).clip(0)
        for picture, value in zip((*self.bins, self._open), (*COVERED, 0), strict=True):
            picture[top:bottom, left:right] = value

    def shares_seen(self, edges) -> np.ndarray:
        """Tell how much of each of many rectangles is in the frame and not covered.

        Parameters
        ----------
        edges : ndarray of int, shape (M, 4)
            ``(left, top, right, bottom)``, right and bottom exclusive.

        Returns
        -------
        ndarray, shape (M,)
            From 0 to 1.

        Examples
        --------
        >>> picture = Picture(np.zeros((40, 40, 3), dtype=np.uint8))
        >>> picture.cover([0, 0, 10, 40])
        >>> picture.shares_seen(np.array([[0, 10, 18, 20], [30, 10, 50, 20]])).round(2)
        array([0.56, 0.5 ])
        """
        height, width = self._open.shape
        left, top, right, bottom = kernels.cover(edges, height, width)
        part = self._open[top:bottom, left:right]
        if part.size == 0:
            return np.zeros(len(edges))
        sums = cv2.integral(part)
        x0, y0, x1, y1 = (edges - [left, top, left, top]).clip(0, [right - left, bottom - top] * 2).T
        seen = sums[y1, x1] - sums[y0, x1] - sums[y1, x0] + sums[y0, x0]
        return seen / np.maximum(np.prod(edges[:, 2:] - edges[:, :2], axis=1), 1)

    def histograms(self, edges) -> np.ndarray:
        """Histograms of what is seen of rectangles.

        Parameters
        ----------
        edges : ndarray of int, shape (M, 4)
            ``(left, top, right, bottom)``, right and bottom exclusive.

        Returns
        -------
        ndarray, shape (2, M, 256)
            Of colour and of patterns, normalised; all zeros where nothing is seen.
        """
        height, width = self._open.shape
        inside = edges.clip(0, [width, height] * 2).tolist()
        found = np.zeros((len(FEATURES), len(edges), 256))
        for counts, bins, covered in zip(found, self.bins, COVERED, strict=True):
            for n, (left, top, right, bottom) in enumerate(inside):
                counts[n] = np.bincount(bins[top:bottom, left:right].ravel(), minlength=256)
            counts[:, covered] = 0
        return found / np.maximum(found.sum(axis=2, keepdims=True), 1)


def bands(boxes, n_bands: int, middle: float = MIDDLE) -> np.ndarray:
    """Divide boxes into bands of equal height.

    Parameters
    ----------
    boxes : array_like, shape (M, 4)
        ``(x, y, w, h)`` in pixels.
    n_bands : int
        Number of bands, at least 1.
    middle : float
        Share of the width to take, about the middle.

    Returns
    -------
    ndarray of int, shape (M * n_bands, 4)
        Edges of the bands of the first box from the top, then of the next, as :func:`pftrack.color.pixel_edges` has
        them.

    Examples
    --------
    >>> bands([[10, 20, 10, 30]], n_bands=2, middle=0.6)
    array([[12, 20, 18, 35],
           [12, 35, 18, 50]])
    """
    x, y, w, h = np.asarray(boxes, dtype=float).T[:, :, None]
    tops = y + h * np.arange(n_bands) / n_bands
    each = np.broadcast_arrays(x + (1 - middle) / 2 * w, tops, middle * w, h / n_bands)
    return color.pixel_edges(np.stack(each, axis=-1).reshape(-1, 4))


class Looks:
    """The looks of one target.

    Parameters
    ----------
    picture : Picture
        A frame in which the target is seen.
    box : array_like, shape (4,)
        Where, ``(x, y, w, h)`` in pixels.
    n_bands : int
        Number of bands.
    surroundings : bool
        Whether bins count for as much as they are the target's; all count alike if not.

    Examples
    --------
    A red person on a grey wall, and how much the wall, half of each, and the person look like one:

    >>> frame = np.full((80, 120, 3), 128, dtype=np.uint8)
    >>> frame[10:70, 40:60] = (0, 0, 200)
    >>> picture = Picture(frame)
    >>> looks = Looks(picture, [40, 10, 20, 60])
    >>> similarity, seen = looks.similarities(picture, [[80, 10, 20, 60], [50, 10, 20, 60], [40, 10, 20, 60]])
    >>> similarity[0].round(2), seen
    (array([0.  , 0.71, 1.  ]), array([1., 1., 1.]))
    """

    def __init__(self, picture: Picture, box, n_bands: int = 3, surroundings: bool = True):
        self.n_bands, self.surroundings = n_bands, surroundings
        self._inside, self._beside = self._measure(picture, box)
        self._weigh_bins()

    def _measure(self, picture: Picture, box) -> tuple[np.ndarray, np.ndarray]:
        """Return the histograms of the bands, and of what is beside each, as wide on both sides together."""
        x, y, w, h = box
        inside = picture.histograms(bands([box], self.n_bands))
        if not self.surroundings:
            return inside, np.zeros_like(inside)
        half = MIDDLE * w / 2
        sides = [[x + w / 2 - 2 * half, y, half, h], [x + w / 2 + half, y, half, h]]
        beside = picture.histograms(bands(sides, self.n_bands, middle=1.0))
        return inside, beside.reshape(len(FEATURES), 2, self.n_bands, 256).mean(axis=1)

    def _weigh_bins(self) -> None:
        balance = (self._inside - self._beside) / np.maximum(self._inside + self._beside, 1e-9)
        worth = (1 + np.maximum(balance, 0)) / 2
        self._perfect = np.maximum((worth * self._inside).sum(axis=2), 1e-9)
        self._palettes = [kernels.palette(each) for each in worth**2 * self._inside]

    def similarities(self, picture: Picture, boxes) -> tuple[np.ndarray, np.ndarray]:
        r"""Tell how much what is seen of many boxes looks like the target.

        Parameters
        ----------
        picture : Picture
            The frame.
        boxes : array_like, shape (M, 4)
            ``(x, y, w, h)`` in pixels.

        Returns
        -------
        similarities : ndarray, shape (2, M)
            The mean of :math:`\rho` over the bands, from 0 to 1, for colour and for patterns.
        seen : ndarray, shape (M,)
            Share of each box that is seen, from 0 to 1.
        """
        edges = bands(boxes, self.n_bands)
        seen = picture.shares_seen(edges)
        raw = [kernels.similarities(*each) for each in zip(picture.bins, [edges] * 2, self._palettes, strict=True)]
        of_bands = np.reshape(raw / np.sqrt(np.maximum(seen, 1e-9)), (len(FEATURES), -1, self.n_bands))
        counted = np.where(seen < LEAST, 0, seen).reshape(-1, self.n_bands)
        alike = np.minimum(of_bands / self._perfect[:, None], 1)
        total = counted.sum(axis=1)
        return (alike * counted).sum(axis=2) / np.maximum(total, 1e-9), total / self.n_bands

    def learn(self, picture: Picture, box, rate: float) -> None:
        """Follow the target's looks.

        Parameters
        ----------
        picture : Picture
            A frame in which the target is seen.
        box : array_like, shape (4,)
            Where, ``(x, y, w, h)`` in pixels.
        rate : float
            Share of the new in the histograms, from 0 to 1.
        """
        inside, beside = self._measure(picture, box)
        self._inside += rate * (inside - self._inside)
        self._beside += rate * (beside - self._beside)
        self._weigh_bins()
