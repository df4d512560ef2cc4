r"""What a target feels like: local binary patterns.

Colour says nothing about a grey coat; the grain of the cloth still does. A local binary pattern (Ojala et al. 2002)
describes the surroundings of a pixel by which of its neighbours on a ring are at least as bright:

.. math:: \mathrm{LBP} = \sum_{p=0}^{7} [g_p \ge g_c]\, 2^p

A change of illumination that keeps the order of the grey levels changes nothing. Most patterns in natural images are
*uniform*: on the way round the ring, brighter and darker change at most twice. Each of these 58 has a label of its own,
and all others share the last. Li et al. 2012 and 2016 put histograms of them beside those of colour.

The ring here is that of the eight nearest pixels. Other variants, as scikit-image's, interpolate on a circle.
"""

from __future__ import annotations

import cv2
import numpy as np

from pftrack import kernels

N_PATTERNS = 59
"""Number of labels, of 58 uniform patterns and of all the others together."""


def _uniform_labels() -> np.ndarray:
    """Label of each of the 256 codes, in the order of the codes."""
    codes = np.arange(256)
    bits = codes[:, None] >> np.arange(8) & 1
    uniform = (bits != np.roll(bits, 1, axis=1)).sum(axis=1) <= 2
    return np.where(uniform, np.cumsum(uniform) - 1, N_PATTERNS - 1).astype(np.uint8)


_UNIFORM_LABELS = _uniform_labels()


def pattern_bins(frame: np.ndarray) -> np.ndarray:
    """Uniform local binary pattern of every pixel.

    A drop-in for :func:`pftrack.color.hsv_bins`: :func:`pftrack.kernels.similarities` takes either.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3) or (H, W), uint8
        A colour image in BGR order, or a grey one.

    Returns
    -------
    ndarray, shape (H, W), uint8
        Labels from 0 to 58; 58 is that of all patterns that are not uniform. A flat pixel has label 57.

    Raises
    ------
    ValueError
        If the image has another shape or dtype.

    Examples
    --------
    A step from dark to bright; what matters is the order of the levels, not their distance:

    >>> step = np.repeat(np.uint8([[10, 10, 90, 90]]), 3, axis=0)
    >>> pattern_bins(step)[1], pattern_bins(step // 5 + 40)[1]
    (array([57, 57, 39, 57], dtype=uint8), array([57, 57, 39, 57], dtype=uint8))
    """
    if frame.ndim == 3 and frame.shape[2] == 3 and frame.size:
        frame = cv2.cvtColor(np.ascontiguousarray(frame), cv2.COLOR_BGR2GRAY)
    return kernels.ring_image(frame, _UNIFORM_LABELS)


def patch_histograms(patterns: np.ndarray, size: int = 12, step: int = 4) -> np.ndarray:
    """Normalised histogram of the patterns in every square patch on a grid.

    Parameters
    ----------
    patterns : ndarray, shape (H, W), uint8
        From :func:`pattern_bins`.
    size : int
        Side of a patch in pixels, a multiple of `step`. 12 is that of Bag of Features Tracking (Yang et al. 2010).
    step : int
        Distance from one patch to the next in pixels, at least 1.

    Returns
    -------
    ndarray, shape (R, C, 59)
        Shares of the pixels with each label. Patch ``[r, c]`` has its top left pixel at ``(c * step, r * step)``; there
        are as many rows and columns of patches as fit into the picture, and none if it is smaller than a patch.

    Raises
    ------
    ValueError
        If `size` is not a positive multiple of `step`, or the picture is not one of labels.

    Examples
    --------
    >>> flat = pattern_bins(np.zeros((20, 24), dtype=np.uint8))
    >>> shares = patch_histograms(flat)
    >>> shares.shape, shares[0, 0, 57]
    ((3, 4, 59), np.float64(1.0))
    """
    if step < 1 or size < 1 or size % step:
        raise ValueError(f"size must be a positive multiple of step, got {size} and {step}")
    if patterns.ndim != 2 or patterns.max(initial=0) >= N_PATTERNS:
        raise ValueError(f"need a picture (H, W) of labels below {N_PATTERNS}, got shape {patterns.shape}")
    n_rows, n_columns = (max(side // step, 0) for side in patterns.shape)
    span = size // step
    if n_rows < span or n_columns < span:
        return np.zeros((max(n_rows - span + 1, 0), max(n_columns - span + 1, 0), N_PATTERNS))
    used = patterns[: n_rows * step, : n_columns * step].astype(int)
    cells = (np.arange(n_rows * step) // step)[:, None] * n_columns + np.arange(n_columns * step) // step
    counts = np.bincount((cells * N_PATTERNS + used).ravel(), minlength=n_rows * n_columns * N_PATTERNS)
    sums = np.zeros((n_rows + 1, n_columns + 1, N_PATTERNS))
    sums[1:, 1:] = counts.reshape(n_rows, n_columns, N_PATTERNS).cumsum(axis=0).cumsum(axis=1)
    inside = sums[span:, span:] - sums[:-span, span:] - sums[span:, :-span] + sums[:-span, :-span]
    return inside / size**2
