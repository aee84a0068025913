"""Disparity from networks with known answers, and from depth that is consistent between views at some pixels."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.priors import networks as nw
from warpgs.errors import DataError
from warpgs.priors.networks import (
    DEFAULTS,
    HALF,
    IMAGENET,
    Preprocessing,
    complete_disparity,
    describe,
    network_disparity,
    open_network,
    resize,
    unit_range,
)

MEAN, STD = (0.4, 0.5, 0.6), (0.2, 0.25, 0.5)


def scaled(values):
    """Scale to [0, 1] by minimum and maximum, in float64."""
    return (values - values.min()) / (values.max() - values.min())


def photo(height, width, seed=0):
    return np.random.default_rng(seed).random((height, width, 3), np.float32)


def response(image, mean=MEAN, std=STD):
    """Return the depth network's answer to colours, in float64."""
    return ((image.astype(float) - mean) / std) @ nw.DEPTH_WEIGHTS[0] + nw.DEPTH_BIAS[0]


@pytest.mark.parametrize("layout", ["nchw", "nhwc"])
@pytest.mark.parametrize(("output", "sign"), [("disparity", 1), ("depth", -1)])
def test_normalisation_and_sign(tmp_path, layout, output, sign):
    """At the network's own size the map is the formula: colours normalised, depth inverted, scaled to [0, 1]."""
    image = photo(32, 64)
    how = Preprocessing(32, 32, MEAN, STD, output)
    if output == "depth":
        image = 0.5 + 0.5 * image  # keeps the response above 0
    found = network_disparity(open_network(nw.depth_network(tmp_path / "d.onnx", layout=layout)), how, image)
    assert found.dtype == np.float32 and found.shape == (32, 64) and (found.min(), found.max()) == (0, 1)
    np.testing.assert_allclose(found, scaled(response(image) ** sign), atol=2e-6)


def test_resizing_keeps_pixel_centres(tmp_path):
    """A ramp stays a ramp through a network of a quarter of the size, flat only beyond its outermost centres."""
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(64) + 0.5)
    image = np.repeat((x / 200 + y / 150)[..., None], 3, 2).astype(np.float32)
    network = open_network(nw.depth_network(tmp_path / "d.onnx", size=(16, 24)))
    found = network_disparity(network, Preprocessing(0, 0, (0.0,) * 3, (1.0,) * 3, "disparity"), image)
    np.testing.assert_allclose(found, scaled(x.clip(2, 94) / 200 + y.clip(2, 62) / 150), atol=1e-5)


def test_free_inputs_keep_proportions_and_multiples():
    how = Preprocessing(384, 32, *HALF, "disparity")
    assert how.free_size(378, 504) == (384, 512)
    assert how.free_size(1920, 1080) == (672, 384)
    assert Preprocessing(518, 14, *HALF, "disparity").free_size(378, 504) == (518, 686)
    assert how.free_size(10, 10_000)[0] == 384


def test_resize_is_linear_up_and_mean_down():
    image = photo(8, 12)
    np.testing.assert_allclose(resize(image, 4, 6), image.reshape(4, 2, 6, 2, 3).mean((1, 3)), atol=1e-6)
    wide = resize(np.float32([[0, 1]]), 1, 4)
    np.testing.assert_allclose(wide, [[0, 0.25, 0.75, 1]], atol=1e-6)
    many = np.random.default_rng(1).random((9, 13, 21), np.float32)
    for size in ((7, 8), (20, 30), (9, 13), (7, 30)):
        found = resize(many, *size)
        np.testing.assert_array_equal(found, np.stack([resize(many[..., c], *size) for c in range(21)], -1))


def test_depth_that_is_not_positive_is_refused(tmp_path):
    network = open_network(nw.depth_network(tmp_path / "d.onnx"))
    with pytest.raises(DataError, match=r"smallest depth is .*JSON file beside it"):
        network_disparity(network, Preprocessing(32, 32, (6.0,) * 3, (0.2,) * 3, "depth"), photo(32, 32))


