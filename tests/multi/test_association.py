"""The association particle filter against a Kalman filter, brute force and scenes with exact truth."""

import copy
import functools
import itertools

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from pftrack import AssociationParticleFilter, datasets, metrics, multi
from pftrack.multi import association
from pftrack.multi.association import ADDITIONS
from pftrack.multi.looks import Looks, Picture

FLAT = np.full((240, 320, 3), 128, np.uint8)
"""Everything looks like everything here, so that only places and sizes tell."""


def without(*names):
    return set(ADDITIONS) - set(names)


def box(x, y=80.0, w=24.0, h=72.0, score=1.0):
    return [x, y, w, h, score]


def started(*people, n_particles=200, n_times=3, seed=0, frame=FLAT, **settings):
    """A tracker who knows people that have stood still for some frames; `people` are detections."""
    tracker = AssociationParticleFilter(n_particles, seed=seed, **settings)
    for _ in range(n_times):
        tracks = tracker.update(frame, people)
    assert [track.id for track in tracks] == list(range(1, len(people) + 1))
    return tracker


@functools.cache
def film(id):
    """A scene, whose truth takes longer than its tracking."""
    return datasets.load(id)


def truth_of(scene, t):
    return scene.tracks[scene.tracks[:, 0] == t][:, 2:]


def ids(tracks):
    return [track.id for track in tracks]


@pytest.fixture(scope="module")
def textured():
    """A picture in which no two places look alike."""
    rng = np.random.default_rng(0)
    blotches = np.kron(rng.integers(30, 220, (20, 27, 3)), np.ones((12, 12, 1), int))[:240, :320]
    return (blotches + rng.integers(-15, 16, blotches.shape)).astype(np.uint8)


# ---------------------------------------------------------------------------------------------------------------------
# The proposal: what is exact where everything is Gaussian
# ---------------------------------------------------------------------------------------------------------------------


def test_particles_at_one_place_are_drawn_from_the_product_of_motion_and_detection():
    (target,) = started(box(100), n_particles=30_000).targets
    target.box = np.array([98.0, 77, 20, 70])
    target.states[:] = [110, 116, 24, 72, 3.0, -1.0]
    x, y, w, h = 104.0, 82.0, 26.0, 75.0
    log_weights = target._draw(np.array([x, y, w, h, 1.0]))
    place, speed = 0.02 * 70, 0.015 * 70
    moving = np.array([place**2 + speed**2] * 2 + [0.02**2] * 2)
    detecting = np.array([(0.06 * 70) ** 2] * 2 + [0.1**2] * 2)
    prior, seen = np.array([110, 116, np.log(24), np.log(72)]), np.array([x + w / 2, y + h / 2, np.log(w), np.log(h)])
    variance = 1 / (1 / moving + 1 / detecting)
    mean = variance * (prior / moving + seen / detecting)
    drawn = np.hstack([target.states[:, :2], np.log(target.states[:, 2:4])])
    error = np.sqrt(variance / 30_000)
    assert (np.abs(drawn.mean(axis=0) - mean) < 4 * error).all()
    np.testing.assert_allclose(drawn.var(axis=0), variance, rtol=0.04)
    assert np.ptp(log_weights) == 0
    unmoved = np.array([110, 116, np.log(72)]), seen[[0, 1, 3]]
    evidence = multivariate_normal(unmoved[0], np.diag((moving + detecting)[[0, 1, 3]]))
    peak = evidence.logpdf(unmoved[0])
    assert log_weights[0] == pytest.approx(evidence.logpdf(unmoved[1]) - peak)


def test_steps_and_changes_of_velocity_go_together():
    """Without a detection: x' = x + v + e and v' = v + d, with var(e) = place^2 + speed^2, cov(e, d) = speed^2."""
    (target,) = started(box(100), n_particles=30_000).targets
    target.box = np.array([98.0, 77, 20, 50])
    target.states[:] = [110, 116, 24, 72, 3.0, -1.0]
    target.predict(np.array([2.0, 7.0]))
    log_weights = target._draw(None)
    changes = (target.states - [115, 122, 24, 72, 3, -1])[:, [0, 1, 4, 5]]
    place, speed = (0.02 * 50) ** 2, (0.015 * 50) ** 2
    expected = np.kron([[place + speed, speed], [speed, speed]], np.eye(2))
    np.testing.assert_allclose(np.cov(changes.T), expected, atol=0.03 * (place + speed))
    np.testing.assert_allclose(changes.mean(axis=0), 0, atol=0.03)
    np.testing.assert_array_equal(log_weights, 0)


def test_without_the_proposal_a_detection_moves_nobody():
    trackers = [started(box(100), additions=without("proposal")) for _ in range(2)]
    a, b = (tracker.update(FLAT, [box(100 + far)])[0] for tracker, far in zip(trackers, (0, 10), strict=True))
    np.testing.assert_array_equal(a.particles, b.particles)
    np.testing.assert_allclose(a.weights, 1 / 200, rtol=1e-5)  # on a flat picture nothing weighs


