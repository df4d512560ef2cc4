"""The boosted particle filter against its equations by hand, and on scenes with exact truth."""

import colorsys
import math

import cv2
import numpy as np
import pytest

from pftrack import BoostedParticleFilter, adaboost, color, datasets, metrics, multi
from pftrack.multi import boosted

NOISE, SPREAD = np.array([1.0, 0.7, 0.1]), np.array([0.5, 0.5, 0.2])
CENTERS = np.array([[1.5, -0.5, 1.1], [-1.0, 0.8, 0.9]])


def truth_of(scene, t):
    """True boxes of a frame, as detections."""
    rows = scene.tracks[scene.tracks[:, 0] == t]
    return rows[:, 2:]


def run(tracker, scene, frames=None, every=1):
    """Follow a scene with its true boxes as detections in one of so many frames."""
    frames = range(len(scene.frames)) if frames is None else frames
    return [tracker.update(scene.frames[t], truth_of(scene, t) if t % every == 0 else []) for t in frames]


# ---------------------------------------------------------------------------------------------------------------------
# Colours
# ---------------------------------------------------------------------------------------------------------------------


def test_bins_are_those_of_a_plain_loop():
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    frame[:4] = rng.integers(0, 256, (4, 30, 1))  # grey
    frame[4:8] //= 6  # dark
    hsv = cv2.cvtColor(frame, cv2.COLOR_BGR2HSV)
    counts = np.zeros(110)
    for y in range(20):
        for x in range(30):
            h, s, v = hsv[y, x].astype(int)
            colored = s / 255 > 0.1 and v / 255 > 0.2
            counts[10 * (h * 10 // 180) + s * 10 // 256 if colored else 100 + v * 10 // 256] += 1
    found = color.histograms(boosted.color_bins(frame), [[0, 0, 30, 20]])[0]
    np.testing.assert_allclose(found[:110] * 600, counts)
    assert found[110:].sum() == 0
    assert counts[:100].sum() > 100
    assert counts[100:].sum() > 100


def test_hue_of_a_pixel_is_that_of_the_standard_library():
    b, g, r = 50, 90, 200
    h, s, _ = colorsys.rgb_to_hsv(r / 255, g / 255, b / 255)
    assert boosted.color_bins(np.uint8([[[b, g, r]]]))[0, 0] == 10 * int(10 * h) + int(10 * s)


def test_the_likelihood_is_that_of_both_halves():
    scene = datasets.load("synthetic-walk")
    tracker = BoostedParticleFilter(n_particles=30, seed=0, alpha=0)
    tracker.update(scene.frames[0], truth_of(scene, 0))
    (component,) = tracker._components
    (track,) = tracker.update(scene.frames[1], [])
    first, now = (boosted.color_bins(scene.frames[t]) for t in (0, 1))
    expected = []
    for x, y, w, h in track.particles:
        total = 0.0
        for half in range(2):
            template = color.histograms(first, boosted._halves([scene.target(1)[0]]))[half]
            seen = color.histograms(now, boosted._halves([[x - w / 2, y - h / 2, w, h]]))[half]
            total += 1 - np.sqrt(template * seen).sum()
        expected.append(math.exp(-20 * total))
    np.testing.assert_allclose(track.weights, expected / np.sum(expected), rtol=1e-4)
    assert track.score == pytest.approx(max(expected), rel=1e-4)
    x, y, w, h = track.weights @ track.particles
    np.testing.assert_allclose(track.box, [x - w / 2, y - h / 2, w, h])
    assert component.track is track


# ---------------------------------------------------------------------------------------------------------------------
# The proposal and the weights
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", [0.0, 0.3, 0.8])
def test_importance_weights_have_mean_one_and_a_bound(alpha):
    """For every previous state the mean of p/q under q is one: the integral of p."""
    predicted = np.tile([0.3, 0.2, 1.0], (200_000, 1))
    proposal = predicted, NOISE, CENTERS, SPREAD, alpha
    moved = boosted.propose(*proposal, np.random.default_rng(0))
    ratios = np.exp(boosted.log_importance(moved, *proposal))
    assert ratios.mean() == pytest.approx(1, abs=0.01)
    assert ratios.max() <= 1 / (1 - alpha) + 1e-9
    np.testing.assert_allclose(ratios @ moved / len(moved), predicted[0], atol=0.02)  # and the moments are those of p
    np.testing.assert_allclose((ratios @ (moved - predicted) ** 2) / len(moved), NOISE**2, rtol=0.03)


def test_the_ratio_is_that_of_the_densities():
    def density(x, mean, deviation):
        return np.exp(-0.5 * ((x - mean) / deviation) ** 2).prod(axis=1) / np.prod(deviation) / (2 * np.pi) ** 1.5

    rng = np.random.default_rng(1)
    states, predicted = rng.normal(size=(2, 50, 3))
    transition = density(states, predicted, NOISE)
    ada = np.mean([density(states, center, SPREAD) for center in CENTERS], axis=0)
    found = boosted.log_importance(states, predicted, NOISE, CENTERS, SPREAD, 0.4)
    np.testing.assert_allclose(np.exp(found), transition / (0.4 * ada + 0.6 * transition), rtol=1e-9)


@pytest.mark.parametrize("alpha", [0.0, 0.5, 0.9])
def test_the_posterior_does_not_depend_on_the_proposal(alpha):
    """A linear Gaussian step, whose posterior is known; without the division it would not come out."""
    noise, spread, sigma, y = np.array([1.0]), np.array([0.4]), 0.8, 1.0
    rng = np.random.default_rng(2)
    predicted = rng.normal(0.0, 0.6, (200_000, 1))
    proposal = predicted, noise, np.array([[2.0]]), spread, alpha
    moved = boosted.propose(*proposal, rng)
    log_likelihoods = -0.5 * ((y - moved[:, 0]) / sigma) ** 2
    grid = np.linspace(-8, 8, 4001)
    density = np.exp(-0.5 * grid**2 / (1 + 0.36) - 0.5 * ((y - grid) / sigma) ** 2)
    exact = (grid * density).sum() / density.sum()

    def mean(log_weights):
        return weighted_mean(moved[:, 0], log_weights)

    assert mean(log_likelihoods + boosted.log_importance(moved, *proposal)) == pytest.approx(exact, abs=0.01)
    if alpha:
        assert abs(mean(log_likelihoods) - exact) > 0.2


def weighted_mean(states, log_weights):
    weights = np.exp(log_weights - log_weights.max())
    return weights @ states / weights.sum()


def test_a_share_alpha_is_drawn_about_the_detections():
    moved = boosted.propose(np.zeros((20_000, 1)), np.ones(1), np.array([[50.0], [90.0]]), np.ones(1), 0.3,
                            np.random.default_rng(0))  # fmt: skip
    shares = [(np.abs(moved - center) < 10).mean() for center in (0, 50, 90)]
    np.testing.assert_allclose(shares, [0.7, 0.15, 0.15], atol=0.01)


def test_a_detection_far_away_changes_nothing():
    scene = datasets.load("synthetic-walk")
    plain, boosted_filter = (BoostedParticleFilter(30, seed=0, alpha=alpha) for alpha in (0.0, 0.5))
    for tracker in (plain, boosted_filter):
        tracker.update(scene.frames[0], truth_of(scene, 0))
    a = plain.update(scene.frames[1], [])[0]
    b = boosted_filter.update(scene.frames[1], [[250, 10, 20, 60, 1.0]])[0]
    np.testing.assert_array_equal(a.box, b.box)


def test_shares_follow_from_the_evidence():
    shares = np.exp(boosted.update_shares(np.log([0.2, 0.3, 0.5]), np.log([0.4, 0.1, 0.02])))
    np.testing.assert_allclose(shares, np.array([0.08, 0.03, 0.01]) / 0.12)
    far = boosted.update_shares([-2000.0, -2.0], [-3.0, -1.0])  # no share is ever lost to rounding
    assert np.isfinite(far).all()
    assert np.exp(far).sum() == pytest.approx(1)


def test_shares_of_a_tracker_are_those_of_its_likelihoods():
    scene = datasets.load("synthetic-crossing")
    tracker = BoostedParticleFilter(n_particles=40, seed=0, alpha=0)
    tracker.update(scene.frames[0], truth_of(scene, 0))
    assert tracker.shares == pytest.approx({1: 0.5, 2: 0.5})
    evidences = []
    bins = boosted.color_bins(scene.frames[1])
    tracks = tracker.update(scene.frames[1], [])
    for component, track in zip(tracker._components, tracks, strict=True):
        scales = track.particles[:, 2] / component.size[0]
        evidences.append(np.exp(component._log_likelihoods(bins, track.particles, scales)).sum())
    expected = np.array(evidences) / np.sum(evidences)
    assert list(tracker.shares.values()) == pytest.approx(expected.tolist())


def test_the_dynamics_are_second_order():
    scene = datasets.load("synthetic-walk")
    tracker = BoostedParticleFilter(n_particles=5, seed=0, inertia=(1.0, 0.5, 0.0))
    tracker.update(scene.frames[0], truth_of(scene, 0))
    (component,) = tracker._components
    step = component.states - component.previous
    np.testing.assert_allclose(component.predicted - component.states, step * [1.0, 0.5, 0.0])


# ---------------------------------------------------------------------------------------------------------------------
# Whole films
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("every", [1, 10])
def test_people_keep_their_names(every):
    scene = datasets.load("synthetic-crossing")
    tracks = run(BoostedParticleFilter(n_particles=150, seed=0), scene, every=every)
    for found in tracks:
        assert [track.id for track in found] == list(scene.ids)
        assert not any(track.held for track in found)
        assert all(0 <= track.score <= 1 for track in found)
    for k, id in enumerate(scene.ids):
        errors = metrics.center_error([found[k].box for found in tracks], scene.target(id))
        assert np.nanmean(errors) < 8


def test_the_scale_is_in_the_state():
    """It follows a target that grows, as far as its colours tell; a box inside it has nearly the same."""
    scene = datasets.load("synthetic-scale")
    first = scene.target(1)[0, 3]
    heights = {}
    for noise in (0.01, 1e-9):
        tracker = BoostedParticleFilter(n_particles=100, seed=0, noise=(0.03, 0.015, noise), alpha=0)
        heights[noise] = run(tracker, scene)[-1][0].box[3]
    assert scene.target(1)[-1, 3] > heights[0.01] > 1.1 * first
    assert heights[1e-9] == pytest.approx(first, rel=0.1)  # what remains is the noise of the detection


def test_who_enters_is_born_and_who_is_seen_no_more_dies():
    scene = datasets.load("synthetic-crossing")
    first, both = truth_of(scene, 0)[:1], truth_of(scene, 1)
    tracker = BoostedParticleFilter(n_particles=60, seed=0, patience=3)
    assert tracker.update(scene.frames[0], []) == []
    assert [track.id for track in tracker.update(scene.frames[0], first)] == [1]
    tracks = tracker.update(scene.frames[1], both)
    assert [track.id for track in tracks] == [1, 2]
    np.testing.assert_array_equal(tracks[1].box, both[1, :4])
    assert sum(tracker.shares.values()) == pytest.approx(1)
    for t in (2, 3):
        assert [track.id for track in tracker.update(scene.frames[t], truth_of(scene, t)[1:])] == [1, 2]
    assert [track.id for track in tracker.update(scene.frames[4], truth_of(scene, 4)[1:])] == [2]
    assert tracker.shares == pytest.approx({2: 1.0})
    assert [track.id for track in tracker.update(scene.frames[5], truth_of(scene, 5))] == [
        2,
        3,
    ]  # numbers are not reused


def test_two_detections_of_one_newcomer_are_one():
    scene = datasets.load("synthetic-walk")
    found = truth_of(scene, 0)
    twice = np.vstack([found, found + [2, 1, 0, 0, 0]])
    assert len(BoostedParticleFilter(n_particles=20, seed=0).update(scene.frames[0], twice)) == 1


def test_components_at_one_place_are_merged_and_the_elder_inherits():
    scene = datasets.load("synthetic-walk")
    tracker = BoostedParticleFilter(n_particles=80, seed=0, min_overlap=0.9, merge_overlap=0.5, alpha=0)
    box = truth_of(scene, 0)[0]
    assert len(tracker.update(scene.frames[0], [box])) == 1
    shifted = truth_of(scene, 1)[0] + [6, 0, 0, 0, 0]
    assert [track.id for track in tracker.update(scene.frames[1], [shifted])] == [1, 2]
    for t in range(2, 6):
        tracks = tracker.update(scene.frames[t], [])
    assert [track.id for track in tracks] == [1]
    assert tracker.shares == pytest.approx({1: 1.0})


def test_who_leaves_the_frame_is_given_up():
    frame = np.full((80, 120, 3), 90, np.uint8)
    tracker = BoostedParticleFilter(n_particles=30, seed=0, noise=(1e-3, 1e-3, 1e-3))
    tracker.update(frame, [[100, 20, 15, 40, 1.0]])
    (component,) = tracker._components
    component.predicted[:, 0] += 60
    assert tracker.update(frame, []) == []
    assert tracker.shares == {}


def test_the_same_seed_gives_the_same_and_another_does_not():
    scene = datasets.load("synthetic-crossing")

    def rows(seed, n=4):
        return multi.table(run(BoostedParticleFilter(n_particles=40, seed=seed), scene, range(n)))

    np.testing.assert_array_equal(rows(0), rows(0))
    assert not np.array_equal(rows(0), rows(1))
    np.testing.assert_array_equal(rows(np.random.default_rng(3)), rows(np.random.default_rng(3)))


def test_a_target_does_not_depend_on_who_else_is_followed():
    scene = datasets.load("synthetic-crossing")
    both, alone = (BoostedParticleFilter(n_particles=40, seed=0) for _ in range(2))
    for t in range(6):
        found = truth_of(scene, t)
        a, b = both.update(scene.frames[t], found)[0], alone.update(scene.frames[t], found[:1])[0]
        np.testing.assert_array_equal(a.box, b.box)


# ---------------------------------------------------------------------------------------------------------------------
# AdaBoost, and what comes from outside
# ---------------------------------------------------------------------------------------------------------------------


def test_adaboost_finds_people_who_face_the_camera(footage):
    film = footage("bobot-J")
    detector = adaboost.AdaBoostDetector()
    times = range(0, 160, 20)
    found = [[t, -1, *row] for t in times for row in detector.detect(film.frames[t])]
    score = metrics.detections(found, film.tracks[np.isin(film.tracks[:, 0], times)])
    assert score.recall > 0.5
    assert score.precision > 0.6
    assert (np.array(found)[:, 6] >= detector.min_windows).all()


def test_the_detector_is_asked_where_no_detections_are_given():
    class Everywhere:
        def detect(self, frame):
            return np.array([[10.0, 10, 12, 30, 1.0], [60.0, 10, 12, 30, 0.5]])

    frame = np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    assert isinstance(BoostedParticleFilter().detector, adaboost.AdaBoostDetector)
    assert BoostedParticleFilter().update(frame) == []
    assert len(BoostedParticleFilter(20, detector=Everywhere()).update(frame)) == 2


def test_a_detection_beyond_the_border_starts_nobody():
    frame = np.zeros((60, 90, 3), np.uint8)
    assert BoostedParticleFilter(10).update(frame, [[200, 20, 30, 80, 1.0]]) == []


def test_a_detection_half_beyond_the_border_starts_somebody():
    frame = np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    tracker = BoostedParticleFilter(20, seed=0)
    assert len(tracker.update(frame, [[-5, -45, 20, 60, 1.0]])) == 1
    assert all(np.isfinite(track.weights).all() for track in tracker.update(frame, []))


def test_detections_that_are_none_are_refused():
    with pytest.raises(ValueError, match="detections must be rows"):
        BoostedParticleFilter(10).update(np.zeros((60, 90, 3), np.uint8), [[1, 2, 3, 4]])


def test_frames_that_do_not_fit_are_refused():
    tracker = BoostedParticleFilter(10)
    with pytest.raises(ValueError, match="colour image"):
        tracker.update(np.zeros((4, 4)))
    tracker.update(np.zeros((60, 90, 3), np.uint8), [])
    with pytest.raises(ValueError, match="one size"):
        tracker.update(np.zeros((60, 80, 3), np.uint8), [])
    with pytest.raises(ValueError, match="colour image"):
        adaboost.AdaBoostDetector().detect(np.zeros((4, 4)))


@pytest.mark.parametrize(
    "settings",
    [
        {"n_particles": 0}, {"seed": -1}, {"alpha": 1.0}, {"alpha": -0.1}, {"noise": (0.1, 0.1)}, {"sharpness": 0},
        {"noise": (0.1, 0.1, 0)}, {"detection_noise": (0, 1, 1)}, {"inertia": (1, 1, 2)}, {"inertia": (1, np.nan, 1)},
        {"min_overlap": 0}, {"min_overlap": 1.1}, {"merge_overlap": 0}, {"patience": 0},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(ValueError, match=r"must|at least"):
        BoostedParticleFilter(**settings)


@pytest.mark.parametrize("settings", [{"scale": 0}, {"step": 1.0}, {"min_windows": 0}])
def test_settings_of_adaboost_out_of_range_are_refused(settings):
    with pytest.raises(ValueError, match="need a scale"):
        adaboost.AdaBoostDetector(**settings)
