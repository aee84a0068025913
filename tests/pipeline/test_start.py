"""Where fits start: points from confirmed depth and where no view looks, and kernels compiled beforehand."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp

from tests.example_terms import DepthCorrelation
from tests.priors.rigs import still_life, write_flo
from tests.scenes import photos, priors, ring, seeds
from warpgs.app.cli import main
from warpgs.compat import gsplat, inria
from warpgs.geometry import back_project, in_image, project_points
from warpgs.kernels import launch as interop
from warpgs.kernels.sweep import given
from warpgs.pipeline.metrics.scores import render_view, score
from warpgs.pipeline.model.depth_points import (
    BEYOND,
    BEYOND_PX,
    EXTRAPOLATED_OPACITY,
    REACH,
    STEP,
    coarse_points,
    depth_bounds,
    extrapolated_points,
    in_free_space,
    merge,
    merge_cells,
)
from warpgs.pipeline.model.start import InitConfig, Start, initial_gaussians, initial_points, subsample
from warpgs.pipeline.paper.strategy import PaperConfig
from warpgs.pipeline.run import precompile
from warpgs.pipeline.run.precompile import fit_kernels
from warpgs.pipeline.train import setup
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies import sampling
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, PointCloud, View, ViewDepth

# The coarse start: a Gaussian per confirmed pixel, merged, filled, and honest where there is nothing to confirm.


def depth_of(values: np.ndarray) -> ViewDepth:
    valid = values > 0
    return ViewDepth(values.astype(np.float32), valid, np.where(valid, 1, np.inf).astype(np.float32))


def known(valid_fraction: float = 1.0, cut: int = 0) -> tuple[list[View], list[ViewDepth]]:
    views, depths = still_life()
    generator = np.random.default_rng(0)
    out = []
    for d in depths:
        valid = generator.uniform(size=d.shape) < valid_fraction
        valid[:, :cut] = False
        out.append(depth_of(np.where(valid, d, 0)))
    return views, out


def test_every_confirmed_pixel_becomes_a_point():
    views, depths = known(0.3)
    cloud, notes = coarse_points(views, depths, merge_px=0, fill_px=0, source="flow")
    counts = [int(d.valid.sum()) for d in depths]
    assert len(cloud) == sum(counts)
    first = slice(0, counts[0])
    pixels, z = project_points(views[0].camera, cloud.points[first])
    rows, columns = np.nonzero(depths[0].valid)
    assert np.allclose(pixels, np.stack([columns, rows], 1) + 0.5, atol=1e-4)
    assert np.allclose(z, depths[0].depth[rows, columns])
    assert np.array_equal(cloud.colors[first], views[0].image[rows, columns])
    assert notes[0] == f"000.png: {100 * depths[0].valid.mean():.0f} % of pixels by flow"
    assert notes[-1] == f"{len(cloud):,} points from {len(cloud):,} pixels by flow, 0 filled in"


def test_points_of_the_reconstruction_fill_what_no_depth_confirms():
    """Those that two views saw, where there are none of the sweep's; the others and those seen once are left out."""
    views, depths = known(cut=40)
    names = [v.name for v in views]
    rows, columns = np.mgrid[10:60:10, 5:35:10].reshape(2, -1)
    z = known()[1][0].depth[rows, columns]
    inside = back_project(views[0].camera, np.stack([columns, rows], 1) + 0.5, z)
    seen = [sum(in_image(v.camera, p[None])[0] for v in views) >= 2 for p in inside]
    points = np.concatenate([inside, inside + 0.01])
    tracks = (*(frozenset(names) for _ in inside), *(frozenset(names[:1]) for _ in inside))
    cloud = PointCloud(points, np.full((len(points), 3), 0.25, np.float32), tracks)
    bare, _ = coarse_points(views, depths, merge_px=4, fill_px=0, source="sweep")
    more, notes = coarse_points(views, depths, merge_px=4, fill_px=0, source="sweep", known=cloud)
    added = more.points[len(bare) :]
    assert 0 < len(added) <= sum(seen) and f"{len(added)} from the reconstruction" in notes[-1]
    assert np.abs(added[:, None] - inside[None]).sum(2).min(1).max() < 1e-9
    unknown = PointCloud(points, cloud.colors)
    assert len(coarse_points(views, depths, merge_px=4, fill_px=0, source="sweep", known=unknown)[0]) == len(bare)
    filled, _ = coarse_points(views, depths, merge_px=4, fill_px=8, source="sweep", known=cloud)
    without, _ = coarse_points(views, depths, merge_px=4, fill_px=8, source="sweep")
    assert len(filled) >= len(without)


