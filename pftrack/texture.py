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
