"""Priors of views end to end: sources, fallbacks, cache, notes."""

import json
from dataclasses import dataclass

import numpy as np
import pytest

from tests.priors import networks as nw
from tests.priors.test_depth import response, scaled, two_planes
from tests.priors.test_semantics import shapes
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.priors.views import PriorConfig, view_priors
from warpgs.process import Detail
from warpgs.scene import Camera, View

PLAIN = {"size": 32, "mean": [0, 0, 0], "std": [1, 1, 1]}
DEPTH = {"size": 32, "mean": [0.4, 0.5, 0.6], "std": [0.2, 0.25, 0.5]}


@dataclass(frozen=True)
class Depth:
    """A stand-in for `warpgs.scene.ViewDepth`."""

    depth: np.ndarray
    valid: np.ndarray
    sensitivity: np.ndarray


def view(image, name="a.png", mask=None):
    height, width = image.shape[:2]
    return View(name, Camera(np.eye(4), np.eye(3), width, height), image, mask)


def dark(name="dark.png"):
    """Return an image in which the network finds background alone."""
    return view(0.02 * np.random.default_rng(1).random((32, 64, 3), np.float32), name)


def networks(tmp_path, depth=None, **more):
    """Two networks, with a description of the input beside each; without one for ``depth``, the usual values are assumed."""
    (tmp_path / "s.onnx.json").write_text(json.dumps(PLAIN))
    if depth:
        (tmp_path / "d.onnx.json").write_text(json.dumps(depth))
    return PriorConfig(
        depth_model=nw.depth_network(tmp_path / "d.onnx"),
        segmentation_model=nw.segmentation_network(tmp_path / "s.onnx"),
        **more,
    )


def check(prior, shape):
    """Assert that every map is float32, finite, in [0, 1] and of the view's size."""
    for m in (prior.disparity, prior.confidence, prior.boundary, prior.foreground):
        assert m.dtype == np.float32 and m.shape == shape and m.min() >= 0 and m.max() <= 1
    assert prior.depth_source and prior.semantics_source


def test_networks_give_the_maps_and_the_notes_say_what_was_assumed(tmp_path):
    image, labels = shapes()
    config = networks(tmp_path, DEPTH)
    (prior,), notes = view_priors([view(image)], config)
    check(prior, labels.shape)
    np.testing.assert_allclose(prior.disparity, scaled(response(image)), atol=2e-6)
    assert ((prior.foreground > 0.5) == (labels > 0)).all()
    assert "d.onnx (SHA-256 " in prior.depth_source and "s.onnx (SHA-256 " in prior.semantics_source
    text = "\n".join(notes)
    assert "d.onnx: assumed multiple 32, output disparity" in text and "s.onnx: assumed multiple 32;" in text


def test_output_depth_turns_the_map_over(tmp_path):
    image = 0.5 + 0.5 * np.random.default_rng(0).random((32, 32, 3), np.float32)
    (disparity,), _ = view_priors([view(image)], networks(tmp_path, DEPTH))
    (depth,), notes = view_priors([view(image)], networks(tmp_path, DEPTH | {"output": "depth"}))
    np.testing.assert_allclose(depth.disparity, scaled(1 / response(image)), atol=2e-6)
    assert disparity.disparity.argmax() == depth.disparity.argmin() and any("gives depth" in n for n in notes)


def test_maps_are_kept_and_found_again(tmp_path):
    views = [view(shapes()[0], "a.png"), view(1 - shapes()[0], "b.png")]
    config, folder = networks(tmp_path), tmp_path / "cache"
    first, notes = view_priors(views, config, cache=folder)
    assert len(list(folder.iterdir())) == 4 and not any("there already" in n for n in notes)
    second, notes = view_priors(views, config, cache=folder)
    assert f"priors: 4 of 4 maps were read from the cache {folder}" in notes
    for f, s in zip(first, second):
        for name in ("disparity", "confidence", "boundary", "foreground"):
            np.testing.assert_array_equal(getattr(f, name), getattr(s, name))
    # another description, another file, no folder: nothing old is taken
    _, notes = view_priors(views, networks(tmp_path, {"multiple": 16}), cache=folder)
    assert any("2 of 4 maps" in n for n in notes)
    nw.write(tmp_path / "d.onnx", nw.linear(2 * nw.DEPTH_WEIGHTS, nw.DEPTH_BIAS))
    _, notes = view_priors(views, config, cache=folder)
    assert any("2 of 4 maps" in n for n in notes)
    count = len(list(folder.iterdir()))
    _, notes = view_priors(views, networks(tmp_path, {"multiple": 8}))
    assert len(list(folder.iterdir())) == count and not any("there already" in n for n in notes)


def test_a_side_file_decides_the_entry_too(tmp_path):
    folder = tmp_path / "cache"
    view_priors([view(shapes()[0])], networks(tmp_path), cache=folder)
    (tmp_path / "d.onnx.json").write_text(json.dumps({"mean": [0.1, 0.2, 0.3], "output": "disparity"}))
    _, notes = view_priors([view(shapes()[0])], networks(tmp_path), cache=folder)
    assert any("1 of 2 maps" in n for n in notes)


