"""Mean-Shift and CAMSHIFT: what OpenCV computes, with the book's protocol around it."""

import cv2
import numpy as np
import pytest

from pftrack import datasets, metrics
from pftrack.trackers import CamShiftTracker, MeanShiftTracker, track

BLUE = (255, 0, 0)


@pytest.fixture(scope="module")
def walk():
    """Frames and boxes of a scene without any difficulty."""
    scene = datasets.load("synthetic-walk")
    return list(scene.frames), scene.boxes


def opencv_sample(search, frames, window):
    """The loop of OpenCV's samples/python/camshift.py, with `search` one of cv2.meanShift and cv2.CamShift."""
    x, y, w, h = window
    histogram = None
    for frame in frames:
        hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
        mask = cv2.inRange(hsv, np.array((0.0, 60.0, 32.0)), np.array((180.0, 255.0, 255.0)))
        if histogram is None:
            histogram = cv2.calcHist([hsv[y : y + h, x : x + w]], [0], mask[y : y + h, x : x + w], [16], [0, 180])
            cv2.normalize(histogram, histogram, 0, 255, cv2.NORM_MINMAX)
            continue
        probability = cv2.calcBackProject([hsv], [0], histogram, [0, 180], 1)
        probability &= mask
        criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 1)
        found, window = search(probability, window, criteria)
        yield found, window, probability


def whole(box) -> tuple[int, int, int, int]:
    return tuple(round(float(side)) for side in box)


def block(x=30, y=20, w=10, h=20, color=BLUE, size=(80, 60)) -> np.ndarray:
    frame = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    frame[y : y + h, x : x + w] = color
    return frame


@pytest.mark.parametrize(
    ("tracker", "search"), [(MeanShiftTracker, cv2.meanShift), (CamShiftTracker, cv2.CamShift)], ids=["ms", "cs"]
)
@pytest.mark.parametrize("name", ["synthetic-walk", "synthetic-scale", "bobot-I"])
def test_the_window_is_that_of_opencvs_sample(footage, tracker, search, name):
    scene = datasets.load(name) if name.startswith("synthetic") else footage(name)
    frames = [scene.frames[index] for index in range(25)]
    start = whole(scene.boxes[0])
    tracker = tracker()
    tracker.init(frames[0], start)
    moved = False
    for frame, (found, window, probability) in zip(frames[1:], opencv_sample(search, frames, start), strict=True):
        estimate = tracker.update(frame)
        assert tuple(estimate.box) == window
        x, y, w, h = window
        assert estimate.score == pytest.approx(probability[y : y + h, x : x + w].mean() / 255)
        if search is cv2.CamShift:
            assert tracker.rotated_box == found
        moved |= window[:2] != start[:2]
    assert moved


@pytest.mark.parametrize("tracker", [MeanShiftTracker, CamShiftTracker])
def test_a_target_without_clutter_is_followed_to_within_two_pixels(walk, tracker):
    frames, truth = walk
    boxes = track(tracker(), frames, truth[0])
    assert metrics.center_error(boxes, truth).mean() < 2


@pytest.mark.parametrize("tracker", [MeanShiftTracker, CamShiftTracker])
def test_the_colours_are_learnt_where_the_box_is(tracker):
    """A green neighbour of equal size is no temptation."""
    frames = []
    for shift in range(0, 20, 2):
        frame = block(10 + shift)
        frame[20:40, 50:60] = (0, 255, 0)
        frames.append(frame)
    boxes = track(tracker(), frames, (10, 20, 10, 20))
    np.testing.assert_allclose(boxes[-1, :2] + boxes[-1, 2:] / 2, (33, 30), atol=2)
    boxes = track(tracker(), frames, (50, 20, 10, 20))
    np.testing.assert_allclose(boxes[-1, :2] + boxes[-1, 2:] / 2, (55, 30), atol=2)


def test_mean_shift_keeps_its_size_and_camshift_adapts_it():
    """The block grows from 20x40 to 40x80 about a fixed centre."""
    frames = [block(100 - n, 100 - 2 * n, 20 + 2 * n, 40 + 4 * n, size=(200, 240)) for n in range(11)]
    fixed = track(MeanShiftTracker(), frames, (100, 100, 20, 40))
    np.testing.assert_array_equal(fixed[:, 2:], np.tile([20, 40], (11, 1)))
    fitted = track(CamShiftTracker(), frames, (100, 100, 20, 40))
    assert np.prod(fitted[-1, 2:]) > 3 * np.prod(fitted[0, 2:])
    np.testing.assert_allclose(fitted[-1, :2] + fitted[-1, 2:] / 2, (110, 120), atol=2)


def test_camshift_measures_size_and_orientation_of_a_tilted_target():
    """OpenCV's rotated rectangle is that of an ellipse with the same moments: 4 standard deviations along each axis."""
    length, thickness, angle = 80, 24, 30.0
    frame = np.zeros((200, 240, 3), dtype=np.uint8)
    corners = cv2.boxPoints(((120, 100), (length, thickness), angle))
    cv2.fillPoly(frame, [np.rint(corners).astype(int)], BLUE)
    tracker = CamShiftTracker()
    tracker.init(frame, (80, 65, 80, 70))
    for _ in range(5):
        tracker.update(frame)
    (x, y), sides, found = tracker.rotated_box
    assert (x, y) == pytest.approx((120, 100), abs=2)
    assert max(sides) == pytest.approx(4 * length / np.sqrt(12), rel=0.06)
    assert min(sides) == pytest.approx(4 * thickness / np.sqrt(12), rel=0.06)
    along = found + (90 if sides[1] > sides[0] else 0)
    assert (along - angle + 90) % 180 - 90 == pytest.approx(0, abs=3)


