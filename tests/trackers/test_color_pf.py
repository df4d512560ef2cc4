"""The colour particle filter, step by step against OpenCV's histograms and the equations as printed."""

import cv2
import numpy as np
import pytest

from pftrack import datasets, metrics, smc
from pftrack.trackers import ColorParticleFilter, track
from pftrack.trackers.color_pf import particle_boxes

BOX = (60.0, 40.0, 20.0, 50.0)
STILL = (0.0,) * 5


@pytest.fixture(scope="module")
def walk():
    """Frames and boxes of a scene without any difficulty."""
    scene = datasets.load("synthetic-walk")
    return list(scene.frames), scene.boxes


def picture(x: int = 60, y: int = 40, size=(160, 120)) -> np.ndarray:
    """A two-coloured target on a ground of noise."""
    frame = np.random.default_rng(7).integers(90, 140, (size[1], size[0], 3)).astype(np.uint8)
    frame[y : y + 25, x : x + 20] = (200, 40, 30)
    frame[y + 25 : y + 50, x : x + 20] = (30, 160, 40)
    return frame


def opencv_histogram(frame: np.ndarray, box) -> np.ndarray:
    """The 8x8x4 HSV histogram of a box inside the frame, by OpenCV."""
    left, top = np.rint(box[:2]).astype(int)
    right, bottom = np.rint(np.add(box[:2], box[2:])).astype(int)
    assert left >= 0
    assert top >= 0
    assert right <= frame.shape[1]
    assert bottom <= frame.shape[0]
    hsv = cv2.cvtColor(frame[top:bottom, left:right], cv2.COLOR_BGR2HSV)
    return cv2.calcHist([hsv], [0, 1, 2], None, [8, 8, 4], [0, 180, 0, 256, 0, 256])


def opencv_distance(frame: np.ndarray, box, target) -> float:
    return cv2.compareHist(opencv_histogram(frame, box), target, cv2.HISTCMP_BHATTACHARYYA)


def boxes_by_hand(particles) -> np.ndarray:
    """Equation 8: centre and scale of a rectangle that was 20 by 50 in the first frame."""
    x, y, _, _, k = np.asarray(particles).T
    return np.column_stack([x - 10 * k, y - 25 * k, 20 * k, 50 * k])


def likelihoods_by_hand(frame, particles, target, sigma) -> np.ndarray:
    """Equation 13 from OpenCV's distances."""
    distances = np.array([opencv_distance(frame, box, target) for box in boxes_by_hand(particles)])
    return np.exp(-(distances**2) / (2 * sigma**2)) / (sigma * np.sqrt(2 * np.pi))


def started(frame=None, **arguments) -> ColorParticleFilter:
    tracker = ColorParticleFilter(**arguments)
    tracker.init(picture() if frame is None else frame, BOX)
    return tracker


# ---------------------------------------------------------------------------------------------------------------------
# Start and motion
# ---------------------------------------------------------------------------------------------------------------------


def test_all_particles_begin_on_the_target_as_in_equation_8():
    tracker = ColorParticleFilter(n_particles=7)
    estimate = tracker.init(picture(), BOX)
    np.testing.assert_array_equal(estimate.particles, np.tile([70, 65, 0, 0, 1], (7, 1)))
    np.testing.assert_allclose(estimate.weights, np.full(7, 1 / 7))


def test_a_particle_stands_for_a_box_about_its_centre():
    boxes = particle_boxes([[70, 65, 3, -2, 1], [0, 0, 0, 0, 0.5]], size=(20, 50))
    np.testing.assert_array_equal(boxes, [[60, 40, 20, 50], [-5, -12.5, 10, 25]])


def test_without_noise_the_particles_stay_put():
    tracker = started(n_particles=20, noise=STILL)
    for _ in range(5):
        estimate = tracker.update(picture())
        np.testing.assert_array_equal(estimate.particles, np.tile([70, 65, 0, 0, 1], (20, 1)))
        np.testing.assert_allclose(estimate.box, BOX)
        assert estimate.score == pytest.approx(1)


