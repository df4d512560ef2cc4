"""The filter of Li et al. 2016 to the letter, against its equations by hand and in plain loops."""

import itertools

import numpy as np
import pytest

from pftrack import AssociationParticleFilter, codebook, color, superpixels, texture
from pftrack.multi import printed
from pftrack.multi.looks import Picture
from pftrack.multi.printed import PrintedTarget

PERSON = [60, 20, 20, 60]


def picture(*people, seed=0):
    """Red people on a grey wall with some grain; people is (x, y) of the corner of each."""
    frame = np.full((100, 160, 3), 150)
    for x, y in people:
        frame[max(y, 0) : y + 60, max(x, 0) : x + 20] = (30, 30, 190)
    grain = np.random.default_rng(seed).integers(-6, 7, frame.shape)
    return (frame + grain).clip(0, 255).astype(np.uint8)


def someone(n_particles=50, seed=0, n_training=2, **settings):
    """A person of two pictures."""
    settings = AssociationParticleFilter(n_particles, seed=seed, as_printed=True, **settings)
    frames = [picture((60, 20), seed=t) for t in range(n_training)]
    return PrintedTarget(1, [PERSON] * n_training, frames, settings, np.random.default_rng(seed))


# ---------------------------------------------------------------------------------------------------------------------
# The equations
# ---------------------------------------------------------------------------------------------------------------------


def test_similarity_by_hand():
    np.testing.assert_allclose(
        printed.similarities([0, 0.02, 0.08], sigma=0.1), [1, 0.367879441171, 0.0183156388887]
    )  # 1, 1/e, 1/e^4


def test_weights_of_features_by_hand():
    """Colour tells more of the first observation, texture of the second, and neither anything of the third."""
    of_color = [[0.1, 0.4, 0.9], [0.5, 0.4, 0.5], [0.3, 0.3, 0.3]]
    of_texture = [[0.2, 0.3, 0.4], [0.8, 0.2, 0.5], [0.9, 0.9, 0.9]]
    weights = printed.feature_weights([of_color, of_texture])
    np.testing.assert_allclose(weights, [[0.8 / 1.0, 0.1 / 0.7, 0.5], [0.2 / 1.0, 0.6 / 0.7, 0.5]])
    found = printed.feature_weights(np.random.default_rng(0).random((2, 5, 7)))
    np.testing.assert_allclose(found.sum(axis=0), 1)
    np.testing.assert_array_equal(printed.feature_weights([[0.4], [0.9]]), 0.5)  # one particle tells nothing


def by_loop(frame, boxes):
    """Histograms of colour and of patterns of whole boxes, pixel by pixel."""
    found = []
    for bins in (np.minimum(color.hsv_bins(frame), 254), texture.pattern_bins(frame)):
        of_one = []
        for x, y, w, h in boxes:
            left, top, right, bottom = (int(np.floor(edge + 0.5)) for edge in (x, y, x + w, y + h))
            pixels = [
                bins[v, u]
                for v in range(max(top, 0), min(bottom, frame.shape[0]))
                for u in range(max(left, 0), min(right, frame.shape[1]))
            ]
            of_one.append(np.bincount(pixels, minlength=256) / max(len(pixels), 1))
        found.append(of_one)
    return found


def test_the_incidence_matrix_is_that_of_a_plain_loop():
    target, frame = someone(20, sigma=(0.3, 0.1)), picture((64, 22), (120, 10), seed=7)
    rng = np.random.default_rng(1)
    target.states = np.array([70, 50, 20, 60]) + rng.normal(0, [8, 6, 1, 3], (20, 4))
    observations = np.array([[64, 22, 20, 60, 1.0], [118, 12, 22, 58, 0.5], [5, 70, 20, 60, 0.1]])
    column = target.associate(Picture(frame), observations)
    observed = by_loop(frame, observations[:, :4])
    of_particles = by_loop(frame, [[x - w / 2, y - h / 2, w, h] for x, y, w, h in target.states])
    for i in range(3):
        alike = np.zeros((2, 20))
        for f in range(2):
            for k in range(20):
                common = sum(min(p, q) for p, q in zip(observed[f][i], of_particles[f][k], strict=True))
                alike[f, k] = np.exp(-((1 - common) ** 2) / (2 * 0.3**2))  # the first sigma is that of both features
        spreads = alike.max(axis=1) - alike.min(axis=1)
        a = spreads[0] / spreads.sum()
        mixture = a * alike[0] + (1 - a) * alike[1]
        assert column[i] == pytest.approx(mixture.max())
        assert target.shares[0, i] == pytest.approx(a)
        np.testing.assert_allclose(target.likelihoods[i], mixture)
    assert np.ptp(target.likelihoods[0]) > 0.2
    assert target.associate(Picture(frame), np.empty((0, 5))).shape == (0,)


