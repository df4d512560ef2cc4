"""Superpixel tracking: its formulas by hand, its memory frame by frame, and scenes with exact truth."""

import cv2
import numpy as np
import pytest
from scipy import stats

from pftrack import SuperpixelTracker, codebook, color, datasets, metrics, superpixels, track
from pftrack.trackers import superpixel

BOX = np.array([30.0, 20.0, 16.0, 24.0])


def picture(x: int = 30) -> np.ndarray:
    """A blue block on green ground."""
    frame = np.full((80, 100, 3), (0, 160, 0), dtype=np.uint8)
    frame[20:44, x : x + 16] = (255, 0, 0)
    return frame


def show(monkeypatch, painted) -> None:
    """Let the tracker see this confidence map, whatever is in the frame."""
    monkeypatch.setattr(superpixels, "paint", lambda *_: painted)


def map_of(x: int, inside: float = 1.0, outside: float = -1 / 3) -> np.ndarray:
    painted = np.full((80, 100), outside)
    painted[20:44, x : x + 16] = inside
    return painted


@pytest.fixture(scope="module")
def walk():
    scene = datasets.load("synthetic-walk")
    return list(scene.frames[:25]), scene.boxes[:25]


# ---------------------------------------------------------------------------------------------------------------------
# Formulas
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("factor", [1, 2, 3])
def test_a_score_is_what_the_code_gets_by_warping(sign, factor):
    """It warps each candidate to the size of the last box, sums, and multiplies or divides by the ratio of areas."""
    reference = np.array([6, 10])
    painted = np.random.default_rng(0).uniform(-0.4, 1.0, (60, 40)) * sign
    box = np.array([5, 7, *reference * factor])
    window = painted[7 : 7 + box[3], 5 : 5 + box[2]]
    warped = cv2.resize(window, reference.tolist(), interpolation=cv2.INTER_AREA)  # the mean of factor x factor pixels
    ratio = box[2:].prod() / reference.prod()
    expected = warped.sum() * ratio if warped.sum() > 0 else warped.sum() / ratio
    assert (warped.sum() > 0) == (sign > 0)
    sums = superpixels.box_confidences(painted, [box])
    assert superpixel.scores(sums, [box[2:].prod()], reference.prod()) == pytest.approx([expected])


def test_the_prior_is_a_product_of_normal_densities():
    rng = np.random.default_rng(0)
    state, variances = np.array([50.0, 60.0, 20.0, 40.0]), (90.0, 30.0)
    particles = state + rng.normal(size=(20, 4)) * 8
    density = stats.multivariate_normal(state, np.diag([90.0, 90.0, 30.0, 30.0]))
    expected = density.logpdf(particles) - density.logpdf(state)
    np.testing.assert_allclose(superpixel.motion_log_prior(particles, state, variances), expected)


def test_the_estimate_is_the_greatest_posterior(monkeypatch):
    tracker = SuperpixelTracker(noise=(0.3, 0.1, 0.05, 0.02), sigma_center=0.2, sigma_size=0.3)
    tracker.init(picture(), BOX)
    painted = map_of(36)
    show(monkeypatch, painted)
    estimate = tracker.update(picture())
    x, y, w, h = estimate.particles.T
    edges = color.pixel_edges(np.column_stack([x - w / 2, y - h / 2, w, h]))
    total = np.array([painted[top:bottom, left:right].sum() for left, top, right, bottom in edges])
    score = np.where(total > 0, total, total * (16 * 24 / (w * h)) ** 2)
    center, size = stats.norm([38, 32], np.sqrt(0.2 * 90)), stats.norm([16, 24], np.sqrt(0.3 * 90))
    prior = (center.pdf(estimate.particles[:, :2]) * size.pdf(estimate.particles[:, 2:])).prod(axis=1)
    weights = (score - score.min()) * prior
    np.testing.assert_allclose(estimate.weights, weights / weights.sum(), rtol=1e-6, atol=1e-12)
    x, y, w, h = estimate.particles[weights.argmax()]
    np.testing.assert_allclose(estimate.box, [x - w / 2, y - h / 2, w, h])
    assert 31 < estimate.box[0] < 37  # drawn to the map by the score, back to the last box by the prior
    inside = superpixels.box_confidences(painted, [estimate.box])[0] / estimate.box[2:].prod()
    assert estimate.score == pytest.approx(inside)


def test_negative_confidences_count_a_third_of_positive_ones():
    plain, milder = SuperpixelTracker(penalty=1), SuperpixelTracker(penalty=3)
    for tracker in (plain, milder):
        tracker.init(picture(), BOX)
    full = plain.prior.confidences
    assert full.min() < 0 < full.max()
    np.testing.assert_allclose(milder.prior.confidences, np.where(full < 0, full / 3, full))


