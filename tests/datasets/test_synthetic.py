"""Synthetic scenes: the same film for the same seed, truth that is exact, and knobs that do what they say."""

import cv2
import numpy as np
import pytest

from pftrack import datasets
from pftrack.datasets import synthetic
from pftrack.datasets.synthetic import draw_detections, scene

SMALL = {"n_frames": 20, "size": (160, 120)}


def silhouette(owner: np.ndarray, walker: int) -> tuple[int, int, int, int]:
    """Box around the pixels that show a walker."""
    y, x = np.nonzero(owner == walker)
    return x.min(), y.min(), x.max() + 1 - x.min(), y.max() + 1 - y.min()


def mean_color(film, index: int, walker: int) -> np.ndarray:
    frame, owner, _ = film.frames.draw(index)
    return frame[owner == walker].mean(axis=0)


# ---------------------------------------------------------------------------------------------------------------------
# The same film
# ---------------------------------------------------------------------------------------------------------------------


def test_a_seed_gives_the_same_film_to_the_bit():
    knobs = {**SMALL, "n_walkers": 3, "distractors": 1, "camera_motion": 10, "birth_death": True, "seed": 5}
    one, two = scene(**knobs), scene(**knobs)
    np.testing.assert_array_equal(one.tracks, two.tracks)
    for a, b in zip(one.frames, two.frames, strict=True):
        np.testing.assert_array_equal(a, b)


def test_seeds_differ_in_paths_and_pictures():
    one, two = scene(**SMALL, seed=1), scene(**SMALL, seed=2)
    assert not np.array_equal(one.tracks, two.tracks)
    assert not np.array_equal(one.frames[0], two.frames[0])


def test_frames_read_out_of_order_equal_the_sequential_ones():
    film = scene(**SMALL, n_walkers=2, camera_motion=10, occlusion=30, illumination=0.3)
    in_order = list(film.frames)
    for index in np.random.default_rng(0).permutation(20):
        np.testing.assert_array_equal(film.frames[index], in_order[index])
    np.testing.assert_array_equal(film.frames[-1], in_order[-1])


def test_grain_is_new_in_every_frame_and_has_the_given_deviation():
    """Two frames of a still scene differ by the difference of two grains."""
    noise = 6.0
    frames = scene(**SMALL, noise=noise).frames
    still = scene(**SMALL, noise=0.0).frames
    (first, owner, _), (second, later, _) = frames.draw(0), frames.draw(1)
    ground = (owner == -1) & (later == -1)
    ground &= (still[0].min(axis=2) > 40) & (still[0].max(axis=2) < 215)  # where nothing is clipped
    change = second.astype(float)[ground][:, 0] - first.astype(float)[ground][:, 0]
    expected = np.sqrt(2 * noise**2 + 2 / 12)  # and that of two roundings
    assert change.std() == pytest.approx(expected, rel=5 / np.sqrt(2 * change.size))
    np.testing.assert_array_equal(still[0][ground], still[1][ground])


@pytest.mark.parametrize("name", synthetic.SCENES)
def test_every_ready_made_scene_loads_with_its_target_in_the_first_frame(name):
    film = datasets.load(name)
    assert film.name == name
    assert film.frames[0].shape == (240, 320, 3)
    assert film.frames[0].dtype == np.uint8
    assert film.boxes.shape == (len(film), 4)
    assert film.ids[0] == 1
    x, y, w, h = film.boxes[0]
    assert 0 <= x < x + w <= 320
    assert 0 <= y < y + h <= 240


# ---------------------------------------------------------------------------------------------------------------------
# The truth
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "knobs",
    [
        {},
        {"seed": 7},
        {"n_walkers": 3},
        {"camera_motion": 20},
        {"growth": 1.5},
        {"growth": 0.6},
        {"occlusion": 60},
        {"distractors": 2, "birth_death": True, "seed": 3},
    ],
    ids=str,
)
def test_a_true_box_is_the_box_around_the_walkers_pixels(knobs):
    film = scene(n_frames=40, **knobs)
    n_compared = 0
    for index in range(0, 40, 3):
        _, owner, visible = film.frames.draw(index)
        for walker, share in enumerate(visible):
            if share == 1:
                box = film.target(walker + 1)[index]
                np.testing.assert_allclose(silhouette(owner, walker), box, atol=1)
                n_compared += 1
    assert n_compared >= 5


