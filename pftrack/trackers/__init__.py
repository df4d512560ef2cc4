"""Single-target trackers, one a file, and their names on the command line."""

from pftrack.trackers.base import Estimate, Tracker, follow, track
from pftrack.trackers.camshift import CamShiftTracker
from pftrack.trackers.color_pf import ColorParticleFilter
from pftrack.trackers.mean_shift import MeanShiftTracker
from pftrack.trackers.robust_pf import RobustParticleFilter

TRACKERS = {
    "mean-shift": MeanShiftTracker,
    "camshift": CamShiftTracker,
    "color-pf": ColorParticleFilter,
    "robust-pf": RobustParticleFilter,
}
"""The trackers by name."""

__all__ = [
    "TRACKERS",
    "CamShiftTracker",
    "ColorParticleFilter",
    "Estimate",
    "MeanShiftTracker",
    "RobustParticleFilter",
    "Tracker",
    "follow",
    "track",
]
