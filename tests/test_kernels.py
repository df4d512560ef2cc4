"""The compiled loops against their NumPy twins, and both against OpenCV and closed forms."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

import pftrack
from pftrack import color, kernels, motion, smc
from pftrack.trackers.color_pf import particle_boxes


@pytest.fixture(params=["compiled", "twin"])
def loop(request, monkeypatch):
    """Run a test twice: with the compiled loops, and as if numba could not be imported."""
    if request.param == "twin":
        monkeypatch.setattr(kernels, "compiled", lambda *_, **__: None)
    elif kernels.compiled(kernels._comb_loop) is None:
        pytest.skip("numba is not installed")


@pytest.fixture
def frame():
    """Smooth random colours, so that bins come in patches."""
    noise = np.random.default_rng(1).integers(0, 256, size=(60, 80, 3), dtype=np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 3, borderType=cv2.BORDER_REPLICATE) * 3


def random_edges(rng, n, width=80, height=60):
    """Rectangles in and around an image, some of them beyond its border."""
    left, top = rng.integers(-30, width + 10, n), rng.integers(-30, height + 10, n)
    return np.stack([left, top, left + rng.integers(1, 50, n), top + rng.integers(1, 50, n)], axis=1)


def by_loop(name, bins, edges, targets):
    """Similarities by one of the two loops, whatever the cost model would choose; "library" leaves it the choice."""
    if name == "library":
        return kernels.similarities(bins, edges, targets)
    edges, colors = np.asarray(edges, dtype=np.int64), kernels.palette(targets)
    survey = kernels.compiled(kernels._survey_loop)
    regions, region_of, areas, cover, _, largest = survey(edges, *bins.shape, (0, 0), len(colors.roots), True)
    if name == "direct":
        totals = kernels.compiled(kernels._direct_loop, reorder=True)(bins, regions, colors.used, colors.roots)
    else:
        counter = np.zeros(0, dtype=np.uint16 if largest < 2**16 else np.uint32)
        sweep = kernels.compiled(kernels._sweep_loop, reorder=True)
        totals = sweep(bins, regions, cover, colors.numbers, colors.roots, counter)
    return np.where(region_of >= 0, np.minimum(np.append(totals, 0)[region_of] / np.sqrt(np.maximum(areas, 1)), 1), 0)


each_way = pytest.mark.parametrize("way", ["direct", "sweep", "library"])


@each_way
def test_similarity_is_what_opencv_compares(way, frame):
    bins, rng = color.hsv_bins(frame), np.random.default_rng(2)
    target = cv2.calcHist([bins[10:40, 20:40]], [0], None, [256], [0, 256])
    edges = np.clip(random_edges(rng, 200), 0, [79, 59, 80, 60])
    edges[:, 2:] = np.maximum(edges[:, 2:], edges[:, :2] + 1)
    rho = by_loop(way, bins, edges, target.T / target.sum())
    for (left, top, right, bottom), coefficient in zip(edges, rho, strict=True):
        histogram = cv2.calcHist([bins[top:bottom, left:right]], [0], None, [256], [0, 256])
        distance = cv2.compareHist(target, histogram, cv2.HISTCMP_BHATTACHARYYA)
        assert np.sqrt(1 - coefficient) == pytest.approx(distance, abs=1e-6)


@each_way
@pytest.mark.parametrize("n_changed", [0, 1, 2, 5, 20, 60, 90, 100, 120, 200, 400])
def test_small_distances_are_as_exact_as_large_ones(way, n_changed):
    """On both sides of the threshold at which square roots become double."""
    bins = np.repeat(np.arange(4, dtype=np.uint8), 600).reshape(4, 600)
    target = np.bincount(bins.ravel(), minlength=256) / bins.size
    bins[0, :n_changed] = 3
    shares = np.bincount(bins.ravel(), minlength=256) / bins.size
    truth = np.sqrt(max(1 - np.sqrt(shares * target).sum(), 0))
    (rho,) = by_loop(way, bins, [[0, 0, 600, 4]], target)
    assert np.sqrt(1 - rho) == pytest.approx(truth, abs=1e-6)


@each_way
def test_rectangles_take_their_targets_in_turn(way):
    bins = np.repeat(np.uint8([[3, 200]]), 4, axis=1)
    targets = np.zeros((2, 256))
    targets[0, 3] = targets[1, 200] = 1
    edges = [[0, 0, 4, 1], [0, 0, 4, 1], [4, 0, 8, 1], [4, 0, 8, 1]]
    np.testing.assert_array_equal(by_loop(way, bins, edges, targets), [1, 0, 0, 1])


@each_way
def test_what_lies_outside_the_image_is_not_read(way):
    bins = np.full((4, 4), 9, dtype=np.uint8)
    edges = [[-100, -100, 200, 200], [-3, 0, 1, 4], [50, 50, 60, 60], [-9, -9, -1, -1], [3, 3, 2, 2], [0, 4, 4, 4]]
    np.testing.assert_allclose(by_loop(way, bins, edges, np.eye(256)[9]), [4 / 300, 0.5, 0, 0, 0, 0])


@pytest.mark.parametrize("edges", [np.empty((0, 4)), [[5, 5, 9, 9]], [[2, 2, 2, 2]]])
def test_nothing_visible_is_like_nothing(loop, edges):
    rho = kernels.similarities(np.zeros((4, 4), np.uint8), edges, np.eye(256)[0])
    np.testing.assert_array_equal(rho, np.zeros(len(edges)))
    assert kernels.similarities(np.zeros((0, 0), np.uint8), edges, np.eye(256)[0]).sum() == 0


def test_what_lies_outside_can_be_ignored(loop):
    bins = np.full((4, 4), 9, dtype=np.uint8)
    rho = kernels.similarities(bins, [[-4, 0, 4, 4], [0, 0, 2, 2], [8, 8, 9, 9]], np.eye(256)[9], outside="ignore")
    np.testing.assert_array_equal(rho, [1, 1, 0])


def test_a_part_of_the_bins_with_its_origin_will_do(loop, frame):
    bins, edges = color.hsv_bins(frame), np.array([[22, 13, 40, 30], [25, 10, 45, 41], [22, 13, 40, 30]])
    target = color.histograms(bins, [[20, 10, 20, 30]])[0]
    whole = kernels.similarities(bins, edges, target)
    left, top, right, bottom = kernels.cover(edges, 60, 80)
    assert (left, top, right, bottom) == (21, 9, 46, 42)
    part = kernels.similarities(bins[top:bottom, left:right], edges, target, origin=(left, top))
    np.testing.assert_array_equal(part, whole)
    assert whole.min() > 0.1


@pytest.mark.parametrize("sparse", [True, False])
@pytest.mark.parametrize("n_targets", [1, 3])
def test_all_loops_agree(monkeypatch, frame, sparse, n_targets):
    bins, rng = color.hsv_bins(frame), np.random.default_rng(3)
    targets = rng.dirichlet(np.full(256, 0.02 if sparse else 5.0), size=n_targets)
    edges = random_edges(rng, 300)[rng.integers(300, size=600)]  # with duplicates
    found = [by_loop(way, bins, edges, targets) for way in ("direct", "sweep", "library")]
    monkeypatch.setattr(kernels, "compiled", lambda *_, **__: None)
    truth = kernels.similarities(bins, edges, targets)
    assert len(np.unique(truth)) > 100
    np.testing.assert_allclose(found, [truth] * 3, rtol=0, atol=1e-12)


def test_the_loops_mean_the_same_before_they_are_compiled(frame):
    """Plain Python checks what numba does not: that no index leaves its array."""
    bins, edges = color.hsv_bins(frame), random_edges(np.random.default_rng(4), 30)
    colors = kernels.palette(color.histograms(bins, [[20, 10, 20, 30]]))
    regions, region_of, _, cover, n_pixels, largest = kernels._survey_loop(edges, 60, 80, (0, 0), 1, True)
    direct = kernels._direct_loop(bins, regions, colors.used, colors.roots)
    sweep = kernels._sweep_loop(bins, regions, cover, colors.numbers, colors.roots, np.zeros(0, np.uint32))
    np.testing.assert_allclose(direct, sweep, rtol=1e-12)
    visible = np.clip(edges, 0, [80, 60, 80, 60])
    areas = np.prod(visible[:, 2:] - visible[:, :2], axis=1)
    np.testing.assert_array_equal(region_of >= 0, areas > 0)
    assert largest == areas.max()
    assert n_pixels == areas.sum()


def test_equal_rectangles_are_counted_once():
    edges = np.array([[0, 0, 9, 9], [1, 0, 9, 9], [0, 0, 9, 9], [-5, 0, 9, 9], [1, 0, 9, 9]])
    regions, region_of, *_ = kernels._survey_loop(edges, 20, 20, (0, 0), 1, True)
    assert region_of.tolist() == [0, 1, 0, 0, 1]  # cut to the image, the fourth is the first
    np.testing.assert_array_equal(regions[:, :4], edges[:2])
    assert kernels._survey_loop(edges, 20, 20, (0, 0), 2, True)[1].tolist() == [0, 1, 0, 2, 3]  # two targets in turn


@pytest.mark.parametrize("side", [200, 300])
def test_counters_may_overflow(side):
    """Two rectangles of one colour under 90,000 pixels of it; the larger has more pixels than 16 bits can count."""
    bins = np.zeros((600, 300), dtype=np.uint8)
    bins[300:, 250:] = 1
    edges = [[300 - side, 300, 300, 300 + side], [0, 310, 50, 360]]
    rho = by_loop("sweep", bins, edges, np.eye(256)[0])
    np.testing.assert_allclose(rho, [np.sqrt(1 - 50 / side), 1], rtol=1e-7)


@pytest.mark.parametrize(
    ("n_regions", "area", "width", "height", "pays"),
    [(1000, 2400, 80, 130, True), (100, 2400, 80, 130, True), (1, 2400, 32, 82, False), (10, 100, 600, 400, False)],
)
def test_the_sweep_is_for_many_rectangles_close_together(n_regions, area, width, height, pays):
    assert kernels._sweep_pays(n_regions * area, n_regions, width, height, 64) == pays


@pytest.mark.parametrize(
    ("bins", "edges", "targets"),
    [
        (np.zeros((4, 4)), [[0, 0, 1, 1]], np.zeros(256)),
        (np.zeros((4, 4, 3), np.uint8), [[0, 0, 1, 1]], np.zeros(256)),
        (np.zeros((4, 4), np.uint8), [0, 0, 1, 1], np.zeros(256)),
        (np.zeros((4, 4), np.uint8), [[0, 0, 1, 1]], np.zeros(16)),
        (np.zeros((4, 4), np.uint8), [[0, 0, 1, 1]], np.full(256, np.nan)),
    ],
)
def test_arrays_of_the_wrong_shape_never_reach_a_compiled_loop(bins, edges, targets):
    with pytest.raises(ValueError, match=r"must be|must have"):
        kernels.similarities(bins, edges, targets)


def test_outside_is_one_of_two_words():
    with pytest.raises(ValueError, match="mismatch"):
        kernels.similarities(np.zeros((4, 4), np.uint8), [[0, 0, 1, 1]], np.zeros(256), outside="reflect")


def test_a_palette_of_all_bins_has_room_for_them():
    colors = kernels.palette(np.full(256, 1 / 256))
    np.testing.assert_array_equal(colors.numbers, np.arange(256))
    np.testing.assert_allclose(colors.roots, 1 / 16)
    assert kernels.palette(np.eye(256)[:255].sum(axis=0)).roots.shape == (1, 256)


def test_every_level_has_its_bin(loop):
    """All hues, saturations and values of OpenCV's 8-bit HSV."""
    hue, saturation, value = np.meshgrid(np.arange(180), np.arange(256), np.arange(0, 256, 5), indexing="ij")
    hsv = np.stack([hue, saturation, value], axis=-1).reshape(180, -1, 3)
    expected = 32 * (hsv[..., 0] * 8 // 180) + 4 * (hsv[..., 1] // 32) + hsv[..., 2] // 64
    np.testing.assert_array_equal(kernels.bin_image(hsv.astype(np.uint8)), expected)


def test_bin_image_takes_any_part_of_an_image_and_nothing_else(loop):
    hsv = np.random.default_rng(4).integers(0, 180, (20, 30, 3), dtype=np.uint8)
    np.testing.assert_array_equal(kernels.bin_image(hsv[::-1, ::2]), kernels.bin_image(hsv)[::-1, ::2])
    for wrong in (np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3))):
        with pytest.raises(ValueError, match="need a"):
            kernels.bin_image(wrong)


