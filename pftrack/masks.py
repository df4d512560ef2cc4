r"""The exhaustive search over colour masks behind the CAMSHIFT results of Owczarek et al. 2015.

Fig. 6a and Table II show the best 100 of 278,784 results: one CAMSHIFT run over the film for each way to mask the
target's colours. The paper names only the count. It is the square of the number of intervals whose ends are multiples
of 8 in 0 to 256, :math:`\binom{33}{2}^2 = 528^2`, so we read a *mask* as an interval of saturation times one of value.
Chapter 6 runs the search.

:func:`run_mask` is the tracker by OpenCV itself, as in its CAMSHIFT sample, one mask at a time. :func:`search` follows
all masks to the same windows, pixel for pixel. What makes it fast changes no result:

- Ends at multiples of 8 cut saturation and value into 32 cells each, so with the hue bin 14 bits say all that a mask
  can know of a pixel. The film is encoded once, and the back-projection of a mask becomes a table of 16,384 bytes.
- Masks whose tables agree on every code that occurs in the film make one tracker, and are followed once.
- Moments are sums of whole numbers, hence exact. When a window moves, only what enters and leaves it is summed.
- A mask is given up when even the highest overlaps possible in all frames to come could not bring it among the best:
  1 for CAMSHIFT, and for Mean-Shift, with its fixed window, that of a window which shares a corner with the truth.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import joblib
import numpy as np
from numba import njit
from tqdm.auto import tqdm

from pftrack import color, files, metrics
from pftrack.checks import check_box
from pftrack.trackers.base import check_frame

N_HUES = 16
"""Hue bins of OpenCV's CAMSHIFT sample."""

CELL = 8
"""Levels of saturation or value in one cell; the ends of the masks are multiples of it."""

N_CELLS = 256 // CELL
"""Cells of saturation, and of value."""

MAX_ITERATIONS = 10
"""Most Mean-Shift iterations a frame in the sample; it also stops at a step shorter than 1 pixel."""

CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, MAX_ITERATIONS, 1)
MARGIN = 10  # pixels by which OpenCV's CAMSHIFT widens the window on every side before it fits it
BLOCK = 256  # masks that a worker is given at once
STRETCH = 32  # frames between two looks at which masks to give up


@dataclass(frozen=True)
class MaskSearch:
    """The best masks of a search, the best one first; from :func:`search`.

    Attributes
    ----------
    masks : ndarray of int, shape (n_best, 4)
        Half-open intervals ``s_low, s_high, v_low, v_high`` of saturation and value, 0 to 256.
    overlap_mean, hit_ratio : ndarray, shape (n_best,)
        Mean overlap and share of hits, from 0 to 1, over all frames, a hidden one counting as 0 and as a miss.
    overlaps : ndarray, shape (n_best, T)
        Overlap in each frame, from 0 to 1; NaN where the truth is hidden.
    iterations : ndarray of int, shape (n_best, T)
        Mean-Shift iterations in each frame as OpenCV counts them, 0 to 10; 0 in the first frame.
    n_completed : int
        How many masks were followed to the last frame. The others were given up. How soon depends on which worker is
        done first, so this number, and no other, may differ from run to run.
    """

    masks: np.ndarray
    overlap_mean: np.ndarray
    hit_ratio: np.ndarray
    overlaps: np.ndarray
    iterations: np.ndarray
    n_completed: int


