"""The full-size experiments behind the book: Figures 3 and 6 and Table II of Owczarek et al. 2015, and more.

Each item of :data:`ITEMS` takes a :class:`Plan` and writes one or two files below ``results/``; ``pftrack reproduce``
runs them. The files are plain CSV under lines ``# key: value`` that say the settings, versions and machine;
:func:`read` gives both. What has been computed is kept in the user's cache, so an interrupted item goes on where it
stopped, and items share their runs. Chapter 6 shows the files and re-runs a part of them.

Overlaps and hits are given twice, over ``all`` frames, a hidden one counting as overlap 0 and as a miss, and over the
``visible`` ones (see :mod:`pftrack.metrics`). And "± sd" can mean three things, of which the paper names none:

runs
    standard deviation, over runs (or masks), of a run's mean over frames: how much one run differs from the next;
frames
    standard deviation over the frames of one run, averaged over runs: how much a run goes up and down;
band
    standard deviation over runs in one frame, averaged over frames: the mean half-width of the grey band of Fig. 6.
"""

from __future__ import annotations

import importlib.metadata
import inspect
import os
import platform
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

import pftrack
from pftrack import datasets, experiments, metrics
from pftrack.datasets import registry
from pftrack.experiments import Run
from pftrack.files import replacing

PARTICLES = (10, 20, 35, 50, 75, 100, 200, 350, 500, 1000, 2000)
"""Numbers of particles of Fig. 3."""

SEEDS_OF_SENSITIVITY = 10
"""Most runs of each setting in :func:`sensitivity`."""

PAPER = {
    ("overlap", "camshift"): (0.53, 0.06),
    ("overlap", "color-pf"): (0.62, 0.10),
    ("hit_ratio", "camshift"): (0.79, 0.02),
    ("hit_ratio", "color-pf"): (0.87, 0.04),
    ("iterations", "camshift"): (1.90, 0.52),
    ("ms_per_frame", "camshift"): (0.73, 0.03),
    ("ms_per_frame", "color-pf"): (5.55, 0.00),
}
"""What the paper prints in its Table II, as the mean and the number after ±."""

SCORES = ("overlap_all", "overlap_visible", "hit_ratio_all", "hit_ratio_visible")


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

    def write(self, name: str, table: pd.DataFrame, **about) -> Path:
        """Write a file of the results; see :func:`write`."""
        return write(Path(self.results) / name, table, sequence=self.sequence, **about)


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


def _mean_and_sd(table: pd.DataFrame, by: list[str]) -> pd.DataFrame:
    """Mean and standard deviation over runs of the scores, one row for each value of `by`."""
    scores = table.groupby(by, sort=False)[list(SCORES)].agg(["mean", "std"])
    scores.columns = [f"{score}_{sense.replace('std', 'sd')}" for score, sense in scores.columns]
    return scores.reset_index()


def _hits(overlaps: np.ndarray) -> np.ndarray:
    """Return 1 where an overlap is a hit, 0 where it is a miss, and NaN where the target is hidden."""
    return np.where(np.isnan(overlaps), np.nan, overlaps >= metrics.HIT_OVERLAP)


def _per_frame(overlaps: np.ndarray) -> dict[str, np.ndarray]:
    """Return mean, spread, band and share of hits over runs, in every frame; NaN where the target is hidden."""
    low, high = np.percentile(overlaps, [5, 95], axis=0)
    sd = overlaps.std(axis=0, ddof=1) if len(overlaps) > 1 else np.full(overlaps.shape[1], np.nan)
    return {"mean": overlaps.mean(axis=0), "sd": sd, "p05": low, "p95": high, "hits": _hits(overlaps).mean(axis=0)}


# ---------------------------------------------------------------------------------------------------------------------
# The items
# ---------------------------------------------------------------------------------------------------------------------


def fig3(plan: Plan) -> list[Path]:
    """Fig. 3: overlap and time against the number of particles.

    ``fig3-runs.csv`` has one row a run; ``fig3.csv`` one for each number of particles, with mean and standard deviation
    over runs of the overlap and the hit ratio, and the least and the median time per frame in milliseconds.
    """
    variants = [{"n_particles": n} for n in plan.particles]
    runs = experiments.grid("color-pf", plan.sequence, seeds=range(plan.n_runs), settings=variants)
    scores = experiments.table(runs, plan.run(runs))
    summary = _mean_and_sd(scores, ["n_particles"])
    times = _times([Run("color-pf", plan.sequence, 0, variant) for variant in variants])
    summary["ms_min"], summary["ms_median"] = np.min(times, axis=1), np.median(times, axis=1)
    about = _settings(plan, plan.n_runs)
    del about["n_particles"]
    rows = scores[["n_particles", "seed", *scores.columns[scores.columns.get_loc("n_frames") :]]]
    return [plan.write("fig3-runs.csv", rows, **about), plan.write("fig3.csv", summary, **about)]


