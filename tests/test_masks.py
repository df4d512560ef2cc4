import subprocess
import sys

import cv2
import numpy as np
import pytest

import pftrack
from pftrack import masks, metrics

TRACKERS = "camshift", "mean-shift"


def noise(rng, n_frames, height, width):
    """Random pixels: every hue everywhere, and no shape at all."""
    return rng.integers(0, 256, (n_frames, height, width, 3), dtype=np.uint8)


def drift(rng, n_frames, height, width):
    """A smooth patchwork of colours that jumps about, over the border and back on the other side."""
    patches = rng.integers(0, 256, (5, 6, 3), dtype=np.uint8)
    picture = cv2.resize(patches, (width, height), interpolation=cv2.INTER_CUBIC)
    return [np.roll(picture, tuple(rng.integers(-6, 7, 2)), axis=(0, 1)) for _ in range(n_frames)]


def discs(rng, n_frames, height, width):
    """One plain disc a frame, anywhere, also half outside; too symmetric for a safe angle."""
    frames = np.zeros((n_frames, height, width, 3), dtype=np.uint8)
    for frame in frames:
        center = int(rng.integers(0, width)), int(rng.integers(0, height))
        cv2.circle(frame, center, int(rng.integers(1, 20)), (255, 30, 60), -1)
    return frames


def sparks(rng, n_frames, height, width):
    """Few, dim pixels, and every third frame black."""
    frames = noise(rng, n_frames, height, width) // 3
    frames[rng.random(frames.shape[:3]) < 0.9] = 0
    frames[::3] = 0
    return frames


def scene(seed, kind, n_frames=6):
    """Return the frames of a scene and a box that may hang over the border."""
    rng = np.random.default_rng(seed)
    height, width = (int(side) for side in rng.integers(20, 90, 2))
    box = rng.uniform(-5, width - 5), rng.uniform(-5, height - 5), rng.uniform(8, width), rng.uniform(8, height)
    return kind(rng, n_frames, height, width), np.array(box)


def some_masks(seed, n):
    """Random masks, and three that admit nearly everything."""
    every = masks.all_masks()
    wide = [[0, 256, 0, 256], [0, 256, 32, 256], [64, 256, 32, 256]]
    return np.vstack([every[np.random.default_rng(seed).integers(0, len(every), n)], wide])


def followed(frames, truth, chosen, tracker):
    """Windows and iterations that the compiled search goes through for each mask."""
    film = masks._encode(frames, truth, tracker == "camshift")
    windows, iterations, completed = masks._follow(film, chosen)
    assert completed.all()
    return windows, iterations


def assert_same_as_opencv(frames, truth, chosen, tracker):
    for mask, *found in zip(chosen, *followed(frames, truth, chosen, tracker), strict=True):
        windows, iterations = masks.run_mask(frames, truth[0], mask, tracker)
        np.testing.assert_array_equal(found[0], windows, err_msg=str(mask))
        np.testing.assert_array_equal(found[1], iterations, err_msg=str(mask))


def ranked(frames, truth, chosen, tracker):
    """Return the masks' order, and scores in it, from runs of OpenCV one by one."""
    scores = []
    for mask in chosen:
        score = metrics.single_target(masks.run_mask(frames, truth[0], mask, tracker)[0], truth)
        scores.append((score.overlap_all, score.hit_ratio_all))
    order = sorted(range(len(chosen)), key=lambda index: (-scores[index][0], index))
    return order, np.array(scores)[order]


@pytest.fixture(scope="module")
def walk():
    sequence = pftrack.datasets.load("synthetic-occlusion")
    return list(sequence.frames[20:90]), sequence.boxes[20:90]


@pytest.fixture
def small_blocks(monkeypatch):
    monkeypatch.setattr(masks, "BLOCK", 4)


def assert_same_search(one, other):
    for field in ("masks", "overlap_mean", "hit_ratio", "overlaps", "iterations"):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field), err_msg=field)


# The space of masks


