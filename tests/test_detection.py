"""Finding pedestrians: against plain loops, OpenCV's own answer, closed forms and real footage."""

import cv2
import numpy as np
import pytest

from pftrack import detection, metrics
from pftrack.detection import MotionMask, PedestrianDetector, SizePrior, hog_windows, merge, motion_regions, trim


@pytest.fixture(scope="module")
def square():
    """A film of a bright square that walks over noise."""
    rng = np.random.default_rng(0)
    ground = rng.integers(90, 110, (120, 200, 3), dtype=np.uint8)
    frames = []
    for t in range(40):
        frame = np.clip(ground + rng.integers(-3, 4, ground.shape), 0, 255).astype(np.uint8)
        frame[40:90, 5 + 4 * t : 30 + 4 * t] = (30, 30, 220)
        frames.append(frame)
    return frames


# ---------------------------------------------------------------------------------------------------------------------
# What moves
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["knn", "mog2"])
def test_a_background_is_learnt(square, method):
    motion = MotionMask(method)
    masks = [motion(frame) for frame in square]
    assert masks[0].all()  # nothing is known yet
    body = np.zeros(masks[-1].shape, bool)
    body[40:90, 5 + 4 * 39 : 30 + 4 * 39] = True
    assert masks[-1][body].mean() > 0.9
    assert masks[-1][~body].mean() < 0.1


def test_a_film_has_one_background_whatever_was_drawn_before(square):
    """OpenCV's k nearest neighbours use its global generator."""
    one, other = MotionMask("knn"), MotionMask("knn")
    for frame in square:
        mask = one(frame)
        cv2.randu(np.zeros((3, 3), np.uint8), 0, 255)
        np.testing.assert_array_equal(other(frame), mask)


def test_the_difference_shows_what_was_uncovered_and_what_covers(square):
    motion = MotionMask("difference")
    masks = [motion(frame) for frame in square]
    assert masks[0].all()
    where = np.flatnonzero(masks[20].any(axis=0))
    left = 5 + 4 * 20
    assert set(where) <= {*range(left - 4, left), *range(left + 21, left + 25)}
    assert not masks[20][:, left + 4 : left + 20].any()  # inside, nothing changes
    still = MotionMask("difference")
    assert [bool(still(square[0]).any()) for _ in range(3)] == [True, False, False]


def test_without_a_background_everything_moves(square):
    motion = MotionMask("none")
    assert all(motion(frame).all() for frame in square[:3])
    with pytest.raises(ValueError, match="unknown method 'optical flow'; choose one of knn"):
        MotionMask("optical flow")


@pytest.mark.parametrize("seed", range(5))
def test_regions_hold_all_parts_that_are_large_enough(seed):
    rng = np.random.default_rng(seed)
    mask = np.zeros((300, 400), bool)
    for x, y in zip(rng.integers(0, 380, 6), rng.integers(0, 260, 6), strict=True):
        mask[y : y + rng.integers(15, 60), x : x + rng.integers(15, 40)] = True
    mask[5, 5] = True  # a speck
    regions = motion_regions(mask, min_pixels=200)
    covered = np.zeros_like(mask)
    for left, top, right, bottom in regions:
        assert 0 <= left < right <= 400
        assert 0 <= top < bottom <= 300
        covered[top:bottom, left:right] = True
    mask[5, 5] = covered[5, 5]
    assert (covered | ~mask).all()
    for n, a in enumerate(regions):
        for b in regions[:n]:  # two that remain apart would have cost more pixels together
            low, high = np.minimum(a, b)[:2], np.maximum(a, b)[2:]
            touch = (np.maximum(a, b)[:2] < np.minimum(a, b)[2:]).all()
            together, apart = np.prod(high - low), sum(np.prod(each[2:] - each[:2]) for each in (a, b))
            assert not touch or together > apart


def test_where_nothing_moves_there_is_no_region():
    assert motion_regions(np.zeros((100, 100), bool)).shape == (0, 4)
    np.testing.assert_array_equal(motion_regions(np.ones((100, 120), bool)), [[0, 0, 120, 100]])


# ---------------------------------------------------------------------------------------------------------------------
# What looks like a person
# ---------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def corridor(footage):
    sequence = footage("bobot-J")
    return sequence.frames[0], sequence.tracks[sequence.tracks[:, 0] == 0, 2:6]


