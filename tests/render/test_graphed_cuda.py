"""Calls that repeat are replayed on CUDA with the same bits, also on a stream of their own."""

import dataclasses
import warnings
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import torch.utils.checkpoint

from tests.gaussians import camera, cloud, leaves, of_kind
from tests.scenes import photos, seeds
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.view_modules import Exposure, RefinePoses
from warpgs.render import graphed
from warpgs.render.graphed import MIN_CALLS
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

pytestmark = pytest.mark.cuda

CUDA = torch.device("cuda", 0)
PLAIN = RasterizeOptions(record=False)


def scene(count: int = 400, width: int = 70, height: int = 50) -> tuple[Gaussians, list[Camera]]:
    g, cams = leaves(cloud(count, device=CUDA)), camera(width, height, 4, torch.float32, CUDA)
    return g, [Camera(v, k, width, height) for v, k in zip(cams.viewmat, cams.K)]


@pytest.fixture
def fresh():
    """The recorder of the GPU, cleared; those of other tests are cleared, too."""
    own = graphed.recorder(CUDA)
    graphed.clear_graph_cache()
    for each in graphed._RECORDERS.values():
        each.graphs.replays = 0
    yield own
    own.clear()


def replays() -> int:
    return sum(own.graphs.replays for own in graphed._RECORDERS.values())


def loop(record: bool, steps: int = 9, change: float = 0.01, keep: bool = True, **options):
    """Images, projected Gaussians, counts and gradients of each step; without ``keep`` it holds nothing on the GPU."""
    g, cams = scene()
    seen, params = [], list(g.tensors().values())
    for step in range(steps):
        r = rasterize(g, cams[step % 4], RasterizeOptions(record=record, **options))
        loss = (r.rgb**2).sum()
        if step % 3 == 0:  # another backward kernel
            loss = loss + r.alpha.sum() + 0.1 * r.depth.sum()
        gradients = torch.autograd.grad(loss, params, retain_graph=True)
        (own,) = torch.autograd.grad(loss, r.projected)
        found = [t.detach() for t in (r.rgb, r.alpha, r.depth, r.projected, r.tile_counts, *gradients, own)]
        seen.append(found if keep else [t.cpu() for t in found])
        del r, loss, gradients, own, found
        with torch.no_grad():
            for p in params:
                p += change * torch.sin(torch.arange(p.numel(), device=CUDA) + step).view(p.shape)
    return seen


def equal(a: list, b: list) -> bool:
    return len(a) == len(b) and all(torch.equal(x, y) for s, t in zip(a, b) for x, y in zip(s, t, strict=True))


@pytest.mark.parametrize(
    "options", [{}, {"rule": "gsplat-1.5", "tile_size": 8}, {"sh_degree": 0, "window": (16, 0, 32, 32), "antialiased": True}]
)
def test_a_loop_sees_the_same_bits(fresh, options):
    background = torch.tensor([0.2, 0.5, 0.1], device=CUDA)
    for more in ({}, {"background": background}):
        for keep in (True, False):
            fresh.clear()
            before = replays()
            assert equal(loop(True, keep=keep, **options, **more), loop(False, keep=keep, **options, **more))
            assert replays() > before


@pytest.mark.parametrize("kind", ["covariances", "degree 4"])
def test_packed_covariances_and_degree_4_are_replayed(fresh, kind):
    """Loops whose parameters move in place see the same bits with graphs, also where each call packs tensors anew."""

    def steps(record):
        g, cams = leaves(cloud(400, device=CUDA, degree=4 if kind == "degree 4" else 1)), scene()[1]
        if kind == "covariances":
            g = of_kind(kind, g)
        params, seen = list(g.tensors().values()), []
        for step in range(9):
            r = rasterize(g, cams[step % 4], RasterizeOptions(record=record))
            seen.append([r.rgb.detach().cpu(), *(v.cpu() for v in torch.autograd.grad((r.rgb**2).sum(), params))])
            del r
            with torch.no_grad():
                for p in params:
                    p *= 1.01
        return seen

    before = replays()
    assert equal(steps(True), steps(False))
    assert kind == "covariances" or replays() > before  # torch may give packed tensors other addresses


