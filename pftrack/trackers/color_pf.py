"""The colour particle filter of Owczarek et al. 2015, section III-B, as printed.

Each particle is a rectangle ``[x, y, dx/dt, dy/dt, k]`` (eq. 8). Every frame moves the particles (eqs 9 and 10), weighs
each by how much the colours inside it look like the target's (eqs 11 to 13), reports the mean state (eq. 14) and
spreads the particles over the whole image when the target is lost (eq. 15). What the paper leaves open is an argument
with a default, chosen once. Chapter 5 builds the filter step by step; chapter 6 measures it.
"""

from __future__ import annotations

import math

import numpy as np

from pftrack import color, kernels, motion, smc
from pftrack.checks import check_box, check_seed
from pftrack.trackers.base import Estimate, Prepared, check_frame, check_started


def particle_boxes(particles, size) -> np.ndarray:
    """Rectangles that particle states stand for (Owczarek et al. 2015, eq. 8).

    Parameters
    ----------
    particles : array_like, shape (N, 5)
        States ``[x, y, dx/dt, dy/dt, k]``, with ``(x, y)`` the centre in pixels.
    size : array_like, shape (2,)
        Width and height in pixels at scale ``k = 1``.

    Returns
    -------
    ndarray, shape (N, 4)
        Boxes ``(x, y, w, h)`` in pixels, top-left origin.

    Examples
    --------
    >>> particle_boxes([[100.0, 50.0, 0.0, 0.0, 2.0]], size=(20, 30))
    array([[80., 20., 40., 60.]])
    """
    particles = np.asarray(particles, dtype=float)
    boxes = np.empty((len(particles), 4))
    boxes[:, 2:] = particles[:, 4:] * size
    boxes[:, :2] = particles[:, :2] - boxes[:, 2:] / 2
    return boxes


def _picture(frame: np.ndarray | Prepared) -> np.ndarray:
    """Return the bin image where there is one already, else the frame."""
    return frame.bins if isinstance(frame, Prepared) else frame


