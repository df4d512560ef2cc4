"""OpenCV's trackers, and trackers made of OpenCV's functions as most programmers would make them."""

import cv2
import numpy as np

from pftrack import color


class CamShift:
    """CAMSHIFT as in OpenCV's sample: convert the frame, project the histogram back, move the window."""

    def init(self, frame, box):
        """Learn the hues of the box."""
        self.histogram = color.masked_histogram(frame, box)
        self.first = self.window = tuple(int(v) for v in box)
        self.criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 1)

    def update(self, frame):
        """Follow the hues."""
        hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
        probability = cv2.calcBackProject([hsv], [0], self.histogram, [0, 180], 1)
        _, self.window = cv2.CamShift(probability, self.window, self.criteria)
        if min(self.window[2:]) < 2:
            self.window = self.first


class CamShiftPutBack(CamShift):
    """The same, with its window put back after each frame: its cost then does not depend on where it went."""

    def update(self, frame):
        """Search from the first window again."""
        super().update(frame)
        self.window = self.first


class CamShiftInWindow(CamShift):
    """The same on a window padded by half its size on each side: what CAMSHIFT could cost."""

    def update(self, frame):
        """Follow the hues within the padded window."""
        x, y, w, h = self.window
        left, top = max(x - w // 2, 0), max(y - h // 2, 0)
        part = frame[top : y + h + h // 2, left : x + w + w // 2]
        probability = cv2.calcBackProject([cv2.cvtColor(part, cv2.COLOR_BGR2HSV)], [0], self.histogram, [0, 180], 1)
        _, (x, y, w, h) = cv2.CamShift(probability, (x - left, y - top, w, h), self.criteria)
        self.window = (x + left, y + top, w, h) if min(w, h) >= 2 else self.first


class NaiveParticleFilter:
    """The colour particle filter written down as it is told: a three-channel histogram for every particle."""

    LEVELS = (8, 8, 4)
    RANGES = (0, 180, 0, 256, 0, 256)

    def __init__(self, n_particles: int, noise):
        self.n_particles, self.noise = n_particles, noise

    def init(self, frame, box):
        """Learn the histogram of the box."""
        self.rng, self.size = np.random.default_rng(0), np.array(box[2:], dtype=float)
        self.particles = np.tile([box[0] + box[2] / 2, box[1] + box[3] / 2, 0, 0, 1.0], (self.n_particles, 1))
        self.target = self.histogram(cv2.cvtColor(frame, cv2.COLOR_BGR2HSV), self.particles[0])

    def histogram(self, hsv, particle):
        """Colours in a particle's rectangle."""
        w, h = particle[4] * self.size
        left, top = max(round(particle[0] - w / 2), 0), max(round(particle[1] - h / 2), 0)
        part = hsv[top : max(round(particle[1] + h / 2), 0), left : max(round(particle[0] + w / 2), 0)]
        if part.size == 0:
            return np.zeros(self.LEVELS, dtype=np.float32)
        return cv2.calcHist([part], [0, 1, 2], None, self.LEVELS, self.RANGES)

    def update(self, frame):
        """Predict, weigh each particle, estimate, resample."""
        hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
        self.particles[:, :2] += self.particles[:, 2:4]
        self.particles += self.noise * self.rng.standard_normal(self.particles.shape)
        self.particles[:, 4] = self.particles[:, 4].clip(0.2, 5.0)
        histograms = [self.histogram(hsv, particle) for particle in self.particles]
        distances = np.array([cv2.compareHist(self.target, h, cv2.HISTCMP_BHATTACHARYYA) for h in histograms])
        weights = np.exp(-(distances**2) / (2 * 0.1**2))
        weights /= weights.sum()
        self.mean = weights @ self.particles
        chosen = np.searchsorted(np.cumsum(weights), (self.rng.random() + np.arange(len(weights))) / len(weights))
        self.particles = self.particles[np.minimum(chosen, len(weights) - 1)]


class OpenCVTracker:
    """One of OpenCV's own, which are made anew for each target."""

    def __init__(self, name: str):
        where = cv2.legacy if name == "MOSSE" else cv2
        self.create = getattr(where, f"Tracker{name}_create")

    def init(self, frame, box):
        """Make one and start it."""
        self.tracker = self.create()
        self.tracker.init(frame, tuple(int(v) for v in box))

    def update(self, frame):
        """Follow."""
        self.tracker.update(frame)
