"""What training views saw of a render, against rays cast through a scene of known shapes; scores split by it."""

import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from tests.scenes import photos, ring, three_gaussians
from warpgs.geometry import look_at
from warpgs.pipeline.metrics.coverage import (
    BINS,
    MAX_COUNT,
    DepthView,
    classes_of,
    coverage_lines,
    coverage_map,
    coverage_of_run,
    depth_views,
    fraction_outside,
    photo_errors,
    score_by_coverage,
)
from warpgs.pipeline.metrics.scores import score
from warpgs.pipeline.run.folder import METRICS
from warpgs.render.options import RasterizeOptions
from warpgs.report.images import coverage_image
from warpgs.scene import Camera, View
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import camera_path, still_life


def ray_depth(camera: Camera) -> torch.Tensor:
    """The z-depth of the demo's shapes at the centres of the pixels."""
    xy = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), -1).reshape(-1, 2)
    rays = raycast.pixel_rays(camera.K, camera.viewmat, xy)
    t, _ = raycast.cast(still_life(), camera.center, rays)
    z = np.where(np.isfinite(t), t, 0) * (rays @ camera.viewmat[2, :3])
    return torch.from_numpy(z.reshape(camera.height, camera.width).astype(np.float32))


def truly_sees(viewer: Camera, points: np.ndarray) -> np.ndarray:
    """Whether points lie in a camera's image and the ray to each hits nothing before it."""
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
    """Occlusion and the edges of images included, for all but the pixels at silhouettes."""
    cameras = camera_path(9, 120, 90)
    target, training = cameras[4], [cameras[i] for i in (0, 3, 8)]
    depth = ray_depth(target)
    found = coverage_map(depth, target, [DepthView(c, ray_depth(c)) for c in training])
    xy = np.stack(np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5), -1).reshape(-1, 2)
    rays = np.concatenate([(xy - target.K[:2, 2]) / target.K[[0, 1], [0, 1]], np.ones((len(xy), 1))], 1)
    points = (rays * depth.numpy().reshape(-1, 1) - target.viewmat[:3, 3]) @ target.viewmat[:3, :3]
    wanted = np.sum([truly_sees(c, points) for c in training], 0).reshape(90, 120)
    assert (wanted[..., None] == [0, 1, 2, 3]).mean((0, 1)).min() > 0.01  # every count is there to be got wrong
    assert (found.counts.numpy() == wanted).mean() > 0.95


def plane(width: int = 30, height: int = 20, depth: float = 2.0) -> tuple[Camera, torch.Tensor]:
    """A camera before a wall that faces it."""
    K = np.array([[30.0, 0, width / 2], [0, 30, height / 2], [0, 0, 1]])
    return Camera(np.eye(4), K, width, height), torch.full((height, width), depth)


def test_views_that_saw_nothing_of_it():
    """One turned away, one hidden behind a nearer wall, one that looks through, one without a surface."""
    camera, depth = plane()
    away = Camera(look_at(np.zeros(3), np.array([0.0, 0, -1]), np.array([0.0, -1, 0])), camera.K, 30, 20)
    others = [DepthView(away, depth), DepthView(camera, depth / 2), DepthView(camera, 2 * depth), DepthView(camera, 0 * depth)]
    found = coverage_map(depth, camera, others)
    assert not found.counts.any() and not bool(found.difference.isnan().any())
    assert (found.difference == 0.5).all()  # of the nearer wall, as a share of the depth
    assert (coverage_map(depth, camera, [*others, DepthView(camera, 1.01 * depth)]).counts == 1).all()


def test_counts_end_at_255_and_pixels_without_surface_are_nobodys():
    """Background where the scene is transparent, else seen by none; every pixel is in one class."""
    camera, depth = plane()
    depth[:5] = 0
    found = coverage_map(depth, camera, [DepthView(camera, depth)] * 300)
    assert found.counts.dtype == torch.uint8 and (found.counts[5:] == MAX_COUNT).all() and not found.counts[:5].any()
    assert bool(torch.isinf(found.difference[:5]).all())
    for transparent, name in ((True, "background"), (False, "0")):
        classes = classes_of(found, transparent)
        assert (np.sum(list(classes.values()), 0) == 1).all() and classes[name][:5].all() and classes["2+"][5:].all()


