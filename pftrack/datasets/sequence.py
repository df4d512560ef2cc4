"""A sequence: frames, the truth about them, and where they come from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pftrack.datasets.frames import Dimmed, Frames
from pftrack.datasets.readers import boxes_of


@dataclass(frozen=True)
class Sequence:
    """Footage with its ground truth.

    Attributes
    ----------
    name, title : str
        The dataset id, and what it shows.
    frames : Frames
        The pictures, ``(H, W, 3)`` uint8 in BGR order, read one at a time; indexable, with a length `T`.
    tracks : ndarray, shape (R, 7)
        All true boxes, one a row: ``frame, id, x, y, w, h, score``, frames from 0 (see
        :mod:`pftrack.datasets.readers`).
    fps : float
        Frames a second.
    licence, citation : str
        On what terms the footage may be used, and whom to credit.
    detections : ndarray, shape (D, 7), or None
        Published detections of another system, as rows like those of `tracks`, with id -1 and a score.
    """

    name: str
    title: str
    frames: Frames
    tracks: np.ndarray
    fps: float
    licence: str
    citation: str
    detections: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def ids(self) -> list[int]:
        """Identities of the targets, in the order of their first appearance."""
        return list(dict.fromkeys(self.tracks[:, 1].astype(int).tolist()))

    def target(self, target: int) -> np.ndarray:
        """Boxes of one target, shape (T, 4), NaN where it is hidden or absent.

        Raises
        ------
        ValueError
            If there is no such id.
        """
        return boxes_of(self.tracks, target, len(self.frames))

    @property
    def boxes(self) -> np.ndarray:
        """Boxes of the first target, shape (T, 4), NaN where it is hidden or absent."""
        return self.target(self.ids[0])

    def dimmed(self, illumination: float) -> Sequence:
        """Return the same sequence in light that fades, see :class:`~pftrack.datasets.frames.Dimmed`.

        Its name says so, and it has no published detections: they were not made in that light.

        Examples
        --------
        >>> import pftrack
        >>> scene = pftrack.datasets.load("synthetic-walk").dimmed(0.6)
        >>> scene.name, [round(float(frame.mean())) for frame in scene.frames[::99]]
        ('synthetic-walk (dimmed)', [125, 50])
        """
        return replace(self, name=f"{self.name} (dimmed)", frames=Dimmed(self.frames, illumination), detections=None)
