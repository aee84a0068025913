"""What Warp lets pass and warpgs must not: hidden float32, generated adjoints, writes out of bounds (docs/numerics.md)."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

KERNELS = sorted((Path(__file__).parents[2] / "warpgs/kernels").glob("*.py"))


def is_kernel(decorator: ast.expr) -> bool:
    """Whether a decorator is wp.kernel or a partial of it."""
    call = decorator.func if isinstance(decorator, ast.Call) else decorator
    return ast.unparse(call) in ("wp.kernel", "kernel")


def warp_functions(path: Path) -> list[ast.FunctionDef]:
    """Functions that Warp compiles: its kernels and functions, but not the stubs of native ones."""
    found = []
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.FunctionDef):
            names = [ast.unparse(d.func if isinstance(d, ast.Call) else d) for d in node.decorator_list]
            if any(n in ("wp.func", "wp.kernel", "kernel") for n in names):
                found.append(node)
    return found


def test_no_adjoint_is_generated():
    """Every kernel has enable_backward=False: dynamic loops are not replayed in adjoints that Warp makes itself."""
    count = 0
    for path in KERNELS:
        text = path.read_text("utf-8")
        for f in warp_functions(path):
            for d in f.decorator_list:
                if is_kernel(d):
                    count += 1
                    # options may be shared: then they are spelled where they are made
                    said = ast.unparse(d) if "options" not in ast.unparse(d) else text
                    said = said if ast.unparse(d) != "kernel" else text
                    assert "enable_backward=False" in said or '"enable_backward": False' in said, f"{path.name}: {f.name}"
    assert count >= 25


def bare_floats(function: ast.FunctionDef) -> list[int]:
    """Lines with a float literal that is not wrapped in the kernel's own scalar type."""
    wrapped = set()
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("real", "wp.static", "wp.float64"):
            wrapped |= {id(n) for n in ast.walk(node)}
    own = [n for statement in function.body for n in ast.walk(statement)]
    return [n.lineno for n in own if isinstance(n, ast.Constant) and isinstance(n.value, float) and id(n) not in wrapped]


def test_no_constant_is_hidden_float32():
    """In functions made by scalar type every float is real(...); a bare one would be float32 in float64 kernels too."""
    checked = 0
    for path in KERNELS:
        for maker in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(maker, ast.FunctionDef) and any(a.arg == "real" for a in maker.args.args):
                for f in ast.walk(maker):
                    if isinstance(f, ast.FunctionDef) and any(
                        ast.unparse(d.func if isinstance(d, ast.Call) else d) in ("wp.func", "wp.kernel", "kernel")
                        for d in f.decorator_list
                    ):
                        checked += 1
                        assert not bare_floats(f), f"{path.name}: {f.name}, lines {bare_floats(f)}"
    assert checked >= 50


DEBUG = """
import sys, torch, warp as wp
wp.config.mode = "debug"
from tests.gaussians import camera, cloud, leaves
from warpgs.kernels.update import adam_step
from warpgs.kernels.neighbours import mean_square_distances
from warpgs.kernels.ssim import differences
from warpgs.render.rasterize import RasterizeOptions, rasterize
device = torch.device(sys.argv[1])
g, cam = leaves(cloud(300, device=device)), camera(45, 37, cameras=2, dtype=torch.float32, device=device)
for tile_size in (8, 16):
    r = rasterize(g, cam, RasterizeOptions(tile_size=tile_size, contributions=True))
    (r.rgb.sum() + (r.alpha * r.depth).sum()).backward()
image, target = torch.rand(2, 37, 45, 3, device=device)
image.requires_grad_()
differences(image, target).sum().backward()
p = torch.rand(700, 3, device=device)
adam_step(p, torch.rand_like(p), torch.zeros_like(p), torch.zeros_like(p), lr=0.1, step=1)
mean_square_distances(p)
if device.type == "cuda":
    torch.cuda.synchronize()
print("checked")
"""


@pytest.mark.slow
def test_no_access_out_of_bounds(tmp_path):
    """All ops once with Warp's bounds checks, which end the process; on a CPU: unoptimised kernels of 1024 threads want more
    registers than a multiprocessor has, and compute-sanitizer looks after them. The check of written numbers does not apply:
    it also stops at what entries held before they were written, and at quotients that a branch-free kernel does not select.
    """
    done = subprocess.run(
        [sys.executable, "-c", DEBUG, "cpu"], capture_output=True, text=True, check=False,
        env={**os.environ, "WARP_CACHE_PATH": str(tmp_path)},
    )  # fmt: skip
    assert done.returncode == 0 and done.stdout.split()[-1] == "checked", (done.stdout + done.stderr)[-2000:]
