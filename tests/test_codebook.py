"""Codebooks against a plain loop, closed forms and what the words mean."""

import numpy as np
import pytest

from pftrack import codebook, color


def one_at_a_time(points, bandwidth):
    """Mean-Shift as it is told: from every point by itself; then the less populous of two near modes is dropped."""
    found = {}
    for start in points:
        mode, n_near = start, 0
        for _ in range(300):
            near = points[np.linalg.norm(points - mode, axis=1) <= bandwidth]
            before, mode, n_near = mode, near.mean(axis=0), len(near)
            if np.linalg.norm(mode - before) <= 1e-3 * bandwidth:
                break
        found[tuple(mode.round(12))] = n_near
    kept = []
    for mode in sorted(found, key=lambda mode: (found[mode], mode), reverse=True):
        if all(np.linalg.norm(np.subtract(mode, other)) > bandwidth for other in kept):
            kept.append(mode)
    return np.array(kept)


@pytest.fixture(scope="module")
def patches(footage):
    """Colour histograms of square patches of a real picture."""
    frame = footage("bobot-I").frames[0]
    rng = np.random.default_rng(0)
    boxes = np.column_stack([rng.uniform(0, 300, 250), rng.uniform(0, 220, 250), np.full((250, 2), 14)])
    return color.histograms(frame, boxes, outside="ignore")


@pytest.mark.parametrize("bandwidth", [0.15, 0.3, 0.5])
def test_all_at_once_finds_what_one_at_a_time_finds(patches, bandwidth):
    found, truth = codebook.mean_shift(patches, bandwidth), one_at_a_time(patches, bandwidth)
    assert len(found) > 3
    np.testing.assert_allclose(found, truth, atol=2e-3 * bandwidth)


@pytest.mark.parametrize("seed", range(5))
def test_separate_clouds_are_clusters_at_their_means(seed):
    rng = np.random.default_rng(seed)
    centers = np.array([[0, 0, 0], [9, 0, 0], [0, 9, 9]])
    clouds = [center + rng.uniform(-1, 1, (n, 3)) for center, n in zip(centers, (40, 30, 20), strict=True)]
    modes = codebook.mean_shift(rng.permutation(np.concatenate(clouds)), bandwidth=4)
    np.testing.assert_allclose(modes, [cloud.mean(axis=0) for cloud in clouds])  # the most populous first


def test_a_large_bandwidth_has_one_word_and_a_small_one_as_many_as_points(patches):
    np.testing.assert_allclose(codebook.mean_shift(patches, 2.0), patches.mean(axis=0, keepdims=True))
    different = np.unique(patches, axis=0)
    assert len(codebook.mean_shift(patches, 1e-6)) == len(different)


def test_no_two_modes_lie_within_the_bandwidth(patches):
    modes = codebook.mean_shift(patches, 0.3)
    apart = codebook.squared_distances(modes, modes)[~np.eye(len(modes), dtype=bool)]
    assert apart.min() > 0.3**2
    np.testing.assert_allclose(modes.sum(axis=1), 1)  # means of histograms are histograms


def test_a_bag_says_which_words_occur(patches):
    words = codebook.mean_shift(patches, 0.3)
    bag = codebook.bag_of_words(patches, words)
    truth = [np.linalg.norm(words - patch, axis=1).argmin() for patch in patches]
    np.testing.assert_array_equal(codebook.nearest_words(patches, words), truth)
    np.testing.assert_allclose(bag * len(patches), np.bincount(truth, minlength=len(words)))
    assert codebook.intersection(bag, bag) == pytest.approx(1)


def test_intersection_is_one_less_half_the_distance_in_l1():
    p, q = np.random.default_rng(1).dirichlet(np.ones(9), size=(2, 20))
    np.testing.assert_allclose(codebook.intersection(p, q), 1 - np.abs(p - q).sum(axis=1) / 2)


def test_words_that_are_seen_move_words_that_are_not_stay_and_new_ones_join():
    old = np.array([[1.0, 0, 0], [0, 1, 0]])
    seen = np.array([[0.8, 0.2, 0], [0.8, 0.2, 0], [0, 0, 1]])
    new = codebook.update_codebook(old, seen, bandwidth=0.5, forget=0.75)
    np.testing.assert_allclose(new, [[0.95, 0.05, 0], [0, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(codebook.update_codebook(old, seen, 0.5, forget=1)[:2], old)
    np.testing.assert_allclose(codebook.update_codebook(old, seen, 0.5, forget=0)[0], seen[0])


def test_to_the_letter_words_that_are_not_seen_shrink():
    old, seen = np.array([[0.0, 1.0], [1.0, 0.0]]), np.array([[1.0, 0.0]] * 4)
    words = old
    for _ in range(5):
        words = codebook.update_codebook(words, seen, bandwidth=0.2, literal=True)
    np.testing.assert_allclose(words[words[:, 1] > 0], [[0, 0.9**5]])
    mixed = codebook.update_codebook(old, seen, bandwidth=0.2)
    np.testing.assert_allclose(mixed.sum(axis=1), 1)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros(3), [[np.nan, 0.0]], [[np.inf, 0.0]]])
def test_points_must_be_points(points):
    with pytest.raises(ValueError, match="non-empty"):
        codebook.mean_shift(points, 1.0)


def test_what_makes_no_sense_is_refused():
    for bandwidth, max_steps in [(0, 10), (-1, 10), (np.nan, 10), (1, 0)]:
        with pytest.raises(ValueError, match="bandwidth"):
            codebook.mean_shift([[0.0]], bandwidth, max_steps)
    with pytest.raises(ValueError, match="forget"):
        codebook.update_codebook([[0.0]], [[0.0]], 1.0, forget=1.5)
    for literal in (True, False):
        with pytest.raises(ValueError, match="one dimension"):
            codebook.update_codebook([[0.0]], [[0.0, 1.0]], 1.0, literal=literal)


def test_a_climb_may_be_cut_short(patches):
    """After one step every mode is the mean of what lies around some point, and not yet where a longer climb ends."""
    modes = codebook.mean_shift(patches, 0.3, max_steps=1)
    near = codebook.squared_distances(patches, patches) <= 0.3**2
    means = near @ patches / near.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(codebook.squared_distances(modes, means).min(axis=1), 0, atol=1e-12)
    assert len(modes) != len(codebook.mean_shift(patches, 0.3))
