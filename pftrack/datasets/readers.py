"""Ground-truth files: one reader a format, all returning the same table.

A table of *tracks* is a float array of shape ``(R, 7)``, one box a row, with the columns
``frame, id, x, y, w, h, score``: frames counted from 0, boxes in pixels from the top-left corner, score 1 for a true
box. It is what MOTChallenge files hold, but for their counting from 1. Rows are sorted by frame, then by id.
"""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from pftrack.files import replacing

COLUMNS = ("frame", "id", "x", "y", "w", "h", "score")
"""Columns of a table of tracks."""


def _text(path: str | os.PathLike) -> str:
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not a text file") from error


def _table(rows) -> np.ndarray:
    table = np.array(rows, dtype=float).reshape(-1, len(COLUMNS))
    return table[np.lexsort((table[:, 1], table[:, 0]))]


def read_bobot(path: str | os.PathLike, image_size: tuple[int, int], target: int = 1) -> np.ndarray:
    """Read the truth of a BoBoT sequence.

    The first line names the video; each later one is ``frame x y w h``, with x and w divided by the image's width and
    y and h by its height. A box of zeros marks a frame where the target is hidden; it gets no row.

    Parameters
    ----------
    path : path
        The text file.
    image_size : tuple of int
        ``(width, height)`` of the frames in pixels.
    target : int
        The id to write into the table; the file itself describes one target.

    Returns
    -------
    ndarray, shape (R, 7)
        A table of tracks.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If a line does not have five numbers.
    """
    width, height = image_size
    rows = []
    for number, line in enumerate(_text(path).splitlines()[1:], start=2):
        if not line.strip():
            continue
        try:
            frame, x, y, w, h = (float(word) for word in line.split())
        except ValueError:
            raise ValueError(f"{path}, line {number}: expected 'frame x y w h', got {line!r}") from None
        if w > 0 and h > 0:
            rows.append([frame, target, x * width, y * height, w * width, h * height, 1.0])
    return _table(rows)


def read_mot(path: str | os.PathLike) -> np.ndarray:
    """Read tracks or detections in the format of the MOTChallenge.

    Lines are ``frame,id,x,y,w,h,score,...`` with frames from 1; detections carry the id -1. Columns after the seventh
    are ignored.

    Parameters
    ----------
    path : path
        The text file.

    Returns
    -------
    ndarray, shape (R, 7)
        A table of tracks, frames from 0.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If a line does not begin with seven numbers.
    """
    rows = []
    for number, line in enumerate(_text(path).splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split(",")[:7]]
            if len(row) < 7:
                raise ValueError
        except ValueError:
            raise ValueError(f"{path}, line {number}: expected 'frame,id,x,y,w,h,score', got {line!r}") from None
        rows.append([row[0] - 1, *row[1:]])
    return _table(rows)


def write_mot(path: str | os.PathLike, tracks) -> None:
    """Write a table of tracks as MOTChallenge rows, ``frame,id,x,y,w,h,score,-1,-1,-1``, frames from 1.

    Parameters
    ----------
    path : path
        Where to write; the file appears only when it is complete.
    tracks : array_like, shape (R, 7)
        A table of tracks, frames from 0.
    """
    lines = [
        f"{int(frame) + 1},{int(target)},{x:g},{y:g},{w:g},{h:g},{score:g},-1,-1,-1\n"
        for frame, target, x, y, w, h, score in np.asarray(tracks, dtype=float)
    ]
    with replacing(path) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")


def read_xml(path: str | os.PathLike) -> np.ndarray:
    """Read the truth of a CAVIAR clip, or of PETS 2009 as annotated by A. Milan, who used the same format.

    Each ``<frame number="...">`` lists objects with an id and a ``<box>`` whose ``xc`` and ``yc`` are its *centre*.
    CAVIAR's groups, roles and hypotheses are not read.

    Parameters
    ----------
    path : path
        The XML file.

    Returns
    -------
    ndarray, shape (R, 7)
        A table of tracks, frames from 0.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is not XML of this form.
    """
    try:
        frames = list(ElementTree.fromstring(_text(path)).iter("frame"))
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is not a CAVIAR or PETS ground-truth file: {error}") from error
    if not frames:
        raise ValueError(f"{path} is not a CAVIAR or PETS ground-truth file: it has no <frame>")
    rows = []
    for frame in frames:
        try:
            number = int(frame.attrib["number"])
            for item in frame.iterfind("objectlist/object"):
                box = item.find("box").attrib
                w, h = float(box["w"]), float(box["h"])
                x, y = float(box["xc"]) - w / 2, float(box["yc"]) - h / 2
                rows.append([number, float(item.attrib["id"]), x, y, w, h, 1.0])
        except (AttributeError, KeyError, ValueError) as error:
            raise ValueError(
                f"{path} is not a CAVIAR or PETS ground-truth file: in frame {frame.get('number')} an object has no "
                f"readable id or box ({error})"
            ) from error
    return _table(rows)


def boxes_of(tracks, target: int, n_frames: int) -> np.ndarray:
    """Boxes of one target from a table of tracks.

    Parameters
    ----------
    tracks : array_like, shape (R, 7)
        A table of tracks.
    target : int
        The target's id.
    n_frames : int
        Length of the sequence, `T`.

    Returns
    -------
    ndarray, shape (T, 4)
        ``(x, y, w, h)`` in pixels; NaN in frames that have no row for the target.

    Raises
    ------
    ValueError
        If the table has no row of that target.

    Examples
    --------
    >>> boxes_of([[1, 7, 10, 20, 30, 40, 1]], target=7, n_frames=2)
    array([[nan, nan, nan, nan],
           [10., 20., 30., 40.]])
    """
    tracks = np.asarray(tracks, dtype=float)
    rows = tracks[(tracks[:, 1] == target) & (tracks[:, 0] < n_frames)]
    if not len(rows):
        raise ValueError(f"there is no target {target}; the ids are {sorted({int(i) for i in tracks[:, 1]})}")
    boxes = np.full((n_frames, 4), np.nan)
    boxes[rows[:, 0].astype(int)] = rows[:, 2:6]
    return boxes
