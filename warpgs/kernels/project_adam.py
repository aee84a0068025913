"""The backward pass of `project` and Adam in one kernel: gradients of the parameters are never in memory.

It leaves what `project`'s backward pass and then Adam would: on CUDA in float32 the same kernels' functions in the same order.
"""

import functools
from collections.abc import Mapping

import torch
import warp as wp

from warpgs.constants import Rule
from warpgs.kernels import adam, sh
from warpgs.kernels.functions import make_projection
from warpgs.kernels.native import BLOCK, source
from warpgs.kernels.native import make_functions as make_native
from warpgs.kernels.project_backward import make_functions
from warpgs.runtime import interop

PATTERNS = {"means": "N 3", "quats": "N 4", "log_scales": "N 3", "logit_opacities": "N", "sh": "N K 3"}
"""The five tensors in the order of their rates."""
HEAD = 3
"""Numbers of a row of harmonics that have a rate of their own: the constant coefficient."""


@functools.cache
def _make_native():
    """The update of a block's rows, for CUDA in float32."""
    vec16 = wp.types.vector(16, wp.float32)

    @wp.func_native(source("project_adam.cu", BLOCK=BLOCK).replace("ELEMENT", adam.ELEMENT))
    def update_rows(
        item: int, n: int, seen: int, v_mean: wp.vec3, v_quat: wp.vec4, v_log_scale: wp.vec3, v_logit: float,
        v_color: wp.vec3, basis: vec16, count: int, head: int, share: wp.array(dtype=float), rates: wp.array(dtype=float),
        beta1: float, beta2: float, rest1: float, rest2: float, eps: float,
        means: wp.array2d(dtype=float), mean_means: wp.array2d(dtype=float), mean_squares: wp.array2d(dtype=float),
        quats: wp.array2d(dtype=float), quat_means: wp.array2d(dtype=float), quat_squares: wp.array2d(dtype=float),
        log_scales: wp.array2d(dtype=float), scale_means: wp.array2d(dtype=float), scale_squares: wp.array2d(dtype=float),
        logits: wp.array2d(dtype=float), logit_means: wp.array2d(dtype=float), logit_squares: wp.array2d(dtype=float),
        sh: wp.array2d(dtype=float), sh_means: wp.array2d(dtype=float), sh_squares: wp.array2d(dtype=float),
    ):  # fmt: skip
        """Adam over all rows of the block's items, of which the caller has the gradient of row ``n`` (-1 for none).

        ``seen`` says whether some thread of the block has that of row ``item``. All BLOCK threads must call it.
        """
        ...

    return update_rows