def test_noise_is_in_units_of_the_targets_width_but_for_the_scale():
    noise, n_particles = (0.2, 0.1, 0.02, 0.03, 0.04), 4000
    estimate = started(n_particles=n_particles, noise=noise).update(picture())
    expected = np.array(noise) * [20, 20, 20, 20, 1]
    error = 5 / np.sqrt(2 * n_particles)  # five standard errors of a standard deviation
    np.testing.assert_allclose(estimate.particles.std(axis=0), expected, rtol=error)
    np.testing.assert_array_less(
        np.abs(estimate.particles.mean(axis=0) - [70, 65, 0, 0, 1]), 5 * expected / np.sqrt(n_particles)
    )
    correlation = np.corrcoef(estimate.particles.T) - np.eye(5)
    assert np.abs(correlation).max() < 5 / np.sqrt(n_particles)


def test_the_same_film_at_twice_the_resolution_gives_twice_the_boxes():
    small = [picture(60 + n, 40 + n) for n in range(5)]
    large = [cv2.resize(frame, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST) for frame in small]
    first = track(ColorParticleFilter(seed=3), small, BOX)
    second = track(ColorParticleFilter(seed=3), large, np.multiply(BOX, 2))
    np.testing.assert_allclose(second[1], 2 * first[1], atol=1)  # edges are rounded to finer pixels
    assert np.abs(second - 2 * first).max() < 8


@pytest.mark.parametrize("dt", [0.5, 1.0, 2.0])
def test_positions_advance_by_velocity_times_dt(dt):
    tracker = started(n_particles=30, noise=(0, 0, 0.05, 0.05, 0), dt=dt, resample_threshold=0)
    first, second = tracker.update(picture()), tracker.update(picture())
    np.testing.assert_array_equal(first.particles[:, :2], np.tile([70, 65], (30, 1)))
    np.testing.assert_allclose(second.particles[:, :2], [70, 65] + dt * first.particles[:, 2:4], rtol=1e-12)
    assert np.ptp(first.particles[:, 2]) > 1


def test_scales_are_kept_within_their_limits():
    tracker = started(n_particles=200, noise=(0, 0, 0, 0, 0.5), scale_limits=(0.8, 1.25))
    scales = tracker.update(picture()).particles[:, 4]
    assert scales.min() == 0.8
    assert scales.max() == 1.25
    assert ((scales > 0.8) & (scales < 1.25)).any()


# ---------------------------------------------------------------------------------------------------------------------
# Weights and estimate
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.05, 0.1, 0.3])
def test_weights_are_the_likelihoods_of_equation_13_by_opencvs_histograms(sigma):
    target = opencv_histogram(picture(), BOX)
    frame = picture(63, 41)
    estimate = started(n_particles=100, sigma=sigma).update(frame)
    expected = likelihoods_by_hand(frame, estimate.particles, target, sigma)
    np.testing.assert_allclose(estimate.weights, expected / expected.sum(), rtol=1e-3, atol=1e-9)
    assert np.ptp(estimate.weights) > 0.001


def test_weights_are_carried_over_when_there_was_no_resampling():
    target = opencv_histogram(picture(), BOX)
    tracker = started(n_particles=60, resample_threshold=0, sigma=0.2)
    product = np.ones(60)
    for shift in (1, 2, 3):
        frame = picture(60 + shift)
        estimate = tracker.update(frame)
        product *= likelihoods_by_hand(frame, estimate.particles, target, 0.2)
        np.testing.assert_allclose(estimate.weights, product / product.sum(), rtol=3e-3, atol=1e-9)


def test_weights_are_forgotten_after_resampling():
    target = opencv_histogram(picture(), BOX)
    tracker = started(n_particles=60, resample_threshold=1, sigma=0.2)
    for shift in (1, 2, 3):
        frame = picture(60 + shift)
        estimate = tracker.update(frame)
        expected = likelihoods_by_hand(frame, estimate.particles, target, 0.2)
        np.testing.assert_allclose(estimate.weights, expected / expected.sum(), rtol=1e-3, atol=1e-9)


def test_the_box_is_that_of_the_mean_state_of_equation_14():
    estimate = started(n_particles=80).update(picture(62))
    mean = estimate.weights @ estimate.particles
    np.testing.assert_allclose(estimate.box, boxes_by_hand([mean])[0], rtol=1e-12)


def test_the_score_is_one_minus_the_distance_at_the_mean_state():
    target = opencv_histogram(picture(), BOX)
    estimate = started(n_particles=80).update(picture(62))
    assert estimate.score == pytest.approx(1 - opencv_distance(picture(62), estimate.box, target), abs=1e-4)
    assert estimate.score < 0.999