def intervals(step: int = CELL) -> np.ndarray:
    """All half-open intervals of levels whose ends are multiples of a step.

    Parameters
    ----------
    step : int
        A divisor of 256.

    Returns
    -------
    ndarray of int, shape (n, 2)
        Rows ``low, high`` with ``0 <= low < high <= 256``, in order; they admit the levels from low to high - 1.

    Raises
    ------
    ValueError
        If `step` does not divide 256.

    Examples
    --------
    >>> intervals(128).tolist()
    [[0, 128], [0, 256], [128, 256]]
    >>> len(intervals())
    528
    """
    if step not in [2**power for power in range(9)]:
        raise ValueError(f"step must divide 256, as 8 and 64 do, got {step}")
    low, last = np.triu_indices(256 // step)
    return step * np.column_stack([low, last + 1])


def all_masks() -> np.ndarray:
    """All masks of the search: every interval of saturation with every interval of value.

    Returns
    -------
    ndarray of int, shape (278784, 4)
        Rows ``s_low, s_high, v_low, v_high``; the intervals are half-open.

    Examples
    --------
    >>> all_masks()[[0, -1]].tolist()
    [[0, 8, 0, 8], [248, 256, 248, 256]]
    """
    sides = intervals()
    return np.hstack([np.repeat(sides, len(sides), axis=0), np.tile(sides, (len(sides), 1))])


def run_mask(frames, box, mask, tracker: str = "camshift") -> tuple[np.ndarray, np.ndarray]:
    """Track through a film with one mask, by OpenCV's own functions, as its CAMSHIFT sample does.

    Slow and plain: the truth to which :func:`search` is held.

    Parameters
    ----------
    frames : iterable of ndarray, shape (H, W, 3), uint8
        The film, in BGR order.
    box : array_like, shape (4,)
        The target in the first frame, ``(x, y, w, h)`` in pixels.
    mask : array_like of int, shape (4,)
        Half-open intervals ``s_low, s_high, v_low, v_high`` of saturation and value, 0 to 256.
    tracker : {"camshift", "mean-shift"}
        CAMSHIFT goes on with whatever window OpenCV returns, and where that shows nothing of the target, it grows by 10
        pixels a side (:class:`~pftrack.trackers.camshift.CamShiftTracker` keeps it instead). Mean-Shift's window keeps
        its size.

    Returns
    -------
    windows : ndarray, shape (T, 4)
        ``(x, y, w, h)`` in pixels: the given box in the first frame, OpenCV's window in the others.
    iterations : ndarray of int, shape (T,)
        Mean-Shift iterations as OpenCV counts them: those that moved the window, 0 to 10; 0 in the first frame.

    Raises
    ------
    ValueError
        If a frame, the box, the mask or the name of the tracker is unusable.

    Examples
    --------
    >>> frame = np.zeros((60, 80, 3), dtype=np.uint8)
    >>> frame[20:40, 30:40] = (255, 0, 0)
    >>> film = [frame, np.roll(frame, 4, axis=1)]
    >>> windows, iterations = run_mask(film, (30, 20, 10, 20), (64, 256, 32, 256), "mean-shift")
    >>> print(windows[1], iterations[1])  # the target moved by 4; OpenCV stops where a step rounds to 0
    [32. 20. 10. 20.] 1
    """
    s_low, s_high, v_low, v_high = (int(end) for end in _check_masks([mask])[0])
    admitted = (s_low, s_high - 1), (v_low, v_high - 1)
    is_camshift = _check_tracker(tracker)
    windows, iterations, shape = [], [], None
    for frame in frames:
        check_frame(frame, shape)
        if shape is None:
            window, shape = _first_window(box, frame), frame.shape
            histogram = color.masked_histogram(frame, box, *admitted, N_HUES)
            windows, iterations = [box], [0]
            continue
        probability = color.back_projection(frame, histogram, *admitted)
        count, moved = cv2.meanShift(probability, window, CRITERIA)
        window = _cam_shift(probability, window) if is_camshift else moved
        windows.append(window)
        iterations.append(count)
    return np.array(windows, dtype=float).reshape(-1, 4), np.array(iterations, dtype=int)


def search(
    frames,
    truth,
    *,
    tracker: str = "camshift",
    masks=None,
    n_best: int = 100,
    n_jobs: int = 1,
    store=None,
    progress: bool = False,
) -> MaskSearch:
    """Find the masks with which a tracker reaches the highest mean overlap.

    Parameters
    ----------
    frames : iterable of ndarray, shape (H, W, 3), uint8
        The film, in BGR order; it is read once.
    truth : array_like, shape (T, 4)
        True boxes ``(x, y, w, h)`` in pixels, NaN where the target is hidden. Tracking starts from the first.
    tracker : {"camshift", "mean-shift"}
        What to run; see :func:`run_mask`.
    masks : array_like of int, shape (M, 4), optional
        The masks to try, half-open, with ends at multiples of 8; by default :func:`all_masks`.
    n_best : int
        How many to return; all of them, if there are fewer. Between equals the earlier one comes first.
    n_jobs : int
        Number of worker processes, as ``joblib.Parallel`` counts them.
    store : path, optional
        A folder in which to keep the finished blocks of masks, so that a search that was interrupted goes on where it
        stopped. Blocks of another film, other settings or another version of the code are left alone.
    progress : bool
        Whether to show a progress bar.

    Returns
    -------
    MaskSearch
        The best masks, and how they did.

    Raises
    ------
    ValueError
        If a frame, the truth, a mask or a setting is unusable.

    Examples
    --------
    >>> import pftrack
    >>> scene = pftrack.datasets.load("synthetic-walk")
    >>> masks = [[0, 256, 0, 256], [64, 256, 32, 256]]
    >>> search(scene.frames[:10], scene.boxes[:10], masks=masks, n_best=1).masks
    array([[ 64, 256,  32, 256]])
    """
    is_camshift = _check_tracker(tracker)
    masks = all_masks() if masks is None else _check_masks(masks)
    if n_best < 1 or n_jobs == 0:
        raise ValueError(f"n_best must be at least 1 and n_jobs not 0, got {n_best} and {n_jobs}")
    truth = np.asarray(truth, dtype=float)
    if truth.ndim != 2 or truth.shape[1] != 4 or len(truth) == 0:
        raise ValueError(f"truth must hold a box x, y, w, h for each frame, shape (T, 4), got {truth.shape}")
    film = _encode(frames, truth, is_camshift)
    first, twin = _merge(film, masks)
    n_best = min(n_best, len(masks))
    folder = None if store is None else _folder(Path(store), film, masks, n_best)
    means = _run_blocks(film, masks[first], twin, n_best, n_jobs, folder, progress)[twin]
    best = np.argsort(-means, stable=True)[:n_best]
    paths, iterations, _ = _follow(film, masks[best])
    overlaps = np.array([metrics.overlap(path, truth) for path in paths])
    counted = np.nan_to_num(overlaps)
    return MaskSearch(
        masks=masks[best],
        overlap_mean=counted.mean(axis=1),
        hit_ratio=(counted >= metrics.HIT_OVERLAP).mean(axis=1),
        overlaps=overlaps,
        iterations=iterations,
        n_completed=int(np.isfinite(means).sum()),
    )


@dataclass(frozen=True)
class _Film:
    """What all masks have in common."""

    codes: np.ndarray  # (T, H, W): hue bin in bits 10 to 13, cells of saturation and value in bits 5 to 9 and 0 to 4
    counts: np.ndarray  # (16, 32, 32): how often each code occurs in the first window
    window: tuple[int, int, int, int]
    truth: np.ndarray
    is_camshift: bool


def _encode(frames, truth, is_camshift) -> _Film:
    bins = np.arange(N_HUES, dtype=np.float32)[:, None]  # back-projecting this histogram gives the bin of each hue
    bins = cv2.calcBackProject([np.arange(180, dtype=np.uint8)], [0], bins, [0, 180], 1).ravel().astype(np.uint16)
    codes, window, shape = [], None, None
    for frame in frames:
        shape = check_frame(frame, shape).shape
        window = window or _first_window(truth[0], frame)
        hue, saturation, value = cv2.split(cv2.cvtColor(frame, cv2.COLOR_BGR2HSV))
        codes.append(bins[hue] << 10 | (saturation // CELL).astype(np.uint16) << 5 | value // CELL)
    if len(codes) != len(truth):
        raise ValueError(f"frames and truth must be equally long, got {len(codes)} and {len(truth)}")
    x, y, w, h = window
    shape = N_HUES, N_CELLS, N_CELLS
    counts = np.bincount(codes[0][y : y + h, x : x + w].ravel(), minlength=math.prod(shape)).reshape(shape)
    codes = np.array(codes)
    codes.flags.writeable = False  # as it reaches a worker: numba compiles for one kind only
    return _Film(codes, counts, window, truth, is_camshift)


def _table(film, mask) -> np.ndarray:
    """Back-projection of each code under a mask, (16, 32, 32) uint8."""
    s_low, s_high, v_low, v_high = mask // CELL
    histogram = film.counts[:, s_low:s_high, v_low:v_high].sum(axis=(1, 2)).astype(np.float32)
    table = np.zeros(film.counts.shape, dtype=np.uint8)
    weights = np.rint(cv2.normalize(histogram, None, 0, 255, cv2.NORM_MINMAX))
    table[:, s_low:s_high, v_low:v_high] = weights.reshape(-1, 1, 1)
    return table


def _merge(film, masks) -> tuple[np.ndarray, np.ndarray]:
    """Find the masks that differ in this film: their indices (D,), and for every mask its place among them (M,)."""
    occurs = np.zeros(film.counts.size, dtype=bool)
    for codes in film.codes:
        occurs[codes] = True
    occurs = occurs.reshape(film.counts.shape)
    first, places, twin = [], {}, np.empty(len(masks), dtype=int)
    for index, mask in enumerate(masks):
        digest = hashlib.blake2b(_table(film, mask) * occurs, digest_size=16).digest()
        twin[index] = places.setdefault(digest, len(places))
        if len(places) > len(first):
            first.append(index)
    return np.array(first), twin


def _folder(store, film, masks, n_best) -> Path:
    """Make the folder for the blocks of exactly this search by exactly this code."""
    digest = hashlib.blake2b(digest_size=16)
    for source in (__file__, color.__file__, metrics.single.__file__):
        digest.update(Path(source).read_bytes())
    digest.update(repr((cv2.__version__, film.codes.shape, film.is_camshift, n_best)).encode())
    for array in (film.codes, film.truth, masks):
        digest.update(np.ascontiguousarray(array))
    folder = store / digest.hexdigest()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _run_blocks(film, masks, twin, n_best, n_jobs, folder, progress) -> np.ndarray:
    """Mean overlap of each of the masks that differ, -inf if given up."""
    means = np.full(len(masks), -np.inf)
    order = np.random.default_rng(0).permutation(len(masks))  # good masks met early spare work on the others
    blocks = np.split(order, range(BLOCK, len(order), BLOCK))
    paths = [] if folder is None else [folder / f"{number}.npz" for number in range(len(blocks))]
    stored = [number for number, path in enumerate(paths) if path.exists()]
    for number in stored:
        with np.load(paths[number]) as file:
            means[blocks[number]] = file["means"]

    def tasks():  # drawn one by one, so that each knows the n_best-th best mean of the blocks that were back before it
        for number in sorted(set(range(len(blocks))) - set(stored)):
            floor = np.partition(means[twin], -n_best)[-n_best]
            yield joblib.delayed(_score)(number, film, masks[blocks[number]], floor)

    workers = joblib.Parallel(n_jobs, return_as="generator_unordered", batch_size=1, pre_dispatch="n_jobs")
    with tqdm(total=len(blocks), initial=len(stored), unit="block", disable=not progress) as bar:
        for number, result in workers(tasks()):
            means[blocks[number]] = result
            if folder is not None:
                with files.replacing(paths[number]) as temporary, temporary.open("wb") as file:
                    np.savez(file, means=result)
            bar.update()
    return means


def _attainable(film) -> np.ndarray:
    """Highest overlap that a tracker can have in each frame, (T,)."""
    truth = np.hstack([np.zeros_like(film.truth[:, :2]), film.truth[:, 2:]])
    box = truth if film.is_camshift else np.tile([0, 0, *film.window[2:]], (len(truth), 1))
    return np.nan_to_num(metrics.overlap(box, truth))


def _score(number, film, masks, floor) -> tuple[int, np.ndarray]:
    """Return the number of a block, and the mean overlap of each of its masks, -inf if given up."""
    paths, _, completed = _follow(film, masks, floor)
    means = np.full(len(masks), -np.inf)
    means[completed] = [np.nan_to_num(metrics.overlap(path, film.truth)).mean() for path in paths[completed]]
    return number, means


def _follow(film, masks, floor: float = -np.inf) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Follow masks: their windows (M, T, 4), iterations (M, T), and whether each was followed to the end (M,).

    Those that can no longer reach a mean overlap of `floor` are given up on the way.
    """
    codes = np.asarray(film.codes)  # in a worker it is a memory map
    n_frames, to_come = len(codes), _attainable(film)
    paths = np.empty((len(masks), n_frames, 4))
    paths[:, 0] = film.truth[0]
    iterations = np.zeros((len(masks), n_frames), dtype=int)
    alive, sums = np.arange(len(masks)), np.ones(len(masks))
    tables = np.array([_table(film, mask).ravel() for mask in masks])
    windows = np.tile(film.window, (len(masks), 1))
    for start in range(1, n_frames, STRETCH):
        keep = sums + to_come[start:].sum() > (floor - 1e-9) * n_frames  # rounding must not cost a mask its place
        alive, sums, tables, windows = alive[keep], sums[keep], tables[keep], windows[keep]
        part = slice(start, min(start + STRETCH, n_frames))
        found = np.empty((len(alive), part.stop - start, 5), dtype=np.int64)
        _advance(codes[part], tables, windows, film.is_camshift, found)
        paths[alive, part], iterations[alive, part], windows = found[..., :4], found[..., 4], found[:, -1, :4]
        overlaps = metrics.overlap(found[..., :4].reshape(-1, 4), np.tile(film.truth[part], (len(alive), 1)))
        sums += np.nan_to_num(overlaps).reshape(found.shape[:2]).sum(axis=1)
    return paths, iterations, np.isin(np.arange(len(masks)), alive)


def _first_window(box, frame) -> tuple[int, int, int, int]:
    """Whole-pixel window of the visible part of a box."""
    height, width = frame.shape[:2]
    edges = color.pixel_edges([check_box(box, frame)])[0]
    left, top, right, bottom = (int(edge) for edge in np.clip(edges, 0, [width, height, width, height]))
    return left, top, right - left, bottom - top


def _cam_shift(probability, window) -> tuple[int, int, int, int]:
    """Window that OpenCV's CamShift finds by OpenCV's own arithmetic, the same on every machine.

    An OpenCV built with Intel's library leaves the moments to it, which rounds once where OpenCV rounds twice. It
    matters only to a shape as symmetric as a drawn disc, the axes of which may then come out the other way round.
    """
    use = cv2.ipp.useIPP()
    cv2.ipp.setUseIPP(False)
    try:
        return cv2.CamShift(probability, window, CRITERIA)[1]
    finally:
        cv2.ipp.setUseIPP(use)


def _check_tracker(tracker) -> bool:
    """Whether the tracker is CAMSHIFT."""
    if tracker not in ("camshift", "mean-shift"):
        raise ValueError(f'tracker must be "camshift" or "mean-shift", got {tracker!r}')
    return tracker == "camshift"


def _check_masks(masks) -> np.ndarray:
    """Return the masks as an array of int, shape (M, 4), or say what is wrong with them."""
    array = np.asarray(masks)
    if array.ndim != 2 or array.shape[1] != 4 or len(array) == 0 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"masks must be whole numbers s_low, s_high, v_low, v_high, shape (M, 4), got {masks!r}")
    low, high = array[:, ::2], array[:, 1::2]
    bad = ((low < 0) | (low >= high) | (high > 256) | (low % CELL != 0) | (high % CELL != 0)).any(axis=1)
    if bad.any():
        raise ValueError(
            f"a mask must have 0 <= low < high <= 256 and ends at multiples of {CELL}, got {array[bad][0].tolist()}"
        )
    return array.astype(int)


# The compiled part. Nothing here checks an index: all comes checked from above.


@njit(cache=True)
def _advance(codes, tables, windows, is_camshift, found):
    """Take the window of every mask through some frames; `found` gets x, y, w, h and iterations."""
    moments = np.empty(6, dtype=np.int64)
    for mask in range(len(tables)):
        x, y, w, h = windows[mask]
        for t in range(len(codes)):
            count, x, y, rectangle = _climb(moments, codes[t], tables[mask], x, y, w, h)
            if is_camshift:
                x, y, w, h = _adapt(moments, codes[t], tables[mask], x, y, w, h, rectangle)
            found[mask, t] = x, y, w, h, count


@njit(cache=True)
def _climb(moments, codes, table, x, y, w, h):
    """Mean-Shift as in OpenCV's meanShift: iterations, the window's corner, and the rectangle last measured."""
    height, width = codes.shape
    rectangle = (0, 0, 0, 0)
    for count in range(MAX_ITERATIONS):
        rectangle = _measure(moments, codes, table, rectangle, (x, y, x + w, y + h))
        m00, m10, m01 = moments[0], moments[1] - x * moments[0], moments[2] - y * moments[0]
        if m00 == 0:
            return count, x, y, rectangle
        new_x = min(max(x + round(m10 / m00 - w * 0.5), 0), width - w)
        new_y = min(max(y + round(m01 / m00 - h * 0.5), 0), height - h)
        if new_x == x and new_y == y:
            return count, x, y, rectangle
        x, y = new_x, new_y
    return MAX_ITERATIONS, x, y, rectangle


@njit(cache=True)
def _adapt(moments, codes, table, x, y, w, h, rectangle):
    """The window that OpenCV's CamShift makes of the one at which Mean-Shift arrived, operation by operation."""
    height, width = codes.shape
    x, y = max(x - MARGIN, 0), max(y - MARGIN, 0)
    w, h = min(w + 2 * MARGIN, width - x), min(h + 2 * MARGIN, height - y)
    _measure(moments, codes, table, rectangle, (x, y, x + w, y + h))
    m00, m10, m01, m20, m11, m02 = moments
    if m00 == 0:
        return x, y, w, h
    m20 += x * (x * m00 - 2 * m10)  # from the image's corner to the window's
    m11 += x * y * m00 - x * m01 - y * m10
    m02 += y * (y * m00 - 2 * m01)
    m10 -= x * m00
    m01 -= y * m00

    inverse = 1.0 / m00
    mu20, mu11, mu02 = m20 - m10 * (m10 * inverse), m11 - m10 * (m01 * inverse), m02 - m01 * (m01 * inverse)
    a, b, c = mu20 * inverse, mu11 * inverse, mu02 * inverse
    theta = math.atan2(2 * b, a - c + math.sqrt(4 * b * b + (a - c) * (a - c)))
    cos, sin = math.cos(theta), math.sin(theta)
    along = max(0.0, cos * cos * mu20 + 2 * cos * sin * mu11 + sin * sin * mu02)
    across = max(0.0, sin * sin * mu20 - 2 * cos * sin * mu11 + cos * cos * mu02)
    length, breadth = math.sqrt(along * inverse) * 4, math.sqrt(across * inverse) * 4
    if length < breadth:
        length, breadth, cos, sin = breadth, length, sin, cos

    x_mean, y_mean = round(m10 * inverse + x), round(m01 * inverse + y)
    w = min(max(round(abs(length * cos)), round(abs(breadth * sin))) + 2, 2 * (width - x_mean))
    h = min(max(round(abs(length * sin)), round(abs(breadth * cos))) + 2, 2 * (height - y_mean))
    x, y = max(0, x_mean - w // 2), max(0, y_mean - h // 2)
    return x, y, min(w, width - x), min(h, height - y)


@njit(cache=True)
def _measure(moments, codes, table, old, new):
    """Make of the moments of one rectangle (left, top, right, bottom) those of another, and return it."""
    left, top, right, bottom = max(old[0], new[0]), max(old[1], new[1]), min(old[2], new[2]), min(old[3], new[3])
    common = max(right - left, 0) * max(bottom - top, 0)
    if 2 * common > (old[2] - old[0]) * (old[3] - old[1]):
        for sign, outer in ((-1, old), (1, new)):  # what the two do not share
            _add(moments, codes, table, outer[0], outer[1], outer[2], top, sign)
            _add(moments, codes, table, outer[0], top, left, bottom, sign)
            _add(moments, codes, table, right, top, outer[2], bottom, sign)
            _add(moments, codes, table, outer[0], bottom, outer[2], outer[3], sign)
    else:
        moments[:] = 0
        _add(moments, codes, table, new[0], new[1], new[2], new[3], 1)
    return new


@njit(cache=True)
def _add(moments, codes, table, left, top, right, bottom, sign):
    """Add to the moments about the image's corner, m00, m10, m01, m20, m11, m02, those of a rectangle, or subtract."""
    for y in range(top, bottom):
        p0, p1, p2 = np.uint64(0), np.uint64(0), np.uint64(0)
        for x in range(np.uint64(left), np.uint64(right)):  # unsigned: numba then need not look for negative indices
            p = np.uint64(table[codes[y, x]])
            p0 += p
            p1 += p * x
            p2 += p * x * x
        m0, m1 = sign * np.int64(p0), sign * np.int64(p1)
        moments[0] += m0
        moments[1] += m1
        moments[2] += m0 * y
        moments[3] += sign * np.int64(p2)
        moments[4] += m1 * y
        moments[5] += m0 * y * y
