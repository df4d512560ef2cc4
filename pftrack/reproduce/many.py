"""Many pedestrians: the detector and the bag-of-features particle filter of Li et al. 2012 as numbers."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from pftrack import datasets, metrics, multi
from pftrack.datasets.readers import boxes_of
from pftrack.detection import PedestrianDetector, detect
from pftrack.reproduce.plan import Plan

PLAIN = {"trimmed": False, "weighted": False, "min_windows": 1, "min_foreground": 0.0, "size_prior": False}
"""Settings of a detector that believes each of HOG's windows, but for those that overlap with a better one."""

REFINEMENTS = (
    ("trimmed", "trimmed"),
    ("weighted mean", "weighted"),
    ("two windows", "min_windows"),
    ("moving", "min_foreground"),
    ("size prior", "size_prior"),
)
"""What chapter 8 adds to the plain detector, in this order, and the setting that each step returns to its default."""

EVERY = 16
"""One frame in so many is timed."""


def detectors() -> list[tuple[str, dict[str, object]]]:
    """List the rows of :func:`detection`: what each says, and the settings that differ from the default.

    Examples
    --------
    >>> [name for name, settings in detectors() if settings.get("background") == "none"]
    ['plain', '+ trimmed', '+ weighted mean', '+ two windows', '+ moving', '+ size prior']
    """
    rows = []
    for background in ({"background": "none"}, {}):
        left_out = dict(PLAIN)
        rows.append(("plain", background | left_out))
        for name, setting in REFINEMENTS:
            left_out = {each: value for each, value in left_out.items() if each != setting}
            rows.append((f"+ {name}", background | left_out))
    others = [{"background": "mog2"}, {"background": "difference"}, {"scale": 1.5}]
    return rows + [("+ size prior", settings) for settings in others]


def detection(plan: Plan) -> list[Path]:
    """Figures 3 and 4 of Li et al. 2012: HOG on whole frames and on motion regions, and what each refinement is worth.

    ``detection.csv`` has one row for each detector, with recall, precision and mean overlap over all frames and all
    true boxes of the crowd, and the time of one core that a frame takes, from the raw frame to HOG's windows.
    """
    film = datasets.load(plan.crowd)
    rows = []
    for name, settings in detectors():
        detector = PedestrianDetector(**settings)
        about = {"detector": name, "background": detector.motion.method, "scale": detector.scale}
        found = detect(film.frames, detector, store=plan.folder / "detection", progress=plan.progress)
        score = metrics.detections(found, film.tracks)
        rows.append(about | {each: getattr(score, each) for each in ("n_found", "recall", "precision", "overlap")})
    table = pd.DataFrame(rows)
    kinds = list(dict.fromkeys(zip(table["background"], table["scale"], strict=True)))
    spent = dict(zip(kinds, _times(film.frames, kinds, plan.progress), strict=True))
    table["ms"] = [spent[kind] for kind in zip(table["background"], table["scale"], strict=True)]
    return [plan.write("detection.csv", table, sequence=plan.crowd, boxes=len(film.tracks), timed=f"every {EVERY}th")]


def _times(frames, kinds, progress: bool) -> list[float]:
    """Measure milliseconds of one core from a frame to HOG's windows; in every frame that is timed, all take turns."""
    detectors = [PedestrianDetector(background, scale=scale) for background, scale in kinds]
    spent = np.zeros((0, len(kinds)))
    n_threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for t, frame in enumerate(tqdm(frames, unit="frame", disable=not progress)):
            if t % EVERY < EVERY - 1:  # the background must be learnt from every frame
                for detector in detectors:
                    detector.motion(frame)
                continue
            row = []
            for detector in detectors:
                start = time.process_time()
                detector.propose(frame)
                row.append((time.process_time() - start) * 1000)
            spent = np.vstack([spent, row])
    finally:
        cv2.setNumThreads(n_threads)
    return spent.mean(axis=0).tolist()


N_TRAINING = 5
"""Training frames of the bag-of-features filter; the targets that are followed are those seen in all of them."""

AT_MOST = 160
"""Frames of a sequence of which the ablation uses no more; on `bobot-J` they hold the first crossing."""