def test_windows_on_the_whole_frame_are_opencvs(corridor):
    frame, _ = corridor
    hog = cv2.HOGDescriptor()
    hog.setSVMDetector(cv2.HOGDescriptor_getDefaultPeopleDetector())
    big = cv2.resize(frame, None, fx=2, fy=2)
    truth, scores = hog.detectMultiScale(
        big, winStride=(8, 8), padding=(16, 16), scale=1.05, hitThreshold=0, groupThreshold=0
    )
    found = hog_windows(frame, [[0, 0, 320, 240]])
    theirs = np.column_stack([truth / 2, scores])
    np.testing.assert_allclose(found, theirs[np.lexsort(theirs.T)])
    assert (found[:, 4] >= 0).all()


def test_a_window_in_a_region_is_where_it_is_in_the_frame(corridor):
    frame, boxes = corridor
    region = [[180, 10, 300, 235]]
    found = hog_windows(frame, region)
    assert metrics.pairwise_overlap(trim(found[:, :4]), boxes[1:]).max() > 0.7
    part = hog_windows(frame[10:235, 180:300], [[0, 0, 120, 225]])
    np.testing.assert_allclose(found, part + [180, 10, 0, 0, 0])


def test_a_region_smaller_than_a_window_is_not_searched(corridor):
    assert hog_windows(corridor[0], [[10, 10, 20, 30]]).shape == (0, 5)
    assert hog_windows(corridor[0], np.empty((0, 4))).shape == (0, 5)
    with pytest.raises(ValueError, match="scale must be positive"):
        hog_windows(corridor[0], [[0, 0, 320, 240]], scale=0)


def plain_suppression(boxes, scores, overlap):
    """Non-maximum suppression as it is told."""
    kept = []
    for n in np.argsort(-scores):
        if all(metrics.pairwise_overlap(boxes[n : n + 1], boxes[k : k + 1])[0, 0] < overlap for k in kept):
            kept.append(n)
    return kept


@pytest.mark.parametrize("seed", range(5))
def test_merging_without_weights_is_plain_suppression(seed):
    rng = np.random.default_rng(seed)
    boxes = np.column_stack([rng.uniform(0, 60, (40, 2)), rng.uniform(20, 30, 40), rng.uniform(40, 60, 40)])
    scores = rng.random(40)
    merged, best, members = merge(boxes, scores, 0.5, weighted=False)
    kept = plain_suppression(boxes, scores, 0.5)
    np.testing.assert_array_equal(merged, boxes[kept])
    np.testing.assert_array_equal(best, scores[kept])
    np.testing.assert_array_equal(np.sort(np.concatenate(members)), np.arange(40))  # each box in one heap
    averaged, _, _ = merge(boxes, scores, 0.5)
    for box, heap in zip(averaged, members, strict=True):
        np.testing.assert_allclose(box, scores[heap] @ boxes[heap] / scores[heap].sum(), rtol=1e-4)
    lonely = [heap for heap in members if len(heap) < 3]
    assert len(merge(boxes, scores, 0.5, min_boxes=3)[0]) == len(members) - len(lonely)


def test_nothing_merges_to_nothing():
    merged, best, members = merge(np.empty((0, 4)), [])
    assert (merged.shape, best.shape, members) == ((0, 4), (0,), [])


# ---------------------------------------------------------------------------------------------------------------------
# What sizes people have
# ---------------------------------------------------------------------------------------------------------------------


def people(rng, n, intercept=-30.0, slope=0.3, noise=0.05):
    feet = rng.uniform(250, 560, n)
    heights = (intercept + slope * feet) * np.exp(rng.normal(0, noise, n))
    return np.column_stack([rng.uniform(0, 700, n), feet - heights, 0.4 * heights, heights])


@pytest.mark.parametrize("seed", range(5))
def test_the_line_is_found_among_outliers(seed):
    rng = np.random.default_rng(seed)
    prior = SizePrior()
    wrong = people(rng, 60)
    wrong[:, 3] *= rng.choice([0.4, 1.9], 60)
    prior.learn(rng.permutation(np.vstack([people(rng, 240), wrong])))
    feet = np.array([280.0, 400.0, 520.0])
    np.testing.assert_allclose(prior.heights(feet), -30 + 0.3 * feet, rtol=0.06)
    assert 0.03 < prior.spread < 0.12


