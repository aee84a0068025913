"""Maps of a segmentation network with known answers, the falloff of boundaries, and the classical stand-in."""

import numpy as np
import pytest

from tests.priors import networks as nw
from warpgs.errors import DataError
from warpgs.priors.networks import Preprocessing, open_network
from warpgs.priors.views import (
    SemanticMaps,
    _fast_length,
    boundary_weight,
    class_probabilities,
    classical_semantics,
    knows_foreground,
    network_semantics,
)

PLAIN = Preprocessing(32, 32, (0.0,) * 3, (1.0,) * 3, "classes")


def shapes(height=32, width=64):
    """Return a black image with a red and a blue rectangle, and the labels that the network gives them."""
    image, labels = np.zeros((height, width, 3), np.float32), np.zeros((height, width), int)
    image[8:20, 6:24, 0], labels[8:20, 6:24] = 0.9, 3
    image[12:30, 40:58, 2], labels[12:30, 40:58] = 0.7, 15
    return image, labels


def test_sides_of_reduced_images_are_quick_to_transform():
    """The largest product of 2, 3 and 5 up to a length."""
    products = sorted(2**a * 3**b * 5**c for a in range(10) for b in range(6) for c in range(4))
    for length in (1, 7, 193, 258, 511, 997):
        assert _fast_length(length) == max(p for p in products if p <= length)


def brute_boundary(labels):
    """Return exp(-d^2 / 2 s^2) by the distances of every pixel to all pixels at a label change."""
    height, width = labels.shape
    edges = []
    for i in range(height):
        for j in range(width):
            near = [(i + a, j + b) for a, b in ((0, 1), (1, 0), (0, -1), (-1, 0))]
            if any(0 <= k < height and 0 <= m < width and labels[k, m] != labels[i, j] for k, m in near):
                edges.append((i, j))
    i, j = np.mgrid[:height, :width]
    d2 = np.min([(i - a) ** 2 + (j - b) ** 2 for a, b in edges], axis=0)
    return np.exp(-d2 / (2 * (2 * width / 500) ** 2))


@pytest.mark.parametrize(
    "options", [{}, {"layout": "nhwc"}, {"size": (32, 64)}, {"then": "Softmax"}, {"layout": "nhwc", "then": "Softmax"}]
)
def test_maps_equal_the_formula(tmp_path, options):
    """Softmax, largest probability, 1 - background and falloff, for logits and probabilities, in both layouts."""
    image, labels = shapes()
    maps = network_semantics(open_network(nw.segmentation_network(tmp_path / "s.onnx", **options)), PLAIN, image)
    weights, bias = nw.segmentation_weights()
    p = np.exp(image.astype(float) @ weights.T + bias)
    p /= p.sum(-1, keepdims=True)
    assert (p.argmax(-1) == labels).all()
    for found, wanted in (
        (maps.confidence, p.max(-1)),
        (maps.foreground, 1 - p[..., 0]),
        (maps.boundary, brute_boundary(labels)),
    ):
        assert found.dtype == np.float32 and found.shape == labels.shape
        np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_a_coarse_network_puts_labels_where_they_are(tmp_path):
    """At a quarter of the size each label covers its object; a shift of half a pixel would show."""
    image, labels = np.zeros((128, 256, 3), np.float32), np.zeros((128, 256), int)
    image[32:80, 64:160, 0], labels[32:80, 64:160] = 0.9, 3
    network = open_network(nw.segmentation_network(tmp_path / "s.onnx", size=(32, 64)))
    p = class_probabilities(network, PLAIN, image)
    found = p.argmax(-1)
    # the object's outline lies on the coarse grid, so errors are the same on all sides
    assert (found == 3).sum() == pytest.approx((labels == 3).sum(), rel=0.06)
    rows, columns = np.nonzero(found == 3)
    assert (rows.min() + rows.max(), columns.min() + columns.max()) == (32 + 79, 64 + 159)
    np.testing.assert_allclose(p.sum(-1), 1, atol=1e-5)


@pytest.mark.parametrize("count", [1, 20, 22])
def test_another_number_of_classes_is_refused(tmp_path, count):
    path = nw.write(tmp_path / "s.onnx", nw.linear(np.random.default_rng(0).normal(size=(count, 3)), np.zeros(count)))
    with pytest.raises(DataError, match=f"{count}, 32, 64.*21 PASCAL VOC classes"):
        class_probabilities(open_network(path), PLAIN, shapes()[0])


def test_boundary_scales_with_the_width_and_is_nothing_without_labels():
    assert (boundary_weight(np.zeros((5, 7), int)) == 0).all()
    labels = np.zeros((4, 1000), int)
    labels[:, 500:] = 1
    weight = boundary_weight(labels)
    assert weight[0, 499] == weight[0, 500] == 1
    np.testing.assert_allclose(weight[2, 504], np.exp(-0.5), rtol=1e-6)  # 4 px at 1000 px


def test_when_foreground_is_known():
    def maps(foreground, boundary):
        return SemanticMaps(np.ones((10, 10)), np.full((10, 10), float(boundary)), np.full((10, 10), foreground))

    assert knows_foreground(maps(0.02, 1)) and not knows_foreground(maps(0.009, 1))
    assert not knows_foreground(maps(0.1, 0)), "every label is background"
    assert knows_foreground(maps(0.9, 0)), "every label is an object"


def test_classical_maps_show_an_object_and_its_outline():
    """A bright textured disc on dark ground is salient, with a boundary along its outline and none far away."""
    y, x = np.mgrid[:96, :128] + 0.5
    radius = np.hypot(x - 70, y - 45)
    disc = radius < 22
    image = np.where(disc[..., None], [0.9, 0.7, 0.2], [0.1, 0.12, 0.15])
    image = np.clip(image + np.random.default_rng(0).normal(0, 0.01, image.shape), 0, 1).astype(np.float32)
    maps = classical_semantics(image)
    for m in (maps.confidence, maps.boundary, maps.foreground):
        assert m.dtype == np.float32 and m.shape == disc.shape and 0 <= m.min() <= m.max() <= 1
    assert maps.foreground[disc].mean() > 2 * maps.foreground[radius > 40].mean() + 0.1
    assert maps.boundary[np.abs(radius - 22) < 0.7].mean() > 0.5 and maps.boundary[np.abs(radius - 22) > 6].max() < 0.01
    np.testing.assert_array_equal(maps.confidence, np.maximum(maps.foreground, 1 - maps.foreground))


def test_classical_maps_of_an_even_wall_are_finite():
    maps = classical_semantics(np.full((40, 50, 3), 0.5, np.float32))
    assert all(np.isfinite(m).all() for m in (maps.confidence, maps.boundary, maps.foreground)) and not maps.boundary.any()
