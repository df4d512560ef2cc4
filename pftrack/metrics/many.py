r"""How good detections are, and the tracks of many targets: CLEAR, identity F1 and HOTA.

With many targets the first question is which box is whose. In one frame it is the *assignment* of true boxes to boxes
found, one to one, with the largest sum of overlaps. Over time three answers are in use; they differ in what they try
to preserve, and so in what they punish.

**CLEAR** (Bernardin and Stiefelhagen 2008) goes frame by frame and changes a pair only when it must. It counts the
misses :math:`\text{FN}`, the false positives :math:`\text{FP}` and the switches :math:`\text{IDSW}`, where a target is
taken over by another track, against the number of true boxes:

.. math:: \text{MOTA} = 1 - \frac{\text{FN} + \text{FP} + \text{IDSW}}{\text{GT}} .

It can be negative. A swap costs one switch for each of the two targets however long it lasts, so that MOTA says mostly
how good the detections are.

**Identity F1** (Ristani et al. 2016) pairs whole tracks with whole targets, one to one over the film, for the largest
number :math:`\text{IDTP}` of frames in which they agree. All other boxes are wrong, however well they fit:

.. math:: \text{IDF1} = \frac{2\,\text{IDTP}}{\text{GT} + \text{boxes found}} .

**HOTA** (Luiten et al. 2021) is the geometric mean of how well boxes are found, :math:`\text{DetA}`, and how well they
are put together to tracks, :math:`\text{AssA}`, averaged over 19 thresholds of the overlap.

The conventions are those of TrackEval, the code of the MOTChallenge, and named where they matter. Tables are those of
:mod:`pftrack.datasets.readers`. All boxes given count: what should not, such as the boxes that a truth flags as not to
be scored, must be left out before. Chapter 11 uses the measures.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np

from pftrack.metrics.single import pairwise_overlap

HOTA_OVERLAPS = np.arange(1, 20) / 20
"""The 19 thresholds over which HOTA is averaged (Luiten et al. 2021)."""


# ---------------------------------------------------------------------------------------------------------------------
# Detections
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DetectionScore:
    """How good detections are, from :func:`detections`.

    Attributes
    ----------
    n_truth, n_found, n_matched : int
        Number of true boxes, of detections, and of pairs of both that overlap enough.
    recall, precision : float
        Share of the true boxes that were found, and of the detections that are right; NaN of nothing.
    overlap : float
        Mean overlap of the pairs.
    """

    n_truth: int
    n_found: int
    n_matched: int
    recall: float
    precision: float
    overlap: float


def detections(found, truth, min_overlap: float = 0.5) -> DetectionScore:
    """Score detections against the truth.

    Parameters
    ----------
    found, truth : array_like, shape (R, 7)
        Tables of detections and of tracks, ``frame, id, x, y, w, h, score``; ids and scores are not looked at.
    min_overlap : float
        Least overlap of a pair, above 0.

    Returns
    -------
    DetectionScore
        Recall, precision and mean overlap of the pairs that :func:`correct` finds.

    Raises
    ------
    ValueError
        As :func:`correct` does.

    Examples
    --------
    >>> truth = [[0, 1, 0, 0, 10, 20, 1], [1, 1, 0, 0, 10, 20, 1]]
    >>> score = detections([[0, -1, 0, 0, 10, 16, 0.7]], truth)
    >>> score.recall, score.precision, score.overlap
    (0.5, 1.0, 0.8)
    """
    overlaps = _overlaps_of_pairs(found, truth, min_overlap)
    n_found, n_truth, n = len(overlaps), len(truth), int(np.sum(overlaps > 0))
    return DetectionScore(
        n_truth=n_truth,
        n_found=n_found,
        n_matched=n,
        recall=_ratio(n, n_truth),
        precision=_ratio(n, n_found),
        overlap=_ratio(overlaps.sum(), n),
    )


def correct(found, truth, min_overlap: float = 0.5) -> np.ndarray:
    """Tell which detections are right.

    Parameters
    ----------
    found, truth : array_like, shape (R, 7)
        Tables of detections and of tracks, ``frame, id, x, y, w, h, score``; ids and scores are not looked at.
    min_overlap : float
        Least overlap of a pair, above 0. In every frame pairs are one to one, and chosen for the largest sum of
        overlaps: of two detections of one person, one is wrong.

    Returns
    -------
    ndarray, shape (R,), bool
        One for every row of `found`.

    Raises
    ------
    ValueError
        If a table has another shape, or a box is not finite or has a negative side, or `min_overlap` is not above 0
        and at most 1.

    Examples
    --------
    >>> truth = [[0, 1, 0, 0, 10, 20, 1]]
    >>> correct([[0, -1, 2, 0, 10, 20, 0.9], [0, -1, 1, 0, 10, 20, 0.7], [1, -1, 0, 0, 10, 20, 0.8]], truth)
    array([False,  True, False])
    """
    return _overlaps_of_pairs(found, truth, min_overlap) > 0


def _overlaps_of_pairs(found, truth, min_overlap: float) -> np.ndarray:
    """Overlap of every detection with the true box it is paired with; 0 where it has none."""
    _check_overlap(min_overlap)
    found, truth = _table(found, "the table of detections"), _table(truth, "the truth")
    overlaps = np.zeros(len(found))
    for _, columns, rates in _shared_frames(truth, found):
        i, j = _assign(np.where(rates >= min_overlap, rates, 0.0))
        overlaps[columns[j]] = rates[i, j]
    return overlaps


def match_targets(tracks, truth, frame: int, min_overlap: float = 0.3) -> dict[int, int]:
    """Tell which track is which target, by their overlap in one frame.

    Parameters
    ----------
    tracks, truth : array_like, shape (R, 7)
        Tables of tracks, ``frame, id, x, y, w, h, score``.
    frame : int
        The frame in which they are compared.
    min_overlap : float
        Least overlap of a pair.

    Returns
    -------
    dict of int to int
        Number of the track of each target that has one; one to one, for the largest sum of overlaps.

    Examples
    --------
    >>> truth = [[0, 7, 0, 0, 10, 20, 1], [0, 8, 50, 0, 10, 20, 1]]
    >>> match_targets([[0, 1, 51, 0, 10, 20, 1]], truth, frame=0)
    {8: 1}
    """
    tracks, truth = _table(tracks, "the table of tracks"), _table(truth, "the truth")
    tracks, truth = tracks[tracks[:, 0] == frame], truth[truth[:, 0] == frame]
    rates = pairwise_overlap(truth[:, 2:6], tracks[:, 2:6])
    pairs = zip(*_assign(rates), strict=True)
    return {int(truth[i, 1]): int(tracks[j, 1]) for i, j in pairs if rates[i, j] >= min_overlap}


# ---------------------------------------------------------------------------------------------------------------------
# Tracks
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MultiTargetScore:
    """How good the tracks of many targets are, from :func:`multi_target`.

    Shares lie between 0 and 1, but for `mota`, which errors can make negative. A share or a mean of nothing is NaN
    (where TrackEval writes 0).

    Attributes
    ----------
    n_frames : int
        Frames with a true box or one found.
    n_truth, n_found, n_matched : int
        True boxes, boxes found, and pairs of both that CLEAR makes.
    n_targets, n_tracks : int
        Different ids of the true boxes, and of those found.
    misses, false_positives : int
        True boxes, and boxes found, without a partner.
    switches : int
        How often a target is paired with another track than the last time it had one.
    fragments : int
        How often a target is paired again, after frames in which it was not.
    mostly_tracked, partly_tracked, mostly_lost : int
        Targets that have a partner in more than 80 % of their frames, in 20 to 80 %, and in less than 20 %.
    mota : float
        ``1 - (misses + false_positives + switches) / n_truth``.
    motp : float
        Mean overlap of the pairs; higher is better. (py-motmetrics prints ``1 - motp``.)
    idf1, id_precision, id_recall : float
        Boxes of tracks that agree with the one target their track stands for, as a share of all boxes, found and true;
        of the boxes found; and of the true boxes.
    hota, deta, assa : float
        Means over the 19 thresholds of ``sqrt(deta * assa)``; of the share of pairs among all boxes, a pair counting
        once; and of the same share between the track and the target of a pair, over all pairs.
    """

    n_frames: int
    n_truth: int
    n_found: int
    n_matched: int
    n_targets: int
    n_tracks: int
    misses: int
    false_positives: int
    switches: int
    fragments: int
    mostly_tracked: int
    partly_tracked: int
    mostly_lost: int
    mota: float
    motp: float
    idf1: float
    id_precision: float
    id_recall: float
    hota: float
    deta: float
    assa: float

    def as_dict(self) -> dict[str, float]:
        """Return the fields as a plain dictionary, for a table or for JSON."""
        return asdict(self)


def multi_target(tracks, truth, min_overlap: float = 0.5) -> MultiTargetScore:
    """Score the tracks of many targets by CLEAR, identity F1 and HOTA.

    Parameters
    ----------
    tracks, truth : array_like, shape (R, 7)
        Tables of tracks, ``frame, id, x, y, w, h, score``, in any order; scores are not looked at. All boxes count.
    min_overlap : float
        Least overlap of a pair, above 0, for CLEAR and identity F1. HOTA has thresholds of its own.

    Returns
    -------
    MultiTargetScore
        All measures, by the conventions of TrackEval.

    Raises
    ------
    ValueError
        If a table has another shape, or an id twice in one frame; if a frame or an id is no whole number, or a box is
        not finite or has a negative side; or if `min_overlap` is not above 0 and at most 1.

    Examples
    --------
    Two people walk apart for four frames, and their tracks are swapped half-way. Every box is right, and so most of
    CLEAR's count; identity F1 holds each track to one person, and half of what it did is wrong.

    >>> truth = [[t, who, 100 * who + 5 * t, 0, 20, 50, 1] for t in range(4) for who in (1, 2)]
    >>> tracks = [[t, 3 - who if t >= 2 else who, *box] for t, who, *box in truth]
    >>> score = multi_target(tracks, truth)
    >>> score.switches, score.mota, score.idf1
    (2, 0.75, 0.5)
    """
    _check_overlap(min_overlap)
    tracks, truth = _tracks(tracks, "the table of tracks"), _tracks(truth, "the truth")
    film = _film(tracks, truth)
    return MultiTargetScore(
        n_frames=len(np.union1d(tracks[:, 0], truth[:, 0])),
        n_truth=len(truth),
        n_found=len(tracks),
        n_targets=len(film.n_true),
        n_tracks=len(film.n_found),
        **_clear(film, min_overlap),
        **_identity(film, min_overlap),
        **_hota(film),
    )


@dataclass(frozen=True)
class _Film:
    """What all three measures start from. Targets and tracks are numbered from 0.

    Attributes
    ----------
    n_true, n_found : ndarray, shapes (I,) and (J,)
        Number of boxes of each target and of each track.
    frames : list of (ndarray, ndarray, ndarray), shapes (n,), (m,) and (n, m)
        The targets, the tracks, and the overlaps of their boxes, in every frame that has both. In the others there is
        nothing to pair.
    """

    n_true: np.ndarray
    n_found: np.ndarray
    frames: list[tuple[np.ndarray, np.ndarray, np.ndarray]]


def _film(tracks: np.ndarray, truth: np.ndarray) -> _Film:
    _, target, n_true = np.unique(truth[:, 1], return_inverse=True, return_counts=True)
    _, track, n_found = np.unique(tracks[:, 1], return_inverse=True, return_counts=True)
    return _Film(n_true, n_found, [(target[i], track[j], rates) for i, j, rates in _shared_frames(truth, tracks)])


def _clear(film: _Film, min_overlap: float) -> dict[str, float]:
    """Pair frame by frame, keep a pair as long as it holds, and count what goes wrong (Bernardin and Stiefelhagen).

    Pairs of the frame before come first, then the largest sum of overlaps. "Before" is the last frame that had both
    true boxes and tracks. A switch may come any time after.
    """
    nobody = np.full(len(film.n_true), -1)
    before, latest = nobody, nobody.copy()  # the track of every target in the frame before, and the last it ever had
    n_covered, n_starts = np.zeros_like(nobody), np.zeros_like(nobody)
    switches, total = 0, 0.0
    for targets, tracks, rates in film.frames:
        kept = before[targets][:, None] == tracks
        bonus = len(targets) + 1  # more than all overlaps together
        i, j = _assign(np.where(rates >= min_overlap, rates + bonus * kept, 0.0))
        who, track = targets[i], tracks[j]
        switches += np.sum((latest[who] >= 0) & (latest[who] != track))
        n_starts[who] += before[who] < 0
        n_covered[who] += 1
        total += rates[i, j].sum()
        before = nobody.copy()
        before[who] = latest[who] = track
    n_matched, n_truth = n_covered.sum(), film.n_true.sum()
    misses, false_positives = n_truth - n_matched, film.n_found.sum() - n_matched
    covered = n_covered / film.n_true
    counts = {
        "n_matched": n_matched,
        "misses": misses,
        "false_positives": false_positives,
        "switches": switches,
        "fragments": np.sum(np.maximum(n_starts - 1, 0)),
        "mostly_tracked": np.sum(covered > 0.8),
        "partly_tracked": np.sum((covered >= 0.2) & (covered <= 0.8)),
        "mostly_lost": np.sum(covered < 0.2),
    }
    mota = 1 - _ratio(misses + false_positives + switches, n_truth)
    return {name: int(count) for name, count in counts.items()} | {"mota": mota, "motp": _ratio(total, n_matched)}


def _identity(film: _Film, min_overlap: float) -> dict[str, float]:
    """Pair whole tracks with whole targets, for the most frames in which they agree (Ristani et al.)."""
    agree = np.zeros((len(film.n_true), len(film.n_found)))
    for targets, tracks, rates in film.frames:
        agree[np.ix_(targets, tracks)] += rates >= min_overlap
    right, n_truth, n_found = agree[_assign(agree)].sum(), film.n_true.sum(), film.n_found.sum()
    return {
        "idf1": _ratio(2 * right, n_truth + n_found),
        "id_precision": _ratio(right, n_found),
        "id_recall": _ratio(right, n_truth),
    }


def _hota(film: _Film) -> dict[str, float]:
    """Pair frame by frame those who belong together over the film, then score at all thresholds (Luiten et al.).

    How well a track and a target belong together is an intersection over union, counted in boxes: in every frame they
    share a part of a box, their overlap relative to all that either overlaps.
    """
    boxes = film.n_true[:, None] + film.n_found
    shared = np.zeros(boxes.shape)
    for targets, tracks, rates in film.frames:
        either = rates.sum(axis=1, keepdims=True) + rates.sum(axis=0) - rates
        shared[np.ix_(targets, tracks)] += np.divide(rates, either, out=np.zeros_like(rates), where=either > 0)
    belonging = shared / (boxes - shared)

    pairs = [np.empty((0, 3))]
    for targets, tracks, rates in film.frames:
        i, j = _assign(belonging[np.ix_(targets, tracks)] * rates)
        pairs.append(np.column_stack([targets[i], tracks[j], rates[i, j]]))
    target, track, rate = np.concatenate(pairs).T

    detection, association = np.zeros((2, len(HOTA_OVERLAPS)))
    for n, threshold in enumerate(HOTA_OVERLAPS):
        close = rate >= threshold
        together = np.zeros(boxes.shape)
        np.add.at(together, (target[close].astype(int), track[close].astype(int)), 1)
        n_pairs = together.sum()
        detection[n] = _ratio(n_pairs, film.n_true.sum() + film.n_found.sum() - n_pairs)
        association[n] = np.sum(together * together / (boxes - together)) / max(n_pairs, 1)
    hota = np.sqrt(detection * association)
    return {"hota": float(hota.mean()), "deta": float(detection.mean()), "assa": float(association.mean())}


# ---------------------------------------------------------------------------------------------------------------------
# What they share
# ---------------------------------------------------------------------------------------------------------------------


def _assign(worth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pairs, one to one, that are worth most together; without those worth nothing."""
    from scipy.optimize import linear_sum_assignment  # takes a second to import

    rows, columns = linear_sum_assignment(worth, maximize=True)
    worthy = worth[rows, columns] > 0
    return rows[worthy], columns[worthy]