@pytest.mark.parametrize("n_teeth", [1, 7, 1000, 5000])
@pytest.mark.parametrize("one_shift", [True, False])
def test_a_comb_finds_what_a_search_in_the_cumulative_weights_finds(loop, n_teeth, one_shift):
    rng = np.random.default_rng(5)
    weights = rng.dirichlet(np.full(1000, 0.1))
    weights[[0, 500, 998, 999]] = 0
    shifts = rng.random(1 if one_shift else n_teeth)
    ancestors, smallest, total = kernels.comb(weights, shifts, n_teeth)
    truth = np.searchsorted(np.cumsum(weights / weights.sum()), (np.arange(n_teeth) + shifts) / n_teeth, side="right")
    np.testing.assert_array_equal(ancestors, truth)
    assert smallest == 0
    assert total == pytest.approx(weights.sum())


@pytest.mark.parametrize("weights", [[np.nan, 1], [-3, 4], [0, 0], [np.inf, 1], [1e300, 1e300]])
def test_a_comb_never_leaves_its_arrays(weights):
    ancestors, *_ = kernels.compiled(kernels._comb_loop)(np.array(weights, dtype=float), np.array([0.5]), 8)
    assert set(ancestors.tolist()) <= {0, 1}


@pytest.mark.parametrize("shifts", [np.zeros(3), np.zeros((1, 1))])
def test_a_comb_needs_one_shift_or_one_for_each_tooth(shifts):
    with pytest.raises(ValueError, match="need weights"):
        kernels.comb(np.ones(4) / 4, shifts, 4)