@pytest.mark.parametrize(("n_missed", "share_seen", "left"), [(3, 1.0, 1.0), (4, 1.0, 0.9), (0, 0.34, 0.9)])
def test_who_is_not_found_comes_to_rest(n_missed, share_seen, left):
    (target,) = started(box(100)).targets
    before = target.states.copy()
    target.n_missed, target.share_seen = n_missed, share_seen
    target.predict(np.array([2.0, -1.0]))
    np.testing.assert_allclose(target.states[:, 4:], left * before[:, 4:])
    np.testing.assert_allclose(target.states[:, :2], before[:, :2] + [2, -1] + left * before[:, 4:])
    np.testing.assert_array_equal(target.states[:, 2:4], before[:, 2:4])


@pytest.mark.parametrize("velocity", [True, False])
def test_where_looks_tell_nothing_it_is_a_kalman_filter(velocity):
    tracker = started(box(60), n_particles=20_000, additions=ADDITIONS if velocity else without("velocity"))
    (target,) = tracker.targets
    h = 72
    motion, seen = np.array([[1, 1], [0, 1]]), np.array([[1, 0]])
    if not velocity:
        motion = np.eye(2)
    mean = np.array([[72.0, 80 + 36], [0, 0]])  # of place and velocity, for x and y
    covariance = np.diag([0.06 * h, 0.03 * h]) ** 2
    rng = np.random.default_rng(3)
    for t in range(10):
        h = target.box[3]
        place, speed = (0.02 * h) ** 2, (0.015 * h) ** 2
        noise = np.array([[place + speed, speed], [speed, speed]]) if velocity else np.diag([0.08 * h, 0]) ** 2
        detection = np.array(box(60 + 3 * t + rng.normal(0, 3), 80 - t + rng.normal(0, 3)))
        (track,) = tracker.update(FLAT, [detection])
        mean, covariance = motion @ mean, motion @ covariance @ motion.T + noise
        gain = covariance @ seen.T / (covariance[0, 0] + (0.06 * h) ** 2)
        mean = mean + gain @ (detection[None, :2] + detection[None, 2:4] / 2 - seen @ mean)
        covariance = (np.eye(2) - gain @ seen) @ covariance
        np.testing.assert_allclose(track.box[:2] + track.box[2:] / 2, mean[0], atol=0.25)
        spread = np.sqrt(track.weights @ (track.particles[:, :2] - mean[0]) ** 2)
        np.testing.assert_allclose(spread, np.sqrt(covariance[0, 0]), rtol=0.05)
        if velocity:
            np.testing.assert_allclose(target.states[:, 4:].mean(axis=0), mean[1], atol=0.1)
            np.testing.assert_allclose(target.states[:, 4:].std(axis=0), np.sqrt(covariance[1, 1]), rtol=0.05)
    if velocity:
        assert mean[1, 0] > 1.5  # the velocity has been learnt from places alone


@pytest.mark.parametrize("product", [True, False])
@pytest.mark.parametrize("detected", [True, False])
def test_weights_are_prediction_times_looks(textured, product, detected):
    additions = ADDITIONS if product else without("product")
    (target,) = started(box(100), n_particles=300, frame=textured, additions=additions, sigma=(0.3, 0.2)).targets
    picture, usual, looks = Picture(textured), target.usual, copy.deepcopy(target.looks)
    picture.cover([80, 100, 30, 60])
    observation = np.array(box(103, 78)) if detected else None
    target.predict(np.zeros(2))
    before = target.states.copy()
    target.update(picture, observation)
    track = target.track
    x, y, w, h = track.particles.T
    similarities, seen = looks.similarities(picture, np.column_stack([x - w / 2, y - h / 2, w, h]))
    assert 0.1 < seen.min() < seen.max()
    each = np.exp(-(1 - similarities) / (2 * np.array([[0.3**2], [0.2**2]])))
    if product:
        likelihoods = each[0] * each[1]
        assert track.color_weight == 0.5
    else:
        a = np.ptp(each[0]) / (np.ptp(each[0]) + np.ptp(each[1]))  # eq. 9
        assert track.color_weight == pytest.approx(a)
        likelihoods = a * each[0] + (1 - a) * each[1]
    weights = likelihoods**seen * np.exp((usual - 0.5) * (1 - seen))
    if detected:
        variance = 72**2 * (0.02**2 + 0.015**2 + 0.06**2)
        weights *= np.exp(-((115 - before[:, 0]) ** 2 + (114 - before[:, 1]) ** 2) / (2 * variance))
        weights *= np.exp(-(np.log(72 / before[:, 3]) ** 2) / (2 * (0.02**2 + 0.1**2)))
    weights /= weights.sum()
    np.testing.assert_allclose(track.weights, weights, rtol=1e-6)
    x, y, w, h = weights @ track.particles
    np.testing.assert_allclose(track.box, [x - w / 2, y - h / 2, w, h])
    assert track.score == pytest.approx((weights * seen) @ similarities[0] / (weights @ seen))
    assert target.share_seen == pytest.approx(weights @ seen)


