"""Overlap, hits and centre errors against cases worked out by hand and by counting pixels."""

import json

import numpy as np
import pytest

from pftrack import metrics

HIDDEN = [np.nan] * 4


@pytest.mark.parametrize(
    ("box", "truth", "expected"),
    [
        pytest.param([3, 4, 10, 20], [3, 4, 10, 20], 1.0, id="identical"),
        pytest.param([0, 0, 2, 2], [1, 0, 2, 2], 2 / 6, id="shifted by half a width"),
        pytest.param([0, 0, 10, 10], [5, 5, 10, 10], 25 / 175, id="shifted along the diagonal"),
        pytest.param([0, 0, 10, 10], [2, 3, 4, 5], 20 / 100, id="one inside the other"),
        pytest.param([0, 0, 9, 3], [3, -3, 3, 9], 9 / 45, id="a cross"),
        pytest.param([0, 0, 10, 10], [10, 0, 10, 10], 0.0, id="touching at an edge"),
        pytest.param([0, 0, 10, 10], [50, 60, 10, 10], 0.0, id="apart along both axes"),
        pytest.param([0, 0, 10, 10], [0, 60, 10, 10], 0.0, id="apart along one axis"),
        pytest.param([-5, -5, 10, 10], [-5, -5, 10, 5], 0.5, id="over the image border"),
        pytest.param([0.25, 0, 0.5, 1], [0.5, 0, 0.5, 1], 0.25 / 0.75, id="fractions of a pixel"),
        pytest.param([5, 5, 0, 0], [0, 0, 10, 10], 0.0, id="a box without area"),
        pytest.param([5, 5, 0, 0], [5, 5, 0, 0], 0.0, id="neither has area"),
    ],
)
def test_overlap_worked_out_by_hand(box, truth, expected):
    assert metrics.overlap([box], [truth]) == pytest.approx([expected])


def random_boxes(n, seed):
    rng = np.random.default_rng(seed)
    corner, size = rng.integers(0, 20, size=(n, 2)), rng.integers(1, 15, size=(n, 2))
    return np.hstack([corner, size]).astype(float)


def test_overlap_is_that_of_the_pixels_counted_one_by_one():
    boxes, truth = random_boxes(300, seed=1), random_boxes(300, seed=2)

    def pixels(box):
        x, y, w, h = box.astype(int)
        return {(i, j) for i in range(x, x + w) for j in range(y, y + h)}

    counted = [len(pixels(a) & pixels(b)) / len(pixels(a) | pixels(b)) for a, b in zip(boxes, truth, strict=True)]
    np.testing.assert_allclose(metrics.overlap(boxes, truth), counted, rtol=1e-14)
    assert 0 in counted
    assert max(counted) > 0.5


def test_measures_do_not_care_which_box_is_the_truth_nor_where_the_origin_is():
    rng = np.random.default_rng(3)
    boxes, truth = rng.uniform(1, 20, size=(2, 200, 4))
    for measure in (metrics.overlap, metrics.center_error):
        values = measure(boxes, truth)
        np.testing.assert_allclose(measure(truth, boxes), values)
        np.testing.assert_allclose(measure(boxes + [7, -9, 0, 0], truth + [7, -9, 0, 0]), values, atol=1e-12)


def test_overlap_is_nan_where_the_truth_is_hidden_and_zero_where_only_the_box_is_missing():
    some = [0, 0, 4, 4]
    rates = metrics.overlap([some, HIDDEN, HIDDEN, some], [HIDDEN, some, HIDDEN, some])
    np.testing.assert_array_equal(rates, [np.nan, 0.0, np.nan, 1.0])


def test_measures_read_lists_and_leave_arrays_as_they_were():
    boxes, truth = random_boxes(5, seed=4), random_boxes(5, seed=5)
    before = boxes.copy(), truth.copy()
    for measure in (metrics.overlap, metrics.center_error):
        np.testing.assert_array_equal(measure(boxes, truth), measure(boxes.tolist(), truth.tolist()))
    np.testing.assert_array_equal(boxes, before[0])
    np.testing.assert_array_equal(truth, before[1])


@pytest.mark.parametrize(
    ("box", "truth", "expected"),
    [
        pytest.param([0, 0, 2, 2], [3, 4, 2, 2], 5.0, id="3-4-5 triangle"),
        pytest.param([0, 0, 10, 20], [4, 8, 2, 4], 0.0, id="same centre, other size"),
        pytest.param([0, 0, 10, 10], [0, 0, 16, 26], np.hypot(3, 8), id="same corner, other size"),
        pytest.param([-8, 0, 4, 4], [8, 0, 4, 4], 16.0, id="over the image border"),
        pytest.param(HIDDEN, [0, 0, 2, 2], np.nan, id="no box"),
        pytest.param([0, 0, 2, 2], HIDDEN, np.nan, id="no truth"),
    ],
)
def test_centre_error_worked_out_by_hand(box, truth, expected):
    np.testing.assert_allclose(metrics.center_error([box], [truth]), [expected])


