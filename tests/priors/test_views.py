"""Priors of views end to end: the choice of neighbours, sources, lenses as pinholes, and maps on disk."""

import dataclasses
import json
import sys

import cv2
import numpy as np
import pytest
import torch
from safetensors.numpy import save

from tests.gaussians import cloud, lens_camera
from tests.priors import networks as nw
from tests.priors.test_networks import response, scaled, shapes, two_planes
from warpgs.errors import DataError, UsageError
from warpgs.geometry import look_at
from warpgs.priors import networks as cache_module
from warpgs.priors.given_depth import lens_depth, pinhole_view
from warpgs.priors.networks import MapCache, cache_folder
from warpgs.priors.sweep import matching_views, shared_sight, spread_views
from warpgs.priors.views import PriorConfig, view_priors
from warpgs.process import Detail
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, View, ViewDepth

PLAIN = {"size": 32, "mean": [0, 0, 0], "std": [1, 1, 1]}
DEPTH = {"size": 32, "mean": [0.4, 0.5, 0.6], "std": [0.2, 0.25, 0.5]}


REGION = np.zeros((32, 64), bool)
REGION[10:20, 20:40] = True


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Keep maps in a folder of the test."""
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def view(image, name="a.png", mask=None):
    height, width = image.shape[:2]
    return View(name, Camera(np.eye(4), np.eye(3), width, height), image, mask)


def dark(name="dark.png"):
    return view(0.02 * np.random.default_rng(1).random((32, 64, 3), np.float32), name)


def networks(tmp_path, depth=None, **more):
    """Two networks, with a description of the input beside each; without one for ``depth``, the usual values are assumed."""
    (tmp_path / "s.onnx.json").write_text(json.dumps(PLAIN))
    if depth:
        (tmp_path / "d.onnx.json").write_text(json.dumps(depth))
    depth, labels = nw.depth_network(tmp_path / "d.onnx"), nw.segmentation_network(tmp_path / "s.onnx")
    return PriorConfig(depth_model=depth, segmentation_model=labels, **more)


def check(prior, shape):
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
    image = 0.5 + 0.5 * np.random.default_rng(0).random((32, 32, 3), np.float32)
    (disparity,), _ = view_priors([view(image)], networks(tmp_path, DEPTH))
    (depth,), notes = view_priors([view(image)], networks(tmp_path, DEPTH | {"output": "depth"}))
    np.testing.assert_allclose(depth.disparity, scaled(1 / response(image)), atol=2e-6)
    assert disparity.disparity.argmax() == depth.disparity.argmin() and any("gives depth" in n for n in notes)


def test_maps_are_kept_and_found_again(tmp_path, folder):
    """Unless the network or its description is another."""
    views = [view(shapes()[0], "a.png"), view(1 - shapes()[0], "b.png")]
    config = networks(tmp_path)
    first, _ = view_priors(views, config)
    written = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    second, _ = view_priors(views, config)
    assert len(written) == 4 and written == {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    for f, s in zip(first, second):
        for name in ("disparity", "confidence", "boundary", "foreground"):
            np.testing.assert_array_equal(getattr(f, name), getattr(s, name))
    view_priors(views, networks(tmp_path, {"mean": [0.1, 0.2, 0.3], "multiple": 16}))
    assert len(list(folder.iterdir())) == 6
    nw.write(tmp_path / "d.onnx", nw.linear(2 * nw.DEPTH_WEIGHTS, nw.DEPTH_BIAS))
    view_priors(views, config)
    assert len(list(folder.iterdir())) == 8


def test_a_region_stands_in_where_the_network_finds_no_foreground(tmp_path):
    views = [dark("a.png"), view(shapes()[0], "b.png"), dark("c.png"), *(dark(f"{i}.png") for i in range(6))]
    priors, notes = view_priors(views, networks(tmp_path), regions=[REGION, REGION, None, *[np.ones((32, 64), bool)] * 6])
    assert (priors[0].foreground == REGION).all() and "mask or black background" in priors[0].semantics_source
    assert priors[0].boundary[10, 20] == 1 and priors[0].boundary[0, 0] < 1e-6
    assert ((priors[1].foreground > 0.5) == (shapes()[1] > 0)).all(), "the network knows better"
    for p in priors[2:]:  # no region, or one that is no object
        assert not p.foreground.any() and not p.boundary.any() and p.semantics_source.startswith("none")
        check(p, (32, 64))
    text = "\n".join(notes)
    assert "gave the foreground of a.png" in text
    assert "no score for c.png, 0.png, 1.png, 2.png, 3.png and 2 more, which have hardly any foreground" in text


def test_regions_and_classical_sources_say_so():
    """Without any depth, geometry does not count."""
    (prior,), notes = view_priors([view(shapes()[0])], PriorConfig(), regions=[REGION])
    assert (prior.foreground == REGION).all() and (prior.confidence == 1).all()
    assert any("a mask is more reliable than saliency" in n and isinstance(n, Detail) for n in notes)
    assert not prior.disparity.any() and prior.depth_source == "none"
    assert any("neither a network nor other views gave depth" in n for n in notes)
    image, inverse, near = two_planes()
    valid = np.random.default_rng(1).random(near.shape) < 0.1
    consistent = ViewDepth(np.where(valid, 1 / inverse, 0), valid, np.where(valid, 0.01, np.inf))
    nothing = ViewDepth(np.zeros(near.shape), np.zeros(near.shape, bool), np.full(near.shape, np.inf))
    views = [view(image, "a.png"), view(image, "b.png")]
    (a, b), notes = view_priors(views, PriorConfig(), depths=lambda: [consistent, nothing])
    for p in (a, b):
        check(p, near.shape)
    assert a.disparity[near].min() > a.disparity[~near].max() and f"{valid.mean():.1%}" in a.depth_source
    assert not b.disparity.any() and b.depth_source == "none"
    text = "\n".join(notes)
    assert f"0.0% to {valid.mean():.1%} of the pixels" in text and "no consistent depth in b.png" in text
    assert "saliency as foreground" in text and "--segmentation-model" in text


def test_both_networks_are_opened_before_one_runs(tmp_path, monkeypatch):
    config = PriorConfig(depth_model=nw.depth_network(tmp_path / "d.onnx"), segmentation_model=str(tmp_path / "none.onnx"))
    monkeypatch.setattr("warpgs.priors.networks.network_disparity", lambda *a: pytest.fail("ran"))
    with pytest.raises(DataError, match=r"none\.onnx: the model cannot be read"):
        view_priors([view(shapes()[0])], config)


def test_a_network_of_the_other_kind_is_refused(tmp_path):
    depth, labels = nw.depth_network(tmp_path / "d.onnx"), nw.segmentation_network(tmp_path / "s.onnx")
    with pytest.raises(DataError, match="is it a depth network"):
        view_priors([view(shapes()[0])], PriorConfig(depth_model=labels))
    with pytest.raises(DataError, match=r"\[1, 21, height"):
        view_priors([view(shapes()[0])], PriorConfig(segmentation_model=depth))
    for path, flag, output in ((depth, "depth_model", "classes"), (labels, "segmentation_model", "depth")):
        (tmp_path / f"{path}.json").write_text(json.dumps({"output": output}))
        with pytest.raises(DataError, match=f"its output is {output}"):
            view_priors([view(shapes()[0])], PriorConfig(**{flag: path}))


def test_settings_are_checked():
    for fields, words in (({"onnx_provider": "tpu"}, "onnx-provider must be one"), ({"depth_guides": True}, "--depth-model")):
        with pytest.raises(UsageError, match=words):
            PriorConfig(**fields)


# Neighbours that see the same from another side, and few views that see what all see.

K = np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
UP = np.array([0.0, -1.0, 0.0])


def ring(angles, radius: float = 4.0, look: float = 1.0) -> list[Camera]:
    """Return cameras on a circle, which look at its centre, or away from it for ``look`` = -1."""
    centers = [radius * np.array([np.sin(a), 0, -np.cos(a)]) for a in np.radians(angles)]
    return [Camera(look_at(c, c - look * c, UP), K, 80, 60) for c in centers]


def test_neighbours_see_the_same_from_another_side():
    cameras = [*ring([0, 0.05, 8, 100]), *ring([2], look=-1)]
    sight = shared_sight(cameras, [(3, 5)] * 5)
    assert matching_views(sight, cameras, 0, 4, range(5))[0] == 2
    assert not {3, 4} & set(matching_views(sight, cameras, 0, 4, range(5)))
    overlap, matching = sight
    assert overlap[0, 1] > 0.99 and matching[0, 1] < 0.01 < 0.8 < matching[0, 2]
    assert (np.diag(matching) == 0).all() and (overlap[0, 3:] == 0).all()
    # of those allowed
    cameras = ring([0, 90, 180, 200])
    sight = shared_sight(cameras, [(0.5, 1)] * 4)
    assert not sight[1].any()
    assert matching_views(sight, cameras, 0, 2, range(4)) == [1, 3] and matching_views(sight, cameras, 0, 2, [2, 3]) == [3, 2]
    # of two dense groups and one lone view, every one gets a view; none is taken twice
    cameras = ring([0, 1, 2, 3, 4, 120, 121, 122, 240])
    sight = shared_sight(cameras, [(3, 5)] * 9)
    taken = spread_views(sight, 3)
    assert len(taken) == 3 and taken[0] in range(5) and taken[1] in (5, 6, 7) and taken[2] == 8
    arc = ring(range(31), look=1)
    assert np.diff(spread_views(shared_sight(arc, [(3, 5)] * 31), 4)).min() > 4  # although all see nearly the same
    same = shared_sight(ring([0] * 4), [(3, 5)] * 4)
    assert spread_views(same, 3) == [0, 1, 2]
    assert spread_views(sight, 9) == list(range(9)) and len(spread_views(sight, 8)) == 8


# Views of lenses as pinholes, and depth back in the pixels of the lens.


def arrays(camera: Camera) -> Camera:
    return dataclasses.replace(
        camera, **{n: v.numpy() for n, v in vars(camera).items() if isinstance(v, torch.Tensor)}
    )  # fmt: skip


@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_a_lens_view_becomes_that_of_a_pinhole_and_back(model):
    """Small Gaussians rendered by either camera: images agree but for interpolation, and depth comes back to the lens."""
    gaussians, cam = cloud(400, torch.float32), lens_camera(model, width=120, height=90, dtype=torch.float32)
    pinhole = dataclasses.replace(cam, model="pinhole", distortion=None)
    gaussians = dataclasses.replace(gaussians, log_scales=gaussians.log_scales.clamp(-2.5, -2.3).mean(1, True).repeat(1, 3))
    shown, wanted = rasterize(gaussians, cam), rasterize(gaussians, pinhole)
    view = View("a.png", arrays(cam), shown.rgb.numpy(), score_mask=np.ones((90, 120), bool), alpha=shown.alpha.numpy())
    found = pinhole_view(view)
    assert found.camera.model == "pinhole" and found.camera.distortion is None and np.array_equal(found.camera.K, view.camera.K)
    inner = found.mask if found.mask is not None else np.ones((90, 120), bool)
    assert inner.mean() > 0.8 and np.array_equal(found.score_mask, inner)
    # a first-order footprint and a bilinear sample of features of 4 px differ by a few levels; no resampling, by more than 60
    change = np.abs(shown.rgb.numpy() - wanted.rgb.numpy())[inner].mean()
    for moved, true in ((found.image, wanted.rgb), (found.alpha, wanted.alpha)):
        assert np.abs(moved - true.numpy())[inner].mean() < 0.15 * change
    depth = ViewDepth(wanted.depth.numpy(), wanted.alpha.numpy() > 0.5, np.ones((90, 120), np.float32))
    back = lens_depth(view.camera, depth)
    both = back.valid & (shown.alpha.numpy() > 0.5)
    # where neighbouring pixels show one depth; the nearest pixel is taken
    assert both.mean() > 0.3 and np.median(np.abs(back.depth / shown.depth.numpy() - 1)[both]) < 0.01
    assert not back.depth[~back.valid].any() and np.isinf(back.sensitivity[~back.valid]).all()


@pytest.mark.parametrize("model", ["opencv", "fisheye"])
def test_depth_moves_with_its_pixel(model):
    """Each pixel of the lens has the depth of the pinhole's pixel that OpenCV names, a fisheye as distance."""
    cam = arrays(lens_camera(model, width=120, height=90))
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
    ramp = (1 + x / 120 + y / 30).astype(np.float32)
    back = lens_depth(cam, ViewDepth(ramp, np.ones((90, 120), bool), ramp))
    undistort = cv2.fisheye.undistortPoints if model == "fisheye" else cv2.undistortPoints
    rays = undistort(np.stack([x, y], -1).reshape(-1, 1, 2), cam.K, cam.distortion)[:, 0]
    u, v = (rays * np.diag(cam.K)[:2] + cam.K[:2, 2]).T
    inside = (u > 0.01) & (v > 0.01) & (u < 119.99) & (v < 89.99)
    wanted = 1 + (np.floor(u) + 0.5) / 120 + (np.floor(v) + 0.5) / 30
    if model == "fisheye":
        wanted *= np.hypot(1, np.linalg.norm(rays, axis=1))
    moved = np.abs(wanted.reshape(90, 120) - ramp)[inside.reshape(90, 120)]
    error = np.abs(back.depth.ravel() - wanted)[inside & back.valid.ravel()]
    # rounding may floor a few pixels to a neighbour, an iteration of OpenCV's ends at 0.01 px
    assert moved.mean() > 0.01 and (error < 1e-5).mean() > 0.95 and error.max() < 0.1
    assert inside.mean() > 0.7 and (back.valid.ravel() == inside).mean() > 0.97


