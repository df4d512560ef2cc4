"""CAMSHIFT: Mean-Shift with a window that adapts its size and orientation to the target.

Bradski 1998, in the form that OpenCV's ``CamShift`` gives it; the tracker that Owczarek et al. 2015 compare with
(section IV-B, Table II). Chapter 4 derives it.
"""

from __future__ import annotations

import cv2
import numpy as np

from pftrack.trackers.base import Estimate
from pftrack.trackers.mean_shift import MeanShiftTracker


class CamShiftTracker(MeanShiftTracker):
    """Follow a target by Mean-Shift and fit the window to the colours found.

    Parameters, errors and score are those of :class:`~pftrack.trackers.mean_shift.MeanShiftTracker`.

    Attributes
    ----------
    rotated_box : tuple or None
        OpenCV's rotated rectangle ``((cx, cy), (width, height), angle in degrees)`` fitted in the last frame; None
        before the first and while the target is lost. The box of the estimate is the upright search window.

    Examples
    --------
    The target moves by 4 pixels and grows; the window follows both.

    >>> frame = np.zeros((60, 80, 3), dtype=np.uint8)
    >>> frame[20:40, 30:40] = (255, 0, 0)
    >>> larger = np.zeros_like(frame)
    >>> larger[18:46, 32:46] = (255, 0, 0)
    >>> tracker = CamShiftTracker()
    >>> _ = tracker.init(frame, (30, 20, 10, 20))
    >>> for _ in range(5):
    ...     estimate = tracker.update(larger)
    >>> (x, y), (w, h), angle = tracker.rotated_box
    >>> print(round(x), round(y))
    38 31
    """

    rotated_box: tuple | None = None

    def init(self, frame: np.ndarray, box) -> Estimate:
        """Learn the masked hue histogram of the target; see :class:`~pftrack.trackers.mean_shift.MeanShiftTracker`."""
        self.rotated_box = None
        return super().init(frame, box)

    def _search(self, probability: np.ndarray) -> tuple[int, int, int, int]:
        rotated_box, window = cv2.CamShift(probability, self.window, self.criteria)
        self.rotated_box = rotated_box if min(rotated_box[1]) > 0 else None
        return window