def _times(runs: list[Run], n_passes: int = 10) -> np.ndarray:
    """Measure milliseconds a frame, one row a run; runs take turns, so that slow spells of a machine hit all alike."""
    return np.hstack([[experiments.time_per_frame(run, repeats=1) for run in runs] for _ in range(n_passes)])


def _settings(plan: Plan, n_runs: int, tracker: str = "color-pf") -> dict[str, object]:
    """Return what the file of an item of a particle filter says above its table: the settings at their default."""
    return {"tracker": tracker, **Run(tracker, plan.sequence, 0).all_settings, "runs": n_runs}


def fig6a(plan: Plan) -> list[Path]:
    """Fig. 6a: overlap per frame of the best masks of CAMSHIFT, and of Mean-Shift, of all those there are.

    ``fig6a.csv`` has one row a frame, with mean and standard deviation over the masks, 5th and 95th percentile and
    share of hits; ``fig6a-masks.csv`` one row a mask, with its half-open intervals of saturation and value, its scores
    and its mean number of Mean-Shift iterations a frame.
    """
    curves, masks = {}, []
    for tracker in ("camshift", "mean-shift"):
        found = _search(plan, tracker)
        name = tracker.replace("-", "_")
        curves |= {f"{name}_{measure}": curve for measure, curve in _per_frame(found.overlaps).items()}
        rows = pd.DataFrame(found.masks, columns=["s_low", "s_high", "v_low", "v_high"])
        rows.insert(0, "tracker", tracker)
        rows.insert(1, "rank", np.arange(1, len(rows) + 1))
        rows["overlap_all"] = np.nan_to_num(found.overlaps).mean(axis=1)
        rows["overlap_visible"] = np.nanmean(found.overlaps, axis=1)
        rows["hit_ratio_all"] = np.nan_to_num(_hits(found.overlaps)).mean(axis=1)
        rows["hit_ratio_visible"] = np.nanmean(_hits(found.overlaps), axis=1)
        rows["iterations"] = found.iterations[:, 1:].mean(axis=1)
        masks.append(rows)
    about = {"masks": _n_masks(plan), "best": plan.n_runs}
    hidden = np.isnan(datasets.load(plan.sequence).boxes[:, 0])
    curves = pd.DataFrame({"frame": np.arange(len(hidden)), "hidden": hidden.astype(int)} | curves)
    return [
        plan.write("fig6a.csv", curves, **about),
        plan.write("fig6a-masks.csv", pd.concat(masks, ignore_index=True), **about),
    ]


def _n_masks(plan: Plan) -> int | str:
    return "all" if plan.masks is None else len(plan.masks)


def _search(plan: Plan, tracker: str):
    """Search the masks of a Mean-Shift tracker, taking from the store what is there."""
    from pftrack import masks

    sequence = datasets.load(plan.sequence, progress=plan.progress)
    return masks.search(
        sequence.frames,
        sequence.boxes,
        tracker=tracker,
        masks=plan.masks,
        n_best=plan.n_runs,
        n_jobs=-1 if plan.n_jobs is None else plan.n_jobs,
        store=plan.folder,
        progress=plan.progress,
    )


def fig6b(plan: Plan) -> list[Path]:
    """Fig. 6b: overlap per frame of the particle filter with 100 particles.

    ``fig6b.csv`` has one row a frame: whether the target is hidden (the other columns are then empty), and over runs
    the mean, standard deviation, 5th and 95th percentile of the overlap and the share of runs that hit.
    """
    runs = _runs_of_100(plan)
    boxes = plan.run(runs)
    truth = datasets.load(plan.sequence).boxes
    curves = _per_frame(np.array([metrics.overlap(found, truth) for found in boxes]))
    hidden = np.isnan(truth[:, 0]).astype(int)
    table = pd.DataFrame({"frame": np.arange(len(truth)), "hidden": hidden} | curves)
    return [plan.write("fig6b.csv", table, **_settings(plan, plan.n_runs))]