def test_without_outliers_it_is_the_line_of_least_squares():
    rng = np.random.default_rng(0)
    boxes = people(rng, 500, noise=0.005)
    prior = SizePrior()
    prior.learn(boxes)
    truth = np.polyfit(boxes[:, 1] + boxes[:, 3], boxes[:, 3], 1)
    np.testing.assert_allclose(prior.line, truth[::-1], rtol=0.03)


def test_the_prior_waits_until_it_knows_enough_and_forgets_the_oldest():
    rng = np.random.default_rng(0)
    prior = SizePrior(min_boxes=30, max_boxes=200)
    prior.learn(people(rng, 29))
    assert prior.line is None
    with pytest.raises(ValueError, match="needs 30 boxes"):
        prior.heights([300])
    prior.learn(people(rng, 1))
    assert prior.line is not None
    prior.learn(people(rng, 400, intercept=10, slope=0.1))
    np.testing.assert_allclose(prior.heights([400]), 50, rtol=0.05)
    before = prior.line
    prior.learn(np.empty((0, 4)))
    assert prior.line is before


# ---------------------------------------------------------------------------------------------------------------------
# The detector
# ---------------------------------------------------------------------------------------------------------------------


def test_the_first_frame_shows_both_people_of_the_corridor(corridor):
    frame, boxes = corridor
    found = PedestrianDetector().detect(frame)
    assert found.shape[1] == 5
    assert (np.diff(found[:, 4]) <= 0).all()  # the best first
    assert metrics.pairwise_overlap(boxes, found[:, :4]).max(axis=1).min() > 0.7


def test_a_crowd_is_found(footage):
    """The numbers of the whole film are in results/detection.csv; here are twelve frames of it."""
    film = footage("pets09-s2l1")
    detector = PedestrianDetector()
    frames = range(60, 172)
    found = []
    for t in frames:
        if t < 100 or t % 6:
            detector.motion(film.frames[t])  # learn the background
            continue
        boxes = detector.detect(film.frames[t])
        found.append(np.column_stack([np.full(len(boxes), t), np.full(len(boxes), -1), boxes]))
    found = np.concatenate(found)
    score = metrics.detections(
        found, film.tracks[np.isin(film.tracks[:, 0], [t for t in frames if t >= 100 and not t % 6])]
    )
    assert score.recall > 0.8
    assert score.precision > 0.8


def window(x, feet, height, score, foreground=1.0):
    """HOG's window about a person."""
    h = height / detection.TRIM[3]
    w = h / 2
    return [x - w / 2, feet - height - detection.TRIM[1] * h, w, h, score, foreground]


def test_each_refinement_does_what_it_says():
    person = [window(100, 200, 80, 1.0), window(104, 202, 80, 3.0)]
    ghost, lonely = [window(300, 200, 80, 1.0, 0.1)] * 2, [window(500, 200, 80, 2.0)]
    detector = PedestrianDetector(size_prior=False)
    (found,) = detector.refine(person + ghost + lonely, (480, 640))
    np.testing.assert_allclose(found[3], 80, rtol=1e-3)
    np.testing.assert_allclose(found[0] + found[2] / 2, 103, rtol=1e-3)  # the better window weighs three times as much
    np.testing.assert_allclose([found[2] / found[3], found[4]], [detection.ASPECT, 3.0])
    assert len(PedestrianDetector(size_prior=False, min_windows=1).refine(person + lonely, (480, 640))) == 2
    assert len(PedestrianDetector(size_prior=False, min_foreground=0).refine(person + ghost, (480, 640))) == 2
    (untrimmed,) = PedestrianDetector(trimmed=False, weighted=False, size_prior=False).refine(person, (480, 640))
    np.testing.assert_allclose(untrimmed, person[1][:5])


def test_a_prior_that_knows_drops_giants_and_corrects_the_rest():
    rng = np.random.default_rng(0)
    detector = PedestrianDetector()
    detector.prior.learn(people(rng, 300, noise=0.06))
    feet = 400.0
    expected = -30 + 0.3 * feet
    ordinary, giant = [window(100, feet, 1.1 * expected, 0.3)] * 2, [window(400, feet, 2 * expected, 0.3)] * 2
    (found,) = detector.refine(ordinary + giant, (576, 768))
    pull = 0.06**2 / (0.06**2 + detector.prior.spread**2)  # the product of two normal densities
    np.testing.assert_allclose(found[3], (1 - pull) * 1.1 * expected + pull * detector.prior.heights(feet), rtol=1e-3)


