"""The compiled hot loops, each beside its plain NumPy twin.

A particle filter spends its time in a few loops over pixels. Here they are twice: once in NumPy and OpenCV, which is
the readable truth, and once as a loop that numba compiles to machine code. The public functions call the compiled loop
where numba can be imported and the twin otherwise; the tests hold the two together. Numba is imported on the first
call, so that ``import pftrack`` stays quick, and what it has compiled is kept on disk.

Compiled loops do not check their indices, so each public function makes sure first that none leaves its array.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import cv2
import numpy as np

ALIKE = 0.998
"""Squared Bhattacharyya coefficient above which square roots are taken in double precision. The Hellinger distance is
then so small that the 8th decimal of the coefficient shows in its 6th."""

MANY_DRAWS = 1500
"""Number of random draws from which a compiled loop is faster than NumPy, though it takes longer to begin."""

N_ORIENTATIONS = 6
"""Number of orientations of a gradient, over half a turn."""

FLAT = 12.0
"""Mean gradient of a neighbourhood, in grey levels over two pixels, below which it counts as flat."""


@functools.cache
def _numba():
    """Import numba, where it can be, and tell it which loops others call."""
    try:
        import numba
    except ImportError:
        return None
    weighing = _similarities_loop, _survey_loop, _sweep_pays, _match_loop, _direct_loop, _sweep_loop
    for loop in (_move_loop, _weigh_loop, *weighing):
        numba.extending.register_jitable(loop)
    return numba


@functools.cache
def compiled(loop, reorder: bool = False):
    """Compile a loop with numba, or return None where numba cannot be imported.

    Parameters
    ----------
    loop : function
        A function of arrays and numbers that numba can compile.
    reorder : bool
        Whether sums may be taken in any order, several terms at once.

    Returns
    -------
    function or None
        The compiled function, kept on disk from one run to the next.
    """
    numba = _numba()
    return numba and numba.njit(cache=True, fastmath={"reassoc", "nsz"} if reorder else False)(loop)


# ---------------------------------------------------------------------------------------------------------------------
# Particles: resampling and moving
# ---------------------------------------------------------------------------------------------------------------------


def comb(weights, shifts, n_teeth: int):
    """Find the ancestors that the teeth of a comb fall on, one in each of equal slices of the cumulative weights.

    Parameters
    ----------
    weights : ndarray, shape (N,)
        Weights, to be normalised; what comes of negative ones or NaN means nothing.
    shifts : ndarray, shape (n_teeth,) or (1,)
        Where in its slice each tooth is, or all are: from 0 to below 1.
    n_teeth : int
        Number of teeth, at least 1.

    Returns
    -------
    ancestors : ndarray of int, shape (n_teeth,)
        Index of the particle whose share of the cumulative weights holds each tooth, in increasing order.
    smallest, total : float
        Smallest and sum of the weights, so that the caller need not look again.

    Raises
    ------
    ValueError
        If an array is empty or has another shape.

    Examples
    --------
    >>> comb(np.array([0.25, 0.5, 0.25]), np.array([0.5]), 4)
    (array([0, 1, 1, 2]), 0.25, 1.0)
    """
    if weights.ndim != 1 or weights.size == 0 or n_teeth < 1 or shifts.shape not in ((n_teeth,), (1,)):
        raise ValueError(f"need weights (N,) and shifts ({n_teeth},) or (1,), got {weights.shape} and {shifts.shape}")
    run = compiled(_comb_loop) or comb_numpy
    return run(np.ascontiguousarray(weights, dtype=float), np.ascontiguousarray(shifts, dtype=float), n_teeth)


def comb_numpy(weights, shifts, n_teeth):
    """Twin of the compiled loop of :func:`comb`."""
    total = weights.sum()
    teeth = (np.arange(n_teeth) + shifts) * (total / n_teeth)
    last = np.flatnonzero(weights).max(initial=0)  # rounding must never pick a particle of weight zero
    ancestors = np.minimum(np.searchsorted(np.cumsum(weights), teeth, side="right"), last)
    return ancestors, float(weights.min()), float(total)


def _comb_loop(weights, shifts, n_teeth):
    """Count the teeth below each cumulative weight; the ancestor of a tooth is the number of particles it has passed.

    Nowhere is there a branch on the weights: a processor cannot guess how many offspring the next particle has.
    """
    smallest, total = weights[0], 0.0
    for i in range(len(weights)):
        smallest = min(smallest, weights[i])
        total += weights[i]
    passed = np.zeros(n_teeth + 1, dtype=np.int64)  # particles that end below a tooth, but not below the one before
    teeth_per_weight, cumulative, last = n_teeth / total if total > 0 else 0.0, 0.0, 0
    for i in range(len(weights)):
        cumulative += weights[i]
        last = i if weights[i] > 0 else last
        position = cumulative * teeth_per_weight
        tooth = int(position) if 0 <= position < n_teeth else n_teeth
        shift = shifts[min(tooth, len(shifts) - 1)]
        tooth += tooth < n_teeth and shift < position - tooth
        passed[tooth] += 1
    ancestors = np.empty(n_teeth, dtype=np.int64)
    n_passed = 0
    for j in range(n_teeth):
        n_passed += passed[j]
        ancestors[j] = min(n_passed, last)
    return ancestors, smallest, total


def move(particles, noise, rng: np.random.Generator, dt: float, scale_limits, size):
    """Move particles ``[x, y, dx/dt, dy/dt, k]`` and find their pixels (Owczarek et al. 2015, eqs 8 to 10).

    Parameters
    ----------
    particles : ndarray, shape (N, 5)
        Centres in pixels, velocities in pixels a frame, and scales.
    noise : array_like, shape (5,)
        Standard deviations of the Gaussian noise, in the same units.
    rng : numpy.random.Generator
        Source of randomness.
    dt : float
        Time between frames.
    scale_limits : tuple of float
        Lowest and highest scale; others are cut to these.
    size : array_like, shape (2,)
        Width and height in pixels at scale 1.

    Returns
    -------
    particles : ndarray, shape (N, 5)
        The moved particles; the input is left as it was.
    edges : ndarray of int, shape (N, 4)
        ``(left, top, right, bottom)`` of their rectangles, each rounded to the nearest whole pixel.

    Raises
    ------
    ValueError
        If an array has the wrong shape.

    Examples
    --------
    >>> still, rng = np.zeros(5), np.random.default_rng(0)
    >>> particles, edges = move(np.array([[10.0, 10.0, 2.0, 0.0, 1.0]]), still, rng, 1.0, (0.2, 5.0), (4.0, 8.0))
    >>> particles, edges
    (array([[12., 10.,  2.,  0.,  1.]]), array([[10,  6, 14, 14]]))
    """
    particles, noise = np.ascontiguousarray(particles, dtype=float), np.ascontiguousarray(noise, dtype=float)
    if particles.ndim != 2 or particles.shape[1] != 5 or noise.shape != (5,):
        raise ValueError(f"need particles (N, 5) and noise (5,), got shapes {particles.shape} and {noise.shape}")
    settings = noise, float(dt), *map(float, scale_limits), *map(float, size)
    run = compiled(_draw_and_move_loop)
    if run is not None and particles.size >= MANY_DRAWS:
        return run(particles, rng, *settings)
    run = compiled(_move_loop) or move_numpy
    return run(particles, rng.standard_normal(particles.shape), *settings)


def move_numpy(particles, steps, noise, dt, lowest, highest, width, height):
    """Twin of the compiled loop of :func:`move`."""
    moved = particles.copy()
    moved[:, :2] += dt * particles[:, 2:4]
    moved += noise * steps
    moved[:, 4] = moved[:, 4].clip(lowest, highest)
    sizes = moved[:, 4:] * [width, height]
    corners = moved[:, :2] - sizes / 2
    return moved, np.floor(np.hstack([corners, corners + sizes]) + 0.5).astype(np.int64)


def _draw_and_move_loop(particles, rng, noise, dt, lowest, highest, width, height):
    steps = np.empty_like(particles)
    for n in range(len(particles)):
        for i in range(5):
            steps[n, i] = rng.standard_normal()  # the same numbers as NumPy's
    return _move_loop(particles, steps, noise, dt, lowest, highest, width, height)


def _move_loop(particles, steps, noise, dt, lowest, highest, width, height):
    moved, edges = steps, np.empty((len(particles), 4), dtype=np.int64)  # in place, to stay in the cache
    for n in range(len(particles)):
        moved[n, 0] = particles[n, 0] + dt * particles[n, 2] + noise[0] * steps[n, 0]
        moved[n, 1] = particles[n, 1] + dt * particles[n, 3] + noise[1] * steps[n, 1]
        moved[n, 2] = particles[n, 2] + noise[2] * steps[n, 2]
        moved[n, 3] = particles[n, 3] + noise[3] * steps[n, 3]
        moved[n, 4] = min(max(particles[n, 4] + noise[4] * steps[n, 4], lowest), highest)
        w, h = moved[n, 4] * width, moved[n, 4] * height
        left, top = moved[n, 0] - w / 2, moved[n, 1] - h / 2
        edges[n, 0], edges[n, 1] = math.floor(left + 0.5), math.floor(top + 0.5)
        edges[n, 2], edges[n, 3] = math.floor(left + w + 0.5), math.floor(top + h + 0.5)
    return moved, edges


def weigh(log_weights, states):
    """Turn log-weights into weights, and sum up what they say.

    Parameters
    ----------
    log_weights : ndarray, shape (N,)
        Logarithms of the weights, up to a constant; ``-inf`` is a weight of zero.
    states : ndarray, shape (N, d)
        The particles.

    Returns
    -------
    weights : ndarray, shape (N,)
        Normalised weights (Owczarek et al. 2015, eq. 5); all equal if all were zero.
    mean : ndarray, shape (d,)
        Weighted mean of the states (eqs 6 and 14).
    n_effective : float
        Effective sample size (eq. 7, times N).
    log_total : float
        Logarithm of the sum of the weights before they were normalised.

    Raises
    ------
    ValueError
        If there are no particles, the shapes do not fit, or a log-weight is NaN or infinitely large.

    Examples
    --------
    >>> weights, mean, n_effective, log_total = weigh(np.log([1.0, 3.0]), np.array([[0.0], [4.0]]))
    >>> print(weights, mean, n_effective, round(np.exp(log_total), 6))
    [0.25 0.75] [3.] 1.6 4.0
    """
    log_weights, states = np.ascontiguousarray(log_weights, dtype=float), np.ascontiguousarray(states, dtype=float)
    if log_weights.ndim != 1 or states.ndim != 2 or not 0 < len(log_weights) == len(states):
        raise ValueError(f"need log-weights (N,) and states (N, d), got shapes {log_weights.shape} and {states.shape}")
    run = compiled(_weigh_loop, reorder=True) or weigh_numpy
    weights, mean, n_effective, log_total = run(log_weights, states)
    if not log_total < np.inf:  # also catches NaN
        raise ValueError("log-weights must not hold NaN or +inf; a weight of zero is -inf")
    return weights, mean, n_effective, log_total


def weigh_numpy(log_weights, states):
    """Twin of the compiled loop of :func:`weigh`."""
    largest = log_weights.max()
    with np.errstate(invalid="ignore"):  # inf - inf, of which the total will tell
        weights = np.exp(log_weights - largest) if largest > -np.inf else np.ones(len(log_weights))
    total = weights.sum()
    weights /= total
    return weights, weights @ states, 1.0 / (weights @ weights), largest + math.log(total)


def _weigh_loop(log_weights, states):
    n, d = states.shape
    largest = log_weights[0]
    for i in range(n):
        largest = max(largest, log_weights[i])
    weights = np.ones(n)
    if largest > -math.inf:
        for i in range(n):
            weights[i] = math.exp(log_weights[i] - largest)
    total = squares = 0.0
    for i in range(n):
        total += weights[i]
    mean = np.zeros(d)
    for i in range(n):
        weights[i] /= total
        squares += weights[i] * weights[i]
        for j in range(d):
            mean[j] += weights[i] * states[i, j]
    return weights, mean, 1.0 / squares, largest + math.log(total)


# ---------------------------------------------------------------------------------------------------------------------
# The bin of every pixel
# ---------------------------------------------------------------------------------------------------------------------


def bin_image(hsv: np.ndarray) -> np.ndarray:
    """Histogram bin of every pixel of an HSV image: 8 levels of hue, 8 of saturation, 4 of value.

    Parameters
    ----------
    hsv : ndarray, shape (H, W, 3), uint8
        OpenCV's 8-bit HSV: hue 0 to 179, saturation and value 0 to 255.

    Returns
    -------
    ndarray, shape (H, W), uint8
        ``32 * hue_level + 4 * saturation_level + value_level``, from 0 to 255.

    Raises
    ------
    ValueError
        If the array has the wrong shape or dtype.

    Examples
    --------
    >>> bin_image(np.uint8([[[0, 0, 0], [22, 31, 63], [23, 32, 64], [179, 255, 255]]]))
    array([[  0,   0,  37, 255]], dtype=uint8)
    """
    if hsv.ndim != 3 or hsv.shape[2] != 3 or hsv.dtype != np.uint8:
        raise ValueError(f"need a (H, W, 3) uint8 image, got {hsv.shape} {hsv.dtype}")
    run = compiled(_bin_image_loop) or bin_image_numpy
    return run(np.ascontiguousarray(hsv).reshape(-1)).reshape(hsv.shape[:2])


def bin_image_numpy(levels) -> np.ndarray:
    """Twin of the compiled loop of :func:`bin_image`."""
    hue, saturation, value = levels.reshape(-1, 3).T
    return (hue.astype(int) * 8 // 180 << 5 | saturation >> 5 << 2 | value >> 6).astype(np.uint8)


def _bin_image_loop(levels):
    bins = np.empty(levels.size // 3, dtype=np.uint8)
    for i in range(bins.size):
        hue_level = np.uint16(levels[3 * i]) * np.uint16(365) >> np.uint16(13)  # hue * 8 // 180, without a division
        bins[i] = np.uint8(hue_level << 5) | levels[3 * i + 1] >> 5 << 2 | levels[3 * i + 2] >> 6
    return bins


def ring_image(gray: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Label every pixel of a grey image by which of its eight neighbours are at least as bright.

    Parameters
    ----------
    gray : ndarray, shape (H, W), uint8
        A grey image. Beyond its border it goes on as its outermost pixels.
    labels : ndarray, shape (256,), uint8
        Label of every code; bit `p` of the code belongs to neighbour `p`, from the right clockwise.

    Returns
    -------
    ndarray, shape (H, W), uint8
        The labels.

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype.

    Examples
    --------
    >>> spot = np.uint8([[0, 0, 0], [0, 9, 9], [0, 0, 0]])
    >>> ring_image(spot, np.arange(256, dtype=np.uint8))[1]
    array([255,   1,  17], dtype=uint8)
    """
    if gray.ndim != 2 or gray.dtype != np.uint8 or labels.shape != (256,) or labels.dtype != np.uint8:
        raise ValueError(f"need a (H, W) uint8 image and 256 uint8 labels, got {gray.shape} {gray.dtype}")
    if gray.size == 0:
        return gray.copy()
    run = compiled(_ring_image_loop) or ring_image_numpy
    return run(cv2.copyMakeBorder(gray, 1, 1, 1, 1, cv2.BORDER_REPLICATE), np.ascontiguousarray(labels))