def test_merging_takes_the_mean_of_a_cell():
    """Points of a cell are added up in their order, whatever the parts; cells come in the order of their place."""

    def cells(*parts):
        """Return the number of each point's cell."""
        return np.concatenate(
            [np.repeat(own[:, 2], own[:, 1] - own[:, 0]) for own in merge_cells([given(*p) for p in parts], 1)]
        )

    points = np.array([[0.1, 0.1, 0.1], [0.3, 0.3, 0.3], [1.2, 0.1, 0.1], [0.2, 0.2, 0.2]])
    widths = np.array([1.0, 1.1, 0.9, 4.0])
    numbers = cells((points, widths))
    assert numbers[0] == numbers[1] and len(set(numbers.tolist())) == 3
    cloud = merge([given(points, widths)], [points.astype(np.float32)], merge_cells([given(points, widths)], 1))
    assert len(cloud) == 3 and np.abs(cloud.points - 0.2).sum(1).min() < 1e-12
    assert np.allclose(cloud.points, cloud.colors)
    # an outlier so far away that cells have no single number each: the others share cells as they did without it
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3))
    near = cells((points, np.full(200, 0.25)))
    far = cells((points, np.full(200, 0.25)), (np.array([[1e14, -1e14, 1e14]]), np.full(1, 0.25)))
    assert np.array_equal(far[:200][:, None] == far[:200], near[:, None] == near) and (far[200] != far[:200]).all()
    generator = np.random.default_rng(0)
    points, colors = generator.uniform(-2, 2, (30_000, 3)), generator.uniform(size=(30_000, 3)).astype(np.float32)
    widths = generator.uniform(0.2, 0.5, len(points))
    level = np.round(np.log2(0.5 * widths))
    rows = np.column_stack([level, np.floor(points / np.exp2(level)[:, None])])
    _, wanted, counts = np.unique(rows, axis=0, return_inverse=True, return_counts=True)
    means = [
        np.stack([np.bincount(wanted.ravel(), v) for v in values.T.astype(float)], 1) / counts[:, None]
        for values in (points, colors)
    ]
    for ends in ([], [0, 7, 30_000], [300, 301, 20_000]):
        parts = [given(*part) for part in zip(np.split(points, ends), np.split(widths, ends))]
        cloud = merge(parts, np.split(colors, ends), merge_cells(parts, 0.5))
        assert np.array_equal(cloud.points, means[0]) and np.array_equal(cloud.colors, means[1].astype(np.float32))


def test_filled_points_come_last_and_hide_nothing():
    """What no view confirms gets coarse points near the true surface, and none before a depth that another view found."""
    views, depths = known(cut=40)
    bare, _ = coarse_points(views, depths, merge_px=4, fill_px=0, source="sweep")
    cloud, notes = coarse_points(views, depths, merge_px=4, fill_px=8, source="sweep")
    assert np.array_equal(cloud.points[: len(bare)], bare.points) and len(cloud) > len(bare)
    assert "75 % of pixels by sweep, " in notes[0] and notes[-1].endswith(f"{len(cloud) - len(bare)} filled in")
    filled = cloud.points[len(bare) :]
    filled = given(filled, np.ones(len(filled)))
    assert not any(in_free_space(filled, views[j : j + 1], [0.93 * depths[j].depth], -1).any() for j in range(3))
    # a view whose depth was not searched for neither fills nor hides: the work for each of many views is bounded
    unsearched = dataclasses.replace(depth_of(0 * depths[2].depth), searched=False)
    few, _ = coarse_points(views[:2], depths[:2], merge_px=0, fill_px=4, source="sweep")
    more, notes = coarse_points(views, [*depths[:2], unsearched], merge_px=0, fill_px=4, source="sweep")
    assert np.array_equal(few.points, more.points) and "filled" not in notes[2] and "filled" in notes[1]