def test_likelihoods_that_all_underflow_do_no_harm():
    estimate = started(n_particles=50, sigma=1e-3).update(picture(66, 45))
    assert np.isfinite(estimate.box).all()
    assert estimate.weights.sum() == pytest.approx(1)


# ---------------------------------------------------------------------------------------------------------------------
# Resampling
# ---------------------------------------------------------------------------------------------------------------------


def indicator(weights) -> float:
    """Equation 7."""
    return 1 / np.sum(weights**2) / len(weights)


@pytest.mark.parametrize("threshold", [0.2, 0.5, 0.8])
def test_resampling_happens_exactly_when_the_indicator_of_equation_7_is_below_the_threshold(monkeypatch, threshold):
    given = []

    def recorded(weights, rng):
        given.append(weights)
        return smc.systematic(weights, rng)

    monkeypatch.setitem(smc.RESAMPLERS, "recorded", recorded)
    tracker = started(n_particles=50, sigma=0.25, resample_threshold=threshold, resampler="recorded")
    n_resampled = 0
    for n in range(1, 21):
        given.clear()
        estimate = tracker.update(picture(60 + n))
        assert not estimate.lost
        assert len(given) == (indicator(estimate.weights) < threshold)
        if given:
            np.testing.assert_array_equal(given[0], estimate.weights)  # the estimate holds those before resampling
        n_resampled += len(given)
    assert 0 < n_resampled < 20


@pytest.mark.parametrize("resampler", ["multinomial", "stratified", "systematic", "residual"])
def test_the_threshold_is_sharp(resampler):
    """The indicator after one frame depends on the seed alone, so a threshold can be put on either side of it."""

    def second(threshold):
        tracker = started(n_particles=50, resample_threshold=threshold, resampler=resampler)
        first = tracker.update(picture(63))
        return indicator(first.weights), tracker.update(picture(64))

    measured, never = second(0)
    _, always = second(1)
    assert 0.01 < measured < 0.99
    assert not np.array_equal(never.particles, always.particles)
    for threshold, expected in ((measured * (1 - 1e-6), never), (measured * (1 + 1e-6), always)):
        _, estimate = second(threshold)
        np.testing.assert_array_equal(estimate.particles, expected.particles)
        np.testing.assert_array_equal(estimate.weights, expected.weights)


def test_resampled_particles_descend_from_the_ancestors_that_were_drawn(monkeypatch):
    ancestors = np.random.default_rng(0).integers(50, size=50)
    monkeypatch.setitem(smc.RESAMPLERS, "given", lambda weights, rng: ancestors)
    tracker = started(n_particles=50, resample_threshold=1, resampler="given", noise=(0.1, 0.1, 0.001, 0.001, 0.01))
    first, second = tracker.update(picture(61)), tracker.update(picture(62))
    expected = first.particles[ancestors]
    expected[:, :2] += expected[:, 2:4]
    step = np.abs(second.particles - expected)
    assert (step < 6 * np.array([0.1, 0.1, 0.001, 0.001, 0.01]) * [20, 20, 20, 20, 1]).all()
    assert step.max() > 0


# ---------------------------------------------------------------------------------------------------------------------
# Loss and re-initialisation
# ---------------------------------------------------------------------------------------------------------------------


def test_the_target_is_lost_exactly_when_the_distance_at_the_mean_exceeds_the_limit():
    distance = 1 - started().update(picture(63)).score
    for limit, lost in ((distance + 1e-9, False), (distance - 1e-9, True)):
        tracker = started(lost_distance=limit)
        estimate = tracker.update(picture(63))
        assert estimate.lost is lost
        spread = tracker.update(picture(63)).particles[:, :2].std(axis=0)
        assert (spread > 20).all() == (spread > 10).any() == lost


def test_the_target_is_lost_when_the_mean_state_leaves_the_image():
    frames = [picture(60 - 4 * n) for n in range(16)]  # at 0 in the end
    gone = np.random.default_rng(7).integers(90, 140, (120, 160, 3)).astype(np.uint8)
    tracker = started(lost_distance=1.0, n_particles=200, noise=(0.3, 0.1, 0.05, 0.01, 0.03))
    for frame in frames[1:]:
        estimate = tracker.update(frame)
        assert not estimate.lost
    for _ in range(40):
        estimate = tracker.update(gone)
        x = estimate.box[0] + estimate.box[2] / 2
        y = estimate.box[1] + estimate.box[3] / 2
        assert estimate.lost == (not (0 <= x < 160 and 0 <= y < 120))
        if estimate.lost:
            return
    pytest.fail("the mean state never left the image")