def _runs_of_100(plan: Plan) -> list[Run]:
    return experiments.grid("color-pf", plan.sequence, seeds=range(plan.n_runs), settings={"n_particles": 100})


def table2(plan: Plan) -> list[Path]:
    """Table II: CAMSHIFT, Mean-Shift and the particle filter by all measures, the paper's numbers beside ours.

    ``table2.csv`` has one row for a measure, counted over all or the visible frames, and a sense of ±, named in the
    column ``sd_over`` (see the module's introduction; of times: over repeated passes). ``floor`` is a box that never
    moves. Mean-Shift trackers are their best masks, the particle filter its runs, as in Fig. 6.
    """
    truth = datasets.load(plan.sequence).boxes
    pf = np.array([metrics.overlap(boxes, truth) for boxes in plan.run(_runs_of_100(plan))])
    floor = metrics.overlap(np.tile(truth[0], (len(truth), 1)), truth)[None]
    found = {tracker: _search(plan, tracker) for tracker in ("camshift", "mean-shift")}
    overlaps = {tracker: search.overlaps for tracker, search in found.items()} | {"color-pf": pf, "floor": floor}
    hits = {name: _hits(rates) for name, rates in overlaps.items()}
    iterations = {tracker: search.iterations[:, 1:] for tracker, search in found.items()}
    timed = [
        Run(tracker, plan.sequence, seed)
        for tracker, seed in (("camshift", None), ("mean-shift", None), ("color-pf", 0))
    ]
    times = {run.tracker: passes[:, None] for run, passes in zip(timed, _times(timed), strict=True)}
    rows = []
    for measure, values in (("overlap", overlaps), ("hit_ratio", hits)):
        counted = {name: np.nan_to_num(rates) for name, rates in values.items()}
        rows += _rows(measure, "all", counted) + _rows(measure, "visible", values)
    rows += _rows("iterations", "all", iterations)
    rows += _rows("ms_per_frame", "all", times)[:1]  # a pass over the film has one time
    return [plan.write("table2.csv", pd.DataFrame(rows), runs=plan.n_runs, masks=_n_masks(plan))]


def _rows(measure: str, frames: str, values: dict[str, np.ndarray]) -> list[dict]:
    """Return the rows of a measure in Table II, one for each sense of ±."""
    spreads = {name: spread(value) for name, value in values.items()}
    rows = []
    for sense in ("runs", "frames", "band"):
        row = {"measure": measure, "frames": frames, "sd_over": sense}
        for name in ("camshift", "mean-shift", "color-pf", "floor"):
            if (measure, name) in PAPER:
                row[f"paper_{name}_mean"], row[f"paper_{name}_sd"] = PAPER[measure, name]
            if name in spreads:
                row[f"{name}_mean"], row[f"{name}_sd"] = spreads[name]["mean"], spreads[name][sense]
        rows.append(row)
    return rows


def sensitivity(plan: Plan) -> list[Path]:
    """How much the settings matter that the paper does not print: one varied at a time, the others at their default.

    ``sensitivity.csv`` has one row for each setting and value, with mean and standard deviation over 10 runs of the
    overlap and the hit ratio. The three kinds of noise are given as factors of their default.
    """
    tried = variations()
    seeds = range(min(plan.n_runs, SEEDS_OF_SENSITIVITY))
    runs = experiments.grid("color-pf", plan.sequence, seeds=seeds, settings=[settings for *_, settings in tried])
    scores = experiments.table(runs, plan.run(runs))
    scores["setting"] = [name for name, *_ in tried for _ in seeds]
    scores["value"] = [str(value) for _, value, _ in tried for _ in seeds]
    scores["default"] = [int(not one.settings) for one in runs]
    table = _mean_and_sd(scores, ["setting", "value", "default"])
    return [plan.write("sensitivity.csv", table, **_settings(plan, len(seeds)))]