@pytest.mark.parametrize("step", [1, 8, 64, 256])
def test_intervals_are_the_pairs_of_ends(step):
    found = masks.intervals(step)
    n_ends = 256 // step + 1
    assert len({tuple(row) for row in found}) == len(found) == n_ends * (n_ends - 1) // 2
    assert (found[:, 0] < found[:, 1]).all()
    assert set(found.ravel()) == set(range(0, 257, step))


def test_there_are_as_many_masks_as_the_paper_tried():
    found = masks.all_masks()
    assert found.shape == (278_784, 4)
    assert len(np.unique(found, axis=0)) == 278_784
    assert (found[:, ::2] < found[:, 1::2]).all()


@pytest.mark.parametrize("step", [0, -8, 3, 512, 2.5])
def test_step_must_divide_256(step):
    with pytest.raises(ValueError, match="divide 256"):
        masks.intervals(step)


# The reference


@pytest.mark.parametrize("tracker", TRACKERS)
def test_reference_is_the_loop_of_opencv_s_sample(walk, tracker):
    frames, truth = walk
    left, top, right, bottom = window = (int(edge) for edge in pftrack.color.pixel_edges(truth[:1])[0])
    window = left, top, right - left, bottom - top
    expected, track = [], {"camshift": cv2.CamShift, "mean-shift": cv2.meanShift}[tracker]
    for frame in frames:
        hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
        admitted = cv2.inRange(hsv, (0, 64, 32), (180, 199, 255))  # inRange includes both ends
        if frame is frames[0]:
            hue, mask = hsv[top:bottom, left:right], admitted[top:bottom, left:right]
            histogram = cv2.calcHist([hue], [0], mask, [16], [0, 180])
            cv2.normalize(histogram, histogram, 0, 255, cv2.NORM_MINMAX)
            continue
        probability = cv2.calcBackProject([hsv], [0], histogram, [0, 180], 1) & admitted
        window = track(probability, window, (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 1))[1]
        expected.append(window)
    windows, _ = masks.run_mask(frames, truth[0], [64, 200, 32, 256], tracker)
    np.testing.assert_array_equal(windows[0], truth[0])
    np.testing.assert_array_equal(windows[1:], expected)


def test_mean_shift_reference_is_the_tracker_of_the_library(walk):
    frames, truth = walk
    windows, _ = masks.run_mask(frames[:20], truth[0], [64, 256, 32, 256], "mean-shift")
    tracker = pftrack.MeanShiftTracker(saturation=(64, 255), value=(32, 255))
    np.testing.assert_array_equal(windows, pftrack.track(tracker, frames[:20], truth[0]))


@pytest.fixture
def unseen():
    """A black target before a picture full of colours, and a mask that admits the colours but not the target."""
    frames = noise(np.random.default_rng(16), 6, 60, 80)
    frames[0, 20:32, 30:40] = 0
    return frames, np.tile([30.0, 20, 10, 12], (6, 1)), [64, 256, 32, 256]


def test_camshift_that_sees_nothing_grows_by_10_a_side_until_it_is_the_image(unseen):
    frames, truth, mask = unseen
    expected = [[30, 20, 10, 12], [20, 10, 30, 32], [10, 0, 50, 52], [0, 0, 70, 60], [0, 0, 80, 60], [0, 0, 80, 60]]
    np.testing.assert_array_equal(masks.run_mask(frames, truth[0], mask)[0], expected)
    np.testing.assert_array_equal(followed(frames, truth, np.array([mask]), "camshift")[0], [expected])


def test_mean_shift_that_sees_nothing_stays(unseen):
    frames, truth, mask = unseen
    windows, iterations = followed(frames, truth, np.array([mask]), "mean-shift")
    np.testing.assert_array_equal(windows, [truth])
    assert not iterations.any()


def test_reference_leaves_the_settings_of_opencv_alone():
    cv2.ipp.setUseIPP(True)
    before = cv2.ipp.useIPP()
    masks.run_mask(*scene(0, noise), [0, 256, 0, 256])
    assert cv2.ipp.useIPP() == before


# The compiled search goes through the same windows


