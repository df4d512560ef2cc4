"""What all trackers share: the protocol, the checks of frames and boxes, and the loop over a film."""

import cv2
import numpy as np
import pytest

import pftrack
from pftrack import datasets
from pftrack.checks import check_box
from pftrack.trackers import TRACKERS, Estimate, follow, track
from pftrack.trackers.base import check_frame

WIDTH, HEIGHT = 80, 60
BOX = (30.0, 20.0, 10.0, 20.0)


def blue_on_black(x: int = 30, size=(WIDTH, HEIGHT)) -> np.ndarray:
    frame = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    frame[20:40, x : x + 10] = (255, 0, 0)
    return frame


@pytest.fixture(params=TRACKERS.values(), ids=TRACKERS.keys())
def tracker(request):
    return request.param()


class Fake:
    """A tracker that notes what it is given and reports the number of the frame."""

    def __init__(self):
        self.calls = []

    def _report(self, call):
        self.calls.append(call)
        return Estimate(box=np.full(4, float(len(self.calls) - 1)), score=1.0, lost=False)

    def init(self, frame, box):
        return self._report(("init", frame, tuple(box)))

    def update(self, frame):
        return self._report(("update", frame))


class ShortFilm:
    """Announces five frames and holds three, as a damaged video does."""

    def __len__(self):
        return 5

    def __iter__(self):
        return iter([blue_on_black()] * 3)


# ---------------------------------------------------------------------------------------------------------------------
# Frames
# ---------------------------------------------------------------------------------------------------------------------

BAD_FRAMES = {
    "grey": (np.zeros((60, 80), np.uint8), r"\(60, 80\); convert grey or four-channel images with cv2\.cvtColor"),
    "one channel": (np.zeros((60, 80, 1), np.uint8), r"\(60, 80, 1\); convert grey"),
    "four channels": (np.zeros((60, 80, 4), np.uint8), r"\(60, 80, 4\); convert grey or four-channel images"),
    "a stack": (np.zeros((2, 60, 80, 3), np.uint8), r"shape \(H, W, 3\), got shape \(2, 60, 80, 3\)"),
    "no pixels": (np.zeros((0, 80, 3), np.uint8), r"shape \(H, W, 3\), got shape \(0, 80, 3\)"),
    "floats": (np.zeros((60, 80, 3)), "dtype uint8 with values 0 to 255, got float64"),
    "16 bit": (np.zeros((60, 80, 3), np.uint16), "dtype uint8 with values 0 to 255, got uint16"),
    "a list": (np.zeros((2, 2, 3), np.uint8).tolist(), r"shape \(H, W, 3\), got list"),
    "nothing": (None, r"shape \(H, W, 3\), got NoneType"),
    "a path": ("frame.png", r"shape \(H, W, 3\), got str"),
}


@pytest.mark.parametrize(("frame", "hint"), BAD_FRAMES.values(), ids=BAD_FRAMES.keys())
def test_a_bad_frame_is_refused_at_the_start_and_later(tracker, frame, hint):
    with pytest.raises(ValueError, match=hint):
        tracker.init(frame, BOX)
    tracker.init(blue_on_black(), BOX)
    with pytest.raises(ValueError, match=hint):
        tracker.update(frame)


def test_a_frame_of_another_size_is_refused(tracker):
    tracker.init(blue_on_black(), BOX)
    with pytest.raises(ValueError, match="100x60 but tracking began on 80x60; all frames must have one size"):
        tracker.update(blue_on_black(size=(100, 60)))


def test_a_refused_frame_does_not_spoil_the_track(tracker):
    tracker.init(blue_on_black(), BOX)
    with pytest.raises(ValueError):
        tracker.update(blue_on_black(size=(100, 60)))
    undisturbed = type(tracker)()
    undisturbed.init(blue_on_black(), BOX)
    for x in (31, 33):
        np.testing.assert_array_equal(tracker.update(blue_on_black(x)).box, undisturbed.update(blue_on_black(x)).box)


def test_update_before_init_says_what_to_call(tracker):
    with pytest.raises(ValueError, match=r"call init\(frame, box\) before update"):
        tracker.update(blue_on_black())


def test_a_good_frame_is_returned_as_it_is():
    frame = blue_on_black()
    assert check_frame(frame) is frame
    assert check_frame(frame, frame.shape) is frame
    view = frame[::2, ::-1]  # neither contiguous nor in order
    assert check_frame(view) is view


# ---------------------------------------------------------------------------------------------------------------------
# Boxes
# ---------------------------------------------------------------------------------------------------------------------

