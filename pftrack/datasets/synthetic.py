"""Synthetic scenes: textured walkers over a textured ground, with exact truth and a knob for every difficulty.

They are the controlled experiments of the book (one difficulty at a time, as much of it as one likes) and the default
of the tests, since they need no footage. Positions and sizes are whole pixels, so the truth is exact; each frame is
drawn when it is asked for, and the same seed always gives the same film.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pftrack.datasets.frames import Frames, light
from pftrack.datasets.sequence import Sequence

HIDDEN_BELOW = 0.1
"""A walker of whom less than this share can be seen counts as hidden, and has no true box."""

MARGIN = 48
"""Pixels of ground beyond the frame on every side, for the camera to move over."""


@dataclass(frozen=True)
class Walker:
    """One pedestrian of a scene.

    Attributes
    ----------
    position : tuple of float
        Centre in the first frame, in pixels of the scene.
    velocity : tuple of float
        Pixels a frame.
    size : tuple of int
        Width and height in the first frame, in pixels.
    clothes : int
        Seed of the colours; walkers with equal `clothes` look alike.
    growth : float
        Size in the last frame divided by the size in the first.
    enters, leaves : int
        First frame in which the walker exists, and the first in which it does so no more.
    """

    position: tuple[float, float]
    velocity: tuple[float, float]
    size: tuple[int, int]
    clothes: int
    growth: float = 1.0
    enters: int = 0
    leaves: int = 10**9


class SyntheticFrames(Frames):
    """Frames of a synthetic scene, drawn on demand; see :func:`scene` for the knobs."""

    def __init__(self, walkers, n_frames, size, *, pillar, illumination, camera_motion, noise, seed):
        self.walkers, self.n_frames, self.size, self.seed = walkers, n_frames, size, seed
        self.illumination, self.camera_motion, self.noise = illumination, camera_motion, noise
        width, height = size
        self.ground = _ground(width + 2 * MARGIN, height + 2 * MARGIN, seed)
        self.pillar = None
        if pillar > 0:
            left, right = (MARGIN + round(width / 2 + side * pillar / 2) for side in (-1, 1))
            self.pillar = slice(left, right)
            shade = _texture(right - left, height + 2 * MARGIN, seed + 1)[..., None]
            self.pillar_picture = np.clip(np.array([70, 80, 90]) + 15 * shade, 0, 255).astype(np.uint8)
        self.pictures = {walker.clothes: _person(walker.clothes) for walker in walkers}

    def __len__(self) -> int:
        return self.n_frames

    def camera(self, index: int) -> tuple[int, int]:
        """Whole-pixel offset of the camera in a frame."""
        phase = 2 * np.pi * index / 60
        dx, dy = self.camera_motion * np.sin(phase), self.camera_motion * np.sin(1.7 * phase) / 2
        return round(dx), round(dy)

    def box(self, walker: Walker, index: int) -> tuple[int, int, int, int]:
        """Whole-pixel box of a walker in a frame, whether it can be seen or not."""
        scale = walker.growth ** (index / max(self.n_frames - 1, 1))
        w, h = (round(side * scale) for side in walker.size)
        dx, dy = self.camera(index)
        x = round(walker.position[0] + walker.velocity[0] * index - w / 2) - dx
        y = round(walker.position[1] + walker.velocity[1] * index - h / 2) - dy
        return x, y, w, h

    def draw(self, index: int) -> tuple[np.ndarray, np.ndarray, list[float]]:
        """Draw a frame.

        Returns
        -------
        frame : ndarray, shape (H, W, 3), uint8
            The picture in BGR order.
        owner : ndarray of int, shape (H, W)
            Index of the walker that each pixel shows; -1 where it shows none.
        visible : list of float
            Share of each walker that can be seen, from 0 to 1; pixels out of the picture are not seen.
        """
        width, height = self.size
        dx, dy = self.camera(index)
        window = np.s_[MARGIN + dy : MARGIN + dy + height, MARGIN + dx : MARGIN + dx + width]
        frame = self.ground[window].copy()
        owner = np.full((height, width), -1)
        drawn = np.zeros(len(self.walkers))
        boxes = [self.box(walker, index) for walker in self.walkers]
        for n in sorted(range(len(boxes)), key=lambda n: boxes[n][1] + boxes[n][3]):  # whoever stands lower is nearer
            walker, (x, y, w, h) = self.walkers[n], boxes[n]
            if not walker.enters <= index < walker.leaves:
                continue
            picture, mask = self.pictures[walker.clothes]
            picture = cv2.resize(picture, (w, h), interpolation=cv2.INTER_LINEAR)
            mask = cv2.resize(mask, (w, h), interpolation=cv2.INTER_NEAREST) > 0
            drawn[n] = mask.sum()
            left, top, right, bottom = max(x, 0), max(y, 0), min(x + w, width), min(y + h, height)
            if left < right and top < bottom:
                part = np.s_[top - y : bottom - y, left - x : right - x]
                frame[top:bottom, left:right][mask[part]] = picture[part][mask[part]]
                owner[top:bottom, left:right][mask[part]] = n
        if self.pillar is not None:
            left, right = (np.clip(edge - MARGIN - dx, 0, width) for edge in (self.pillar.start, self.pillar.stop))
            frame[:, left:right] = self.pillar_picture[MARGIN + dy : MARGIN + dy + height, : right - left]
            owner[:, left:right] = -1
        gain = light(index, self.n_frames, self.illumination)
        grain = self.noise * np.random.default_rng([self.seed, index]).standard_normal((height, width, 1))
        frame = np.clip(frame * gain + grain, 0, 255).astype(np.uint8)
        visible = [float((owner == n).sum() / drawn[n]) if drawn[n] else 0.0 for n in range(len(boxes))]
        return frame, owner, visible

    def read(self, index: int) -> np.ndarray:
        """Draw the picture of one frame."""
        return self.draw(index)[0]


def _texture(width: int, height: int, seed: int) -> np.ndarray:
    """Noise of mean 0 and about unit variance, coarse and fine together."""
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.standard_normal((height // 16 + 2, width // 16 + 2)), (width, height))
    return 0.8 * coarse + 0.4 * rng.standard_normal((height, width))


def _ground(width: int, height: int, seed: int) -> np.ndarray:
    """Pale grey-green ground with slabs."""
    ground = np.array([118, 140, 128]) + 14 * _texture(width, height, seed)[..., None]
    ground[::40] -= 25
    ground[:, ::56] -= 25
    return np.clip(ground, 0, 255).astype(np.uint8)


def _person(clothes: int) -> tuple[np.ndarray, np.ndarray]:
    """Picture of a person seen from behind, 48 by 144 pixels, and its silhouette."""
    rng = np.random.default_rng([clothes, 99])
    hue = int(rng.integers(180))
    colors = np.uint8([[[hue, 210, 190], [(hue + 70 + int(rng.integers(40))) % 180, 160, 110], [12, 110, 200]]])
    shirt, trousers, skin = (cv2.cvtColor(colors, cv2.COLOR_HSV2BGR)[0, n].tolist() for n in range(3))
    picture = np.zeros((144, 48, 3), np.uint8)
    mask = np.zeros((144, 48), np.uint8)
    for canvas, paints in ((picture, (skin, shirt, trousers)), (mask, (255, 255, 255))):
        cv2.rectangle(canvas, (6, 76), (21, 143), paints[2], -1)
        cv2.rectangle(canvas, (26, 76), (41, 143), paints[2], -1)
        cv2.rectangle(canvas, (0, 26), (47, 80), paints[1], -1)
        cv2.ellipse(canvas, (24, 14), (11, 14), 0, 0, 360, paints[0], -1)
    stripes = 12 * np.sign(np.sin(np.arange(144) * 2 * np.pi / rng.integers(6, 14)))
    shade = stripes[:, None, None] + 8 * rng.standard_normal((144, 48, 1))
    return np.clip(picture + shade, 0, 255).astype(np.uint8), mask


def scene(
    *,
    n_frames: int = 100,
    size: tuple[int, int] = (320, 240),
    n_walkers: int = 1,
    occlusion: int = 0,
    distractors: int = 0,
    illumination: float = 0.0,
    camera_motion: float = 0.0,
    growth: float = 1.0,
    birth_death: bool = False,
    noise: float = 2.0,
    seed: int = 0,
    name: str = "synthetic",
) -> Sequence:
    """Draw a film of walkers with exact truth.

    Parameters
    ----------
    n_frames : int
        Length of the film.
    size : tuple of int
        ``(width, height)`` of the frames in pixels.
    n_walkers : int
        Number of people with clothes of their own; the first is target 1.
    occlusion : int
        Width in pixels of a pillar in the middle of the scene, behind which everybody passes; 0 for none.
    distractors : int
        Number of further people dressed exactly like the first.
    illumination : float
        Share of the light that is gone by the last frame, from 0 to below 1.
    camera_motion : float
        Amplitude in pixels of a swaying camera, at most 48.
    growth : float
        Size of the people in the last frame relative to the first, from 0.2 to 5.
    birth_death : bool
        Whether people after the first appear and vanish during the film.
    noise : float
        Standard deviation of the grain, in grey levels.
    seed : int
        Seed of the paths, clothes and textures.
    name : str
        Name of the sequence.

    Returns
    -------
    Sequence
        Frames drawn on demand, and the boxes of all walkers. A walker of whom less than a tenth can be seen is hidden.

    Raises
    ------
    ValueError
        If a knob is out of its range.

    Examples
    --------
    >>> film = scene(n_frames=60, occlusion=90, seed=3)
    >>> film.frames[0].shape
    (240, 320, 3)
    >>> bool(np.isnan(film.boxes).any())  # somewhere the target is behind the pillar
    True
    """
    if n_frames < 1 or n_walkers < 1 or distractors < 0 or occlusion < 0:
        raise ValueError("a scene needs at least one frame and one walker, and no negative number of anything")
    if min(size) < 32:
        raise ValueError(f"size must be at least 32x32 pixels, got {size}")
    if not 0 <= illumination < 1 or not 0 <= camera_motion <= MARGIN or not 0.2 <= growth <= 5 or not noise >= 0:
        raise ValueError(
            f"illumination must lie in [0, 1), camera_motion in [0, {MARGIN}], growth in [0.2, 5] and noise at 0 or "
            f"above; got {illumination}, {camera_motion}, {growth} and {noise}"
        )
    rng = np.random.default_rng(seed)
    width, height = size
    walkers = []
    for n in range(n_walkers + distractors):
        direction = 1 if n % 2 == 0 else -1
        h = round(height * rng.uniform(0.36, 0.42))
        w = round(h / 3)
        lane = height * (0.42 + 0.3 * n / max(n_walkers + distractors - 1, 1) + rng.uniform(-0.03, 0.03))
        head_start = rng.uniform(0, 0.3) * width if n > 1 else 0.0  # no two march side by side
        speed = (width - 3 * w - head_start) / max(n_frames, 60)  # across the picture, but not out of it
        start = 1.5 * w + head_start if direction > 0 else width - 1.5 * w - head_start
        lifetime = {}
        if birth_death and n > 0:
            lifetime["enters"] = int(rng.integers(0, n_frames // 3 + 1))
            lifetime["leaves"] = int(rng.integers(2 * n_frames // 3, n_frames + 1))
        walkers.append(
            Walker(
                position=(start, lane),
                velocity=(direction * speed, rng.uniform(-0.05, 0.05)),
                size=(w, h),
                clothes=seed * 1000 + (n if n < n_walkers else 0),
                growth=growth,
                **lifetime,
            )
        )
    frames = SyntheticFrames(
        walkers,
        n_frames,
        size,
        pillar=occlusion,
        illumination=illumination,
        camera_motion=camera_motion,
        noise=noise,
        seed=seed,
    )
    rows = [
        [index, n + 1, *frames.box(walker, index), 1.0]
        for index in range(n_frames)
        for n, (walker, visible) in enumerate(zip(walkers, frames.draw(index)[2], strict=True))
        if visible >= HIDDEN_BELOW
    ]
    title = f"synthetic scene, {n_walkers + distractors} walkers, {n_frames} frames, seed {seed}"
    return Sequence(name, title, frames, np.array(rows, dtype=float).reshape(-1, 7), 25.0, "BSD-3-Clause", "pftrack")


SCENES: dict[str, dict] = {
    "synthetic-walk": {},
    "synthetic-occlusion": {"occlusion": 90},
    "synthetic-distractor": {"distractors": 1},
    "synthetic-crossing": {"n_walkers": 2},
    "synthetic-illumination": {"illumination": 0.6},
    "synthetic-camera": {"camera_motion": 20.0},
    "synthetic-scale": {"growth": 1.6},
    "synthetic-crowd": {"n_walkers": 5, "birth_death": True},
    "synthetic-dusk": {"n_walkers": 4, "illumination": 0.6},
}
"""Ready-made scenes by id: the arguments of :func:`scene`."""


def draw_detections(
    film: Sequence, found: float = 0.9, error: float = 0.05, ghosts: float = 0.2, seed: int = 0
) -> np.ndarray:
    """Draw detections from the truth, for scenes whose people no detector of real ones finds.

    Parameters
    ----------
    film : Sequence
        Any sequence with true boxes.
    found : float
        Probability of each true box to be found.
    error : float
        Standard deviation of the left, top, width and height of a detection, relative to its size.
    ghosts : float
        Mean number of false boxes a frame. Each has the size of some true box, and may be anywhere in any frame.
    seed : int
        Seed of the random numbers.

    Returns
    -------
    ndarray, shape (R, 7)
        A table of detections, see :mod:`pftrack.datasets.readers`: ``frame, id, x, y, w, h, score`` with id -1 and
        score 1.

    Examples
    --------
    >>> film = scene(n_frames=50)
    >>> len(film.tracks), len(draw_detections(film, ghosts=0)), len(draw_detections(film, found=1, ghosts=0))
    (50, 45, 50)
    """
    rng = np.random.default_rng(seed)
    table = film.tracks[rng.random(len(film.tracks)) < found]
    false = film.tracks[rng.integers(len(film.tracks), size=rng.poisson(ghosts * len(film)))].copy()
    false[:, 0] = rng.integers(len(film), size=len(false))
    height, width = film.frames[0].shape[:2]
    false[:, 2:4] = rng.uniform(0, [width, height] - false[:, 4:6])
    table = np.concatenate([table, false])
    table[:, 2:6] += rng.normal(0, error, (len(table), 4)) * table[:, [4, 5, 4, 5]]
    table[:, [1, 6]] = -1, 1
    return table
