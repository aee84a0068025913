"""Projection of 3D Gaussians to ellipses in the image: activations, EWA covariance and its factor, colour, tile counts."""

from collections.abc import Sequence

import torch
import warp as wp

from warpgs.device import BINNING, BLENDING, FLOAT, LOSS, PROJECTION, SAMPLING, Needs, StepSizes
from warpgs.errors import UsageError
from warpgs.kernels import launch, project_cpu, project_cuda
from warpgs.kernels.cameras import CAMERA_MODELS
from warpgs.kernels.ellipse import PROJECTED_SIZE, ProjectInputs
from warpgs.kernels.falloff import Pass
from warpgs.kernels.graphs import TORCH, Allocator
from warpgs.kernels.native import BLOCK
from warpgs.kernels.project_cpu import LANES


def step_bytes(sizes: StepSizes) -> Needs:
    """Return the bytes of projected Gaussians with their tile counts, and of gradients, at each moment of a step."""
    one = FLOAT * PROJECTED_SIZE * sizes.count
    projected = one + FLOAT * sizes.count
    # with chunks, the gradient of one and of all; statistics are computed from the last copy
    sums = 2 * one if sizes.chunked else 0
    return {
        BINNING: projected + sums, LOSS: projected, BLENDING: projected + max(one, sums),
        PROJECTION: projected + 2 * one + sizes.row * sizes.count, SAMPLING: projected,
    }  # fmt: skip


def _threads_each(tensor: torch.Tensor) -> bool:
    """Return whether the kernels of `project_cuda` apply, which take a thread for each Gaussian."""
    return tensor.is_cuda


def project_tensors(inputs: ProjectInputs, settings: Pass, allocator: Allocator = TORCH) -> tuple[torch.Tensor, torch.Tensor]:
    """Return projected Gaussians [C, N, 12] and tile counts [C, N], int32, of contiguous tensors. Nothing is checked."""
    means, real = inputs.means, launch.real_of(inputs.means)
    cameras, count, rule = len(inputs.viewmats), len(means), settings.rule
    projected = allocator.output((cameras, count, PROJECTED_SIZE), means.dtype, means.device)
    tile_counts = allocator.output((cameras, count), torch.int32, means.device)
    arguments = [
        *inputs, *settings.size, *settings.window, settings.tile_size, settings.sh_count,
        rule.near, rule.far, rule.low_pass, rule.alpha_cut, rule.square_sigma, projected, tile_counts,
    ]  # fmt: skip
    if _threads_each(means):
        kernel, cost = project_cuda.make_forward(real, *settings.variant()), 5
        tasks = -(-cameras * count // BLOCK) * BLOCK
    else:
        kernel, tasks, cost = project_cpu.make_forward(real, *settings.variant()), cameras * -(-count // LANES), 5 * LANES
    launch.launch(kernel, tasks, arguments, means.device, cost=cost, block_dim=BLOCK)
    return projected, tile_counts


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, settings, *tensors):
        inputs = ProjectInputs(*(t.contiguous() for t in tensors))
        projected, tile_counts = project_tensors(inputs, settings)
        launch.keep(ctx, *inputs[:-1], projected, tile_counts)
        ctx.settings = settings
        ctx.mark_non_differentiable(tile_counts)
        ctx.set_materialize_grads(False)  # else torch makes zeros for the counts
        return projected, tile_counts

    @staticmethod
    @launch.first_order
    def backward(ctx, v_projected, _):
        *inputs, projected, tile_counts = launch.kept(ctx)
        wants_camera = ctx.needs_input_grad[6] or ctx.needs_input_grad[7]  # viewmats and Ks, behind the settings
        found = project_gradients(inputs, ctx.settings, projected, tile_counts, v_projected, wants_camera=wants_camera)
        return None, *found, None, None


def project_gradients(
    inputs: Sequence[torch.Tensor], settings: Pass, projected: torch.Tensor, tile_counts: torch.Tensor,
    v_projected: torch.Tensor | None, *, wants_camera: bool, allocator: Allocator = TORCH,
) -> list[torch.Tensor | None]:  # fmt: skip
    """Return the gradients of the first seven inputs, those of viewmats and Ks None unless wanted. Nothing is checked."""
    real, device = launch.real_of(projected), projected.device
    rule = settings.rule
    v_projected = torch.zeros_like(projected) if v_projected is None else v_projected.contiguous()
    found = [allocator.output(tensor.shape, tensor.dtype, device) for tensor in inputs[:5]]
    cameras, count = len(inputs[5]), len(inputs[0])
    rows = (cameras, count) if wants_camera else (0, 0)
    v_viewmats, v_Ks = (projected.new_zeros(*rows, n, n) if wants_camera else projected.new_empty(*rows, n, n) for n in (4, 3))
    arguments = [*inputs[:8], *settings.size, settings.sh_count, rule.near, rule.low_pass, projected, tile_counts, v_projected]
    if _threads_each(projected):
        kernel, tasks, cost = project_cuda.make_backward(real, *settings.variant()), -(-count // BLOCK) * BLOCK, 10
        if real is wp.float64:
            found[4].zero_()
        arguments.append(int(wants_camera))
    else:
        kernel = project_cpu.make_backward(real, *settings.variant(), wants_camera)
        tasks, cost = -(-count // LANES), 10 * LANES
    arguments += [*found, v_viewmats, v_Ks]
    launch.launch(kernel, tasks, arguments, device, cost=cost * cameras, block_dim=BLOCK)
    if not wants_camera:
        return [*found, None, None]
    # in float64, so that the float32 result is the same for any number of threads
    return [*found, *(v.sum(1, dtype=torch.float64).to(v.dtype) for v in (v_viewmats, v_Ks))]


def project_inputs(inputs: ProjectInputs, settings: Pass) -> tuple[torch.Tensor, torch.Tensor]:
    """Project Gaussians into C cameras (EWA, first order): return rows [C, N, 12] (`PROJECTED_SIZE`), tile counts [C, N]."""
    # Differentiable in the first seven tensors (docs/project.md). A Gaussian is culled, with results and gradients zero, if its
    # depth is below ``rule.near`` or above ``rule.far``, its opacity is below the cut-off, its box is outside the window, or a
    # parameter that is read is non-finite or outside the ranges of docs/conventions.md.
    if inputs.distortion.requires_grad:
        raise UsageError("gradients of distortion coefficients are not supported: give distortion.detach()")
    model = CAMERA_MODELS.find(settings.camera_model)
    scales, opacities = ("log_scales", "logit_opacities") if settings.parameters == "stored" else ("scales", "opacities")
    sizes = launch.check(
        means=(inputs.means, "N 3"), quats=(inputs.quats, "N 4"),
        **{scales: (inputs.log_scales, "N 3"), opacities: (inputs.logit_opacities, "N")}, sh=(inputs.sh, "N K 3"),
        viewmats=(inputs.viewmats, "C 4 4"), Ks=(inputs.Ks, "C 3 3"),
        distortion=(inputs.distortion, f"C {model.coefficients}"),
    )  # fmt: skip
    if sizes["K"] < settings.sh_count:
        raise ValueError(f"sh has {sizes['K']} coefficients per channel, but the degree needs {settings.sh_count}")
    width, height = settings.size
    if width < 1 or height < 1:
        raise ValueError(f"the image must be at least 1 x 1 px, not {width} x {height}")
    projected, tile_counts = _Project.apply(settings, *inputs)
    return projected, tile_counts
