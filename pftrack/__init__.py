"""Particle filters taught by building pedestrian trackers.

The library behind the book. A tracker is started on the first frame and updated with each later one:

>>> import pftrack
>>> scene = pftrack.datasets.load("synthetic-walk")
>>> tracker = pftrack.ColorParticleFilter(n_particles=100, seed=0)
>>> boxes = pftrack.track(tracker, scene.frames[:10], scene.boxes[0])
>>> pftrack.metrics.single_target(boxes, scene.boxes[:10]).n_frames
10
"""

from pftrack import color, datasets, detection, metrics, motion, multi, smc
from pftrack.detection import PedestrianDetector
from pftrack.multi import AssociationParticleFilter, BagOfFeaturesParticleFilter, BoostedParticleFilter, Track
from pftrack.sliders import Slider, explore
from pftrack.trackers import (
    CamShiftTracker,
    ColorParticleFilter,
    Estimate,
    MeanShiftTracker,
    RobustParticleFilter,
    SuperpixelTracker,
    follow,
    track,
)

__version__ = "0.1.0"

__all__ = [
    "AssociationParticleFilter",
    "BagOfFeaturesParticleFilter",
    "BoostedParticleFilter",
    "CamShiftTracker",
    "ColorParticleFilter",
    "Estimate",
    "MeanShiftTracker",
    "PedestrianDetector",
    "RobustParticleFilter",
    "Slider",
    "SuperpixelTracker",
    "Track",
    "color",
    "datasets",
    "detection",
    "explore",
    "follow",
    "metrics",
    "motion",
    "multi",
    "smc",
    "track",
]
