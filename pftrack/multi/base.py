"""What all multi-target trackers share: the tracks they return, how training detections become targets, and the loop.

A multi-target tracker is any object with ``update(frame, detections=None)``, which returns the list of its
:class:`Track` in that frame. It finds the targets itself; with `detections` given, in what is found for it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from tqdm.auto import tqdm

from pftrack import patches
from pftrack.checks import check_box, check_picture, check_same_size
from pftrack.detection import merge
from pftrack.metrics import pairwise_overlap


@dataclass(frozen=True)
class Track:
    """Where a tracker believes one of its targets to be in one frame.

    Attributes
    ----------
    id : int
        Number of the target, from 1, never given to another.
    box : ndarray, shape (4,)
        ``(x, y, w, h)`` in pixels.
    score : float
        Confidence from 0 to 1; what it measures is said by each tracker.
    held : bool
        Whether the target is too hidden to be measured, so that its box is the last one, or where it is expected.
    particles : ndarray, shape (N, 4), or None
        The particles before resampling, ``[x, y, w, h]`` with `x` and `y` of the *centre*.
    weights : ndarray, shape (N,), or None
        Their normalised weights.
    color_weight : float
        Weight of colour in the likelihood, from 0 to 1; that of texture is the rest.
    """

    id: int
    box: np.ndarray
    score: float
    held: bool = False
    particles: np.ndarray | None = None
    weights: np.ndarray | None = None
    color_weight: float = float("nan")


def stream(seed, number: int) -> np.random.Generator:
    """Random numbers of one target, whatever the others need of theirs.

    Parameters
    ----------
    seed : int or numpy.random.Generator
        Seed of the tracker.
    number : int
        Number of the target.

    Returns
    -------
    numpy.random.Generator
        A stream that depends on both, or the next child of the generator.
    """
    return seed.spawn(1)[0] if isinstance(seed, np.random.Generator) else np.random.default_rng([seed, number])


def check_detections(detections) -> np.ndarray:
    """Return detections as an array, or say what is wrong with them.

    Parameters
    ----------
    detections : array_like, shape (D, 5)
        ``x, y, w, h, score`` of each, in pixels; possibly none.

    Returns
    -------
    ndarray, shape (D, 5)
        The same.

    Raises
    ------
    ValueError
        If they are no rows of five numbers, or a box is empty or not finite.

    Examples
    --------
    >>> check_detections([]).shape
    (0, 5)
    """
    found = np.asarray(detections, dtype=float)
    found = found.reshape(-1, 5) if found.size == 0 else found
    if found.ndim != 2 or found.shape[1] != 5 or not np.isfinite(found).all() or not (found[:, 2:4] > 0).all():
        raise ValueError(f"detections must be rows x, y, w, h, score with boxes that are not empty, got {detections!r}")
    return found


def check_training(frames, boxes) -> list[dict[int, np.ndarray]]:
    """Return the boxes of each target in training frames, or say what is wrong with them.

    Parameters
    ----------
    frames : sequence of ndarray, shape (H, W, 3), uint8
        The frames.
    boxes : array_like, shape (M, K, 4)
        Box of each of `K` targets in each frame, NaN where it is hidden.

    Returns
    -------
    list of dict of int to ndarray, shape (4,)
        For each target its box in the frames in which it is seen.

    Raises
    ------
    ValueError
        If there are no frames or targets, a frame or a box is unusable, or a target is never seen.
    """
    boxes = np.asarray(boxes, dtype=float)
    if len(frames) == 0 or boxes.ndim != 3 or boxes.shape[::2] != (len(frames), 4) or boxes.shape[1] == 0:
        raise ValueError(
            f"need training frames and boxes (M, K, 4) of them, got {len(frames)} frames and boxes {boxes.shape}"
        )
    for frame in frames:
        check_same_size(check_picture(frame).shape, frames[0].shape)
    known = [
        {t: check_box(box, frames[t]) for t, box in enumerate(of_one) if not np.isnan(box).any()}
        for of_one in boxes.swapaxes(0, 1)
    ]
    if not all(known):
        raise ValueError("a target is hidden in all training frames, so nothing can be learnt of it")
    return known


class MultiTracker(Protocol):
    """The protocol of every multi-target tracker."""

    def update(self, frame: np.ndarray, detections=None) -> list[Track]:
        """Follow all targets into the next frame, the first included.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The next frame.
        detections : array_like, shape (D, 5), optional
            ``x, y, w, h, score`` of what was found in it; by default the tracker looks itself where it needs to.
        """


def link(detections: Sequence, min_frames: int, min_overlap: float = 0.3) -> list[dict[int, np.ndarray]]:
    """Join the detections of consecutive frames to targets.

    Detections that overlap by half in one frame are first merged: they are one person, found twice. Each frame is then
    joined to the latest boxes of the targets so far, one to one, for the largest sum of overlaps. A target that keeps
    inside a larger one, found as often at least, is left out.

    Parameters
    ----------
    detections : sequence of array_like, shape (D, 5)
        ``x, y, w, h, score`` in each frame, possibly none.
    min_frames : int
        Targets that were found in fewer frames are left out.
    min_overlap : float
        Least overlap of a detection with the latest box of its target.

    Returns
    -------
    list of dict of int to ndarray, shape (4,)
        For each target its box in the frames in which it was found; the target found most often first, and of those
        found equally often the largest.

    Examples
    --------
    >>> someone, twice = [10, 10, 20, 50, 0.9], [12, 10, 20, 50, 0.5]
    >>> (target,) = link([[someone], [someone, twice], [], [twice]], min_frames=3)
    >>> list(target)
    [0, 1, 3]
    """
    from scipy.optimize import linear_sum_assignment  # takes a second to import

    targets: list[dict[int, np.ndarray]] = []
    for t, found in enumerate(detections):
        found = np.asarray(found, dtype=float).reshape(-1, 5)
        boxes, _, _ = merge(found[:, :4], np.maximum(found[:, 4], 0.0), overlap=0.5)
        latest = np.array([list(target.values())[-1] for target in targets]).reshape(-1, 4)
        overlaps = pairwise_overlap(latest, boxes)
        joined = set()
        for target, box in zip(*linear_sum_assignment(overlaps, maximize=True), strict=True):
            if overlaps[target, box] >= min_overlap:
                targets[target][t] = boxes[box]
                joined.add(box)
        targets += [{t: box} for n, box in enumerate(boxes) if n not in joined]
    targets = [target for target in targets if len(target) >= min_frames]
    targets.sort(key=lambda target: (len(target), np.prod(list(target.values())[-1][2:])), reverse=True)
    return [target for n, target in enumerate(targets) if not any(_inside(target, other) for other in targets[:n])]


def _inside(target: dict[int, np.ndarray], other: dict[int, np.ndarray]) -> bool:
    """Tell whether most of a target is inside another in all frames they share: legs or a head, taken for a person."""
    shared = target.keys() & other.keys()
    return bool(shared) and all(patches.coverage([other[t]], _edges(target[t]))[0, 0, 0] > 0.8 for t in shared)


def _edges(box) -> np.ndarray:
    x, y, w, h = box
    return np.array([[x, y, x + w, y + h]])


def follow(
    tracker: MultiTracker, frames: Iterable[np.ndarray], detections=None, progress: bool = False
) -> Iterator[list[Track]]:
    """Run a multi-target tracker over frames and yield its tracks in each.

    Parameters
    ----------
    tracker : MultiTracker
        A new tracker.
    frames : iterable of ndarray, shape (H, W, 3), uint8
        The frames; only one is held at a time.
    detections : array_like, shape (R, 7), optional
        A table of detections of all frames, ``frame, id, x, y, w, h, score``; by default the tracker looks itself.
    progress : bool
        Whether to show a progress bar.

    Yields
    ------
    list of Track
        One list for every frame.

    Raises
    ------
    ValueError
        If there are no frames, or one is not what the tracker takes.
    """
    n_frames = len(frames) if hasattr(frames, "__len__") else None
    t = -1
    for t, frame in enumerate(tqdm(frames, total=n_frames, unit="frame", disable=not progress)):
        found = None
        if detections is not None:
            table = np.asarray(detections, dtype=float).reshape(-1, 7)
            found = table[table[:, 0] == t, 2:]
        try:
            tracks = tracker.update(frame, found)
        except ValueError as error:
            raise ValueError(f"frame {t}: {error}") from error
        yield tracks
    if t < 0:
        raise ValueError("there are no frames to track through")


def table(tracks: Iterable[list[Track]]) -> np.ndarray:
    """Collect tracks in a table.

    Parameters
    ----------
    tracks : iterable of list of Track
        The tracks in each frame, from :func:`follow`.

    Returns
    -------
    ndarray, shape (R, 7)
        ``frame, id, x, y, w, h, score``, see :mod:`pftrack.datasets.readers`.

    Examples
    --------
    >>> table([[], [Track(1, np.array([10.0, 20.0, 30.0, 40.0]), 0.5)]])
    array([[ 1. ,  1. , 10. , 20. , 30. , 40. ,  0.5]])
    """
    rows = [[t, track.id, *track.box, track.score] for t, found in enumerate(tracks) for track in found]
    return np.array(rows, dtype=float).reshape(-1, 7)