# ---------------------------------------------------------------------------------------------------------------------
# The incidence matrix, and who is whose
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("velocity", [True, False])
def test_the_incidence_matrix_says_how_well_detections_were_predicted(velocity):
    """On a flat picture: the mean of a Gaussian about each particle, per height squared."""
    tracker = started(box(100), n_particles=40, additions=ADDITIONS if velocity else without("velocity"))
    (target,) = tracker.targets
    h = target.box[3]
    detections = np.array([box(100), box(112, 70, 30, 80), box(95, 84, 20, 60)])
    target.predict(np.array([3.0, 0.0]))
    column = target.associate(Picture(FLAT), detections)
    step = 0.02**2 + 0.015**2 if velocity else 0.08**2
    covariance = np.diag([step + 0.06**2] * 2 + [0.02**2 + 0.1**2])
    for entry, (x, y, w, high, _) in zip(column, detections, strict=True):
        z = [(x + w / 2) / h, (y + high / 2) / h, np.log(high)]
        logs = [multivariate_normal([s[0] / h, s[1] / h, np.log(s[3])], covariance).logpdf(z) for s in target.states]
        assert entry == pytest.approx(logsumexp(logs) - np.log(40))
    assert column.argmax() == 0
    assert np.ptp(column) > 1


@pytest.mark.parametrize("product", [True, False])
def test_the_incidence_matrix_says_how_alike_detections_are(textured, product):
    """What is left without the gate; with it, the two are added."""
    additions = ADDITIONS if product else without("product")
    (target,) = started(box(100), frame=textured, additions=additions).targets
    target.shares = np.array([0.3, 0.7])
    picture, detections = Picture(textured), np.array([box(102), box(130), box(10, 150, 20, 60)])
    gated = target.associate(picture, detections)
    target.additions = target.additions - {"gate"}
    alike = target.associate(picture, detections)
    for i, (of_color, of_pattern) in enumerate(target.looks.similarities(picture, detections[:, :4])[0].T):
        color, pattern = np.exp(-(1 - of_color) / (2 * 0.2**2)), np.exp(-(1 - of_pattern) / (2 * 0.35**2))
        likelihood = color * pattern if product else 0.3 * color + 0.7 * pattern
        assert alike[i] == pytest.approx(2 * (np.log(likelihood) - target.usual))
    target.looks.similarities = lambda _, boxes: (np.ones((2, len(boxes))), np.ones(len(boxes)))
    target.shares, target.additions = np.array([0.5, 0.5]), target.additions | {"gate"}
    placed = target.associate(picture, detections)
    np.testing.assert_allclose(gated, placed + 2 * target.usual + alike)


class Column:
    """A target with a given column of the incidence matrix."""

    def __init__(self, column):
        self.column = column

    def associate(self, picture, observations):
        return self.column


@pytest.mark.parametrize("n_observations", [0, 1, 3, 4])
@pytest.mark.parametrize("n_targets", [1, 3, 4])
def test_the_assignment_has_the_greatest_sum_of_all(n_observations, n_targets):
    """Of all ways to give observations to targets, or to nobody, which is worth the floor."""
    rng = np.random.default_rng([n_observations, n_targets])
    for _ in range(10):
        matrix = rng.normal(-8, 5, (n_observations, n_targets))
        tracker = AssociationParticleFilter()
        tracker.targets = [Column(column) for column in matrix.T]
        owners = tracker._associate(None, np.zeros((n_observations, 5)))
        np.testing.assert_array_equal(tracker.incidence, np.maximum(matrix, association.UNMATCHED))
        gain = matrix - association.UNMATCHED
        best = max(
            sum(gain[i, j] for i, j in zip(order, range(n_targets), strict=True) if i < n_observations)
            for order in itertools.permutations(range(n_observations + n_targets), n_targets)
        )
        assert len(set(owners.values())) == len(owners)
        assert sum(gain[i, j] for j, i in owners.items()) == pytest.approx(best)
        assert all(gain[i, j] > 0 for j, i in owners.items())


def test_taken_one_by_one_a_detection_may_belong_to_two():
    matrix = np.array([[3.0, 2.0], [2.5, -4.0]])
    found = {}
    for additions in (ADDITIONS, without("one to one")):
        tracker = AssociationParticleFilter(additions=additions)
        tracker.targets = [Column(column) for column in matrix.T]
        found[len(additions)] = tracker._associate(None, np.zeros((2, 5)))
    assert found == {len(ADDITIONS): {0: 1, 1: 0}, len(ADDITIONS) - 1: {0: 0, 1: 0}}