def test_the_score_is_the_mean_back_projection():
    """In a full window it is 1; in one that the target fills by half it is one half."""
    tracker = MeanShiftTracker()
    tracker.init(block(), (30, 20, 10, 20))
    assert tracker.update(block()).score == 1
    tracker.init(block(), (25, 20, 20, 20))
    assert tracker.update(block()).score == pytest.approx(0.5)


@pytest.mark.parametrize("tracker", [MeanShiftTracker, CamShiftTracker])
def test_a_lost_window_stays_where_it_was_and_finds_the_target_again(tracker):
    tracker = tracker()
    tracker.init(block(), (30, 20, 10, 20))
    seen = tracker.update(block(32))
    for _ in range(3):
        gone = tracker.update(block(color=(0, 0, 0)))
        assert gone.lost
        assert gone.score == 0
        np.testing.assert_array_equal(gone.box, seen.box)
    again = tracker.update(block(33))
    assert not again.lost
    assert again.score > 0.5


def test_camshift_has_no_rotated_box_before_the_first_frame_and_while_lost():
    tracker = CamShiftTracker()
    assert tracker.rotated_box is None
    tracker.init(block(), (30, 20, 10, 20))
    assert tracker.rotated_box is None
    tracker.update(block())
    assert tracker.rotated_box is not None
    tracker.update(block(color=(0, 0, 0)))
    assert tracker.rotated_box is None
    tracker.update(block())
    assert tracker.rotated_box is not None
    tracker.init(block(), (30, 20, 10, 20))
    assert tracker.rotated_box is None


@pytest.mark.parametrize("tracker", [MeanShiftTracker, CamShiftTracker])
@pytest.mark.parametrize("color", [(128, 128, 128), (10, 10, 10)], ids=["grey", "dark"])
def test_a_target_without_any_colour_is_lost_at_once(tracker, color):
    """The mask admits none of its pixels, so there is nothing to look for."""
    tracker = tracker()
    tracker.init(block(color=color), (30, 20, 10, 20))
    estimate = tracker.update(block(31, color=color))
    assert estimate.lost
    np.testing.assert_array_equal(estimate.box, (30, 20, 10, 20))


@pytest.mark.parametrize("tracker", [MeanShiftTracker, CamShiftTracker])
@pytest.mark.parametrize("corner", [(-5, -10), (75, 50), (-5, 50), (75, -10)], ids=str)
def test_a_target_half_outside_is_followed_inside(tracker, corner):
    x, y = corner
    frame = np.zeros((60, 80, 3), dtype=np.uint8)
    frame[max(y, 0) : y + 20, max(x, 0) : x + 10] = BLUE
    tracker = tracker()
    tracker.init(frame, (x, y, 10, 20))
    for _ in range(3):
        estimate = tracker.update(frame)
        assert not estimate.lost
        left, top, w, h = estimate.box
        assert left >= 0
        assert top >= 0
        assert left + w <= 80
        assert top + h <= 60


@pytest.mark.parametrize("channel", ["saturation", "value"])
def test_the_lowest_admitted_level_counts_and_the_one_below_it_does_not(channel):
    hsv = np.zeros((60, 80, 3), dtype=np.uint8)
    hsv[20:40, 30:40] = (120, 100, 200)
    frame = cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)
    level = int(cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)[25, 35, 1 if channel == "saturation" else 2])
    for lowest, lost in ((level, False), (level + 1, True)):
        tracker = MeanShiftTracker(**{channel: (lowest, 255)})
        tracker.init(frame, (30, 20, 10, 20))
        assert tracker.update(frame).lost == lost


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        ({"saturation": (-1, 255)}, "saturation must be an interval within 0 to 255"),
        ({"saturation": (60, 256)}, "saturation must be an interval within 0 to 255"),
        ({"saturation": (200, 100)}, "saturation must be an interval within 0 to 255"),
        ({"value": (float("nan"), 255)}, "value must be an interval within 0 to 255"),
        ({"value": (0, 300)}, "value must be an interval within 0 to 255"),
        ({"n_hues": 0}, "n_hues, max_iterations and epsilon must be positive"),
        ({"max_iterations": 0}, "n_hues, max_iterations and epsilon must be positive"),
        ({"epsilon": 0.0}, "n_hues, max_iterations and epsilon must be positive"),
        ({"epsilon": float("nan")}, "n_hues, max_iterations and epsilon must be positive"),
    ],
    ids=str,
)
@pytest.mark.parametrize("tracker", [MeanShiftTracker, CamShiftTracker])
def test_an_argument_out_of_its_range_is_refused(tracker, arguments, hint):
    with pytest.raises(ValueError, match=hint):
        tracker(**arguments)
