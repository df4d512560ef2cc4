"""The bag-of-features filter against its equations by hand, on real people and on scenes with exact truth."""

import numpy as np
import pytest

from pftrack import BagOfFeaturesParticleFilter, codebook, datasets, metrics, multi, patches
from pftrack.multi import bag_of_features

LITERAL = {"n_bands": 1, "discriminative": False, "mutual_occlusion": False, "follow_camera": False}


@pytest.fixture(scope="module")
def corridor(footage):
    """The first frames of two people in a corridor, and their boxes (T, 2, 4)."""
    film = footage("bobot-J")
    frames = list(film.frames[:14])
    return frames, np.stack([film.target(1)[:14], film.target(2)[:14]], axis=1)


def started(corridor, n_training=5, **settings):
    frames, boxes = corridor
    tracker = BagOfFeaturesParticleFilter(seed=0, n_training=n_training, **settings)
    tracker.init(frames[:n_training], boxes[:n_training])
    return tracker


def run(tracker, frames):
    return multi.table(multi.follow(tracker, frames))


def errors(rows, boxes, first):
    return [
        np.linalg.norm((rows[rows[:, 1] == k][:, 2:4] + rows[rows[:, 1] == k][:, 4:6] / 2)
        - (boxes[first:, k - 1, :2] + boxes[first:, k - 1, 2:] / 2), axis=1).mean()
        for k in (1, 2)
    ]  # fmt: skip


def test_known_people_are_followed(corridor):
    rows = run(started(corridor), corridor[0][5:])
    assert max(errors(rows, corridor[1], 5)) < 8


def test_people_are_found_in_the_training_frames(corridor):
    frames, _ = corridor
    rows = run(BagOfFeaturesParticleFilter(n_particles=100, seed=0), frames[:10])
    assert set(rows[:, 0]) == set(range(4, 10))  # from the last training frame on
    pairs = metrics.match_targets(rows, datasets.load("bobot-J").tracks, frame=4)
    assert sorted(pairs) == [1, 2]
    assert len(np.unique(rows[:, 1])) == 2


def test_the_same_seed_gives_the_same_and_another_does_not(corridor):
    frames = corridor[0][5:8]
    a, b = (run(started(corridor, n_particles=60), frames) for _ in range(2))
    np.testing.assert_array_equal(a, b)
    other = BagOfFeaturesParticleFilter(60, seed=1)
    other.init(corridor[0][:5], corridor[1][:5])
    assert not np.array_equal(run(other, frames), a)
    generators = [BagOfFeaturesParticleFilter(60, seed=np.random.default_rng(3)) for _ in range(2)]
    for tracker in generators:
        tracker.init(corridor[0][:5], corridor[1][:5])
    np.testing.assert_array_equal(run(generators[0], frames), run(generators[1], frames))


def test_a_target_does_not_depend_on_who_else_is_followed(corridor):
    """To the letter, every target has a filter of its own."""
    frames, boxes = corridor
    both, alone = started(corridor, **LITERAL, n_particles=60), BagOfFeaturesParticleFilter(60, seed=0, **LITERAL)
    alone.init(frames[:5], boxes[:5, :1])
    a, b = run(both, frames[5:9]), run(alone, frames[5:9])
    np.testing.assert_array_equal(a[a[:, 1] == 1], b)


@pytest.mark.parametrize("literal", [True, False])
def test_weights_are_those_of_the_equations(corridor, literal):
    settings = LITERAL if literal else {"mutual_occlusion": False, "follow_camera": False}
    tracker = started(corridor, n_particles=40, learn="nothing", **settings)
    track = tracker.update(corridor[0][5])[0]
    target = tracker._targets[0]
    x, y, w, h = track.particles.T
    boxes = np.column_stack([x - w / 2, y - h / 2, w, h])
    similarities = []
    for kind, words, template, worth, bandwidth in zip(
        target.found, target.codebooks, target.templates, target.worth, tracker.bandwidths, strict=True
    ):
        nearest = codebook.nearest_words(kind.features, words)
        near = np.linalg.norm(kind.features - words[nearest], axis=1) <= 1.5 * bandwidth
        total = np.zeros(len(boxes))
        for band in range(tracker.n_bands):
            part = boxes * [1, 1, 1, 1 / tracker.n_bands]
            part[:, 1] += band * part[:, 3]
            covered = patches.coverage(part, kind.edges)[:, 0]
            for n in range(len(boxes)):
                bag = np.zeros(len(words))
                np.add.at(bag, nearest[near], (covered[n] * kind.areas)[near])
                bag /= covered[n] @ kind.areas
                total[n] += (worth * np.minimum(bag, template[band])).sum() / (worth * template[band]).sum()
        similarities.append(total / tracker.n_bands)
    likelihoods = np.exp(-((1 - np.array(similarities)) ** 2) / (2 * 0.2**2))  # Li et al. 2016, eq. 7
    spreads = np.ptp(likelihoods, axis=1)
    a = spreads[0] / spreads.sum()  # eq. 9
    assert track.color_weight == pytest.approx(a, rel=1e-3)
    mixture = a * likelihoods[0] + (1 - a) * likelihoods[1]
    np.testing.assert_allclose(track.weights, mixture / mixture.sum(), rtol=2e-3)
    assert track.score == pytest.approx(mixture.max(), rel=1e-3)
    center = track.weights @ track.particles
    np.testing.assert_allclose(track.box, [*center[:2] - center[2:] / 2, *center[2:]])


