"""Projection of 3D Gaussians written from the paper (Kerbl et al. 2023, section 4), dense, in any float type, by matrices."""

import torch

from tests.reference.sh import colors_reference


def product(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Matrix product of ``a`` [..., I, J] and ``b`` [..., J, K], summed in order: a library would pick one by the processor."""
    total = a[..., :, 0, None] * b[..., None, 0, :]
    for j in range(1, a.shape[-1]):
        total = total + a[..., :, j, None] * b[..., None, j, :]
    return total


def rotations(quats: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [N, 3, 3] of quaternions wxyz [N, 4] of any length."""
    q = quats / quats.norm(dim=-1, keepdim=True)
    w, v = q[:, 0], q[:, 1:]
    zero = torch.zeros_like(w)
    skew = torch.stack([zero, -v[:, 2], v[:, 1], v[:, 2], zero, -v[:, 0], -v[:, 1], v[:, 0], zero], -1).view(-1, 3, 3)
    # Rodrigues: R = I + 2 w [v] + 2 [v]^2
    return torch.eye(3, dtype=q.dtype) + 2 * w[:, None, None] * skew + 2 * product(skew, skew)


def project_reference(means, quats, log_scales, logit_opacities, sh, viewmats, Ks, *, width, height, degree, low_pass):
    """Means [C, N, 2], covariances [C, N, 2, 2], colours [C, N, 3], depths [C, N] and opacities [N], none culled."""
    S = torch.diag_embed(torch.exp(log_scales))
    M = product(rotations(quats), S)
    sigma = product(M, M.transpose(1, 2))
    all_means, all_covs, all_colors, all_depths = [], [], [], []
    for view, K in zip(viewmats, Ks):
        W, t = view[:3, :3], view[:3, 3]
        p = product(means, W.T) + t
        z = p[:, 2]
        pixels = torch.stack([K[0, 0] * p[:, 0] / z + K[0, 2], K[1, 1] * p[:, 1] / z + K[1, 2]], -1)
        size = torch.tensor([width, height], dtype=means.dtype)
        at = torch.minimum(torch.maximum(pixels, -0.15 * size), 1.15 * size)
        xy = (at - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]])  # x / z and y / z where the Jacobian is taken
        zero = torch.zeros_like(z)
        J = torch.stack(
            [K[0, 0] / z, zero, -K[0, 0] * xy[:, 0] / z, zero, K[1, 1] / z, -K[1, 1] * xy[:, 1] / z], -1
        ).view(-1, 2, 3)  # fmt: skip
        T = product(J, W)
        cov = product(product(T, sigma), T.transpose(1, 2)) + low_pass * torch.eye(2, dtype=means.dtype)
        center = -product(W.T, t[:, None])[:, 0]
        away = means - center
        dirs = away / away.norm(dim=-1, keepdim=True)
        all_means.append(pixels)
        all_covs.append(cov)
        all_colors.append(torch.clamp_min(colors_reference(sh, dirs, degree) + 0.5, 0))
        all_depths.append(z)
    stack = torch.stack
    return stack(all_means), stack(all_covs), stack(all_colors), stack(all_depths), torch.sigmoid(logit_opacities)
