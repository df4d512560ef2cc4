"""Multi-target trackers, one a file, and their names on the command line."""

from pftrack.multi.bag_of_features import BagOfFeaturesParticleFilter
from pftrack.multi.base import MultiTracker, Track, follow, link, table

MULTI_TRACKERS = {"bof-pf": BagOfFeaturesParticleFilter}
"""The multi-target trackers by name."""

__all__ = ["MULTI_TRACKERS", "BagOfFeaturesParticleFilter", "MultiTracker", "Track", "follow", "link", "table"]