@pytest.mark.parametrize("floor", [association.UNMATCHED, -1e9])
def test_who_leaves_does_not_shift_the_others(monkeypatch, floor):
    """The trap: one leaves at the left, one comes at the right, and giving each a neighbour's detection costs less
    than giving the newcomer's to who has left. A floor, below which nobody is anybody, gets out of it.
    """
    monkeypatch.setattr(association, "UNMATCHED", floor)
    people = [box(30), box(95), box(160)]
    tracker = started(*people, additions=without("border"))
    tracks = tracker.update(FLAT, [*people[1:], box(225)])
    kept = {track.id: track.box[0] for track in tracks if track.id != 1}
    moved = [kept[2] - 95, kept[3] - 160]
    if floor == -1e9:
        assert min(moved) > 10  # so it is a trap
    else:
        np.testing.assert_allclose(moved, 0, atol=2)
        np.testing.assert_array_equal(tracker.incidence.argmax(axis=0)[1:], [0, 1])


# ---------------------------------------------------------------------------------------------------------------------
# Birth and death
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_frames", [1, 2, 3, 5])
def test_who_is_seen_in_so_many_frames_in_a_row_is_somebody(n_frames):
    tracker = AssociationParticleFilter(20, seed=0, n_frames=n_frames)
    for t in range(1, n_frames):
        assert tracker.update(FLAT, [box(50 + t)]) == []
    (track,) = tracker.update(FLAT, [box(50 + n_frames)])
    assert track.id == 1
    np.testing.assert_array_equal(track.box, box(50 + n_frames)[:4])
    assert ids(tracker.update(FLAT, [box(51 + n_frames)])) == [1]


def test_who_misses_a_frame_begins_again():
    tracker = AssociationParticleFilter(20, seed=0)
    for seen in [1, 1, 0] * 4:
        assert tracker.update(FLAT, [box(50)] * seen) == []
    assert [len(tracker.update(FLAT, [box(50)])) for _ in range(3)] == [0, 0, 1]


def test_who_is_doubtful_or_jumps_is_nobody():
    tracker = AssociationParticleFilter(20, seed=0, birth_score=0.8)
    for t in range(8):
        assert tracker.update(FLAT, [box(50, score=0.79), box(120 if t % 2 else 200)]) == []


def test_somebody_new_has_the_velocity_of_the_detections():
    tracker = AssociationParticleFilter(20_000, seed=0)
    for t in range(3):
        tracker.update(FLAT, [box(50 + 4 * t, 80 - t)])
    states = tracker.targets[0].states
    np.testing.assert_allclose(states.mean(axis=0), [70, 114, 24, 72, 4, -1], atol=0.15)
    expected = [0.06 * 72, 0.06 * 72, 0.05 * 24, 0.05 * 72, 0.03 * 72, 0.03 * 72]
    np.testing.assert_allclose(states.std(axis=0), expected, rtol=0.03)


def test_the_camera_gives_nobody_a_velocity():
    boxes = {t: np.array(box(50 + 4 * t, 80)[:4], dtype=float) for t in (0, 2)}  # hidden in between
    settings, rng = AssociationParticleFilter(20_000), np.random.default_rng(0)
    target = association._Target(1, boxes, Picture(FLAT), np.array([3.0, -2.0]), settings, rng)
    np.testing.assert_allclose(target.states[:, 4:].mean(axis=0), [4 - 3, 2], atol=0.1)


@pytest.mark.parametrize("n_frames", [2, 3, 4])
def test_who_looks_gone_is_shown_no_more_after_so_many_frames(textured, n_frames):
    tracker = started(box(100), n_times=n_frames, n_frames=n_frames, remember=n_frames + 4, frame=textured)
    for _ in range(20):
        tracker.update(textured, [box(100)])
    other = textured[::-1, ::-1].copy()
    shown = [ids(tracker.update(other, [])) for _ in range(n_frames + 4)]
    assert shown == [[1]] * (n_frames - 1) + [[]] * 5
    assert tracker.targets == []  # and then forgotten


@pytest.mark.parametrize("remembered", [True, False])
def test_forgotten_at_once_without_finding_again(textured, remembered):
    tracker = started(box(100), frame=textured, additions=ADDITIONS if remembered else without("re-finding"))
    for _ in range(10):
        tracker.update(textured, [box(100)])
    for _ in range(3):
        tracks = tracker.update(textured[::-1, ::-1].copy(), [])
    assert tracks == []
    assert len(tracker.targets) == remembered