def _shared_frames(truth: np.ndarray, found: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the rows of both tables, and the overlap of each with each, in every frame that has both."""
    for frame in np.intersect1d(truth[:, 0], found[:, 0]):
        rows, columns = np.flatnonzero(truth[:, 0] == frame), np.flatnonzero(found[:, 0] == frame)
        yield rows, columns, pairwise_overlap(truth[rows, 2:6], found[columns, 2:6])


def _ratio(part, whole) -> float:
    return float(part / whole) if whole > 0 else float("nan")


def _check_overlap(min_overlap: float) -> None:
    if not 0 < min_overlap <= 1:
        raise ValueError(f"the least overlap must be above 0 and at most 1, got {min_overlap}")


def _table(rows, name: str) -> np.ndarray:
    """Return a checked table; an empty list is a table without rows."""
    table = np.asarray(rows, dtype=float)
    if table.size == 0:
        return np.empty((0, 7))
    if table.ndim != 2 or table.shape[1] != 7:
        raise ValueError(f"{name} must have shape (R, 7), got {table.shape}")
    wrong = ~np.isfinite(table[:, :6]).all(axis=1) | (table[:, 4:6] < 0).any(axis=1)
    if wrong.any():
        raise ValueError(f"{name} has a box that is not finite or has a negative side: {table[wrong][0].tolist()}")
    return table


def _tracks(rows, name: str) -> np.ndarray:
    """Return a checked table of tracks, sorted by frame and id, so that the order of its rows cannot matter."""
    table = _table(rows, name)
    if (table[:, :2] % 1 != 0).any():
        raise ValueError(f"{name} has a frame or an id that is no whole number")
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    twice = np.flatnonzero((np.diff(table[:, :2], axis=0) == 0).all(axis=1))
    if twice.size:
        frame, id = table[twice[0], :2].astype(int)
        raise ValueError(f"{name} has id {id} twice in frame {frame} (counted from 0)")
    return table
