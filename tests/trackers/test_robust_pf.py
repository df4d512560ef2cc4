"""The robust filter on scenes with exact truth, and the parts of it that have a closed form."""

import cv2
import numpy as np
import pytest

from pftrack import RobustParticleFilter, datasets, metrics, smc, track
from pftrack.trackers import robust_pf


def run(scene, n_frames=None, **settings):
    frames = scene.frames[:n_frames]
    return track(RobustParticleFilter(**settings), frames, scene.boxes[0])


@pytest.mark.parametrize("name", ["synthetic-crossing", "synthetic-distractor", "synthetic-camera", "synthetic-scale"])
def test_holds_its_target(name):
    scene = datasets.load(name)
    overlap = metrics.overlap(run(scene, 60), scene.boxes[:60])
    assert np.nanmean(overlap) > 0.75
    assert np.nanmin(overlap) > metrics.HIT_OVERLAP


def test_same_seed_gives_the_same_boxes():
    scene = datasets.load("synthetic-walk")
    first, again, other = (run(scene, 15, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_prepared_frames_give_the_same_boxes_to_the_bit():
    scene = datasets.load("synthetic-distractor")
    trackers = [RobustParticleFilter(seed=seed) for seed in (0, 1)]
    boxes = []
    for t, frame in enumerate(scene.frames[:20]):
        look = trackers[0].prepare(frame)
        estimates = [tracker.update(look) if t else tracker.init(look, scene.boxes[0]) for tracker in trackers]
        boxes.append([estimate.box for estimate in estimates])
    for seed in (0, 1):
        np.testing.assert_array_equal(np.array(boxes)[:, seed], run(scene, 20, seed=seed))


def test_a_tracker_can_be_started_again():
    scene = datasets.load("synthetic-walk")
    tracker = RobustParticleFilter(seed=4)
    first = track(tracker, scene.frames[:10], scene.boxes[0])
    np.testing.assert_array_equal(first, track(tracker, scene.frames[:10], scene.boxes[0]))


def test_twice_the_picture_gives_twice_the_boxes():
    scene = datasets.load("synthetic-walk")
    large = [cv2.resize(frame, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST) for frame in scene.frames[:20]]
    boxes = track(RobustParticleFilter(seed=0), large, 2 * scene.boxes[0])
    assert metrics.single_target(boxes, 2 * scene.boxes[:20]).overlap_visible > 0.8


def test_redrawn_particles_together_weigh_what_the_prior_gives_them():
    scene = datasets.load("synthetic-walk")
    tracker = RobustParticleFilter(n_particles=400, seed=0)
    tracker.init(scene.frames[0], scene.boxes[0])
    tracker.log_weights = np.log(np.random.default_rng(0).dirichlet(np.ones(400)))
    tracker._n_bad = tracker.patience
    before = tracker.particles[0]
    particles, log_weights = tracker._predict(tracker.prepare(scene.frames[1]))
    weights = smc.normalize(log_weights)
    is_new = np.isclose(log_weights, np.log(robust_pf.JUMP / 0.25))
    assert is_new.sum() == 100
    assert weights[is_new].sum() == pytest.approx(robust_pf.JUMP, rel=0.1)  # the others' weights are a random sample
    assert (np.abs(particles[is_new] - before).sum(axis=1) > 1e-9).all()


def test_the_target_is_lost_behind_a_wall_and_found_again():
    scene = datasets.load("synthetic-walk")
    frames = [frame.copy() for frame in scene.frames[:60]]
    for frame in frames[20:40]:
        frame[:] = 90
    tracker = RobustParticleFilter(seed=0)
    lost, boxes = [], []
    for t, frame in enumerate(frames):
        estimate = tracker.update(frame) if t else tracker.init(frame, scene.boxes[0])
        lost.append(estimate.lost)
        boxes.append(estimate.box)
    assert not any(lost[:20])
    assert all(lost[24:40])
    assert metrics.overlap(boxes, scene.boxes[:60])[50:].min() > 0.5


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"n_particles": 0}, "at least 1"),
        ({"n_bands": 0}, "at least 1"),
        ({"patience": 0}, "at least 1"),
        ({"seed": -1}, "non-negative"),
        ({"seed": "one"}, "integer"),
        ({"sigma": 0}, "positive"),
        ({"template_weight": -1}, "not negative"),
        ({"noise": (0.1, 0.1)}, "three"),
        ({"noise": (0.1, np.nan, 0.1)}, "NaN"),
        ({"side_margin": 0.5}, "side_margin"),
        ({"redraw": 1}, "redraw"),
        ({"learning_rate": 2}, "between 0 and 1"),
        ({"resample_threshold": -0.1}, "between 0 and 1"),
    ],
)
def test_a_setting_out_of_its_range_is_named(settings, word):
    with pytest.raises(ValueError, match=word):
        RobustParticleFilter(**settings)


def test_update_needs_init_and_frames_of_one_size():
    scene = datasets.load("synthetic-walk")
    tracker = RobustParticleFilter()
    with pytest.raises(ValueError, match="init"):
        tracker.update(scene.frames[0])
    tracker.init(scene.frames[0], scene.boxes[0])
    with pytest.raises(ValueError, match="one size"):
        tracker.update(np.zeros((50, 60, 3), np.uint8))


@pytest.mark.parametrize("settings", [{"n_particles": 1}, {"template_weight": 0}, {"n_bands": 1, "redraw": 0}])
def test_every_part_can_be_left_out(settings):
    scene = datasets.load("synthetic-walk")
    assert np.isfinite(run(scene, 8, **settings)).all()


def test_a_small_target_at_the_border_is_no_trouble():
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (4, 12, 10, 3), dtype=np.uint8)
    assert np.isfinite(track(RobustParticleFilter(seed=0), frames, (-3, 8, 6, 9))).all()


def test_real_footage_is_followed_better_than_the_paper_reports(footage):
    sequence = footage("bobot-I")
    score = metrics.single_target(run(sequence), sequence.boxes)
    assert score.overlap_all > 0.80
    assert score.hit_ratio_all > 0.95
