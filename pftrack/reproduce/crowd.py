"""Many pedestrians who come and go: the association filter of Li et al. 2016 on whole films, and its parts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from pftrack import datasets, metrics, multi
from pftrack.detection import detect
from pftrack.multi.association import ADDITIONS
from pftrack.reproduce.plan import Plan

FORMS = {"default": {}, "as printed": {"as_printed": True}}
"""The two forms of the filter, and their settings."""

PUBLISHED_SCORE = {"pets09-s2l1": 0.9, "tud-campus": 20.0}
"""Films that come with detections of others, and the score from which one of these may be somebody new."""

ABLATED = ("mota", "idf1", "hota")
"""Measures of the ablation."""

N_PRINTED = 3
"""Seeds of the filter as printed; the default has ten."""

PRINTED_FRAMES = 120
"""Frames of a film that the filter as printed sees, for nobody ever leaves it, and each frame takes longer."""

N_ABLATED = 5
"""Seeds of the ablation."""


def association_steps() -> list[tuple[str, dict[str, object]]]:
    """List the rows of :func:`association`'s ablation: what is left out, and the settings.

    Examples
    --------
    >>> [name for name, _ in association_steps()][:3]
    ['nothing', 'product', 'gate']
    """
    left_out = [(name, {"additions": [each for each in ADDITIONS if each != name]}) for name in ADDITIONS]
    return [("nothing", {}), *left_out]


def association(plan: Plan) -> list[Path]:
    """Score the association filter on whole films: MOTA, IDF1, HOTA and what they are made of.

    ``association-runs.csv`` has one row for each film, form (``default`` or ``as printed``) and seed, with all measures
    of :class:`pftrack.metrics.many.MultiTargetScore`, over all frames, or as printed over the first 120; on the
    detections of our detector (``own``), and in the default form on those that come with a film (``published``).
    ``association-ablation.csv`` has one row for each addition that is left out, and film.
    """
    n_seeds = {form: min(plan.n_runs, N_PRINTED if settings else 10) for form, settings in FORMS.items()}
    found = {id: _detections(plan, id) for id in plan.followed}
    runs = [
        (id, source, form, settings, table, seed)
        for id in plan.followed
        for source, (table, birth) in found[id].items()
        for form, settings in ((form, settings | birth) for form, settings in FORMS.items())
        if source == "own" or form == "default"
        for seed in range(n_seeds[form])
    ]
    ends = {"default": None, "as printed": PRINTED_FRAMES}
    scores = _scored(plan, [(id, settings, table, seed, ends[form]) for id, _, form, settings, table, seed in runs])
    rows = [
        {"sequence": id, "detections": source, "form": form, "seed": seed} | score
        for (id, source, form, _, _, seed), score in zip(runs, scores, strict=True)
    ]
    seeds = range(min(plan.n_runs, N_ABLATED))
    steps = [(name, settings, id) for name, settings in association_steps() for id in plan.followed]
    tasks = [(id, settings, found[id]["own"][0], seed, None) for _, settings, id in steps for seed in seeds]
    scores = np.array([[score[each] for each in ABLATED] for score in _scored(plan, tasks)])
    parts = []
    for (name, _, id), of_step in zip(steps, scores.reshape(len(steps), len(seeds), -1), strict=True):
        spread = of_step.std(axis=0, ddof=1) if len(seeds) > 1 else np.full(len(ABLATED), np.nan)
        parts.append([name, id, *np.column_stack([of_step.mean(axis=0), spread]).ravel(), len(seeds)])
    columns = [f"{each}_{what}" for each in ABLATED for what in ("mean", "sd")]
    about = {"sequence": " ".join(plan.followed)}
    ablation = pd.DataFrame(parts, columns=["left_out", "sequence", *columns, "runs"])
    return [
        plan.write("association-runs.csv", pd.DataFrame(rows), **about, birth_score=PUBLISHED_SCORE),
        plan.write("association-ablation.csv", ablation, **about),
    ]


def _detections(plan: Plan, id: str) -> dict[str, tuple[np.ndarray, dict]]:
    """Return the tables of detections of a film, each with the settings it needs."""
    film = datasets.load(id, plan.progress)
    found = {"own": (detect(film.frames, store=plan.folder / "detection", progress=plan.progress), {})}
    if id in PUBLISHED_SCORE:
        found["published"] = film.detections, {"birth_score": PUBLISHED_SCORE[id]}
    return found


def _scored(plan: Plan, tasks) -> list[dict[str, float]]:
    return list(plan.each(_score, tasks))


def _score(library: str, id: str, settings: dict, found: np.ndarray, seed: int, end: int | None) -> dict[str, float]:
    """Let a filter follow everybody in the first frames of a film, and score it."""
    film = datasets.load(id, progress=False)
    frames = film.frames[:end]
    tracker = multi.AssociationParticleFilter(seed=seed, **settings)
    tracks = multi.table(multi.follow(tracker, frames, found))
    return metrics.multi_target(tracks, film.tracks[film.tracks[:, 0] < len(frames)]).as_dict()