@pytest.mark.parametrize("distance_scale", ["farthest", "cluster"])
def test_a_superpixel_counts_less_the_farther_it_is_from_its_cluster(walk, distance_scale):
    frames, boxes = walk
    tracker = SuperpixelTracker(distance_scale=distance_scale, n_superpixels=30, spread=1.5)
    tracker.init(frames[0], boxes[0])
    region = superpixels.surroundings(boxes[0], frames[0].shape, square=True)
    training = superpixels.cut(frames[0], region, 30, n_steps=superpixel.N_STEPS).features
    found = superpixels.cut(frames[3], region, 30)
    for feature, confidence in zip(found.features, tracker._confidences(found), strict=True):
        distances = np.linalg.norm(tracker.prior.centers - feature, axis=1)
        k = distances.argmin()
        farthest = (np.linalg.norm(training - feature, axis=1) ** 2).max()
        r = farthest if distance_scale == "farthest" else tracker.prior.radii[k]
        assert confidence == pytest.approx(np.exp(-1.5 * distances[k] / r) * tracker.prior.confidences[k])


def test_the_map_covers_the_square_around_the_last_box(monkeypatch):
    tracker, maps, paint = SuperpixelTracker(), [], superpixels.paint
    monkeypatch.setattr(superpixels, "paint", lambda *arguments: maps.append(paint(*arguments)) or maps[-1])
    tracker.init(picture(), BOX)
    tracker.update(picture())
    half = 1.5 * np.hypot(8, 12)
    rows, columns = np.nonzero(maps[0] > -1)
    left, top, right, bottom = np.round([38 - half, 32 - half, 38 + half, 32 + half])
    assert (columns.min(), rows.min()) == (left, top)
    assert (columns.max(), rows.max()) == (right - 1, bottom - 1)


# ---------------------------------------------------------------------------------------------------------------------
# Learning
# ---------------------------------------------------------------------------------------------------------------------


def test_clusters_are_made_anew_in_the_first_frames_and_then_every_ten(monkeypatch):
    tracker = SuperpixelTracker(n_superpixels=20, n_candidates=20)
    tracker.init(picture(), BOX)
    show(monkeypatch, map_of(30))
    learnt, prior = [], tracker.prior
    for t in range(1, 40):
        tracker.update(picture())
        if tracker.prior is not prior:
            learnt.append(t)
        prior = tracker.prior
    assert learnt == [1, 2, 3, 14, 24, 34]
    assert len(tracker._lessons) == 15


def test_nothing_is_learnt_of_an_occluded_frame(monkeypatch):
    tracker = SuperpixelTracker(seed=1)
    tracker.init(picture(), BOX)
    seen = tracker.update(picture())
    prior, lessons = tracker.prior, list(tracker._lessons)
    show(monkeypatch, map_of(30, inside=-1 / 3))
    for _ in range(20):
        estimate = tracker.update(picture())
        assert estimate.lost
        assert estimate.score == 0
        spread = np.abs(estimate.particles[:, :2] - (seen.box[:2] + seen.box[2:] / 2)).max(axis=0)
        assert (spread < 5 * np.array([0.2, 0.05]) * seen.box[2:]).all()  # still drawn where it was last seen
    assert tracker.prior is prior
    assert len(tracker._lessons) == len(lessons)
    show(monkeypatch, map_of(31))
    estimate = tracker.update(picture(31))
    assert not estimate.lost
    assert len(tracker._lessons) == len(lessons) + 1


@pytest.mark.parametrize(("mean", "learnt"), [(-0.06, True), (-0.09, False)])
def test_occlusion_is_told_by_the_best_sum_relative_to_the_square(monkeypatch, mean, learnt):
    """Of a map of one value every candidate has the mean; 0.515 allows a sum of -0.015 of the square's area."""
    tracker = SuperpixelTracker()
    tracker.init(picture(), BOX)
    left, top, right, bottom = superpixels.surroundings(BOX, picture().shape, square=True)
    assert -0.09 < -0.015 * (right - left) * (bottom - top) / BOX[2:].prod() < -0.06
    show(monkeypatch, np.full((80, 100), mean))
    estimate = tracker.update(picture())
    assert estimate.lost
    assert (len(tracker._lessons) == 2) == learnt