@pytest.mark.parametrize("n_particles", [20, 2000])
def test_particles_move_as_the_paper_says(loop, n_particles):
    """Few and many: NumPy and numba draw the same random numbers."""
    rng = np.random.default_rng(6)
    particles, noise = rng.normal([50, 40, 3, -2, 1], 1.0, (n_particles, 5)), np.array([4, 4, 1, 1, 0.2])
    moved, edges = kernels.move(particles, noise, np.random.default_rng(7), 0.5, (0.5, 1.5), (10, 20))
    truth = motion.linear_gaussian(particles, motion.constant_velocity(0.5), noise, np.random.default_rng(7))
    truth[:, 4] = truth[:, 4].clip(0.5, 1.5)
    np.testing.assert_allclose(moved, truth, rtol=1e-14)
    np.testing.assert_array_equal(edges, color.pixel_edges(particle_boxes(moved, (10, 20))))


def test_drawing_in_a_loop_leaves_the_generator_where_numpy_would():
    rng, same = np.random.default_rng(8), np.random.default_rng(8)
    kernels.move(np.zeros((1000, 5)), np.zeros(5), rng, 1.0, (0.5, 2), (4, 4))
    same.standard_normal((1000, 5))
    assert rng.random() == same.random()


def test_weighing_is_what_its_parts_are(loop):
    rng = np.random.default_rng(9)
    log_weights, states = rng.normal(-900, 5, 500), rng.normal(size=(500, 3))
    weights, mean, n_effective, log_total = kernels.weigh(log_weights, states)
    np.testing.assert_allclose(weights, smc.normalize(log_weights), rtol=1e-12)
    np.testing.assert_allclose(mean, smc.weighted_mean(states, weights), rtol=1e-12)
    assert n_effective == pytest.approx(smc.effective_sample_size(weights))
    assert log_total == pytest.approx(smc.log_sum_exp(log_weights))


