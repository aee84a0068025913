"""CUDA text: it compiles without a GPU; contracts between its bodies: items dealt, tiles ordered, blocks left out."""

import functools
import itertools
import math
from types import SimpleNamespace

import pytest
import torch
import warp as wp

from tests.gaussians import camera, cloud, leaves
from warpgs.constants import ALPHA_CUT
from warpgs.kernels import blend, blend_cuda, launch, native, project_cuda, walk
from warpgs.kernels.cameras import CAMERA_MODELS
from warpgs.kernels.native import source
from warpgs.pipeline.run.precompile import fit_kernels
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize

CUDA = torch.device("cuda", 0)


def ints(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.view(-1)


@pytest.mark.cuda
@pytest.mark.parametrize("count", [1, 31, 1000, 1025, 8192, 8193, 20_000])
def test_long_lists_come_first(count):
    """Each tile once, in the row of its length's leading zeros, and nothing behind the last; lists lie anywhere."""
    generator = torch.Generator().manual_seed(count)
    lengths = torch.exp2(21 * torch.rand(count, generator=generator)).int() - 1
    lengths[::7] = 0
    begins = torch.randint(2**20, (count,), generator=generator, dtype=torch.int32)
    ranges = torch.stack([begins, begins + lengths], 1).to(CUDA)
    order = torch.full((blend_cuda.RANKS, count), -1, dtype=torch.int32, device=CUDA)
    counts = torch.zeros(blend_cuda.RANKS, dtype=torch.int32, device=CUDA)
    threads = -(-count // blend_cuda.ORDER_THREADS) * blend_cuda.ORDER_THREADS
    inputs = [ints(ranges), count, ints(counts), ints(order)]
    launch.launch(blend_cuda.make_kernels(16).order_tiles, threads, inputs, CUDA, block_dim=blend_cuda.ORDER_THREADS)
    ranks = 32 - torch.ceil(torch.log2(lengths.double() + 1)).int()
    for rank, found in enumerate(order.cpu()):
        wanted = torch.nonzero(ranks == rank)[:, 0].int()
        assert int(counts[rank]) == len(wanted) and bool((found[len(wanted) :] == -1).all())
        assert torch.equal(found[: len(wanted)].sort().values, wanted)


@functools.cache
def small_kernels() -> SimpleNamespace:
    numbers = {"SIDE": 16, "STATE": 5, "WARPS": 2, "STRIDE": 12, "SCALE": blend_cuda.SCALE}

    @wp.func_native(
        source("blend_common.cu", **numbers)
        + """
        Splat s;
        s.load(projected.data, i);
        s.rescale();
        return s.touches(corners.data[2 * i], corners.data[2 * i + 1], limit_of(s.b.y, __log2f(cut)));
        """
    )
    def touches(projected: wp.array(dtype=float), corners: wp.array(dtype=float), cut: float, i: int) -> int: ...

    @wp.kernel(enable_backward=False, module="unique")
    def block(
        begin: int, projected: wp.array(dtype=float), corners: wp.array(dtype=float), cut: float, found: wp.array(dtype=int)
    ):
        i = begin + wp.tid()
        found[i] = touches(projected, corners, cut, i)

    @wp.kernel(enable_backward=False, module="unique")
    def deal(begin: int, wanted: wp.array(dtype=int), found: wp.array(dtype=int)):
        i = begin + wp.tid()
        found[i] = native.compact(i, wanted[i])

    return SimpleNamespace(block=block, deal=deal)


@pytest.mark.cuda
@pytest.mark.parametrize("fraction", [0.0, 0.3, 0.97, 1.0])
def test_wanted_items_go_to_the_first_threads(fraction):
    """Wanted items come in order within their block, for any nonzero flag; left-over threads get -1."""
    blocks = 50
    draw = torch.rand(blocks * native.BLOCK, generator=torch.Generator().manual_seed(0))
    wanted = torch.where(draw < fraction, (draw * 1000).int() % 3 + 1, 0).int()
    found = torch.full_like(wanted, -7).to(CUDA)
    launch.launch(small_kernels().deal, len(wanted), [ints(wanted.to(CUDA)), ints(found)], CUDA, block_dim=native.BLOCK)
    for i, dealt in enumerate(found.cpu().view(blocks, -1).tolist()):
        items = range(i * native.BLOCK, (i + 1) * native.BLOCK)
        mine = [item for item in items if wanted[item] > 0]
        assert dealt == mine + [-1] * (native.BLOCK - len(mine))


def at_their_edge(count: int, longest: float, corner: bool):
    """Return projected Gaussians, and for each a block with one pixel at its edge; ``longest`` is the log of the axis [px]."""
    generator = torch.Generator().manual_seed(int(longest) + corner)

    def rand(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    turn, along = 2 * math.pi * rand(count), torch.exp(longest * rand(count) - 0.6)
    across = torch.minimum(torch.exp(5 * rand(count) ** 2 - 0.6), along)
    c, s, det = torch.cos(turn), torch.sin(turn), (along * across) ** 2
    xx, xy, yy = (c * along) ** 2 + (s * across) ** 2, c * s * (along**2 - across**2), (s * along) ** 2 + (c * across) ** 2
    u11, u12, u22 = (yy / det).sqrt(), -xy / (yy * det).sqrt(), 1 / yy.sqrt()
    opacity = ALPHA_CUT * torch.exp(5.5 * rand(count) ** 2)
    reach = (2 * torch.log(opacity / ALPHA_CUT) + 1e-5).sqrt() * 1.00001
    angle, near = 2 * math.pi * rand(count), reach * (1 - torch.exp(-12 * rand(count)))
    dy = near * torch.sin(angle) / u22
    dx = (near * torch.cos(angle) - u12 * dy) / u11
    place = torch.floor(rand(count, 2) * (2 if corner else torch.tensor([8, 4])))
    corners = torch.floor(rand(count, 2) * 16) * torch.tensor([8, 4])
    pixel = corners + place * (torch.tensor([7, 3]) if corner else 1) + 0.5
    columns = [pixel[:, 0] - dx, pixel[:, 1] - dy, u11, u12, u22, opacity]
    records = torch.stack([*columns, *[opacity] * 4, reach * xx.sqrt(), reach * yy.sqrt()], 1)
    return records.float(), corners.float()


@pytest.mark.cuda
@pytest.mark.parametrize("corner", [False, True], ids=["any pixel", "corners"])
@pytest.mark.parametrize("longest", [5.0, 11.5, 15.5])
def test_no_block_that_draws_is_left_out(longest, corner):
    """No block is left out of Gaussians as round as a pixel or as long as 3 million, at their very edge in float64."""
    records, corners = at_their_edge(200_000, longest, corner)
    mx, my, u11, u12, u22, opacity = (t[:, None, None] for t in records.double().unbind(1)[:6])
    dx = corners[:, 0, None, None].double() + torch.arange(8) + 0.5 - mx
    dy = corners[:, 1, None, None].double() + torch.arange(4)[:, None] + 0.5 - my
    alpha = opacity * torch.exp(-0.5 * ((u11 * dx + u12 * dy) ** 2 + (u22 * dy) ** 2))
    drawn = (alpha.amax((1, 2)) >= ALPHA_CUT).to(CUDA)
    found = torch.empty(len(records), dtype=torch.int32, device=CUDA)
    floats = [t.to(CUDA).view(-1) for t in (records, corners)]
    launch.launch(small_kernels().block, len(records), [*floats, ALPHA_CUT, ints(found)], CUDA)
    assert int(drawn.sum()) > 180_000 and int((drawn & (found == 0)).sum()) == 0


@pytest.mark.cuda
def test_gradients_agree_for_every_chunk(monkeypatch):
    """Lists that are longer than the largest chunk, begun anywhere; images have the same bits, gradients differ by rounding."""
    gaussians = leaves(cloud(3000, torch.float32, CUDA))
    cam = camera(48, 33, None, torch.float32, CUDA)
    with torch.no_grad():
        gaussians.logit_opacities.sub_(4)  # or the first few hide the others
        gaussians.log_scales.add_(1.5)
    found = []
    for chunk in blend_cuda.CHUNKS:
        monkeypatch.setattr(blend_cuda, "chunk_of", lambda tiles, order, chunk=chunk: chunk)
        r = rasterize(gaussians, cam, RasterizeOptions(record=False))
        assert int(r.tile_counts.sum()) > 2 * 256 * 9
        loss = (r.rgb**2).sum() + (0.1 * r.depth).sum()
        found.append((r.rgb.detach(), torch.autograd.grad(loss, list(gaussians.tensors().values()))))
    for image, gradients in found[1:]:
        assert torch.equal(image, found[0][0])
        for own, wanted in zip(gradients, found[0][1]):
            assert float((own - wanted).norm()) <= 1e-5 * float(wanted.norm())


@pytest.mark.cuda
def test_devices_and_streams_without_a_number():
    """The current device is meant; Warp's own work runs on torch's stream, and on no other afterwards."""
    unnumbered = torch.device("cuda")
    assert launch.warp_device(unnumbered) is launch.warp_device(CUDA) and launch.warp_device(torch.device("cpu")).is_cpu
    where = launch.warp_device(CUDA)
    before = where.stream.cuda_stream
    with torch.cuda.stream(torch.cuda.Stream(CUDA)), launch.stream_of(CUDA):
        wanted = torch.cuda.current_stream(CUDA).cuda_stream
        assert where.stream.cuda_stream == wanted == launch.warp_stream(unnumbered).cuda_stream
    assert where.stream.cuda_stream == before != wanted


# CUDA text compiles, also on a machine without a GPU: NVRTC comes with Warp.

ARCHITECTURE = 75
"""Oldest architecture that is compiled for (Turing)."""


def modules() -> dict[str, wp.Module]:
    """Modules of all kernels that a fit launches on CUDA, and of those that only the public op launches."""
    kernels = [k for k, _ in fit_kernels(True)]
    kernels += [k for size in (8, 16) for k in vars(walk.make_native(size)).values()]
    variants = list(itertools.product(("stored", "activated", "covariances"), (True, False)))  # parameters, antialiased
    for variant in [*variants, ("stored", False, 25)]:
        both = project_cuda.make_forward, project_cuda.make_backward
        kernels += [make(real, "pinhole", *variant) for make in both for real in (wp.float32, wp.float64)]
    for channels in blend.WIDTHS:
        kernels += [blend_cuda.make_forward(8, save, per, channels) for save in (True, False) for per in (1, 2)]
        for depth, absgrad in itertools.product((True, False), repeat=2):
            made = blend_cuda.make_backward(8, depth, 64, True, channels, absgrad)
            kernels += [made.backward, made.gather]
    for model in CAMERA_MODELS.names():
        kernels += [project_cuda.make_forward(wp.float32, model), project_cuda.make_backward(wp.float32, model)]
    return {k.module.name: k.module for k in kernels}


def test_a_fit_compiles_no_module_and_no_header_twice():
    """A module is compiled for each size of blocks, and Warp's headers for each set of compiler flags."""
    kernels = {cuda: fit_kernels(cuda) for cuda in (True, False)}
    flags = set()
    for kernel, block in kernels[False]:
        native.module_name(kernel.module, block)
        flags.add(kernel.module.options["cpu_compiler_flags"])
    assert flags == {options["cpu_compiler_flags"] for options in (native.EXACT, native.ROLLED)}
    for jobs in kernels.values():
        blocks = {(kernel.module.name, block) for kernel, block in jobs}
        assert len({name for name, _ in blocks}) == len(blocks) == len(jobs) > 20


@pytest.mark.slow
def test_cuda_text_compiles(tmp_path):
    wp.init()
    if wp.get_cuda_supported_archs() == []:
        pytest.skip("this build of Warp has no NVRTC")
    found = modules()
    assert len(found) > 20
    for module in found.values():
        wp.compile_aot_module(module, arch=ARCHITECTURE, use_ptx=True, module_dir=str(tmp_path))
