"""Scores of renders: figures, LPIPS, things that moved, and what training views saw."""

import copy
import dataclasses
import hashlib
import json
import math
from concurrent.futures import CancelledError
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import nn

from tests.scenes import photos, ring, three_gaussians
from warpgs.app.cli import main
from warpgs.errors import DataError
from warpgs.geometry import camera_extent, focus_point, look_at
from warpgs.pipeline.metrics import scores
from warpgs.pipeline.metrics.coverage import (
    BINS,
    classes_of,
    coverage_lines,
    coverage_map,
    coverage_of_run,
    depth_views,
    fraction_outside,
    photo_errors,
)
from warpgs.pipeline.metrics.lpips import MODES, NETS, Lpips, Net, convert_lpips
from warpgs.pipeline.metrics.scores import (
    baselines,
    counted_region,
    moved_fractions,
    moved_notes,
    psnr,
    score,
    summarize,
    to_8_bit,
    variants,
)
from warpgs.pipeline.model.edit import SEEN, coverage, sensitivities
from warpgs.pipeline.run.folder import METRICS
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.report.images import coverage_image
from warpgs.scene import Camera, Gaussians, View
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import camera_path, still_life

# Scores, what guessing would score, and camera paths.


def test_scores_are_of_the_saved_picture():
    view = photos(1)[0]
    m = score(view, view.image + 1e-4)
    assert m.psnr > 50 and m.ssim > 0.999 and m.ssim_skimage > 0.999
    assert np.array_equal(to_8_bit(np.array([-1.0, 0.5, 2.0])), np.float32([0, 128 / 255, 1]))
    m = score(view, view.image, Witness())
    assert m.row()["lpips_vgg_legacy"] == 0.25 and "lpips" not in m.row()
    assert summarize([m, m])["lpips_vgg_legacy"] == 0.25
    assert "lpips_vgg_legacy" not in summarize([score(view, view.image)])
    assert "not measured" in variants(None)["lpips"]


@pytest.mark.parametrize("height, width", [(11, 11), (40, 57), (10, 30)])
def test_ssim_without_the_border_is_scikit_images(height, width):
    """To the rounding of scikit-image, which sums in float32 here; NaN where the window does not fit."""
    from skimage.metrics import structural_similarity

    generator, camera = np.random.default_rng(0), photos(1)[0].camera
    smooth = np.add.outer(np.linspace(0, 0.7, height), np.linspace(0, 0.3, width))[..., None].repeat(3, 2).astype(np.float32)
    noise = generator.random((height, width, 3), np.float32)
    for a, b in ((noise, noise[::-1]), (smooth, smooth + 0.1 * noise), (np.ones_like(noise), smooth), (smooth, smooth)):
        a, b = to_8_bit(a), to_8_bit(b)
        found = score(View("a", replace(camera, width=width, height=height), a), b).ssim_skimage
        if height < 11:
            assert math.isnan(found)
            continue
        given = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1, "channel_axis": -1}
        assert found == pytest.approx(structural_similarity(a.astype(float), b.astype(float), **given), abs=2e-6)


class Witness:
    """Stands in for LPIPS and keeps what it was given."""

    def measure(self, image, target):
        self.seen = (image, target)
        return {"lpips_vgg_legacy": 0.25, "lpips_vgg_standard": float("nan")}