def ring_image_numpy(padded, labels) -> np.ndarray:
    """Twin of the compiled loop of :func:`ring_image`."""
    height, width = padded.shape[0] - 2, padded.shape[1] - 2
    center, codes = padded[1:-1, 1:-1], np.zeros((height, width), dtype=np.uint8)
    for p, (dx, dy) in enumerate([(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]):
        codes |= (padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width] >= center).astype(np.uint8) << p
    return labels[codes]


def _ring_image_loop(padded, labels):
    height, width = padded.shape[0] - 2, padded.shape[1] - 2
    bins = np.empty((height, width), dtype=np.uint8)
    for y in range(height):
        above, here, below, codes = padded[y], padded[y + 1], padded[y + 2], bins[y]
        for x in range(width):
            c = here[x + 1]
            code = np.uint8(here[x + 2] >= c) | np.uint8(below[x + 2] >= c) << np.uint8(1)
            code |= np.uint8(below[x + 1] >= c) << np.uint8(2) | np.uint8(below[x] >= c) << np.uint8(3)
            code |= np.uint8(here[x] >= c) << np.uint8(4) | np.uint8(above[x] >= c) << np.uint8(5)
            code |= np.uint8(above[x + 1] >= c) << np.uint8(6) | np.uint8(above[x + 2] >= c) << np.uint8(7)
            codes[x] = np.uint8(code)
        for x in range(width):
            codes[x] = labels[codes[x]]
    return bins


