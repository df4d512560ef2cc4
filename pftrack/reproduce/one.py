"""One pedestrian: Figures 3 and 6 and Table II of Owczarek et al. 2015, what its settings and our steps are worth."""

from __future__ import annotations

import inspect
from pathlib import Path

import numpy as np
import pandas as pd

import pftrack
from pftrack import datasets, experiments, metrics
from pftrack.experiments import Run
from pftrack.reproduce.plan import Plan, spread

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