def test_a_training_loop_is_replayed(fresh):
    """With torch's Adam, a loss of several terms, and cameras in turn, nearly every step is four graphs."""
    g, cams = scene(2000)
    optimizer = torch.optim.Adam(list(g.tensors().values()), 1e-3)
    target = torch.rand(50, 70, 3, device=CUDA)
    for step in range(60):
        optimizer.zero_grad()
        image = rasterize(g, cams[step % 4]).rgb
        loss = (image - target).abs().mean() + 0.2 * ((image - target) ** 2).mean()
        loss.backward()
        optimizer.step()
        if step == 19:
            before, captured = replays(), fresh.rasterizer._forward_blend.captures
    assert replays() - before == 4 * 40 and fresh.rasterizer._forward_blend.captures == captured


def test_images_without_gradients_are_replayed(fresh):
    """Beside a loop with gradients, whose graphs stay; the bits are those of single kernels."""
    g, cams = scene(2000)
    images = graphed.recorder(CUDA, False)
    images.clear()
    for step in range(40):
        (rasterize(g, cams[step % 4]).rgb ** 2).sum().backward()
        with torch.no_grad():
            found, wanted = (rasterize(g, cams[step % 4], o) for o in (RasterizeOptions(), PLAIN))
        assert all(torch.equal(getattr(found, n), getattr(wanted, n)) for n in ("rgb", "alpha", "depth", "projected"))
        assert not found.rgb.requires_grad
        del found, wanted
    # the first camera needs more than the third, whose call is the first to be captured: captured anew at the eleventh
    assert fresh.rasterizer.rendered == 30 and images.rasterizer.rendered == 30 and images.graphs.replays > 30
    images.clear()


def test_more_instances_than_the_capacity_run_without_graphs(fresh):
    """Gaussians that grow twice give the same bits, and are captured anew."""
    g, cams = scene(3000)

    def image(record):
        r = rasterize(g, cams[0], RasterizeOptions(record=record))
        return [r.rgb.detach(), *torch.autograd.grad(r.rgb.sum(), list(g.tensors().values()))]

    capacities = []
    for step in range(14):
        assert equal([image(True)], [image(False)])
        capacities.append(0 if fresh.rasterizer is None else fresh.rasterizer.capacity[1])
        if step in (5, 6):
            with torch.no_grad():
                g.log_scales.add_(1)
    # it did not pay, so the sixth call is captured, not the third
    assert capacities[:2] == [0, 0] and capacities[6:11] == [0] * 5 and capacities[-1] > capacities[5] > 0


def test_open_backward_passes_keep_what_they_need(fresh):
    """Two images before either gradient, an autograd graph that is kept, and one that is thrown away unused."""
    g, cams = scene()
    params = list(g.tensors().values())

    def image_of(i, record=True):
        return rasterize(g, cams[i], RasterizeOptions(record=record)).rgb

    def gradients(*images, **how):
        return torch.autograd.grad(sum((k + 1) * p.sum() for k, p in enumerate(images)), params, **how)

    for _ in range(MIN_CALLS):
        gradients(image_of(0))
    assert fresh.rasterizer is not None
    wanted = gradients(image_of(1, False), image_of(2, False))
    before = replays()
    both = image_of(1), image_of(2)
    assert replays() == before + 4 and equal([gradients(*both)], [wanted])
    kept = image_of(3)
    once = gradients(kept, retain_graph=True)
    other = gradients(image_of(0))
    assert equal([gradients(kept)], [once]) and equal([other], [gradients(image_of(0, False))])
    assert equal([once], [gradients(image_of(3, False))])


def test_batches_and_gradients_of_projected_gaussians(fresh):
    """Four cameras at once, stored column by column, each with a background of its own; densification reads the gradients."""
    g, _ = scene()
    cams = camera(70, 50, 4, torch.float32, CUDA)
    cams = dataclasses.replace(cams, viewmat=cams.viewmat.mT.contiguous().mT)
    backgrounds, seen = torch.rand(4, 3, device=CUDA), {}
    for record in (True, False):
        for _ in range(MIN_CALLS + 1):
            for t in g.tensors().values():
                t.grad = None
            r = rasterize(g, cams, RasterizeOptions(record=record, background=backgrounds))
            r.projected.retain_grad()
            (r.rgb * r.rgb).sum().backward()
        seen[record] = [r.rgb.detach(), r.projected.grad, *(t.grad for t in g.tensors().values())]
    assert replays() > 0 and equal([seen[True]], [seen[False]])


