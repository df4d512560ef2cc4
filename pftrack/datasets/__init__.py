"""Footage with ground truth: real sequences through a registry, and synthetic scenes with exact truth.

>>> from pftrack import datasets
>>> scene = datasets.load("synthetic-walk")
>>> len(scene), scene.frames[0].shape, scene.boxes.shape
(100, (240, 320, 3), (100, 4))
"""

from pftrack.datasets import readers, registry, synthetic
from pftrack.datasets.frames import Frames, ImageFrames, VideoFrames, open_frames
from pftrack.datasets.sequence import Sequence

__all__ = [
    "Frames",
    "ImageFrames",
    "Sequence",
    "VideoFrames",
    "ids",
    "load",
    "open_frames",
    "readers",
    "registry",
    "synthetic",
]


def ids() -> list[str]:
    """Names of all datasets, real and synthetic."""
    return [*registry.ENTRIES, *synthetic.SCENES]


def load(id: str, progress: bool = True) -> Sequence:
    """Load a dataset by its id.

    Looks in ``$PFTRACK_DATA/<id>``, then in the user's cache, and otherwise downloads what is missing. Synthetic
    scenes need no files.

    Parameters
    ----------
    id : str
        One of :func:`ids`.
    progress : bool
        Whether to show a progress bar if something must be downloaded.

    Returns
    -------
    Sequence
        Lazy frames, boxes, tracks, frame rate, licence and citation.

    Raises
    ------
    ValueError
        If there is no such dataset, or a file of it is damaged.
    FileNotFoundError
        If its files are not here and cannot be downloaded.

    Examples
    --------
    >>> load("synthetic-crossing").ids
    [1, 2]
    """
    if id in synthetic.SCENES:
        return synthetic.scene(name=id, **synthetic.SCENES[id])
    if id not in registry.ENTRIES:
        raise ValueError(f"unknown dataset {id!r}; there are {', '.join(ids())}")
    return registry.ENTRIES[id].read(registry.ENTRIES[id], registry.fetch(id, progress))
