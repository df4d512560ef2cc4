"""The ridge template against sums over pixels and against the objective that it minimises."""

import cv2
import numpy as np
import pytest

from pftrack import datasets, kernels, metrics, template


@pytest.fixture(scope="module")
def scene():
    return datasets.load("synthetic-walk")


@pytest.fixture(scope="module")
def integral(scene):
    return kernels.channel_integral(scene.frames[0])


def test_orientations_have_unit_length_whatever_the_contrast(scene, integral):
    look = template.features(integral, scene.boxes[:3])
    assert look.shape == (3, 32 * 9 + 1)
    np.testing.assert_allclose(np.linalg.norm(look[:, : 32 * 6], axis=1), 1, atol=1e-4)


@pytest.mark.parametrize(("width", "side"), [(10, 1), (24, 1), (48, 2), (75, 3), (5000, 30)])
def test_image_is_reduced_to_the_target_but_never_enlarged(width, side):
    integral, found = template.reduced_channels(np.zeros((241, 320, 3), np.uint8), width)
    assert found == side
    assert integral.shape == (241 // side + 1, 320 // side + 1, 9)


@pytest.mark.parametrize("width", [20, 50, 80])
def test_channels_of_a_part_are_those_of_the_whole(width):
    """To the bit, also at the border, for boxes that reach beyond it, and when a second request needs more."""
    rng = np.random.default_rng(3)
    frame = cv2.GaussianBlur(rng.integers(0, 256, (241, 322, 3), dtype=np.uint8), (0, 0), 2)
    whole, side = template.reduced_channels(frame, width)
    part = template.PartialChannels(frame, width)
    assert part.side == side
    for left, top in [(120, 90), (130, 95), (-30, -20), (290, 200), (5, 150), (400, -300), (-200, 90)]:
        corners = np.array([left, top]) + rng.uniform(0, 15, (8, 2))
        boxes = np.hstack([corners, np.full((8, 2), [width, 2.5 * width])]) / side
        np.testing.assert_array_equal(template.features(part, boxes), template.features(whole, boxes))


def test_a_part_that_has_been_made_serves_again():
    part = template.PartialChannels(np.zeros((200, 300, 3), np.uint8), 24)
    large = part([[100, 50, 24, 60], [120, 60, 24, 60]])
    assert part([[110, 55, 24, 60]])[0] is large[0]
    assert part([[50, 55, 24, 60]])[0] is not large[0]
    assert large[0].size < 301 * 201 * 9 / 5


def test_coefficients_minimise_the_penalised_squared_error(monkeypatch, scene, integral):
    rng = np.random.default_rng(1)
    box = scene.boxes[0]
    model = template.RidgeTemplate(rng)
    samples = model._around(box, 40)
    monkeypatch.setattr(model, "_around", lambda box, n: samples)
    model.learn(integral, box)
    look, y = template.features(integral, samples), metrics.overlap(samples, np.tile(box, (len(samples), 1)))
    weights = np.where(np.arange(len(y)) == 0, 4, 1) / (len(y) + 3)
    penalty = model.ridge * (weights @ (look**2).sum(axis=1)) / look.shape[1]

    def error(coefficients):
        return weights @ (y - look @ coefficients) ** 2 + penalty * coefficients @ coefficients

    least = error(model.coefficients)
    for _ in range(50):
        assert error(model.coefficients + 1e-3 * rng.standard_normal(look.shape[1])) > least


def test_predicts_the_overlap_of_boxes_it_was_not_taught(scene, integral):
    box, rng = scene.boxes[0], np.random.default_rng(2)
    model = template.RidgeTemplate(rng)
    model.learn(integral, box)
    boxes = box + rng.uniform(-1, 1, (200, 4)) * box[[2, 3, 2, 3]] * [0.4, 0.4, 0, 0]
    overlap = metrics.overlap(boxes, np.tile(box, (200, 1)))
    assert np.corrcoef(overlap, model.predict(integral, boxes))[0, 1] > 0.9


def test_the_anchor_keeps_what_the_first_frame_taught(scene, integral):
    """Without an anchor, a hundred lessons about a piece of ground bring the forecast for the target down."""
    box = scene.boxes[0]
    here = {}
    for anchor in (0.0, 0.3):
        model = template.RidgeTemplate(np.random.default_rng(3), anchor=anchor)
        model.learn(integral, box)
        for _ in range(100):
            model.learn(integral, box + [1.5 * box[2], 0, 0, 0])
        (here[anchor],) = model.predict(integral, [box])
    print(here)
    assert here[0.3] > here[0.0] + 0.2
