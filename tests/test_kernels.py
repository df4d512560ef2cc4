"""The compiled loops against their NumPy twins, and both against OpenCV and closed forms."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from pftrack import color, kernels


@pytest.fixture(params=["direct", "sweep", "twin"])
def loop(request, monkeypatch):
    """Run a test three times: with either compiled loop, and as if numba could not be imported."""
    if request.param == "twin":
        monkeypatch.setattr(kernels, "compiled", lambda loop: None)
    elif kernels.compiled(kernels._direct_loop) is None:
        pytest.skip("numba is not installed")
    monkeypatch.setattr(kernels, "_sweep_pays", lambda *_: request.param == "sweep")
    return request.param


@pytest.fixture
def frame():
    """Smooth random colours, so that bins come in patches."""
    noise = np.random.default_rng(1).integers(0, 256, size=(60, 80, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3, borderType=cv2.BORDER_REPLICATE) * 3


def random_edges(rng, n, width=80, height=60):
    """Rectangles in and around an image, some of them beyond its border."""
    left, top = rng.integers(-30, width + 10, n), rng.integers(-30, height + 10, n)
    return np.stack([left, top, left + rng.integers(1, 50, n), top + rng.integers(1, 50, n)], axis=1)


def test_similarity_is_what_opencv_compares(loop, frame):
    bins, rng = color.hsv_bins(frame), np.random.default_rng(2)
    target = cv2.calcHist([bins[10:40, 20:40]], [0], None, [256], [0, 256])
    edges = np.clip(random_edges(rng, 200), 0, [79, 59, 80, 60])
    edges[:, 2:] = np.maximum(edges[:, 2:], edges[:, :2] + 1)
    areas = np.prod(edges[:, 2:] - edges[:, :2], axis=1)
    rho = kernels.similarities(bins, edges, areas, target.T / target.sum())
    for (left, top, right, bottom), coefficient in zip(edges, rho, strict=True):
        histogram = cv2.calcHist([bins[top:bottom, left:right]], [0], None, [256], [0, 256])
        distance = cv2.compareHist(target, histogram, cv2.HISTCMP_BHATTACHARYYA)
        assert np.sqrt(1 - coefficient) == pytest.approx(distance, abs=1e-6)


def test_rectangles_take_their_targets_in_turn(loop):
    bins = np.repeat(np.uint8([[3, 200]]), 4, axis=1)
    targets = np.zeros((2, 256))
    targets[0, 3] = targets[1, 200] = 1
    edges = [[0, 0, 4, 1], [0, 0, 4, 1], [4, 0, 8, 1], [4, 0, 8, 1]]
    np.testing.assert_array_equal(kernels.similarities(bins, edges, [4, 4, 4, 4], targets), [1, 0, 0, 1])


def test_bins_are_put_together_from_the_table(loop):
    rng = np.random.default_rng(4)
    hsv = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    table = rng.integers(0, 256, (256, 3), dtype=np.uint8)
    expected = [[table[h, 0] | table[s, 1] | table[v, 2] for h, s, v in row] for row in hsv]
    np.testing.assert_array_equal(kernels.bin_image(hsv[:, ::-1][:, ::-1], table), expected)


def test_what_lies_outside_the_image_is_not_read(loop):
    bins = np.full((4, 4), 9, dtype=np.uint8)
    target = np.eye(256)[9]
    edges = [[-100, -100, 200, 200], [-3, 0, 1, 4], [50, 50, 60, 60], [-9, -9, -1, -1], [3, 3, 2, 2]]
    rho = kernels.similarities(bins, edges, [16, 16, 100, 64, 1], target)
    np.testing.assert_allclose(rho, [1, 0.5, 0, 0, 0])


@pytest.mark.parametrize("sparse", [True, False])
def test_all_loops_agree(monkeypatch, frame, sparse):
    bins, rng = color.hsv_bins(frame), np.random.default_rng(3)
    targets = rng.dirichlet(np.full(256, 0.02 if sparse else 5.0), size=3)
    edges = random_edges(rng, 300)
    areas = np.prod(edges[:, 2:] - edges[:, :2], axis=1)
    found = []
    for sweep in (True, False):
        monkeypatch.setattr(kernels, "_sweep_pays", lambda *_, answer=sweep: answer)
        found.append(kernels.similarities(bins, edges, areas, targets))
    monkeypatch.setattr(kernels, "compiled", lambda loop: None)
    truth = kernels.similarities(bins, edges, areas, targets)
    assert len(np.unique(truth)) > 100
    np.testing.assert_allclose(found, [truth, truth], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("n", "spread", "pays"), [(2000, 5, True), (3, 100, False)])
def test_the_sweep_is_for_many_rectangles_close_together(n, spread, pays):
    corner = 150 + np.random.default_rng(5).integers(-spread, spread + 1, (n, 2))
    visible = np.hstack([corner, corner + [30, 80]])
    assert kernels._sweep_pays(np.zeros((400, 400), np.uint8), visible, 50) == pays


@pytest.mark.parametrize(
    ("bins", "edges", "areas", "targets"),
    [
        (np.zeros((4, 4)), [[0, 0, 1, 1]], [1], np.zeros(256)),
        (np.zeros((4, 4, 3), np.uint8), [[0, 0, 1, 1]], [1], np.zeros(256)),
        (np.zeros((4, 4), np.uint8), [0, 0, 1, 1], [1], np.zeros(256)),
        (np.zeros((4, 4), np.uint8), [[0, 0, 1, 1]], [1, 1], np.zeros(256)),
        (np.zeros((4, 4), np.uint8), [[0, 0, 1, 1]], [1], np.zeros(16)),
    ],
)
def test_arrays_of_the_wrong_shape_never_reach_a_compiled_loop(bins, edges, areas, targets):
    with pytest.raises(ValueError, match=r"must be|need"):
        kernels.similarities(bins, edges, areas, targets)


def test_compiled_channels_equal_their_twin_to_the_bit(monkeypatch, frame):
    compiled = kernels.channel_integral(frame)
    monkeypatch.setattr(kernels, "compiled", lambda loop: None)
    np.testing.assert_array_equal(compiled, kernels.channel_integral(frame))


def test_bin_image_refuses_what_it_cannot_index():
    for hsv, table in [(np.zeros((4, 4)), np.zeros((256, 3))), (np.zeros((4, 4, 3), np.uint8), np.zeros((8, 3)))]:
        with pytest.raises(ValueError, match="need a"):
            kernels.bin_image(hsv, table)


@pytest.mark.parametrize("degrees", [15, 45, 75, 105, 135, 165])
def test_a_slope_falls_into_the_channel_of_its_orientation(loop, degrees):
    """The middle of channel c, of six over half a turn, is at 15 + 30 c degrees."""
    y, x = np.indices((64, 64))
    slope = 128 + 3 * (np.cos(np.radians(degrees)) * (x - 32) + np.sin(np.radians(degrees)) * (y - 32))
    frame = cv2.merge([np.clip(slope, 0, 255).round().astype(np.uint8)] * 3)
    totals = kernels.channel_integral(frame)[-1, -1, :6]
    assert totals.argmax() == (degrees - 15) // 30
    assert totals.max() > 0.8 * totals.sum()


def test_last_channels_sum_opencvs_lab(loop, frame):
    sums = kernels.channel_integral(frame)[..., 6:]
    np.testing.assert_array_equal(sums, cv2.integral(cv2.cvtColor(frame, cv2.COLOR_BGR2Lab)))


def test_cell_means_are_means_of_pixels(loop):
    pixels = np.random.default_rng(0).integers(0, 100, (30, 40, 2), dtype=np.int32)
    integral = np.pad(pixels, ((1, 0), (1, 0), (0, 0))).cumsum(axis=0).cumsum(axis=1).astype(np.int32)
    (means,) = kernels.cell_means(integral, [[4, 6, 12, 9]], (3, 4))
    for row, column in np.ndindex(3, 4):
        cell = pixels[6 + 3 * row : 9 + 3 * row, 4 + 3 * column : 7 + 3 * column]
        np.testing.assert_allclose(means[row, column], cell.mean(axis=(0, 1)))


def test_cells_outside_the_image_are_empty(loop, frame):
    integral = kernels.channel_integral(frame)
    means = kernels.cell_means(integral, [[-50, -50, 20, 20], [1000, 1000, 20, 20]], (2, 2))
    np.testing.assert_array_equal(means, 0)


def test_cell_means_refuse_what_they_cannot_index():
    for integral, boxes in [(np.zeros((4, 4, 1)), [[0, 0, 1, 1]]), (np.zeros((4, 4, 1), np.int32), [0, 0, 1, 1])]:
        with pytest.raises(ValueError, match="need boxes"):
            kernels.cell_means(integral, boxes, (1, 1))


def test_importing_the_library_does_not_import_numba():
    code = "import sys, pftrack; sys.exit('numba' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