@pytest.mark.parametrize(("n_times", "n_believed"), [(3, 0), (12, 2), (40, 9), (100, 17)])
def test_who_looks_as_usual_is_believed_the_longer_the_oftener_found(n_times, n_believed):
    """For a quarter of the frames in which it was found, at most 18, not being found is no absence."""
    tracker = started(box(100), n_times=n_times, n_particles=20) if n_times < 4 else started(box(100), n_particles=20)
    for _ in range(n_times - 3):
        tracker.update(FLAT, [box(100)])
    (target,), absent = tracker.targets, []
    for _ in range(n_believed + 2):
        tracker.update(FLAT, [])
        absent.append(target.n_absent)
    assert absent == [0] * n_believed + [1, 2]
    assert target.missing == (n_times < 12)  # who was found a few times only is not shown without a detection


@pytest.mark.parametrize(("additions", "expected"), [(ADDITIONS, {1}), (without("re-finding"), {1, 2})])
def test_who_is_found_again_has_the_same_number(additions, expected):
    """The light goes out for six frames, and its walker walks on."""
    scene, shown = film("synthetic-walk"), []
    tracker = AssociationParticleFilter(100, seed=0, additions=additions)
    for t in range(45):
        dark = 26 <= t < 32
        frame = np.zeros((240, 320, 3), np.uint8) if dark else scene.frames[t]
        shown.append(ids(tracker.update(frame, [] if dark else truth_of(scene, t))))
    assert shown[25] == [1]
    assert shown[28:32] == [[]] * 4
    assert set(itertools.chain(*shown)) == expected
    assert len(shown[-1]) == 1


def test_numbers_are_given_in_order_and_never_again(textured):
    tracker, numbers = AssociationParticleFilter(20, seed=0, remember=3), []
    other = textured[::-1, ::-1].copy()
    for _ in range(4):
        for _ in range(4):
            tracks = tracker.update(textured, [box(100), box(200)])
        numbers.append(ids(tracks))
        for _ in range(4):
            tracks = tracker.update(other, [])
        assert tracks == []
    assert numbers == [[1, 2], [3, 4], [5, 6], [7, 8]]


@pytest.mark.parametrize(("start", "velocity"), [((235, 80), (6, 0)), ((60, 80), (-6, 0)), ((150, 110), (0, 5))])
@pytest.mark.parametrize("additions", [ADDITIONS, without("border")])
def test_who_walks_out_of_the_picture_has_left(start, velocity, additions):
    """To the right, to the left, and towards the camera."""
    tracker = AssociationParticleFilter(100, seed=0, additions=additions)
    for t in range(26):
        x, y, w, h, score = box(*np.add(start, np.multiply(velocity, t)))
        inside = t < 14 and 0 < x + w / 2 < 320 and y + h < 260
        tracks = tracker.update(FLAT, [[x, y, w, h, score]] if inside else [])
        if t == 6:
            assert ids(tracks) == [1]
    assert bool(tracker.targets) == (additions != ADDITIONS)


def test_who_is_not_found_near_the_border_has_left_and_elsewhere_not(textured):
    people = [box(150), box(300 - 12)]
    tracker = started(*people, frame=textured)
    for _ in range(10):
        tracker.update(textured, people)
    other = textured[::-1, ::-1].copy()
    for _ in range(3):
        tracker.update(other, [])
    assert [target.track.id for target in tracker.targets] == [1]


@pytest.mark.parametrize(
    ("x", "y", "n_absent", "left"),
    [
        (150, 80, 9, False), (-15, 80, 0, False), (-16, 80, 0, True), (311, 80, 0, False), (312, 80, 0, True),
        (9, 80, 3, True), (9, 80, 2, False), (10, 80, 3, False), (286, 80, 3, False), (287, 80, 3, True),
        (150, 166, 3, False), (150, 167, 3, True), (150, 167, 2, False), (150, 196, 0, False), (150, 197, 0, True),
    ],
)  # fmt: skip
def test_where_the_border_is(x, y, n_absent, left):
    """At once where the centre or the feet are far out; near the sides, 0.3 heights of 72, after three frames."""
    tracker = started(box(150))
    (target,) = tracker.targets
    target.box, target.n_absent = np.array(box(x, y)[:4]), n_absent
    assert tracker._has_left(target) == left


@pytest.mark.parametrize(("additions", "numbers"), [(ADDITIONS, [1]), (without("parts"), [1, 2])])
@pytest.mark.parametrize("whole", [True, False])
def test_legs_are_nobody_new(additions, numbers, whole):
    """Whether the whole person is found with them or not."""
    tracker, legs = started(box(100), additions=additions), box(104, 120, 14, 30)
    for _ in range(20):
        tracker.update(FLAT, [box(100)])
    for _ in range(4):
        tracks = tracker.update(FLAT, [box(100), legs] if whole else [legs])
    assert ids(tracks) == numbers


@pytest.mark.parametrize(("additions", "n_people"), [(ADDITIONS, 1), (without("parts"), 2)])
def test_legs_that_are_found_from_the_first_are_nobody_either(additions, n_people):
    """10 of their 14 pixels are inside, which joining detections would let pass."""
    tracker = AssociationParticleFilter(50, seed=0, additions=additions)
    for _ in range(3):
        tracks = tracker.update(FLAT, [box(100), box(114, 110, 14, 42)])
    assert len(tracks) == n_people


