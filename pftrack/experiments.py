"""Repeated runs and sweeps: many seeds, settings and sequences, on all cores or on a cluster.

A particle filter is random, so one run of it says little: every number of the book is a mean over runs, with its
spread. A :class:`Run` names everything that one run depends on, :func:`grid` lists the runs of an experiment,
:func:`run` computes their boxes and :func:`table` scores them, one row a run. Chapter 6 uses all four.

Runs that differ in nothing but the seed go through the film side by side: each frame is decoded once for all of them,
and where a tracker has a method ``prepare``, what it derives from the frame alone (for the colour particle filter the
bin of every pixel) is computed once as well. Its ``init`` and ``update`` then take what ``prepare(frame)`` returned in
place of the frame. The boxes are those of :func:`pftrack.trackers.base.track` to the bit, whatever the number of
workers.

The work is spread by joblib: over the cores of this machine or, with one line around the same call, over the workers of
a Dask cluster (``pip install "pftrack[cluster]"``)::

    with distributed.Client("scheduler:8786"), joblib.parallel_config("dask"):
        boxes = experiments.run(runs, store="runs")

Every worker needs the footage, and the library of the caller, which is checked.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import importlib.util
import inspect
import itertools
import multiprocessing
import os
import signal
import threading
import time
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import joblib
import numpy as np
from tqdm.auto import tqdm

from pftrack import datasets, metrics
from pftrack.files import replacing
from pftrack.trackers import TRACKERS, Tracker

if TYPE_CHECKING:
    import pandas as pd

LARGEST_GROUP = 10
"""Most runs that share a pass through the film, unless said otherwise."""

UPPER_ROOMS = ("cli.py", "explore.py", "masks.py", "plots.py", "reproduce", "video.py")
"""Files and folders that trackers and datasets do not build on, so that a change of them leaves every box as it is."""


# ---------------------------------------------------------------------------------------------------------------------
# What to run
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """One tracker on one target of one sequence, and all that its boxes depend on.

    Attributes
    ----------
    tracker : str
        A name in ``pftrack.trackers.TRACKERS``.
    sequence : str
        A dataset id, one of :func:`pftrack.datasets.ids`.
    seed : int or None
        Seed of the random numbers, from 0; None for a tracker that draws none.
    settings : tuple of (str, value)
        Arguments of the tracker's constructor, sorted by name, without those that have their default. A dictionary may
        be given. Values are numbers, words, or lists or arrays of them, which become tuples.
    target : int or None
        Id of the target; None is the first of the sequence.

    Raises
    ------
    ValueError
        If the tracker or the sequence is unknown, a setting is none of the tracker's, or the seed is missing where one
        is needed or given where none is.
    TypeError
        If the value of a setting is of another kind.

    Examples
    --------
    >>> Run("color-pf", "synthetic-walk", seed=3, settings={"n_particles": 20, "dt": 1}).settings
    (('n_particles', 20),)
    """

    tracker: str
    sequence: str
    seed: int | None = None
    settings: tuple[tuple[str, object], ...] = ()
    target: int | None = None

    def __post_init__(self):
        if self.sequence not in datasets.ids():
            raise ValueError(f"unknown dataset {self.sequence!r}; there are {', '.join(datasets.ids())}")
        defaults = _defaults(self.tracker)
        if takes_seed(self.tracker) and self.seed is None:
            raise ValueError(f"{self.tracker} is random; give the run a seed")
        if not takes_seed(self.tracker) and self.seed is not None:
            raise ValueError(f"{self.tracker} is not random; leave its seed None")
        settings = {name: _plain(value) for name, value in dict(self.settings).items()}
        unknown = settings.keys() - defaults.keys()
        if unknown:
            raise ValueError(f"{self.tracker} has no setting {min(unknown)!r}; it has {', '.join(defaults)}")
        changed = sorted((name, value) for name, value in settings.items() if value != defaults[name])
        for name, value in (("settings", tuple(changed)), ("seed", _plain(self.seed)), ("target", _plain(self.target))):
            object.__setattr__(self, name, value)

    @property
    def all_settings(self) -> dict[str, object]:
        """Every argument of the tracker's constructor but the seed, those left at their default included."""
        return _defaults(self.tracker) | dict(self.settings)

    def make_tracker(self) -> Tracker:
        """Return a new tracker with the settings and the seed of this run."""
        seed = {} if self.seed is None else {"seed": self.seed}
        return TRACKERS[self.tracker](**dict(self.settings), **seed)

    def load(self) -> tuple[datasets.Frames, np.ndarray]:
        """Load the frames, and the true boxes of the target, shape (T, 4), NaN where it is hidden.

        Raises
        ------
        ValueError
            If the sequence has no such target, or it is hidden in the first frame, so that no tracker can start.
        """
        sequence = datasets.load(self.sequence, progress=False)
        truth = sequence.boxes if self.target is None else sequence.target(self.target)
        if np.isnan(truth[0]).any():
            raise ValueError(f"the target of {self} is not to be seen in the first frame, so no tracker can start")
        return sequence.frames, truth


