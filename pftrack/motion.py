r"""How a pedestrian may move from one frame to the next: transition models and re-initialisation.

The state of Owczarek et al. 2015 (eq. 8) is :math:`s = [x, y, \dot x, \dot y, k]`: the centre of a rectangle in
pixels, its velocity in pixels a frame, and its scale relative to the size it had in the first frame. Between frames it
moves by eq. 9, :math:`s_t = A s_{t-1} + w_{t-1}`, with Gaussian noise :math:`w`. Functions of particles take and
return whole sets, one particle a row. Chapter 5 uses them; chapter 1 uses the same linear model against a Kalman
filter. Where the camera moves too, its motion is measured between frames; chapter 7 uses that.
"""

from __future__ import annotations

import cv2
import numpy as np


def constant_velocity(dt: float = 1.0) -> np.ndarray:
    """Transition matrix `A` of the state ``[x, y, dx/dt, dy/dt, k]`` (Owczarek et al. 2015, eq. 10).

    The position advances by velocity times `dt`; velocity and scale stay. (The paper calls eq. 9 a *second-order*
    difference equation; with this matrix it is first order in the state and second order in the position alone.)

    Parameters
    ----------
    dt : float
        Time between frames, in the unit that velocities are given in; 1 means pixels a frame.

    Returns
    -------
    ndarray, shape (5, 5)
        The matrix `A`.

    Examples
    --------
    >>> constant_velocity() @ [100.0, 50.0, 2.0, -1.0, 1.0]
    array([102.,  49.,   2.,  -1.,   1.])
    """
    matrix = np.eye(5)
    matrix[0, 2] = matrix[1, 3] = dt
    return matrix


def linear_gaussian(states, matrix, noise, rng: np.random.Generator) -> np.ndarray:
    """Move every particle by ``A s + w`` with ``w ~ N(0, diag(noise**2))`` (Owczarek et al. 2015, eq. 9).

    Parameters
    ----------
    states : array_like, shape (N, d)
        One particle a row.
    matrix : array_like, shape (d, d)
        The transition matrix `A`.
    noise : array_like, shape (d,) or scalar
        Standard deviations of the noise, in the units of the state; the paper's `Q` is ``diag(noise**2)``.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    ndarray, shape (N, d)
        The moved particles; the input is left as it was.

    Raises
    ------
    ValueError
        If a standard deviation is negative or NaN.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> linear_gaussian([[10.0, 10.0, 1.0, 0.0, 1.0]], constant_velocity(), noise=0.0, rng=rng)
    array([[11., 10.,  1.,  0.,  1.]])
    """
    states = np.asarray(states, dtype=float)
    noise = np.asarray(noise, dtype=float)
    if not np.all(noise >= 0):
        raise ValueError(f"noise holds standard deviations and must not be negative or NaN, got {noise}")
    return states @ np.asarray(matrix, dtype=float).T + noise * rng.standard_normal(states.shape)


def random_walk(states, noise, rng: np.random.Generator) -> np.ndarray:
    """Move every particle by Gaussian noise alone: :func:`linear_gaussian` with the identity for `A`.

    Parameters
    ----------
    states : array_like, shape (N, d)
        One particle a row.
    noise : array_like, shape (d,) or scalar
        Standard deviations of the step, in the units of the state.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    ndarray, shape (N, d)
        The moved particles.

    Raises
    ------
    ValueError
        If a standard deviation is negative or NaN.

    Examples
    --------
    >>> random_walk([[10.0, 20.0]], noise=[0.0, 0.0], rng=np.random.default_rng(0))
    array([[10., 20.]])
    """
    states = np.asarray(states, dtype=float)
    return linear_gaussian(states, np.eye(states.shape[1]), noise, rng)


def reinitialize(
    n_particles: int,
    image_size: tuple[int, int],
    rng: np.random.Generator,
    scale_range: tuple[float, float] = (1.0, 2.0),
    velocity_range: tuple[float, float] = (-0.05, 0.05),
) -> np.ndarray:
    """Spread particles uniformly over the image, to find a target that was lost (Owczarek et al. 2015, eq. 15).

    Parameters
    ----------
    n_particles : int
        Number of particles to draw, at least 1.
    image_size : tuple of int
        ``(width, height)`` of the image in pixels.
    rng : numpy.random.Generator
        Source of randomness.
    scale_range : tuple of float
        Lowest and highest scale, relative to the initial size. The paper's default re-draws no scale below 1, even
        for a target that has become smaller.
    velocity_range : tuple of float
        Lowest and highest velocity along each axis, in pixels a frame.

    Returns
    -------
    ndarray, shape (n_particles, 5)
        States ``[x, y, dx/dt, dy/dt, k]``.

    Raises
    ------
    ValueError
        If `n_particles` is below 1 or the image has no area.

    Examples
    --------
    >>> states = reinitialize(1000, image_size=(320, 240), rng=np.random.default_rng(0))
    >>> states.shape, bool((states[:, 4] >= 1).all())
    ((1000, 5), True)
    """
    width, height = image_size
    if n_particles < 1 or width < 1 or height < 1:
        raise ValueError(f"need at least one particle and an image with area, got {n_particles} and {image_size}")
    low = np.array([0, 0, velocity_range[0], velocity_range[0], scale_range[0]])
    high = np.array([width, height, velocity_range[1], velocity_range[1], scale_range[1]])
    return low + (high - low) * rng.random((n_particles, 5))


def reduced_gray(frame: np.ndarray, width: int = 160) -> np.ndarray:
    """Make a small grey copy of a frame, for :func:`camera_shift`.

    Parameters
    ----------
    frame : ndarray, shape (H, W, 3), uint8
        A colour image in BGR order.
    width : int
        Width of the copy, in pixels.

    Returns
    -------
    ndarray, shape (width * H / W, width), uint8
        The copy, at least 8 pixels high.
    """
    size = width, max(8, round(frame.shape[0] * width / frame.shape[1]))
    return cv2.resize(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)


def camera_shift(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """How far the background has moved between two frames: the median of the optical flow at a grid of points.

    Most points of a grid lie on the background, so the median is its motion, whatever a few pedestrians do. The flow
    is that of Lucas and Kanade, by OpenCV.

    Parameters
    ----------
    before, after : ndarray, shape (h, w), uint8
        Two grey images, from :func:`reduced_gray`.

    Returns
    -------
    ndarray, shape (2,)
        Shift along x and y, in pixels of these images; 0 where too few points can be followed.

    Examples
    --------
    >>> pattern = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (90, 160), dtype=np.uint8), (0, 0), 3)
    >>> print(camera_shift(pattern, np.roll(pattern, 2, axis=1))[0].round(1))
    2.0
    """
    height, width = before.shape
    x, y = np.meshgrid(np.linspace(0.05, 0.95, 8) * width, np.linspace(0.08, 0.92, 6) * height)
    points = np.stack([x, y], axis=-1).reshape(-1, 1, 2).astype(np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 8, 0.03)
    flow = {"winSize": (11, 11), "maxLevel": 2, "criteria": criteria}
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, points, None, **flow)
    shifts = (moved - points)[found[:, 0] == 1, 0]
    return np.median(shifts, axis=0).astype(float) if len(shifts) > 8 else np.zeros(2)