@functools.cache
def make_kernel(real, native: bool):
    """The kernel for one scalar type: one thread per Gaussian; ``native`` for CUDA and float32."""
    m = make_projection(real)
    f = make_functions(real)
    harmonics = sh.make_functions(real)
    element = adam.make_functions(real)
    vec3 = m.vec3
    vec4 = m.vec4
    vec16 = harmonics.vec16
    compact = make_native().compact if native else None
    color_weights = make_native().color_weights if native else None
    update_rows = _make_native() if native else None

    @wp.func
    def move(
        n: int, i: int, g: real, tensor: int, head: int, rates: wp.array(dtype=real),
        beta1: real, beta2: real, rest1: real, rest2: real, eps: real,
        parameter: wp.array2d(dtype=real), mean: wp.array2d(dtype=real), square: wp.array2d(dtype=real),
    ):  # fmt: skip
        """Update number i of row n of a tensor."""
        rate = wp.where(i < head, rates[3 * tensor], rates[3 * tensor + 1])
        mean[n, i] = element.decayed(mean[n, i], g, beta1, rest1)
        square[n, i] = element.decayed_square(square[n, i], g, beta2, rest2)
        parameter[n, i] = element.moved(parameter[n, i], mean[n, i], square[n, i], rate, rates[3 * tensor + 2], eps)

    # four blocks to a multiprocessor
    registers = {"cuda_max_registers": 128} if native else {}

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.project.adam.{real.__name__}.{int(native)}", **registers)
    def update(
        begin: int, viewmats: wp.array(dtype=m.mat44), Ks: wp.array(dtype=m.mat33),
        width: int, height: int, sh_count: int, near: real, low_pass: real,
        splats: wp.array2d(dtype=real), tile_counts: wp.array(dtype=int), v_splats: wp.array2d(dtype=real),
        share: wp.array(dtype=real), rates: wp.array(dtype=real), skip: wp.array(dtype=int),
        beta1: real, beta2: real, rest1: real, rest2: real, eps: real,
        # outputs
        means: wp.array2d(dtype=real), mean_means: wp.array2d(dtype=real), mean_squares: wp.array2d(dtype=real),
        quats: wp.array2d(dtype=real), quat_means: wp.array2d(dtype=real), quat_squares: wp.array2d(dtype=real),
        log_scales: wp.array2d(dtype=real), scale_means: wp.array2d(dtype=real), scale_squares: wp.array2d(dtype=real),
        logits: wp.array2d(dtype=real), logit_means: wp.array2d(dtype=real), logit_squares: wp.array2d(dtype=real),
        coefficients: wp.array2d(dtype=real), sh_means: wp.array2d(dtype=real), sh_squares: wp.array2d(dtype=real),
    ):  # fmt: skip
        if skip[0] != 0:
            return
        item = begin + wp.tid()
        seen = int(0)
        if item < means.shape[0]:
            seen = tile_counts[item]
        n = wp.where(seen > 0, item, -1)
        if wp.static(native):
            n = compact(item, seen)
        v_mean = vec3()
        v_quat = vec4()
        v_log_scale = vec3()
        v_logit = real(0.0)
        v_color = vec3()
        basis = vec16()
        if n >= 0:
            view = viewmats[0]
            mean = vec3(means[n, 0], means[n, 1], means[n, 2])
            quat = vec4(quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3])
            log_scale = vec3(log_scales[n, 0], log_scales[n, 1], log_scales[n, 2])
            g = f.shape(mean, quat, log_scale, view, Ks[0], real(width), real(height), near, low_pass, v_splats, n)
            v_quat = g.quat
            v_log_scale = g.log_scale
            v_logit = f.logit(splats, v_splats, n, logits[n, 0])
            d = m.direction(mean, view)
            basis = harmonics.basis(vec3(d[0], d[1], d[2]))
            v_color = f.color(splats, v_splats, n)
            w = vec16()
            if wp.static(native):
                w = color_weights(coefficients, n, sh_count, v_color)
            else:
                for k in range(16):
                    if k < sh_count:
                        for channel in range(3):
                            w[k] += coefficients[n, 3 * k + channel] * v_color[channel]
            v_mean = g.mean + f.centered(d, w)
        if wp.static(native):
            update_rows(
                item, n, seen, v_mean, v_quat, v_log_scale, v_logit, v_color, basis, sh_count, wp.static(HEAD), share, rates,
                beta1, beta2, rest1, rest2, eps, means, mean_means, mean_squares, quats, quat_means, quat_squares,
                log_scales, scale_means, scale_squares, logits, logit_means, logit_squares, coefficients, sh_means, sh_squares,
            )  # fmt: skip
        else:
            for i in range(3):
                before = means[item, i]
                move(item, i, v_mean[i], 0, 0, rates, beta1, beta2, rest1, rest2, eps, means, mean_means, mean_squares)
                if share.shape[0] > 0:
                    if share[item] != real(1.0):
                        means[item, i] = before + share[item] * (means[item, i] - before)
                move(
                    item, i, v_log_scale[i], 2, 0, rates, beta1, beta2, rest1, rest2, eps,
                    log_scales, scale_means, scale_squares,
                )  # fmt: skip
            for i in range(4):
                move(item, i, v_quat[i], 1, 0, rates, beta1, beta2, rest1, rest2, eps, quats, quat_means, quat_squares)
            move(item, 0, v_logit, 3, 0, rates, beta1, beta2, rest1, rest2, eps, logits, logit_means, logit_squares)
            for i in range(coefficients.shape[1]):
                v = real(0.0)
                if i < 3 * sh_count:
                    v = basis[i // 3] * v_color[i % 3]
                move(
                    item, i, v, 4, wp.static(HEAD), rates, beta1, beta2, rest1, rest2, eps,
                    coefficients, sh_means, sh_squares,
                )  # fmt: skip

    return update


def project_adam(
    params: Mapping[str, torch.Tensor], exp_avgs: Mapping[str, torch.Tensor], exp_avg_sqs: Mapping[str, torch.Tensor],
    viewmats: torch.Tensor, Ks: torch.Tensor, splats: torch.Tensor, tile_counts: torch.Tensor, v_splats: torch.Tensor,
    *, width: int, height: int, degree: int, rule: Rule, rates: torch.Tensor, skip: torch.Tensor,
    share: torch.Tensor | None = None, betas: tuple[float, float] = adam.BETAS, eps: float = adam.EPS,
) -> None:  # fmt: skip
    """One step of Adam (`adam_step`) on all five tensors by the gradients that `project`'s backward pass gives for one camera.

    A Gaussian that the camera does not see has a zero gradient; its moments decay and move it.

    Args:
        params: The tensors that `project` took, by the names of ``PATTERNS``, contiguous; updated in place.
        exp_avgs: Running means of their gradients, by the same names, contiguous; updated in place.
        exp_avg_sqs: Running means of the squares, likewise.
        viewmats: camera_from_world, shape [1, 4, 4].
        Ks: Intrinsics [px], shape [1, 3, 3].
        splats: Records that `project` gave, shape [1, N, 12].
        tile_counts: Tile counts that it gave, int32, shape [1, N].
        v_splats: Gradient of the records, shape [1, N, 12].
        width: Image width [px].
        height: Image height [px].
        degree: Spherical-harmonics degree used, 0 to 3.
        rule: Cut-offs.
        rates: Three numbers of `scheduled_rates` for each tensor, in order, shape [15]; the head of a row of ``sh`` is its
            constant coefficient.
        skip: Nothing changes where this is not 0, int32, shape [1].
        share: Part of its step that each mean takes, shape [N]; None for all of it.
        betas: Decay of the two running means.
        eps: Added to the root.

    Raises:
        TypeError: A scalar type is neither float32 nor float64, or they differ.
        ValueError: A shape or device disagrees, or a tensor to be updated is not contiguous.
    """
    groups = {"params": params, "exp_avgs": exp_avgs, "exp_avg_sqs": exp_avg_sqs}
    named = {f"{name} of {group}": (tensors[name], p) for name, p in PATTERNS.items() for group, tensors in groups.items()}
    shared = {} if share is None else {"share": (share, "N")}
    sizes = interop.check(
        **named, viewmats=(viewmats, "1 4 4"), Ks=(Ks, "1 3 3"), splats=(splats, "1 N 12"), v_splats=(v_splats, "1 N 12"),
        rates=(rates, "15"), **shared,
    )  # fmt: skip
    count, sh_count = sizes["N"], sh.coefficient_count(degree)
    if sizes["K"] < sh_count:
        raise ValueError(f"sh holds {sizes['K']} coefficients a channel, degree {degree} needs {sh_count}")
    if tuple(tile_counts.shape) != (1, count):
        raise ValueError(f"tile_counts must have shape [1, {count}], not {list(tile_counts.shape)}")
    for name, (tensor, _) in named.items():
        if not tensor.is_contiguous():
            raise ValueError(f"{name} is updated in place and must be contiguous")
    if count == 0:
        return
    real, device = interop.real_of(splats), splats.device
    native = device.type == "cuda" and real is wp.float32
    m = make_projection(real)
    record = splats.shape[-1]
    inputs = [
        interop.view(viewmats.contiguous(), m.mat44), interop.view(Ks.contiguous(), m.mat33), width, height, sh_count,
        rule.near, rule.low_pass, interop.view(splats.detach().contiguous().view(-1, record), real),
        interop.view(tile_counts.contiguous().view(-1), wp.int32), interop.view(v_splats.contiguous().view(-1, record), real),
        interop.view(splats.new_empty(0) if share is None else share.contiguous(), real), interop.view(rates.contiguous(), real),
        interop.view(skip, wp.int32), *betas, 1 - betas[0], 1 - betas[1], eps,
        *(interop.view(t.detach().view(count, -1), real) for t, _ in named.values()),
    ]  # fmt: skip
    threads = -(-count // BLOCK) * BLOCK if native else count
    interop.launch(make_kernel(real, native), threads, inputs, device, cost=100, block_dim=BLOCK)