def test_no_weight_at_all_is_the_same_for_all(loop):
    weights, mean, n_effective, log_total = kernels.weigh(np.full(4, -np.inf), np.arange(4.0)[:, None])
    np.testing.assert_array_equal(weights, 0.25)
    assert (mean, n_effective, log_total) == (1.5, 4, -np.inf)


@pytest.mark.parametrize("worst", [np.nan, np.inf])
def test_weights_that_are_no_numbers_are_refused(loop, worst):
    with pytest.raises(ValueError, match="NaN"):
        kernels.weigh([0.0, worst], np.zeros((2, 1)))


def test_observing_is_what_its_parts_are(loop, frame):
    bins, rng = color.hsv_bins(frame), np.random.default_rng(10)
    target = color.histograms(bins, [[30, 15, 12, 24]])[0]
    particles = rng.normal([36, 27, 0, 0, 1], [4, 4, 1, 1, 0.1], (50, 5))
    boxes, before = particle_boxes(particles, (12, 24)), rng.normal(size=50)
    arguments = particles, color.pixel_edges(boxes), before, kernels.palette(target), 0.2, (12, 24), "mismatch"
    log_weights, weights, n_effective, mean, box, similarity = kernels.observe(bins, (0, 0), *arguments)
    density = color.log_likelihood(frame, boxes, target, 0.2) + np.log(0.2 * np.sqrt(2 * np.pi))
    np.testing.assert_allclose(log_weights, before + density, rtol=1e-9)
    np.testing.assert_allclose(weights, smc.normalize(log_weights), rtol=1e-12)
    np.testing.assert_allclose(mean, smc.weighted_mean(particles, weights), rtol=1e-12)
    np.testing.assert_allclose(box, particle_boxes([mean], (12, 24))[0], rtol=1e-12)
    assert n_effective == pytest.approx(smc.effective_sample_size(weights))
    assert np.sqrt(1 - similarity) == pytest.approx(color.distances(frame, [box], target)[0], abs=1e-9)


