"""Local binary patterns against their definition."""

import numpy as np
import pytest

from pftrack import kernels, texture

RING = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1)]


@pytest.fixture(params=["compiled", "twin"])
def loop(request, monkeypatch):
    if request.param == "twin":
        monkeypatch.setattr(kernels, "compiled", lambda *_, **__: None)


@pytest.fixture
def gray():
    return np.random.default_rng(0).integers(0, 8, (30, 40), dtype=np.uint8) * 30


def test_a_code_is_the_sum_of_the_definition(loop, gray):
    codes = kernels.ring_image(gray, np.arange(256, dtype=np.uint8))
    for y, x in np.ndindex(28, 38):
        ring = [gray[y + 1 + dy, x + 1 + dx] >= gray[y + 1, x + 1] for dx, dy in RING]
        assert codes[y + 1, x + 1] == sum(2**p for p in range(8) if ring[p])


def test_58_patterns_are_uniform():
    """As in Ojala et al. 2002: P (P - 1) + 2 with P = 8."""
    labels, counts = np.unique(texture._UNIFORM_LABELS, return_counts=True)
    np.testing.assert_array_equal(labels, np.arange(59))
    np.testing.assert_array_equal(counts, [1] * 58 + [256 - 58])
    assert texture._UNIFORM_LABELS[0b01010101] == 58
    assert texture._UNIFORM_LABELS[0b00111000] < 58


def test_any_change_of_light_that_keeps_the_order_keeps_the_patterns(loop, gray):
    darker = (np.sqrt(gray.astype(float)) * 9 + 20).astype(np.uint8)
    np.testing.assert_array_equal(texture.pattern_bins(gray), texture.pattern_bins(darker))


def test_a_quarter_turn_turns_the_ring(loop, gray):
    codes = kernels.ring_image(gray, np.arange(256, dtype=np.uint8))
    turned = kernels.ring_image(np.rot90(gray, -1), np.arange(256, dtype=np.uint8)).astype(int)
    np.testing.assert_array_equal(np.rot90(codes, -1), (turned >> 2 | turned << 6) & 255)


def test_a_grey_frame_in_colour_is_the_same(loop, gray):
    np.testing.assert_array_equal(texture.pattern_bins(np.dstack([gray] * 3)), texture.pattern_bins(gray))


def test_beyond_the_border_the_image_goes_on(loop):
    ramp = np.tile(np.arange(5, dtype=np.uint8), (4, 1))
    codes = kernels.ring_image(ramp, np.arange(256, dtype=np.uint8))
    assert (codes[:, 0] == 255).all()  # nobody is darker than the left edge
    np.testing.assert_array_equal(codes[0], codes[2])


@pytest.mark.parametrize("wrong", [np.zeros((4, 4)), np.zeros((4, 4, 4), np.uint8), np.zeros(4, np.uint8)])
def test_what_is_no_picture_is_refused(wrong):
    with pytest.raises(ValueError, match="need a"):
        texture.pattern_bins(wrong)


def test_a_picture_of_nothing_has_no_patterns():
    assert texture.pattern_bins(np.zeros((0, 5, 3), np.uint8)[..., 0]).shape == (0, 5)


@pytest.mark.parametrize(("size", "step"), [(12, 4), (6, 6), (5, 1)])
def test_patches_are_counted_where_they_are(gray, size, step):
    patterns = texture.pattern_bins(gray)
    shares = texture.patch_histograms(patterns, size, step)
    assert shares.shape == ((30 - size) // step + 1, (40 - size) // step + 1, 59)
    for r, c in np.ndindex(shares.shape[:2]):
        patch = patterns[r * step : r * step + size, c * step : c * step + size]
        np.testing.assert_allclose(shares[r, c] * size**2, np.bincount(patch.ravel(), minlength=59))


def test_in_a_picture_smaller_than_a_patch_there_is_none():
    assert texture.patch_histograms(np.zeros((5, 40), np.uint8)).shape == (0, 8, 59)
    assert texture.patch_histograms(np.zeros((0, 3), np.uint8)).shape == (0, 0, 59)


def test_patches_off_the_grid_and_pictures_without_labels_are_refused():
    for size, step in [(12, 5), (0, 1), (4, 0)]:
        with pytest.raises(ValueError, match="multiple of step"):
            texture.patch_histograms(np.zeros((20, 20), np.uint8), size, step)
    with pytest.raises(ValueError, match="labels below 59"):
        texture.patch_histograms(np.full((20, 20), 59, np.uint8))