def test_the_worth_of_a_word_is_how_much_it_is_the_targets(corridor):
    tracker = started(corridor)
    target = tracker._targets[0]
    for feature in (0, 1):
        inside, everywhere = np.zeros(len(target.codebooks[feature])), np.zeros(len(target.codebooks[feature]))
        for found, box in target.training:
            kind = found[feature]
            nearest = codebook.nearest_words(kind.features, target.codebooks[feature])
            far = np.linalg.norm(kind.features - target.codebooks[feature][nearest], axis=1)
            for patch in np.flatnonzero(far <= 1.5 * tracker.bandwidths[feature]):
                covered = patches.coverage([box], kind.edges[patch : patch + 1])[0, 0, 0]
                inside[nearest[patch]] += covered * kind.areas[patch]
                everywhere[nearest[patch]] += kind.areas[patch]
        balance = (2 * inside - everywhere) / np.maximum(everywhere, 1e-9)  # Li et al. 2016, eq. 1
        np.testing.assert_allclose(target.worth[feature], np.maximum(balance, 0), atol=1e-5)
    assert all((worth == 1).all() for worth in started(corridor, discriminative=False)._targets[0].worth)


def test_one_feature_alone_and_fixed_weights(corridor):
    frame = corridor[0][5]
    for settings, weight in [({"features": "color"}, 1), ({"features": "texture"}, 0), ({"adapt_weights": False}, 0.5)]:
        (track, _) = started(corridor, n_particles=20, **settings).update(frame)
        assert track.color_weight == weight
        assert np.isfinite(track.weights).all()


def test_a_hidden_target_is_held_while_its_particles_go_on(corridor):
    frames, boxes = corridor
    tracker = started(corridor, follow_camera=False, n_particles=80)
    seen = tracker.update(frames[5])[0]
    dark = np.full_like(frames[6], (0, 255, 0))
    spreads = []
    for _ in range(6):
        track = tracker.update(dark)[0]
        assert track.held
        np.testing.assert_array_equal(track.box, seen.box)
        spreads.append(track.particles[:, 0].std())
    step = 0.1 * seen.box[3]
    steps = np.sqrt(spreads[0] ** 2 + step**2 * np.arange(6))  # a random walk
    np.testing.assert_allclose(spreads, steps, rtol=0.25)
    again = [tracker.update(frame)[0] for frame in frames[6:9]]
    assert not again[-1].held
    assert metrics.center_error([again[-1].box], boxes[8:9, 0])[0] < 12


def test_people_who_cross_keep_their_names():
    """Two walkers of a scene with exact truth; the farther one is held while it is hidden."""
    scene = datasets.load("synthetic-crossing")
    truth = np.stack([scene.target(1), scene.target(2)], axis=1)
    tracker = BagOfFeaturesParticleFilter(n_particles=150, seed=0)
    tracker.init(list(scene.frames[:5]), truth[:5])
    tracks = list(multi.follow(tracker, scene.frames[5:]))
    for k in (0, 1):
        assert np.max(metrics.center_error([found[k].box for found in tracks], truth[5:, k])) < 10
    feet = truth[5, :, 1] + truth[5, :, 3]
    far = feet.argmin()
    held = np.array([found[far].held for found in tracks])
    covered = metrics.overlap(truth[5:, far], truth[5:, 1 - far]) > 0
    assert held.any()
    assert not held[~covered].any()
    assert not any(found[1 - far].held for found in tracks)


@pytest.mark.parametrize("learn", ["bags", "codebook", "nothing"])
def test_what_is_learnt(corridor, learn):
    tracker = started(corridor, n_particles=40, learn=learn, update_every=2)
    target = tracker._targets[0]
    words, templates = [len(book) for book in target.codebooks], [each.copy() for each in target.templates]
    for frame in corridor[0][5:9]:
        tracker.update(frame)
    grown = [len(book) for book in target.codebooks]
    assert (grown == words) == (learn != "codebook")
    if learn == "nothing":
        np.testing.assert_array_equal(target.templates[0], templates[0])
    if learn == "bags":
        assert 0 < np.abs(target.templates[0] - templates[0]).max() < 0.2
        assert len(target.recent) == 2


