"""Looks, and what is seen of them, against plain loops over pixels."""

import cv2
import numpy as np
import pytest

from pftrack import color, texture
from pftrack.multi import looks
from pftrack.multi.looks import Looks, Picture

TARGET = [30.1, 12.6, 21.0, 40.0]
BOXES = [TARGET, [33, 14, 20, 42], [2, 5, 20, 40], [60, 20, 22, 38], [-9, -12, 21, 40], [70, 40, 24, 40]]


@pytest.fixture(scope="module")
def frame():
    """Blotches with grain, so that neighbouring boxes are alike but not the same."""
    rng = np.random.default_rng(0)
    blotches = cv2.resize(rng.integers(0, 256, (9, 12, 3), dtype=np.uint8), (90, 70)).astype(int)
    return (blotches + rng.integers(-20, 20, (70, 90, 3))).clip(0, 255).astype(np.uint8)


def edges_of(x, y, w, h):
    return [int(np.floor(edge + 0.5)) for edge in (x, y, x + w, y + h)]


def covered(shape, *boxes):
    """Mask of what people hide: 0.76 of the width and 0.95 of the height of a box, from the feet."""
    mask = np.zeros(shape[:2], dtype=bool)
    for x, y, w, h in boxes:
        left, top, right, bottom = edges_of(x + 0.12 * w, y + 0.05 * h, 0.76 * w, 0.95 * h)
        mask[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)] = True
    return mask


def by_loop(frame, hidden, edges):
    """Counts of both features, and the share that is seen, pixel by pixel."""
    colors, patterns = color.hsv_bins(frame), texture.pattern_bins(frame)
    left, top, right, bottom = edges
    counts, n_seen = np.zeros((2, 256)), 0
    for y in range(max(top, 0), min(bottom, frame.shape[0])):
        for x in range(max(left, 0), min(right, frame.shape[1])):
            if not hidden[y, x]:
                n_seen += 1
                counts[0, min(colors[y, x], 254)] += 1
                counts[1, patterns[y, x]] += 1
    return counts / max(n_seen, 1), n_seen / ((right - left) * (bottom - top))


def measured(frame, hidden, box, n_bands):
    """Histograms of the middle of each band, and of as much beside it, half on either side."""
    x, y, w, h = box
    inside, beside = [], []
    for n in range(n_bands):
        top, high = y + h * n / n_bands, h / n_bands
        inside.append(by_loop(frame, hidden, edges_of(x + 0.2 * w, top, 0.6 * w, high))[0])
        sides = [edges_of(left, top, 0.3 * w, high) for left in (x - 0.1 * w, x + 0.8 * w)]
        beside.append(np.mean([by_loop(frame, hidden, side)[0] for side in sides], axis=0))
    return np.array(inside), np.array(beside)


def expected(frame, hidden, inside, beside, boxes):
    """The formula of the module, bin by bin."""
    n_bands, found, shares = len(inside), [], []
    for x, y, w, h in boxes:
        total, weight = np.zeros(2), 0.0
        for n in range(n_bands):
            band = edges_of(x + 0.2 * w, y + h * n / n_bands, 0.6 * w, h / n_bands)
            histograms, share = by_loop(frame, hidden, band)
            if share < 0.1:
                continue
            weight += share
            for feature in range(2):
                alike = perfect = 0.0
                for p, q, r in zip(histograms[feature], inside[n, feature], beside[n, feature], strict=True):
                    if q > 0:
                        worth = (1 + max((q - r) / (q + r), 0)) / 2
                        alike += worth * np.sqrt(p * q)
                        perfect += worth * q
                total[feature] += share * alike / perfect
        found.append(total / max(weight, 1e-9))
        shares.append(weight / n_bands)
    return np.transpose(found), np.array(shares)


def test_one_band_without_surroundings_is_the_bhattacharyya_coefficient(frame):
    picture = Picture(frame)
    found, seen = Looks(picture, TARGET, n_bands=1, surroundings=False).similarities(picture, BOXES[:4])
    for feature, bins in enumerate((np.minimum(color.hsv_bins(frame), 254), texture.pattern_bins(frame))):
        middles = [edges_of(x + 0.2 * w, y, 0.6 * w, h) for x, y, w, h in BOXES[:4]]
        shares = [np.bincount(bins[t:b, le:r].ravel(), minlength=256) / ((b - t) * (r - le)) for le, t, r, b in middles]
        rho = [sum(np.sqrt(p * q) for p, q in zip(each, shares[0], strict=True)) for each in shares]
        np.testing.assert_allclose(found[feature], rho, atol=1e-6)
        assert np.ptp(rho) > 0.05
    np.testing.assert_array_equal(seen, 1)