def test_free_space_bounds_and_objects_on_black():
    """Nearer than the surface: hides it. On it, behind it, in the view itself, or where nothing was found: does not."""
    camera = Camera(np.eye(4), np.array([[10.0, 0, 5], [0, 10, 5], [0, 0, 1]]), 10, 10)
    views = [View("a", camera, np.zeros((10, 10, 3), np.float32))] * 2
    depth = np.full((10, 10), 4.0)
    depth[:, :5] = 0
    points = np.array([[0.1, 0, 2], [0.1, 0, 3.9], [0.1, 0, 6], [-0.1, 0, 2], [50, 0, 2]])
    row = given(points, np.ones(5))
    assert in_free_space(row, views, [depth, depth], 0).tolist() == [[True, False, False, False, False]]
    assert not in_free_space(row, views[:1], [depth], 0).any()
    points = np.stack([np.zeros(101), np.zeros(101), np.linspace(2, 4, 101)], 1)
    near, far = depth_bounds(views[0], points, (1, 2))
    assert near == pytest.approx(2.04 / 1.3) and far == pytest.approx(3.96 * 3)
    assert depth_bounds(views[0], points[:5], (1, 2)) == depth_bounds(views[0], -points, (1, 2)) == (1, 2)
    camera = ring(1)[0]
    y, x = np.mgrid[:32, :40] + 0.5
    ball = (x - 20) ** 2 + (y - 16) ** 2 < 64
    view = View("a", camera, np.where(ball[..., None], 0.8, 0).astype(np.float32).repeat(3, 2))
    valid = ball & (x < 20) | (x < 4)
    depth = ViewDepth(np.where(valid, 2, 0).astype(np.float32), valid, np.ones(valid.shape, np.float32))
    cloud, notes = coarse_points([view], [depth], merge_px=0, fill_px=2, source="flow")
    assert (cloud.colors == np.float32(0.8)).all() and "50 % of the foreground by flow, 50 % filled" in notes[0]


@pytest.mark.parametrize("source", ["sweep", "flow"])
def test_start_from_confirmed_depth(source):
    views, depths = still_life()
    config = InitConfig(source=source, flow="dis", fill_px=0)
    cloud, how, *_ = initial_points(views, None, config, np.random.default_rng(0))
    assert 1000 < len(cloud) < sum(d.size for d in depths) / 12 and f"by {source}" in how and how.count(" % of pixels") == 3
    pixels, z = project_points(views[1].camera, cloud.points)
    seen = in_image(views[1].camera, cloud.points)
    at = np.floor(pixels[seen]).astype(int)
    ratio = z[seen] / depths[1][at[:, 1], at[:, 0]]
    assert (np.abs(ratio - 1) < 0.03).mean() > 0.6
    again, *_ = initial_points(views, None, config, np.random.default_rng(0))
    assert np.array_equal(cloud.points, again.points)


def test_fallbacks_are_said(tmp_path):
    views, _ = still_life()
    cloud, how, *_ = initial_points(views[:1], None, InitConfig(source="sweep", random_count=300), np.random.default_rng(0))
    assert len(cloud) == 300 and "instead of --init.source sweep: depth needs at least two views" in how
    write_flo(tmp_path / "000-to-001.flo", np.full((120, 160, 2), np.nan, np.float32))
    config = InitConfig(source="flow", flow=str(tmp_path), random_count=300)
    cloud, how, *_ = initial_points(views, None, config, np.random.default_rng(0))
    assert len(cloud) == 300 and "only 0 points survived" in how and "no flow to 002.png" in how and "overlap?" in how
    away = [photos(2)[0]]
    turned = np.diag([-1.0, 1, -1, 1]) @ away[0].camera.viewmat
    noise = np.random.default_rng(0).uniform(size=(32, 40, 3)).astype(np.float32)
    away.append(View("back.png", Camera(turned, away[0].camera.K, 40, 32), noise))
    cloud, how, *_ = initial_points(away, None, InitConfig(source="sweep", random_count=300), np.random.default_rng(0))
    assert len(cloud) == 300 and "no depth agrees with back.png" in how