def test_hooks_and_checkpoints_run_without_graphs(fresh):
    """Saved tensors that are stored elsewhere, and an image that is rendered again for its gradient."""
    g, cams = scene()
    params = list(g.tensors().values())

    def gradient(render):
        return torch.autograd.grad(render(g, cams[0]).rgb.sum(), params)

    wanted = gradient(lambda *of: rasterize(*of, PLAIN))
    for _ in range(2 * MIN_CALLS):
        with torch.autograd.graph.save_on_cpu(pin_memory=True):
            assert equal([gradient(rasterize)], [wanted])
    assert replays() == 0
    for _ in range(2 * MIN_CALLS):
        again = torch.utils.checkpoint.checkpoint(lambda: rasterize(g, cams[0]).rgb, use_reentrant=False)
        assert equal([torch.autograd.grad(again.sum(), params)], [wanted])


def test_threads_render_what_they_would_alone(fresh):
    def work(seed):
        g = leaves(cloud(300, device=CUDA, seed=seed))
        cam, found = camera(70, 50, None, torch.float32, CUDA), {}
        for record in (False, True):
            for _ in range(12):
                r = rasterize(g, cam, RasterizeOptions(record=record))
                found[record] = [r.rgb.detach(), *torch.autograd.grad(r.rgb.sum(), list(g.tensors().values()))]
        return equal([found[True]], [found[False]])

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(work, range(4))) == [True] * 4


def test_a_device_that_is_not_the_current_one(fresh):
    """Its calls run without graphs."""
    if torch.cuda.device_count() < 2:
        pytest.skip("needs a second CUDA device to be the current one")
    g, cams = scene()
    with torch.cuda.device(1):
        for _ in range(MIN_CALLS + 2):
            rasterize(g, cams[0]).rgb.sum().backward()
            assert torch.cuda.current_device() == 1
    assert replays() == 0


def test_cameras_and_backgrounds_have_gradients(fresh):
    def run(record):
        g, cams = scene()
        seen = []
        for step in range(6):
            c = cams[step % 4]
            v, k, b = (t.clone().requires_grad_() for t in (c.viewmat, c.K, torch.full((3,), 0.1 * step, device=CUDA)))
            r = rasterize(g, dataclasses.replace(c, viewmat=v, K=k), RasterizeOptions(background=b, record=record))
            seen.append(torch.autograd.grad((r.rgb**2).sum() + r.depth.sum(), [v, k, b, g.means]))
        return seen

    assert equal(run(True), run(False)) and replays() > 0


def test_graphs_hold_no_memory(fresh):
    """Between calls only what graphs need for themselves; in a call what others take, and a little spare capacity."""
    g, cams = scene(30_000, 400, 300)
    peaks, held = {}, {}
    for record in (False, True):
        for _ in range(MIN_CALLS + 3):
            torch.cuda.reset_peak_memory_stats()
            before = torch.cuda.memory_allocated()
            image = rasterize(g, cams[0], RasterizeOptions(record=record)).rgb
            # in this thread: one of autograd's own lets go of gradients whenever it comes to it
            with torch.autograd.set_multithreading_enabled(False):
                torch.autograd.grad(image.sum(), list(g.tensors().values()))
            del image
            peaks[record] = torch.cuda.max_memory_allocated() - before
        held[record] = torch.cuda.memory_allocated()
    assert replays() > 0 and held[True] - held[False] < 2**21
    assert peaks[True] < 1.1 * peaks[False] + 2**20


def test_streams_do_not_share(fresh):
    found = {}
    for record in (True, False):
        g, cams = scene()
        found[record] = []
        for stream in (torch.cuda.current_stream(), torch.cuda.Stream()):
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(2 * MIN_CALLS):
                    r = rasterize(g, cams[0], RasterizeOptions(record=record))
                    (step,) = torch.autograd.grad(r.rgb.sum(), g.means)
                    with torch.no_grad():
                        g.means.sub_(1e-4 * step)
                    found[record].append([r.rgb.detach(), step])
                del r  # its graph would tie the leaves to this stream, of which torch warns on the next one
            torch.cuda.current_stream().wait_stream(stream)
    assert fresh.graphs.replays > 0 and replays() > fresh.graphs.replays and equal(found[True], found[False])