@pytest.mark.parametrize("n_bands", [1, 3])
@pytest.mark.parametrize("surroundings", [True, False])
@pytest.mark.parametrize("nearer", [[], [[38, 30, 25, 45], [0, -5, 18, 30]]])
def test_similarities_are_those_of_the_formula(frame, n_bands, surroundings, nearer):
    """With people in front of some boxes, and boxes partly outside the frame."""
    picture, nothing = Picture(frame), covered(frame.shape)
    target = Looks(picture, TARGET, n_bands, surroundings)
    inside, beside = measured(frame, nothing, TARGET, n_bands)
    for box in nearer:
        picture.cover(box)
    found, seen = target.similarities(picture, BOXES)
    hidden = covered(frame.shape, *nearer)
    similarity, shares = expected(frame, hidden, inside, beside if surroundings else 0 * beside, BOXES)
    np.testing.assert_allclose(seen, shares, atol=1e-12)
    np.testing.assert_allclose(found, similarity, atol=1e-5)
    assert (seen < 0.8).sum() >= (3 if nearer else 2)
    assert found.min() >= 0
    assert found.max() <= 1


def test_who_is_half_hidden_from_the_first_is_known_by_the_rest(frame):
    """What is covered is in no histogram of the target either."""
    picture, hidden = Picture(frame), covered(frame.shape, [38, 30, 25, 45])
    picture.cover([38, 30, 25, 45])
    found, seen = Looks(picture, TARGET).similarities(picture, [TARGET])
    np.testing.assert_allclose(found, 1, atol=1e-6)
    assert 0.4 < seen[0] < 0.9
    wholly = Picture(frame)
    inside, beside = measured(frame, hidden, TARGET, 3)
    known, _ = Looks(picture, TARGET).similarities(wholly, BOXES[:4])
    np.testing.assert_allclose(known, expected(frame, covered(frame.shape), inside, beside, BOXES[:4])[0], atol=1e-5)


@pytest.mark.parametrize(
    ("surroundings", "similarity"), [(True, 0.5 * np.sqrt(0.5) / (1 * 0.5 + 0.5 * 0.5)), (False, np.sqrt(0.5))]
)
def test_the_targets_own_colours_count_more(surroundings, similarity):
    """Red and green stripes on a green lawn: of the green, v is 1/2, so that the lawn is less like the target."""
    frame = np.full((60, 80, 3), (0, 200, 0), np.uint8)
    frame[10:50:2, 30:50] = (0, 0, 200)
    picture = Picture(frame)
    target = Looks(picture, [23.5, 10, 33, 40], n_bands=1, surroundings=surroundings)  # its middle is the stripes
    assert target.similarities(picture, [[60, 10, 10, 40]])[0][0] == pytest.approx(similarity, abs=1e-6)


def test_bands_tell_white_over_black_from_black_over_white():
    frame = np.full((60, 100, 3), (0, 160, 0), np.uint8)
    frame[10:30, 10:30] = frame[30:50, 60:80] = 255
    frame[30:50, 10:30] = frame[10:30, 60:80] = 0
    picture = Picture(frame)
    upright, reverse = [10, 10, 20, 40], [60, 10, 20, 40]
    for n_bands, similarity in [(1, 1), (2, 0), (4, 0)]:
        target = Looks(picture, upright, n_bands)
        np.testing.assert_allclose(target.similarities(picture, [upright, reverse])[0][0], [1, similarity], atol=1e-6)


@pytest.mark.parametrize("rate", [0.0, 0.3, 1.0])
def test_looks_follow_the_target_by_so_much(frame, rate):
    later = np.roll(frame[::-1], 7, axis=1).copy()
    target = Looks(Picture(frame), TARGET)
    target.learn(Picture(later), BOXES[1], rate)
    found = target.similarities(Picture(later), BOXES)[0]
    nothing = covered(frame.shape)
    old, new = measured(frame, nothing, TARGET, 3), measured(later, nothing, BOXES[1], 3)
    inside, beside = ((1 - rate) * a + rate * b for a, b in zip(old, new, strict=True))
    np.testing.assert_allclose(found, expected(later, nothing, inside, beside, BOXES)[0], atol=1e-5)
    if rate == 1:
        again = Looks(Picture(later), BOXES[1]).similarities(Picture(later), BOXES)[0]
        np.testing.assert_allclose(found, again, atol=1e-9)


