"""Figures of the book: one style, one colour for each role, frames with boxes and particles, and short clips.

The palette is that of Okabe and Ito, which readers with any form of colour blindness can tell apart; figures have an
opaque light ground, so that they read the same on a dark page.
"""

from __future__ import annotations

import base64
import html

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from pftrack.video import encode

BLUE, VERMILION, GREEN, ORANGE, SKY, PURPLE, YELLOW, BLACK = (
    "#0072B2", "#D55E00", "#009E73", "#E69F00", "#56B4E9", "#CC79A7", "#F0E442", "#000000"
)  # fmt: skip
TRUTH, ESTIMATE, PARTICLES, BASELINE = BLUE, VERMILION, ORANGE, GREEN
"""One colour for each role, the same in every chapter."""


def use_style() -> None:
    """Set Matplotlib's defaults to those of the book; the first code cell of every chapter calls it."""
    plt.rcParams.update(
        {
            "axes.axisbelow": True,
            "axes.grid": True,
            "axes.prop_cycle": plt.cycler(color=[BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, BLACK]),
            "axes.spines.right": False,
            "axes.spines.top": False,
            "axes.titlelocation": "left",
            "axes.titlesize": "medium",
            "figure.constrained_layout.use": True,
            "figure.dpi": 96,
            "figure.facecolor": "white",
            "figure.figsize": (7.0, 3.4),
            "font.size": 10,
            "grid.color": "0.9",
            "legend.frameon": False,
            "savefig.facecolor": "white",
        }
    )


def show_frame(ax: Axes, frame: np.ndarray, title: str = "") -> None:
    """Draw a frame, with pixel coordinates on its axes.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
        Where to draw.
    frame : ndarray, shape (H, W, 3) in BGR order, or (H, W)
        The image; a single channel is shown in grey.
    title : str
        What the picture shows.
    """
    image = cv2.cvtColor(frame, cv2.COLOR_BGR2RGB) if frame.ndim == 3 else frame
    levels = {"vmin": 0, "vmax": 255} if frame.dtype == np.uint8 else {}  # a dim picture stays dim
    height, width = frame.shape[:2]
    ax.imshow(image, cmap="gray", extent=(0, width, height, 0), **levels)
    ax.set(title=title, xlabel="x (pixels)", ylabel="y (pixels)", xlim=(0, width), ylim=(height, 0))
    ax.grid(False)


def draw_box(ax: Axes, box, color: str = ESTIMATE, label: str | None = None, **style) -> None:
    """Outline a box ``(x, y, w, h)``; a NaN box draws nothing.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
        Where to draw.
    box : array_like, shape (4,)
        In pixels.
    color, label, **style
        Passed to ``matplotlib.patches.Rectangle``.
    """
    x, y, w, h = np.asarray(box, dtype=float)
    if np.isfinite([x, y, w, h]).all():
        ax.add_patch(Rectangle((x, y), w, h, **{"fill": False, "edgecolor": color, "lw": 2, "label": label, **style}))


def draw_particles(ax: Axes, particles, weights=None, color: str = PARTICLES, label: str | None = None) -> None:
    """Scatter the centres of particles, their area in proportion to the weights.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
        Where to draw.
    particles : array_like, shape (N, d)
        States whose first two columns are x and y in pixels.
    weights : array_like, shape (N,), optional
        Normalised weights; equal if not given.
    color, label
        Passed to ``Axes.scatter``.
    """
    particles = np.asarray(particles)
    n = len(particles)
    area = 8 * n * (np.full(n, 1 / n) if weights is None else np.asarray(weights))
    ax.scatter(particles[:, 0], particles[:, 1], s=np.clip(area, 1, 60), color=color, lw=0.3, ec="k", label=label)


class Clip:
    """A short film shown in a notebook and in the built page alike, with nothing fetched from elsewhere.

    Parameters
    ----------
    frames : iterable of ndarray, shape (H, W, 3), uint8
        The pictures in BGR order, all of one size.
    fps : float
        Frames a second.
    description : str
        What the film shows, in words; read aloud to those who cannot see it.
    quality : int
        As for :func:`pftrack.video.encode`: smaller is better and larger.

    Raises
    ------
    ValueError
        If there are no frames.

    Examples
    --------
    >>> frames = [np.full((48, 64, 3), shade, dtype=np.uint8) for shade in (0, 128, 255)]
    >>> Clip(frames, fps=25, description="Grey turns to white.")
    Clip: 3 frames of 64x48 at 25 fps. Grey turns to white.
    """

    def __init__(self, frames, fps: float, description: str, quality: int = 30):
        frames = list(frames)
        self.mp4 = encode(frames, fps, quality)
        self.fps, self.description = fps, description
        self.n_frames, (self.height, self.width) = len(frames), (side // 2 * 2 for side in frames[0].shape[:2])
        self.poster = cv2.imencode(".jpg", frames[len(frames) // 2], [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()

    def __repr__(self) -> str:
        return f"Clip: {self.n_frames} frames of {self.width}x{self.height} at {self.fps:g} fps. {self.description}"

    def _repr_html_(self) -> str:
        mp4, poster = (base64.b64encode(data).decode() for data in (self.mp4, self.poster))
        description = html.escape(self.description, quote=True)
        return (
            f'<figure><video controls loop muted playsinline width="{self.width}" style="max-width:100%" '
            f'aria-label="{description}" poster="data:image/jpeg;base64,{poster}" '
            f'src="data:video/mp4;base64,{mp4}"></video><figcaption>{description}</figcaption></figure>'
        )