def test_nobody_in_the_picture_is_nobody_found():
    detector = PedestrianDetector()
    for _ in range(3):
        assert detector.detect(np.full((200, 200, 3), 127, np.uint8)).shape == (0, 5)
    assert detector.refine(np.empty((0, 6)), (10, 10)).shape == (0, 5)


def test_what_is_no_frame_is_refused():
    detector = PedestrianDetector()
    with pytest.raises(ValueError, match="must be a colour image"):
        detector.detect(np.zeros((20, 20), np.uint8))
    detector.detect(np.zeros((40, 40, 3), np.uint8))
    with pytest.raises(ValueError, match="all frames must have one size"):
        detector.detect(np.zeros((40, 50, 3), np.uint8))


@pytest.mark.parametrize(
    "arguments",
    [{"scale": 0}, {"threshold": -1}, {"min_windows": 0}, {"min_foreground": 1.5}, {"gate": 0}, {"height_noise": 0}],
)
def test_settings_out_of_range_are_refused(arguments):
    with pytest.raises(ValueError, match="got"):
        PedestrianDetector(**arguments)


# ---------------------------------------------------------------------------------------------------------------------
# The film and the store
# ---------------------------------------------------------------------------------------------------------------------


@pytest.fixture
def counted(monkeypatch):
    """Count the frames in which windows are looked for, quickly."""
    calls = []

    def windows(frame, regions, scale, threshold):
        calls.append(int(frame[0, 0, 0]))
        return np.array([[*window(60 + calls[-1], 100, 60, 1.0)[:4], 1.0]] * 2)

    monkeypatch.setattr(detection, "hog_windows", windows)
    monkeypatch.setattr(detection, "BLOCK", 4)
    return calls


def film(n, offset=0):
    frames = [np.zeros((120, 160, 3), np.uint8) for _ in range(n)]
    for t, frame in enumerate(frames):
        frame[0, 0] = t + offset
    return frames


def test_the_store_spares_what_was_found_before(counted, tmp_path):
    frames = film(10)
    detector = PedestrianDetector(min_foreground=0, size_prior=False)
    plain = detection.detect(frames, PedestrianDetector(min_foreground=0, size_prior=False))
    assert plain.shape == (10, 7)
    np.testing.assert_array_equal(plain[:, 0], np.arange(10))
    np.testing.assert_array_equal(plain[:, 1], -1)
    counted.clear()
    first = detection.detect(frames[:8], detector, store=tmp_path)
    assert counted == list(range(8))
    counted.clear()
    again = detection.detect(frames, PedestrianDetector(min_foreground=0, size_prior=False), store=tmp_path)
    assert counted == [8, 9]
    np.testing.assert_allclose(again, plain)
    np.testing.assert_allclose(first, plain[:8])


def test_the_store_tells_films_and_settings_apart(counted, tmp_path):
    detection.detect(film(4), store=tmp_path)
    counted.clear()
    detection.detect(film(4), PedestrianDetector(min_windows=1), store=tmp_path)  # only the second part differs
    assert counted == []
    detection.detect(film(4), PedestrianDetector(scale=1.5), store=tmp_path)
    detection.detect(film(4, offset=1), store=tmp_path)
    detection.detect(film(4), PedestrianDetector("mog2"), store=tmp_path)
    assert len(counted) == 12


def test_a_film_that_was_interrupted_goes_on_with_the_background_it_had(square, tmp_path, monkeypatch):
    monkeypatch.setattr(detection, "BLOCK", 10)
    whole = detection.detect(square, PedestrianDetector(min_windows=1), store=tmp_path / "whole")
    detection.detect(square[:20], PedestrianDetector(min_windows=1), store=tmp_path / "parts")
    seen = []
    monkeypatch.setattr(
        MotionMask, "__call__", lambda self, frame, call=MotionMask.__call__: seen.append(1) or call(self, frame)
    )
    rest = detection.detect(square, PedestrianDetector(min_windows=1), store=tmp_path / "parts")
    assert len(seen) == 40
    np.testing.assert_allclose(rest, whole)


def test_a_damaged_file_of_the_store_is_made_again(counted, tmp_path):
    before = detection.detect(film(4), store=tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_bytes(b"not an array")
    np.testing.assert_array_equal(detection.detect(film(4), store=tmp_path), before)
    assert np.load(path).shape == (8, 7)