AFTER = 20
"""Last frames in which it is asked whether two targets have changed their names."""

LITERAL = {
    "n_bands": 1,
    "discriminative": False,
    "mutual_occlusion": False,
    "follow_camera": False,
    "learn": "codebook",
}
"""Settings that make the bag-of-features filter that of the paper, as far as its text tells; what remains is that the
candidates share a segmentation, and that a patch may be like no word."""

ADDITIONS = (
    ("learning bags", "learn"),
    ("bands", "n_bands"),
    ("worth of words", "discriminative"),
    ("mutual occlusion", "mutual_occlusion"),
    ("camera", "follow_camera"),
)
"""What we added to the paper's filter, in this order, and the setting that each step returns to its default."""


def bof_steps() -> list[tuple[str, dict[str, object]]]:
    """List the rows of :func:`bof`'s ablation: what each says, and the settings that differ from the default.

    Examples
    --------
    >>> [name for name, _ in bof_steps()][:3]
    ['the paper', '+ learning bags', '+ bands']
    """
    left_out = dict(LITERAL)
    rows = [("the paper", dict(left_out))]
    for name, setting in ADDITIONS:
        left_out = {each: value for each, value in left_out.items() if each != setting}
        rows.append((f"+ {name}", left_out))
    rows += [("colour alone", {"features": "color"}), ("texture alone", {"features": "texture"})]
    rows += [("weights fixed", {"adapt_weights": False}), ("nothing learnt", {"learn": "nothing"})]
    return rows


def bof(plan: Plan) -> list[Path]:
    """Tables 1 to 3 of Li et al. 2012 for our footage: the centre errors of the bag-of-features filter.

    ``bof.csv`` has one row for each sequence, target and seed: once with the targets known in the training frames
    (``known``), and once with those that the detector found. ``bof-ablation.csv`` has one row for each setting and
    sequence, over the first 160 frames, with the targets known: mean and standard deviation over seeds of the mean
    error over targets, and in how many runs two targets changed their names. Errors are in pixels.
    """
    seeds = range(min(plan.n_runs, 10))
    runs = [({}, id, seed, known, None) for known in (True, False) for id in plan.followed for seed in seeds]
    ablated = [
        (settings, id, seed, True, AT_MOST) for _, settings in bof_steps() for id in plan.followed for seed in seeds
    ]
    rows = _followed(plan, runs + ablated)
    whole = pd.concat(rows[: len(runs)], ignore_index=True)
    parts = []
    for n, (name, _) in enumerate(bof_steps()):
        begin = len(runs) + n * len(plan.followed) * len(seeds)
        step = pd.concat(rows[begin : begin + len(plan.followed) * len(seeds)])
        for id, of_sequence in step.groupby("sequence", sort=False):
            by_seed = of_sequence.groupby("seed").agg({"center_error": "mean", "swapped": "max"})
            errors = by_seed["center_error"]
            parts.append([name, id, errors.mean(), errors.std(ddof=1), int(by_seed["swapped"].sum()), len(by_seed)])
    columns = ["setting", "sequence", "center_error_mean", "center_error_sd", "swaps", "runs"]
    about = {"sequence": " ".join(plan.followed), "seeds": len(seeds), "training": N_TRAINING}
    return [
        plan.write("bof.csv", whole, **about),
        plan.write("bof-ablation.csv", pd.DataFrame(parts, columns=columns), **about, at_most=AT_MOST),
    ]


def _followed(plan: Plan, runs) -> list[pd.DataFrame]:
    """Do the runs, taking from the store what is there, and score each target of each."""
    films = {id: datasets.load(id, plan.progress) for id in plan.followed}
    casts = {(id, n): seen_in_training(films[id], N_TRAINING, n) for id in films for n in (None, AT_MOST)}
    tasks = []
    for settings, id, seed, known, at_most in runs:
        _, truth = casts[id, at_most]
        given = truth[:N_TRAINING] if known else None
        tasks.append(({"n_training": N_TRAINING} | settings, id, len(truth), given, seed))
    found = plan.each(_follow, tasks)
    return [
        _score(tracks, *casts[id, at_most], films[id], {"sequence": id, "seed": seed, "known": known})
        for tracks, (_, id, seed, known, at_most) in zip(found, runs, strict=True)
    ]


