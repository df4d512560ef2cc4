"""The comparison of Li et al. 2016, section 5.1, and of Li et al. 2012: superpixel tracking, boosted and their filters.

All start from the same: those pedestrians who are seen in all of the first five frames, with their true boxes there,
which the boosted particle filter gets as detections. From then on those that need detections get the same table of what
the library's detector found; the boosted particle filter runs a second time with its own, AdaBoost.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from pftrack import datasets, detection, metrics, multi
from pftrack.adaboost import AdaBoostDetector
from pftrack.datasets.readers import boxes_of
from pftrack.reproduce.crowd import N_PRINTED
from pftrack.reproduce.many import AFTER, N_TRAINING, seen_in_training, swapped
from pftrack.reproduce.plan import Plan
from pftrack.trackers import SuperpixelTracker

PRINTED = {
    "Table 3": {
        "superpixel": (33.4929, 29.9134, 17.2689),
        "boosted-pf": (35.1872, 15.3953, 29.447),
        "association-pf": (8.2831, 6.187, 7.3893),
    },
    "Table 4": {
        "superpixel": (51.0719, 15.6293, 23.0312, 5.2422, 14.0239),
        "boosted-pf": (48.0748, 7.1292, 3.4245, 3.4314, 3.0628),
        "association-pf": (8.3892, 6.3603, 10.3213, 4.2821, 3.1802),
    },
    "Table 5": {
        "superpixel": (10.8409, 16.5392, 12.8657),
        "boosted-pf": (5.9901, 18.5687, 18.086),
        "association-pf": (6.0895, 7.8006, 4.0837),
    },
}
"""What Li et al. 2016 print for pedestrians 1, 2, ... of their sequences 1 to 3, whose frames are 800x450, 384x288 and
800x450: average centre errors in pixels. (Table 3 of Li et al. 2012 is lost from its text.)"""


class SuperpixelTrackers:
    """Superpixel tracking for several people, each for itself, under the protocol of the trackers of many."""

    def __init__(self, seed: int = 0):
        self.seed = seed

    def init(self, frames, boxes) -> None:
        """Learn targets that are known, from frames and their boxes, shape (M, K, 4)."""
        self.trackers = [SuperpixelTracker(seed=self.seed) for _ in range(boxes.shape[1])]
        for n, tracker in enumerate(self.trackers):
            tracker.init_from(frames, boxes[:, n])

    def update(self, frame: np.ndarray, detections=None) -> list[multi.Track]:
        """Follow all targets into the next frame; detections are not looked at."""
        estimates = [tracker.update(frame) for tracker in self.trackers]
        return [multi.Track(n, estimate.box, estimate.score) for n, estimate in enumerate(estimates, start=1)]


TRACKERS = {
    "superpixel": (SuperpixelTrackers, {}, None),
    "boosted-pf": (multi.BoostedParticleFilter, {}, "HOG"),
    "boosted-pf (AdaBoost)": (multi.BoostedParticleFilter, {}, "AdaBoost"),
    "bof-pf": (multi.BagOfFeaturesParticleFilter, {}, None),
    "association-pf": (multi.AssociationParticleFilter, {}, "HOG"),
    "association-pf (as printed)": (multi.AssociationParticleFilter, {"as_printed": True}, "HOG"),
}
"""What is compared. Each name stands for a class, its settings and whose detections it gets after the training."""

DIMMED = 0.6
"""Share of the light that is gone by the last frame of the first film, when it is shown a second time."""

DRAWN = "synthetic-dusk"
"""The scene that ends the comparison. The detector finds nobody in it, so detections are drawn at random."""

AT_MOST = {"pets09-s2l1": 210}
"""Most frames of a film that are used. The sequence that Li et al. 2016 took from PETS has as many."""

CERTAIN = 5.0
"""Score of true boxes that are given as detections. The detector is as sure of its best."""


def comparison(plan: Plan) -> list[Path]:
    """Tables 3 to 5 of Li et al. 2016, and 3 of 2012, for our footage: the average centre errors of all trackers.

    ``comparison.csv`` has one row for each tracker, sequence, target and seed, with the measures of :func:`score`.
    """
    seeds = range(min(plan.n_runs, 10))
    versions = [*((id, 0.0) for id in plan.followed), (plan.followed[0], DIMMED), (DRAWN, 0.0)]
    cascades = plan.each(_adaboost, [(*version, AT_MOST.get(version[0])) for version in versions])
    films = zip(versions, cascades, strict=True)
    table = pd.concat([_compare(plan, *version, cascade, seeds) for version, cascade in films])
    about = {"sequence": ", ".join(table["sequence"].unique()), "seeds": len(seeds), "training": N_TRAINING}
    return [plan.write("comparison.csv", table, **about, illumination=DIMMED, at_most=AT_MOST)]


def _adaboost(library: str, id: str, illumination: float, n_frames: int | None) -> np.ndarray:
    """Return the table of what AdaBoost finds; it remembers nothing, so that every seed would see the same."""
    detector = AdaBoostDetector()
    found = [detector.detect(frame) for frame in _load(id, illumination).frames[:n_frames]]
    return np.array([[t, -1, *row] for t, rows in enumerate(found) for row in rows]).reshape(-1, 7)


def _compare(plan: Plan, id: str, illumination: float, cascade: np.ndarray, seeds) -> pd.DataFrame:
    """Let all trackers follow the same targets of a film, and score the track of each."""
    film = _load(id, illumination, plan.progress)
    targets, truth = seen_in_training(film, N_TRAINING, AT_MOST.get(id))
    if id == DRAWN:
        found = datasets.synthetic.draw_detections(film)
    else:
        found = detection.detect(film.frames, store=plan.folder / "detection", progress=plan.progress)
    about = (id, illumination, len(truth), truth[:N_TRAINING], CERTAIN)
    tasks = [
        (name, settings, *about, {"HOG": found, "AdaBoost": cascade}.get(whose), seed)
        for name, (_, settings, whose) in TRACKERS.items()
        for seed in (seeds[:N_PRINTED] if settings else seeds)
    ]
    rows = []
    for (name, *_, seed), tracks in zip(tasks, plan.each(_follow, tasks), strict=True):
        ids = metrics.match_targets(tracks, film.tracks, N_TRAINING - 1)
        for n, target in enumerate(targets):
            track = np.full((len(truth), 4), np.nan)
            if target in ids:
                track = boxes_of(tracks, ids[target], len(truth))
            run = {"tracker": name, "sequence": film.name, "target": target, "seed": seed}
            rows.append(run | score(track, n, truth, N_TRAINING, AFTER))
    return pd.DataFrame(rows)


def _load(id: str, illumination: float, progress: bool = False) -> datasets.Sequence:
    film = datasets.load(id, progress)
    return film.dimmed(illumination) if illumination else film


def _follow(
    library: str, name: str, settings: dict, id: str, illumination: float, n_frames: int, known, certain, found, seed
) -> np.ndarray:
    """Show a tracker the targets in the training frames, and let it follow them; return the table of tracks."""
    frames = _load(id, illumination).frames[:n_frames]
    tracker = TRACKERS[name][0](seed=seed, **settings)
    n_training = len(known)
    first = [[multi.Track(n, box, certain) for n, box in enumerate(boxes, start=1)] for boxes in known]
    if hasattr(tracker, "init"):
        tracker.init(list(frames[:n_training]), known)
    else:
        first = multi.follow(tracker, frames[:n_training], multi.table(first))
    if found is not None:
        found = found - [n_training, 0, 0, 0, 0, 0, 0]  # the frames after the training are counted from 0
    return multi.table([*first, *multi.follow(tracker, frames[n_training:], found)])


def score(track: np.ndarray, which: int, truth: np.ndarray, begin: int, n_last: int) -> dict[str, float]:
    """Score how one target was followed, over the frames in which it is seen.

    Parameters
    ----------
    track : ndarray, shape (T, 4)
        Boxes of the track that was the target's in the last training frame; NaN where it has none.
    which : int
        Which of the targets it is, from 0.
    truth : ndarray, shape (T, K, 4)
        Boxes of all targets, NaN where they are hidden.
    begin : int
        The first frame after the training frames.
    n_last : int
        Of how many last frames :func:`~pftrack.reproduce.many.swapped` asks.

    Returns
    -------
    dict of str to float
        ``center_error``, eqs 12 and 13: the mean distance of the centres. (The paper calls it a root mean square, but
        it is none.) Where the track has no box, because it has ended or hides, or the target goes on under another
        number, its last one is kept, so that a lost person costs what a held state costs; a track that never was has
        the true box of the last training frame. ``frames``, in how many the target is seen; ``reported`` and ``right``,
        the shares of them in which the track has a box, and one that overlaps with the truth by half; and ``swapped``,
        by the boxes that it has.

    Examples
    --------
    Somebody walks to the right, two pixels a frame, and the track ends after the first step:

    >>> truth = np.array([[[x, 0.0, 10.0, 20.0]] for x in (0, 2, 4, 6)])
    >>> track = truth[:, 0].copy()
    >>> track[2:] = np.nan
    >>> found = score(track, 0, truth, begin=1, n_last=20)
    >>> found["center_error"], found["frames"], found["swapped"]
    (2.0, 3, 0.0)
    """
    boxes = truth[:, which]
    seen = np.isfinite(boxes[:, 0]) & (np.arange(len(boxes)) >= begin)
    kept = pd.DataFrame(track)
    kept.iloc[begin - 1] = kept.iloc[begin - 1].fillna(pd.Series(boxes[begin - 1]))
    return {
        "center_error": float(metrics.center_error(kept.ffill(), boxes)[seen].mean()),
        "frames": int(seen.sum()),
        "reported": float(np.isfinite(track[seen, 0]).mean()),
        "right": float((metrics.overlap(track, boxes)[seen] >= 0.5).mean()),
        "swapped": swapped(np.where(seen[:, None], track, np.nan), which, truth, n_last),
    }