@pytest.mark.parametrize("kind", ["mask", "score_mask"])
def test_masked_view_is_scored_by_the_dtu_recipe(kind):
    """PSNR over the mask alone; SSIM and LPIPS on both images with white outside, so what stands there cannot matter."""
    view = photos(1)[0]
    mask = np.zeros(view.image.shape[:2], bool)
    mask[8:24, 10:30] = True
    rng = np.random.default_rng(0)
    image = view.image + 0.1 * mask[..., None].astype(np.float32)
    scores = []
    for filling in (0.0, 1.0):
        truth, render = view.image.copy(), image.copy()
        truth[~mask], render[~mask] = filling, rng.random((int((~mask).sum()), 3))
        witness = Witness()
        scores.append(score(View("a", view.camera, truth, **{kind: mask}), render, witness))
        assert all((i[~mask] == 1).all() for i in witness.seen)
        assert np.array_equal(witness.seen[1][mask], to_8_bit(view.image)[mask])
    if kind == "score_mask":  # it wins over the mask of the fit
        scores.append(score(View("a", view.camera, truth, ~mask, mask), render))
        assert scores[2].psnr == scores[1].psnr
    a, b, *_ = scores
    assert (a.psnr, a.ssim, a.ssim_skimage) == (b.psnr, b.ssim, b.ssim_skimage) and a.region == kind.replace("_", " ")
    expected = np.mean((to_8_bit(image)[mask].astype(float) - to_8_bit(view.image)[mask]) ** 2)
    assert a.psnr == pytest.approx(-10 * math.log10(expected), abs=1e-4) and a.ssim < 1
    from tests.reference.ssim import ssim_reference  # the same figure, from images composited here

    pair = [torch.from_numpy(np.where(mask[..., None], to_8_bit(i), 1)).double() for i in (image, view.image)]
    assert a.ssim == pytest.approx(float(ssim_reference(*pair).mean()), abs=1e-5)


def test_psnr_of_known_errors_regions_and_guesses():
    a = np.full((8, 9, 3), 0.5, np.float32)
    assert psnr(a + 0.1, a) == pytest.approx(20, abs=1e-4) and psnr(a, a) == math.inf
    region = np.zeros((8, 9), bool)
    region[:4] = True
    b = a.copy()
    b[4:] = 1
    assert psnr(b, a, region) == math.inf and psnr(b, a) < 10
    view = photos(1)[0]
    bright = View("a", view.camera, np.full_like(view.image, 0.5))
    assert counted_region(bright) == (None, "all")
    dark = np.zeros_like(view.image)
    dark[10:20, 10:20] = 0.7
    region, name = counted_region(View("a", view.camera, dark))
    assert name == "foreground" and int(region.sum()) == 100
    mask = np.zeros(view.image.shape[:2], bool)
    mask[0] = True
    assert counted_region(View("a", view.camera, dark, mask))[1] == "mask"
    views = photos(3)
    g = baselines([views[0], views[2]], [views[1]])
    mean = to_8_bit((views[0].image + views[2].image) / 2)
    region, _ = counted_region(views[1])
    assert g["mean_photo"] == pytest.approx(psnr(mean, views[1].image, region))
    assert baselines(photos(2, 20, 16), [views[1]]) == {}
    assert summarize([]) == {}
    cameras = ring(5)
    assert np.linalg.norm(focus_point(cameras)) < 1e-4
    assert 1.0 < camera_extent(cameras) < 2.2 and camera_extent(cameras[:1]) == 0


WALL = 2.2
"""Depth of a wall that all of it is painted on [u]."""


def _scene(count: int = 6) -> tuple[list[View], list[tuple]]:
    first = photos(1, 64, 48)[0]
    views = []
    for i in range(count):
        viewmat = np.eye(4)
        viewmat[0, 3] = 0.1 * i
        views.append(
            View(f"{i}.png", dataclasses.replace(first.camera, viewmat=viewmat), np.full((48, 64, 3), 0.4, np.float32))
        )
    return views, [(v.image.copy(), np.full((48, 64), WALL), np.ones((48, 64))) for v in views]


def _with_patch(view: View) -> View:
    image = view.image.copy()
    left = round(26 + view.camera.K[0, 0] * (view.camera.viewmat[0, 3] - 0.2) / WALL)
    image[20:30, left : left + 12] = 0.9
    return dataclasses.replace(view, image=image)


@pytest.mark.parametrize("alone", [True, False])
def test_what_one_view_alone_shows_is_named(alone):
    views, renders = _scene()
    changed = [_with_patch(v) if i == 2 or not alone else v for i, v in enumerate(views)]
    fractions = moved_fractions(changed, renders)
    assert [f > 0 for f in fractions] == [alone and i == 2 for i in range(len(views))]
    assert fractions[2] == pytest.approx(0.04 * alone, abs=0.02)
    notes = moved_notes({v.name: f for v, f in zip(views, fractions)})
    assert len(notes) == alone and all("2.png" in n and "of its pixels" in n for n in notes)