def test_pinholes_stay_and_parallel_rays_are_refused():
    cam = arrays(lens_camera("orthographic", width=8, height=6))
    view = View("a.png", dataclasses.replace(cam, model="pinhole"), np.zeros((6, 8, 3), np.float32))
    depth = ViewDepth(*(np.zeros((6, 8), t) for t in (np.float32, bool, np.float32)))
    assert pinhole_view(view) is view and lens_depth(view.camera, depth) is depth
    with pytest.raises(UsageError, match=r"no depth for 'orthographic' cameras: give --init.source points"):
        pinhole_view(dataclasses.replace(view, camera=cam))


# Maps on disk: found again when nothing changed, made again when anything did or the file is damaged.

IMAGE = np.random.default_rng(0).random((6, 9, 3), np.float32)
NAMES = ("a", "b")


MADE = tuple(np.full((6, 9), v, np.float32) for v in (0.25, 1.0))


def test_whatever_decides_the_maps_decides_the_entry(tmp_path, monkeypatch):
    """The same is read again; another pixel, network, shape, name or version of the code is not."""
    calls, folder = [], tmp_path / "deep" / "folder"

    def ask(image, names=NAMES, **decided_by):
        store, before = MapCache(folder), len(calls)
        maps = store.maps(image, names, decided_by, lambda: calls.append(1) or MADE)
        assert store.notes == [] and all(np.array_equal(a, b) for a, b in zip(maps, MADE))
        return len(calls) == before

    changed = IMAGE.copy()
    changed[3, 4, 1] = np.nextafter(changed[3, 4, 1], 2)
    assert [ask(IMAGE, m=1), ask(IMAGE.copy(), m=1), ask(changed, m=1), ask(IMAGE, m=2)] == [0, 1, 0, 0]
    monkeypatch.setattr(cache_module, "CODE", cache_module.CODE + 1)
    assert [ask(IMAGE, m=1), ask(IMAGE, ("a", "c"), m=1), ask(IMAGE, ("a", "c"), m=1)] == [0, 0, 1]
    assert len(calls) == 5 == len(list(folder.glob("*.safetensors"))) == len(list(folder.iterdir()))


