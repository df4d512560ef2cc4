"""Mean-Shift tracking: climb the back-projection with a window of fixed size.

Comaniciu et al. 2000, in the form that OpenCV's ``meanShift`` gives it; Owczarek et al. 2015 compare with it
(section IV-B). Chapter 4 derives it.
"""

from __future__ import annotations

import cv2
import numpy as np

from pftrack.checks import check_box
from pftrack.color import back_projection, masked_histogram, pixel_edges
from pftrack.trackers.base import Estimate, check_frame, check_started


class MeanShiftTracker:
    """Follow a target by moving a fixed window to the centre of mass of its back-projected colours.

    Parameters
    ----------
    saturation, value : tuple of int
        Lowest and highest saturation and value (0 to 255, inclusive) of the pixels that count; the defaults are those
        of OpenCV's CAMSHIFT sample.
    n_hues : int
        Number of hue bins of the target's histogram.
    max_iterations : int
        Most Mean-Shift iterations a frame.
    epsilon : float
        Stop when the window moves less than this many pixels.

    Raises
    ------
    ValueError
        If an interval is empty or leaves 0 to 255, or `n_hues`, `max_iterations` or `epsilon` is not positive.

    Notes
    -----
    The score is the mean of the back-projection in the window, from 0 to 1. The target is `lost` when the window
    shows none of its colours; the window then stays where it was.

    Examples
    --------
    >>> frame = np.zeros((60, 80, 3), dtype=np.uint8)
    >>> frame[20:40, 30:40] = (255, 0, 0)
    >>> tracker = MeanShiftTracker()
    >>> _ = tracker.init(frame, (30, 20, 10, 20))
    >>> tracker.update(np.roll(frame, 4, axis=1)).box  # it moved by 4; OpenCV stops where a step rounds to 0
    array([32., 20., 10., 20.])
    """

    def __init__(
        self,
        saturation: tuple[int, int] = (60, 255),
        value: tuple[int, int] = (32, 255),
        n_hues: int = 16,
        max_iterations: int = 10,
        epsilon: float = 1.0,
    ):
        for name, (low, high) in (("saturation", saturation), ("value", value)):
            if not 0 <= low <= high <= 255:
                raise ValueError(f"{name} must be an interval within 0 to 255, got {(low, high)}")
        if n_hues < 1 or max_iterations < 1 or not epsilon > 0:
            raise ValueError(
                f"n_hues, max_iterations and epsilon must be positive, got {n_hues}, {max_iterations}, {epsilon}"
            )
        self.saturation, self.value, self.n_hues = saturation, value, n_hues
        self.criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, max_iterations, epsilon)
        self.histogram = None
        self._shape = None

    def init(self, frame: np.ndarray, box) -> Estimate:
        """Learn the masked hue histogram of the target.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The first frame.
        box : array_like, shape (4,)
            The target in it, ``(x, y, w, h)`` in pixels.

        Returns
        -------
        Estimate
            The given box, with score 1.

        Raises
        ------
        ValueError
            If the frame or the box is unusable.
        """
        frame = check_frame(frame)
        box = check_box(box, frame)
        self.histogram = masked_histogram(frame, box, self.saturation, self.value, self.n_hues)
        height, width = frame.shape[:2]
        left, top, right, bottom = np.clip(pixel_edges([box])[0], 0, [width, height, width, height])
        self.window = (int(left), int(top), int(right - left), int(bottom - top))
        self._shape = frame.shape
        return Estimate(box=box, score=1.0, lost=False)

    def update(self, frame: np.ndarray) -> Estimate:
        """Move the window to where the target's colours are in the next frame.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The next frame, of the size of the first.

        Returns
        -------
        Estimate
            The window, the mean back-projection in it, and whether the target is lost.

        Raises
        ------
        ValueError
            If the frame is unusable, or `init` was not called.
        """
        frame = check_frame(frame, check_started(self._shape))
        probability = back_projection(frame, self.histogram, self.saturation, self.value)
        window = self._search(probability)
        x, y, w, h = window
        mass = float(probability[y : y + h, x : x + w].sum())
        lost = mass == 0
        if not lost:
            self.window = window
        return Estimate(box=np.array(self.window, dtype=float), score=0.0 if lost else mass / (255 * w * h), lost=lost)

    def _search(self, probability: np.ndarray) -> tuple[int, int, int, int]:
        """Return the new window ``(x, y, w, h)`` that OpenCV finds."""
        _, window = cv2.meanShift(probability, self.window, self.criteria)
        return window
