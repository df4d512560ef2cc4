"""Side by side: how long trackers and particle filters take, all in one process, on one thread.

Contenders take turns, block by block, so that whatever else the machine does falls on all of them alike; the fastest
of a contender's blocks is what it can do. Ratios of these minima travel from machine to machine, milliseconds do not.
``make bench`` runs this in an environment of its own and writes ``results/speed.csv``; chapter 7 shows the table.
"""

import argparse
import os
import platform
import time
from datetime import date
from pathlib import Path

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", NUMBA_NUM_THREADS="1")  # before NumPy is imported

import cv2
import numpy as np
import pandas as pd
from filters import growth_filters, resamplers
from opencv import CamShift, CamShiftInWindow, CamShiftPutBack, NaiveParticleFilter, OpenCVTracker
from tqdm import tqdm

import pftrack
from pftrack import color, kernels, reproduce, texture

N_BLOCKS = 25
"""Blocks of each contender, after one that is not counted."""

NOISE = np.array([4.0, 4.0, 1.0, 1.0, 0.02])
"""Noise of the colour particle filters: pixels, pixels a frame, and scale."""

TARGETS = {
    "320x240, 30x80": (150, 100, 30, 80),
    "320x240, 60x160": (140, 40, 60, 160),
    "768x576, 30x80": (360, 240, 30, 80),
    "768x576, 60x160": (350, 200, 60, 160),
}
"""Size of the frame, size of the target: where it is in the first frame.

What they show is mostly road and lawn: stand-ins for people of these sizes, of whom the small frames have none.
"""


def race(contenders: dict, n_blocks: int = N_BLOCKS, title: str = "") -> dict[str, float]:
    """Let contenders take turns; each is a function that does one block and returns its seconds."""
    seconds = {name: [] for name in contenders}
    for _ in tqdm(range(n_blocks + 1), desc=title, unit="block"):
        for name, block in contenders.items():
            seconds[name].append(block())
    return {name: min(times[1:]) for name, times in seconds.items()}


def following(tracker, frames: list, box):
    """Return a block: start a tracker on the first frame, then follow; seconds a frame of the following alone."""

    def block() -> float:
        tracker.init(frames[0], box)
        begin = time.perf_counter()
        for frame in frames[1:]:
            tracker.update(frame)
        return (time.perf_counter() - begin) / (len(frames) - 1)

    return block


def repeating(function, n: int):
    """Return a block: call a function `n` times; seconds a call."""

    def block() -> float:
        begin = time.perf_counter()
        for _ in range(n):
            function()
        return (time.perf_counter() - begin) / n

    return block


def trackers(box) -> dict[str, object]:
    """All single-target trackers, by the name they have in the table."""
    noise = NOISE / [box[2], box[2], box[2], box[2], 1.0]
    contenders = {
        "CAMSHIFT": CamShift(),
        "CAMSHIFT, window put back": CamShiftPutBack(),
        "CAMSHIFT, padded window only": CamShiftInWindow(),
        "naive PF, N = 100": NaiveParticleFilter(100, NOISE),
    }
    for n in (100, 1000, 10_000):
        contenders[f"color-pf, N = {n}"] = pftrack.ColorParticleFilter(n, seed=0, noise=noise, lost_distance=1.0)
    contenders["color-pf, N = 100, lost"] = pftrack.ColorParticleFilter(100, seed=0, lost_distance=0.0)
    for n in (100, 1000, 10_000):
        contenders[f"robust-pf, N = {n}"] = pftrack.RobustParticleFilter(n, seed=0)
    return contenders | {f"OpenCV {name}": OpenCVTracker(name) for name in ("MOSSE", "KCF", "CSRT", "MIL")}


def histograms_of_six(frame, n_particles: int = 300):
    """Weigh the particles of six pedestrians by colour and by texture (Li et al. 2016), from a frame as it comes."""
    rng = np.random.default_rng(0)
    boxes = np.array([[x, y, 30, 80] for x in (100, 360, 600) for y in (150, 350)], dtype=float)
    kinds = color.hsv_bins, texture.pattern_bins
    palettes = [[kernels.palette(color.histograms(bins(frame), [box])) for bins in kinds] for box in boxes]
    clouds = [color.pixel_edges(box + rng.normal(0, [4, 4, 1, 2], (n_particles, 4))) for box in boxes]

    def weigh():
        for cloud, palette in zip(clouds, palettes, strict=True):
            left, top, right, bottom = kernels.cover(cloud, *frame.shape[:2])
            part = frame[top:bottom, left:right]
            for bins, colors in zip(kinds, palette, strict=True):
                kernels.similarities(bins(part), cloud, colors, origin=(left, top))

    return weigh


def main(path: Path, n_blocks: int) -> None:
    """Run all races, print the table and write it."""
    cv2.setNumThreads(1)
    sequence = pftrack.datasets.load("pets09-s2l1")
    full = [sequence.frames[t] for t in range(100, 120)]
    frames = {
        "768x576": full,
        "320x240": [cv2.resize(frame, (320, 240), interpolation=cv2.INTER_AREA) for frame in full],
    }
    rows = []

    def report(group: str, setting: str, seconds: dict[str, float], errors=None) -> None:
        unit = next(iter(seconds.values()))  # that of the first contender
        for name, best in seconds.items():
            rows.append([group, setting, name, best * 1e3, best / unit, errors and errors[name]])

    for setting, box in TARGETS.items():
        clip = frames[setting.split(",")[0]]
        blocks = {name: following(tracker, clip, box) for name, tracker in trackers(box).items()}
        report("tracker", setting, race(blocks, n_blocks, setting))
    blocks = {
        "CAMSHIFT": following(CamShift(), full, TARGETS["768x576, 30x80"]),
        "colour and LBP histograms": repeating(histograms_of_six(full[0]), 10),
    }
    report("histograms", "768x576, 6 targets x 300 particles", race(blocks, n_blocks, "histograms"))
    for n in (100, 1000, 10_000):
        for scheme, contenders in resamplers(n).items():
            blocks = {name: repeating(function, 5) for name, function in contenders.items()}
            report("resampling", f"{scheme}, N = {n}", race(blocks, n_blocks, f"{scheme}, N = {n}"))
    contenders, errors = growth_filters(n_particles=1000, n_steps=100)
    blocks = {name: repeating(function, 1) for name, function in contenders.items()}
    report("filter", "growth model, T = 100, N = 1000", race(blocks, n_blocks, "growth model"), errors)

    table = pd.DataFrame(rows, columns=["group", "setting", "contender", "ms", "ratio", "rmse"])
    about = {"date": date.today().isoformat(), "system": platform.system(), "threads": 1, "blocks": n_blocks}
    reproduce.write(path, table.round({"ms": 5, "ratio": 4, "rmse": 4}), **about)
    print(table.to_string(index=False, float_format="{:.3f}".format, na_rep=""))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("results/speed.csv"))
    parser.add_argument("--blocks", type=int, default=N_BLOCKS, help=f"blocks of each contender ({N_BLOCKS})")
    arguments = parser.parse_args()
    main(arguments.output, arguments.blocks)
