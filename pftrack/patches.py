r"""Patches of a region: where they are, how large, and what each looks like (Li et al. 2012, section 3.2.1).

A tracker that describes a target by its patches needs them for hundreds of candidate rectangles in every frame. The
paper cuts every candidate into superpixels by itself. Here the region that all candidates of a target share is cut
once, and a candidate has as much of a patch as it covers: with the patch taken as the rectangle of its extents, that is

.. math:: c = \frac{|[x_0, x_1] \cap [p_0, p_1]|}{p_1 - p_0} \cdot \frac{|[y_0, y_1] \cap [q_0, q_1]|}{q_1 - q_0} ,

exact for the square patches of texture, and near for superpixels, which are compact. Chapter 10 uses it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pftrack import color, superpixels, texture

REDUCED_HEIGHT = 80
"""Height in pixels to which larger targets are reduced, so that a patch is always about the same share of a person."""

PATCH = 12
"""Side of a patch of texture in pixels of the reduced picture, as in Bag of Features Tracking (Yang et al. 2010)."""

STEP = 4
"""Distance between the patches of texture from which some are drawn at random."""


@dataclass(frozen=True)
class Patches:
    """Patches of one kind in one region of a frame.

    Attributes
    ----------
    features : ndarray, shape (S, d)
        Normalised histogram of each.
    edges : ndarray, shape (S, 4)
        ``(left, top, right, bottom)`` of their extents, in pixels of the frame.
    areas : ndarray, shape (S,)
        How much each counts: the number of its pixels, in pixels of the frame.
    """

    features: np.ndarray
    edges: np.ndarray
    areas: np.ndarray

    def __len__(self) -> int:
        return len(self.features)


def describe(
    frame: np.ndarray, region, height: float, n_superpixels: int, n_patches: int, rng: np.random.Generator
) -> tuple[Patches, Patches]:
    """Cut a region of a frame into superpixels, and draw square patches of texture from it.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A frame.
    region : tuple of int
        ``(left, top, right, bottom)`` inside the frame, right and bottom exclusive.
    height : float
        Height of the target in pixels; if it is more than 80, the region is reduced accordingly first.
    n_superpixels : int
        About how many superpixels the surroundings of the target (:func:`pftrack.superpixels.surroundings`) would have
        if its width were 0.4 of its height. A larger region has more.
    n_patches : int
        Most patches of texture.
    rng : numpy.random.Generator
        Source of randomness for the places of the patches of texture.

    Returns
    -------
    of_color : Patches
        Superpixels with histograms of 256 HSV bins.
    of_texture : Patches
        Patches with histograms of 59 local binary patterns; none where the region is smaller than a patch.

    Examples
    --------
    >>> frame = np.zeros((100, 100, 3), dtype=np.uint8)
    >>> frame[:, 50:] = 255
    >>> of_color, of_texture = describe(frame, (10, 10, 90, 90), 80, 20, 50, np.random.default_rng(0))
    >>> of_color.features.shape[1], of_texture.features.shape
    (256, (50, 59))
    >>> print(round(of_color.areas.sum()))
    6400
    """
    left, top, right, bottom = region
    part = frame[top:bottom, left:right]
    reduction = min(1.0, REDUCED_HEIGHT / height)
    if reduction < 1:
        size = [max(round(reduction * side), 2) for side in (right - left, bottom - top)]
        part = cv2.resize(part, size, interpolation=cv2.INTER_AREA)
    factor = np.array([part.shape[1] / (right - left), part.shape[0] / (bottom - top)] * 2)
    origin = np.array([left, top] * 2)
    usual = 0.4 * (superpixels.FACTOR * height * reduction) ** 2
    n_segments = max(round(n_superpixels * part.shape[0] * part.shape[1] / usual), 1)
    labels = superpixels.segment(part, n_segments, n_steps=4)
    areas, edges = _extents(labels)
    of_color = Patches(
        superpixels.histograms(color.hsv_bins(part), labels), edges / factor + origin, areas / factor[:2].prod()
    )
    grid = texture.patch_histograms(texture.pattern_bins(part), PATCH, STEP)
    n_on_grid = grid.shape[0] * grid.shape[1]
    drawn = rng.permutation(n_on_grid)[:n_patches]
    rows, columns = np.divmod(drawn, max(grid.shape[1], 1))
    corners = np.column_stack([columns, rows]) * STEP
    edges = np.hstack([corners, corners + PATCH]) / factor + origin
    areas = np.full(len(drawn), PATCH**2 / factor[:2].prod())
    return of_color, Patches(grid.reshape(-1, texture.N_PATTERNS)[drawn], edges, areas)


def _extents(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return areas of labelled regions, and the rectangles of the same mean and variance as their pixels."""
    height, width = labels.shape
    areas = np.bincount(labels.ravel())
    half = []
    mean = []
    for axis in (np.arange(width)[None] + 0.5, np.arange(height)[:, None] + 0.5):
        place = np.broadcast_to(axis, labels.shape).ravel()
        first = np.bincount(labels.ravel(), place) / areas
        second = np.bincount(labels.ravel(), place**2) / areas
        mean.append(first)
        half.append(np.sqrt(3 * (np.maximum(second - first**2, 0) + 1 / 12)))  # a side a has variance a^2 / 12
    mean, half = np.column_stack(mean), np.column_stack(half)
    return areas, np.hstack([mean - half, mean + half])


def coverage(boxes, edges, n_bands: int = 1) -> np.ndarray:
    """Share of each patch that each horizontal band of each box covers.

    Parameters
    ----------
    boxes : array_like, shape (N, 4)
        ``(x, y, w, h)`` in pixels.
    edges : array_like, shape (S, 4)
        ``(left, top, right, bottom)`` of the patches.
    n_bands : int
        Into how many bands of equal height the boxes are divided.

    Returns
    -------
    ndarray, shape (N, n_bands, S), float32
        From 0 (not covered) to 1 (wholly).

    Examples
    --------
    >>> coverage([[0, 0, 10, 20]], [[5, 0, 15, 20]], n_bands=2)
    array([[[0.25],
            [0.25]]], dtype=float32)
    """
    boxes, edges = np.asarray(boxes, dtype=np.float32), np.asarray(edges, dtype=np.float32).reshape(-1, 4)
    left, top, right, bottom = edges.T
    x, y, w, h = boxes.T[..., None]
    across = (np.minimum(x + w, right) - np.maximum(x, left)).clip(0) / (right - left)
    ends = y + h * np.linspace(0, 1, n_bands + 1, dtype=np.float32)
    passed = ((ends[..., None] - top) / (bottom - top)).clip(0, 1)  # share of each patch above each end
    return across[:, None] * np.diff(passed, axis=1)
