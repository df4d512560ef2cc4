"""What multi-target trackers share."""

import numpy as np
import pytest

from pftrack import multi
from pftrack.multi import Track, base, link, table


def found(*people, score=1.0):
    return np.array([[x, 20, 20, 60, score] for x in people], dtype=float).reshape(-1, 5)


def test_people_who_walk_are_joined_and_a_ghost_is_not():
    frames = [found(10 + 3 * t, 200 - 3 * t) for t in range(5)]
    frames[2] = np.vstack([frames[2], found(400)])
    left, right = sorted(link(frames, min_frames=4), key=lambda target: target[0][0])
    assert [box[0] for box in left.values()] == [10, 13, 16, 19, 22]
    assert [box[0] for box in right.values()] == [200, 197, 194, 191, 188]


def test_joining_is_for_the_largest_sum():
    """Taking the best pair first would leave the second person with nobody."""
    frames = [found(0, 9), found(5, 15)]
    targets = link(frames, min_frames=2)
    assert sorted((a[0], b[0]) for a, b in (list(target.values()) for target in targets)) == [(0, 5), (9, 15)]


def test_one_person_found_twice_is_one():
    frames = [np.vstack([found(50, score=2.0), found(53, score=0.5)]) for _ in range(3)]
    assert len(link(frames, min_frames=2)) == 1


def test_legs_inside_a_person_are_not_another():
    legs = np.array([[52, 50, 14, 30, 3.0]])
    assert len(link([np.vstack([found(50), legs])] * 3, min_frames=3)) == 1
    behind = np.array([[60, 25, 18, 50, 3.0]])  # half hidden, which is somebody
    assert len(link([np.vstack([found(50), behind])] * 3, min_frames=3)) == 2


def test_gaps_are_bridged_and_nobody_is_nobody():
    (target,) = link([found(50), found(), found(52)], min_frames=2)
    assert list(target) == [0, 2]
    assert link([found(), found()], min_frames=1) == []
    assert link([], min_frames=1) == []


class Spy:
    """A tracker that shows what it is given."""

    def __init__(self):
        self.given = []

    def update(self, frame, detections=None):
        self.given.append(detections)
        if frame.ndim != 3:
            raise ValueError("that is no frame")
        return [Track(1, np.array([1.0, 2, 3, 4]), 0.5)]


def test_each_frame_gets_its_own_detections():
    rows = np.array([[0, -1, 1, 2, 3, 4, 0.5], [2, -1, 5, 6, 7, 8, 0.25]])
    tracker = Spy()
    assert len(list(multi.follow(tracker, [np.zeros((4, 4, 3))] * 3, rows))) == 3
    assert [found.tolist() for found in tracker.given] == [[[1, 2, 3, 4, 0.5]], [], [[5, 6, 7, 8, 0.25]]]
    tracker = Spy()
    list(multi.follow(tracker, [np.zeros((4, 4, 3))]))
    assert tracker.given == [None]


def test_an_error_says_in_which_frame():
    with pytest.raises(ValueError, match="frame 1: that is no frame"):
        list(multi.follow(Spy(), [np.zeros((4, 4, 3)), np.zeros(4)]))
    with pytest.raises(ValueError, match="no frames"):
        list(multi.follow(Spy(), []))


def test_a_table_has_a_row_for_every_track():
    rows = table([[Track(3, np.arange(4.0), 0.25)], [], [Track(1, np.ones(4), 1.0), Track(3, np.ones(4), 0.5)]])
    np.testing.assert_array_equal(rows[:, :2], [[0, 3], [2, 1], [2, 3]])
    np.testing.assert_array_equal(rows[0, 2:], [0, 1, 2, 3, 0.25])
    assert table([]).shape == (0, 7)


# ---------------------------------------------------------------------------------------------------------------------
# Random numbers of the targets, and detections from outside
# ---------------------------------------------------------------------------------------------------------------------


def test_every_target_has_a_stream_of_its_own():
    """It is the same whoever else there is, and no two agree in any number."""
    draws = {key: base.stream(*key).random(100) for key in [(0, 1), (0, 2), (1, 1), (1, 2), (12, 0)]}
    for key in reversed(draws):
        np.testing.assert_array_equal(base.stream(*key).random(100), draws[key])
    assert len(np.unique(list(draws.values()))) == 500


def test_a_generator_gives_its_children_in_turn():
    generator, same = np.random.default_rng(5), np.random.default_rng(5)
    children = [base.stream(generator, number) for number in (7, 7)]
    expected = [np.random.default_rng(each) for each in same.bit_generator.seed_seq.spawn(2)]
    draws = [child.random(50) for child in children]
    np.testing.assert_array_equal(draws, [child.random(50) for child in expected])
    assert not np.intersect1d(*draws).size
    np.testing.assert_array_equal(generator.random(50), same.random(50))  # and draws no number of its own


@pytest.mark.parametrize("none", [[], np.empty((0, 5)), np.empty((0, 7)), ()])
def test_no_detections_are_none(none):
    assert base.check_detections(none).shape == (0, 5)


def test_detections_are_what_they_were():
    rows = [[-5, 2, 3, 4, -0.5], [1, 2, 0.5, 1e4, 7]]
    checked = base.check_detections(rows)
    assert checked.dtype == float
    np.testing.assert_array_equal(checked, rows)


@pytest.mark.parametrize(
    "detections",
    [
        [[1, 2, 3, 4]], [1, 2, 3, 4, 5], [[1, 2, 3, 4, 5, 6]], [[[1, 2, 3, 4, 5]]], 3.0,
        [[1, 2, 0, 4, 1]], [[1, 2, 3, -4, 1]], [[1, 2, np.nan, 4, 1]], [[1, np.inf, 3, 4, 1]], [[1, 2, 3, 4, np.nan]],
        [[1, 2, 3, 4, 1], [1, 2, 3, 0, 1]],
    ],
)  # fmt: skip
def test_detections_that_are_none_are_refused(detections):
    with pytest.raises(ValueError, match="detections must be rows"):
        base.check_detections(detections)


def test_every_training_box_is_checked_and_not_only_the_last():
    frames = [np.zeros((60, 80, 3), dtype=np.uint8)] * 3
    boxes = np.tile([10.0, 10.0, 20.0, 30.0], (3, 2, 1))
    boxes[1, 0] = np.nan  # hidden
    assert [sorted(known) for known in base.check_training(frames, boxes)] == [[0, 2], [0, 1, 2]]
    for wrong in ([200, 10, 20, 30], [10, 10, 0, 30], [10, 10, np.inf, 30]):
        boxes[1, 1] = wrong
        with pytest.raises(ValueError, match="box"):
            base.check_training(frames, boxes)
