"""The same bits every time: all ops, with any number of threads and on any stream; and what Warp allows and warpgs does not."""

import ast
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from bench.lib.kernel_calls import adam_step
from tests.gaussians import camera, cloud
from warpgs.kernels.neighbours import mean_square_distances
from warpgs.kernels.ssim import differences, ssim
from warpgs.kernels.tsdf import integrate
from warpgs.kernels.update import squared_error
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

REPEATS = 50


def all_bits(gaussians, cam, deterministic=True) -> list[torch.Tensor]:
    leaves = {n: t.detach().requires_grad_() for n, t in gaussians.tensors().items()}
    r = rasterize(Gaussians(**leaves), cam, RasterizeOptions(deterministic=deterministic, record=False))
    loss = r.rgb.square().sum() + (r.alpha * r.depth).sum()
    return [t.detach() for t in (r.rgb, r.alpha, r.depth)] + list(torch.autograd.grad(loss, list(leaves.values())))


def other_bits(device) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 130, 150, 3, generator=generator).to(device)
    points = torch.randn(3000, 3, generator=generator).to(device)
    leaf = image.clone().requires_grad_()
    sums = differences(leaf, target)
    sums.sum().backward()
    param, mean, square = target.clone(), torch.zeros_like(target), torch.zeros_like(target)
    adam_step(param, image, mean, square, lr=0.1, step=1)
    distances, weights = torch.zeros(2, 40, 40, 40, device=device)
    view = Camera(np.eye(4), np.array([[150.0, 0, 75], [0, 150, 65], [0, 0, 1]]), 150, 130)
    integrate(distances, weights, (-1.0, -1.0, 2.0), 0.05, 0.2, view, 3 + image[..., 0], target[..., 0].contiguous())
    assert bool(weights.any())
    found = [sums, leaf.grad, ssim(image, target), mean_square_distances(points), param, squared_error(image, target)]
    return [t.detach() for t in (*found, distances)]


def test_50_repeats_give_the_same_bits(device):
    """All ops, fifty times with 1 to 8 threads, while other work keeps the machine busy."""
    gaussians, cam = cloud(1500, device=device), camera(72, 50, cameras=2, dtype=torch.float32, device=device)
    torch.set_num_threads(1)
    first, others = all_bits(gaussians, cam), other_bits(device)
    assert all(bool(t.any()) for t in first)
    over = threading.Event()

    def disturb() -> None:
        while not over.is_set():
            torch.rand(200, 200) @ torch.rand(200, 200)

    with ThreadPoolExecutor(1) as pool:
        load = pool.submit(disturb)
        try:
            for i in range(REPEATS):
                torch.set_num_threads((2, 3, 5, 8, 1)[i % 5])
                assert all(torch.equal(a, b) for a, b in zip(first, all_bits(gaussians, cam), strict=True)), i
                assert i >= 10 or all(torch.equal(a, b) for a, b in zip(others, other_bits(device), strict=True)), i
        finally:
            over.set()
        load.result()


@pytest.mark.cuda
def test_a_side_stream_gives_the_same_bits():
    """Kernels, sorts and scans follow torch's current stream, with other work on the default one."""
    device = torch.device("cuda", 0)
    gaussians, cam = cloud(20_000, device=device), camera(640, 480, dtype=torch.float32, device=device)
    first = all_bits(gaussians, cam)
    stream = torch.cuda.Stream()
    noise = torch.rand(4000, 4000, device=device)
    for _ in range(10):
        noise = (noise @ noise).clamp(0, 1)
        stream.wait_stream(torch.cuda.default_stream())
        with torch.cuda.stream(stream):
            again = all_bits(gaussians, cam)
        stream.synchronize()
        assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))


def test_atomic_sums_differ_by_rounding_alone(device):
    """On a CPU there are none: both modes are one. On CUDA their order changes, and with it the last bits of gradients."""
    gaussians, cam = cloud(600, device=device), camera(64, 48, dtype=torch.float32, device=device)
    ordered = all_bits(gaussians, cam)
    for _ in range(4):
        for a, b in zip(all_bits(gaussians, cam, deterministic=False), ordered, strict=True):
            assert (a.double() - b.double()).norm() <= (0.0 if device.type == "cpu" else 1e-4) * b.double().norm()


KERNELS = sorted((Path(__file__).parents[2] / "warpgs/kernels").glob("*.py"))


def warp_functions(tree: ast.AST) -> list[ast.FunctionDef]:
    """Functions that Warp compiles: its kernels and functions, but not the stubs of native ones."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    names = ("wp.func", "wp.kernel", "kernel")
    return [f for f in functions if any(ast.unparse(getattr(d, "func", d)) in names for d in f.decorator_list)]


def bare_floats(function: ast.FunctionDef) -> list[int]:
    """Lines with a float literal that is not wrapped in the kernel's own scalar type."""
    wrapped = set()
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("real", "wp.static", "wp.float64"):
            wrapped |= {id(n) for n in ast.walk(node)}
    own = [n for statement in function.body for n in ast.walk(statement)]
    return [n.lineno for n in own if isinstance(n, ast.Constant) and isinstance(n.value, float) and id(n) not in wrapped]


def test_no_adjoint_is_generated_and_no_constant_is_hidden_float32():
    """Every kernel has enable_backward=False; in functions made by scalar type every float is real(...)."""
    count = 0
    for path in KERNELS:
        text = path.read_text("utf-8")
        for f in warp_functions(ast.parse(text)):
            for d in f.decorator_list:
                if ast.unparse(getattr(d, "func", d)) in ("wp.kernel", "kernel"):
                    count += 1
                    # options may be shared: then they are spelled where they are made
                    said = ast.unparse(d) if "options" not in ast.unparse(d) else text
                    said = said if ast.unparse(d) != "kernel" else text
                    assert "enable_backward=False" in said or '"enable_backward": False' in said, f"{path.name}: {f.name}"
    assert count >= 25
    checked = 0
    for path in KERNELS:
        for maker in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(maker, ast.FunctionDef) and any(a.arg == "real" for a in maker.args.args):
                for f in warp_functions(maker):
                    checked += 1
                    assert not bare_floats(f), f"{path.name}: {f.name}, lines {bare_floats(f)}"
    assert checked >= 50
