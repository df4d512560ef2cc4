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

import cv2
import numpy as np

N_ORIENTATIONS = 6
"""Number of orientations of a gradient, over half a turn."""

FLAT = 12.0
"""Mean gradient of a neighbourhood, in grey levels over two pixels, below which it counts as flat."""


@functools.cache
def compiled(loop):
    """Compile a loop with numba, or return None where numba cannot be imported.

    Parameters
    ----------
    loop : function
        A function of arrays and numbers that numba can compile.

    Returns
    -------
    function or None
        The compiled function, kept on disk from one run to the next.
    """
    try:
        import numba
    except ImportError:
        return None
    return numba.njit(cache=True)(loop)


# ---------------------------------------------------------------------------------------------------------------------
# The bin of every pixel
# ---------------------------------------------------------------------------------------------------------------------


def bin_image(hsv: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Look up the histogram bin of every pixel.

    Parameters
    ----------
    hsv : ndarray, shape (H, W, 3), uint8
        An image of three channels.
    table : ndarray, shape (256, 3), uint8
        The part of the bin that each level of each channel contributes; the parts occupy different bits.

    Returns
    -------
    ndarray, shape (H, W), uint8
        The parts of the three channels put together by a bitwise *or*.

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype.

    Examples
    --------
    >>> table = np.zeros((256, 3), dtype=np.uint8)
    >>> table[9] = 1, 2, 4
    >>> bin_image(np.uint8([[[9, 0, 9], [9, 9, 9]]]), table)
    array([[5, 7]], dtype=uint8)
    """
    if hsv.ndim != 3 or hsv.shape[2] != 3 or hsv.dtype != np.uint8 or table.shape != (256, 3):
        raise ValueError(f"need a (H, W, 3) uint8 image and a (256, 3) table, got {hsv.shape} and {table.shape}")
    run = compiled(_bin_image_loop) or bin_image_numpy
    return run(np.ascontiguousarray(hsv), table)


def bin_image_numpy(hsv, table) -> np.ndarray:
    """Twin of the compiled loop of :func:`bin_image`."""
    levels = cv2.LUT(hsv, table[None])
    return levels[..., 0] | levels[..., 1] | levels[..., 2]


def _bin_image_loop(hsv, table):
    height, width, _ = hsv.shape
    bins = np.empty((height, width), dtype=np.uint8)
    for y in range(height):
        for x in range(width):
            bins[y, x] = table[hsv[y, x, 0], 0] | table[hsv[y, x, 1], 1] | table[hsv[y, x, 2], 2]
    return bins


# ---------------------------------------------------------------------------------------------------------------------
# Colours of many rectangles against those of the target
# ---------------------------------------------------------------------------------------------------------------------


def similarities(bins: np.ndarray, edges, areas, targets) -> np.ndarray:
    r"""Bhattacharyya coefficient of each of many rectangles of a bin image with a target histogram.

    .. math:: \rho_m = \sum_u \sqrt{\frac{n_m(u)}{a_m}\, q_{m \bmod B}(u)}

    Parameters
    ----------
    bins : ndarray, shape (H, W), uint8
        Histogram bin of every pixel, from :func:`pftrack.color.hsv_bins`.
    edges : array_like of int, shape (M, 4)
        ``(left, top, right, bottom)`` of each rectangle, right and bottom exclusive; only what lies inside the image
        is counted.
    areas : array_like, shape (M,)
        Number `a` that the counts of each rectangle are divided by, in pixels.
    targets : array_like, shape (B, 256)
        Normalised histograms `q`; rectangle `m` is compared with the one numbered ``m % B``.

    Returns
    -------
    ndarray, shape (M,)
        From 0 (nothing in common, or nothing visible) to 1 (identical).

    Raises
    ------
    ValueError
        If an array has the wrong shape or dtype.

    Examples
    --------
    >>> bins = np.array([[7, 7, 9, 9]], dtype=np.uint8)
    >>> target = np.zeros((1, 256))
    >>> target[0, 7] = 1.0
    >>> similarities(bins, [[0, 0, 2, 1], [1, 0, 3, 1], [2, 0, 4, 1]], [2, 2, 2], target).round(3)
    array([1.   , 0.707, 0.   ])
    """
    if bins.ndim != 2 or bins.dtype != np.uint8:
        raise ValueError(f"bins must be a (H, W) uint8 image from hsv_bins, got {bins.shape} {bins.dtype}")
    roots = np.sqrt(np.atleast_2d(targets).astype(float))
    edges = np.asarray(edges, dtype=np.int64)
    areas = np.asarray(areas, dtype=float)
    if edges.ndim != 2 or edges.shape[1:] != (4,) or areas.shape != (len(edges),) or roots.shape[1] != 256:
        raise ValueError(
            f"need edges (M, 4), areas (M,) and targets (B, 256), got {edges.shape}, {areas.shape} and {roots.shape}"
        )
    height, width = bins.shape
    visible = np.clip(edges, 0, [width, height, width, height])
    visible[:, 2:] = np.maximum(visible[:, 2:], visible[:, :2])
    direct, sweep = compiled(_direct_loop), compiled(_sweep_loop)
    if direct is None or len(visible) == 0:
        return np.minimum(similarities_numpy(bins, visible, np.maximum(areas, 1.0), roots), 1.0)
    used = np.flatnonzero(roots.any(axis=0))  # only the bins that a target has need to be counted
    numbers = np.full(256, len(used) % 256, dtype=np.uint8)
    numbers[used] = np.arange(len(used))
    left, top = visible[:, :2].min(axis=0)
    right, bottom = visible[:, 2:].max(axis=0)
    part = cv2.LUT(bins[top:bottom, left:right], numbers) if right > left and bottom > top else bins[:0, :0]
    visible -= [left, top, left, top]
    run = sweep if _sweep_pays(part, visible, len(used)) else direct
    return np.minimum(run(part, visible, np.maximum(areas, 1.0), roots[:, used].copy()), 1.0)


def _sweep_pays(part: np.ndarray, visible: np.ndarray, n_bins: int) -> bool:
    """Say whether the sweep is the faster loop, from the measured cost of their inner steps, in nanoseconds."""
    n_rows = len(np.unique(visible[:, 1::2]))
    direct = 0.6 * np.prod(visible[:, 2:] - visible[:, :2], axis=1).sum() + 1.5 * n_bins * len(visible)
    sweep = 1.0 * part.size + 0.1 * n_rows * part.shape[1] * n_bins + 2.0 * n_bins * len(visible)
    return sweep < direct


def similarities_numpy(bins, visible, areas, roots) -> np.ndarray:
    """Twin of the compiled loops of :func:`similarities`: one ``cv2.calcHist`` a rectangle."""
    rho = np.zeros(len(visible))
    for m, (left, top, right, bottom) in enumerate(visible.tolist()):
        if right > left and bottom > top:
            counts = cv2.calcHist([bins[top:bottom, left:right]], [0], None, [256], [0, 256])[:, 0].astype(float)
            rho[m] = np.sqrt(counts / areas[m]) @ roots[m % len(roots)]
    return rho


def _direct_loop(part, visible, areas, roots):
    """Count the pixels of each rectangle by themselves; `part` holds numbers of used bins, or larger ones."""
    n_targets, n_bins = roots.shape
    rho = np.empty(len(visible))
    counts = np.empty(256, dtype=np.int32)
    for m in range(len(visible)):
        left, top, right, bottom = visible[m]
        counts[:] = 0
        for y in range(top, bottom):
            for x in range(left, right):
                counts[part[y, x]] += 1
        total = 0.0
        for k in range(n_bins):
            total += math.sqrt(counts[k]) * roots[m % n_targets, k]
        rho[m] = total / math.sqrt(areas[m])
    return rho


def _sweep_loop(part, visible, areas, roots):
    """Go through the rows once, with a running count of every bin in every column.

    The sum over the columns of a rectangle, where it ends less where it begins, is its histogram: the cost of a
    rectangle does not depend on its size.
    """
    height, width = part.shape
    n_targets, n_bins = roots.shape
    n_rectangles = len(visible)
    begins, ends = np.argsort(visible[:, 1]), np.argsort(visible[:, 3])
    columns = np.zeros((width, n_bins), dtype=np.int32)  # pixels of each bin above the current row
    prefix = np.zeros((width + 1, n_bins), dtype=np.int32)  # the same, in all columns to the left
    before = np.empty((n_rectangles, n_bins), dtype=np.int32)
    rho = np.empty(n_rectangles)
    b = e = 0
    for y in range(height + 1):
        begin = b < n_rectangles and visible[begins[b], 1] == y
        if begin or (e < n_rectangles and visible[ends[e], 3] == y):
            for x in range(width):
                for k in range(n_bins):
                    prefix[x + 1, k] = prefix[x, k] + columns[x, k]
        while b < n_rectangles and visible[begins[b], 1] == y:
            m = begins[b]
            for k in range(n_bins):
                before[m, k] = prefix[visible[m, 2], k] - prefix[visible[m, 0], k]
            b += 1
        while e < n_rectangles and visible[ends[e], 3] == y:
            m = ends[e]
            total = 0.0
            for k in range(n_bins):
                root = roots[m % n_targets, k]
                if root > 0:
                    count = prefix[visible[m, 2], k] - prefix[visible[m, 0], k] - before[m, k]
                    total += math.sqrt(count) * root
            rho[m] = total / math.sqrt(areas[m])
            e += 1
        if y < height:
            for x in range(width):
                k = part[y, x]
                if k < n_bins:
                    columns[x, k] += 1
    return rho


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


def cell_means(integral: np.ndarray, boxes, grid: tuple[int, int]) -> np.ndarray:
    """Mean of each channel over each cell of a grid laid on each of many boxes.

    Parameters
    ----------
    integral : ndarray, shape (H + 1, W + 1, C), int32
        An integral image, as of :func:`channel_integral`.
    boxes : array_like, shape (N, 4)
        Boxes ``(x, y, w, h)`` in pixels of that image. What lies outside the image counts as zero.
    grid : tuple of int
        Number of rows and columns.

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
    edges_x = np.floor(x + w * np.arange(columns + 1) / columns + 0.5).clip(0, integral.shape[1] - 1).astype(int)
    edges_y = np.floor(y + h * np.arange(rows + 1) / rows + 0.5).clip(0, integral.shape[0] - 1).astype(int)
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