@pytest.mark.parametrize("tracker", TRACKERS)
@pytest.mark.parametrize("kind", [noise, drift, discs, sparks])
def test_windows_and_iterations_are_opencv_s_on_made_up_scenes(tracker, kind):
    for seed in range(30):
        frames, box = scene(seed, kind)
        assert_same_as_opencv(frames, np.tile(box, (6, 1)), some_masks(seed, 4), tracker)


@pytest.mark.parametrize("tracker", TRACKERS)
def test_windows_and_iterations_are_opencv_s_over_many_frames(walk, tracker):
    assert_same_as_opencv(*walk, some_masks(1, 12), tracker)


@pytest.mark.parametrize("tracker", TRACKERS)
def test_windows_and_iterations_are_opencv_s_on_footage(footage, tracker):
    sequence = footage("bobot-I")
    assert_same_as_opencv(list(sequence.frames[:70]), sequence.boxes[:70], some_masks(2, 12), tracker)


@pytest.mark.parametrize("corner", [(0, 0), (0, 56), (62, 0), (62, 56)])
@pytest.mark.parametrize("tracker", TRACKERS)
def test_windows_in_a_corner_are_opencv_s(tracker, corner):
    rng = np.random.default_rng(3)
    frames = drift(rng, 8, 80, 90)
    assert_same_as_opencv(frames, np.tile([*corner, 28.0, 24], (8, 1)), some_masks(3, 8), tracker)


@pytest.mark.parametrize("tracker", TRACKERS)
def test_climbs_too_long_for_one_frame_are_opencv_s(tracker):
    frame = np.zeros((200, 360, 3), dtype=np.uint8)
    rows, columns = np.indices((200, 360))
    frame[rows < 2 * np.exp(columns / 75)] = (255, 0, 0)  # a slope that is equally steep, in proportion, all the way
    frames, truth = [frame] * 6, np.tile([0.0, 0, 60, 200], (6, 1))
    assert_same_as_opencv(frames, truth, some_masks(4, 3), tracker)
    _, iterations = followed(frames, truth, np.array([[64, 256, 32, 256]]), "mean-shift")
    assert iterations[0, 1] == 10
    assert iterations[0].max() == 10


# The search


@pytest.mark.parametrize("tracker", TRACKERS)
def test_search_ranks_as_opencv_one_mask_at_a_time(walk, small_blocks, tracker):
    chosen = some_masks(5, 12)
    chosen = np.vstack([chosen, chosen[::2]])  # equals, of which the earlier go first
    order, scores = ranked(*walk, chosen, tracker)
    found = masks.search(*walk, tracker=tracker, masks=chosen, n_best=len(chosen) + 5)
    np.testing.assert_array_equal(found.masks, chosen[order])
    np.testing.assert_array_equal(np.column_stack([found.overlap_mean, found.hit_ratio]), scores)
    assert found.n_completed == len(chosen)


@pytest.mark.parametrize("tracker", TRACKERS)
def test_giving_masks_up_early_changes_no_result(walk, small_blocks, tracker):
    chosen = some_masks(6, 60)
    whole = masks.search(*walk, tracker=tracker, masks=chosen, n_best=len(chosen))
    for n_best in (1, 3, 10):
        found = masks.search(*walk, tracker=tracker, masks=chosen, n_best=n_best)
        np.testing.assert_array_equal(found.masks, whole.masks[:n_best])
        np.testing.assert_array_equal(found.overlaps, whole.overlaps[:n_best])
        np.testing.assert_array_equal(found.iterations, whole.iterations[:n_best])
        assert n_best <= found.n_completed < whole.n_completed


@pytest.mark.parametrize("tracker", TRACKERS)
def test_no_window_overlaps_more_than_is_held_possible(tracker):
    rng = np.random.default_rng(17)
    truth = rng.uniform(0, 30, (1000, 4)) + [0, 0, 1, 1]
    truth[::10] = np.nan
    film = masks._Film(None, None, (0, 0, 12, 17), truth, tracker == "camshift")
    possible = masks._attainable(film)
    for shift in rng.uniform(-4, 4, (200, 2)):
        windows = np.hstack([truth[:, :2] + shift, np.tile([12, 17], (1000, 1))])
        assert (np.nan_to_num(metrics.overlap(windows, truth)) <= possible + 1e-12).all()
    centered = np.hstack([truth[:, :2] + truth[:, 2:] / 2 - [6, 8.5], np.tile([12, 17], (1000, 1))])
    reached = metrics.overlap(truth if tracker == "camshift" else centered, truth)
    np.testing.assert_allclose(possible, np.nan_to_num(reached), rtol=1e-12)


