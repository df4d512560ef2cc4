"""What all single-target trackers share: the estimate they return, the checks they make, and the loop over frames.

A tracker is any object with ``init(frame, box)`` and ``update(frame)``, both returning an :class:`Estimate`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from tqdm.auto import tqdm

MIN_SIDE = 2
"""Smallest width and height, in visible pixels, of a box that a tracker accepts."""


LARGEST = 1e6
"""Largest number, in pixels, that makes sense in a box."""


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
    if isinstance(frame, Prepared):
        pass  # its frame was checked
    elif not isinstance(frame, np.ndarray) or frame.ndim != 3 or frame.shape[2] != 3 or frame.size == 0:
        found = f"shape {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise ValueError(
            f"a frame must be a colour image of shape (H, W, 3), got {found}; convert grey or four-channel images "
            "with cv2.cvtColor first"
        )
    elif frame.dtype != np.uint8:
        raise ValueError(f"a frame must have dtype uint8 with values 0 to 255, got {frame.dtype}")
    if shape is not None and frame.shape != shape:
        raise ValueError(
            f"the frame is {frame.shape[1]}x{frame.shape[0]} but tracking began on {shape[1]}x{shape[0]}; "
            "all frames must have one size"
        )
    return frame


def check_box(box, frame: np.ndarray) -> np.ndarray:
    """Return the box as floats, or say what is wrong with it.

    Parameters
    ----------
    box : array_like, shape (4,)
        ``(x, y, w, h)`` in pixels; it may reach over the border, but not lie beyond it.
    frame : ndarray, shape (H, W, 3)
        The image it is drawn on.

    Raises
    ------
    ValueError
        If the box has not four finite numbers, is empty, or shows less than 2x2 pixels of the frame.
    """
    given = box
    try:
        box = np.array(given, dtype=float)
    except (TypeError, ValueError):
        box = np.empty(0)
    if box.shape != (4,) or not np.all(np.abs(box) <= LARGEST):
        raise ValueError(f"a box must be four finite numbers x, y, w, h in pixels, got {given!r}")
    x, y, w, h = box
    if w <= 0 or h <= 0:
        raise ValueError(f"the box {box.tolist()} is empty; width and height must be positive")
    height, width = frame.shape[:2]
    visible = min(x + w, width) - max(x, 0), min(y + h, height) - max(y, 0)
    if min(visible) <= 0:
        raise ValueError(f"the box {box.tolist()} lies outside the {width}x{height} frame")
    if min(visible) < MIN_SIDE:
        raise ValueError(
            f"the box {box.tolist()} shows less than {MIN_SIDE}x{MIN_SIDE} pixels of the {width}x{height} frame, "
            "too few to learn the target's colours from"
        )
    return box


def check_seed(seed) -> None:
    """Make sure that a seed is one.

    Raises
    ------
    ValueError
        If it is neither a non-negative integer nor a generator.
    """
    if not (isinstance(seed, np.random.Generator) or (isinstance(seed, (int, np.integer)) and seed >= 0)):
        raise ValueError(f"seed must be a non-negative integer or a Generator, got {seed}")


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