def test_a_region_stands_in_where_the_network_finds_no_foreground(tmp_path):
    region = np.zeros((32, 64), bool)
    region[10:20, 20:40] = True
    views = [dark("a.png"), view(shapes()[0], "b.png"), dark("c.png"), dark("d.png")]
    regions = [region, region, None, np.ones((32, 64), bool)]
    priors, notes = view_priors(views, networks(tmp_path), regions=regions)
    assert (priors[0].foreground == region).all() and "mask or black background" in priors[0].semantics_source
    assert priors[0].boundary[10, 20] == 1 and priors[0].boundary[0, 0] < 1e-6
    assert ((priors[1].foreground > 0.5) == (shapes()[1] > 0)).all(), "the network knows better"
    for p in priors[2:]:  # no region, or one that is no object
        assert not p.foreground.any() and not p.boundary.any() and p.semantics_source.startswith("none")
        check(p, (32, 64))
    text = "\n".join(notes)
    assert "gave the foreground of a.png" in text and "no score for c.png, d.png, which have hardly any foreground" in text


def test_a_region_beats_saliency():
    region = np.zeros((32, 64), bool)
    region[10:20, 20:40] = True
    (prior,), notes = view_priors([view(shapes()[0])], PriorConfig(), regions=[region])
    assert (prior.foreground == region).all() and (prior.confidence == 1).all()
    assert any("a mask is more reliable than saliency" in n and isinstance(n, Detail) for n in notes)


def test_classical_sources_say_so():
    image, inverse, near = two_planes()
    valid = np.random.default_rng(1).random(near.shape) < 0.1
    consistent = Depth(np.where(valid, 1 / inverse, 0), valid, np.where(valid, 0.01, np.inf))
    nothing = Depth(np.zeros(near.shape), np.zeros(near.shape, bool), np.full(near.shape, np.inf))
    views = [view(image, "a.png"), view(image, "b.png")]
    (a, b), notes = view_priors(views, PriorConfig(), depths=lambda: [consistent, nothing])
    for p in (a, b):
        check(p, near.shape)
    assert a.disparity[near].min() > a.disparity[~near].max() and f"{valid.mean():.1%}" in a.depth_source
    assert not b.disparity.any() and b.depth_source == "none"
    text = "\n".join(notes)
    assert f"0.0% to {valid.mean():.1%} of a view's pixels" in text and "no consistent depth in b.png" in text
    assert "saliency is used as foreground" in text and "--segmentation-model" in text


def test_without_any_depth_geometry_does_not_count():
    (prior,), notes = view_priors([view(shapes()[0])], PriorConfig())
    assert not prior.disparity.any() and prior.depth_source == "none"
    assert any("neither a network nor other views gave depth" in n for n in notes)


def test_many_names_are_cut_short(tmp_path):
    _, notes = view_priors([dark(f"{i}.png") for i in range(8)], networks(tmp_path))
    assert any("0.png, 1.png, 2.png, 3.png, 4.png and 3 more views" in n for n in notes)


def test_both_networks_are_opened_before_one_runs(tmp_path, monkeypatch):
    config = PriorConfig(depth_model=nw.depth_network(tmp_path / "d.onnx"), segmentation_model=str(tmp_path / "none.onnx"))
    monkeypatch.setattr("warpgs.priors.views.network_disparity", lambda *a: pytest.fail("ran"))
    with pytest.raises(DataError, match=r"none\.onnx: the model cannot be read"):
        view_priors([view(shapes()[0])], config)


def test_a_network_of_the_other_kind_is_refused(tmp_path):
    depth, labels = nw.depth_network(tmp_path / "d.onnx"), nw.segmentation_network(tmp_path / "s.onnx")
    with pytest.raises(DataError, match="is it a depth network"):
        view_priors([view(shapes()[0])], PriorConfig(depth_model=labels))
    with pytest.raises(DataError, match="21 PASCAL VOC classes"):
        view_priors([view(shapes()[0])], PriorConfig(segmentation_model=depth))
    for path, flag, output in ((depth, "depth_model", "classes"), (labels, "segmentation_model", "depth")):
        (tmp_path / f"{path}.json").write_text(json.dumps({"output": output}))
        with pytest.raises(DataError, match=f"its output is {output}"):
            view_priors([view(shapes()[0])], PriorConfig(**{flag: path}))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"onnx_provider": "tpu"}, "onnx-provider must be one of cpu, cuda, not 'tpu'"),
        ({"depth_guides": True}, "--depth-guides requires --depth-model"),
    ],
)
def test_settings_are_checked(fields, message):
    with pytest.raises(UsageError, match=message):
        PriorConfig(**fields)


def test_the_provider_reaches_onnxruntime(tmp_path, monkeypatch):
    import onnxruntime

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(ResourceError, match="--onnx-provider cuda"):
        view_priors([view(shapes()[0])], networks(tmp_path, onnx_provider="cuda"))