def test_parts_are_inside_what_is_taller_and_not_much_less_sure():
    whole = box(100, 80, 30, 90, 1.0)
    cases = [
        (box(104, 110, 14, 40, 1.9), True),
        (box(104, 110, 14, 40, 2.1), False),  # the larger one is doubtful
        (box(104, 80, 14, 73, 1.0), False),  # as tall
        (box(122, 110, 14, 40, 1.0), False),  # 8 of 14 pixels inside
        (box(121, 110, 14, 40, 1.0), True),  # 9 of 14
    ]
    for other, part in cases:
        assert association._parts(np.array([whole, other])).tolist() == [False, part]
    assert association._parts(np.empty((0, 5))).tolist() == []


def test_a_second_box_of_one_person_is_nobody_new():
    tracker = AssociationParticleFilter(50, seed=0)
    for _ in range(8):
        tracks = tracker.update(FLAT, [box(100), box(106, score=0.9)])
    assert len(tracks) == 1


# ---------------------------------------------------------------------------------------------------------------------
# What covers, and what moves
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("covers", [True, False])
def test_who_is_nearer_covers_who_is_behind(covers):
    """One particle each: how much is seen of the farther one is a matter of two boxes."""
    people = [box(100, 80), box(104, 100)]
    tracker = started(*people, n_particles=1, additions=ADDITIONS if covers else without("mutual occlusion"))
    far, near = sorted(tracker.update(FLAT, people), key=lambda track: track.box[1])
    mask = np.ones((240, 320))
    x, y, w, h = near.box
    left, top, right, bottom = np.floor([x + 0.12 * w + 0.5, y + 0.05 * h + 0.5, x + 0.88 * w + 0.5, y + h + 0.5])
    if covers:
        mask[int(top) : int(bottom), int(left) : int(right)] = 0
    x, y, w, h = far.particles[0] - np.append(far.particles[0, 2:] / 2, [0, 0])
    left, right = (int(np.floor(edge + 0.5)) for edge in (x + 0.2 * w, x + 0.8 * w))
    rows = [int(np.floor(y + n * h / 3 + 0.5)) for n in range(4)]
    shares = [mask[a:b, left:right].mean() for a, b in itertools.pairwise(rows)]
    seen = {target.track.id: target.share_seen for target in tracker.targets}
    assert seen[near.id] == 1
    assert seen[far.id] == pytest.approx(np.mean([share * (share >= 0.1) for share in shares]))
    assert (seen[far.id] < 1) == covers


def test_who_is_hidden_behind_another_is_held_and_not_absent():
    people = [box(100, 78), box(100, 84, 30, 80)]
    tracker = started(box(60, 78), box(140, 84, 30, 80))
    for t in range(1, 21):
        tracker.update(FLAT, [box(60 + 2 * t, 78), box(140 - 2 * t, 84, 30, 80)])
    tracks = tracker.update(FLAT, people[1:])
    held = {track.id: track.held for track in tracks}
    nearer = max(tracks, key=lambda track: track.box[1] + track.box[3]).id
    assert held == {nearer: False, 3 - nearer: True}


def test_particles_go_along_with_the_background(monkeypatch):
    """With a swaying camera, where a target is expected is nearer to where it is."""
    scene = film("synthetic-camera")
    associate, errors = association._Target.associate, {}
    for additions in (ADDITIONS, without("camera")):
        expected = []
        monkeypatch.setattr(
            association._Target, "associate",
            lambda self, *args, to=expected: to.append(self.states[:, :2].mean(axis=0)) or associate(self, *args),
        )  # fmt: skip
        tracker = AssociationParticleFilter(200, seed=0, additions=additions)
        for t in range(30):
            tracker.update(scene.frames[t], truth_of(scene, t))
        boxes = scene.target(1)[3:30]
        assert len(expected) == len(boxes)
        errors[len(additions)] = np.linalg.norm(expected - boxes[:, :2] - boxes[:, 2:] / 2, axis=1).mean()
    assert errors[len(ADDITIONS)] < 0.85 * errors[len(ADDITIONS) - 1]


@pytest.mark.parametrize("detected", [True, False])
def test_who_cannot_be_seen_is_held_unless_detected(detected):
    (target,), picture = started(box(100)).targets, Picture(FLAT)
    picture.cover([0, 0, 320, 240])
    target.update(picture, np.array(box(100)) if detected else None)
    assert target.share_seen < 0.35
    assert target.track.held == (not detected)
    assert target.n_absent == (not detected)


@pytest.mark.parametrize(("share_seen", "drop", "n_absent"), [(0.36, 0.09, 0), (0.34, 0.09, 3), (0.36, 0.11, 3)])
def test_it_is_no_absence_to_be_seen_and_look_as_usual(share_seen, drop, n_absent):
    (target,) = started(box(100)).targets
    target.n_found, target.n_absent, target.usual_color, target.share_seen = 40, 2, 0.7, share_seen
    target._miss(0.7 - drop)
    assert (target.n_missed, target.n_absent) == (1, n_absent)


