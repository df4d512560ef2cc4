"""Many pedestrians: the detector and the bag-of-features particle filter of Li et al. 2012 as numbers."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import joblib
import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from pftrack import datasets, metrics, multi
from pftrack.datasets.readers import boxes_of
from pftrack.detection import PedestrianDetector, detect
from pftrack.experiments import LIBRARY
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
    tasks = [({}, id, seed, known, None) for known in (True, False) for id in plan.followed for seed in seeds]
    ablated = [
        (settings, id, seed, True, AT_MOST) for _, settings in bof_steps() for id in plan.followed for seed in seeds
    ]
    rows = _followed(plan, tasks + ablated)
    whole = pd.concat(rows[: len(tasks)], ignore_index=True)
    parts = []
    for n, (name, _) in enumerate(bof_steps()):
        begin = len(tasks) + n * len(plan.followed) * len(seeds)
        step = pd.concat(rows[begin : begin + len(plan.followed) * len(seeds)])
        for id, of_sequence in step.groupby("sequence", sort=False):
            runs = of_sequence.groupby("seed").agg({"center_error": "mean", "swapped": "max"})
            errors = runs["center_error"]
            parts.append([name, id, errors.mean(), errors.std(ddof=1), int(runs["swapped"].sum()), len(runs)])
    columns = ["setting", "sequence", "center_error_mean", "center_error_sd", "swaps", "runs"]
    about = {"sequence": " ".join(plan.followed), "seeds": len(seeds), "training": N_TRAINING}
    return [
        plan.write("bof.csv", whole, **about),
        plan.write("bof-ablation.csv", pd.DataFrame(parts, columns=columns), **about, at_most=AT_MOST),
    ]


def _followed(plan: Plan, tasks) -> list[pd.DataFrame]:
    """Do the runs, taking from the store what is there."""
    memory = joblib.Memory(plan.folder / "many", verbose=0)
    run = joblib.delayed(memory.cache(_follow))
    parallel = joblib.Parallel(-1 if plan.n_jobs is None else plan.n_jobs, return_as="generator")
    done = parallel(run(LIBRARY, *task) for task in tasks)
    return list(tqdm(done, total=len(tasks), unit="run", disable=not plan.progress))


def _follow(library: str, settings: dict, id: str, seed: int, known: bool, at_most: int | None) -> pd.DataFrame:
    """Follow the targets of a sequence that are seen in all training frames, and score each."""
    film = datasets.load(id, progress=False)
    n_frames = min(len(film), at_most or len(film))
    in_training = [set(film.tracks[film.tracks[:, 0] == t, 1].astype(int)) for t in range(N_TRAINING)]
    targets = [target for target in film.ids if all(target in seen for seen in in_training)]
    truth = {target: boxes_of(film.tracks, target, len(film))[:n_frames] for target in targets}
    ends = max(int(np.flatnonzero(np.isfinite(boxes[:, 0]))[-1]) for boxes in truth.values()) + 1
    frames = film.frames[:ends]
    tracker = multi.BagOfFeaturesParticleFilter(seed=seed, n_training=N_TRAINING, **settings)
    if known:
        first = frames[:N_TRAINING]
        tracker.init(list(first), np.stack([truth[target][:N_TRAINING] for target in targets], axis=1))
        found = multi.table([*[[]] * N_TRAINING, *multi.follow(tracker, frames[N_TRAINING:])])
        ids = {target: n for n, target in enumerate(targets, start=1)}
    else:
        found = multi.table(multi.follow(tracker, frames))
        ids = metrics.match_targets(found, film.tracks, N_TRAINING - 1)
        ids = {target: ids[target] for target in targets if target in ids}
    middles = {target: _centers(truth[target][:ends]) for target in targets}
    rows = []
    for target in targets:
        error, n_compared, swapped = np.nan, 0, np.nan
        if target in ids:
            center = _centers(boxes_of(found, ids[target], ends))
            distances = np.linalg.norm(center - np.array([middles[each] for each in targets]), axis=2)
            own = distances[targets.index(target)]
            compared = np.isfinite(own)
            error, n_compared = own[compared].mean(), compared.sum()
            late = np.flatnonzero(compared)[-AFTER:]
            nearest = np.nan_to_num(distances[:, late], nan=np.inf).mean(axis=1).argmin()
            swapped = float(nearest != targets.index(target))
        rows.append([id, target, seed, known, error, n_compared, swapped])
    return pd.DataFrame(rows, columns=["sequence", "target", "seed", "known", "center_error", "frames", "swapped"])


def _centers(boxes) -> np.ndarray:
    return boxes[:, :2] + boxes[:, 2:] / 2