def test_particles_are_weighed_by_the_likeness_to_what_is_observed():
    target, frame = someone(30), picture((64, 22), seed=7)
    target.predict(np.zeros(2))
    moved = target.states.copy()
    observations = np.array([[5, 5, 20, 60, 1.0], [64, 22, 20, 60, 1.0]])
    target.associate(Picture(frame), observations)
    target.update(Picture(frame), observations[1])
    weights = target.likelihoods[1] / target.likelihoods[1].sum()
    np.testing.assert_allclose(target.track.weights, weights)
    np.testing.assert_array_equal(target.track.particles, moved)
    x, y, w, h = sum(weight * state for weight, state in zip(weights, moved, strict=True))
    np.testing.assert_allclose(target.track.box, [x - w / 2, y - h / 2, w, h])
    assert target.track.score == target.likelihoods[1].max()
    assert target.track.color_weight == target.shares[0, 1]
    assert not target.track.held
    counts = [(target.states == state).all(axis=1).sum() for state in moved]
    assert np.abs(counts - 30 * weights).max() < 1  # systematic resampling


def test_particles_move_by_random_perturbation_alone():
    target = someone(40_000)
    target.predict(np.array([9.0, 9.0]))  # of the camera nothing is printed
    np.testing.assert_allclose(target.states.mean(axis=0), [70, 50, 20, 60], atol=0.1)
    np.testing.assert_allclose(target.states.std(axis=0), np.array(target.NOISE) * [60, 60, 20, 60], rtol=0.02)
    target.states[:, 2:] = [[1.0, 1e5]]
    target.predict(np.zeros(2))
    np.testing.assert_allclose(target.states[:, 2:], np.tile([20 / 3, 3 * 60], (40_000, 1)), atol=1)


def test_what_is_not_observed_is_held_while_its_particles_go_on():
    target, spreads = someone(4000), []
    for n in range(1, 6):
        target.predict(np.zeros(2))
        target.update(Picture(picture()), None)
        assert target.n_absent == n
        assert target.track.held
        np.testing.assert_array_equal(target.track.box, PERSON)
        spreads.append(target.states[:, 0].std())
    np.testing.assert_allclose(spreads, 0.05 * 60 * np.sqrt(np.arange(1, 6)), rtol=0.05)  # a random walk
    observation = np.array([*PERSON, 1.0])
    target.associate(Picture(picture((60, 20))), observation[None])
    target.update(Picture(picture((60, 20))), observation)
    assert target.n_absent == 0


# ---------------------------------------------------------------------------------------------------------------------
# The confidence map
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("moved", [(0, 0), (5, -3), (-6, 4)])
@pytest.mark.parametrize("seed", [0, 1])
def test_who_has_moved_a_little_is_observed(moved, seed):
    """The centre of what is observed is on the person; of the rest of the box the letter says nothing."""
    x, y = np.add(PERSON[:2], moved).tolist()
    found = someone(seed=seed).observe(picture((x, y), seed=9))
    center = found[:2] + found[2:4] / 2
    assert (np.abs(center - [x + 10, y + 30]) <= [10.5, 30.5]).all()
    assert found[4] > 0.5


def test_where_all_is_background_nothing_is_observed():
    target = someone()
    known = len(target.known)
    assert target.observe(picture(seed=9)) is None
    assert len(target.known) == known  # and nothing learnt
    target.box = np.array([400.0, 20, 20, 60])
    assert target.observe(picture((60, 20))) is None


