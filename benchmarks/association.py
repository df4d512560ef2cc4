"""Trackers of many, side by side on the same detections: the library's, and the SORT, ByteTrack and OC-SORT of today.

Those three come from the package ``trackers`` (Roboflow) with the settings it publishes, but for the frame rate, which
is the film's: they wait a second for a target that is not found. Their thresholds, 0.25 for SORT, 0.6 and 0.7 for
ByteTrack and 0.6 for OC-SORT, are applied to the detections' scores as these are. They know nothing but detections;
the library's trackers look at the frames too.

``pftrack.metrics.multi_target`` scores every run. TrackEval scores it again, from overlaps of its own, and must agree.
``make bench`` runs this after ``clustering.py`` and writes ``results/association-peers.csv``, one row a run. The time
is that of a frame whose detections are there, in the mean, on one thread.
"""

import argparse
import os
import time
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", NUMBA_NUM_THREADS="1")  # before NumPy is imported

import cv2
import numpy as np
import pandas as pd
import supervision
import trackers
from tqdm import tqdm
from trackeval.datasets._base_dataset import _BaseDataset
from trackeval.metrics import CLEAR, HOTA, Identity

import pftrack
from pftrack import datasets, metrics, multi, reproduce
from pftrack.datasets import registry

FILMS = {
    "pets09-s2l1": "found",
    "tud-campus": "found",
    "bobot-J": "found",
    "caviar-walk1": "drawn",
    "synthetic-crowd": "drawn",
    "synthetic-crossing": "drawn",
    "synthetic-distractor": "drawn",
}
"""Films of several targets, and where the detections come from.

``found`` are those of the library's detector. In the other films, whose people are small or synthetic, it finds next
to nobody; there detections are ``drawn`` at random about the truth. ``published`` ones come with some films.
"""

PEERS = {"SORT": trackers.SORTTracker, "ByteTrack": trackers.ByteTrackTracker, "OC-SORT": trackers.OCSORTTracker}
"""The peers by name."""

TOLERANCE = 1e-6
"""Largest difference to TrackEval that is let pass."""

WARM_UP = 10
"""Frames that every tracker sees before it is timed, so that compiling does not count."""


# ---------------------------------------------------------------------------------------------------------------------
# Detections
# ---------------------------------------------------------------------------------------------------------------------


def detections(film: datasets.Sequence, source: str) -> np.ndarray:
    """Return the table of detections of a film that all trackers are given."""
    if source == "published":
        return film.detections
    if source == "drawn":
        return datasets.synthetic.draw_detections(film)
    store = registry.cache_folder() / "experiments" / "detection"  # that of pftrack reproduce detection
    return pftrack.detection.detect(film.frames, store=store, progress=True)


# ---------------------------------------------------------------------------------------------------------------------
# Trackers
# ---------------------------------------------------------------------------------------------------------------------


class Peer:
    """A tracker of the package ``trackers`` under the library's protocol."""

    def __init__(self, kind: type, fps: float):
        self.tracker = kind(frame_rate=fps)

    def update(self, frame, detections=None) -> list[multi.Track]:
        """Hand over corners, and take back those whom the tracker has confirmed: the others have number -1."""
        x, y, w, h, scores = np.asarray(detections, dtype=float).reshape(-1, 5).T
        found = supervision.Detections(xyxy=np.column_stack([x, y, x + w, y + h]), confidence=scores)
        known = self.tracker.update(found)
        return [
            multi.Track(int(id), np.array([left, top, right - left, bottom - top]), float(score))
            for (left, top, right, bottom), _, score, _, id, _ in known
            if id >= 0
        ]


@dataclass
class Clock:
    """A tracker, and the seconds that each of its updates took."""

    tracker: multi.MultiTracker
    seconds: list[float] = field(default_factory=list)

    def update(self, frame, detections=None) -> list[multi.Track]:
        """Update the tracker and note the time."""
        begin = time.perf_counter()
        tracks = self.tracker.update(frame, detections)
        self.seconds.append(time.perf_counter() - begin)
        return tracks


def contenders(fps: float, n_seeds: int) -> list[tuple[str, int | None, multi.MultiTracker]]:
    """List name, seed and a new tracker; the peers draw no random numbers."""
    peers = [(name, None, Peer(kind, fps)) for name, kind in PEERS.items()]
    ours = [(name, n, kind(seed=n)) for name, kind in multi.MULTI_TRACKERS.items() for n in range(n_seeds)]
    return peers + ours