def test_several_known_frames_are_learnt_together(walk):
    frames, boxes = walk
    tracker = SuperpixelTracker(penalty=1, n_superpixels=60)
    estimate = tracker.init_from(frames[:5], boxes[:5])
    np.testing.assert_array_equal(estimate.box, boxes[4])
    found = [
        superpixels.cut(frame, superpixels.surroundings(box, frame.shape, square=True), 60, n_steps=superpixel.N_STEPS)
        for frame, box in zip(frames[:5], boxes[:5], strict=True)
    ]
    centers = codebook.mean_shift(np.concatenate([of_one.features for of_one in found]), 0.18)
    words = codebook.nearest_words(np.concatenate([of_one.features for of_one in found]), centers)
    inside, outside = np.hstack([superpixels.areas(of_one, box) for of_one, box in zip(found, boxes[:5], strict=True)])
    inside, outside = np.bincount(words, inside), np.bincount(words, outside)
    np.testing.assert_allclose(tracker.prior.confidences, (inside - outside) / (inside + outside))
    assert metrics.overlap(tracker.update(frames[5]).box[None], boxes[5:6])[0] > 0.8


def test_one_known_frame_is_init_and_hidden_ones_are_left_out(walk):
    frames, boxes = walk
    hidden = np.full(4, np.nan)
    trackers = [SuperpixelTracker(seed=2) for _ in range(3)]
    trackers[0].init(frames[1], boxes[1])
    trackers[1].init_from(frames[1:2], boxes[1:2])
    trackers[2].init_from(frames[:3], [hidden, boxes[1], hidden])
    first, second, third = ([tracker.update(frame).box for frame in frames[2:5]] for tracker in trackers)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, third)


# ---------------------------------------------------------------------------------------------------------------------
# Scenes
# ---------------------------------------------------------------------------------------------------------------------


def test_a_walker_is_followed(walk):
    frames, boxes = walk
    overlap = metrics.overlap(track(SuperpixelTracker(seed=0), frames, boxes[0]), boxes)
    assert overlap.mean() > 0.8
    assert overlap.min() > 0.6


def test_the_same_seed_gives_the_same_boxes(walk):
    frames, boxes = walk
    first, again, other = (track(SuperpixelTracker(seed=seed), frames[:6], boxes[0]) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_a_person_in_real_footage_is_followed(footage):
    sequence = footage("bobot-I")
    tracker = SuperpixelTracker(seed=0)
    tracker.init_from([sequence.frames[t] for t in range(5)], sequence.boxes[:5])
    boxes = np.array([tracker.update(sequence.frames[t]).box for t in range(5, 20)])
    assert np.nanmean(metrics.overlap(boxes, sequence.boxes[5:20])) > 0.6


# ---------------------------------------------------------------------------------------------------------------------
# Errors
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "hint"),
    [
        ({"n_candidates": 0}, "at least 1"),
        ({"n_superpixels": 0}, "at least 1"),
        ({"n_training": 0}, "at least 1"),
        ({"update_every": 0}, "at least 1"),
        ({"window": 3}, "window at least n_training"),
        ({"seed": -1}, "non-negative"),
        ({"noise": (0.1, 0.1, 0.1)}, "four"),
        ({"noise": (0.1, 0.1, 0.1, np.nan)}, "NaN"),
        ({"noise": (0.1, 0.1, 0.1, -0.1)}, "negative"),
        ({"sigma_center": 0}, "positive"),
        ({"sigma_size": np.inf}, "positive"),
        ({"bandwidth": -0.1}, "positive"),
        ({"spread": -1}, "not be negative"),
        ({"penalty": 0.5}, "at least 1"),
        ({"occlusion": np.nan}, "a number"),
        ({"distance_scale": "radius"}, "farthest"),
    ],
    ids=str,
)
def test_a_setting_out_of_its_range_is_named(settings, hint):
    with pytest.raises(ValueError, match=hint):
        SuperpixelTracker(**settings)


@pytest.mark.parametrize(
    ("frames", "boxes", "hint"),
    [
        ([], np.empty((0, 4)), "got 0 frames"),
        ([picture()] * 2, [BOX], r"got 2 frames and boxes \(1, 4\)"),
        ([picture()], BOX, r"boxes \(4,\)"),
        ([picture(), picture()[:50]], [BOX, BOX], "one size"),
        ([picture(), None], [BOX, BOX], "colour image"),
        ([picture()], [[np.nan] * 4], "hidden in all"),
        ([picture()], [[200, 20, 16, 24]], "outside the 100x80 frame"),
    ],
    ids=["no frames", "too few boxes", "one box", "sizes", "no frame", "hidden", "outside"],
)
def test_what_cannot_be_learnt_from_is_refused(frames, boxes, hint):
    with pytest.raises(ValueError, match=hint):
        SuperpixelTracker().init_from(frames, boxes)