def test_what_moved_takes_two_other_views_and_a_good_fit():
    views, renders = _scene()
    views[2] = _with_patch(views[2])
    elsewhere = [(rgb, depth if i == 2 else 2 * depth, alpha) for i, (rgb, depth, alpha) in enumerate(renders)]
    assert not any(moved_fractions(views, elsewhere))
    assert not any(moved_fractions(views[:5], renders[:5]))
    mask = np.ones((48, 64), bool)
    mask[16:34, 22:42] = False
    masked = [dataclasses.replace(v, mask=mask) if i == 2 else v for i, v in enumerate(views)]
    assert moved_fractions(views, renders)[2] > 0 and not any(moved_fractions(masked, renders))
    early = [(rgb + np.float32(0.01), *rest) for rgb, *rest in renders]  # all views are far from their renders
    assert moved_fractions(views, renders)[2] > 0 and not any(moved_fractions(views, early))
    views[2] = dataclasses.replace(views[2], image=views[2].image + np.float32(0.1))
    assert not any(moved_fractions(views, renders))


def cameras(count: int = 4) -> list[Camera]:
    return [Camera(torch.from_numpy(c.viewmat).float(), torch.from_numpy(c.K).float(), c.width, c.height) for c in ring(count)]


def test_which_views_see_a_gaussian():
    g = three_gaussians()
    far = {n: torch.cat([t, t[:1]]) for n, t in g.tensors().items()}
    far["means"][3] = torch.tensor([0.0, 0.0, -50.0])
    maxima, views = coverage(Gaussians(**far), cameras(), RasterizeOptions())
    assert views.tolist() == [4, 4, 4, 0] and float(maxima[3]) == 0
    weights = [rasterize(g, c, RasterizeOptions(contributions=True)).weight_maxima[0] for c in cameras()]
    assert torch.equal(maxima[:3], torch.stack(weights).amax(0))  # although its walk ends where little light is left
    g = three_gaussians()
    rows = {n: t[[0, 0]].clone() for n, t in g.tensors().items()}
    rows["logit_opacities"][:] = 9.0
    rows["log_scales"][0], rows["log_scales"][1] = math.log(0.4), math.log(0.02)
    away = rows["means"][0] - torch.from_numpy(cameras(1)[0].center)
    rows["means"][1] = rows["means"][0] + 0.3 * away.float()
    maxima, views = coverage(Gaussians(**rows), cameras(1), RasterizeOptions())
    assert views.tolist() == [1, 0] and 0 < float(maxima[1]) < SEEN


def test_sensitivities_are_squared_changes_of_images():
    """The trace of the Jacobian; the images without a Gaussian; and those without its harmonics."""
    small = [dataclasses.replace(c, K=c.K * torch.tensor([[0.2], [0.2], [1.0]]), width=8, height=6) for c in cameras(2)]
    g = three_gaussians()
    g.logit_opacities.clamp_(max=1.0)
    generator = torch.Generator().manual_seed(0)
    g = dataclasses.replace(g, sh=torch.cat([g.sh, 0.05 * torch.randn(3, 3, 3, generator=generator)], 1))
    exact = torch.zeros(3, 3)
    for c in small:
        leaves = {n: t.clone().requires_grad_() for n, t in g.tensors().items()}
        image = rasterize(Gaussians(**leaves), c).rgb
        for value in image.flatten():
            v_means, v_scales = torch.autograd.grad(value, [leaves["means"], leaves["log_scales"]], retain_graph=True)
            width = g.log_scales.exp().amax(1, keepdim=True)
            exact[0] += (v_means * width).square().sum(1) + v_scales.square().sum(1)
        for i in range(3):
            flat = g.sh.clone()
            flat[i, 1:] = 0
            hidden = RasterizeOptions(opacity_factors=(torch.arange(3) != i).float())
            exact[1, i] += (rasterize(g, c, hidden).rgb - image).square().sum().item()
            exact[2, i] += (rasterize(dataclasses.replace(g, sh=flat), c).rgb - image).square().sum().item()
    estimates = torch.stack([sensitivities(g, small, RasterizeOptions(), seed) for seed in range(49)])
    error = estimates.std(0) / 7
    assert bool((exact > 1e-3).all()) and bool(((estimates.mean(0) - exact).abs() < 4 * error + 1e-3 * exact).all())
    assert bool((error < 0.25 * exact).all())
    with torch.no_grad():
        assert torch.equal(sensitivities(g, small, RasterizeOptions(), 0), estimates[0])