SIZE, NEAR, FAR = 96, 2.0, 4.0
RED, BLUE = (0.75, 0.25, 0.25), (0.25, 0.25, 0.75)


def card(shift: float = 0.0) -> tuple[View, ViewDepth]:
    viewmat = np.eye(4)
    viewmat[0, 3] = -shift
    camera = Camera(viewmat, np.array([[SIZE, 0, SIZE / 2], [0, SIZE, SIZE / 2], [0, 0, 1]], float), SIZE, SIZE)
    near = np.zeros((SIZE, SIZE), bool)
    near[24:72, 24:72] = True
    image = np.where(near[..., None], RED, BLUE).astype(np.float32)
    return View(f"{shift}", camera, image), depth_of(np.where(near, NEAR, FAR))


def test_images_go_on_beyond_their_border_and_walls_behind_the_edge_of_a_card():
    view, depth = card()
    cloud = extrapolated_points([view], [depth])
    pixels, z = project_points(view.camera, cloud.points)
    outside = ~in_image(view.camera, cloud.points)
    pad = BEYOND * SIZE
    assert outside.sum() == ((SIZE + 2 * pad) / BEYOND_PX) ** 2 - (SIZE / BEYOND_PX) ** 2
    assert np.allclose(z[outside], FAR, rtol=0.2) and np.allclose(cloud.colors[outside], BLUE, atol=1e-5)
    assert pixels[outside].min() >= -pad and pixels[outside].max() <= SIZE + pad
    beside = card(0.5)
    both = extrapolated_points([view, beside[0]], [depth, beside[1]])
    shown = [in_image(v.camera, both.points) for v in (view, beside[0])]
    beyond = ~(shown[0] | shown[1])
    assert 0 < beyond.sum() < 2 * outside.sum()
    elsewhere = cloud.points[outside & in_image(beside[0].camera, cloud.points)]
    assert len(elsewhere) and not (elsewhere[:, None] == both.points).all(2).any()
    inside = in_image(view.camera, cloud.points)
    pixels, z = project_points(view.camera, cloud.points[inside])
    red, _, blue = cloud.colors[inside].T
    assert len(z) > 20 and np.allclose(z, FAR) and (blue > red).all()
    edge = np.minimum(pixels - 24, 72 - pixels).min(1)  # distance from the card's edge, inwards [px]
    assert (edge > 0).all() and (edge <= REACH).all()
    slope = np.broadcast_to(2 * (1 + 0.8 * (STEP - 1)) ** np.arange(SIZE), (SIZE, SIZE))  # more than EDGE within reach
    assert not in_image(view.camera, extrapolated_points([view], [depth_of(slope)]).points).any()
    (view, depth), (other, _) = card(), card(0.5)
    past = np.full((SIZE, SIZE), 8 * FAR)
    none = extrapolated_points([view, other], [depth, depth_of(past)])
    assert not (in_image(view.camera, none.points) & in_image(other.camera, none.points)).any()
    some = extrapolated_points([view, other], [depth, depth_of(0 * past)])
    assert (in_image(view.camera, some.points) & in_image(other.camera, some.points)).any()


def test_nothing_is_extrapolated_of_parts_of_images():
    view, depth = card()
    mask = np.ones((SIZE, SIZE), bool)
    mask[:8] = False
    assert len(extrapolated_points([dataclasses.replace(view, mask=mask)], [depth])) == 0
    assert len(extrapolated_points([dataclasses.replace(view, alpha=mask.astype(np.float32))], [depth])) == 0
    assert len(extrapolated_points([view], [depth_of(0 * depth.depth)])) == 0
    assert len(extrapolated_points([view], [dataclasses.replace(depth, searched=False)])) == 0
    lens = dataclasses.replace(view.camera, model="opencv", distortion=np.zeros(8))
    bent = extrapolated_points([dataclasses.replace(view, camera=lens)], [depth])
    assert len(bent) > 20 and in_image(view.camera, bent.points).all()