def _follow(library: str, settings: dict, id: str, n_frames: int, known, seed: int) -> np.ndarray:
    """Follow the targets of a sequence, known or found in the training frames; return the table of tracks."""
    frames = datasets.load(id, progress=False).frames[:n_frames]
    tracker = multi.BagOfFeaturesParticleFilter(seed=seed, **settings)
    if known is None:
        return multi.table(multi.follow(tracker, frames))
    n_training = len(known)
    tracker.init(list(frames[:n_training]), known)
    return multi.table([*[[]] * n_training, *multi.follow(tracker, frames[n_training:])])


def _score(tracks, targets: list[int], truth, film: datasets.Sequence, about: dict) -> pd.DataFrame:
    if about["known"]:
        ids = {target: n for n, target in enumerate(targets, start=1)}
    else:
        ids = metrics.match_targets(tracks, film.tracks, N_TRAINING - 1)
    rows = []
    for n, target in enumerate(targets):
        error, n_compared, is_swapped = np.nan, 0, np.nan
        if target in ids:
            track = boxes_of(tracks, ids[target], len(truth))
            errors = metrics.center_error(track, truth[:, n])
            error, n_compared = np.nanmean(errors), np.isfinite(errors).sum()
            is_swapped = swapped(track, n, truth, AFTER)
        measures = {"center_error": error, "frames": n_compared, "swapped": is_swapped}
        rows.append(about | {"target": target} | measures)
    return pd.DataFrame(rows)[["sequence", "target", "seed", "known", *measures]]


def seen_in_training(
    film: datasets.Sequence, n_training: int, at_most: int | None = None
) -> tuple[list[int], np.ndarray]:
    """Find the targets that are seen in all training frames.

    Parameters
    ----------
    film : Sequence
        The sequence.
    n_training : int
        How many training frames there are.
    at_most : int, optional
        Frames of the sequence to use; all if not given.

    Returns
    -------
    targets : list of int
        Their ids.
    truth : ndarray, shape (T, K, 4)
        Their boxes, NaN where they are hidden, up to the frame in which the last of them is seen last.
    """
    truth = {target: film.target(target)[:at_most] for target in film.ids}
    targets = [target for target, boxes in truth.items() if np.isfinite(boxes[:n_training]).all()]
    boxes = np.stack([truth[target] for target in targets], axis=1)
    end = np.flatnonzero(np.isfinite(boxes).any(axis=(1, 2)))[-1] + 1
    return targets, boxes[:end]


def swapped(track, which: int, truth: np.ndarray, n_last: int) -> float:
    """Tell whether a track has ended up with another than its target.

    Parameters
    ----------
    track : array_like, shape (T, 4)
        Boxes of the track, NaN where there is none.
    which : int
        Whom of the targets it should follow, from 0.
    truth : ndarray, shape (T, K, 4)
        Boxes of all targets, NaN where they are hidden.
    n_last : int
        In how many of the last frames that show both target and track the centres are compared.

    Returns
    -------
    float
        1 if another target was nearer, in the mean; 0 if not; NaN if no frame shows both target and track.

    Examples
    --------
    Two walk towards each other, and the track turns round with the first half-way:

    >>> one = np.array([[x, 0.0, 10.0, 20.0] for x in (0, 20, 40, 60, 80)])
    >>> truth, track = np.stack([one, one[::-1]], axis=1), one[[0, 1, 2, 1, 0]]
    >>> swapped(track, 0, truth, n_last=2), swapped(track, 0, truth, n_last=5)
    (1.0, 0.0)
    """
    distances = np.array([metrics.center_error(track, boxes) for boxes in truth.swapaxes(0, 1)])
    late = np.flatnonzero(np.isfinite(distances[which]))[-n_last:]
    if not len(late):
        return float("nan")
    return float(np.nan_to_num(distances[:, late], nan=np.inf).mean(axis=1).argmin() != which)