# ---------------------------------------------------------------------------------------------------------------------
# The other opinion
# ---------------------------------------------------------------------------------------------------------------------


def trackeval(tracks: np.ndarray, truth: np.ndarray, n_frames: int) -> dict[str, float]:
    """Score tracks by TrackEval, under the names that the measures have in the library."""
    tables = {"gt": truth, "tracker": tracks}
    numbers = {side: np.unique(table[:, 1], return_inverse=True) for side, table in tables.items()}
    data = {"num_timesteps": n_frames, "similarity_scores": []}
    for side, table in tables.items():
        data |= {f"num_{side}_dets": len(table), f"num_{side}_ids": len(numbers[side][0])}
        data[f"{side}_ids"] = [numbers[side][1][table[:, 0] == t] for t in range(n_frames)]
    for t in range(n_frames):
        boxes = [table[table[:, 0] == t, 2:6] for table in (truth, tracks)]
        data["similarity_scores"].append(_BaseDataset._calculate_box_ious(*boxes, box_format="xywh"))
    clear, identity = (kind({"PRINT_CONFIG": False}).eval_sequence(data) for kind in (CLEAR, Identity))
    hota = HOTA().eval_sequence(data)
    return {
        "misses": clear["CLR_FN"],
        "false_positives": clear["CLR_FP"],
        "switches": clear["IDSW"],
        "fragments": clear["Frag"],
        "mostly_tracked": clear["MT"],
        "partly_tracked": clear["PT"],
        "mostly_lost": clear["ML"],
        "mota": clear["MOTA"],
        "motp": clear["MOTP"],
        "idf1": identity["IDF1"],
        "id_precision": identity["IDP"],
        "id_recall": identity["IDR"],
        **{name.lower(): np.mean(hota[name]) for name in ("HOTA", "DetA", "AssA")},
    }


def score(tracks: np.ndarray, truth: np.ndarray, n_frames: int) -> dict[str, float]:
    """Score tracks by the library, and stop if TrackEval is of another opinion."""
    ours = metrics.multi_target(tracks, truth).as_dict()
    for name, theirs in trackeval(tracks, truth, n_frames).items():
        if abs(np.nan_to_num(ours[name]) - theirs) > TOLERANCE:  # what is undefined TrackEval calls 0
            raise AssertionError(f"{name}: {ours[name]} by pftrack, {theirs} by TrackEval")
    return ours


# ---------------------------------------------------------------------------------------------------------------------
# The table
# ---------------------------------------------------------------------------------------------------------------------


def main(path: Path, films: list[str], n_seeds: int, published: bool) -> None:
    """Run all trackers on all films, print the table, in the mean over seeds, and write it."""
    jobs = []
    for name in films:
        film = datasets.load(name)
        sources = [FILMS[name]] + ["published"] * (published and film.detections is not None)
        jobs += [(film, source, detections(film, source)) for source in sources]
    cv2.setNumThreads(1)
    film, _, found = jobs[0]
    for _, _, tracker in contenders(film.fps, 1):
        list(multi.follow(tracker, film.frames[:WARM_UP], found))
    rows = []
    for film, source, found in jobs:
        about = {"film": film.name, "detections": source}
        for name, seed, tracker in tqdm(contenders(film.fps, n_seeds), desc=f"{film.name}, {source}", unit="run"):
            clock = Clock(tracker)
            tracks = multi.table(multi.follow(clock, film.frames, found))
            measures = score(tracks, film.tracks, len(film))
            rows.append(about | {"tracker": name, "seed": seed} | measures | {"ms": 1e3 * np.mean(clock.seconds)})
    table = pd.DataFrame(rows).astype({"seed": "Int64"})
    reproduce.write(path, table, threads=1, **{name: version(name) for name in ("trackers", "trackeval")})
    shown = ["hota", "deta", "assa", "idf1", "mota", "motp", "switches", "false_positives", "misses", "ms"]
    means = table.groupby(["film", "detections", "tracker"], sort=False)[shown].mean()
    print(means.to_string(float_format="{:.3f}".format))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("results/association-peers.csv"))
    parser.add_argument("--films", nargs="+", choices=FILMS, default=list(FILMS), help="films to run on (all)")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each of the library's trackers (1)")
    parser.add_argument("--published", action="store_true", help="also on the detections that come with a film")
    arguments = parser.parse_args()
    main(arguments.output, arguments.films, arguments.seeds, arguments.published)