def test_what_is_usual_follows_slowly():
    (target,) = started(box(100)).targets
    target.usual, target.usual_color, target.share_seen = -2.0, 0.5, 0.81
    target._find(Picture(FLAT), 0.9, -1.0)
    assert (target.usual, target.usual_color) == (pytest.approx(-1.9), pytest.approx(0.54))
    target.share_seen = 0.79
    target._find(Picture(FLAT), 0.9, -1.0)
    assert target.usual == pytest.approx(-1.9)


@pytest.mark.parametrize("surroundings", [True, False])
def test_looks_are_of_the_last_detection(textured, surroundings):
    additions = ADDITIONS if surroundings else without("surroundings")
    (target,) = started(box(100), frame=textured, additions=additions, n_bands=2).targets
    picture, boxes = Picture(textured), [box(103)[:4], box(20)[:4]]
    expected = Looks(picture, box(100)[:4], n_bands=2, surroundings=surroundings).similarities(picture, boxes)
    np.testing.assert_allclose(target.looks.similarities(picture, boxes)[0], expected[0])


def test_looks_are_learnt_only_from_who_is_seen_well(textured):
    people = [box(100, 80), box(106, 94)]
    tracker = started(*people, frame=textured)
    before = [(target.looks._inside.copy(), target.usual, target.n_found) for target in tracker.targets]
    grain = np.random.default_rng(1).integers(0, 9, textured.shape, dtype=np.uint8)
    tracker.update(textured + grain, people)
    learnt = []
    for target, (inside, usual, n_found) in zip(tracker.targets, before, strict=True):
        assert target.n_found == n_found + 1
        assert (target.usual != usual) == (np.abs(target.looks._inside - inside).max() > 1e-6)
        learnt.append((target.box[1] > 87, target.share_seen > 0.8, target.usual != usual))
    assert sorted(learnt) == [(False, False, False), (True, True, True)]  # the nearer one


# ---------------------------------------------------------------------------------------------------------------------
# Whole scenes
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("additions", [ADDITIONS, (), *(without(name) for name in ADDITIONS)])
def test_it_follows_a_crowd_whatever_is_left_out(additions):
    scene = film("synthetic-crowd")
    tracker = AssociationParticleFilter(30, seed=0, additions=additions)
    tracks = [tracker.update(scene.frames[t], truth_of(scene, t)) for t in range(28, 36)]
    rows = multi.table(tracks)
    rows[:, 0] += 28
    score = metrics.multi_target(rows[rows[:, 0] > 29], scene.tracks[np.isin(scene.tracks[:, 0], range(30, 36))])
    assert score.misses == score.false_positives == score.switches == 0
    assert tracker.incidence.shape == (5, 5)
    assert (np.sort(tracker.incidence, axis=0)[-1] > association.UNMATCHED).all()


def crossing(additions, seed):
    scene = film("synthetic-crossing")
    detections = datasets.synthetic.draw_detections(scene, seed=2)
    rows = multi.table(multi.follow(AssociationParticleFilter(60, seed, additions=additions), scene.frames, detections))
    return metrics.multi_target(rows, scene.tracks).idf1


def test_people_who_cross_keep_their_numbers():
    """With detections that are moved, missed and made up; as the paper has it they swap."""
    assert crossing(ADDITIONS, 0) > 0.95
    assert crossing((), 0) < 0.8


def test_the_same_seed_gives_the_same_and_another_does_not():
    scene = film("synthetic-crossing")

    def run(seed):
        tracker = AssociationParticleFilter(40, seed=seed)
        return [tracker.update(scene.frames[t], truth_of(scene, t)) for t in range(6)]

    a, again, other = run(0), run(0), run(1)
    np.testing.assert_array_equal(multi.table(a), multi.table(again))
    np.testing.assert_array_equal(a[-1][1].particles, again[-1][1].particles)
    assert not np.isclose(a[-1][0].particles, other[-1][0].particles).any()
    assert not np.isclose(a[-1][0].particles[:, 2] / 2, a[-1][1].particles[:, 2] / 2).all()
    generators = [run(np.random.default_rng(7)) for _ in range(2)]
    np.testing.assert_array_equal(*(multi.table(each) for each in generators))


def test_fields_of_a_track():
    tracker = started(box(100), box(200), n_particles=25)
    newborn = started(box(100)).targets[0].track
    assert (newborn.particles, newborn.weights, newborn.score) == (None, None, 1.0)
    for number, track in enumerate(tracker.update(FLAT, [box(100), box(200)]), start=1):
        assert track.id == number
        assert (track.box.shape, track.particles.shape, track.weights.shape) == ((4,), (25, 4), (25,))
        assert track.weights.sum() == pytest.approx(1)
        assert track.score == pytest.approx(1)
        assert not track.held