def redrawn(**arguments):
    """What a filter without noise holds after it lost its target: one step of motion after the draw."""
    tracker = started(noise=STILL, **arguments)
    nothing = np.zeros((120, 160, 3), np.uint8)
    assert tracker.update(nothing).lost
    estimate = tracker.update(nothing)
    states = estimate.particles.copy()
    states[:, :2] -= states[:, 2:4]
    return states, estimate.weights


def test_reinitialisation_draws_uniformly_from_the_ranges_of_equation_15():
    n_particles = 4000
    states, weights = redrawn(n_particles=n_particles)
    low, high = np.array([0, 0, -0.05, -0.05, 1]), np.array([160, 120, 0.05, 0.05, 2])
    span, rounding = high - low, 1e-9
    assert states.shape == (n_particles, 5)
    assert ((states >= low - rounding) & (states <= high + rounding)).all()
    np.testing.assert_array_less(states.min(axis=0), low + span * 20 / n_particles)
    np.testing.assert_array_less(high - span * 20 / n_particles, states.max(axis=0))
    standardised = (states.mean(axis=0) - (low + high) / 2) / (span / np.sqrt(12 * n_particles))
    assert np.abs(standardised).max() < 5
    np.testing.assert_allclose(states.std(axis=0), span / np.sqrt(12), rtol=5 / np.sqrt(n_particles))
    correlation = np.corrcoef(states.T) - np.eye(5)
    assert np.abs(correlation).max() < 5 / np.sqrt(n_particles)
    np.testing.assert_allclose(weights, 1 / n_particles)  # nothing is to be seen that could tell them apart


def test_reinitialisation_takes_its_scales_from_scale_range():
    states, _ = redrawn(n_particles=500, scale_range=(0.5, 0.75))
    assert states[:, 4].min() >= 0.5
    assert states[:, 4].max() <= 0.75
    assert np.ptp(states[:, 4]) > 0.2


def test_a_target_that_comes_back_elsewhere_is_found_again():
    tracker = started(n_particles=1000)
    for _ in range(3):
        assert tracker.update(np.zeros((120, 160, 3), np.uint8)).lost
    for _ in range(12):
        estimate = tracker.update(picture(110, 60))
    assert not estimate.lost
    np.testing.assert_allclose(estimate.box[:2] + estimate.box[2:] / 2, (120, 85), atol=8)


def test_pixels_outside_count_as_told():
    """Half of the rectangle lies outside: only "ignore" calls the half that can be seen a perfect match."""
    frame = picture(0)
    scores = {}
    for outside in ("mismatch", "ignore"):
        tracker = ColorParticleFilter(n_particles=10, noise=STILL, outside=outside)
        tracker.init(frame, (-20, 40, 40, 50))
        scores[outside] = tracker.update(frame).score
    assert scores["ignore"] == pytest.approx(1, abs=1e-6)
    assert scores["mismatch"] == pytest.approx(1 - np.sqrt(1 - np.sqrt(0.5)), abs=1e-6)


# ---------------------------------------------------------------------------------------------------------------------
# Seeds and accuracy
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_target_without_clutter_is_followed_to_within_two_pixels(walk, seed):
    frames, truth = walk
    boxes = track(ColorParticleFilter(n_particles=500, seed=seed), frames, truth[0])
    assert metrics.center_error(boxes, truth).mean() < 2


def test_a_seed_gives_the_same_boxes_to_the_bit_and_another_gives_others(walk):
    frames, truth = walk
    tracker = ColorParticleFilter(n_particles=30, seed=4)
    first = track(tracker, frames[:30], truth[0])
    np.testing.assert_array_equal(first, track(ColorParticleFilter(n_particles=30, seed=4), frames[:30], truth[0]))
    np.testing.assert_array_equal(first, track(tracker, frames[:30], truth[0]))  # the same object, started again
    assert not np.array_equal(first[1], track(ColorParticleFilter(n_particles=30, seed=5), frames[:30], truth[0])[1])


