"""CUDA text compiles, also on a machine without a GPU: NVRTC comes with Warp."""

import itertools

import pytest
import warp as wp

from warpgs.kernels import blend, blend_cuda, project_cuda, walk
from warpgs.kernels.cameras import CAMERA_MODELS
from warpgs.pipeline.run.precompile import fit_kernels

ARCHITECTURE = 75
"""Oldest architecture that is compiled for (Turing)."""


def modules() -> dict[str, wp.Module]:
    """Modules of all kernels that a fit launches on CUDA, and of those that only the public op launches."""
    kernels = [k for k, _ in fit_kernels(True)]
    kernels += [make(size) for make in (walk.make_median_native, walk.make_heaviest_native) for size in (8, 16)]
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


@pytest.mark.slow
def test_cuda_text_compiles(tmp_path):
    """Each module, to PTX."""
    wp.init()
    if wp.get_cuda_supported_archs() == []:
        pytest.skip("this build of Warp has no NVRTC")
    found = modules()
    assert len(found) > 20
    for module in found.values():
        wp.compile_aot_module(module, arch=ARCHITECTURE, use_ptx=True, module_dir=str(tmp_path))