def test_one_particle_will_do():
    tracker = started(box(100), n_particles=1)
    for _ in range(5):
        (track,) = tracker.update(FLAT, [box(100)])
        np.testing.assert_array_equal(track.weights, [1.0])
        ((x, y, w, h),) = track.particles
        np.testing.assert_allclose(track.box, [x - w / 2, y - h / 2, w, h])


def test_where_nobody_is_there_is_nobody():
    tracker = AssociationParticleFilter()
    for none in ([], np.empty((0, 5)), [], []):
        assert tracker.update(FLAT, none) == []
        assert tracker.incidence.shape == (0, 0)


def test_the_detector_is_asked_where_no_detections_are_given():
    class Always:
        def detect(self, frame):
            return np.array([box(100)])

    tracker = AssociationParticleFilter(20, detector=Always())
    assert [len(tracker.update(FLAT)) for _ in range(4)] == [0, 0, 1, 1]
    assert AssociationParticleFilter().update(FLAT) == []  # the default one finds nobody in a wall


# ---------------------------------------------------------------------------------------------------------------------
# What comes from outside
# ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_printed", [True, False])
def test_known_people_are_followed_from_the_next_frame_on(as_printed):
    scene = film("synthetic-crossing")
    boxes = np.stack([scene.target(1)[:5], scene.target(2)[:5]], axis=1)
    boxes[1, 0] = np.nan  # hidden in one frame
    tracker = AssociationParticleFilter(60, seed=0, as_printed=as_printed)
    tracker.init(list(scene.frames[:5]), boxes)
    if not as_printed:
        velocities = [target.states[:, 4].mean() for target in tracker.targets]
        assert velocities == pytest.approx([scene.frames.walkers[n].velocity[0] for n in (0, 1)], abs=0.8)
    tracks = tracker.update(scene.frames[5], truth_of(scene, 5))
    assert ids(tracks) == [1, 2]
    errors = metrics.center_error([track.box for track in tracks], truth_of(scene, 5)[:, :4])
    assert errors.max() < (30 if as_printed else 5)
    if not as_printed:
        for t in range(6, 9):
            tracks = tracker.update(scene.frames[t], [*truth_of(scene, t), box(150, 160)])
        assert ids(tracks) == [1, 2, 3]


def test_people_who_cannot_be_known_are_refused():
    tracker = AssociationParticleFilter(10)
    seen, hidden = box(100)[:4], [np.nan] * 4
    for frames, boxes in [([], np.empty((0, 1, 4))), ([FLAT], [seen]), ([FLAT], [[seen], [seen]])]:
        with pytest.raises(ValueError, match="need training frames and boxes"):
            tracker.init(frames, boxes)
    with pytest.raises(ValueError, match="hidden in the last training frame"):
        tracker.init([FLAT, FLAT], [[seen], [hidden]])
    with pytest.raises(ValueError, match="hidden in all training frames"):
        tracker.init([FLAT], [[hidden]])
    with pytest.raises(ValueError, match="one size"):
        tracker.init([FLAT, FLAT[:100]], [[seen], [seen]])


@pytest.mark.parametrize(
    "settings",
    [
        {"n_particles": 0}, {"n_frames": 0}, {"n_bands": 0}, {"remember": 2}, {"n_frames": 10, "remember": 9},
        {"sigma": (0.2,)}, {"sigma": (0.2, 0)}, {"sigma": (-1, 0.2)}, {"sigma": (np.nan, 0.2)}, {"seed": -1},
        {"seed": 0.5}, {"additions": ("gate", "wings")},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_refused(settings):
    with pytest.raises(ValueError, match=r"must|at least|unknown additions \['wings'\]"):
        AssociationParticleFilter(**settings)


def test_what_is_no_frame_or_no_detections_is_refused():
    tracker = AssociationParticleFilter(10)
    with pytest.raises(ValueError, match="colour image"):
        tracker.update(np.zeros((60, 90)), [])
    for detections in ([[1, 2, 3, 4]], [[1, 2, 0, 4, 1]], [[1, 2, np.nan, 4, 1]]):
        with pytest.raises(ValueError, match="detections must be rows"):
            tracker.update(FLAT, detections)
    tracker.update(FLAT, [])
    with pytest.raises(ValueError, match="one size"):
        tracker.update(FLAT[:100], [])


@pytest.mark.parametrize("width", [40, 70])
def test_who_was_behind_a_pillar_is_found_again(width):
    film = datasets.synthetic.scene(occlusion=width)
    tracks = multi.table(multi.follow(AssociationParticleFilter(seed=0), film.frames, film.tracks))
    assert np.unique(tracks[:, 1]).tolist() == [1]
    assert metrics.multi_target(tracks, film.tracks).idf1 > 0.9