BAD_BOXES = {
    "NaN": ((np.nan, 20, 10, 20), "four finite numbers x, y, w, h"),
    "hidden": ([np.nan] * 4, "four finite numbers x, y, w, h"),
    "infinite": ((30, 20, np.inf, 20), "four finite numbers x, y, w, h"),
    "three numbers": ((30, 20, 10), "four finite numbers x, y, w, h"),
    "five numbers": ((30, 20, 10, 20, 1), "four finite numbers x, y, w, h"),
    "one row of a table": ([[30, 20, 10, 20]], "four finite numbers x, y, w, h"),
    "nothing": (None, "four finite numbers x, y, w, h"),
    "zero width": ((30, 20, 0, 20), "is empty; width and height must be positive"),
    "negative height": ((30, 20, 10, -20), "is empty; width and height must be positive"),
    "right of the frame": ((80, 20, 10, 20), "outside the 80x60 frame"),
    "above the frame": ((30, -20, 10, 20), "outside the 80x60 frame"),
    "far away": ((-500, 900, 10, 20), "outside the 80x60 frame"),
    "one pixel": ((30, 20, 1, 1), "less than 2x2 pixels of the 80x60 frame"),
    "one column": ((30, 20, 1, 20), "less than 2x2 pixels of the 80x60 frame"),
    "one visible column": ((-9, 20, 10, 20), "less than 2x2 pixels of the 80x60 frame"),
    "one visible row": ((30, 59, 10, 20), "less than 2x2 pixels of the 80x60 frame"),
}


@pytest.mark.parametrize(("box", "hint"), BAD_BOXES.values(), ids=BAD_BOXES.keys())
def test_a_bad_box_is_refused(tracker, box, hint):
    with pytest.raises(ValueError, match=hint):
        tracker.init(blue_on_black(), box)


def test_a_box_too_large_for_whole_numbers_is_refused(tracker):
    with pytest.raises(ValueError, match="box"):
        tracker.init(blue_on_black(), (0, 0, 1e300, 20))


@pytest.mark.parametrize("box", ["10,20,30,40", ("ten", 20, 30, 40), [1, [2, 3], 4, 5]], ids=str)
def test_a_box_that_is_not_of_numbers_says_what_a_box_is(box):
    with pytest.raises(ValueError, match="four finite numbers"):
        check_box(box, blue_on_black())


@pytest.mark.parametrize(
    "box",
    [(0, 0, 2, 2), (78, 58, 2, 2), (-8, 20, 10, 20), (78, 58, 500, 500), (-10, -10, 200, 200), (30.4, 20.6, 9.7, 19.2)],
    ids=str,
)
def test_a_box_on_the_border_or_over_it_is_taken(tracker, box):
    np.testing.assert_array_equal(check_box(box, blue_on_black()), box)
    assert np.isfinite(tracker.init(blue_on_black(), box).box).all()
    assert np.isfinite(tracker.update(blue_on_black()).box).all()


def test_changing_the_users_box_afterwards_changes_nothing(tracker):
    """A row of `sequence.boxes` is a view; the tracker must not keep it."""
    box = np.array(BOX)
    first = tracker.init(blue_on_black(), box)
    box[:] = (0, 0, 70, 50)
    other = type(tracker)()
    other.init(blue_on_black(), BOX)
    np.testing.assert_array_equal(tracker.update(blue_on_black(31)).box, other.update(blue_on_black(31)).box)
    np.testing.assert_array_equal(first.box, BOX)


# ---------------------------------------------------------------------------------------------------------------------
# Estimates
# ---------------------------------------------------------------------------------------------------------------------


def test_the_first_estimate_is_the_given_box(tracker):
    estimate = tracker.init(blue_on_black(), BOX)
    np.testing.assert_array_equal(estimate.box, BOX)
    assert estimate.score == 1
    assert estimate.lost is False


def test_an_estimate_has_the_promised_types_and_ranges(tracker):
    tracker.init(blue_on_black(), BOX)
    estimate = tracker.update(blue_on_black(32))
    assert estimate.box.shape == (4,)
    assert estimate.box.dtype == float
    assert isinstance(estimate.score, float)
    assert 0 <= estimate.score <= 1
    assert type(estimate.lost) is bool


def test_frames_are_not_changed(tracker):
    first, second = blue_on_black(), blue_on_black(32)
    tracker.init(first, BOX)
    tracker.update(second)
    np.testing.assert_array_equal(first, blue_on_black())
    np.testing.assert_array_equal(second, blue_on_black(32))