ONE = np.ones((6, 9), np.float32)
DAMAGED = {
    "empty": b"", "cut off": save({"a": ONE, "b": ONE})[:99], "noise": bytes(200), "one map short": save({"a": ONE}),
    "another shape": save({"a": ONE.T.copy(), "b": ONE}), "another type": save({"a": ONE.astype(np.float64), "b": ONE}),
    "NaN": save({"a": ONE * np.nan, "b": ONE}), "out of range": save({"a": ONE * 2, "b": ONE}),
}  # fmt: skip


@pytest.mark.parametrize("how", DAMAGED)
def test_a_damaged_entry_is_made_again_with_a_note(tmp_path, how):
    MapCache(tmp_path).maps(IMAGE, NAMES, {}, lambda: MADE)
    (path,) = tmp_path.iterdir()
    path.write_bytes(DAMAGED[how])
    store, mended = MapCache(tmp_path), MapCache(tmp_path)
    maps = store.maps(IMAGE, NAMES, {}, lambda: MADE)
    assert (maps[0] == 0.25).all() and (maps[1] == 1).all()
    assert len(store.notes) == 1 and "computed again" in store.notes[0] and str(path) in store.notes[0]
    mended.maps(IMAGE, NAMES, {}, lambda: pytest.fail("not read"))
    assert mended.notes == []