def test_an_output_that_is_no_map_is_refused(tmp_path):
    network = open_network(nw.segmentation_network(tmp_path / "s.onnx"))
    with pytest.raises(DataError, match=r"shape \(1, 21, 384, 384\), not that of one depth map"):
        network_disparity(network, DEFAULTS, photo(32, 32))


def described(path):
    return describe(open_network(path), DEFAULTS, "depth")


def test_the_side_file_comes_before_what_is_usual(tmp_path):
    path = nw.depth_network(tmp_path / "d.onnx")
    how, notes = described(path)
    assert how == DEFAULTS
    assert notes == [
        "d.onnx: assumed size 384, multiple 32, mean 0.5 0.5 0.5, std 0.5 0.5 0.5, output disparity; "
        "to change them, write d.onnx.json"
    ]
    side = {"size": 518, "multiple": 14, "mean": IMAGENET[0], "std": IMAGENET[1], "output": "depth"}
    (tmp_path / "d.onnx.json").write_text(json.dumps(side))
    assert described(path) == (Preprocessing(518, 14, *IMAGENET, "depth"), [])


def test_the_documented_side_file_is_one(tmp_path):
    (text,) = re.findall(r"```json\n(.*?)```", (Path(__file__).parents[2] / "docs" / "priors.md").read_text("utf-8"), re.DOTALL)
    (tmp_path / "d.onnx.json").write_text(text)
    assert described(nw.depth_network(tmp_path / "d.onnx")) == (Preprocessing(518, 14, *IMAGENET, "disparity"), [])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "cannot be read"),
        ("[1]", "no JSON object"),
        ('{"men": [0, 0, 0]}', "key 'men' is unknown; size, multiple, mean, std, output"),
        ('{"mean": [0, 0]}', "mean must be three numbers"),
        ('{"mean": [0, 0, NaN]}', "mean must be three numbers"),
        ('{"std": [1, 1, 0]}', "std must be three numbers above 0"),
        ('{"size": 1.5}', "size must be a whole number"),
        ('{"multiple": true}', "multiple must be a whole number"),
        ('{"output": "height"}', "output must be disparity, depth or classes, not 'height'"),
    ],
)
def test_side_files_with_faults(tmp_path, text, message):
    (tmp_path / "d.onnx.json").write_text(text)
    with pytest.raises(DataError, match=message):
        described(nw.depth_network(tmp_path / "d.onnx"))


def test_a_size_against_the_graph_is_refused(tmp_path):
    path = nw.depth_network(tmp_path / "d.onnx", size=(32, 48))
    for size in (64, 32):
        (tmp_path / "d.onnx.json").write_text(json.dumps({"size": size}))
        if size == 32:
            assert described(path)[0].mean == DEFAULTS.mean
        else:
            with pytest.raises(DataError, match=r"size 64, but .* takes 48 x 32 px only"):
                described(path)


def test_unit_range_of_a_wall_is_zero():
    assert (unit_range(np.full((3, 4), 7.0)) == 0).all()
    assert unit_range(np.array([[3.0, 5.0, 4.0]])).tolist() == [[0, 1, 0.5]]


# completion


def two_planes(height=60, width=80, seed=0):
    """Return a slanted near plane, red, before a far one, blue: colours and true inverse depth."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    near = (x > 25) & (x < 60) & (y > 15)
    image = np.where(near[..., None], [0.8, 0.2, 0.1], [0.1, 0.2, 0.7])
    image += np.random.default_rng(seed).normal(0, 0.005, image.shape)
    return image.astype(np.float32), np.where(near, 0.8 + 0.002 * y, 0.3), near


def test_gaps_are_filled_up_to_the_colour_edge_and_not_across():
    """Four valid pixels of a hundred suffice; the object's edge stays where the colours have it."""
    image, inverse, near = two_planes()
    valid = np.random.default_rng(1).random(near.shape) < 0.04
    depth = np.where(valid, 1 / inverse, 0).astype(np.float32)
    found = complete_disparity(image, depth, valid, np.where(valid, 0.01, np.inf))
    assert found.dtype == np.float32 and found.shape == near.shape and (found.min(), found.max()) == (0, 1)
    wanted = scaled(inverse)
    assert np.abs(found - wanted).max() < 0.08 and np.abs(found - wanted).mean() < 0.02
    assert ((found > 0.5) == near).all()