# ---------------------------------------------------------------------------------------------------------------------
# What comes from outside
# ---------------------------------------------------------------------------------------------------------------------


def test_while_nobody_is_found_it_goes_on_looking(corridor):
    frames, boxes = corridor
    tracker = BagOfFeaturesParticleFilter(n_particles=20, seed=0, n_training=3)
    assert all(tracker.update(frame, np.empty((0, 5))) == [] for frame in frames[:6])
    for t in range(6, 9):
        tracks = tracker.update(frames[t], np.column_stack([boxes[t], [1.0, 0.5]]))
    assert [track.id for track in tracks] == [1, 2]


def test_a_target_half_outside_is_followed_to_the_border():
    frames = []
    rng = np.random.default_rng(0)
    ground = rng.integers(60, 200, (120, 160, 3), dtype=np.uint8)
    body = rng.integers(0, 60, (60, 24, 3), dtype=np.uint8)
    for t in range(14):
        frame = ground.copy()
        x = 6 - 2 * t
        frame[30:90, max(x, 0) : x + 24] = body[:, max(-x, 0) :]
        frames.append(frame)
    boxes = np.array([[[6 - 2 * t, 30, 24, 60]] for t in range(5)], dtype=float)
    tracker = BagOfFeaturesParticleFilter(n_particles=60, seed=0, follow_camera=False)
    tracker.init(frames[:5], boxes)
    for frame in frames[5:]:
        (track,) = tracker.update(frame)
        assert np.isfinite(track.box).all()


def test_a_target_too_small_for_texture_is_followed_by_colour():
    frame = np.full((60, 80, 3), (60, 160, 60), np.uint8)
    frame[20:30, 30:35] = (255, 0, 0)
    tracker = BagOfFeaturesParticleFilter(n_particles=200, seed=0, n_training=1, follow_camera=False)
    tracker.init([frame], [[[30, 20, 5, 10]]])
    (track,) = tracker.update(np.roll(frame, 1, axis=1))
    assert metrics.center_error([track.box], [[31, 20, 5, 10]])[0] < 1.5


def test_two_detections_on_one_person_are_one_target(corridor):
    frames, boxes = corridor
    tracker = BagOfFeaturesParticleFilter(n_particles=20, seed=0, n_training=2)
    for t in range(2):
        twice = np.vstack([boxes[t, 0], boxes[t, 0] + [2, 1, 0, 0]])
        tracks = tracker.update(frames[t], np.column_stack([twice, [1.0, 0.7]]))
    assert len(tracks) == 1


def test_a_detection_beyond_the_border_is_no_target(corridor):
    frames, _ = corridor
    tracker = BagOfFeaturesParticleFilter(n_particles=20, seed=0, n_training=1)
    assert tracker.update(frames[0], [[400, 20, 30, 80, 1.0]]) == []


def test_what_cannot_be_learnt_from_is_refused(corridor):
    frames, boxes = corridor
    tracker = BagOfFeaturesParticleFilter()
    for some_frames, some_boxes in [([], np.empty((0, 1, 4))), (frames[:2], boxes[:1]), (frames[:1], boxes[:1, 0])]:
        with pytest.raises(ValueError, match="need training frames and boxes"):
            tracker.init(some_frames, some_boxes)
    with pytest.raises(ValueError, match="hidden in all training frames"):
        tracker.init(frames[:1], np.full((1, 1, 4), np.nan))
    with pytest.raises(ValueError, match="outside"):
        tracker.init(frames[:1], [[[900, 0, 20, 40]]])
    with pytest.raises(ValueError, match="one size"):
        tracker.init([frames[0], frames[1][:100]], boxes[:2])
    with pytest.raises(ValueError, match="colour image"):
        tracker.update(np.zeros((4, 4)))
    started(corridor, n_particles=5)
    with pytest.raises(ValueError, match="one size"):
        started(corridor, n_particles=5).update(frames[5][:100])


@pytest.mark.parametrize(
    "settings",
    [
        {"n_particles": 0}, {"n_training": 0}, {"n_bands": 0}, {"seed": -1}, {"noise": (1, 1, 1)}, {"sigma": 0},
        {"noise": (-1, 1, 1, 1)}, {"bandwidths": (0.3, 0)}, {"occlusion_drop": 0}, {"forget": 1.2},
        {"features": "smell"}, {"learn": "everything"},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(ValueError, match=r"must|at least"):
        BagOfFeaturesParticleFilter(**settings)


@pytest.mark.parametrize("box", [[5, 5, 4, 4], [-30, -30, 20, 20], [70, 50, 40, 40], [0, 0, 80, 60]])
def test_a_region_lies_in_the_frame_and_is_never_empty(box):
    left, top, right, bottom = bag_of_features._region(np.array([box], float), (60, 80, 3))
    assert 0 <= left < right <= 80
    assert 0 <= top < bottom <= 60
    assert min(right - left, bottom - top) >= 20