def ray_depth(camera: Camera) -> torch.Tensor:
    xy = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1).reshape(-1, 2)
    rays = raycast.pixel_rays(camera.K, camera.viewmat, xy)
    t, _ = raycast.cast(still_life(), camera.center, rays)
    z = np.where(np.isfinite(t), t, 0) * (rays @ camera.viewmat[2, :3])
    return torch.from_numpy(z.reshape(camera.height, camera.width).astype(np.float32))


def truly_sees(viewer: Camera, points: np.ndarray) -> np.ndarray:
    p = points @ viewer.viewmat[:3, :3].T + viewer.viewmat[:3, 3]
    uv = p[:, :2] / p[:, 2:] * viewer.K[[0, 1], [0, 1]] + viewer.K[:2, 2]
    away = points - viewer.center
    length = np.linalg.norm(away, axis=1)
    t, _ = raycast.cast(still_life(), viewer.center, away / length[:, None])
    inside = (uv >= 0).all(1) & (uv < [viewer.width, viewer.height]).all(1) & (p[:, 2] > 0)
    return inside & (t > 0.999 * length)


def test_the_fraction_outside_all_photographs():
    """Nothing at a photograph's own camera, half beside it; pixels without a surface count where they are asked about."""
    (camera,) = camera_path(1, 64, 48)
    depth = torch.full((48, 64), 2.0)
    wide = dataclasses.replace(camera, width=128, K=camera.K + np.array([[0, 0, 32.0], [0, 0, 0], [0, 0, 0]]))
    assert fraction_outside(depth, camera, [camera]) == 0
    assert fraction_outside(torch.full((48, 128), 2.0), wide, [camera]) == 0.5
    behind = dataclasses.replace(camera, viewmat=np.diag([1, -1, -1, 1.0]) @ camera.viewmat)
    assert fraction_outside(depth, camera, [behind]) == 1 and fraction_outside(depth, camera, [behind, camera]) == 0
    depth = torch.zeros(48, 128)
    assert fraction_outside(depth, wide, [camera]) == 0
    depth[:, 32:96] = 2.0
    assert fraction_outside(depth, wide, [camera]) == 0.5 and fraction_outside(depth, wide, [camera], empty=False) == 0


def test_counts_are_those_of_cast_rays():
    cameras = camera_path(9, 120, 90)
    target, training = cameras[4], [cameras[i] for i in (0, 3, 8)]
    depth = ray_depth(target)
    counts, _ = coverage_map(depth, target, [(c, ray_depth(c)) for c in training])
    xy = np.stack(np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5), -1).reshape(-1, 2)
    rays = np.concatenate([(xy - target.K[:2, 2]) / target.K[[0, 1], [0, 1]], np.ones((len(xy), 1))], 1)
    points = (rays * depth.numpy().reshape(-1, 1) - target.viewmat[:3, 3]) @ target.viewmat[:3, :3]
    wanted = np.sum([truly_sees(c, points) for c in training], 0).reshape(90, 120)
    assert (wanted[..., None] == [0, 1, 2, 3]).mean((0, 1)).min() > 0.01  # every count is there to be got wrong
    assert (counts.numpy() == wanted).mean() > 0.95


