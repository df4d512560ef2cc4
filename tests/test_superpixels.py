"""Superpixels and the confidence map against closed forms and real footage."""

import numpy as np
import pytest

from pftrack import color, metrics, superpixels


@pytest.fixture(scope="module")
def film(footage):
    sequence = footage("bobot-I")
    return [sequence.frames[t] for t in range(8)], sequence.boxes[:8]


def test_superpixels_share_a_picture_among_them(film):
    frames, boxes = film
    left, top, right, bottom = superpixels.surroundings(boxes[0], frames[0].shape)
    part = frames[0][top:bottom, left:right]
    labels = superpixels.segment(part, n_segments=200)
    n = labels.max() + 1
    assert 120 < n < 280
    np.testing.assert_array_equal(np.unique(labels), np.arange(n))
    features, bins = superpixels.histograms(color.hsv_bins(part), labels), color.hsv_bins(part)
    for s in (0, n // 2, n - 1):
        inside = bins[labels == s]
        np.testing.assert_allclose(features[s], np.bincount(inside, minlength=256) / len(inside))


def test_a_superpixel_keeps_to_an_edge():
    halves = np.zeros((60, 60, 3), np.uint8)
    halves[:, 25:] = (40, 200, 90)
    labels = superpixels.segment(halves, n_segments=30)
    assert not set(labels[:, :25].ravel()) & set(labels[:, 25:].ravel())


@pytest.mark.parametrize("shape", [(2, 2), (3, 40), (5, 5)])
def test_of_a_small_picture_there_are_few(shape):
    labels = superpixels.segment(np.zeros((*shape, 3), np.uint8), n_segments=200)
    assert labels.shape == shape
    assert labels.max() + 1 <= max(shape[0] * shape[1] // 9, 1)


def test_confidence_is_the_balance_of_the_areas(monkeypatch):
    """Eq. 1 by hand: columns of two colours, one of which also lies beside the box."""
    frame = np.zeros((40, 60, 3), np.uint8)
    frame[:, :] = (0, 255, 0)
    frame[:, 20:36] = (255, 0, 0)
    monkeypatch.setattr(superpixels, "segment", lambda part, *_: np.tile(np.arange(part.shape[1]), (part.shape[0], 1)))
    prior = superpixels.learn([frame], [[20, 10, 20, 20]])  # surroundings: columns 15 to 45, rows 5 to 35
    target = np.array([16 * 20, 4 * 20])
    whole = np.array([16 * 30, 14 * 30])
    blue_first = prior.centers[:, color.hsv_bins(frame)[0, 25]].argsort()[::-1]
    np.testing.assert_allclose(prior.confidences[blue_first], (2 * target - whole) / whole)
    np.testing.assert_allclose(prior.radii, 0.18)  # clusters without extent


def test_confidence_falls_with_distance_as_eq_2_says():
    prior = superpixels.PriorKnowledge(np.eye(3), np.array([0.2, 0.4, 0.6]), np.array([0.9, -0.8, 0.1]))
    rng = np.random.default_rng(0)
    features = rng.dirichlet(np.ones(3), 50)
    for feature, found in zip(features, superpixels.confidences(features, prior, spread=2), strict=True):
        distances = np.linalg.norm(np.eye(3) - feature, axis=1)
        i = distances.argmin()
        assert found == pytest.approx(np.exp(-2 * distances[i] / prior.radii[i]) * prior.confidences[i])


def test_the_map_shows_the_target_of_a_real_film(film):
    frames, boxes = film
    prior = superpixels.learn(frames[:5], boxes[:5])
    painted = superpixels.confidence_map(frames[6], boxes[5], prior)
    left, top, right, bottom = superpixels.surroundings(boxes[5], frames[6].shape)
    part = np.zeros(painted.shape, bool)
    part[top:bottom, left:right] = True
    assert (painted[~part] == -1).all()
    assert np.abs(painted).max() <= 1
    x0, y0, x1, y1 = color.pixel_edges([boxes[6]])[0]
    target = np.zeros_like(part)
    target[y0:y1, x0:x1] = True
    assert painted[target].mean() > painted[part & ~target].mean() + 0.3


def test_what_cannot_be_learnt_from_is_refused(film):
    frames, boxes = film
    with pytest.raises(ValueError, match="got 0 frames"):
        superpixels.learn([], np.empty((0, 4)))
    with pytest.raises(ValueError, match=r"got 2 frames and boxes \(1, 4\)"):
        superpixels.learn(frames[:2], boxes[:1])
    with pytest.raises(ValueError, match="less than 2x2"):
        superpixels.learn(frames[:1], [[500, 0, 20, 40]])
    with pytest.raises(ValueError, match="factor"):
        superpixels.surroundings(boxes[0], frames[0].shape, factor=0.5)
    for arguments in [{"n_segments": 0}, {"compactness": 0}]:
        with pytest.raises(ValueError, match="need a colour picture"):
            superpixels.segment(frames[0], **arguments)
    with pytest.raises(ValueError, match="one shape"):
        superpixels.histograms(np.zeros((2, 2), np.uint8), np.zeros((3, 3), int))
    with pytest.raises(ValueError, match="spread"):
        superpixels.confidences([[1.0]], superpixels.PriorKnowledge(np.eye(1), np.ones(1), np.ones(1)), spread=-1)


def test_drawn_boxes_lie_in_the_surroundings(film):
    frames, boxes = film
    left, top, right, bottom = superpixels.surroundings(boxes[0], frames[0].shape)
    drawn = superpixels.sample_boxes(boxes[0], frames[0].shape, 400, np.random.default_rng(0))
    assert (drawn[:, :2] >= [left, top]).all()
    assert (drawn[:, :2] + drawn[:, 2:] <= [right, bottom]).all()
    np.testing.assert_array_equal(drawn[:, 2:], np.tile(boxes[0, 2:], (400, 1)))
    free = [right - left, bottom - top] - boxes[0, 2:]
    np.testing.assert_allclose(np.ptp(drawn[:, :2], axis=0), free, rtol=0.05)


def test_a_box_sums_up_the_pixels_it_shows():
    rng = np.random.default_rng(0)
    painted = rng.uniform(-1, 1, (30, 40))
    boxes = np.column_stack([rng.uniform(-10, 35, 50), rng.uniform(-10, 25, 50), rng.uniform(2, 20, (50, 2))])
    wide = np.pad(painted, 40, constant_values=-1.0)  # beyond the frame all is background
    sums, centers = superpixels.box_confidences(painted, boxes), superpixels.box_confidences(painted, boxes, True)
    for n, (left, top, right, bottom) in enumerate(color.pixel_edges(boxes) + 40):
        assert sums[n] == pytest.approx(wide[top:bottom, left:right].sum())
        x, y = np.floor(boxes[n, :2] + boxes[n, 2:] / 2).astype(int) + 40
        assert centers[n] == wide[y, x]


def test_the_best_of_the_drawn_boxes_is_near_the_target(film):
    frames, boxes = film
    prior = superpixels.learn(frames[:5], boxes[:5])
    painted = superpixels.confidence_map(frames[6], boxes[5], prior)
    drawn = superpixels.sample_boxes(boxes[5], painted.shape, 300, np.random.default_rng(0))
    best = drawn[superpixels.box_confidences(painted, drawn).argmax()]
    assert metrics.overlap(best[None], boxes[6:7])[0] > 0.7
