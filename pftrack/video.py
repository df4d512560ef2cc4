"""Writing annotated video that plays in a browser: H.264 in MP4, through PyAV."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np

from pftrack.color import pixel_edges
from pftrack.files import replacing


def _write_mp4(path: Path, frames: Iterable[np.ndarray], fps: float, quality: int) -> None:
    """Encode frames; odd widths and heights lose a row or column, as H.264 needs."""
    rate = Fraction(fps).limit_denominator(1001)
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = None
        for frame in frames:
            if stream is None:
                stream = container.add_stream("libx264", rate=rate, options={"crf": str(quality), "preset": "medium"})
                stream.height, stream.width = (side // 2 * 2 for side in frame.shape[:2])
                if min(stream.height, stream.width) == 0:
                    raise ValueError(f"frames must have at least 2x2 pixels, got {frame.shape[1]}x{frame.shape[0]}")
                stream.pix_fmt = "yuv420p"
                stream.thread_count = 1  # the same bytes on every machine
            even = np.ascontiguousarray(frame[: stream.height, : stream.width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="bgr24")))
        if stream is None:
            raise ValueError("there are no frames to write")
        container.mux(stream.encode())


def encode(frames: Iterable[np.ndarray], fps: float, quality: int = 28) -> bytes:
    """Encode frames as an MP4 in memory.

    Parameters
    ----------
    frames : iterable of ndarray, shape (H, W, 3), uint8
        Pictures in BGR order, all of one size.
    fps : float
        Frames a second.
    quality : int
        H.264's constant rate factor: 18 looks perfect, 28 is small.

    Returns
    -------
    bytes
        The file.

    Raises
    ------
    ValueError
        If there are no frames.

    Examples
    --------
    >>> encode([np.zeros((48, 64, 3), dtype=np.uint8)], fps=25)[4:8]
    b'ftyp'
    """
    with tempfile.TemporaryDirectory() as folder:  # a real file, since moving the index to the front re-reads it
        path = Path(folder) / "clip.mp4"
        _write_mp4(path, frames, fps, quality)
        return path.read_bytes()


def write(path: str | os.PathLike, frames: Iterable[np.ndarray], fps: float, quality: int = 23) -> None:
    """Write frames to an MP4 file that plays in a browser; the file appears only when it is complete.

    Parameters
    ----------
    path : path
        Where to write; an existing file is replaced.
    frames, fps, quality
        As for :func:`encode`; frames may be a generator, and only one is held at a time.

    Raises
    ------
    ValueError
        If there are no frames.
    OSError
        If the file cannot be written; nothing is left behind.
    """
    with replacing(path) as temporary:
        _write_mp4(temporary, frames, fps, quality)


def annotate(frame: np.ndarray, box, *, lost: bool = False, truth=None, particles=None) -> np.ndarray:
    """Copy of a frame with the tracker's box, and optionally the true box and the particles, drawn on it.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        The picture in BGR order.
    box : array_like, shape (4,)
        The tracker's box, vermilion, or yellow when lost. NaN draws nothing.
    lost : bool
        Whether the tracker has lost its target.
    truth : array_like, shape (4,), optional
        The true box, blue and half transparent as in Owczarek et al. 2015, Fig. 4.
    particles : array_like, shape (N, d), optional
        States whose first two columns are x and y; orange dots.

    Returns
    -------
    ndarray, shape (H, W, 3), uint8
        The annotated picture.
    """
    picture = frame.copy()
    if truth is not None and np.isfinite(truth).all():
        height, width = frame.shape[:2]
        left, top, right, bottom = np.clip(pixel_edges([truth])[0], 0, [width, height, width, height])
        area = picture[top:bottom, left:right]
        area[:] = 0.65 * area + 0.35 * np.array([178, 114, 0])
    for x, y in np.rint(np.asarray(particles)[:, :2]).astype(int) if particles is not None else ():
        cv2.circle(picture, (int(x), int(y)), 2, (0, 159, 230), -1, cv2.LINE_AA)
    if np.isfinite(box).all():
        x, y, w, h = np.rint(box).astype(int)
        color = (66, 228, 240) if lost else (0, 94, 213)
        cv2.rectangle(picture, (x, y), (x + w, y + h), color, 2)
    if lost:
        cv2.putText(picture, "lost", (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(picture, "lost", (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (66, 228, 240), 2, cv2.LINE_AA)
    return picture


TRACK_COLORS = ((0, 94, 213), (178, 114, 0), (115, 158, 0), (0, 159, 230), (167, 121, 204), (233, 180, 86))
"""Colours of tracks by number, in BGR order; they are six of Okabe and Ito's."""


def annotate_tracks(frame: np.ndarray, tracks, particles: bool = False) -> np.ndarray:
    """Copy of a frame with the box and the number of every track drawn on it.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        The picture in BGR order.
    tracks : list of pftrack.multi.Track
        The tracks in it. The box of one that is held, because its target is hidden, is thin.
    particles : bool
        Whether to draw the particles too.

    Returns
    -------
    ndarray, shape (H, W, 3), uint8
        The annotated picture.
    """
    picture = frame.copy()
    for track in tracks:
        color = TRACK_COLORS[(track.id - 1) % len(TRACK_COLORS)]
        for x, y in np.rint(track.particles[:, :2]).astype(int) if particles and track.particles is not None else ():
            cv2.circle(picture, (int(x), int(y)), 1, color, -1, cv2.LINE_AA)
        x, y, w, h = np.rint(track.box).astype(int).tolist()
        cv2.rectangle(picture, (x, y), (x + w, y + h), color, 1 if track.held else 2)
        at = (x + 2, y + 14) if y < 16 else (x, y - 4)
        cv2.putText(picture, str(track.id), at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(picture, str(track.id), at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return picture