def test_a_mask_is_given_up_only_when_it_cannot_reach_the_floor(unseen):
    frames, truth, mask = unseen
    frames, truth = [frames[0]] * 80, np.tile(truth[0], (80, 1))  # a window that sees nothing stays where it should
    for n_hidden in (0, 1, 20):
        truth[70 - n_hidden : 70] = np.nan
        film, reached = masks._encode(frames, truth, False), 1 - n_hidden / 80
        assert masks._follow(film, np.array([mask]), reached)[2].all()
        assert not masks._follow(film, np.array([mask]), reached + 1e-6)[2].any()


def test_order_of_the_masks_changes_no_score(walk, small_blocks):
    chosen = np.unique(some_masks(7, 30), axis=0)
    one, other = (masks.search(*walk, masks=given, n_best=5) for given in (chosen, chosen[::-1]))
    np.testing.assert_array_equal(one.overlap_mean, other.overlap_mean)


def test_number_of_workers_changes_no_result():
    frames, box = scene(8, drift, n_frames=40)
    chosen = some_masks(8, 600)
    searches = [masks.search(frames, np.tile(box, (40, 1)), masks=chosen, n_best=9, n_jobs=n) for n in (1, 2)]
    assert_same_search(*searches)


def test_hidden_frames_count_as_nothing(walk):
    frames, truth = walk
    hidden = np.isnan(truth).any(axis=1)
    assert hidden.any()
    found = masks.search(frames, truth, masks=some_masks(9, 3), n_best=2)
    np.testing.assert_array_equal(np.isnan(found.overlaps), np.tile(hidden, (2, 1)))
    np.testing.assert_allclose(found.overlap_mean, np.nansum(found.overlaps, axis=1) / len(truth), rtol=1e-12)
    np.testing.assert_allclose(found.hit_ratio, (found.overlaps >= 1 / 3).sum(axis=1) / len(truth), rtol=1e-12)
    assert found.overlaps[:, 0] == pytest.approx(1.0)
    assert not found.iterations[:, 0].any()


def test_masks_that_are_one_tracker_are_followed_once():
    frames, box = scene(10, discs)  # two colours: black, and one in saturation cell 28 and value cell 31
    chosen = np.array([[224, 232, 0, 256], [0, 256, 0, 256], [8, 240, 16, 256], [0, 256, 0, 128], [0, 8, 0, 8]])
    film = masks._encode(frames, np.tile(box, (6, 1)), True)
    first, twin = masks._merge(film, chosen)
    for one in range(len(chosen)):
        same = [masks.run_mask(frames, box, chosen[index])[0] for index in (one, first[twin[one]])]
        np.testing.assert_array_equal(*same)
    assert len(first) < len(chosen)


def test_one_frame_is_enough():
    frames, box = scene(11, noise, n_frames=1)
    found = masks.search(frames, [box], masks=[[0, 256, 0, 256]])
    assert found.overlaps.shape == (1, 1)
    assert found.overlap_mean == pytest.approx(1.0)


def test_progress_is_shown_only_on_request(capsys):
    frames, box = scene(12, noise)
    for progress in (False, True):
        masks.search(frames, np.tile(box, (6, 1)), masks=[[0, 256, 0, 256]], progress=progress)
        assert ("1/1" in capsys.readouterr().err) == progress


# What is kept


@pytest.fixture
def scored(monkeypatch):
    """Numbers of the blocks that are really computed, in order; the list may be told to interrupt the work."""

    class Numbers(list):
        stop_before = np.inf

    numbers, score = Numbers(), masks._score

    def counted(number, *rest):
        if len(numbers) >= numbers.stop_before:
            raise KeyboardInterrupt
        numbers.append(number)
        return score(number, *rest)

    monkeypatch.setattr(masks, "_score", counted)
    return numbers