def plane(width: int = 30, height: int = 20, depth: float = 2.0) -> tuple[Camera, torch.Tensor]:
    K = np.array([[30.0, 0, width / 2], [0, 30, height / 2], [0, 0, 1]])
    return Camera(np.eye(4), K, width, height), torch.full((height, width), depth)


def test_masks_hide_and_many_pixels_are_rendered_smaller(monkeypatch):
    cameras, renders = ring(3), scores.Renders(three_gaussians(), RasterizeOptions())
    mask = np.ones((32, 40), bool)
    mask[:, :20] = False
    (_, whole), (_, half) = depth_views(renders, cameras[:2], [None, mask])
    assert bool((half[:, 20:] > 0).any()) and not bool((half[:, :20] > 0).any()) and bool((whole > 0).any())
    monkeypatch.setattr("warpgs.pipeline.metrics.coverage.MAX_PIXELS", 1500)
    small = depth_views(renders, cameras)
    assert sum(d.numel() for _, d in small) <= 1500
    seen = whole > 0
    counts = coverage_map(whole, cameras[0], small)[0]
    assert (counts[seen] > 0).float().mean() > 0.8


def test_a_render_is_made_once_while_there_is_room(monkeypatch):
    """The same arrays come again; a render without room is made again, with the same bits; coverage and scores share them."""
    views, g, made = photos(3), three_gaussians(), []
    monkeypatch.setattr(scores, "rasterize", lambda *a: made.append(a[1]) or rasterize(*a))
    monkeypatch.setattr(scores, "KEPT_BYTES", 5 * 4 * views[0].image[..., 0].size * 2)
    renders = scores.Renders(g, RasterizeOptions())
    first = [renders(v.camera) for v in views]
    again = [renders(v.camera) for v in views]
    assert [a is b for a, b in zip(first, again)] == [True, True, False] and len(made) == 4
    assert all(np.array_equal(a, b) for a, b in zip(first[2], again[2]))
    coverage_of_run(None, renders, views[:1], views[1:2], names={})
    assert len(made) == 4
    renders.ended = True  # a fit that ends with an error: the thread of the coverage stops
    with pytest.raises(CancelledError):
        coverage_of_run(None, renders, views[:1], views[1:2], names={})


def test_scores_split_into_what_they_are_made_of(tmp_path):
    """Pixels and errors of the classes add up to the whole score; the figures fit the schema; each view has its image."""
    views = photos(5)
    train, test = views[:2], views[3:]
    names = {v.name: v.name.removesuffix(".png") for v in views}
    dim = [View(v.name, v.camera, 0.9 * v.image) for v in test]
    renders = scores.Renders(three_gaussians(), RasterizeOptions())
    found = coverage_of_run(tmp_path, renders, train, dim, names=names)
    shares = list(found["classes"].values())
    assert sum(r["share_of_pixels"] for r in shares) == pytest.approx(1) == sum(r["share_of_error"] for r in shares)
    for row, v in zip(found["views"], dim):
        mse = sum(r["share_of_pixels"] * 10 ** (-r["psnr"] / 10) for r in row["classes"].values() if math.isfinite(r["psnr"]))
        original = next(t for t in test if t.name == v.name).image
        assert -10 * math.log10(mse) == pytest.approx(score(v, original).psnr, abs=1e-3)
    protocol = {"split": "", "training_views": 2, "held_out_views": 2, "ground_truth": "", "resolution": [], "score_masks": 0}
    record = {"test": {}, "train": {}, "views": [], "variants": {}, "config_hash": "", "steps": 0, "protocol": protocol}
    METRICS(json.loads(json.dumps(record | {"coverage": found})), "")
    assert sorted(p.name for p in (tmp_path / "coverage").iterdir()) == sorted(v.name for v in test)
    lines = coverage_lines(found)
    assert found["summary"] in lines and sum(line.startswith("all views") for line in lines) == len(found["classes"])
    again = coverage_of_run(None, renders, train, dim, names={})
    assert again["classes"] == found["classes"]


