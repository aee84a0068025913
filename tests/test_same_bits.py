"""The same bits on another processor: libraries take the code that they have for it, and a fit must not show it."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from bench.lib import result_file, same_bits
from tests.example_terms import DepthCorrelation, NormalSmoothness
from tests.gaussians import camera
from warpgs import geometry
from warpgs.io.folder import rigid
from warpgs.kernels.launch import set_threads
from warpgs.pipeline.train.loss import LossInputs, Target, photometric_loss

ROOT = Path(__file__).parent.parent
X86_64 = pytest.mark.skipif(platform.machine() != "x86_64", reason="chooses between code for processors of this kind")
OTHER_MAKER = {"MKL_CBWR": "COMPATIBLE", "OPENBLAS_CORETYPE": "Zen", "OPENCV_IPP": "disabled"}
"""Variables by which libraries take the code that they have for processors of another maker."""


def run(out: Path, *flags: str, **environment: str) -> dict:
    command = [sys.executable, "-m", "bench.fits.same_bits", "--out", str(out), "--size", "64", "48", "--steps", "12", *flags]
    subprocess.run(command, cwd=ROOT, env=os.environ | environment, check=True, capture_output=True)
    return result_file.read(out)["rows"][-1]


def fit_differs(a: dict, b: dict) -> list[str]:
    return [n for n in same_bits.differing(a, b) if not n.startswith(same_bits.LIBRARIES)]


@X86_64
def test_libraries_for_other_processors_give_the_same_start(tmp_path):
    """Photographs, cameras, matches, saliency and swept depths up to the first Gaussians, with the code for another maker."""
    size = {"views": 8, "width": 64, "height": 48, "steps": 12}
    own = {"stages": dict(same_bits.stages(torch.device("cpu"), **size, only_start=True))}
    other = run(tmp_path / "other.json", "--starts", "--threads", "1", **OTHER_MAKER)
    assert len(own["stages"]) > 45 and not any("step" in n for n in own["stages"])
    assert same_bits.differing(own, other)  # else the variables chose nothing; what they change depends on the processor
    assert fit_differs(own, other) == []


@X86_64
@pytest.mark.slow
def test_libraries_for_other_processors_and_other_thread_counts_give_the_same_fit(tmp_path):
    """All stages of the fits, without AVX-512 on 16 threads, and with the code that MKL has for other makers on one."""
    own = run(tmp_path / "own.json")
    older = run(tmp_path / "older.json", "--avx2", "--threads", "16")
    other = run(tmp_path / "other.json", "--threads", "1", **OTHER_MAKER)
    assert len(own["stages"]) >= 90 and own["stages"]["3dgs: first PLY"] != own["stages"]["3dgs: last PLY"]
    for made in (older, other):
        assert fit_differs(made, own) == []


def test_losses_do_not_depend_on_the_number_of_threads():
    """Values and gradients over more pixels than torch sums on one thread, with a mask and of the terms of `examples/`."""
    random = torch.Generator().manual_seed(0)
    rgb, target = (torch.rand(230, 240, 3, generator=random) for _ in range(2))
    depth, disparity, mask = (torch.rand(230, 240, generator=random) + 0.5 for _ in range(3))
    mask, alpha = (mask > 0.6).float(), torch.ones(230, 240)
    cam, one = camera(240, 230, dtype=torch.float32), torch.ones(())
    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2, 5):
            set_threads(threads)
            image, z = rgb.clone().requires_grad_(), depth.clone().requires_grad_()
            losses = [photometric_loss(image, target, m, w) for m, w in ((mask, 0.2), (mask, 0.0), (None, 0.2), (None, 0.0))]
            inputs = LossInputs(
                {"alpha": alpha, "depth": z}, Target(target, mask, {"disparity": disparity}, {}), None, cam, one
            )
            losses += [DepthCorrelation()(inputs), NormalSmoothness()(inputs)]
            found.append(same_bits.digest(*losses, *torch.autograd.grad(sum(losses), [image, z])))
    finally:
        set_threads(before)
    assert len(set(found)) == 1


def row(label: str, stages: dict, device: str = "cpu", **more) -> dict:
    machine = {"device": device, "name": "P", "threads": 2}
    return {"label": label, "machine": machine, "versions": {"torch": "2"}, "arguments": {}, "stages": stages} | more


def test_the_table_names_the_first_stage_that_differs():
    """Functions of libraries apart from stages, which are compared with the first run on that kind of device."""
    stages = {"torch.exp": "1", "decoded images": "2", "3dgs: last PLY": "2", "quick: last PLY": "2"}
    changed = stages | {"torch.exp": "0", "3dgs: last PLY": "0", "quick: last PLY": "0"}
    rows = [row("x", stages), row("x", changed, "cuda"), row("y", changed)]
    lines = same_bits.table(rows).splitlines()[2:]
    assert [line.split(" | ")[-2:] for line in lines[:2]] == [["0", "none |"]] * 2
    assert lines[2].endswith("| 1 | 3dgs: last PLY |")
    # one of another label, kind of device or size of the scene is added
    rows = [row("x", {"a": "0"}), row("y", {"a": "0"})]
    assert same_bits.placed(rows, row("x", {"a": "1"})) == [row("x", {"a": "1"}), rows[1]]
    for other in (row("z", {}), row("x", {}, "cuda"), row("x", {}, arguments={"views": 2})):
        assert same_bits.placed(rows, other) == [*rows, other]


def test_small_matrices_agree_with_lapack():
    """Inverse, nearest rotation and products, which are written out so that no BLAS has a say, to float64's rounding."""
    random = np.random.default_rng(0)
    for _ in range(20):
        m = random.normal(size=(3, 3))
        assert np.allclose(geometry.inverse(m) @ m, np.eye(3), atol=1e-12 * np.linalg.cond(m))
        points = random.normal(size=(7, 3))
        assert np.allclose(geometry.matmul(points, m), points @ m, rtol=0, atol=1e-14)
        assert np.allclose(geometry.matmul(points, m[0]), points @ m[0], rtol=0, atol=1e-14)
        q, _ = np.linalg.qr(m)
        bent = np.eye(4)
        bent[:3, :3] = q * np.sign(np.linalg.det(q)) + 1e-4 * random.normal(size=(3, 3))
        u, _, vt = np.linalg.svd(bent[:3, :3])
        assert np.allclose(rigid(bent, "here")[:3, :3], u @ vt, rtol=0, atol=1e-14)
