"""Multi-target trackers, one a file, and their names on the command line."""

from pftrack.multi.association import AssociationParticleFilter
from pftrack.multi.bag_of_features import BagOfFeaturesParticleFilter
from pftrack.multi.base import MultiTracker, Track, follow, link, table
from pftrack.multi.boosted import BoostedParticleFilter

MULTI_TRACKERS = {
    "bof-pf": BagOfFeaturesParticleFilter,
    "boosted-pf": BoostedParticleFilter,
    "association-pf": AssociationParticleFilter,
}
"""The multi-target trackers by name."""

__all__ = [
    "MULTI_TRACKERS",
    "AssociationParticleFilter",
    "BagOfFeaturesParticleFilter",
    "BoostedParticleFilter",
    "MultiTracker",
    "Track",
    "follow",
    "link",
    "table",
]
