"""Patches against plain loops over pixels."""

import numpy as np
import pytest

from pftrack import color, patches, superpixels, texture


@pytest.fixture(scope="module")
def frame(footage):
    return footage("bobot-J").frames[0]


def describe(frame, region, height, n_superpixels=60, n_patches=1000):
    return patches.describe(frame, region, height, n_superpixels, n_patches, np.random.default_rng(0))


def test_superpixels_share_the_region_and_stand_where_they_are(frame):
    region = (60, 40, 140, 170)
    of_color, _ = describe(frame, region, height=80)  # nothing is reduced
    part = frame[40:170, 60:140]
    labels = superpixels.segment(part, round(60 * part.shape[0] * part.shape[1] / (0.4 * 120**2)), n_steps=4)
    assert of_color.areas.sum() == 80 * 130
    for s in (0, 7, len(of_color) - 1):
        y, x = np.nonzero(labels == s)
        assert of_color.areas[s] == len(x)
        left, top, right, bottom = of_color.edges[s]
        np.testing.assert_allclose([(left + right) / 2, (top + bottom) / 2], [x.mean() + 60.5, y.mean() + 40.5])
        assert (right - left) == pytest.approx(np.sqrt(12 * x.var() + 1))  # of a rectangle, exactly its width
        bins = np.bincount(color.hsv_bins(part)[labels == s], minlength=256)
        np.testing.assert_allclose(of_color.features[s], bins / len(x))


def test_the_extents_of_rectangles_are_their_own():
    labels = np.zeros((12, 20), int)
    labels[3:9, 5:16] = 1
    areas, edges = patches._extents(labels)
    np.testing.assert_allclose(edges[1], [5, 3, 16, 9])
    np.testing.assert_array_equal(areas, [12 * 20 - 66, 66])


def test_patches_of_texture_are_drawn_from_the_grid(frame):
    region = (60, 40, 140, 170)
    _, of_texture = describe(frame, region, height=80, n_patches=90)
    grid = texture.patch_histograms(texture.pattern_bins(frame[40:170, 60:140]), 12, 4)
    assert len(of_texture) == 90
    places = (of_texture.edges[:, :2] - [60, 40]) / 4
    np.testing.assert_array_equal(places, places.astype(int))
    assert len(np.unique(places, axis=0)) == 90
    for (column, row), feature in zip(places.astype(int), of_texture.features, strict=True):
        np.testing.assert_array_equal(feature, grid[row, column])
    np.testing.assert_array_equal(of_texture.edges[:, 2:] - of_texture.edges[:, :2], 12)
    assert len(describe(frame, region, 80)[1]) == grid.shape[0] * grid.shape[1]  # there are no more


def test_a_large_target_has_as_many_patches_as_a_small_one(frame):
    """The picture is reduced, and places and areas are given in the frame's own pixels."""
    small = np.repeat(np.repeat(frame[40:170, 60:140], 3, axis=0), 3, axis=1)
    near, far = describe(small, (0, 0, 240, 390), height=240), describe(frame, (60, 40, 140, 170), height=80)
    for a, b in zip(near, far, strict=True):
        assert len(a) == len(b)
        assert a.areas.sum() == pytest.approx(9 * b.areas.sum())
        np.testing.assert_allclose(a.features, b.features, atol=1e-12)
        np.testing.assert_allclose(a.edges, 3 * (b.edges - [60, 40, 60, 40]), rtol=1e-9, atol=1e-9)


def test_a_region_too_small_has_no_texture(frame):
    of_color, of_texture = describe(frame, (10, 10, 20, 20), height=30)
    assert len(of_color) >= 1
    assert of_texture.features.shape == (0, 59)
    assert of_texture.edges.shape == (0, 4)


@pytest.mark.parametrize("n_bands", [1, 3])
def test_coverage_is_the_share_of_a_patch_in_a_band(n_bands):
    """Against counting the points of a fine grid."""
    rng = np.random.default_rng(0)
    boxes = np.column_stack([rng.uniform(0, 20, (5, 2)), rng.uniform(5, 20, (5, 2))])
    edges = rng.uniform(0, 30, (7, 2))
    edges = np.hstack([edges, edges + rng.uniform(2, 8, (7, 2))])
    found = patches.coverage(boxes, edges, n_bands)
    assert found.shape == (5, n_bands, 7)
    for s, (left, top, right, bottom) in enumerate(edges):
        px, py = np.meshgrid(np.linspace(left, right, 400), np.linspace(top, bottom, 400))
        for n, (x, y, w, h) in enumerate(boxes):
            for band in range(n_bands):
                low, high = y + h * band / n_bands, y + h * (band + 1) / n_bands
                share = ((px >= x) & (px < x + w) & (py >= low) & (py < high)).mean()
                assert found[n, band, s] == pytest.approx(share, abs=0.01)