def test_a_folder_that_cannot_be_written_is_done_without(tmp_path):
    (tmp_path / "file").write_text("in the way")
    store = MapCache(tmp_path / "file" / "maps")
    for seed in range(3):
        assert (store.maps(IMAGE + seed, NAMES, {}, lambda: MADE)[1] == 1).all()
    assert len(store.notes) == 1 and "WARPGS_CACHE" in store.notes[0]


def test_where_the_cache_lies(monkeypatch, tmp_path):
    home, system = tmp_path / "home", tmp_path / "system"
    for name in ("HOME", "USERPROFILE"):
        monkeypatch.setenv(name, str(home))
    for name in ("WARPGS_CACHE", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    linux, apple, windows = home / ".cache" / "warpgs", home / "Library" / "Caches" / "warpgs", home / "AppData" / "Local"
    cases = [("linux", None, linux), ("linux", "relative", linux), ("linux", str(system), system / "warpgs")]
    cases += [("darwin", str(system), apple), ("win32", str(system), windows / "warpgs" / "Cache")]
    for platform, xdg, folder in cases:
        monkeypatch.setattr(sys, "platform", platform)
        if xdg:
            monkeypatch.setenv("XDG_CACHE_HOME", xdg)
        assert cache_folder() == folder
    monkeypatch.setenv("WARPGS_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
