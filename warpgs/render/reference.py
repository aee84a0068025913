"""Reference image of rule ``exact`` in float64, computed without the kernels: errors are measured against it."""

import torch
from torch import Tensor

from warpgs import geometry
from warpgs.constants import FRUSTUM_MARGIN, RULES
from warpgs.kernels import sh
from warpgs.scene import Camera, Gaussians

BLOCK = 16
"""Side of the blocks of pixels that are composited at a time [px]."""


Ellipses = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
"""The visible Gaussians in the image, from front to back: projected means [N, 2] [px]; half sides [N, 2] [px] of the box that
holds every pixel with alpha at or above the cut-off; factors [N, 3] of dx^2, dx dy and dy^2 in the exponent; opacities [N]; and
colours [N, 3]."""


def _project(gaussians: Gaussians, camera: Camera, degree: int, antialiased: bool) -> Ellipses:
    """Project all Gaussians by the matrices of Kerbl et al. 2023, section 4."""
    rule = RULES["exact"]
    means, quats, log_scales, logits, coefficients = (t.detach().double() for t in gaussians.tensors().values())
    view, K = (torch.as_tensor(t, dtype=torch.float64, device=means.device) for t in (camera.viewmat, camera.K))
    rotation, translation = view[:3, :3], view[:3, 3]
    unit = quats / quats.norm(dim=-1, keepdim=True)
    positions = means @ rotation.T + translation
    opacities = torch.sigmoid(logits)
    depths = geometry.depth_of(camera.model, positions)
    lens = None if camera.distortion is None else torch.as_tensor(camera.distortion, dtype=torch.float64, device=means.device)
    seen = geometry.on_lens(camera.model, lens, positions)
    visible = torch.nonzero(seen & (depths >= rule.near) & (opacities >= rule.alpha_cut)).squeeze(1)
    visible = visible[torch.argsort(depths[visible], stable=True)]
    positions, opacities = positions[visible], opacities[visible]
    pixels, jacobians = _pixels(camera, K, lens, positions)
    axes = jacobians @ rotation @ geometry.rotation_matrices(unit[visible]) @ torch.diag_embed(log_scales[visible].exp())
    covariances = axes @ axes.mT + rule.low_pass * torch.eye(2, dtype=torch.float64, device=means.device)
    if antialiased:
        opacities = opacities * (torch.linalg.det(axes @ axes.mT).clamp_min(0) / torch.linalg.det(covariances)).sqrt()
    inverse = torch.linalg.inv_ex(covariances).inverse
    factors = torch.stack([-0.5 * inverse[:, 0, 0], -inverse[:, 0, 1], -0.5 * inverse[:, 1, 1]], 1)
    away = means[visible] + rotation.T @ translation
    directions, count = away / away.norm(dim=-1, keepdim=True), sh.coefficient_count(degree)
    colors = torch.einsum("nk,nkc->nc", sh.basis(directions)[:, :count], coefficients[visible, :count])
    colors = (colors + 0.5).clamp_min(0)
    reach = torch.sqrt(2 * torch.log(opacities / rule.alpha_cut))[:, None] + 0.01  # slightly beyond alpha = cut
    return pixels, reach * torch.sqrt(torch.diagonal(covariances, dim1=-2, dim2=-1)), factors, opacities, colors


def _pixels(camera: Camera, K: Tensor, lens: Tensor | None, positions: Tensor) -> tuple[Tensor, Tensor]:
    """Return projected positions [px], shape [N, 2], of ``positions`` [N, 3] in camera axes, and the Jacobians [N, 2, 3]."""
    z, focal, center = positions[:, 2:], torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64, device=K.device)

    def clamped(pixels: Tensor) -> Tensor:
        return torch.minimum(torch.maximum(pixels, -FRUSTUM_MARGIN * size), (1 + FRUSTUM_MARGIN) * size)

    if camera.model == "pinhole":
        pixels = focal * positions[:, :2] / z + center
        return pixels, torch.cat([torch.diag_embed(focal / z), ((center - clamped(pixels)) / z)[..., None]], -1)
    pixels = focal * geometry.to_plane(camera.model, lens, positions) + center
    at = positions
    if camera.model == "opencv":  # the point moves towards the axis by the same factor as the pixel
        scale = (clamped(pixels) - center) / torch.where(pixels == center, 1, pixels - center)
        scale = torch.where((clamped(pixels) != pixels) & (scale >= 0) & (scale < 1), scale, 1)
        at = torch.cat([positions[:, :2] * scale, z], 1)
    with torch.enable_grad():
        at = at.detach().requires_grad_()
        found = geometry.to_plane(camera.model, lens, at).sum(0)
        rows = [torch.autograd.grad(found[i], at, retain_graph=True)[0] for i in range(2)]
    return pixels, focal[:, None] * torch.stack(rows, 1)


def _block(g: Ellipses, corner: Tensor, size: tuple[int, int], steps: Tensor, background: Tensor):
    """Return the colours [w * h, 3] of a block of ``size`` w x h, by rows; ``steps`` are offsets of pixel centres."""
    rule, (w, h), (pixels, half, factors, opacities, colors) = RULES["exact"], size, g
    extent = torch.tensor([w, h], dtype=torch.float64, device=corner.device)
    near = torch.nonzero(((pixels + half >= corner) & (pixels - half <= corner + extent)).all(1)).squeeze(1)
    dx, dy = corner[0] + steps[:w] - pixels[near, :1], corner[1] + steps[:h] - pixels[near, 1:]
    A, B, C = factors[near].split(1, 1)
    power = (A * dx * dx)[:, None] + (B * dy)[..., None] * dx[:, None] + (C * dy * dy)[..., None]
    alpha = opacities[near, None] * torch.exp(power.flatten(1))
    alpha = torch.where(alpha >= rule.alpha_cut, alpha.clamp_max(rule.alpha_max), 0.0)
    before = torch.cat([torch.ones_like(alpha[:1]), torch.cumprod(1 - alpha, 0)[:-1]])
    weights = torch.where(before >= rule.transmittance_stop, alpha * before, 0.0)
    return weights.T @ colors[near] + (1 - weights.sum(0))[:, None] * background.double()


@torch.no_grad()
def reference_image(
    gaussians: Gaussians, camera: Camera, window: tuple[int, int, int, int], background: Tensor, degree: int,
    antialiased: bool = False,
) -> Tensor:  # fmt: skip
    """Return the colours [h, w, 3] in a window [px] of one image under rule ``exact``, in float64, not clamped."""
    geometry.check_known(camera.model)
    g, device = _project(gaussians, camera, degree, antialiased), gaussians.means.device
    left, top, width, height = window
    image = torch.empty(height, width, 3, dtype=torch.float64, device=device)
    steps = torch.arange(BLOCK, dtype=torch.float64, device=device) + 0.5
    for v in range(0, height, BLOCK):
        for u in range(0, width, BLOCK):
            w, h = min(BLOCK, width - u), min(BLOCK, height - v)
            corner = torch.tensor([left + u, top + v], dtype=torch.float64, device=device)
            image[v : v + h, u : u + w] = _block(g, corner, (w, h), steps, background).view(h, w, 3)
    return image