def variations() -> list[tuple[str, object, dict[str, object]]]:
    """List what :func:`sensitivity` tries: name, value, and the settings that differ from the default.

    Examples
    --------
    >>> [(value, settings) for name, value, settings in variations() if name == "scale_range"][0]
    ((1.0, 2.0), {'scale_range': (1.0, 2.0)})
    """
    parameters = inspect.signature(pftrack.ColorParticleFilter).parameters
    default = {name: parameter.default for name, parameter in parameters.items()}
    varied = [("sigma", round(default["sigma"] * factor, 6)) for factor in (0.5, 0.7, 1, 1.4, 2)]
    varied += [("resample_threshold", value) for value in sorted({0.0, 0.25, 0.75, 1.0, default["resample_threshold"]})]
    varied += [("lost_distance", value) for value in sorted({0.3, 0.4, 0.6, 0.7, 1.0, default["lost_distance"]})]
    varied += [("scale_range", value) for value in (default["scale_range"], (1.0, 1.0), (0.5, 1.0), (0.5, 2.0))]
    tried = [(name, value, {name: value}) for name, value in varied]
    for kind, places in (("position", [0, 1]), ("velocity", [2, 3]), ("scale", [4])):
        for factor in (0.25, 0.5, 1, 2, 4):
            noise = np.array(default["noise"], dtype=float)
            noise[places] *= factor
            tried.append((f"{kind} noise", factor, {"noise": tuple(noise.tolist())}))
    return tried


BARE = {"n_bands": 1, "side_margin": 0.0, "template_weight": 0.0, "learning_rate": 0.0, "follow_camera": False}
"""Settings of the robust filter with its cues, its learning and its camera left out."""

STEPS = (
    ("bands", ("n_bands", "side_margin")),
    ("camera", ("follow_camera",)),
    ("template", ("template_weight",)),
    ("learning colours", ("learning_rate",)),
)
"""What chapter 7 adds to the bare filter, in this order, and the settings that each step returns to their default."""

ABLATION_TARGETS = (("bobot-I", None), ("bobot-J", 1), ("bobot-J", 2))
"""The man of sequence I, and the left and the right person of sequence J."""


def ablation_steps() -> list[tuple[str, str, dict[str, object]]]:
    """List the rows of :func:`ablation`: what it says, tracker, and the settings that differ from the default.

    Examples
    --------
    >>> [name for name, *_ in ablation_steps()][:4]
    ['the paper', 'bare', '+ bands', '+ camera']
    """
    left_out = dict(BARE)
    rows = [("the paper", "color-pf", {}), ("bare", "robust-pf", dict(left_out))]
    for name, settings in STEPS:
        left_out = {setting: value for setting, value in left_out.items() if setting not in settings}
        rows.append((f"+ {name}", "robust-pf", left_out))
    rows += [(f"all but {name}", "robust-pf", {each: BARE[each] for each in settings}) for name, settings in STEPS]
    return [*rows, ("all but redrawing", "robust-pf", {"redraw": 0.0})]


def ablation(plan: Plan) -> list[Path]:
    """What each step from the paper's filter to the robust one is worth, on `bobot-I` and both people of `bobot-J`.

    ``ablation.csv`` has one row for each step and target, with mean and standard deviation over 10 runs of the overlap
    and the hit ratio. Rows that begin with ``+`` add one step to the row above; ``all but`` leaves one out.
    """
    seeds = range(min(plan.n_runs, SEEDS_OF_SENSITIVITY))
    names, runs = [], []
    for name, tracker, settings in ablation_steps():
        new = experiments.grid(tracker, ABLATION_TARGETS, seeds=seeds, settings=[settings])
        names += [name] * len(new)
        runs += new
    scores = experiments.table(runs, plan.run(runs))
    scores["step"] = names
    table = _mean_and_sd(scores, ["step", "sequence", "target"])
    return [plan.write("ablation.csv", table, **_settings(plan, len(seeds), "robust-pf"))]


ITEMS = {
    "fig3": fig3,
    "fig6b": fig6b,
    "fig6a": fig6a,
    "table2": table2,
    "sensitivity": sensitivity,
    "ablation": ablation,
}
"""What can be reproduced, by name, in the order in which ``all`` does it."""


def run(item: str, plan: Plan) -> Iterator[Path]:
    """Reproduce an item, or all.

    Parameters
    ----------
    item : str
        A name in :data:`ITEMS`, or ``all``.
    plan : Plan
        What to compute it on, and how.

    Yields
    ------
    path
        Every file as it is finished.

    Raises
    ------
    ValueError
        If there is no such item.
    FileNotFoundError
        If the footage is not here and cannot be downloaded.
    """
    if item != "all" and item not in ITEMS:
        raise ValueError(f"unknown item {item!r}; choose one of {', '.join(ITEMS)}, or all")
    Path(plan.results).mkdir(parents=True, exist_ok=True)
    for name in ITEMS if item == "all" else [item]:
        yield from ITEMS[name](plan)