# Loops and fits on a CUDA stream of their own: torch does not warn of AccumulateGrad nodes on another stream.


@pytest.fixture
def the_warning_is_an_error():
    """It raises each time that torch has a reason for it."""
    before = torch.is_warn_always_enabled()
    torch.set_warn_always(True)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="The AccumulateGrad node")
        yield
    torch.set_warn_always(before)


@pytest.fixture(params=[False, True], ids=["default stream", "own stream"])
def stream(request):
    """Torch's current stream while a test runs."""
    own = torch.cuda.Stream() if request.param else torch.cuda.current_stream()
    own.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(own):
        yield own
    torch.cuda.current_stream().wait_stream(own)


@pytest.mark.usefixtures("the_warning_is_an_error")
def test_the_warning_is_seen():
    """Where a loop keeps a render of another stream, which ties the leaves to that stream."""
    g, cam = leaves(cloud(50, device=CUDA)), camera(20, 12, dtype=torch.float32, device=CUDA)
    held, own = rasterize(g, cam).rgb, torch.cuda.Stream()
    own.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(own), pytest.raises(UserWarning, match="stream does not match"):
        rasterize(g, cam).rgb.sum().backward()
    torch.cuda.current_stream().wait_stream(own)
    assert held.requires_grad


@pytest.mark.usefixtures("the_warning_is_an_error")
@pytest.mark.parametrize("record", [True, False])
@pytest.mark.parametrize(
    "more", [{}, {"absgrad": True, "contributions": True, "median_depth": True, "heaviest": 2}], ids=["", "all"]
)
def test_a_training_loop_does_not_warn(stream, record, more):
    """An optimizer over Gaussians, pose and background; a render is kept from step to step, as loops that log do."""
    g, cam = leaves(cloud(300, device=CUDA)), camera(70, 50, dtype=torch.float32, device=CUDA)
    pose, background = cam.viewmat.clone().requires_grad_(), torch.zeros(3, device=CUDA, requires_grad=True)
    optimizer = torch.optim.Adam([*g.tensors().values(), pose, background], lr=1e-3)
    target = rasterize(g, cam).rgb.detach() * 0.9
    losses = []
    for _ in range(3 * MIN_CALLS):
        options = RasterizeOptions(background=background, record=record, **more)
        render = rasterize(g, dataclasses.replace(cam, viewmat=pose), options)
        means2d = render.means2d if more else None
        loss = (render.rgb - target).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.detach())
    assert float(losses[-1]) < float(losses[0]) and bool(torch.isfinite(pose.grad).all())
    assert means2d is None or bool(means2d.absgrad.any())


@pytest.mark.usefixtures("the_warning_is_an_error")
def test_a_loop_that_moves_to_another_stream_does_not_warn():
    """Where nothing holds the graph of the last step: leaves that were used on one stream are used on another."""
    g, cam = leaves(cloud(300, device=CUDA)), camera(70, 50, dtype=torch.float32, device=CUDA)
    for own in (torch.cuda.current_stream(), torch.cuda.Stream(), torch.cuda.current_stream()):
        own.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(own):
            for _ in range(2 * MIN_CALLS):
                rasterize(g, cam).rgb.square().mean().backward()
        torch.cuda.current_stream().wait_stream(own)
    assert bool(g.means.grad.any())


@pytest.mark.usefixtures("the_warning_is_an_error")
@pytest.mark.parametrize("batch", [1, 2])
def test_a_fit_does_not_warn(stream, batch):
    """Steps from Python, then replayed; poses and exposures are leaves, too, and Gaussians are added in between."""
    density = DensityConfig(start=5, every=10)
    modules = (RefinePoses(start=0), Exposure())
    config = FitConfig(steps=40, batch=batch, density=density, view_modules=modules, init=InitConfig(source="points"))
    trainer = Trainer(photos(4), seeds(), config, CUDA)
    count = len(trainer.gaussians)
    while trainer.step < config.steps:
        trainer.advance()
    assert len(trainer.gaussians) != count