def takes_seed(tracker: str) -> bool:
    """Tell whether the tracker of this name draws random numbers.

    Raises
    ------
    ValueError
        If there is no such tracker.
    """
    if tracker not in TRACKERS:
        raise ValueError(f"unknown tracker {tracker!r}; choose one of {', '.join(TRACKERS)}")
    return "seed" in inspect.signature(TRACKERS[tracker]).parameters


def _defaults(tracker: str) -> dict[str, object]:
    """Return every argument of a tracker's constructor but the seed, with its default."""
    takes_seed(tracker)
    parameters = inspect.signature(TRACKERS[tracker]).parameters
    return {name: _plain(parameter.default) for name, parameter in parameters.items() if name != "seed"}


def _plain(value):
    """Return the value of a setting as something that can be hashed and that always prints the same."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return tuple(_plain(part) for part in value)
    if not isinstance(value, (int, float, str, type(None))):
        raise TypeError(f"a setting must be a number, a word, or a list of those, got {value!r}")
    return value


def grid(
    trackers: str | Iterable[str],
    sequences: str | Iterable[str | tuple[str, int]],
    *,
    seeds: Iterable[int] = range(10),
    settings: Mapping | Iterable[Mapping] = ({},),
) -> list[Run]:
    """List the runs of all combinations.

    Parameters
    ----------
    trackers : str or iterable of str
        Names of trackers.
    sequences : str or iterable of str or (str, int)
        Dataset ids, or pairs of a dataset id and the id of a target in it.
    seeds : iterable of int
        Seeds; a tracker that draws no random numbers runs once, without one.
    settings : dict or iterable of dict
        Settings of the constructor, one dictionary for each variant.

    Returns
    -------
    list of Run
        Ordered by tracker, then sequence, then settings, then seed.

    Raises
    ------
    ValueError, TypeError
        As for :class:`Run`.

    Examples
    --------
    >>> runs = grid("color-pf", "synthetic-walk", seeds=range(3), settings=[{"n_particles": n} for n in (10, 20)])
    >>> [(dict(one.settings)["n_particles"], one.seed) for one in runs]
    [(10, 0), (10, 1), (10, 2), (20, 0), (20, 1), (20, 2)]
    """
    trackers = [trackers] if isinstance(trackers, str) else trackers
    sequences = [sequences] if isinstance(sequences, str) else sequences
    places = [(place, None) if isinstance(place, str) else tuple(place) for place in sequences]
    variants = [settings] if isinstance(settings, Mapping) else list(settings)
    seeds = list(seeds)
    return [
        Run(tracker, sequence, seed, variant, target)
        for tracker, (sequence, target), variant in itertools.product(trackers, places, variants)
        for seed in (seeds if takes_seed(tracker) else [None])
    ]


# ---------------------------------------------------------------------------------------------------------------------
# Running it
# ---------------------------------------------------------------------------------------------------------------------


def run(
    runs: Iterable[Run],
    *,
    store: str | os.PathLike | None = None,
    n_jobs: int | None = None,
    progress: bool = True,
    group_size: int | None = None,
) -> list[np.ndarray]:
    """Compute the boxes of many runs.

    Parameters
    ----------
    runs : iterable of Run
        What to run; a run that occurs twice is computed once.
    store : path, optional
        A folder, made if need be, in which the boxes of every finished group are kept. A later call takes from it what
        it finds there, so interrupted work goes on where it stopped. What other code of the library, or another version
        of NumPy, OpenCV or numba has computed is never taken.
    n_jobs : int, optional
        Number of worker processes. By default what an enclosing ``joblib.parallel_config`` says, and otherwise one for
        each core.
    progress : bool
        Whether to show a progress bar, which counts runs.
    group_size : int, optional
        Most runs that share a pass through the film; by default up to 10, and fewer where cores would be idle. It has
        no effect on the boxes.

    Returns
    -------
    list of ndarray, shape (T, 4)
        For each run, in the order given, the boxes ``(x, y, w, h)`` in pixels, one for each frame of its sequence; NaN
        where the tracker reported none.

    Raises
    ------
    ValueError
        If a run cannot be done (see :class:`Run` and :func:`pftrack.trackers.base.track`), `group_size` is below 1, or
        a worker has another library than the caller. Groups that were finished before are in the store.
    FileNotFoundError
        If footage is not here and cannot be downloaded.

    Notes
    -----
    On a Dask cluster a task whose workers die again and again leaves joblib waiting (joblib 1.6 does not pass on the
    error): interrupt it, and call again with the same store.

    Examples
    --------
    >>> runs = grid("color-pf", "synthetic-walk", seeds=range(2), settings={"n_particles": 10})
    >>> boxes = run(runs, n_jobs=1, progress=False)
    >>> len(boxes), boxes[0].shape
    (2, (100, 4))
    """
    runs = list(runs)
    if group_size is not None and group_size < 1:
        raise ValueError(f"group_size must be at least 1, got {group_size}")
    folder = None
    if store is not None:
        folder = Path(store) / LIBRARY[:16]
        folder.mkdir(parents=True, exist_ok=True)
    boxes = {one: _read(folder, one) for one in dict.fromkeys(runs)}
    missing = [one for one, found in boxes.items() if found is None]
    if n_jobs is None and joblib.parallel.get_active_backend()[1] is None:
        n_jobs = -1  # no context says how many
    for id in dict.fromkeys(one.sequence for one in missing):
        datasets.load(id, progress)  # so that what must be downloaded is, once
    if group_size is None:
        group_size = max(1, min(LARGEST_GROUP, len(missing) // joblib.effective_n_jobs(n_jobs)))
    tasks = [joblib.delayed(_run_group)(group, LIBRARY) for group in _groups(missing, group_size)]
    parallel = joblib.Parallel(n_jobs, return_as="generator_unordered", batch_size=1)
    with (
        tqdm(total=len(boxes), initial=len(boxes) - len(missing), unit="run", disable=not progress) as bar,
        warnings.catch_warnings(),
    ):
        # an interrupt leaves tasks undone, of which joblib would warn besides
        warnings.filterwarnings("ignore", r".*tasks (have been|which were)", UserWarning)
        for finished in parallel(tasks):
            for one, found in finished.items():
                boxes[one] = found
                _write(folder, one, found)
            bar.update(len(finished))
    return [boxes[one] for one in runs]


def _groups(runs: Sequence[Run], size: int) -> list[list[Run]]:
    """Put runs that differ in nothing but the seed together, at most so many in a group."""
    alike: dict[tuple, list[Run]] = {}
    for one in runs:
        alike.setdefault((one.tracker, one.sequence, one.target, one.settings), []).append(one)
    return [group[n : n + size] for group in alike.values() for n in range(0, len(group), size)]


def _leave_interrupts_to_the_caller() -> None:
    """Ignore Ctrl-C in a worker process: the caller gets it too, and ends its workers, who would only complain."""
    in_worker = multiprocessing.current_process().name != "MainProcess"
    if in_worker and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run_group(runs: Sequence[Run], library: str) -> dict[Run, np.ndarray]:
    """Run trackers of equal settings side by side on one pass through the film; done by a worker."""
    _leave_interrupts_to_the_caller()
    if library != LIBRARY:
        raise ValueError(
            "a worker has another version of pftrack, NumPy, OpenCV or numba than the caller, so their results could "
            "differ; install the same everywhere, or restart Python if the library was edited meanwhile"
        )
    frames, truth = runs[0].load()
    trackers = [one.make_tracker() for one in runs]
    prepare = getattr(trackers[0], "prepare", None)
    boxes = np.full((len(runs), len(truth), 4), np.nan)  # NaN remains where a film ends early
    for t, frame in enumerate(frames):
        try:
            shown = frame if prepare is None else prepare(frame)
            for n, tracker in enumerate(trackers):
                boxes[n, t] = (tracker.init(shown, truth[0]) if t == 0 else tracker.update(shown)).box
        except ValueError as error:
            raise ValueError(f"{runs[0].tracker} on {runs[0].sequence}, frame {t}: {error}") from error
    return dict(zip(runs, boxes, strict=True))


def time_per_frame(one: Run, n_frames: int = 100, repeats: int = 5) -> np.ndarray:
    """Measure how long a tracker takes for a frame, alone in this process, from the raw frame, reading not counted.

    Parameters
    ----------
    one : Run
        What to time. Nothing is prepared or shared here, unlike in :func:`run`.
    n_frames : int
        Number of frames to update on, from the second of the sequence, all held in memory; fewer if it is shorter.
    repeats : int
        Number of passes measured, after one that is not.

    Returns
    -------
    ndarray, shape (repeats,)
        Milliseconds for a frame, the mean over each pass. The least of them is the most repeatable.

    Raises
    ------
    ValueError
        If `n_frames` or `repeats` is below 1.

    Examples
    --------
    >>> bool(np.all(time_per_frame(Run("camshift", "synthetic-walk"), n_frames=5, repeats=2) > 0))
    True
    """
    if n_frames < 1 or repeats < 1:
        raise ValueError(f"n_frames and repeats must be at least 1, got {n_frames} and {repeats}")
    frames, truth = one.load()
    first, *later = frames[: n_frames + 1]
    times = []
    for _ in range(repeats + 1):
        tracker = one.make_tracker()
        tracker.init(first, truth[0])
        start = time.perf_counter()
        for frame in later:
            tracker.update(frame)
        times.append((time.perf_counter() - start) / len(later) * 1000)
    return np.array(times[1:])


# ---------------------------------------------------------------------------------------------------------------------
# Scoring it
# ---------------------------------------------------------------------------------------------------------------------


def table(runs: Iterable[Run], boxes: Iterable[np.ndarray]) -> pd.DataFrame:
    """Score runs, one row each.

    Parameters
    ----------
    runs : iterable of Run
        What was run.
    boxes : iterable of ndarray, shape (T, 4)
        What :func:`run` returned for them.

    Returns
    -------
    pandas.DataFrame
        The columns tracker, sequence, target and seed; every setting of the constructor, those left at their default
        included; and the fields of :class:`~pftrack.metrics.single.SingleTargetScore`. Where trackers of several kinds
        are in one table, the settings that one of them has not are missing in its rows.

    Raises
    ------
    ValueError
        If there are not as many boxes as runs, or they do not fit the truth.

    Examples
    --------
    >>> runs = grid(["mean-shift", "camshift"], "synthetic-walk")
    >>> scores = table(runs, run(runs, n_jobs=1, progress=False))
    >>> scores.groupby("tracker")["n_frames"].max().to_dict()
    {'camshift': 100, 'mean-shift': 100}
    """
    import pandas as pd

    rows, loaded = [], {}
    for one, found in zip(runs, boxes, strict=True):
        place = (one.sequence, one.target)
        if place not in loaded:
            sequence = datasets.load(one.sequence, progress=False)
            target = sequence.ids[0] if one.target is None else one.target
            loaded[place] = target, sequence.target(target)
        target, truth = loaded[place]
        about = {"tracker": one.tracker, "sequence": one.sequence, "target": target, "seed": one.seed}
        rows.append(about | one.all_settings | metrics.single_target(found, truth).as_dict())
    return pd.DataFrame(rows).astype({"seed": "Int64"})


# ---------------------------------------------------------------------------------------------------------------------
# Keeping it
# ---------------------------------------------------------------------------------------------------------------------


def library_digest(folder: Path) -> str:
    """SHA-256 of what boxes depend on besides the run: the library's code, and the versions of what computes with it.

    Parameters
    ----------
    folder : path
        Where the library's source files are.

    Returns
    -------
    str
        64 hexadecimal digits.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if (
            path.suffix in (".py", ".txt") and name.split("/")[0] not in UPPER_ROOMS
        ):  # the .txt hold the checksums of the footage
            digest.update(f"{name}\n{hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode())
    numba = importlib.metadata.version("numba") if importlib.util.find_spec("numba") else None
    digest.update(f"numpy {np.__version__}, opencv {cv2.__version__}, numba {numba}".encode())
    return digest.hexdigest()


LIBRARY = library_digest(Path(__file__).parent)
"""Digest of the library as it was when it was imported."""


def _path(folder: Path, one: Run) -> Path:
    depends_on = (one.tracker, one.sequence, one.target, one.seed, one.settings)
    return folder / f"{hashlib.sha256(repr(depends_on).encode()).hexdigest()[:32]}.npy"


def _read(folder: Path | None, one: Run) -> np.ndarray | None:
    """Return the boxes that the store holds for a run, or None."""
    try:
        return None if folder is None else np.load(_path(folder, one))
    except (OSError, ValueError, EOFError):  # not there, or damaged by other hands
        return None


def _write(folder: Path | None, one: Run, boxes: np.ndarray) -> None:
    if folder is not None:
        with replacing(_path(folder, one)) as temporary, temporary.open("wb") as file:
            np.save(file, boxes)