class ColorParticleFilter:
    """Track one target by its colours with a particle filter (Owczarek et al. 2015, eqs 8 to 15).

    Parameters
    ----------
    n_particles : int
        Number of particles `N`, at least 1. The paper settles on 100 (its Fig. 3).
    seed : int or numpy.random.Generator
        Seed of the random numbers; every call of `init` starts again from it. A generator is used as it is.
    sigma : float
        Standard deviation of the Hellinger distance in eq. 13, above 0. *Not printed in the paper.*
    noise : array_like, shape (5,)
        Standard deviations of the noise of eq. 9 for one frame: of ``x`` and ``y`` and of their velocities in units of
        the target's initial width, so that they do not depend on the resolution, and of the scale `k`, which has no
        unit. *Not printed in the paper.*
    dt : float
        Time between frames in eq. 10; 1 gives velocities in pixels a frame.
    resample_threshold : float
        Resample when the degeneration indicator of eq. 7 falls below this, from 0 (never) to 1. *Not printed.*
    lost_distance : float
        Re-initialise (eq. 15) when the Hellinger distance at the mean state exceeds this: the paper's "probability of
        the mean state drops below a certain threshold", which by eq. 13 is the same. *Not printed.*
    scale_range : tuple of float
        Scales drawn at re-initialisation, as printed in eq. 15.
    scale_limits : tuple of float
        Bounds that keep `k` positive under Gaussian noise. *Not in the paper.*
    outside : {"mismatch", "ignore"}
        What pixels beyond the image border count as; see :func:`pftrack.color.histograms`. *Not in the paper.*
    resampler : str
        Name of a scheme in :data:`pftrack.smc.RESAMPLERS`. *Not in the paper.*

    Raises
    ------
    ValueError
        If an argument is out of its range or the resampler is unknown.

    Notes
    -----
    The score of an estimate is 1 minus the Hellinger distance at the mean state, from 0 to 1.

    Examples
    --------
    >>> frame = np.zeros((60, 80, 3), dtype=np.uint8)
    >>> frame[20:40, 30:40] = (255, 0, 0)
    >>> tracker = ColorParticleFilter(n_particles=500, seed=0)
    >>> _ = tracker.init(frame, (30, 20, 10, 20))
    >>> estimate = tracker.update(np.roll(frame, 2, axis=1))
    >>> print(estimate.box.round(), estimate.lost)
    [32. 20. 10. 20.] False
    """

    def __init__(
        self,
        n_particles: int = 100,
        seed: int | np.random.Generator = 0,
        *,
        sigma: float = 0.1,
        noise=(0.15, 0.1, 0.01, 0.01, 0.03),
        dt: float = 1.0,
        resample_threshold: float = 0.5,
        lost_distance: float = 0.5,
        scale_range: tuple[float, float] = (1.0, 2.0),
        scale_limits: tuple[float, float] = (0.2, 5.0),
        outside: str = "mismatch",
        resampler: str = "systematic",
    ):
        if n_particles < 1:
            raise ValueError(f"n_particles must be at least 1, got {n_particles}")
        check_seed(seed)
        if not 0 < sigma < np.inf:
            raise ValueError(f"sigma must be positive, got {sigma}")
        if not np.isfinite(dt):
            raise ValueError(f"dt must be a finite number, got {dt}")
        noise = np.asarray(noise, dtype=float)
        if noise.shape != (5,) or not np.all((noise >= 0) & np.isfinite(noise)):
            raise ValueError(
                f"noise must be five standard deviations, none negative or NaN or infinite, got {noise.tolist()}"
            )
        if not 0 <= resample_threshold <= 1 or not 0 <= lost_distance <= 1:
            raise ValueError(
                "resample_threshold and lost_distance must lie between 0 and 1, "
                f"got {resample_threshold} and {lost_distance}"
            )
        for name, (low, high) in (("scale_range", scale_range), ("scale_limits", scale_limits)):
            if not 0 < low <= high < np.inf:
                raise ValueError(f"{name} must be an interval above 0, got {(low, high)}")
        if outside not in ("mismatch", "ignore"):
            raise ValueError(f'outside must be "mismatch" or "ignore", got {outside!r}')
        if resampler not in smc.RESAMPLERS:
            raise ValueError(f"unknown resampler {resampler!r}; choose one of {', '.join(smc.RESAMPLERS)}")
        self.n_particles, self.seed = int(n_particles), seed
        self.sigma, self.noise, self.dt = sigma, noise, dt
        self.resample_threshold, self.lost_distance = resample_threshold, lost_distance
        self.scale_range, self.scale_limits = scale_range, scale_limits
        self.outside, self.resampler = outside, smc.RESAMPLERS[resampler]
        self._shape = None

    def prepare(self, frame: np.ndarray) -> Prepared:
        """Compute what depends on the frame alone: its bin image.

        Trackers that differ in their seed or settings can share it when they see the same film: `init` and `update`
        take it in place of the frame, with the same result.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            A frame.

        Returns
        -------
        Prepared
            The bin image.

        Raises
        ------
        ValueError
            If the frame is unusable.
        """
        return Prepared(check_frame(frame).shape, color.hsv_bins(frame))

    def init(self, frame: np.ndarray, box) -> Estimate:
        """Learn the target's histogram and place all particles on it (eq. 8).

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The first frame.
        box : array_like, shape (4,)
            The target in it, ``(x, y, w, h)`` in pixels.

        Returns
        -------
        Estimate
            The given box, with score 1.

        Raises
        ------
        ValueError
            If the frame or the box is unusable.
        """
        frame = check_frame(frame)
        box = check_box(box, frame)
        self.rng = np.random.default_rng(self.seed)
        self.palette = kernels.palette(color.histograms(_picture(frame), [box], outside="ignore"))
        self.size = box[2:]
        self.noise_in_pixels = self.noise * [box[2], box[2], box[2], box[2], 1.0]
        self.particles = np.tile([*(box[:2] + box[2:] / 2), 0.0, 0.0, 1.0], (self.n_particles, 1))
        self.log_weights = np.zeros(self.n_particles)
        self._shape = frame.shape
        return Estimate(box, 1.0, lost=False, particles=self.particles, weights=smc.normalize(self.log_weights))

    def update(self, frame: np.ndarray) -> Estimate:
        """Predict, weigh, estimate and, where needed, resample or re-initialise.

        Parameters
        ----------
        frame : ndarray, shape (H, W, 3), uint8
            The next frame, of the size of the first.

        Returns
        -------
        Estimate
            The rectangle of the mean state, its score, whether the particles were re-initialised (`lost`), and the
            weighted particles before any resampling.

        Raises
        ------
        ValueError
            If the frame is unusable, or `init` was not called.
        """
        frame = check_frame(frame, check_started(self._shape))
        particles, edges = kernels.move(
            self.particles, self.noise_in_pixels, self.rng, self.dt, self.scale_limits, self.size
        )  # eqs 8 to 10
        bins, origin = color.covered_bins(_picture(frame), edges)
        log_weights, weights, n_effective, mean, box, similarity = kernels.observe(
            bins, origin, particles, edges, self.log_weights, self.palette, self.sigma, self.size, self.outside
        )  # eqs 11 to 14, 5 and 7
        distance = math.sqrt(1.0 - similarity)
        lost = self._is_off_image(mean) or distance > self.lost_distance
        estimate = Estimate(box, float(1.0 - distance), bool(lost), particles, weights)
        if lost:
            height, width = frame.shape[:2]
            particles = motion.reinitialize(self.n_particles, (width, height), self.rng, self.scale_range)
            log_weights = np.zeros(self.n_particles)
        elif n_effective < self.resample_threshold * self.n_particles:
            particles = particles.take(self.resampler(weights, self.rng), axis=0)
            log_weights = np.zeros(self.n_particles)
        self.particles, self.log_weights = particles, log_weights
        return estimate

    def _is_off_image(self, mean: np.ndarray) -> bool:
        height, width = self._shape[:2]
        return not (0 <= mean[0] < width and 0 <= mean[1] < height)