def test_masks_hide_and_many_pixels_are_rendered_smaller():
    """A masked half has no depth; the bound on pixels holds, and the maps still agree with each other."""
    cameras, g = ring(3), three_gaussians()
    mask = np.ones((32, 40), bool)
    mask[:, :20] = False
    whole, half = depth_views(g, cameras[:2], RasterizeOptions(), [None, mask])
    assert bool((half.depth[:, 20:] > 0).any()) and not bool((half.depth[:, :20] > 0).any()) and bool((whole.depth > 0).any())
    small = depth_views(g, cameras, RasterizeOptions(), max_pixels=1500)
    assert sum(v.depth.numel() for v in small) <= 1500
    seen = whole.depth > 0
    counts = coverage_map(whole.depth, cameras[0], small).counts
    assert (counts[seen] > 0).float().mean() > 0.8


def test_photographs_tell_the_error_to_expect():
    """None from one view; two photographs of one wall that differ by 0.1 give 0.01 at the first class, and fill the others."""
    camera, depth = plane()
    views = [View(f"{i}", camera, np.full((20, 30, 3), 0.4 + 0.1 * i, np.float32)) for i in range(2)]
    training = [DepthView(camera, depth)] * 2
    assert photo_errors(views[:1], training[:1]) is None
    errors = photo_errors(views, training)
    assert errors.shape == (len(BINS),) and errors == pytest.approx(0.01, rel=1e-5)


def test_scores_split_into_what_they_are_made_of(tmp_path):
    """Pixels and errors of the classes add up to the whole score; the figures fit the schema; each view has its image."""
    views = photos(5)
    train, test = views[:2], views[3:]
    names = {v.name: v.name.removesuffix(".png") for v in views}
    dim = [View(v.name, v.camera, 0.9 * v.image) for v in test]
    found = coverage_of_run(tmp_path, three_gaussians(), train, dim, RasterizeOptions(), names=names)
    shares = list(found["classes"].values())
    assert sum(r["share_of_pixels"] for r in shares) == pytest.approx(1) == sum(r["share_of_error"] for r in shares)
    for row, v in zip(found["views"], dim):
        mse = sum(r["share_of_pixels"] * 10 ** (-r["psnr"] / 10) for r in row["classes"].values() if math.isfinite(r["psnr"]))
        original = next(t for t in test if t.name == v.name).image
        assert -10 * math.log10(mse) == pytest.approx(score(v, original).psnr, abs=1e-3)
    METRICS(
        json.loads(json.dumps({
            "test": {}, "train": {}, "views": [], "variants": {}, "config_hash": "", "steps": 0, "coverage": found,
            "protocol": {"split": "", "training_views": 2, "held_out_views": 2, "ground_truth": "", "resolution": [],
                         "score_masks": 0},
        })), "",
    )  # fmt: skip
    assert sorted(p.name for p in (tmp_path / "coverage").iterdir()) == sorted(v.name for v in test)
    lines = coverage_lines(found)
    assert found["summary"] in lines and sum(line.startswith("all views") for line in lines) == len(found["classes"])
    again = score_by_coverage(three_gaussians(), train, dim, RasterizeOptions())
    assert again["classes"] == found["classes"]


def test_image_leaves_what_was_seen():
    """Pixels that two views saw are as rendered; the others are tinted, and stripes tell the two tints apart in gray, too."""
    image = np.full((16, 24, 3), 0.5, np.float32)
    unseen, once = np.zeros((2, 16, 24), bool)
    unseen[:, :8], once[:, 8:16] = True, True
    shown = coverage_image(image, unseen, once)
    assert (shown[:, 16:] == 0.5).all() and len(np.unique(shown[:, :8, 1])) == 2 and len(np.unique(shown[:, 8:16, 1])) == 1