def test_views_that_saw_nothing_and_pixels_without_surface():
    camera, depth = plane()
    away = Camera(look_at(np.zeros(3), np.array([0.0, 0, -1]), np.array([0.0, -1, 0])), camera.K, 30, 20)
    others = [(away, depth), (camera, depth / 2), (camera, 2 * depth), (camera, 0 * depth)]
    counts, difference = coverage_map(depth, camera, others)
    assert not counts.any() and (difference == 0.5).all()  # of the nearer wall, as a share of the depth
    assert (coverage_map(depth, camera, [*others, (camera, 1.01 * depth)])[0] == 1).all()
    camera, depth = plane()
    depth[:5] = 0
    counts, difference = coverage_map(depth, camera, [(camera, depth)] * 300)
    assert (counts[5:] == 300).all() and not counts[:5].any() and bool(torch.isinf(difference[:5]).all())
    for transparent, name in ((True, "background"), (False, "0")):
        classes = classes_of(counts, (depth <= 0) & transparent)
        assert (np.sum(list(classes.values()), 0) == 1).all() and classes[name][:5].all() and classes["2+"][5:].all()
    # none from one view; two of one wall that differ by 0.1 give 0.01 at the first class, and fill the others
    camera, depth = plane()
    views = [View(f"{i}", camera, np.full((20, 30, 3), 0.4 + 0.1 * i, np.float32)) for i in range(2)]
    training = [(camera, depth)] * 2
    assert photo_errors(views[:1], training[:1]) is None
    errors = photo_errors(views, training)
    assert errors.shape == (len(BINS),) and errors == pytest.approx(0.01, rel=1e-5)
    # the others are tinted, and stripes tell the two tints apart in gray, too
    image = np.full((16, 24, 3), 0.5, np.float32)
    unseen, once = np.zeros((2, 16, 24), bool)
    unseen[:, :8], once[:, 8:16] = True, True
    shown = coverage_image(image, unseen, once)
    assert (shown[:, 16:] == 0.5).all() and len(np.unique(shown[:, :8, 1])) == 2 and len(np.unique(shown[:, 8:16, 1])) == 1


CHANNELS = {"vgg": (64, 128, 256, 512, 512), "alex": (64, 192, 384, 256, 256)}
TAPS = {"vgg": (3, 8, 15, 22, 29), "alex": (1, 4, 7, 9, 11)}
"""Places of the activations that are compared, in torchvision's `features`."""


def vgg16() -> nn.Sequential:
    layers, inputs = [], 3
    for block in ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512)):
        for outputs in block:
            layers += [nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU()]
            inputs = outputs
        layers.append(nn.MaxPool2d(2, 2))
    return nn.Sequential(*layers)


def alexnet() -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(3, 64, 11, stride=4, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(64, 192, 5, padding=2), nn.ReLU(), nn.MaxPool2d(3, 2),
        nn.Conv2d(192, 384, 3, padding=1), nn.ReLU(),
        nn.Conv2d(384, 256, 3, padding=1), nn.ReLU(),
        nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2),
    )  # fmt: skip


BUILD = {"vgg": vgg16, "alex": alexnet}


