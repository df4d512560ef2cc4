"""How good a track is, how good detections are, and how good the tracks of a whole crowd are.

One target against its truth, frame by frame, is in :mod:`pftrack.metrics.single`; many, when who is who has to be
settled first, in :mod:`pftrack.metrics.many`. The result comes first everywhere, the truth second.
"""

from pftrack.metrics.many import (
    DetectionScore,
    MultiTargetScore,
    correct,
    detections,
    match_targets,
    multi_target,
)
from pftrack.metrics.single import (
    HIT_OVERLAP,
    SingleTargetScore,
    center_error,
    overlap,
    pairwise_overlap,
    single_target,
)

__all__ = [
    "HIT_OVERLAP",
    "DetectionScore",
    "MultiTargetScore",
    "SingleTargetScore",
    "center_error",
    "correct",
    "detections",
    "match_targets",
    "multi_target",
    "overlap",
    "pairwise_overlap",
    "single_target",
]
