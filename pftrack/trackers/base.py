"""What all single-target trackers share: the estimate they return, the checks they make, and the loop over frames.

A tracker is any object with ``init(frame, box)`` and ``update(frame)``, both returning an :class:`Estimate`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from tqdm.auto import tqdm

from pftrack.checks import check_picture, check_same_size


@dataclass(frozen=True)
class Estimate:
    """Where a tracker believes its target to be in one frame.

    Attributes
    ----------
    box : ndarray, shape (4,)
        ``(x, y, w, h)`` in pixels, top-left origin; NaN when there is nothing to report.
    score : float
        Confidence from 0 to 1; what it measures is said by each tracker.
    lost : bool
        Whether the tracker believes to have lost the target in this frame.
    particles : ndarray, shape (N, d), or None
        The particles before resampling, for trackers that have them.
    weights : ndarray, shape (N,), or None
        Their normalised weights.
    """

    box: np.ndarray
    score: float
    lost: bool
    particles: np.ndarray | None = None
    weights: np.ndarray | None = None


MISSING = Estimate(box=np.full(4, np.nan), score=0.0, lost=True)
"""The estimate of a frame that could not be read."""


@dataclass(frozen=True)
class Prepared:
    """What colour trackers derive from a frame alone, whatever their seed; it stands in for the frame.

    Attributes
    ----------
    shape : tuple of int
        Shape of the frame, ``(H, W, 3)``.
    bins : ndarray, shape (H, W), uint8
        Histogram bin of every pixel.
    """

    shape: tuple[int, ...]
    bins: np.ndarray


class Tracker(Protocol):
    """The protocol of every single-target tracker.

    A tracker may also have ``prepare(frame)``, which computes what depends on the frame alone. `init` and `update` then
    take what it returns in place of the frame, so that many trackers can share it (:mod:`pftrack.experiments`).
    """

    def init(self, frame: np.ndarray, box) -> Estimate:
        """Start tracking what `box` shows in `frame`."""

    def update(self, frame: np.ndarray) -> Estimate:
        """Find the target in the next frame."""


def check_frame(frame, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """Return the frame, or say what is wrong with it.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8, or Prepared
        A colour image in BGR order.
    shape : tuple of int, optional
        The shape that the first frame had.

    Raises
    ------
    ValueError
        If the frame is not a three-channel uint8 image, or not of the given shape.
    """
    if not isinstance(frame, Prepared):  # whose frame was checked
        check_picture(frame)
    check_same_size(frame.shape, shape)
    return frame


def check_started(shape) -> tuple[int, ...]:
    """Return the shape of the first frame, or say that tracking has not begun.

    Raises
    ------
    ValueError
        If `shape` is None.
    """
    if shape is None:
        raise ValueError("call init(frame, box) before update(frame)")
    return shape


def follow(tracker: Tracker, frames: Iterable[np.ndarray], box, progress: bool = False) -> Iterator[Estimate]:
    """Run a tracker over frames and yield its estimate for each, one at a time.

    Parameters
    ----------
    tracker : Tracker
        Any single-target tracker.
    frames : iterable of ndarray, shape (H, W, 3), uint8
        The frames; only one is held at a time. Where they have a length, and end before it (a damaged video), the
        estimates of the missing frames have a NaN box and say ``lost``.
    box : array_like, shape (4,)
        The target in the first frame, ``(x, y, w, h)`` in pixels.
    progress : bool
        Whether to show a progress bar.

    Yields
    ------
    Estimate
        One for every frame, the first being the box that was given.

    Raises
    ------
    ValueError
        If there are no frames, or a frame or the box is not what the tracker takes.
    """
    n_frames = len(frames) if hasattr(frames, "__len__") else None
    t = -1
    for t, frame in enumerate(tqdm(frames, total=n_frames, unit="frame", disable=not progress)):
        try:
            estimate = tracker.init(frame, box) if t == 0 else tracker.update(frame)
        except ValueError as error:
            raise ValueError(f"frame {t}: {error}") from error
        yield estimate
    if t < 0:
        raise ValueError("there are no frames to track through")
    for _ in range(t + 1, n_frames or 0):
        yield MISSING


def track(tracker: Tracker, frames: Iterable[np.ndarray], box, progress: bool = False) -> np.ndarray:
    """Run a tracker over frames and return its boxes.

    Parameters and errors are those of :func:`follow`.

    Returns
    -------
    ndarray, shape (T, 4)
        The boxes ``(x, y, w, h)`` in pixels, the first being the box that was given.

    Examples
    --------
    >>> import pftrack
    >>> scene = pftrack.datasets.load("synthetic-walk")
    >>> boxes = track(pftrack.ColorParticleFilter(seed=0), scene.frames[:5], scene.boxes[0])
    >>> boxes.shape
    (5, 4)
    """
    return np.array([estimate.box for estimate in follow(tracker, frames, box, progress)])
