"""Single-target trackers, one a file, and their names on the command line."""

from pftrack.trackers.base import Estimate, Tracker, follow, track
from pftrack.trackers.camshift import CamShiftTracker
from pftrack.trackers.color_pf import ColorParticleFilter
from pftrack.trackers.mean_shift import MeanShiftTracker
from pftrack.trackers.robust_pf import RobustParticleFilter
from pftrack.trackers.superpixel import SuperpixelTracker

TRACKERS = {
    "mean-shift": MeanShiftTracker,
    "camshift": CamShiftTracker,
    "color-pf": ColorParticleFilter,
    "robust-pf": RobustParticleFilter,
    "superpixel": SuperpixelTracker,
}
"""The trackers by name."""

__all__ = [
    "TRACKERS",
    "CamShiftTracker",
    "ColorParticleFilter",
    "Estimate",
    "MeanShiftTracker",
    "RobustParticleFilter",
    "SuperpixelTracker",
    "Tracker",
    "follow",
    "track",
]