def test_completion_knows_no_unit_of_length():
    image, inverse, near = two_planes()
    valid = np.random.default_rng(1).random(near.shape) < 0.1
    depth = np.where(valid, 1 / inverse, 0)
    sensitivity = np.where(valid, 0.01 / inverse**2, np.inf)
    found = complete_disparity(image, depth, valid, sensitivity)
    np.testing.assert_allclose(complete_disparity(image, 1000 * depth, valid, 1000 * sensitivity), found, atol=1e-4)


def test_badly_conditioned_depths_yield():
    """Every tenth depth is wrong by half; where its sensitivity is large too, the map hardly changes."""
    image, inverse, near = two_planes()
    rng = np.random.default_rng(2)
    valid, wrong = rng.random(near.shape) < 0.3, rng.random(near.shape) < 0.1
    truth, errors = scaled(inverse), []
    for factor, told in ((1, 1), (1.5, 50), (1.5, 1)):
        depth = np.where(valid, np.where(wrong, factor, 1) / inverse, 0)
        sensitivity = np.where(valid, np.where(wrong, told, 1) * 0.02 / inverse**2, np.inf)
        errors.append(np.abs(complete_disparity(image, depth, valid, sensitivity) - truth).mean())
    right, warned, fooled = errors
    assert warned < 1.1 * right and fooled > 1.7 * right, errors


def test_weights_are_those_of_inverse_depth():
    """Depths 1 and 2 with equally uncertain inverses get the same weight on one surface."""
    columns = np.arange(90) // 30 + np.zeros((40, 1), int)
    image = np.repeat((0.1 + 0.4 * columns)[..., None], 3, 2).astype(np.float32)
    board = np.indices((40, 90)).sum(0) % 2 == 0
    depth = np.where((columns == 0) | ((columns == 1) & board), 1.0, 2.0)
    found = complete_disparity(image, depth, np.ones(depth.shape, bool), 0.1 * depth**2)
    assert abs(found[5:-5, 35:55].mean() - 0.5) < 0.02
    assert found[:, :25].min() > 0.95 and found[:, 65:].max() < 0.05


def test_one_depth_and_one_far_wild_depth():
    image, inverse, near = two_planes()
    lone = np.zeros(near.shape, bool)
    lone[30, 40] = True
    assert (complete_disparity(image, np.where(lone, 2.0, 0), lone, np.where(lone, 0.1, np.inf)) == 0).all()
    everywhere = np.ones(near.shape, bool)
    depth = 1 / inverse
    depth[0, 0] = 1e-6  # a million times nearer than all else
    sensitivity = np.full(near.shape, 0.1)
    sensitivity[0, 0] = 0  # and quite sure of it
    found = complete_disparity(image, depth, everywhere, sensitivity)
    assert found[near].mean() - found[~near].mean() > 0.8


def test_without_any_depth_there_is_nothing_to_complete():
    image, inverse, near = two_planes()
    nowhere, unknown = np.zeros(near.shape, bool), np.full(near.shape, np.inf)
    with pytest.raises(DataError, match="no pixel has a depth"):
        complete_disparity(image, 1 / inverse, nowhere, unknown)
    with pytest.raises(DataError, match="no pixel has a depth"):
        complete_disparity(image, np.full(near.shape, np.nan), ~nowhere, unknown)
    # a depth without a known sensitivity still counts, if least
    assert np.isfinite(complete_disparity(image, 1 / inverse, ~nowhere, unknown)).all()