# ---------------------------------------------------------------------------------------------------------------------
# Colours of many rectangles against those of the target
# ---------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Palette:
    """The bins that targets have pixels in; no other bin adds anything to a Bhattacharyya coefficient.

    Attributes
    ----------
    histograms : ndarray, shape (B, 256)
        Normalised histograms, one a target.
    used : ndarray of int, shape (K,)
        The bins in which some target has pixels, in increasing order.
    numbers : ndarray, shape (256,), uint8
        Place of every bin in `used`; K for all the others.
    roots : ndarray, shape (B, P)
        Square roots of the histograms at `used`, followed by zeros: P is a multiple of 16, above K where it can be, so
        that other bins can be counted too and processors have whole registers to work on.
    """

    histograms: np.ndarray
    used: np.ndarray
    numbers: np.ndarray
    roots: np.ndarray


def palette(targets) -> Palette:
    """Prepare target histograms for :func:`similarities`, once for all frames.

    Parameters
    ----------
    targets : array_like, shape (256,) or (B, 256)
        Normalised histograms.

    Returns
    -------
    Palette
        Their bins.

    Raises
    ------
    ValueError
        If the histograms have another number of bins, or are negative or NaN.

    Examples
    --------
    >>> target = np.zeros(256)
    >>> target[[7, 9]] = 0.25, 0.75
    >>> colors = palette(target)
    >>> colors.used, colors.numbers[[0, 7, 8, 9]], colors.roots.shape
    (array([7, 9]), array([2, 0, 2, 1], dtype=uint8), (1, 16))
    """
    histograms = np.atleast_2d(np.asarray(targets, dtype=float))
    if histograms.ndim != 2 or histograms.shape[1] != 256 or not np.all(histograms >= 0):
        raise ValueError(f"targets must be histograms of 256 bins, none negative or NaN, got shape {histograms.shape}")
    used = np.flatnonzero(histograms.any(axis=0))
    numbers = np.full(256, min(len(used), 255), dtype=np.uint8)
    numbers[used] = np.arange(len(used))
    roots = np.zeros((len(histograms), min(len(used) // 16 * 16 + 16, 256)))
    roots[:, : len(used)] = np.sqrt(histograms[:, used])
    return Palette(histograms, used, numbers, roots)


def similarities(bins: np.ndarray, edges, targets, outside: str = "mismatch", origin=(0, 0)) -> np.ndarray:
    r"""Bhattacharyya coefficient of each of many rectangles of a bin image with a target histogram.

    .. math:: \rho_m = \sum_u \sqrt{\frac{n_m(u)}{a_m}\, q_{m \bmod B}(u)}

    Parameters
    ----------
    bins : ndarray, shape (H, W), uint8
        Histogram bin of every pixel, from :func:`bin_image`.
    edges : array_like of int, shape (M, 4)
        ``(left, top, right, bottom)`` of each rectangle, right and bottom exclusive; only pixels of `bins` are counted.
    targets : Palette, or array_like, shape (B, 256)
        Normalised histograms `q`; rectangle `m` is compared with the one numbered ``m % B``.
    outside : {"mismatch", "ignore"}
        Whether the counts are divided by the full area of a rectangle, so that pixels outside count as a colour no
        target has, or by the area inside.
    origin : tuple of int
        Position ``(x, y)`` of the first pixel of `bins`, where they are a part of the frame.

    Returns
    -------
    ndarray, shape (M,)
        From 0 (nothing in common, or nothing visible) to 1 (identical).

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype, or `outside` is another word.

    Examples
    --------
    >>> bins = np.array([[7, 7, 9, 9]], dtype=np.uint8)
    >>> target = np.zeros(256)
    >>> target[7] = 1.0
    >>> similarities(bins, [[0, 0, 2, 1], [1, 0, 3, 1], [2, 0, 4, 1]], target).round(3)
    array([1.   , 0.707, 0.   ])
    """
    _check_bins(bins, outside)
    edges = _check_edges(edges)
    colors = targets if isinstance(targets, Palette) else palette(targets)
    whole = outside == "mismatch"
    run = compiled(_similarities_loop, reorder=True)
    if run is None:
        return similarities_numpy(bins, edges - [*origin, *origin], colors.histograms, whole)
    return run(np.ascontiguousarray(bins), edges, origin, colors.used, colors.numbers, colors.roots, whole)


def cover(edges, height: int, width: int) -> tuple[int, int, int, int]:
    """Smallest part of an image that shows all that rectangles show of it, and one pixel more on each side.

    Parameters
    ----------
    edges : array_like of int, shape (M, 4)
        ``(left, top, right, bottom)`` of each rectangle, right and bottom exclusive.
    height, width : int
        Size of the image.

    Returns
    -------
    tuple of int
        ``(left, top, right, bottom)`` of the part; of no width or height if nothing is visible.

    Raises
    ------
    ValueError
        If `edges` has the wrong shape.

    Examples
    --------
    >>> cover([[-3, 4, 2, 9], [10, 5, 12, 8]], height=100, width=100)
    (0, 3, 13, 10)
    """
    edges = _check_edges(edges)
    run = compiled(_cover_loop) or cover_numpy
    left, top, right, bottom = run(edges)
    left, top, right, bottom = max(left - 1, 0), max(top - 1, 0), min(right + 1, width), min(bottom + 1, height)
    return left, top, max(left, right), max(top, bottom)


def cover_numpy(edges):
    """Twin of the compiled loop of :func:`cover`."""
    if len(edges) == 0:
        return 0, 0, -1, -1
    return *edges[:, :2].min(axis=0).tolist(), *edges[:, 2:].max(axis=0).tolist()


def _cover_loop(edges):
    left = top = 2**62
    right = bottom = -(2**62)
    for m in range(len(edges)):
        left, top = min(left, edges[m, 0]), min(top, edges[m, 1])
        right, bottom = max(right, edges[m, 2]), max(bottom, edges[m, 3])
    return left, top, right, bottom


def _check_bins(bins, outside) -> None:
    if bins.ndim != 2 or bins.dtype != np.uint8:
        raise ValueError(f"bins must be a (H, W) uint8 image from hsv_bins, got {bins.shape} {bins.dtype}")
    if outside not in ("mismatch", "ignore"):
        raise ValueError(f'outside must be "mismatch" or "ignore", got {outside!r}')


def _check_edges(edges) -> np.ndarray:
    edges = np.ascontiguousarray(edges, dtype=np.int64)
    if edges.ndim != 2 or edges.shape[1] != 4:
        raise ValueError(f"edges must have shape (M, 4), got {edges.shape}")
    return edges


def similarities_numpy(bins, edges, histograms, whole) -> np.ndarray:
    """Twin of the compiled loops of :func:`similarities`: one ``cv2.calcHist`` a rectangle."""
    height, width = bins.shape
    visible = np.clip(edges, 0, [width, height, width, height])
    counted = edges if whole else visible
    areas = np.prod(counted[:, 2:] - counted[:, :2], axis=1)
    rho = np.zeros(len(edges))
    for m, (left, top, right, bottom) in enumerate(visible.tolist()):
        if right > left and bottom > top:
            counts = cv2.calcHist([bins[top:bottom, left:right]], [0], None, [256], [0, 256])[:, 0]
            roots = np.sqrt(histograms[m % len(histograms)])
            total = np.sqrt(counts, dtype=np.float32).astype(float) @ roots
            if total**2 > ALIKE * (right - left) * (bottom - top):
                total = np.sqrt(counts.astype(float)) @ roots
            rho[m] = total / math.sqrt(areas[m])
    return np.minimum(rho, 1.0)


def _similarities_loop(bins, edges, origin, used, numbers, roots, whole):
    height, width = bins.shape
    regions, region_of, areas, cover, n_pixels, largest = _survey_loop(edges, height, width, origin, len(roots), whole)
    left, top, right, bottom = cover
    if not _sweep_pays(n_pixels, len(regions), right - left, bottom - top, roots.shape[1]):
        totals = _direct_loop(bins, regions, used, roots)
    elif largest < 2**16:
        totals = _sweep_loop(bins, regions, cover, numbers, roots, np.zeros(0, dtype=np.uint16))
    else:
        totals = _sweep_loop(bins, regions, cover, numbers, roots, np.zeros(0, dtype=np.uint32))
    rho = np.zeros(len(edges))
    for m in range(len(edges)):
        if region_of[m] >= 0:
            rho[m] = min(totals[region_of[m]] / math.sqrt(areas[m]), 1.0)
    return rho


def _sweep_pays(n_pixels, n_regions, width, height, n_bins):
    """Say whether the sweep is the faster loop, from the measured cost of the inner steps of both, in nanoseconds."""
    direct = 0.5 * n_pixels + (220 + 1.0 * n_bins) * n_regions
    n_sums = min(2 * n_regions, height) * min(2 * n_regions, width)  # in how many rows, over how many strips
    sweep = 1800 + 1.4 * width * height + (0.4 + 0.015 * n_bins) * n_sums + (40 + 0.12 * n_bins) * n_regions
    return sweep < direct


def _survey_loop(edges, height, width, origin, n_targets, whole):
    """Cut rectangles to the image, and put equal ones together: a hash table finds who came before."""
    n_rectangles, (x0, y0) = len(edges), origin
    n_slots = 4
    while n_slots < 2 * n_rectangles:
        n_slots *= 2
    slots = np.full(n_slots, -1, dtype=np.int32)
    regions = np.empty((n_rectangles, 5), dtype=np.int32)  # left, top, right, bottom, target
    region_of = np.full(n_rectangles, -1, dtype=np.int32)
    areas = np.empty(n_rectangles)
    cover_left, cover_top, cover_right, cover_bottom = width, height, 0, 0
    n_regions = n_pixels = largest = 0
    for m in range(n_rectangles):
        left, top = min(max(int(edges[m, 0]) - x0, 0), width), min(max(int(edges[m, 1]) - y0, 0), height)
        right, bottom = min(max(int(edges[m, 2]) - x0, 0), width), min(max(int(edges[m, 3]) - y0, 0), height)
        n_visible = (right - left) * (bottom - top)
        areas[m] = float(edges[m, 2] - edges[m, 0]) * float(edges[m, 3] - edges[m, 1]) if whole else n_visible
        if right <= left or bottom <= top:
            continue
        target = m % n_targets
        slot = ((((left * 65599 + top) * 65599 + right) * 65599 + bottom) * 0x9E3779B97F4A7C1 >> 20) + target
        while True:
            slot &= n_slots - 1
            r = slots[slot]
            if r < 0:  # a new one
                slots[slot] = r = n_regions
                regions[r, 0], regions[r, 1], regions[r, 2], regions[r, 3] = left, top, right, bottom
                regions[r, 4] = target
                n_regions += 1
                n_pixels += n_visible
                largest = max(largest, n_visible)
                cover_left, cover_top = min(cover_left, left), min(cover_top, top)
                cover_right, cover_bottom = max(cover_right, right), max(cover_bottom, bottom)
            same = regions[r, 0] == left and regions[r, 1] == top and regions[r, 2] == right and regions[r, 3] == bottom
            if same and regions[r, 4] == target:
                region_of[m] = r
                break
            slot += 1
    cover = cover_left, cover_top, max(cover_left, cover_right), max(cover_top, cover_bottom)
    return regions[:n_regions], region_of, areas, cover, n_pixels, largest


def _match_loop(counts, roots, n_visible):
    """Sum the products of roots, in single precision unless the region is so like the target that it would show."""
    total = 0.0
    for k in range(len(counts)):
        total += np.sqrt(np.float32(counts[k])) * roots[k]
    if total * total > ALIKE * n_visible:
        total = 0.0
        for k in range(len(counts)):
            total += math.sqrt(counts[k]) * roots[k]
    return total


def _direct_loop(bins, regions, used, roots):
    """Count the pixels of each region by themselves.

    Four counters a bin take turns along a row: in a real picture, whose neighbouring pixels are often but not always
    alike, that halves the time (chapter 7 measures it).
    """
    totals = np.empty(len(regions))
    counts, own = np.empty((4, 256), dtype=np.int32), np.zeros(roots.shape[1], dtype=np.int32)
    for r in range(len(regions)):
        left, top, right, bottom, target = regions[r]
        counts[:] = 0
        for y in range(top, bottom):
            x = left
            while x + 4 <= right:
                counts[0, bins[y, x]] += 1
                counts[1, bins[y, x + 1]] += 1
                counts[2, bins[y, x + 2]] += 1
                counts[3, bins[y, x + 3]] += 1
                x += 4
            while x < right:
                counts[0, bins[y, x]] += 1
                x += 1
        for k in range(len(used)):
            own[k] = counts[0, used[k]] + counts[1, used[k]] + counts[2, used[k]] + counts[3, used[k]]
        totals[r] = _match_loop(own, roots[target], (right - left) * (bottom - top))
    return totals


def _sweep_loop(bins, regions, cover, numbers, roots, counter):
    """Go down the rows once, with a running count of every bin in every strip of columns.

    Strips lie between neighbouring edges of the regions. The running counts of a region's strips, at its bottom less
    at its top, are its histogram: what a region costs does not depend on its size. Counters may overflow, for the
    difference is right as long as the region itself has fewer pixels than they can count.
    """
    cover_left, cover_top, cover_right, cover_bottom = cover
    width, height = cover_right - cover_left, cover_bottom - cover_top
    n_regions, n_bins = len(regions), roots.shape[1]
    strip = np.zeros(width + 1, dtype=np.int64)
    beginning, ending = np.full(height + 1, -1), np.full(height + 1, -1)  # the last region to begin or end at each row,
    begins_before, ends_before = np.empty(n_regions, np.int64), np.empty(n_regions, np.int64)  # and the one before it
    leftmost, rightmost = np.full(height + 1, width), np.zeros(height + 1, np.int64)  # among those
    for r in range(n_regions):
        left, right = regions[r, 0] - cover_left, regions[r, 2] - cover_left
        top, bottom = regions[r, 1] - cover_top, regions[r, 3] - cover_top
        begins_before[r], beginning[top] = beginning[top], r
        ends_before[r], ending[bottom] = ending[bottom], r
        strip[left] = strip[right] = 1
        for y in (top, bottom):
            leftmost[y], rightmost[y] = min(leftmost[y], left), max(rightmost[y], right)
    for x in range(1, width + 1):
        strip[x] += strip[x - 1]
    n_strips = strip[width]  # numbered from 1
    strips = np.zeros((n_strips + 2, n_bins), dtype=counter.dtype)  # pixels of each bin above the current row
    sums = np.zeros((n_strips + 2, n_bins), dtype=counter.dtype)  # sums of these from some strip on
    before = np.empty((n_regions, n_bins), dtype=counter.dtype)
    counts = np.empty(n_bins, dtype=counter.dtype)
    totals = np.empty(n_regions)
    for y in range(height + 1):
        if leftmost[y] < rightmost[y]:
            first, last = strip[leftmost[y]], strip[rightmost[y]]
            for s in range(1, n_strips, 2):  # two at a time, so that the inner loop is begun less often
                if s + 1 >= first and s < last:  # no others are asked for in this row
                    for k in range(n_bins):
                        sum_to_next = sums[s, k] + strips[s, k]
                        sums[s + 1, k] = sum_to_next
                        sums[s + 2, k] = sum_to_next + strips[s + 1, k]
        r = beginning[y]
        while r >= 0:
            left, right = strip[regions[r, 0] - cover_left], strip[regions[r, 2] - cover_left]
            for k in range(n_bins):
                before[r, k] = sums[right, k] - sums[left, k]
            r = begins_before[r]
        r = ending[y]
        while r >= 0:
            left, right = strip[regions[r, 0] - cover_left], strip[regions[r, 2] - cover_left]
            for k in range(n_bins):
                counts[k] = sums[right, k] - sums[left, k] - before[r, k]
            n_visible = (regions[r, 2] - regions[r, 0]) * (regions[r, 3] - regions[r, 1])
            totals[r] = _match_loop(counts, roots[regions[r, 4]], n_visible)
            r = ends_before[r]
        if y < height:
            for x in range(width):
                strips[strip[x], numbers[bins[cover_top + y, cover_left + x]]] += 1
    return totals


def observe(bins, origin, particles, edges, log_weights, colors: Palette, sigma: float, size, outside: str):
    """All that a colour particle filter learns from a frame (Owczarek et al. 2015, eqs 11 to 14, 5 and 7), at once.

    Parameters
    ----------
    bins : ndarray, shape (H, W), uint8
        Bin image of the part of the frame that shows the particles.
    origin : tuple of int
        Position ``(x, y)`` of its first pixel.
    particles, edges : ndarray, shapes (N, 5) and (N, 4)
        From :func:`move`.
    log_weights : ndarray, shape (N,)
        What was known before.
    colors : Palette
        The target's.
    sigma : float
        Standard deviation of the Hellinger distance, above 0.
    size : array_like, shape (2,)
        Width and height of the target in pixels at scale 1.
    outside : {"mismatch", "ignore"}
        As for :func:`similarities`.

    Returns
    -------
    log_weights : ndarray, shape (N,)
        The old ones plus the logarithms of the likelihoods, without the constant of eq. 13.
    weights : ndarray, shape (N,)
        Normalised weights.
    n_effective : float
        Effective sample size.
    mean : ndarray, shape (5,)
        Weighted mean of the particles.
    box : ndarray, shape (4,)
        Its rectangle ``(x, y, w, h)`` in pixels.
    similarity : float
        Bhattacharyya coefficient of that rectangle's colours with the target's.

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype.

    Examples
    --------
    >>> bins = np.zeros((20, 20), dtype=np.uint8)
    >>> bins[:, 10:] = 7
    >>> particles = np.array([[5.0, 10.0, 0.0, 0.0, 1.0], [15.0, 10.0, 0.0, 0.0, 1.0]])
    >>> edges = [[1, 6, 9, 14], [11, 6, 19, 14]]
    >>> colors = palette(np.eye(256)[7])
    >>> _, weights, *_, box, similarity = observe(bins, (0, 0), particles, edges, [0, 0], colors, 0.1, (8, 8), "ignore")
    >>> print(weights.round(3), box.round(3), round(similarity, 3))
    [0. 1.] [11.  6.  8.  8.] 1.0
    """
    _check_bins(bins, outside)
    edges = _check_edges(edges)
    particles = np.ascontiguousarray(particles, dtype=float)
    log_weights = np.ascontiguousarray(log_weights, dtype=float)
    if particles.shape != (len(edges), 5) or log_weights.shape != (len(edges),) or len(edges) == 0:
        raise ValueError(
            f"need particles (N, 5), edges (N, 4) and log-weights (N,), "
            f"got shapes {particles.shape}, {edges.shape} and {log_weights.shape}"
        )
    settings = float(sigma), float(size[0]), float(size[1]), outside == "mismatch"
    run = compiled(_observe_loop, reorder=True)
    if run is None:
        return observe_numpy(bins, origin, particles, edges, log_weights, colors, *settings)
    bins = np.ascontiguousarray(bins)
    return run(bins, origin, particles, edges, log_weights, colors.used, colors.numbers, colors.roots, *settings)


def observe_numpy(bins, origin, particles, edges, log_weights, colors, sigma, width, height, whole):
    """Twin of the compiled loop of :func:`observe`, and the plainest account of it."""
    origin = np.array([*origin, *origin])
    similarity = similarities_numpy(bins, edges - origin, colors.histograms, whole)  # eq. 12
    log_weights = log_weights - (1.0 - similarity) / (2 * sigma**2)  # eqs 11 and 13
    weights, mean, n_effective, _ = weigh_numpy(log_weights, particles)  # eqs 5, 14 and 7
    w, h = mean[4] * width, mean[4] * height
    left, top = mean[0] - w / 2, mean[1] - h / 2
    edges_at_mean = np.floor(np.array([[left, top, left + w, top + h]]) + 0.5).astype(np.int64)
    (at_mean,) = similarities_numpy(bins, edges_at_mean - origin, colors.histograms, whole)
    return log_weights, weights, n_effective, mean, np.array([left, top, w, h]), at_mean


def _observe_loop(bins, origin, particles, edges, log_weights, used, numbers, roots, sigma, width, height, whole):
    rho = _similarities_loop(bins, edges, origin, used, numbers, roots, whole)
    log_weights = log_weights - (1.0 - rho) / (2 * sigma**2)
    weights, mean, n_effective, _ = _weigh_loop(log_weights, particles)
    w, h = mean[4] * width, mean[4] * height
    left, top = mean[0] - w / 2, mean[1] - h / 2
    edges_at_mean = np.empty((1, 4), dtype=np.int64)
    edges_at_mean[0, 0], edges_at_mean[0, 1] = math.floor(left + 0.5), math.floor(top + 0.5)
    edges_at_mean[0, 2], edges_at_mean[0, 3] = math.floor(left + w + 0.5), math.floor(top + h + 0.5)
    at_mean = _similarities_loop(bins, edges_at_mean, origin, used, numbers, roots, whole)[0]
    return log_weights, weights, n_effective, mean, np.array([left, top, w, h]), at_mean


# ---------------------------------------------------------------------------------------------------------------------
# Shape: gradient orientations and colours, summed over rectangles
# ---------------------------------------------------------------------------------------------------------------------


def channel_integral(frame: np.ndarray) -> np.ndarray:
    """Integral image of gradient orientations and Lab colours.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.

    Returns
    -------
    ndarray, shape (H + 1, W + 1, 9), int32
        Sums over the rectangle from the top left corner. Channels 0 to 5 hold the gradient's magnitude at the pixels
        of each of six orientations, 50 times its ratio to the mean of the neighbourhood and at most 255; channels 6 to
        8 hold OpenCV's L, a and b, 0 to 255.

    Examples
    --------
    >>> edge = np.zeros((8, 8, 3), dtype=np.uint8)
    >>> edge[:, 4:] = 255
    >>> channel_integral(edge)[-1, -1, :6] > 0  # a vertical edge: one orientation only
    array([ True, False, False, False, False, False])
    """
    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    dx = cv2.Sobel(gray, cv2.CV_32F, 1, 0, ksize=1)
    dy = cv2.Sobel(gray, cv2.CV_32F, 0, 1, ksize=1)
    magnitude = cv2.magnitude(dx, dy)
    relative = cv2.convertScaleAbs(magnitude / (cv2.blur(magnitude, (9, 9)) + FLAT), alpha=50)
    lab = cv2.cvtColor(frame, cv2.COLOR_BGR2Lab)
    run = compiled(_channel_integral_loop) or channel_integral_numpy
    return run(dx, dy, relative, lab)


def channel_integral_numpy(dx, dy, relative, lab) -> np.ndarray:
    """Twin of the compiled loop of :func:`channel_integral`."""
    half_turns = np.arctan2(dy, dx, dtype=float) / math.pi % 1.0
    orientation = np.minimum((half_turns * N_ORIENTATIONS).astype(int), N_ORIENTATIONS - 1)
    channels = np.zeros((*dx.shape, N_ORIENTATIONS + 3), dtype=np.uint8)
    np.put_along_axis(channels, orientation[..., None], relative[..., None], axis=2)
    channels[..., N_ORIENTATIONS:] = lab
    return cv2.integral(channels)


def _channel_integral_loop(dx, dy, relative, lab):
    height, width = dx.shape
    sums = np.zeros((height + 1, width + 1, N_ORIENTATIONS + 3), dtype=np.int32)
    row = np.zeros(N_ORIENTATIONS + 3, dtype=np.int32)
    boundaries = np.arange(1, N_ORIENTATIONS) * math.pi / N_ORIENTATIONS
    cosines, sines = np.cos(boundaries), np.sin(boundaries)
    for y in range(height):
        row[:] = 0
        for x in range(width):
            u, v = dx[y, x], dy[y, x]
            if v < 0 or (v == 0 and u < 0):  # opposite directions are one orientation
                u, v = -u, -v
            orientation = 0
            for k in range(N_ORIENTATIONS - 1):
                orientation += v * cosines[k] >= u * sines[k]  # it has passed the k-th boundary
            row[orientation] += relative[y, x]
            for c in range(3):
                row[N_ORIENTATIONS + c] += lab[y, x, c]
            for c in range(N_ORIENTATIONS + 3):
                sums[y + 1, x + 1, c] = sums[y, x + 1, c] + row[c]
    return sums


def cell_means(integral: np.ndarray, boxes, grid: tuple[int, int], origin=(0, 0)) -> np.ndarray:
    """Mean of each channel over each cell of a grid laid on each of many boxes.

    Parameters
    ----------
    integral : ndarray, shape (H + 1, W + 1, C), int32
        An integral image, as of :func:`channel_integral`.
    boxes : array_like, shape (N, 4)
        Boxes ``(x, y, w, h)`` in pixels of that image. What lies outside the image counts as zero.
    grid : tuple of int
        Number of rows and columns.
    origin : tuple of int
        Position ``(x, y)`` of the first pixel of the integral image, where that is of a part.

    Returns
    -------
    ndarray, shape (N, rows, columns, C)
        The means.

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype.

    Examples
    --------
    >>> integral = channel_integral(np.full((8, 8, 3), 255, dtype=np.uint8))
    >>> cell_means(integral, [[0, 0, 8, 8], [4, 0, 8, 8]], (1, 2))[..., 6]
    array([[[255., 255.]],
    <BLANKLINE>
           [[255.,   0.]]])
    """
    boxes = np.asarray(boxes, dtype=float)
    if boxes.ndim != 2 or boxes.shape[1] != 4 or integral.ndim != 3 or integral.dtype != np.int32:
        raise ValueError(f"need boxes (N, 4) and an int32 integral image, got {boxes.shape} and {integral.shape}")
    x, y, w, h = boxes.T[..., None]
    rows, columns = grid
    edges_x = np.floor(x + w * np.arange(columns + 1) / columns + 0.5) - origin[0]
    edges_y = np.floor(y + h * np.arange(rows + 1) / rows + 0.5) - origin[1]
    edges_x = edges_x.clip(0, integral.shape[1] - 1).astype(int)
    edges_y = edges_y.clip(0, integral.shape[0] - 1).astype(int)
    run = compiled(_cell_sums_loop) or cell_sums_numpy
    sums = run(np.ascontiguousarray(integral), edges_x, edges_y)
    return sums / np.maximum(w * h / (rows * columns), 1.0)[..., None, None]


def cell_sums_numpy(integral, edges_x, edges_y) -> np.ndarray:
    """Twin of the compiled loop of :func:`cell_means`."""
    corners = integral[edges_y[:, :, None], edges_x[:, None, :]]
    return np.diff(np.diff(corners, axis=1), axis=2)


def _cell_sums_loop(integral, edges_x, edges_y):
    n_boxes, rows, columns = len(edges_x), edges_y.shape[1] - 1, edges_x.shape[1] - 1
    sums = np.empty((n_boxes, rows, columns, integral.shape[2]), dtype=np.int32)
    for n in range(n_boxes):
        for r in range(rows):
            top, bottom = edges_y[n, r], edges_y[n, r + 1]
            for c in range(columns):
                left, right = edges_x[n, c], edges_x[n, c + 1]
                for k in range(integral.shape[2]):
                    total = integral[bottom, right, k] - integral[top, right, k]
                    sums[n, r, c, k] = total - integral[bottom, left, k] + integral[top, left, k]
    return sums
