"""Colour histograms, their distances and back-projection against what OpenCV and SciPy compute."""

import itertools

import cv2
import numpy as np
import pytest
from scipy import stats

from pftrack import color, datasets


def opencv_histogram(frame, mask=None):
    """The 8x8x4 histogram of OpenCV, hue slowest."""
    hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
    return cv2.calcHist([hsv], [0, 1, 2], mask, [8, 8, 4], [0, 180, 0, 256, 0, 256]).ravel()


def random_frame(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, size=(height, width, 3), dtype=np.uint8)


def every_hue():
    """A picture of the whole colour circle, fully saturated and bright, 180 pixels wide."""
    hue = np.arange(180, dtype=np.uint8)
    full = np.full(180, 255, dtype=np.uint8)
    frame = cv2.cvtColor(np.stack([hue, full, full], axis=-1)[None], cv2.COLOR_HSV2BGR)
    assert set(cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)[0, :, 0]) == set(range(180))
    return frame


@pytest.fixture(params=["synthetic-walk", "bobot-I"], scope="module")
def frames(request, footage):
    """Some frames of a synthetic scene, and of real footage where that is at hand."""
    id = request.param
    sequence = datasets.load(id) if id.startswith("synthetic") else footage(id)
    return [sequence.frames[t] for t in (0, len(sequence) // 2, len(sequence) - 1)]


# ---------------------------------------------------------------------------------------------------------------------
# Bins
# ---------------------------------------------------------------------------------------------------------------------


def test_every_colour_there_is_falls_into_the_bin_that_opencv_gives_it():
    """All 256³ colours. OpenCV tells the bin of a pixel when it back-projects a histogram of bin numbers."""
    assert color.HSV_BINS == (8, 8, 4)
    numbers = cv2.Mat(np.arange(256, dtype=np.float32).reshape(8, 8, 4))  # three axes, not two and four channels
    green, red = (np.tile(levels, (16, 1)) for levels in np.mgrid[:256, :256].astype(np.uint8))
    for first_blue in range(0, 256, 16):
        blue = np.repeat(np.arange(first_blue, first_blue + 16, dtype=np.uint8), 256)[:, None]
        frame = np.dstack([np.broadcast_to(blue, green.shape), green, red])
        hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
        expected = cv2.calcBackProject([hsv], [0, 1, 2], numbers, [0, 180, 0, 256, 0, 256], 1)
        np.testing.assert_array_equal(color.hsv_bins(frame), expected)


def test_bins_counted_are_the_histogram_of_opencv(frames):
    for frame in [*frames, random_frame(120, 160), every_hue()]:
        bins = color.hsv_bins(frame)
        assert bins.shape == frame.shape[:2]
        assert bins.dtype == np.uint8
        np.testing.assert_array_equal(np.bincount(bins.ravel(), minlength=256), opencv_histogram(frame))


def test_the_colour_circle_has_eight_levels_of_hue():
    """Bins are 22.5 hues wide: a level holds 22 or 23 whole hues."""
    levels = color.hsv_bins(every_hue())[0] // 32
    np.testing.assert_array_equal(np.unique(levels), np.arange(8))
    assert set(np.bincount(levels)) == {22, 23}
    assert np.all(np.diff(levels.astype(int)) >= 0)


def test_the_bin_of_a_pixel_does_not_depend_on_what_else_is_in_the_picture():
    """OpenCV converts several pixels at a time and the rest one by one."""
    frame = random_frame(4, 80, seed=1)
    bins = color.hsv_bins(frame)
    for width in range(1, 41):
        np.testing.assert_array_equal(color.hsv_bins(frame[:, 3 : 3 + width]), bins[:, 3 : 3 + width])


# ---------------------------------------------------------------------------------------------------------------------
# Boxes. A pixel belongs to a box if its centre lies inside; the tests ask every pixel.
# ---------------------------------------------------------------------------------------------------------------------


def random_boxes(n, width, height, seed):
    """Boxes in the image, across its border and beyond; never with an edge through the centre of a pixel."""
    rng = np.random.default_rng(seed)
    corner = rng.uniform([-0.6 * width, -0.6 * height], [1.2 * width, 1.2 * height], size=(n, 2))
    return np.hstack([corner, rng.uniform(1, [0.6 * width, 0.6 * height], size=(n, 2))])


def centres_within(start, length, first, last):
    """Which of the whole pixels from `first` to `last` have their centre between `start` and `start + length`."""
    centres = np.arange(first, last) + 0.5
    return (start < centres) & (centres < start + length)


def test_edges_are_those_of_the_pixels_whose_centres_lie_inside():
    for box, (left, top, right, bottom) in zip(
        boxes := random_boxes(300, 40, 30, seed=2), color.pixel_edges(boxes), strict=True
    ):
        columns = np.flatnonzero(centres_within(box[0], box[2], -100, 200)) - 100
        rows = np.flatnonzero(centres_within(box[1], box[3], -100, 200)) - 100
        np.testing.assert_array_equal(np.arange(left, right), columns)
        np.testing.assert_array_equal(np.arange(top, bottom), rows)


def test_edges_of_boxes_on_whole_pixels_are_exact_also_outside_the_image():
    edges = color.pixel_edges([[-7, 3, 10, 20], [0, 0, 1, 1], [500, -40, 2, 3]])
    np.testing.assert_array_equal(edges, [[-7, 3, 3, 23], [0, 0, 1, 1], [500, -40, 502, -37]])
    assert np.issubdtype(edges.dtype, np.integer)


@pytest.mark.parametrize("outside", ["mismatch", "ignore"])
def test_histograms_of_boxes_are_those_of_their_pixels(frames, outside):
    frame = frames[0]
    height, width = frame.shape[:2]
    boxes = random_boxes(60, width, height, seed=3)
    kinds = set()
    for box, histogram in zip(boxes, color.histograms(frame, boxes, outside), strict=True):
        across, down = centres_within(box[0], box[2], 0, width), centres_within(box[1], box[3], 0, height)
        counts = opencv_histogram(frame, np.outer(down, across).astype(np.uint8))
        visible = across.sum() * down.sum()
        area = (
            centres_within(box[0], box[2], -2 * width, 3 * width).sum()
            * centres_within(box[1], box[3], -2 * height, 3 * height).sum()
        )
        kinds.add("hidden" if visible == 0 else "whole" if visible == area else "cut")
        expected = counts / (area if outside == "mismatch" else max(visible, 1))
        np.testing.assert_allclose(histogram, expected, rtol=1e-12)
    assert kinds == {"hidden", "whole", "cut"}


def test_a_histogram_sums_to_one_or_to_the_visible_share():
    frame = random_frame(20, 30)
    boxes = [[5, 5, 10, 10], [-5, 0, 10, 20], [25, 15, 10, 10], [0, 0, 60, 40], [-10, -10, 5, 5]]
    np.testing.assert_allclose(color.histograms(frame, boxes, "mismatch").sum(axis=1), [1, 0.5, 0.25, 0.25, 0])
    np.testing.assert_allclose(color.histograms(frame, boxes, "ignore").sum(axis=1), [1, 1, 1, 1, 0])


def test_histograms_of_many_boxes_are_those_of_each_alone():
    frame = random_frame(40, 50, seed=4)
    boxes = random_boxes(30, 50, 40, seed=5)
    together = color.histograms(frame, boxes)
    np.testing.assert_array_equal(together, np.vstack([color.histograms(frame, [box]) for box in boxes]))
    assert color.histograms(frame, np.empty((0, 4))).shape == (0, 256)


def test_a_box_without_area_has_an_empty_histogram():
    np.testing.assert_array_equal(color.histograms(random_frame(8, 8), [[3, 3, 0, 0], [3, 3, 0.2, 5]]), 0)


@pytest.mark.parametrize("outside", ["wrap", "", None])
def test_an_unknown_word_for_what_is_outside_is_rejected(outside):
    frame, boxes = random_frame(8, 8), [[0, 0, 4, 4]]
    with pytest.raises(ValueError, match='must be "mismatch" or "ignore"'):
        color.histograms(frame, boxes, outside)
    with pytest.raises(ValueError, match='must be "mismatch" or "ignore"'):
        color.distances(frame, boxes, np.full(256, 1 / 256), outside)
    with pytest.raises(ValueError, match='must be "mismatch" or "ignore"'):
        color.log_likelihood(frame, boxes, np.full(256, 1 / 256), 0.1, outside)


# ---------------------------------------------------------------------------------------------------------------------
# Distances
# ---------------------------------------------------------------------------------------------------------------------


def random_histograms(n, seed):
    """Counts from nearly even to very uneven, many of them zero."""
    rng = np.random.default_rng(seed)
    return np.array([rng.multinomial(1000, rng.dirichlet(np.full(256, rng.choice([0.02, 0.2, 2])))) for _ in range(n)])


def opencv_distance(p, q):
    return cv2.compareHist(np.float32(p), np.float32(q), cv2.HISTCMP_BHATTACHARYYA)


def test_hellinger_is_the_distance_that_opencv_names_after_bhattacharyya(frames):
    rng = np.random.default_rng(6)
    real = []
    for frame in frames:
        for _ in range(10):
            x, y = rng.integers(0, [frame.shape[1] - 20, frame.shape[0] - 20])
            real.append(opencv_histogram(np.ascontiguousarray(frame[y : y + 20, x : x + 20])))
    for histograms in (random_histograms(30, seed=7), real):
        for p, q in itertools.pairwise(histograms):
            assert color.hellinger(p, q) == pytest.approx(opencv_distance(p, q), abs=1e-6)


def test_hellinger_is_the_euclidean_distance_of_square_roots_over_root_two():
    """Its other definition. Rounding of the sum near 1 counts by its square root, hence the tolerance."""
    shares = random_histograms(40, seed=8) / 1000
    expected = np.linalg.norm(np.sqrt(shares) - np.sqrt(shares[0]), axis=1) / np.sqrt(2)
    np.testing.assert_allclose(color.hellinger(shares, shares[0]), expected, atol=1e-7)
    np.testing.assert_allclose(color.bhattacharyya(shares, shares[0]), 1 - expected**2, rtol=1e-12)


@pytest.mark.parametrize("factor", [1, 7, 1e-6, 1e6])
def test_hellinger_of_a_histogram_and_a_multiple_of_it_is_zero(factor):
    for p in random_histograms(30, seed=9):
        assert color.hellinger(p, factor * p) == pytest.approx(0, abs=1e-7)


def test_hellinger_of_histograms_without_a_common_bin_is_one():
    p = np.arange(10) * (np.arange(10) < 5)
    assert color.hellinger(p, p[::-1]) == 1
    assert color.bhattacharyya(p / p.sum(), p[::-1] / p.sum()) == 0


def test_hellinger_is_symmetric_free_of_scale_and_between_zero_and_one():
    histograms = random_histograms(30, seed=10)
    for p, q in itertools.pairwise(histograms):
        distance = color.hellinger(p, q)
        assert 0 < distance <= 1
        assert color.hellinger(q, p) == pytest.approx(distance, rel=1e-12)
        assert color.hellinger(3 * p, 0.01 * q) == pytest.approx(distance, rel=1e-9)


def test_hellinger_keeps_the_triangle_inequality():
    p, q, r = random_histograms(90, seed=11).reshape(3, 30, 256)
    for a, b, c in zip(p, q, r, strict=True):
        assert color.hellinger(a, c) <= color.hellinger(a, b) + color.hellinger(b, c) + 1e-12


@pytest.mark.parametrize("n", [3, 4], ids=["as many histograms as not bins", "as many histograms as bins"])
def test_last_axes_of_two_stacks_of_histograms_are_compared_pair_by_pair(n):
    p, q = np.random.default_rng(12).dirichlet(np.ones(4), size=(2, n))
    expected = [color.hellinger(a, b) for a, b in zip(p, q, strict=True)]
    np.testing.assert_allclose(color.hellinger(p, q), expected)


def boxes_inside(frame, n, seed):
    rng = np.random.default_rng(seed)
    corner = rng.integers(0, [frame.shape[1] - 40, frame.shape[0] - 40], size=(n, 2))
    return np.hstack([corner, rng.integers(5, 40, size=(n, 2))])


def test_distances_of_boxes_are_those_of_opencv(frames):
    for frame in frames:
        target, *others = boxes_inside(frame, 15, seed=13)
        crops = [np.ascontiguousarray(frame[y : y + h, x : x + w]) for x, y, w, h in others]
        x, y, w, h = target
        template = opencv_histogram(np.ascontiguousarray(frame[y : y + h, x : x + w]))
        result = color.distances(frame, others, template / template.sum())
        expected = [opencv_distance(opencv_histogram(crop), template) for crop in crops]
        np.testing.assert_allclose(result, expected, atol=1e-6)


def test_the_target_is_at_distance_zero_from_itself(frames):
    for frame in frames:
        boxes = boxes_inside(frame, 10, seed=14)
        for box, target in zip(boxes, color.histograms(frame, boxes), strict=True):
            assert color.distances(frame, [box], target) == pytest.approx([0], abs=1e-7)


@pytest.mark.parametrize("outside", ["mismatch", "ignore"])
def test_a_rectangle_of_which_nothing_is_visible_has_distance_one(outside):
    frame = random_frame(30, 40)
    boxes = [[-20, 5, 10, 10], [5, -20, 10, 10], [40, 5, 10, 10], [5, 30, 10, 10], [1e4, 1e4, 9, 9], [5, 5, 0, 0]]
    np.testing.assert_array_equal(color.distances(frame, boxes, np.full(256, 1 / 256), outside), 1.0)


def test_what_is_outside_counts_against_the_match_or_not_at_all():
    """A box of the target's colours alone, half of it visible: the coefficient is sqrt(1/2) or 1."""
    frame = np.full((20, 20, 3), (0, 0, 255), dtype=np.uint8)
    target = color.histograms(frame, [[0, 0, 10, 10]])[0]
    half_out = [[-5, 0, 10, 10]]
    assert color.distances(frame, half_out, target, "mismatch") == pytest.approx([np.sqrt(1 - np.sqrt(0.5))])
    assert color.distances(frame, half_out, target, "ignore") == pytest.approx([0], abs=1e-7)


@pytest.mark.parametrize("outside", ["mismatch", "ignore"])
@pytest.mark.parametrize("sigma", [0.05, 0.2, 3.0])
def test_log_likelihood_is_the_gaussian_density_of_the_distance(sigma, outside):
    frame = random_frame(40, 50, seed=15)
    frame[:, :25] //= 2
    boxes = random_boxes(50, 50, 40, seed=16)
    target = color.histograms(frame, [[10, 10, 20, 20]])[0]
    expected = stats.norm(scale=sigma).logpdf(color.distances(frame, boxes, target, outside))
    np.testing.assert_allclose(color.log_likelihood(frame, boxes, target, sigma, outside), expected)
    assert np.ptp(expected) > 0


@pytest.mark.parametrize("sigma", [0, -0.1, np.nan])
def test_a_sigma_that_is_not_positive_is_rejected(sigma):
    with pytest.raises(ValueError, match="sigma must be positive"):
        color.log_likelihood(random_frame(8, 8), [[0, 0, 4, 4]], np.full(256, 1 / 256), sigma)


# ---------------------------------------------------------------------------------------------------------------------
# Back-projection
# ---------------------------------------------------------------------------------------------------------------------


def camshift_sample(frame, x, y, w, h):
    """What samples/python/camshift.py of OpenCV does before it shifts: histogram of the selection, back-projection."""
    hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
    mask = cv2.inRange(hsv, np.array((0.0, 60.0, 32.0)), np.array((180.0, 255.0, 255.0)))
    hsv_roi = hsv[y : y + h, x : x + w]
    mask_roi = mask[y : y + h, x : x + w]
    histogram = cv2.calcHist([hsv_roi], [0], mask_roi, [16], [0, 180])
    cv2.normalize(histogram, histogram, 0, 255, cv2.NORM_MINMAX)
    histogram = histogram.reshape(-1)
    probability = cv2.calcBackProject([hsv], [0], histogram, [0, 180], 1)
    probability &= mask
    return histogram, probability


def test_masked_histogram_and_back_projection_are_those_of_opencvs_camshift_sample(frames):
    found = 0
    for frame in [*frames, random_frame(240, 320)]:
        for box in boxes_inside(frame, 6, seed=17):
            expected_histogram, expected_probability = camshift_sample(frame, *box.tolist())
            histogram = color.masked_histogram(frame, box)
            assert histogram.shape == (16, 1)
            assert histogram.dtype == np.float32
            np.testing.assert_array_equal(histogram[:, 0], expected_histogram)
            probability = color.back_projection(frame, histogram)
            np.testing.assert_array_equal(probability, expected_probability)
            found += probability.any()
    assert found > 6  # boxes, of which some hold colours that the mask admits


def test_masked_histogram_counts_the_admitted_hues_of_the_visible_pixels():
    frame = random_frame(30, 40, seed=18)
    histogram = color.masked_histogram(frame, (-10, 20, 40, 50), saturation=(50, 200), value=(80, 220), n_hues=9)
    hue, saturation, value = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)[20:, :30].reshape(-1, 3).T.astype(int)
    admitted = (saturation >= 50) & (saturation <= 200) & (value >= 80) & (value <= 220)
    counts = np.bincount(hue[admitted] // 20, minlength=9)
    stretched = 255 * (counts - counts.min()) / np.ptp(counts)
    np.testing.assert_allclose(histogram[:, 0], stretched, rtol=1e-5, atol=1e-4)
    assert histogram.max() == pytest.approx(255)


@pytest.mark.parametrize("channel", ["saturation", "value"])
def test_the_mask_admits_both_its_ends_and_nothing_beyond(channel):
    """Greys have saturation 0 and reds of one value differ in saturation: one level a column."""
    levels = np.arange(256, dtype=np.uint8)
    full = np.full(256, 255, dtype=np.uint8)
    hsv = np.stack([0 * full, *((levels, full) if channel == "saturation" else (full, levels))], axis=-1)[None]
    frame = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)
    level = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)[0, :, 1 if channel == "saturation" else 2]
    limits = {"saturation": (0, 255), "value": (0, 255)} | {channel: (100, 150)}
    ones = np.full((16, 1), 255, dtype=np.float32)
    admitted = color.back_projection(frame, ones, **limits)[0] == 255
    np.testing.assert_array_equal(admitted, (level >= 100) & (level <= 150))
    assert {100, 150} <= set(level[admitted])


def test_a_box_without_admitted_pixels_has_an_empty_histogram_and_back_projection():
    grey = np.full((20, 20, 3), 128, dtype=np.uint8)
    histogram = color.masked_histogram(grey, (2, 2, 10, 10))
    assert histogram.shape == (16, 1)
    np.testing.assert_array_equal(histogram, 0)
    np.testing.assert_array_equal(color.back_projection(random_frame(20, 20), histogram), 0)


@pytest.mark.parametrize("box", [(100, 100, 5, 5), (-9, 3, 5, 5), (3, 90, 5, 5), (3, 3, 0, 0)])
def test_a_box_of_which_nothing_is_visible_has_an_empty_histogram(box):
    np.testing.assert_array_equal(color.masked_histogram(random_frame(20, 20), box), np.zeros((16, 1)))
