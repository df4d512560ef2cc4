"""Mean-Shift side by side: the library's, all points at once, and scikit-learn's, on patches of real pedestrians.

The clusters must be equal. ``make bench`` runs this after ``speed.py`` and writes ``results/clustering.csv``.
"""

import argparse
import os
import time
from pathlib import Path

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")  # before NumPy is imported

import numpy as np
import pandas as pd
from sklearn.cluster import MeanShift
from tqdm import tqdm

import pftrack
from pftrack import codebook, patches, reproduce, superpixels

FILMS = {"bobot-J": 1, "pets09-s2l1": 9}
"""Films, and the target in each whose patches are clustered."""

BANDWIDTHS = {"colour": (0.18, 0.3), "texture": (0.08, 0.12)}
"""Bandwidths that are tried."""

N_FRAMES = 5
"""Training frames."""

N_PASSES = 5
"""Passes of the library's clustering; scikit-learn's takes long enough for one."""


def training_patches(film: str, target: int) -> dict[str, np.ndarray]:
    """Return histograms of the superpixels and of the patches of texture about a target in the training frames."""
    sequence = pftrack.datasets.load(film)
    boxes, rng = sequence.target(target), np.random.default_rng(0)
    found = []
    for frame, box in zip(sequence.frames[:N_FRAMES], boxes, strict=False):
        region = superpixels.surroundings(box, frame.shape)
        found.append(patches.describe(frame, region, box[3], 100, 150, rng))
    kinds = zip(*found, strict=True)
    return {name: np.concatenate([one.features for one in kind]) for name, kind in zip(BANDWIDTHS, kinds, strict=True)}


def seconds(function) -> float:
    """Return how long a function takes."""
    begin = time.perf_counter()
    function()
    return time.perf_counter() - begin


def main(path: Path) -> None:
    """Cluster all patches by both, compare the clusters, print the table and write it."""
    rows = []
    for film, target in tqdm(FILMS.items(), unit="film"):
        for kind, points in training_patches(film, target).items():
            for bandwidth in BANDWIDTHS[kind]:
                ours = codebook.mean_shift(points, bandwidth)
                theirs = MeanShift(bandwidth=bandwidth)
                slow = seconds(lambda points=points, theirs=theirs: theirs.fit(points))
                quick = min(
                    seconds(lambda points=points, h=bandwidth: codebook.mean_shift(points, h)) for _ in range(N_PASSES)
                )
                centers = theirs.cluster_centers_
                same = len(ours) == len(centers)
                apart = np.sqrt(codebook.squared_distances(ours, centers).min(axis=1).max()) if same else np.nan
                rows.append(
                    [film, kind, len(points), bandwidth, len(ours), len(centers), apart, quick, slow, slow / quick]
                )
    names = ["film", "kind", "points", "bandwidth", "words", "words_sklearn", "apart", "s", "s_sklearn", "ratio"]
    table = pd.DataFrame(rows, columns=names)
    reproduce.write(path, table, threads=1)
    print(table.to_string(index=False, float_format="{:.4g}".format))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("results/clustering.csv"))
    main(parser.parse_args().output)
