"""Kernels touch no memory but what they were given: all that torch allocates stands between fences."""

import functools
import subprocess
import sys

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from bench.lib.kernel_calls import adam_step, bin_tiles, blend, contributions, median_depth, project
from tests.gaussians import camera, cloud, leaves
from warpgs.constants import RULES
from warpgs.kernels.ssim import differences, ssim
from warpgs.kernels.tiles import InstanceMemory

GUARD = 64
"""Entries before and behind each tensor; a multiple of 16 bytes."""


class Guarded(TorchDispatchMode):
    """While entered, new tensors lie between fences of NaN or of one whole number, and so does what they begin with."""

    def __init__(self, whole: int):
        super().__init__()
        self.whole, self.kept = whole, []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        fresh = isinstance(result, torch.Tensor) and any(word in function.__name__ for word in ("empty", "zeros", "clone"))
        if not fresh or not result.is_contiguous() or result.dtype == torch.bool:
            return result
        mark = torch.nan if result.is_floating_point() else self.whole
        memory = torch.full((result.numel() + 2 * GUARD,), mark, dtype=result.dtype, device=result.device)
        inner = memory[GUARD : GUARD + result.numel()].view(result.shape)
        if "empty" not in function.__name__:
            inner.copy_(result)
        self.kept.append(memory)
        return inner

    def intact(self) -> bool:
        ends = [end for memory in self.kept for end in (memory[:GUARD], memory[-GUARD:])]
        return all(bool((end.isnan() if end.is_floating_point() else end == self.whole).all()) for end in ends)


def rendering(device, cameras, deterministic=True, degree=1):
    g = leaves(cloud(60, device=device, degree=degree))
    cam = camera(200, 30, cameras=cameras, dtype=torch.float32, device=device)
    size, side = {"width": 200, "height": 30, "rule": RULES["exact"]}, {"tile_size": 8}
    with torch.no_grad():
        g.log_scales[::4] += 2.0  # more tiles than a thread lists or sums alone
    views, Ks = cam.viewmat.clone().requires_grad_(), cam.K.clone().requires_grad_()
    projected, counts = project(*g.tensors().values(), views, Ks, degree=degree, **size, **side)
    made = bin_tiles(projected, counts, **size, **side)
    memory = InstanceMemory(capacity=len(made.slots) + 5, overflow=torch.zeros(1, dtype=torch.int32, device=device))
    spare = bin_tiles(projected, counts, **size, **side, memory=memory)
    images = blend(projected, made, torch.ones(cameras, 3, device=device), **size, deterministic=deterministic)
    inputs = [projected, *g.tensors().values(), views, Ks]
    of_all = torch.autograd.grad(sum((t * t).sum() for t in images), inputs, retain_graph=True)
    of_rgb = torch.autograd.grad(images[0].sum(), inputs)
    count = len(made.slots)
    lists = [made.ranges, made.gaussian_ids, made.slots, spare.ranges, spare.gaussian_ids[:count]]
    fractions, median = contributions(projected, made, **size), median_depth(projected, made, **size)
    return [projected, counts, *lists, *images, *fractions, median, *of_all, *of_rgb]


def similarity(device, cameras):
    generator = torch.Generator().manual_seed(0)
    found = []
    for height, width in ((33, 47), (8, 11), (16, 16)):
        a, b = torch.rand(2, cameras, height, width, 3, generator=generator).to(device).clone().unbind()
        a, b = a.clone().requires_grad_(), b.clone()
        for result in (ssim(a, b), differences(a, b)):
            found += [result, *torch.autograd.grad(result.square().sum(), a)]
    return found


def steps(device, number):
    """Return the results of Adam on sets that fill neither a block nor a piece of four."""
    found = []
    for count, degree in ((129, 2), (2, 0), (128, 1), (63, 3)):
        sh = torch.rand(count, (degree + 1) ** 2, 3, generator=torch.Generator().manual_seed(degree)).to(device)
        tensors = [sh.clone(), sh + 1, sh * 0.1, sh * 0.01]
        adam_step(*tensors, lr=0.1, step=1, head=3, head_lr=0.2)
        found += tensors
    return found


@pytest.mark.parametrize("whole", [2**30, -(2**30)])
@pytest.mark.parametrize("number", [1, 2])
@pytest.mark.parametrize(
    ("work", "guarded"), [(rendering, 20), (functools.partial(rendering, degree=4), 20), (similarity, 20), (steps, 4)]
)
def test_nothing_beside_a_tensor_is_written_or_used(device, work, guarded, number, whole):
    wanted = work(device, number)
    with Guarded(whole) as guards:
        found = work(device, number)
    assert len(guards.kept) >= guarded and guards.intact()
    for i, (a, b) in enumerate(zip(found, wanted, strict=True)):
        assert torch.equal(a, b), i


LAST = """
import ctypes, mmap, torch
from bench.lib.kernel_calls import bin_tiles, blend, project
from tests.gaussians import camera, cloud, leaves
from warpgs.constants import RULES

PAGE, size, side = mmap.PAGESIZE, {"width": 12, "height": 12, "rule": RULES["exact"]}, {"tile_size": 8}
block = mmap.mmap(-1, 2 * PAGE)
start = ctypes.addressof(ctypes.c_char.from_buffer(block))
assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(start + PAGE), ctypes.c_size_t(PAGE), 0) == 0
g, cam = leaves(cloud(60)), camera(12, 12, cameras=1, dtype=torch.float32)
projected, counts = project(*g.tensors().values(), cam.viewmat, cam.K, degree=1, **size, **side)
rgb = blend(projected, bin_tiles(projected, counts, **size, **side), torch.ones(1, 3), **size)[0]
upstream = torch.frombuffer(block, dtype=torch.float32, count=rgb.numel(), offset=PAGE - 4 * rgb.numel()).view_as(rgb)
upstream.fill_(1.0)
print(bool(torch.autograd.grad(rgb, projected, upstream)[0].any()))
"""


def test_gradients_are_not_read_beyond_the_last_pixel():
    """Behind the image's gradient lies a page that nobody may read; the last tile reaches over both edges of the image."""
    found = subprocess.run([sys.executable, "-c", LAST], check=False, capture_output=True, text=True)
    assert found.stdout.endswith("True\n") and found.returncode == 0, (found.returncode, found.stderr)


@pytest.mark.cuda
@pytest.mark.parametrize("whole", [2**30, -(2**30)])
def test_sums_in_no_order_keep_to_their_rows(whole):
    """The backward pass without slots keeps to its memory too; its sums differ in order."""
    device = torch.device("cuda", 0)
    wanted = rendering(device, 2, deterministic=False)
    with Guarded(whole) as guards:
        found = rendering(device, 2, deterministic=False)
    assert guards.intact()
    for a, b in zip(found, wanted, strict=True):
        assert float((a.double() - b).norm()) <= 1e-4 * float(b.double().norm())
