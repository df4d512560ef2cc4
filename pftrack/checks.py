"""Checks of what is handed in: a picture, a box, a seed. Each says what is wrong and what to do."""

from __future__ import annotations

import numpy as np

MIN_SIDE = 2
"""Smallest width and height, in visible pixels, of a box that a tracker accepts."""

LARGEST = 1e6
"""Largest number, in pixels, that makes sense in a box."""


def check_picture(frame) -> np.ndarray:
    """Return the frame, or say why it is no colour image.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.

    Raises
    ------
    ValueError
        If the frame is not a three-channel uint8 image.
    """
    if not isinstance(frame, np.ndarray) or frame.ndim != 3 or frame.shape[2] != 3 or frame.size == 0:
        found = f"shape {frame.shape}" if isinstance(frame, np.ndarray) else type(frame).__name__
        raise ValueError(
            f"a frame must be a colour image of shape (H, W, 3), got {found}; convert grey or four-channel images "
            "with cv2.cvtColor first"
        )
    if frame.dtype != np.uint8:
        raise ValueError(f"a frame must have dtype uint8 with values 0 to 255, got {frame.dtype}")
    return frame


def check_same_size(shape: tuple[int, ...], first: tuple[int, ...] | None) -> None:
    """Make sure that a frame has the size of the first one.

    Parameters
    ----------
    shape : tuple of int
        Shape of the frame, ``(H, W, 3)``.
    first : tuple of int or None
        Shape of the first frame; None if this is the first.

    Raises
    ------
    ValueError
        If they differ.
    """
    if first is not None and shape != first:
        raise ValueError(
            f"the frame is {shape[1]}x{shape[0]} but tracking began on {first[1]}x{first[0]}; "
            "all frames must have one size"
        )


def check_box(box, frame: np.ndarray) -> np.ndarray:
    """Return the box as floats, or say what is wrong with it.

    Parameters
    ----------
    box : array_like, shape (4,)
        ``(x, y, w, h)`` in pixels; it may reach over the border, but not lie beyond it.
    frame : ndarray, shape (H, W, 3)
        The image it is drawn on.

    Raises
    ------
    ValueError
        If the box has not four finite numbers, is empty, or shows less than 2x2 pixels of the frame.
    """
    given = box
    try:
        box = np.array(given, dtype=float)
    except (TypeError, ValueError):
        box = np.empty(0)
    if box.shape != (4,) or not np.all(np.abs(box) <= LARGEST):
        raise ValueError(f"a box must be four finite numbers x, y, w, h in pixels, got {given!r}")
    x, y, w, h = box
    if w <= 0 or h <= 0:
        raise ValueError(f"the box {box.tolist()} is empty; width and height must be positive")
    height, width = frame.shape[:2]
    visible = min(x + w, width) - max(x, 0), min(y + h, height) - max(y, 0)
    if min(visible) <= 0:
        raise ValueError(f"the box {box.tolist()} lies outside the {width}x{height} frame")
    if min(visible) < MIN_SIDE:
        raise ValueError(
            f"the box {box.tolist()} shows less than {MIN_SIDE}x{MIN_SIDE} pixels of the {width}x{height} frame, "
            "too few to learn the target's colours from"
        )
    return box


def is_shown(box, frame: np.ndarray) -> bool:
    """Tell whether a frame shows enough of a box to measure it, as :func:`check_box` demands.

    Parameters
    ----------
    box : array_like, shape (4,)
        ``(x, y, w, h)`` in pixels.
    frame : ndarray, shape (H, W, 3), uint8
        The frame.

    Returns
    -------
    bool
        False where :func:`check_box` would raise.

    Examples
    --------
    >>> frame = np.zeros((100, 100, 3), dtype=np.uint8)
    >>> is_shown((10, 10, 20, 40), frame), is_shown((200, 10, 20, 40), frame)
    (True, False)
    """
    try:
        check_box(box, frame)
    except ValueError:
        return False
    return True


def check_seed(seed) -> None:
    """Make sure that a seed is one.

    Raises
    ------
    ValueError
        If it is neither a non-negative integer nor a generator.
    """
    if not (isinstance(seed, np.random.Generator) or (isinstance(seed, (int, np.integer)) and seed >= 0)):
        raise ValueError(f"seed must be a non-negative integer or a Generator, got {seed}")