def test_extrapolated_points_come_last_or_a_start_says_why_there_are_none():
    views, _ = known()
    config = InitConfig(source="sweep", merge_px=4, fill_px=8)
    plain, more = (
        initial_points(views, None, dataclasses.replace(config, extrapolate=unseen), np.random.default_rng(0))
        for unseen in (False, True)
    )
    count = len(plain.cloud)
    assert plain.extrapolated == 0 and more.extrapolated == len(more.cloud) - count > 20
    assert np.array_equal(more.cloud.points[:count], plain.cloud.points)
    assert f"{more.extrapolated} extrapolated where no view looks" in more.how and "extrapolated" not in plain.how
    opacities = initial_gaussians(more.cloud, InitConfig(), 0, 1.0, torch.device("cpu"), 5).logit_opacities.sigmoid()
    assert torch.allclose(opacities[-5:], torch.tensor(EXTRAPOLATED_OPACITY))
    assert torch.allclose(opacities[:-5], torch.tensor(InitConfig().opacity))
    fewer = subsample(more, len(more.cloud) // 2, np.random.default_rng(0))
    extrapolated = {tuple(p) for p in more.cloud.points[count:]}
    are = [tuple(p) in extrapolated for p in fewer.cloud.points]
    assert sum(are) == fewer.extrapolated > 0 and all(are[-fewer.extrapolated :])
    corner = np.ones(views[0].image.shape[:2], bool)
    corner[:4, :4] = False
    masked = [dataclasses.replace(v, mask=corner) for v in views]
    config = InitConfig(source="sweep", merge_px=4, fill_px=8, extrapolate=True)
    random = dataclasses.replace(config, source="random", random_count=200)
    for chosen, settings, reason in ((masked, config, "none extrapolated (masks"), (views, random, "sweep or flow")):
        start = initial_points(chosen, None, settings, np.random.default_rng(0))
        assert reason in start.how and start.extrapolated == 0
        plain = dataclasses.replace(settings, extrapolate=False)
        assert "extrapolated" not in initial_points(chosen, None, plain, np.random.default_rng(0)).how


@pytest.mark.parametrize("extrapolated", [1, 0])
def test_a_fit_spares_what_no_view_shows(device, extrapolated, monkeypatch):
    cloud = seeds()
    lone = PointCloud(np.concatenate([cloud.points, [[500.0, 500, 500]]]), np.concatenate([cloud.colors, cloud.colors[:1]]))
    monkeypatch.setattr(setup, "initial_points", lambda *given: Start(lone, "", None, extrapolated))
    config = FitConfig(
        steps=4, sh_degree=0, init=InitConfig(source="points", extrapolate=True),
        optimizer=OptimizerConfig(opacities_decay=0.01, opacities_lr=1e-6),
    )  # fmt: skip
    trainer = Trainer(photos(3), lone, config, torch.device(device))
    before = trainer.gaussians.logit_opacities.clone()
    for _ in range(4):
        trainer.advance()
    lower = trainer.gaussians.logit_opacities < before
    far = trainer.gaussians.means.norm(dim=1) > 100
    assert int(far.sum()) == 1 and bool(lower[far]) != bool(extrapolated) and lower[~far].float().mean() > 0.5


@wp.kernel(enable_backward=False, module="unique")
def nothing(begin: int): ...


@pytest.fixture
def launched(monkeypatch):
    """Kind of device, module and size of blocks of each launch of a test."""
    found, launch = set(), interop.launch

    def note(kernel, count, inputs, where, *, block_dim=256, **more):
        found.add((where.type, kernel.module, 1 if where.type == "cpu" else block_dim))
        launch(kernel, count, inputs, where, block_dim=block_dim, **more)

    monkeypatch.setattr(interop, "launch", note)
    return found


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize("strategy", ["paper", "mcmc"])
def test_a_fit_launches_nothing_else(device, strategy, recorded, monkeypatch, launched):
    views = photos(3)
    views[0] = dataclasses.replace(views[0], mask=np.ones(views[0].image.shape[:2], bool))
    monkeypatch.setattr(sampling, "MIN_ALPHA", 0.05)
    method = sampling.MethodConfig(hier=True, sampler=sampling.SamplerConfig(fraction=0.01, max_fraction=0.05))
    own = {} if strategy == "mcmc" else {"strategy_config": PaperConfig(pm=False)}
    config = FitConfig(
        steps=20, dropout=0.2, cuda_graph=recorded, init=InitConfig(source="points" if strategy == "mcmc" else "sweep"),
        optimizer=OptimizerConfig(opacities_decay=0.001),
        strategy=strategy, method=method, **own,
        loss_terms=(DepthCorrelation(0.1, 0.5),),
        density=DensityConfig(start=2, every=2), phases=PhaseConfig(200, 300),
    )  # fmt: skip
    fit = Trainer(views, seeds(), config, device, priors=priors(views))
    while fit.step < 20:
        fit.advance(100)
    assert strategy == "mcmc" or any(event["evicted"] for event in fit.strategy.events)
    score(views[1], render_view(fit.gaussians, views[1], RasterizeOptions())[0])
    warmed = {(kind, k.module, block) for kind in ("cpu", "cuda") for k, block in fit_kernels(kind == "cuda")}
    assert len(launched) > 8 and launched <= warmed and {1, 32, 64, 128, 256} <= {block for _, _, block in warmed}


def test_calls_of_other_programs_launch_nothing_else(device, launched):
    """Their colours, inverse and median depths, with gradients, on their form of Gaussians."""
    means, pose = torch.rand(9, 3, device=device) + 1, torch.eye(4, device=device)
    lens = torch.tensor([[2.0, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 1], [0, 0, 0, 0]], device=device)
    for fields in ((), (False,), (False, False)):
        settings = (32, 32, 0.5, 0.5, means.new_zeros(3), 1.0, pose, lens, 3, means.new_zeros(3), False, *fields)
        given = {"means3D": means.clone().requires_grad_(), "means2D": torch.zeros_like(means), "opacities": means[:, :1] / 2}
        shape = {"scales": means / 9, "rotations": torch.ones(9, 4, device=device), "shs": means.new_zeros(9, 16, 3)}
        image, _, *depths = inria.GaussianRasterizer(inria.GaussianRasterizationSettings(*settings))(**given, **shape)
        sum(values.sum() for values in (image, *depths) if values.requires_grad).backward()
    given = means.clone().requires_grad_(), shape["rotations"], means / 9, means[:, 0] / 2, shape["shs"], pose[None]
    gsplat.rasterization(*given, lens[None, :3, :3], 32, 32, sh_degree=3, render_mode="RGB+ED")[0].sum().backward()
    cuda = device.type == "cuda"
    warmed = {(device.type, kernel.module, block) for kernel, block in fit_kernels(cuda) + precompile.call_kernels(cuda)}
    assert len(launched) > 8 and launched <= warmed, {m.name for _, m, _ in launched - warmed}


@pytest.mark.slow
def test_the_second_call_finds_all_in_the_cache(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(precompile, "fit_kernels", lambda cuda: [(nothing, 1)])
    monkeypatch.setattr(precompile, "call_kernels", lambda cuda: [])
    said = []
    for _ in range(2):
        assert main(["doctor", "--warm"]) == 0
        said.append(capsys.readouterr().out)
        nothing.module.unload()
    assert "cpu: test_start.nothing, after " in said[0] and "1 modules: 1 compiled, 0 were in the cache" in said[0]
    assert "test_start.nothing" not in said[1] and "1 modules: 0 compiled, 1 were in the cache" in said[1]
