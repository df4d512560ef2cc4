"""What the experiments are computed on, the files they write, and the spread of what was measured."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import joblib
import numpy as np
import pandas as pd
from tqdm.auto import tqdm

import pftrack
from pftrack import experiments
from pftrack.datasets import registry
from pftrack.experiments import LIBRARY, Run
from pftrack.files import replacing

PARTICLES = (10, 20, 35, 50, 75, 100, 200, 350, 500, 1000, 2000)
"""Numbers of particles of Fig. 3."""


@dataclass(frozen=True)
class Plan:
    """What the items are computed on, and how.

    Attributes
    ----------
    results : path
        Folder of the files, made if need be.
    n_runs : int
        Runs of each setting, with seeds from 0, and best masks of each Mean-Shift tracker; the paper has 100 of both.
    n_jobs : int or None
        Worker processes, see :func:`pftrack.experiments.run`.
    sequence : str
        Dataset id; the first target of it is followed.
    crowd : str
        Dataset id of the film with many pedestrians, for the detector.
    followed : tuple of str
        Dataset ids of the films in which many are followed.
    particles : tuple of int
        Numbers of particles of Fig. 3.
    masks : ndarray, shape (M, 4), or None
        The masks to search for Fig. 6a; None for all of :func:`pftrack.masks.search`.
    store : path or None
        Where finished work is kept; None is the user's cache.
    progress : bool
        Whether to show progress bars.

    Raises
    ------
    ValueError
        If `n_runs` is below 1.
    """

    results: Path = Path("results")
    n_runs: int = 100
    n_jobs: int | None = None
    sequence: str = "bobot-I"
    crowd: str = "pets09-s2l1"
    followed: tuple[str, ...] = ("bobot-J", "tud-campus", "pets09-s2l1")
    particles: tuple[int, ...] = PARTICLES
    masks: np.ndarray | None = None
    store: Path | None = None
    progress: bool = True

    def __post_init__(self):
        if self.n_runs < 1:
            raise ValueError(f"the number of runs must be at least 1, got {self.n_runs}")

    @property
    def folder(self) -> Path:
        """Where finished work is kept."""
        return registry.cache_folder() / "experiments" if self.store is None else Path(self.store)

    def run(self, runs: Iterable[Run]) -> list[np.ndarray]:
        """Compute the boxes of runs, taking from the store what is there."""
        return experiments.run(runs, store=self.folder, n_jobs=self.n_jobs, progress=self.progress)

    def each(self, function: Callable, tasks: Sequence[tuple]) -> list:
        """Call a function with the arguments of each task, taking from the store what is there.

        What the result depends on must be among the arguments. The first always is the version of the library, which
        includes all but the programs on top of it, such as this one.
        """
        memory = joblib.Memory(self.folder / "many", verbose=0)
        call = joblib.delayed(memory.cache(function))
        parallel = joblib.Parallel(-1 if self.n_jobs is None else self.n_jobs, return_as="generator")
        done = parallel(call(LIBRARY, *task) for task in tasks)
        return list(tqdm(done, total=len(tasks), unit="run", disable=not self.progress))

    def write(self, name: str, table: pd.DataFrame, **about) -> Path:
        """Write a file of the results; see :func:`write`."""
        return write(Path(self.results) / name, table, **({"sequence": self.sequence} | about))


# ---------------------------------------------------------------------------------------------------------------------
# Files
# ---------------------------------------------------------------------------------------------------------------------


def machine() -> dict[str, object]:
    """Return the versions of what computes, and the processor: what a number in a file may depend on.

    Examples
    --------
    >>> list(machine())
    ['pftrack', 'python', 'numpy', 'opencv', 'numba', 'processor', 'cores']
    """
    try:
        numba = importlib.metadata.version("numba")
    except importlib.metadata.PackageNotFoundError:
        numba = "none"
    return {
        "pftrack": pftrack.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
        "numba": numba,
        "processor": _processor(),
        "cores": os.cpu_count(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def write(path: Path, table: pd.DataFrame, **about) -> Path:
    """Write a table as CSV, numbers rounded to 6 decimals, below lines ``# key: value``; whole or not at all.

    Parameters
    ----------
    path : path
        The file.
    table : pandas.DataFrame
        What to write; its index is not.
    **about
        Further keys and values, put before those of :func:`machine`.

    Returns
    -------
    path
        The file.
    """
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        for key, value in (about | machine()).items():
            file.write(f"# {key}: {value}\n")
        table.round(6).to_csv(file, index=False, lineterminator="\n")
    return Path(path)


def read(path: str | os.PathLike) -> pd.DataFrame:
    """Read a file of :func:`write`; the lines above the table are in the dictionary ``table.attrs``, as text.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    """
    table = pd.read_csv(path, comment="#")
    with Path(path).open(encoding="utf-8") as file:
        lines = [line[1:].partition(":") for line in file if line.startswith("#")]
    table.attrs = {key.strip(): value.strip() for key, _, value in lines}
    return table


# ---------------------------------------------------------------------------------------------------------------------
# Spread
# ---------------------------------------------------------------------------------------------------------------------


def spread(values) -> dict[str, float]:
    """Mean of what was measured in every frame of every run, and its standard deviation in three senses.

    Parameters
    ----------
    values : array_like, shape (R, T)
        One row a run, one column a frame; columns that are NaN throughout are left out.

    Returns
    -------
    dict
        ``mean``, and the standard deviations ``runs``, ``frames`` and ``band`` of the module's introduction; NaN where
        there is only one run or frame.

    Examples
    --------
    Two runs, each constant, 1 apart:

    >>> {sense: round(float(value), 3) for sense, value in spread([[0.0, 0.0], [1.0, 1.0]]).items()}
    {'mean': 0.5, 'runs': 0.707, 'frames': 0.0, 'band': 0.707}
    """
    values = np.asarray(values, dtype=float)
    values = values[:, ~np.isnan(values).all(axis=0)]
    n_runs, n_frames = values.shape
    return {
        "mean": values.mean(),
        "runs": values.mean(axis=1).std(ddof=1) if n_runs > 1 else np.nan,
        "frames": values.std(axis=1, ddof=1).mean() if n_frames > 1 else np.nan,
        "band": values.std(axis=0, ddof=1).mean() if n_runs > 1 else np.nan,
    }
