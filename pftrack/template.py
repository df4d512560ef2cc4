r"""A second cue: a linear template that predicts how well a box fits its target.

Colours say *who* is in a rectangle, but hardly *where its edges are*. A grid of cells, each with its gradient
orientations and its mean colour, says where head, shoulders and legs are. Boxes drawn around the target, whose overlap
with it is known, teach a linear model to predict that overlap :math:`y` from the features :math:`\phi` of a box: ridge
regression,

.. math:: \beta = (A + \lambda I)^{-1} r, \qquad A = \mathbb{E}[\phi\,\phi^T], \quad r = \mathbb{E}[\phi\,y].

Only :math:`A` and :math:`r` need to be remembered, so the model is re-fitted cheaply on later frames, and a part of
what the first frame taught, the only one with a box that is known to be true, is never forgotten. Chapter 7 uses it.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from pftrack import kernels, metrics
from pftrack.kernels import N_ORIENTATIONS

GRID = 8, 4
"""Rows and columns of cells."""

MARGIN = 0.1, 0.04
"""Surroundings of the box that the grid takes in on each side, relative to its width and height."""

REACH = 6
"""Reduced pixels beyond a box that matter for it, through rounding, gradients and the mean gradient nearby."""

WIDTH = 24
"""Width of the target, in pixels, in the reduced image from which channels are taken."""


def reduced_channels(frame: np.ndarray, width: float) -> tuple[np.ndarray, int]:
    """Integral channels of a frame, reduced so that the target is about :data:`WIDTH` pixels wide.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.
    width : float
        Width of the target in the frame, in pixels.

    Returns
    -------
    integral : ndarray, shape (H // f + 1, W // f + 1, 9), int32
        From :func:`pftrack.kernels.channel_integral`.
    f : int
        Side, in pixels of the frame, of the squares that have become one pixel; at least 1.
    """
    f = _reduction(frame, width)
    return kernels.channel_integral(_reduced(frame, f)), f


def _reduction(frame: np.ndarray, width: float) -> int:
    height, width_of_frame = frame.shape[:2]
    return min(max(round(width / WIDTH), 1), height // 8, width_of_frame // 8) or 1


def _reduced(frame: np.ndarray, f: int) -> np.ndarray:
    """Average squares of `f` by `f` pixels; what is left over at the right and at the bottom is cut off."""
    height, width = frame.shape[0] // f, frame.shape[1] // f
    whole = frame[: height * f, : width * f]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA) if f > 1 else whole


class PartialChannels:
    """Integral channels as of :func:`reduced_channels`, made only of the part of a frame that boxes cover.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.
    width : float
        Width of the target in the frame, in pixels.

    Attributes
    ----------
    side : int
        Side, in pixels of the frame, of the squares that have become one pixel.

    Examples
    --------
    >>> frame = np.random.default_rng(0).integers(0, 256, (200, 300, 3), dtype=np.uint8)
    >>> whole, side = reduced_channels(frame, width=24)
    >>> part = PartialChannels(frame, width=24)
    >>> box = [[100, 50, 24, 60]]
    >>> part(box)[0].shape, bool((features(part, box) == features(whole, box)).all())
    ((73, 37, 9), True)
    """

    def __init__(self, frame: np.ndarray, width: float):
        self.frame, self.side = frame, _reduction(frame, width)
        self._edges, self._integral = None, None

    def __call__(self, boxes) -> tuple[np.ndarray, tuple[int, int]]:
        """Return an integral image that covers boxes ``(x, y, w, h)`` in reduced pixels, and where it begins."""
        boxes, f = np.asarray(boxes, dtype=float), self.side
        height, width = self.frame.shape[0] // f, self.frame.shape[1] // f
        low, high = boxes[:, :2].min(axis=0), (boxes[:, :2] + boxes[:, 2:]).max(axis=0)
        left, top = np.clip(np.floor(low).astype(int) - REACH, 0, [width - 1, height - 1]).tolist()
        right, bottom = np.clip(np.ceil(high).astype(int) + REACH, [left + 1, top + 1], [width, height]).tolist()
        made = self._edges
        if not made or left < made[0] or top < made[1] or right > made[2] or bottom > made[3]:
            self._edges = left, top, right, bottom
            part = self.frame[top * f : bottom * f, left * f : right * f]
            self._integral = kernels.channel_integral(_reduced(part, f))
        return self._integral, self._edges[:2]


def features(channels, boxes) -> np.ndarray:
    """Features of many boxes: what each cell of the grid shows.

    Parameters
    ----------
    channels : ndarray, shape (H + 1, W + 1, 9), or PartialChannels
        An integral image from :func:`pftrack.kernels.channel_integral`, or what makes one where the boxes are.
    boxes : array_like, shape (N, 4)
        Boxes ``(x, y, w, h)`` in pixels of that image.

    Returns
    -------
    ndarray, shape (N, 289)
        For each of 32 cells, six orientations (together of length 1) and three colours; and a constant.
    """
    boxes = np.asarray(boxes, dtype=float)
    margin = np.array(MARGIN) * boxes[:, 2:]
    around = np.concatenate([boxes[:, :2] - margin, boxes[:, 2:] + 2 * margin], axis=1)
    integral, origin = channels(around) if callable(channels) else (channels, (0, 0))
    cells = kernels.cell_means(integral, around, GRID, origin)
    orientations = cells[..., :N_ORIENTATIONS].reshape(len(boxes), -1)
    colors = cells[..., N_ORIENTATIONS:].reshape(len(boxes), -1)
    orientations /= np.linalg.norm(orientations, axis=1, keepdims=True) + 1e-6
    colors *= 2 / math.sqrt(math.prod(GRID)) / 255
    return np.concatenate([orientations, colors, np.full((len(boxes), 1), 0.5)], axis=1)


class RidgeTemplate:
    """Predict from the look of a box how much it overlaps the target.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of the boxes to learn from.
    ridge : float
        Penalty, relative to the mean of the diagonal of `A`; above 0.
    rate : float
        Share of a new frame in `A` and `r`, from 0 to 1.
    anchor : float
        Share of the first frame that is never forgotten, from 0 to 1.
    n_samples : int
        Boxes drawn around the target in a frame to learn from; five times as many in the first.

    Examples
    --------
    >>> from pftrack import datasets, kernels
    >>> scene = datasets.load("synthetic-walk")
    >>> integral, box = kernels.channel_integral(scene.frames[0]), scene.boxes[0]
    >>> template = RidgeTemplate(rng=np.random.default_rng(0))
    >>> template.learn(integral, box)
    >>> here, beside = template.predict(integral, [box, box + [box[2], 0, 0, 0]])
    >>> bool(here > 0.8), bool(beside < 0.3)
    (True, True)
    """

    def __init__(self, rng, ridge: float = 0.05, rate: float = 0.1, anchor: float = 0.3, n_samples: int = 60):
        self.rng, self.ridge, self.rate, self.anchor, self.n_samples = rng, ridge, rate, anchor, n_samples
        self.first = self.running = self.coefficients = None

    def learn(self, channels, box) -> None:
        """Learn from a frame in which the target's box is known, or believed to be."""
        if self.first is None:
            self.first = self.running = self._moments(channels, box, 5 * self.n_samples)
        else:
            new = self._moments(channels, box, self.n_samples)
            self.running = (1 - self.rate) * self.running + self.rate * new
        both = self.anchor * self.first + (1 - self.anchor) * self.running
        diagonal = np.arange(len(both))
        both[diagonal, diagonal] += self.ridge * self.first[diagonal, diagonal].mean()
        self.coefficients = np.linalg.solve(both[:, :-1], both[:, -1])

    def predict(self, channels, boxes) -> np.ndarray:
        """Predicted overlap of each of many boxes with the target, about 0 to 1."""
        return features(channels, boxes) @ self.coefficients

    def _moments(self, channels, box, n_samples) -> np.ndarray:
        """Means of the products of features with each other and, in the last column, with the overlap."""
        boxes = self._around(np.asarray(box, dtype=float), n_samples)
        look, y = features(channels, boxes), metrics.overlap(boxes, np.tile(box, (len(boxes), 1)))
        weights = np.ones(len(y))
        weights[0] = 4  # the box itself counts as four
        weighted = look * (weights / weights.sum())[:, None]
        return weighted.T @ np.column_stack([look, y])

    def _around(self, box, n) -> np.ndarray:
        """Draw the box itself and `n` others: half close to it, half anywhere within two widths."""
        close = n // 2
        shift = np.concatenate(
            [self.rng.standard_normal((close, 2)) * (0.25, 0.12), self.rng.uniform(-1, 1, (n - close, 2)) * (2.0, 0.6)]
        )
        scale = np.exp(self.rng.standard_normal((n, 1)) * np.repeat([0.12, 0.2], [close, n - close])[:, None])
        sizes = box[2:] * scale
        centers = box[:2] + box[2:] / 2 + shift * box[2:]
        return np.concatenate([box[None], np.concatenate([centers - sizes / 2, sizes], axis=1)])