def test_the_owner_mask_is_where_a_walker_changes_the_picture():
    """The first walker is drawn from the same numbers whether or not there is a second."""
    alone, together = scene(n_frames=30, noise=0.0), scene(n_frames=30, noise=0.0, n_walkers=2)
    np.testing.assert_array_equal(alone.boxes, together.boxes)
    frame, owner, _ = together.frames.draw(10)
    changed = (frame != alone.frames[10]).any(axis=2)
    assert not changed[owner != 1].any()
    assert changed[owner == 1].mean() > 0.95


@pytest.mark.parametrize("occlusion", [20, 90])
def test_a_walker_behind_the_pillar_is_hidden_and_one_beside_it_is_not(occlusion):
    film = scene(occlusion=occlusion, n_frames=60, seed=1)
    free = scene(n_frames=60, seed=1)  # the same walk without a pillar
    left, right = free.boxes[:, 0], free.boxes[:, 0] + free.boxes[:, 2]
    covered = np.minimum(right, 160 + occlusion / 2) - np.maximum(left, 160 - occlusion / 2)
    covered = np.maximum(covered, 0) / free.boxes[:, 2]
    hidden = np.isnan(film.boxes[:, 0])
    assert not hidden[covered == 0].any()
    assert hidden[covered == 1].all()
    assert (covered == 1).any() == (occlusion == 90)
    np.testing.assert_array_equal(film.boxes[~hidden], free.boxes[~hidden])


def test_a_walker_is_hidden_exactly_when_less_than_a_tenth_can_be_seen():
    """The share is counted by hand, against the same walk without a pillar; the walk is slow, to come near a tenth."""
    knobs = {"n_frames": 240, "size": (160, 120)}
    film, free = scene(**knobs, occlusion=40), scene(**knobs)
    shares = []
    for index in range(50, 190):
        whole = (free.frames.draw(index)[1] == 0).sum()
        shares.append((film.frames.draw(index)[1] == 0).sum() / whole)
    shares = np.array(shares)
    np.testing.assert_array_equal(np.isnan(film.boxes[50:190, 0]), shares < 0.1)
    assert shares.min() == 0
    assert shares.max() == 1
    assert ((shares > 0.02) & (shares < 0.1)).any()
    assert ((shares > 0.1) & (shares < 0.18)).any()


def test_a_walker_is_where_its_position_and_velocity_say():
    film = scene(n_frames=40, n_walkers=2)
    for target, walker in zip((1, 2), film.frames.walkers, strict=True):
        boxes = film.target(target)
        path = np.array(walker.position) + np.arange(40)[:, None] * walker.velocity
        np.testing.assert_allclose(boxes[:, :2] + boxes[:, 2:] / 2, path, atol=0.51)  # whole pixels
        np.testing.assert_array_equal(boxes[0, 2:], walker.size)


def test_nobody_can_be_seen_through_the_pillar():
    film = scene(occlusion=90, n_frames=60)
    middle = next(i for i in range(60) if np.isnan(film.boxes[i, 0]))
    _, owner, _ = film.frames.draw(middle)
    assert (owner[:, 115:205] == -1).all()


def test_a_scene_in_which_everybody_is_always_hidden_has_an_empty_truth():
    film = scene(**SMALL, occlusion=160)
    assert film.tracks.shape == (0, 7)
    assert film.ids == []


# ---------------------------------------------------------------------------------------------------------------------
# The knobs
# ---------------------------------------------------------------------------------------------------------------------


