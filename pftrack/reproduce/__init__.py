"""The full-size experiments behind the book: the figures and tables of the three papers, and more.

Each item of :data:`ITEMS` takes a :class:`~pftrack.reproduce.plan.Plan` and writes one or two files below
``results/``; ``pftrack reproduce`` runs them. The files are plain CSV under lines ``# key: value`` that say the
settings, versions and machine; :func:`~pftrack.reproduce.plan.read` gives both. What has been computed is kept in the
user's cache, so an interrupted item goes on where it stopped, and items share their runs. Chapters 6 to 11 show the
files and re-run a part of them.

In the items of one pedestrian (:mod:`pftrack.reproduce.one`) overlaps and hits are given twice, over ``all`` frames, a
hidden one counting as overlap 0 and as a miss, and over the ``visible`` ones (see :mod:`pftrack.metrics`). And "± sd"
can mean three things, of which the paper names none:

runs
    standard deviation, over runs (or masks), of a run's mean over frames: how much one run differs from the next;
frames
    standard deviation over the frames of one run, averaged over runs: how much a run goes up and down;
band
    standard deviation over runs in one frame, averaged over frames: the mean half-width of the grey band of Fig. 6.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pftrack.reproduce.crowd import association, association_steps
from pftrack.reproduce.many import bof, bof_steps, detection, detectors
from pftrack.reproduce.one import (
    BARE,
    PAPER,
    ablation,
    ablation_steps,
    fig3,
    fig6a,
    fig6b,
    sensitivity,
    table2,
    variations,
)
from pftrack.reproduce.plan import PARTICLES, Plan, machine, read, spread, write
from pftrack.reproduce.rivals import PRINTED, comparison

__all__ = [
    "BARE",
    "ITEMS",
    "PAPER",
    "PARTICLES",
    "PRINTED",
    "Plan",
    "ablation_steps",
    "association_steps",
    "bof_steps",
    "detectors",
    "machine",
    "read",
    "run",
    "spread",
    "variations",
    "write",
]

ITEMS = {
    "fig3": fig3,
    "fig6b": fig6b,
    "fig6a": fig6a,
    "table2": table2,
    "sensitivity": sensitivity,
    "ablation": ablation,
    "detection": detection,
    "bof": bof,
    "comparison": comparison,
    "association": association,
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