def test_an_estimate_is_not_changed_by_later_frames(tracker):
    tracker.init(blue_on_black(), BOX)
    estimate = tracker.update(blue_on_black(32))
    arrays = [array for array in (estimate.box, estimate.particles, estimate.weights) if array is not None]
    copies = [array.copy() for array in arrays]
    for x in (34, 36, 38):
        tracker.update(blue_on_black(x))
    tracker.init(blue_on_black(50), (50, 20, 10, 20))
    for array, copy in zip(arrays, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_a_tracker_started_anew_repeats_itself_to_the_bit(tracker):
    frames = [blue_on_black(x) for x in (30, 31, 33, 36, 40)]
    np.testing.assert_array_equal(track(tracker, frames, BOX), track(tracker, frames, BOX))


@pytest.mark.parametrize("color", [(0, 0, 0), (255, 255, 255), (0, 255, 0)], ids=["black", "white", "green"])
def test_a_frame_of_one_colour_is_a_loss_and_not_an_error(tracker, color):
    tracker.init(blue_on_black(), BOX)
    for n_seen in (1, 2, 3):
        estimate = tracker.update(np.full((HEIGHT, WIDTH, 3), color, np.uint8))
        assert estimate.lost is (n_seen >= getattr(tracker, "patience", 1))
        assert np.isfinite(estimate.box).all()
        assert (estimate.box[2:] > 0).all()
        assert estimate.score == 0


def test_a_target_that_leaves_the_picture_is_lost(tracker):
    tracker.init(blue_on_black(), BOX)
    estimates = [tracker.update(blue_on_black(x)) for x in range(30, 90, 3)]  # beyond 80 nothing is drawn
    assert not any(estimate.lost for estimate in estimates[:5])
    assert all(estimate.lost for estimate in estimates[-3:])
    assert all(np.isfinite(estimate.box).all() for estimate in estimates)


# ---------------------------------------------------------------------------------------------------------------------
# The loop
# ---------------------------------------------------------------------------------------------------------------------


def test_follow_starts_on_the_first_frame_and_updates_with_each_later_one():
    fake = Fake()
    estimates = list(follow(fake, ["a", "b", "c"], (1, 2, 3, 4)))
    assert fake.calls == [("init", "a", (1, 2, 3, 4)), ("update", "b"), ("update", "c")]
    assert [estimate.box[0] for estimate in estimates] == [0, 1, 2]


def test_follow_takes_one_frame_for_each_estimate():
    taken = []

    def frames():
        for n in range(5):
            taken.append(n)
            yield n

    estimates = follow(Fake(), frames(), BOX)
    assert taken == []
    for n in range(3):
        next(estimates)
        assert taken == list(range(n + 1))


@pytest.mark.parametrize("frames", [[], iter(())], ids=["empty list", "empty iterator"])
def test_no_frames_are_an_error(frames):
    with pytest.raises(ValueError, match="no frames to track through"):
        list(follow(Fake(), frames, BOX))
    with pytest.raises(ValueError, match="no frames to track through"):
        track(Fake(), [], BOX)


def test_a_film_that_ends_early_is_filled_up_with_lost_frames(tracker):
    estimates = list(follow(tracker, ShortFilm(), BOX))
    assert [estimate.lost for estimate in estimates] == [False, False, False, True, True]
    assert all(np.isnan(estimate.box).all() and estimate.score == 0 for estimate in estimates[3:])
    boxes = track(tracker, ShortFilm(), BOX)
    assert boxes.shape == (5, 4)
    np.testing.assert_array_equal(np.isnan(boxes[:, 0]), [False, False, False, True, True])


def test_a_real_film_that_ends_early_is_filled_up_too(tmp_path):
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, (WIDTH, HEIGHT))
    for x in range(20, 50):
        writer.write(blue_on_black(x))
    writer.release()
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])
    boxes = track(pftrack.MeanShiftTracker(), datasets.open_frames(path), (20, 20, 10, 20))
    n_real = int(np.isfinite(boxes).all(axis=1).sum())
    assert len(boxes) == 30
    assert 2 < n_real < 30
    assert np.isnan(boxes[n_real:]).all()


@pytest.mark.parametrize(
    ("frames", "box", "message"),
    [
        ([blue_on_black()] * 3 + [blue_on_black(size=(40, 60))], BOX, "frame 3: the frame is 40x60"),
        ([blue_on_black(), blue_on_black()[:, :, 0]], BOX, "frame 1: a frame must be a colour image"),
        ([blue_on_black()], (0, 0, 0, 0), "frame 0: the box .* is empty"),
    ],
    ids=["size", "grey", "box"],
)
def test_an_error_names_the_frame(tracker, frames, box, message):
    with pytest.raises(ValueError, match=message):
        track(tracker, frames, box)


def test_estimates_before_an_error_are_not_lost():
    """Whoever writes them out as they come has them."""
    frames = [blue_on_black()] * 3 + [blue_on_black(size=(40, 60))]
    estimates = follow(pftrack.MeanShiftTracker(), frames, BOX)
    assert len([next(estimates) for _ in range(3)]) == 3
    with pytest.raises(ValueError, match="frame 3"):
        next(estimates)


@pytest.mark.parametrize("progress", [False, True])
def test_a_progress_bar_is_shown_only_when_asked_for(capfd, progress):
    list(follow(Fake(), [1, 2, 3], BOX, progress=progress))
    out, err = capfd.readouterr()
    assert out == ""
    assert ("3/3" in err) == progress
    assert progress or err == ""