def test_a_distractor_wears_the_clothes_of_the_target_and_another_walker_does_not():
    twins = scene(n_frames=5, distractors=1, noise=0.0)
    others = scene(n_frames=5, n_walkers=2, noise=0.0)
    assert np.abs(mean_color(twins, 0, 0) - mean_color(twins, 0, 1)).max() < 6
    assert np.abs(mean_color(others, 0, 0) - mean_color(others, 0, 1)).max() > 20
    (frame, owner, visible) = twins.frames.draw(0)
    assert visible == [1.0, 1.0]
    hues = []
    for walker in (0, 1):
        mask = (owner == walker).astype(np.uint8)
        hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
        hues.append(cv2.calcHist([hsv], [0], mask, [16], [0, 180]))
    assert cv2.compareHist(*hues, cv2.HISTCMP_BHATTACHARYYA) < 0.15


def test_the_number_of_targets_is_that_of_walkers_and_distractors():
    assert set(scene(**SMALL, n_walkers=3, distractors=2).ids) == {1, 2, 3, 4, 5}


@pytest.mark.parametrize("illumination", [0.3, 0.6])
def test_illumination_takes_away_its_share_of_the_light(illumination):
    lit, dim = scene(**SMALL, noise=0.0).frames, scene(**SMALL, noise=0.0, illumination=illumination).frames
    np.testing.assert_array_equal(dim[0], lit[0])
    assert dim[19].mean() == pytest.approx((1 - illumination) * lit[19].mean(), abs=0.6)
    means = [frame.mean() / other.mean() for frame, other in zip(dim, lit, strict=True)]
    assert np.all(np.diff(means) < 0)


def test_camera_motion_moves_ground_and_walkers_together():
    still, swaying = scene(n_frames=60, noise=0.0), scene(n_frames=60, noise=0.0, camera_motion=15)
    shift = still.boxes[:, :2] - swaying.boxes[:, :2]
    np.testing.assert_array_equal(still.boxes[:, 2:], swaying.boxes[:, 2:])
    assert 14 <= np.abs(shift[:, 0]).max() <= 15
    assert 6 <= np.abs(shift[:, 1]).max() <= 8
    for index in (5, 15, 40):
        dx, dy = shift[index].astype(int)
        a, b = still.frames[index], swaying.frames[index]
        height, width = a.shape[:2]
        part = np.s_[max(dy, 0) : height + min(dy, 0), max(dx, 0) : width + min(dx, 0)]
        same = np.s_[max(-dy, 0) : height + min(-dy, 0), max(-dx, 0) : width + min(-dx, 0)]
        np.testing.assert_array_equal(a[part], b[same])


@pytest.mark.parametrize("growth", [0.5, 1.0, 1.6])
def test_growth_is_the_ratio_of_the_last_size_to_the_first(growth):
    boxes = scene(n_frames=30, growth=growth).boxes
    np.testing.assert_allclose(boxes[-1, 2:], growth * boxes[0, 2:], atol=0.5)
    heights = boxes[:, 3]
    assert np.all(np.sign(growth - 1) * np.diff(heights) >= 0)


def test_people_after_the_first_appear_and_vanish():
    film = scene(n_frames=60, n_walkers=5, birth_death=True, seed=0)
    always = scene(n_frames=60, n_walkers=5, seed=0)
    assert np.isfinite(film.target(1)).all()
    n_born, n_dead = 0, 0
    for target in range(2, 6):
        present = np.flatnonzero(np.isfinite(film.target(target)[:, 0]))
        assert present[0] <= 20
        assert present[-1] >= 39
        n_born += present[0] > 0
        n_dead += present[-1] < 59
    assert n_born > 0
    assert n_dead > 0
    assert len(film.tracks) < len(always.tracks)
    for index in (0, 30, 59):
        _, owner, visible = film.frames.draw(index)
        in_picture = {n + 1 for n in range(5) if (owner == n).any()}
        in_truth = set(film.tracks[film.tracks[:, 0] == index, 1].astype(int))
        assert in_truth == {n + 1 for n in range(5) if visible[n] >= 0.1}
        assert in_truth <= in_picture


