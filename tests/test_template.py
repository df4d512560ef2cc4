"""The ridge template against sums over pixels and against the objective that it minimises."""

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