def test_the_brightest_of_the_last_hue_is_seen():
    """Its colour has the number of what is covered, and is not taken for it."""
    frame = np.full((40, 60, 3), 90, np.uint8)
    frame[5:35, 20:40] = (8, 0, 255)
    assert color.hsv_bins(frame)[10, 30] == looks.COVERED[0]
    picture = Picture(frame)
    found, seen = Looks(picture, [20, 5, 20, 30]).similarities(picture, [[20, 5, 20, 30], [0, 5, 20, 30]])
    np.testing.assert_allclose(found[0], [1, 0], atol=1e-6)
    np.testing.assert_array_equal(seen, 1)
    assert picture.histograms(np.array([[20, 5, 40, 35]]))[0, 0].sum() == pytest.approx(1)


def test_of_what_is_not_seen_nothing_is_known(frame):
    picture = Picture(frame)
    target = Looks(picture, TARGET)
    picture.cover([-50, -50, 120, 200])
    found, seen = target.similarities(picture, [[5, 5, 20, 40], [200, 5, 20, 40], [-60, -90, 20, 40]])
    np.testing.assert_array_equal(found, 0)
    np.testing.assert_array_equal(seen, 0)
    assert not picture.histograms(np.array([[5, 5, 20, 40], [200, 5, 220, 40]])).any()
    unseen = Looks(picture, [5, 5, 20, 40])  # nor can anything be learnt
    np.testing.assert_array_equal(unseen.similarities(Picture(frame), [TARGET])[0], 0)


def test_a_sliver_of_a_band_does_not_count(frame):
    picture = Picture(frame)
    target = Looks(picture, TARGET, n_bands=2)
    boxes = [[30, -37, 20, 40], [30, -35, 20, 40], [30, -17, 20, 40]]  # of the lower band 3, 5, and 20 rows of 20
    assert target.similarities(picture, boxes)[1].tolist() == pytest.approx([0.075, 0.125, 0.575])
    assert target.similarities(picture, [[30, -39, 20, 40]])[1] == 0  # one row


def test_shares_seen_are_the_mean_of_a_mask(frame):
    rng = np.random.default_rng(1)
    picture = Picture(frame)
    nearer = [[10, 10, 30, 50], [70, -20, 40, 60], [35.5, 40.5, 21, 80]]
    for box in nearer:
        picture.cover(box)
    wide = np.zeros((300, 300))  # the frame begins at 100, 100
    wide[100:170, 100:190] = ~covered(frame.shape, *nearer)
    corners = rng.integers(-60, 110, (200, 2))
    edges = np.hstack([corners, corners + rng.integers(1, 60, (200, 2))])
    expected = [wide[t + 100 : b + 100, le + 100 : r + 100].mean() for le, t, r, b in edges]
    np.testing.assert_allclose(picture.shares_seen(edges), expected, atol=1e-12)
    assert 0 < np.mean(expected) < 1
    np.testing.assert_array_equal(picture.shares_seen(edges + 500), 0)
    assert picture.shares_seen(np.array([[5, 5, 5, 9]])) == 0


def test_histograms_are_those_of_a_plain_loop(frame):
    picture, hidden = Picture(frame), covered(frame.shape, [38, 30, 25, 45])
    picture.cover([38, 30, 25, 45])
    edges = [[30, 12, 51, 53], [-5, -5, 20, 20], [45, 40, 120, 90]]
    truth = np.stack([by_loop(frame, hidden, each)[0] for each in edges], axis=1)
    np.testing.assert_allclose(picture.histograms(np.array(edges)), truth, atol=1e-12)


def test_a_picture_leaves_its_frame_as_it_was(frame):
    before = frame.copy()
    Picture(frame).cover([0, 0, 90, 70])
    np.testing.assert_array_equal(frame, before)


@pytest.mark.parametrize("n_bands", [1, 2, 3, 5])
def test_bands_divide_the_box(n_bands):
    edges = looks.bands(BOXES, n_bands, middle=1.0).reshape(len(BOXES), n_bands, 4)
    np.testing.assert_array_equal(edges[:, 1:, 1], edges[:, :-1, 3])  # no row is left out or taken twice
    whole = np.concatenate([edges[:, 0, :2], edges[:, -1, 2:]], axis=1)
    np.testing.assert_array_equal(whole, [edges_of(*box) for box in BOXES])
    assert np.ptp(edges[..., 3] - edges[..., 1], axis=1).max() <= 1
