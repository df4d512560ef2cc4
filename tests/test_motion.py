"""Transition models and re-initialisation."""

import cv2
import numpy as np
import pytest
from scipy import stats

from pftrack import motion


def test_constant_velocity_is_the_matrix_of_eq_10():
    dt = 0.04
    expected = [[1, 0, dt, 0, 0], [0, 1, 0, dt, 0], [0, 0, 1, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]]
    np.testing.assert_array_equal(motion.constant_velocity(dt), expected)


def test_a_frame_is_the_unit_of_time_by_default():
    np.testing.assert_array_equal(motion.constant_velocity(), motion.constant_velocity(dt=1))


def test_two_steps_of_constant_velocity_are_one_of_twice_the_length():
    step = motion.constant_velocity(0.25)
    np.testing.assert_allclose(step @ step, motion.constant_velocity(0.5))


@pytest.mark.parametrize("noise", [np.array([5.0, 4.0, 0.5, 0.25, 0.02]), 3.0], ids=["one for each", "scalar"])
def test_moved_particles_scatter_about_a_s_with_the_given_standard_deviations(noise):
    n, start = 100_000, np.array([100.0, 50.0, 2.0, -1.0, 1.5])
    matrix = motion.constant_velocity(2.0)
    moved = motion.linear_gaussian(np.tile(start, (n, 1)), matrix, noise, np.random.default_rng(1))
    sigma = np.broadcast_to(noise, 5)
    expected = [100 + 2 * 2.0, 50 - 2 * 1.0, 2.0, -1.0, 1.5]
    assert np.all(np.abs(moved.mean(axis=0) - expected) <= 5 * sigma / np.sqrt(n))
    scatter = (moved - expected).T @ (moved - expected) / n
    # The variance of a product of two centred Gaussians: sigma_i² sigma_j², and twice that where i = j.
    standard_errors = np.outer(sigma, sigma) * np.sqrt((1 + np.eye(5)) / n)
    assert np.all(np.abs(scatter - np.diag(sigma**2)) <= 5 * standard_errors)


def test_the_noise_is_gaussian():
    steps = motion.linear_gaussian(np.zeros((5000, 2)), np.eye(2), [2.0, 0.1], np.random.default_rng(2))
    assert stats.kstest(steps[:, 0], stats.norm(scale=2.0).cdf).pvalue > 1e-3
    assert stats.kstest(steps[:, 1], stats.norm(scale=0.1).cdf).pvalue > 1e-3


def test_every_particle_moves_by_the_matrix_also_if_that_is_not_symmetric():
    rng = np.random.default_rng(3)
    states, matrix = rng.normal(size=(20, 3)), rng.normal(size=(3, 3))
    moved = motion.linear_gaussian(states, matrix, 0.0, rng)
    np.testing.assert_allclose(moved, [matrix @ state for state in states])


def test_a_component_without_noise_does_not_scatter():
    moved = motion.linear_gaussian(np.zeros((50, 2)), np.eye(2), [1.0, 0.0], np.random.default_rng(4))
    assert moved[:, 0].std() > 0
    np.testing.assert_array_equal(moved[:, 1], 0.0)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_the_particles_handed_in_are_left_as_they_were(noise):
    states = np.random.default_rng(5).normal(size=(10, 5))
    before = states.copy()
    for moved in (
        motion.linear_gaussian(states, motion.constant_velocity(), noise, np.random.default_rng(6)),
        motion.random_walk(states, noise, np.random.default_rng(6)),
    ):
        assert not np.shares_memory(states, moved)
        np.testing.assert_array_equal(states, before)


@pytest.mark.parametrize("noise", [[1.0, 2.0, 3.0], 0.5])
def test_random_walk_is_the_linear_model_with_the_identity(noise):
    states = np.random.default_rng(7).normal(size=(10, 3))
    walked = motion.random_walk(states, noise, np.random.default_rng(8))
    np.testing.assert_array_equal(walked, motion.linear_gaussian(states, np.eye(3), noise, np.random.default_rng(8)))
    assert np.all(walked != states)