def test_single_target_worked_out_by_hand():
    truth = [0, 0, 10, 10]
    boxes_and_truth = [
        (truth, truth),  # overlap 1, centre error 0
        ([2, 2, 10, 10], HIDDEN),  # counts for the "all" measures alone
        (HIDDEN, truth),  # overlap 0, no centre error
        ([5, 0, 10, 10], truth),  # overlap 50/150, a hit; centre error 5
        ([6, 8, 10, 10], truth),  # overlap 8/192, a miss; centre error 10
        (HIDDEN, HIDDEN),
    ]
    score = metrics.single_target(*map(list, zip(*boxes_and_truth, strict=True)))
    assert (score.n_frames, score.n_hidden, score.n_missing) == (6, 2, 1)
    overlaps = 1 + 50 / 150 + 8 / 192
    assert score.overlap_all == pytest.approx(overlaps / 6)
    assert score.overlap_visible == pytest.approx(overlaps / 4)
    assert score.hit_ratio_all == pytest.approx(2 / 6)
    assert score.hit_ratio_visible == pytest.approx(2 / 4)
    assert score.center_error_mean == pytest.approx((0 + 5 + 10) / 3)
    assert score.center_error_rms == pytest.approx(np.sqrt((0 + 25 + 100) / 3))


@pytest.mark.parametrize(
    ("shift", "hits"),
    [pytest.param(30, 1, id="exactly 1/3"), pytest.param(31, 0, id="less"), pytest.param(29, 1, id="more")],
)
def test_an_overlap_of_exactly_one_third_is_a_hit(shift, hits):
    """Shifted by half of its width 60, a box shares 30 of 90 columns."""
    score = metrics.single_target([[shift, 0, 60, 10]], [[0, 0, 60, 10]])
    assert score.hit_ratio_all == score.hit_ratio_visible == hits


@pytest.mark.parametrize("n_hidden", [0, 1, 5])
def test_hidden_frames_cap_a_perfect_tracker_below_one(n_hidden):
    boxes = random_boxes(10, seed=6)
    truth = boxes.copy()
    truth[:n_hidden] = np.nan
    score = metrics.single_target(boxes, truth)
    assert score.overlap_visible == pytest.approx(1)
    assert score.hit_ratio_visible == 1
    assert score.overlap_all == pytest.approx(1 - n_hidden / 10)
    assert score.hit_ratio_all == pytest.approx(1 - n_hidden / 10)
    assert (score.n_hidden, score.n_missing) == (n_hidden, 0)


def test_a_tracker_that_never_reports_scores_zero_and_has_no_centre_error():
    score = metrics.single_target([HIDDEN] * 3, random_boxes(3, seed=7))
    assert (score.n_frames, score.n_missing) == (3, 3)
    assert score.overlap_all == score.overlap_visible == score.hit_ratio_all == score.hit_ratio_visible == 0
    assert np.isnan(score.center_error_mean)
    assert np.isnan(score.center_error_rms)


def test_a_score_turns_into_json():
    score = metrics.single_target(random_boxes(10, seed=8), random_boxes(10, seed=9))
    assert metrics.SingleTargetScore(**json.loads(json.dumps(score.as_dict()))) == score


@pytest.mark.parametrize("measure", [metrics.overlap, metrics.center_error, metrics.single_target])
@pytest.mark.parametrize(
    ("boxes", "truth"),
    [
        pytest.param(np.zeros((3, 4)), np.zeros((2, 4)), id="different lengths"),
        pytest.param(np.zeros((3, 4)), np.zeros((1, 4)), id="that would broadcast"),
        pytest.param(np.zeros((3, 5)), np.zeros((3, 5)), id="five columns"),
        pytest.param(np.zeros(4), np.zeros(4), id="one box alone"),
    ],
)
def test_shapes_that_do_not_fit_are_rejected(measure, boxes, truth):
    with pytest.raises(ValueError, match=r"must both have shape \(T, 4\)"):
        measure(boxes, truth)


def test_a_truth_that_is_always_hidden_cannot_be_scored():
    with pytest.raises(ValueError, match="hidden in every frame"):
        metrics.single_target([[0, 0, 4, 4]] * 2, [HIDDEN] * 2)


def test_every_pair_overlaps_as_frame_by_frame():
    rng = np.random.default_rng(0)
    a, b = (np.column_stack([rng.uniform(0, 30, (n, 2)), rng.uniform(0, 20, (n, 2))]) for n in (6, 9))
    rates = metrics.pairwise_overlap(a, b)
    for i, j in np.ndindex(6, 9):
        assert rates[i, j] == pytest.approx(metrics.overlap(a[i : i + 1], b[j : j + 1])[0])
    assert metrics.pairwise_overlap(np.empty((0, 4)), b).shape == (0, 9)
    assert metrics.pairwise_overlap([[0, 0, 0, 0]], [[0, 0, 0, 0]]) == 0
    with pytest.raises(ValueError, match=r"\(N, 4\) and \(M, 4\)"):
        metrics.pairwise_overlap([0, 0, 1, 1], b)
