"""Many pedestrians: Figures 3 and 4 of Li et al. 2012 as numbers."""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from tqdm.auto import tqdm

from pftrack import datasets, metrics
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