@pytest.fixture(scope="module", params=["vgg", "alex"])
def files(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    torch.manual_seed(3)
    features = BUILD[request.param]().eval()
    heads = [torch.rand(1, c, 1, 1) for c in CHANNELS[request.param]]
    state = {f"features.{k}": v for k, v in features.state_dict().items()} | {"classifier.1.weight": torch.zeros(2, 2)}
    torch.save(state, folder / "backbone.pth")
    torch.save({f"lin{i}.model.1.weight": h for i, h in enumerate(heads)}, folder / "heads.pth")
    return request.param, features, heads, folder / "backbone.pth", folder / "heads.pth"


@pytest.fixture(scope="module")
def weights(files):
    *_, backbone, heads = files
    out = backbone.with_name("lpips.safetensors")
    convert_lpips(backbone, heads, out)
    return out


def reference(net, features, heads, a, b, mode):
    features = copy.deepcopy(features).double()
    shift = torch.tensor([-0.030, -0.088, -0.188], dtype=torch.float64).view(1, 3, 1, 1)
    scale = torch.tensor([0.458, 0.448, 0.450], dtype=torch.float64).view(1, 3, 1, 1)
    x, y = (torch.from_numpy(i).double().permute(2, 0, 1)[None] for i in (a, b))
    if mode == "standard":
        x, y = 2 * x - 1, 2 * y - 1
    x, y, total = (x - shift) / scale, (y - shift) / scale, 0.0
    for i, layer in enumerate(features[: TAPS[net][-1] + 1]):
        x, y = layer(x), layer(y)
        if i in TAPS[net]:
            u, v = (t / (torch.linalg.vector_norm(t, dim=1, keepdim=True) + 1e-10) for t in (x, y))
            total += torch.einsum("nchw,c->nhw", (u - v) ** 2, heads[TAPS[net].index(i)].double().flatten()).mean()
    return float(total.detach())


ALEX = pytest.mark.parametrize("files", ["alex"], indirect=True)
"""Files of 10 MB instead of 60 where the network does not matter."""


@pytest.mark.parametrize("mode", MODES)
def test_equals_networks_of_torch_layers(files, weights, mode):
    net, features, heads, *_ = files
    rng = np.random.default_rng(0)
    a = rng.random((33, 38, 3), np.float32)
    b = np.clip(a + 0.2 * rng.standard_normal(a.shape, np.float32), 0, 1)
    lpips = Lpips(weights, torch.device("cpu"))
    expected = reference(net, features, heads, a, b, mode)
    assert expected > 1e-3
    assert lpips.distance(a, b, mode) == pytest.approx(expected, rel=2e-5)
    assert lpips.distance(a, a, mode) == 0
    measured = lpips.measure(a, b)
    assert measured == {f"lpips_{net}_{m}": lpips.distance(a, b, m) for m in MODES}
    side = lpips.net.smallest  # smaller images give NaN, not an error in the middle of an evaluation
    small, enough = np.zeros((side - 1, 64, 3), np.float32), np.zeros((side, side, 3), np.float32)
    assert np.isnan(lpips.distance(small, small, mode)) and lpips.distance(enough, enough, mode) == 0


def test_file_says_what_it_was_made_of(files, weights):
    net, _, _, backbone, heads = files
    with safe_open(weights, "pt") as f:
        metadata, names = f.metadata(), set(f.keys())
    assert metadata["net"] == net and metadata["version"] == "unknown"
    assert metadata["backbone_sha256"] == hashlib.sha256(backbone.read_bytes()).hexdigest()
    assert metadata["heads_sha256"] == hashlib.sha256(heads.read_bytes()).hexdigest()
    assert not any("classifier" in n for n in names)
    lpips = Lpips(weights, torch.device("cpu"))
    view = View("a.png", Camera(np.eye(4), np.diag([40.0, 40, 1]), 40, 40), np.zeros((40, 40, 3), np.float32))
    (scored,) = scores.evaluate(three_gaussians(), [view], RasterizeOptions(), str(weights))
    assert set(scored.lpips) == set(lpips.variants())
    assert lpips.header["sha256"] == hashlib.sha256(weights.read_bytes()).hexdigest()
    assert set(lpips.variants()) == {f"lpips_{net}_{m}" for m in MODES}
    assert "[0, 1]" in lpips.variants()[f"lpips_{net}_legacy"] and "[-1, 1]" in lpips.variants()[f"lpips_{net}_standard"]


class Evil:
    """Unpickling this would run code."""

    def __reduce__(self):
        return (open, ("/tmp/warpgs-evil", "w"))


@ALEX
def test_bad_and_packed_sources_are_named(files, tmp_path):
    net, features, _, backbone, heads_file = files
    out = tmp_path / "x.safetensors"

    def refused(message, backbone=backbone, heads=heads_file):
        with pytest.raises(DataError, match=message):
            convert_lpips(backbone, heads, out)
        assert not out.exists()

    def saved(value):
        torch.save(value, tmp_path / "bad.pth")
        return tmp_path / "bad.pth"

    refused("No such file", heads=tmp_path / "nowhere.pth")
    (tmp_path / "text.pth").write_bytes(b"<html>not found</html>")
    refused("cannot be read as a torch state dict", heads=tmp_path / "text.pth")
    (tmp_path / "cut.pth").write_bytes(backbone.read_bytes()[:5000])
    refused("cannot be read as a torch state dict", backbone=tmp_path / "cut.pth")
    refused("cannot be read as a torch state dict", heads=saved({"lin0.model.1.weight": Evil()}))
    refused("holds a list", heads=saved([1, 2]))
    narrow = {f"lin{i}.model.1.weight": torch.zeros(1, 7, 1, 1) for i in range(5)}
    refused("heads of an unsupported network", heads=saved(narrow))
    refused("heads of an unsupported network", heads=backbone)
    other = {f"features.{k}": v for k, v in BUILD["alex" if net == "vgg" else "vgg"]().state_dict().items()}
    refused("features.0.weight", backbone=saved(other))
    nan = {f"features.{k}": torch.full_like(v, float("nan")) for k, v in features.state_dict().items()}
    refused("not finite", backbone=saved(nan))
    import zipfile

    with zipfile.ZipFile(files[4]) as old, zipfile.ZipFile(tmp_path / "heads.pth", "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name) + b" " * 2**20)
    with pytest.raises(DataError, match=r"heads.pth: cannot be read .*unpacks to [\d,]+ bytes, more than its size"):
        convert_lpips(files[3], tmp_path / "heads.pth", tmp_path / "out")


def test_bad_weights_are_named(weights, tmp_path, monkeypatch):
    from safetensors.torch import save_file

    cpu, bad = torch.device("cpu"), tmp_path / "bad.safetensors"
    with pytest.raises(DataError, match="No such file"):
        Lpips(bad, cpu)
    bad.write_bytes(weights.read_bytes()[:-1000])
    with pytest.raises(DataError, match="warpgs convert-lpips"):
        Lpips(bad, cpu)
    save_file({"a": torch.zeros(1)}, bad)
    with pytest.raises(DataError, match="warpgs convert-lpips"):
        Lpips(bad, cpu)
    save_file({"a": torch.zeros(1)}, bad, {"format": "warpgs-lpips-1", "net": "vgg"})
    with pytest.raises(DataError, match="no features"):
        Lpips(bad, cpu)
    text = b'{"__metadata__":null}   '
    bad.write_bytes(len(text).to_bytes(8, "little") + text)
    with pytest.raises(DataError, match="holds no LPIPS weights"):
        Lpips(bad, cpu)
    net = Net("vgg", "small", (("conv", 0, 3, 4, 3, 1, 1), ("tap",)), 3, "")
    monkeypatch.setitem(NETS, "vgg", net)
    for value in (torch.tensor(float("nan")), torch.tensor(1, dtype=torch.int32)):
        tensors = {n: value.expand(s).contiguous() for n, s in net.shapes().items()}
        save_file(tensors, bad, {"format": "warpgs-lpips-1", "net": "vgg"})
        with pytest.raises(DataError, match=r"features.0.weight is not finite float32"):
            Lpips(bad, cpu)


@ALEX
def test_the_command_and_what_it_says_of_files(files, tmp_path, capsys):
    net, _, _, backbone, heads = files
    out = tmp_path / "made.safetensors"
    assert main(["convert-lpips", "--backbone", str(backbone), "--heads", str(heads), "--out", str(out)]) == 0
    assert net in capsys.readouterr().out and out.is_file()
    assert main(["convert-lpips", "--backbone", str(backbone), "--heads", str(heads), "--out", str(out)]) == 2
    assert "exists" in capsys.readouterr().err
    notes = convert_lpips(files[3], files[4], tmp_path / "again")
    assert len(notes) == 3 and "not torchvision's published file" in notes[1] and "neither v0.0 nor v0.1" in notes[2]