@pytest.mark.parametrize("noise", [-1.0, [1.0, -0.1], [np.nan, 1.0]])
def test_a_standard_deviation_that_is_none_is_rejected(noise):
    with pytest.raises(ValueError, match=r"standard deviations .* must not be negative or NaN"):
        motion.linear_gaussian(np.zeros((3, 2)), np.eye(2), noise, np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"standard deviations .* must not be negative or NaN"):
        motion.random_walk(np.zeros((3, 2)), noise, np.random.default_rng(0))


@pytest.mark.parametrize(
    ("options", "scale", "velocity"),
    [
        pytest.param({}, (1.0, 2.0), (-0.05, 0.05), id="the paper's"),
        pytest.param({"scale_range": (0.5, 3), "velocity_range": (-4, 2)}, (0.5, 3), (-4, 2), id="others"),
    ],
)
def test_reinitialised_particles_are_uniform_over_the_image_and_the_ranges(options, scale, velocity):
    states = motion.reinitialize(5000, (320, 240), np.random.default_rng(9), **options)
    assert states.shape == (5000, 5)
    for column, (low, high) in zip(states.T, [(0, 320), (0, 240), velocity, velocity, scale], strict=True):
        assert column.min() >= low
        assert column.max() <= high
        assert stats.kstest(column, stats.uniform(low, high - low).cdf).pvalue > 1e-3
    correlations = np.corrcoef(states.T)[~np.eye(5, dtype=bool)]
    assert np.all(np.abs(correlations) < 5 / np.sqrt(5000))


def test_reinitialising_repeats_for_a_seed_alone():
    first, second, other = (motion.reinitialize(20, (64, 48), np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, second)
    assert np.all(first != other)


@pytest.mark.parametrize(("n_particles", "image_size"), [(0, (64, 48)), (-1, (64, 48)), (5, (0, 48)), (5, (64, 0))])
def test_reinitialising_needs_particles_and_an_image(n_particles, image_size):
    with pytest.raises(ValueError, match="at least one particle and an image with area"):
        motion.reinitialize(n_particles, image_size, np.random.default_rng(0))


def smooth_noise(height=120, width=200):
    noise = np.random.default_rng(6).integers(0, 256, (height, width, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 4) * 2


@pytest.mark.parametrize("shift", [(3, 0), (0, -2), (-4, 3)])
def test_camera_shift_is_how_far_the_background_moved(shift):
    frame = smooth_noise()
    before = motion.reduced_gray(frame, 200)
    after = motion.reduced_gray(np.roll(frame, shift, axis=(1, 0)), 200)
    np.testing.assert_allclose(motion.camera_shift(before, after), shift, atol=0.3)


def test_a_pedestrian_does_not_move_the_camera():
    frame = smooth_noise()
    moved = frame.copy()
    moved[30:100, 80:120] = np.roll(frame, 6, axis=1)[30:100, 80:120]
    shift = motion.camera_shift(motion.reduced_gray(frame, 200), motion.reduced_gray(moved, 200))
    np.testing.assert_allclose(shift, 0, atol=0.1)


def test_where_nothing_can_be_followed_the_camera_stands():
    rng = np.random.default_rng(7)
    before, after = (rng.integers(0, 256, (60, 80), dtype=np.uint8) for _ in range(2))
    assert np.isfinite(motion.camera_shift(before, after)).all()
    np.testing.assert_array_equal(motion.camera_shift(np.zeros((9, 9), np.uint8), np.zeros((9, 9), np.uint8)), 0)


def test_reduced_gray_has_the_width_asked_for_and_keeps_the_shape_of_the_picture():
    assert motion.reduced_gray(np.zeros((240, 320, 3), np.uint8)).shape == (120, 160)
    assert motion.reduced_gray(np.zeros((4, 320, 3), np.uint8)).shape == (8, 160)