def test_prior_knowledge_is_of_the_latest_frames_and_clustered_now_and_then(monkeypatch):
    monkeypatch.setattr(printed, "CLUSTER_EVERY", 3)
    target, priors = someone(n_training=4), []
    for t in range(6):
        found = target.observe(picture((60, 20), seed=20 + t))
        priors.append(target.prior)
        assert len(target.known) == PrintedTarget.N_TRAINING == 5
        (inside, outside) = target.known[-1][1]
        region = superpixels.surroundings(PERSON, (100, 160, 3))
        assert (inside + outside).sum() == (region[2] - region[0]) * (region[3] - region[1])
        assert inside.sum() == pytest.approx(found[2] * found[3], rel=0.1)
    assert [a is b for a, b in itertools.pairwise(priors)] == [True, False, True, True, False]


# ---------------------------------------------------------------------------------------------------------------------
# The tracker
# ---------------------------------------------------------------------------------------------------------------------


def detection(x, y):
    return [x, y, 20, 60, 1.0]


@pytest.mark.parametrize("n_frames", [2, 3])
def test_training_birth_and_death(n_frames):
    """The first needs the five training frames, others `n_frames`; who is not observed in as many has gone."""
    tracker = AssociationParticleFilter(n_particles=40, seed=0, as_printed=True, n_frames=n_frames)
    numbers = []
    for t in range(6):
        tracks = tracker.update(picture((30, 20), seed=t), [detection(30, 20)])
        numbers.append([track.id for track in tracks])
    assert numbers == [[], [], [], [], [1], [1]]
    for t in range(6, 7 + n_frames):
        frame = picture((30, 20), (110, 25), seed=t)
        tracks = tracker.update(frame, [detection(30, 20), detection(110, 25)])
        numbers.append([track.id for track in tracks])
    assert numbers[6:] == [[1]] * (n_frames - 1) + [[1, 2]] * 2
    for n in range(1, n_frames):
        tracks = tracker.update(picture(seed=20 + n), [])
        assert [(track.id, track.held) for track in tracks] == [(1, True), (2, True)]
    assert tracker.update(picture(seed=30), []) == []
    again = [tracker.update(picture((110, 25), seed=40 + n), [detection(110, 25)]) for n in range(5)]
    assert [[track.id for track in tracks] for tracks in again] == [[]] * 4 + [[3]]  # no number is given twice


def test_a_known_person_is_observed_without_detections_and_detections_of_him_are_nobody_new():
    tracker = AssociationParticleFilter(n_particles=60, seed=0, as_printed=True)
    for t in range(5):
        tracker.update(picture((30, 20), seed=t), [detection(30, 20)])
    for t in range(5, 9):
        (track,) = tracker.update(picture((30 + 2 * (t - 4), 20), seed=t), [])
        assert tracker.incidence.shape == (1, 1)
        assert tracker.incidence > PrintedTarget.LEAST
        assert not track.held
    beside = [*(track.box + [1, 1, 0, 0]), 1.0]
    tracks = tracker.update(picture((38, 20)), [beside, detection(110, 20)])
    assert [each.id for each in tracks] == [1]
    assert tracker.incidence.shape == (2, 1)  # what is observed of him, and of the detections only the other


def test_fields_of_a_track():
    tracker = AssociationParticleFilter(n_particles=30, seed=0, as_printed=True)
    for t in range(6):
        tracks = tracker.update(picture((30, 20), seed=t), [detection(30, 20)])
    (track,) = tracks
    assert (track.box.shape, track.particles.shape, track.weights.shape) == ((4,), (30, 4), (30,))
    assert track.weights.sum() == pytest.approx(1)
    assert 0 <= track.color_weight <= 1
    assert 0 < track.score <= 1


def test_intersections_are_explicit_sums():
    """The one step of the matrix that is another module's."""
    p, q = np.random.default_rng(0).dirichlet(np.ones(59), size=2)
    assert codebook.intersection(p, q) == pytest.approx(sum(min(a, b) for a, b in zip(p, q, strict=True)))