def test_a_generator_is_used_as_it_is(walk):
    frames, truth = walk
    generator = np.random.default_rng(4)
    tracker = ColorParticleFilter(n_particles=30, seed=generator)
    first = track(tracker, frames[:5], truth[0])
    np.testing.assert_array_equal(first, track(ColorParticleFilter(n_particles=30, seed=4), frames[:5], truth[0]))
    assert not np.array_equal(first, track(tracker, frames[:5], truth[0]))


def test_the_global_random_state_is_neither_read_nor_moved(walk):
    frames, truth = walk
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    track(ColorParticleFilter(n_particles=10), frames[:3], truth[0])
    np.testing.assert_array_equal(np.random.get_state()[1], state)  # noqa: NPY002


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_bobot_i_is_followed_as_well_as_the_paper_says(footage, seed):
    """Owczarek et al. 2015, Table II: overlap 0.62 and hit ratio 0.87, hidden frames counted as misses."""
    sequence = footage("bobot-I")
    score = metrics.single_target(
        track(ColorParticleFilter(n_particles=100, seed=seed), sequence.frames, sequence.boxes[0]), sequence.boxes
    )
    assert score.n_frames == 1017
    assert score.n_hidden == 23
    assert score.overlap_all >= 0.62
    assert score.hit_ratio_all >= 0.87


# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------

NAN, INFINITE = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        ({"n_particles": 0}, "n_particles must be at least 1, got 0"),
        ({"n_particles": -5}, "n_particles must be at least 1, got -5"),
        ({"sigma": 0.0}, "sigma must be positive, got 0.0"),
        ({"sigma": -0.1}, "sigma must be positive"),
        ({"sigma": NAN}, "sigma must be positive, got nan"),
        ({"noise": (0.1,) * 4}, "noise must be five standard deviations"),
        ({"noise": 0.1}, "noise must be five standard deviations"),
        ({"noise": (0.1, 0.1, 0.1, 0.1, -0.1)}, "noise must be five standard deviations, none negative"),
        ({"noise": (0.1, 0.1, 0.1, NAN, 0.1)}, "noise must be five standard deviations, none negative or NaN"),
        ({"noise": (0.1, 0.1, 0.1, INFINITE, 0.1)}, "noise"),
        ({"dt": NAN}, "dt"),
        ({"dt": INFINITE}, "dt"),
        ({"resample_threshold": -0.1}, "resample_threshold and lost_distance must lie between 0 and 1"),
        ({"resample_threshold": 1.1}, "resample_threshold and lost_distance must lie between 0 and 1"),
        ({"resample_threshold": NAN}, "resample_threshold and lost_distance must lie between 0 and 1"),
        ({"lost_distance": -0.1}, "resample_threshold and lost_distance must lie between 0 and 1"),
        ({"lost_distance": 1.1}, "resample_threshold and lost_distance must lie between 0 and 1"),
        ({"lost_distance": NAN}, "resample_threshold and lost_distance must lie between 0 and 1"),
        ({"scale_range": (2.0, 1.0)}, "scale_range must be an interval above 0"),
        ({"scale_range": (0.0, 1.0)}, "scale_range must be an interval above 0"),
        ({"scale_range": (1.0, NAN)}, "scale_range must be an interval above 0"),
        ({"scale_range": (1.0, INFINITE)}, "scale_range"),
        ({"scale_limits": (5.0, 0.2)}, "scale_limits must be an interval above 0"),
        ({"scale_limits": (0.0, 5.0)}, "scale_limits must be an interval above 0"),
        ({"scale_limits": (NAN, 5.0)}, "scale_limits must be an interval above 0"),
        ({"outside": "wrap"}, 'outside must be "mismatch" or "ignore", got \'wrap\''),
        ({"resampler": "roulette"}, "unknown resampler 'roulette'; choose one of multinomial, .*residual"),
        ({"seed": -1}, "seed"),
    ],
    ids=str,
)
def test_an_argument_out_of_its_range_is_refused_at_once(arguments, hint):
    with pytest.raises(ValueError, match=hint):
        ColorParticleFilter(**arguments)


def test_the_arguments_at_the_ends_of_their_ranges_are_taken():
    for arguments in (
        {"n_particles": 1},
        {"resample_threshold": 0, "lost_distance": 0},
        {"resample_threshold": 1, "lost_distance": 1},
        {"scale_range": (1, 1), "scale_limits": (1, 1)},
        {"noise": np.zeros(5)},
        {"dt": 0},
    ):
        assert np.isfinite(started(**arguments).update(picture(61)).box).all()