def test_a_walker_walks_straight_across_the_picture_and_stays_in_it():
    boxes = scene(n_frames=100).boxes
    assert np.isfinite(boxes).all()
    steps = np.diff(boxes[:, 0])
    assert steps.max() - steps.min() <= 1  # whole pixels of one velocity
    assert boxes[-1, 0] - boxes[0, 0] > 160
    assert (boxes[:, 0] >= 0).all()
    assert (boxes[:, 0] + boxes[:, 2] <= 320).all()


@pytest.mark.parametrize(
    ("knobs", "hint"),
    [
        ({"n_frames": 0}, "at least one frame"),
        ({"n_walkers": 0}, "one walker"),
        ({"distractors": -1}, "negative"),
        ({"occlusion": -5}, "negative"),
        ({"illumination": 1.0}, "illumination must lie in"),
        ({"illumination": -0.1}, "illumination must lie in"),
        ({"illumination": float("nan")}, "illumination must lie in"),
        ({"camera_motion": -1}, "camera_motion in"),
        ({"camera_motion": 49}, "camera_motion in"),
        ({"growth": 0.0}, "growth in"),
        ({"growth": float("nan")}, "growth in"),
        ({"noise": -1.0}, "noise at 0 or above"),
        ({"noise": float("nan")}, "noise at 0 or above"),
        ({"growth": 0.01}, "growth"),  # walkers of no pixel
        ({"growth": float("inf")}, "growth"),
        ({"size": (0, 0)}, "size"),
        ({"size": (320, 1)}, "size"),
    ],
    ids=str,
)
def test_a_knob_out_of_its_range_is_refused(knobs, hint):
    with pytest.raises(ValueError, match=hint):
        scene(**{**SMALL, **knobs})


# ---------------------------------------------------------------------------------------------------------------------
# Detections
# ---------------------------------------------------------------------------------------------------------------------


def test_detections_without_any_fault_are_the_truth():
    film = scene(**SMALL, n_walkers=3)
    drawn = draw_detections(film, found=1.0, error=0.0, ghosts=0.0)
    np.testing.assert_array_equal(drawn[:, [0, 2, 3, 4, 5, 6]], film.tracks[:, [0, 2, 3, 4, 5, 6]])
    assert (drawn[:, 1] == -1).all()


def test_detections_are_missed_and_moved_as_often_and_as_far_as_is_said():
    film = scene(n_frames=400, n_walkers=5)
    n = len(film.tracks)
    assert abs(len(draw_detections(film, found=0.7, ghosts=0.0)) / n - 0.7) < 5 * np.sqrt(0.7 * 0.3 / n)
    steps = draw_detections(film, found=1.0, error=0.1, ghosts=0.0)[:, 2:6] - film.tracks[:, 2:6]
    steps /= film.tracks[:, [4, 5, 4, 5]]
    np.testing.assert_allclose(steps.std(axis=0), 0.1, rtol=5 / np.sqrt(2 * n))
    np.testing.assert_allclose(steps.mean(axis=0), 0.0, atol=5 * 0.1 / np.sqrt(n))


def test_false_detections_have_the_sizes_of_people_and_lie_anywhere_in_the_picture():
    film = scene(n_frames=400, n_walkers=5)
    false = draw_detections(film, found=0.0, error=0.0, ghosts=2.0)
    assert abs(len(false) - 800) < 5 * np.sqrt(800)  # a Poisson number
    assert {tuple(size) for size in false[:, 4:6]} == {tuple(size) for size in film.tracks[:, 4:6]}
    rest = [320, 240] - false[:, 4:6]
    places = false[:, 2:4] / rest
    assert ((places >= 0) & (places <= 1)).all()
    assert abs(places.mean(axis=0) - 0.5).max() < 5 / np.sqrt(12 * len(false))
    assert len(np.unique(false[:, 0])) > 300


def test_a_seed_gives_the_same_detections():
    film = scene(**SMALL, n_walkers=2)
    np.testing.assert_array_equal(draw_detections(film, seed=3), draw_detections(film, seed=3))
    assert draw_detections(film, seed=3).tobytes() != draw_detections(film, seed=4).tobytes()
