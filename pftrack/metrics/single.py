"""How good the track of one target is: overlap, hits and centre errors.

The measure of Owczarek et al. 2015 (section IV-A) is the *overlap rate* of the tracker's rectangle and the truth's,
the area of their intersection divided by that of their union. A frame is a *hit* when the overlap is at least 1/3.

What to do with frames in which the target is hidden, and so has no true box, is a convention that changes the numbers.
Both are computed, and named: over **all** frames, a hidden frame counting as overlap 0 and as a miss (which caps a
perfect tracker below 1), and over the **visible** frames alone.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

HIT_OVERLAP = 1 / 3
"""Smallest overlap that counts as a hit (Owczarek et al. 2015, section IV-A)."""


def overlap(boxes, truth) -> np.ndarray:
    """Intersection over union of two sequences of boxes, frame by frame.

    Parameters
    ----------
    boxes, truth : array_like, shape (T, 4)
        Boxes ``(x, y, w, h)`` in pixels; NaN where there is none.

    Returns
    -------
    ndarray, shape (T,)
        Overlap between 0 and 1. NaN where the *truth* is hidden, since nothing could be right there; 0 where only
        the tracker's box is missing.

    Raises
    ------
    ValueError
        If the shapes differ or are not ``(T, 4)``.

    Examples
    --------
    Two squares of side 2, one shifted by half its width: the intersection is 2, the union 6.

    >>> overlap([[0, 0, 2, 2]], [[1, 0, 2, 2]]).round(3)
    array([0.333])
    """
    boxes, truth = _check_pair(boxes, truth)
    low = np.maximum(boxes[:, :2], truth[:, :2])
    high = np.minimum(boxes[:, :2] + boxes[:, 2:], truth[:, :2] + truth[:, 2:])
    intersection = np.prod(np.maximum(high - low, 0.0), axis=1)
    union = np.prod(boxes[:, 2:], axis=1) + np.prod(truth[:, 2:], axis=1) - intersection
    rate = np.divide(intersection, union, out=np.zeros(len(boxes)), where=union > 0)
    rate[np.isnan(truth).any(axis=1)] = np.nan
    return rate


def pairwise_overlap(a, b) -> np.ndarray:
    """Intersection over union of every box of one set with every box of another.

    Parameters
    ----------
    a, b : array_like, shapes (N, 4) and (M, 4)
        Boxes ``(x, y, w, h)`` in pixels, not NaN.

    Returns
    -------
    ndarray, shape (N, M)
        Overlap between 0 and 1.

    Raises
    ------
    ValueError
        If the shapes are others.

    Examples
    --------
    >>> pairwise_overlap([[0, 0, 2, 2]], [[1, 0, 2, 2], [5, 5, 1, 1]]).round(3)
    array([[0.333, 0.   ]])
    """
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.ndim != 2 or a.shape[1] != 4 or b.ndim != 2 or b.shape[1] != 4:
        raise ValueError(f"boxes must have shapes (N, 4) and (M, 4), got {a.shape} and {b.shape}")
    a, b = a[:, None], b[None]
    low = np.maximum(a[..., :2], b[..., :2])
    high = np.minimum(a[..., :2] + a[..., 2:], b[..., :2] + b[..., 2:])
    intersection = np.prod(np.maximum(high - low, 0.0), axis=-1)
    union = np.prod(a[..., 2:], axis=-1) + np.prod(b[..., 2:], axis=-1) - intersection
    return np.divide(intersection, union, out=np.zeros(union.shape), where=union > 0)


def center_error(boxes, truth) -> np.ndarray:
    """Distance between the centres of two sequences of boxes, frame by frame.

    Parameters
    ----------
    boxes, truth : array_like, shape (T, 4)
        Boxes ``(x, y, w, h)`` in pixels; NaN where there is none.

    Returns
    -------
    ndarray, shape (T,)
        Distances in pixels; NaN where either box is missing.

    Raises
    ------
    ValueError
        If the shapes differ or are not ``(T, 4)``.

    Examples
    --------
    >>> center_error([[0, 0, 2, 2]], [[3, 4, 2, 2]])
    array([5.])
    """
    boxes, truth = _check_pair(boxes, truth)
    return np.linalg.norm(boxes[:, :2] + boxes[:, 2:] / 2 - truth[:, :2] - truth[:, 2:] / 2, axis=1)


@dataclass(frozen=True)
class SingleTargetScore:
    """Summary of a track of one target, from :func:`single_target`.

    Attributes
    ----------
    n_frames, n_hidden, n_missing : int
        Number of frames; of those, where the truth is hidden; and where it is visible but the tracker gave no box.
    overlap_all, overlap_visible : float
        Mean overlap, from 0 to 1, with hidden frames counted as 0, and without them.
    hit_ratio_all, hit_ratio_visible : float
        Share of frames whose overlap is at least 1/3, with hidden frames counted as misses, and without them.
    center_error_mean, center_error_rms : float
        Mean and root mean square of the distance between centres, in pixels, over the frames where both boxes exist.
    """

    n_frames: int
    n_hidden: int
    n_missing: int
    overlap_all: float
    overlap_visible: float
    hit_ratio_all: float
    hit_ratio_visible: float
    center_error_mean: float
    center_error_rms: float

    def as_dict(self) -> dict[str, float]:
        """Return the fields as a plain dictionary, for a table or for JSON."""
        return asdict(self)


def single_target(boxes, truth) -> SingleTargetScore:
    """Score a track of one target by all measures of Owczarek et al. 2015 and by its centre error.

    Parameters
    ----------
    boxes, truth : array_like, shape (T, 4)
        The tracker's boxes and the true ones, ``(x, y, w, h)`` in pixels; NaN where there is none.

    Returns
    -------
    SingleTargetScore
        Mean overlap, hit ratio and centre error.

    Raises
    ------
    ValueError
        If the shapes differ, or no frame has a true box.

    Examples
    --------
    >>> truth = [[0, 0, 10, 10], [np.nan] * 4]
    >>> score = single_target([[0, 0, 10, 10], [0, 0, 10, 10]], truth)
    >>> score.overlap_visible, score.overlap_all
    (1.0, 0.5)
    """
    rates = overlap(boxes, truth)
    visible = ~np.isnan(rates)
    if not visible.any():
        raise ValueError("the truth is hidden in every frame; there is nothing to score")
    missing = np.isnan(np.asarray(boxes, dtype=float)).any(axis=1)
    errors = center_error(boxes, truth)
    errors = errors[~np.isnan(errors)]
    counted = np.where(visible, rates, 0.0)
    return SingleTargetScore(
        n_frames=len(rates),
        n_hidden=int((~visible).sum()),
        n_missing=int((missing & visible).sum()),
        overlap_all=float(counted.mean()),
        overlap_visible=float(rates[visible].mean()),
        hit_ratio_all=float((counted >= HIT_OVERLAP).mean()),
        hit_ratio_visible=float((rates[visible] >= HIT_OVERLAP).mean()),
        center_error_mean=float(errors.mean()) if errors.size else float("nan"),
        center_error_rms=float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan"),
    )


def _check_pair(boxes, truth) -> tuple[np.ndarray, np.ndarray]:
    boxes, truth = np.asarray(boxes, dtype=float), np.asarray(truth, dtype=float)
    if boxes.ndim != 2 or boxes.shape[1] != 4 or boxes.shape != truth.shape:
        raise ValueError(f"boxes and truth must both have shape (T, 4), got {boxes.shape} and {truth.shape}")
    return boxes, truth