def test_what_is_observed_must_fit_together():
    colors, bins = kernels.palette(np.eye(256)[0]), np.zeros((4, 4), np.uint8)
    with pytest.raises(ValueError, match="need particles"):
        kernels.observe(bins, (0, 0), np.zeros((2, 5)), [[0, 0, 1, 1]], [0.0, 0.0], colors, 0.1, (1, 1), "ignore")
    with pytest.raises(ValueError, match="need particles"):
        kernels.move(np.zeros((2, 3)), np.zeros(5), np.random.default_rng(0), 1.0, (1, 2), (1, 1))
    with pytest.raises(ValueError, match="need log-weights"):
        kernels.weigh([], np.zeros((0, 2)))


def test_a_loop_is_compiled_once_whoever_calls_it():
    """Compiling takes seconds: lists, slices and other types must not bring a second signature into being."""
    scene = pftrack.datasets.load("synthetic-walk")
    for tracker in (
        pftrack.ColorParticleFilter(100),
        pftrack.ColorParticleFilter(1000),
        pftrack.RobustParticleFilter(),
    ):
        pftrack.track(tracker, scene.frames[:4], scene.boxes[0].tolist())
    color.distances(scene.frames[0][:, ::-1], [[3, 4, 20, 30]], color.histograms(scene.frames[0], [[9, 9, 9, 9]])[0])
    smc.stratified([0.5, 0.5], np.random.default_rng(0))
    unordered = kernels._observe_loop, kernels._similarities_loop, kernels._weigh_loop
    ordered = kernels._bin_image_loop, kernels._comb_loop, kernels._cover_loop, kernels._draw_and_move_loop
    dispatchers = [kernels.compiled(loop, reorder=True) for loop in unordered] + [kernels.compiled(f) for f in ordered]
    assert [len(dispatcher.signatures) for dispatcher in dispatchers] == [1] * len(dispatchers)


@pytest.mark.parametrize("name", ["bobot-I", "synthetic-occlusion"])
@pytest.mark.parametrize("tracker", [pftrack.ColorParticleFilter, pftrack.RobustParticleFilter])
def test_trackers_give_the_boxes_of_the_numpy_twins(monkeypatch, tracker, name):
    sequence = pftrack.datasets.load(name)
    n_frames = 25 if tracker is pftrack.RobustParticleFilter else 60
    frames, box = [sequence.frames[t] for t in range(n_frames)], sequence.boxes[0]
    fast = pftrack.track(tracker(seed=1), frames, box)
    monkeypatch.setattr(kernels, "compiled", lambda *_, **__: None)
    np.testing.assert_allclose(fast, pftrack.track(tracker(seed=1), frames, box), rtol=0, atol=1e-6)


def test_compiled_channels_equal_their_twin_to_the_bit(monkeypatch, frame):
    compiled = kernels.channel_integral(frame)
    monkeypatch.setattr(kernels, "compiled", lambda loop: None)
    np.testing.assert_array_equal(compiled, kernels.channel_integral(frame))


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