def test_interrupted_search_goes_on_where_it_stopped(walk, small_blocks, scored, tmp_path):
    frames, truth = walk[0][:20], walk[1][:20]
    chosen = np.unique(some_masks(13, 25), axis=0)
    whole = masks.search(frames, truth, masks=chosen, n_best=3)
    blocks = list(scored)

    scored.clear()
    scored.stop_before = 2
    with pytest.raises(KeyboardInterrupt):
        masks.search(frames, truth, masks=chosen, n_best=3, store=tmp_path / "new" / "store")
    scored.stop_before = np.inf
    resumed = masks.search(frames, truth, masks=chosen, n_best=3, store=tmp_path / "new" / "store")
    assert scored == blocks  # each of them once
    assert_same_search(resumed, whole)

    scored.clear()
    assert_same_search(masks.search(frames, truth, masks=chosen, n_best=3, store=tmp_path / "new" / "store"), whole)
    assert scored == []
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("change", ["film", "truth", "tracker", "n_best", "masks"])
def test_blocks_of_another_search_are_not_used(small_blocks, scored, tmp_path, change):
    frames, box = scene(14, noise)
    frames, truth, chosen = frames.copy(), np.tile(box, (6, 1)), np.unique(some_masks(14, 5), axis=0)
    settings = {"tracker": "camshift", "n_best": 2, "store": tmp_path}
    masks.search(frames, truth, masks=chosen, **settings)
    if change == "film":
        frames[3] = 255 - frames[3]
    elif change == "truth":
        truth[4] += 1
    elif change == "masks":
        chosen = chosen[::-1]
    else:
        settings[change] = {"tracker": "mean-shift", "n_best": 1}[change]
    scored.clear()
    found = masks.search(frames, truth, masks=chosen, **settings)
    assert scored
    assert_same_search(found, masks.search(frames, truth, masks=chosen, **{**settings, "store": None}))


# What is refused


@pytest.mark.parametrize(
    ("mask", "word"),
    [
        ([0, 256, 0], "s_low, s_high"),
        ([], "s_low, s_high"),
        ([0.5, 256, 0, 256], "whole numbers"),
        ([0, 256, 64, 64], "low < high"),
        ([128, 64, 0, 256], "low < high"),
        ([0, 264, 0, 256], "<= 256"),
        ([-8, 256, 0, 256], "0 <= low"),
        ([0, 255, 0, 256], "multiples of 8"),
    ],
)
def test_bad_masks_are_refused(mask, word):
    frames, box = scene(15, noise)
    with pytest.raises(ValueError, match=word):
        masks.search(frames, np.tile(box, (6, 1)), masks=[mask])
    with pytest.raises(ValueError, match=word):
        masks.run_mask(frames, box, mask)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"tracker": "color-pf"}, '"camshift" or "mean-shift"'),
        ({"n_best": 0}, "n_best must be at least 1"),
        ({"n_jobs": 0}, "n_jobs not 0"),
        ({"truth": np.zeros((6, 3))}, r"shape \(T, 4\)"),
        ({"truth": np.zeros((0, 4))}, r"shape \(T, 4\)"),
        ({"truth": np.full((6, 4), np.nan)}, "four finite numbers"),
        ({"truth": np.tile([1.0, 1, 9, 9], (5, 1))}, "equally long, got 6 and 5"),
        ({"frames": []}, "equally long, got 0 and 6"),
        ({"frames": np.zeros((6, 30, 30), np.uint8)}, "colour image"),
        ({"frames": [np.zeros((30 + t, 30, 3), np.uint8) for t in range(6)]}, "one size"),
    ],
)
def test_bad_input_is_refused(changes, word):
    given = {"frames": np.zeros((6, 30, 30, 3), np.uint8), "truth": np.tile([1.0, 1, 9, 9], (6, 1))} | changes
    with pytest.raises(ValueError, match=word):
        masks.search(**given, masks=[[0, 256, 0, 256]])


def test_library_starts_without_the_compiler():
    code = "import sys, pftrack; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
