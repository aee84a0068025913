"""Errors of needles with a triangular factor, with an inverse covariance ("conic") and with textbook formulas.

Needles of one length are in the middle of an image at many angles, tilted out of the image plane; their other axes are as wide
as the pixel filter. The reference is computed in float64 from the same float32 parameters. Three programs in float32 are
compared:

* factor: the kernels.
* conic: the kernels' own factor multiplied out to an inverse covariance, so that only the form differs.
* plain: the whole projection by textbook formulas, with determinant a c - b^2 (tests/reference/low_precision.py, P32).

Errors are those of the weight exp(-power / 2) at places along the needle up to two standard deviations; of alpha in an image;
and the relative error of the gradient of the projected mean, for a random gradient of that image (not for conic, which has no
kernel).
"""

from __future__ import annotations

import dataclasses
import math

import torch

from tests.reference.low_precision import Frame, Inputs, ProjectedGaussians, layers, pixel_centers, projected_of
from warpgs.constants import RULES
from warpgs.kernels.project import project
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

LENGTHS = (1, 3, 10, 30, 100, 300, 1000, 3000, 10000)
"""Standard deviations of the long axis [px]."""
SIDE = 256
"""Width and height of the image [px]."""
ANGLES, IMAGES = 400, 24
"""Needles whose weight is sampled, and needles that are drawn."""
FREE = dataclasses.replace(RULES["exact"], name="free", alpha_cut=0.0, transmittance_stop=0.0)
"""No cut-off, so that no pixel is decided by rounding."""
OPACITY = 0.9


def needles(length: float, count: int) -> Inputs:
    """Return needles through the middle of the image (float32 parameters on the CPU), and pose and intrinsics of a camera."""
    focal = 1.2 * SIDE
    generator = torch.Generator().manual_seed(int(length))
    turn = math.pi * (torch.arange(count, dtype=torch.float64) + torch.rand(count, generator=generator)) / count
    tilt = torch.rand(count, generator=generator, dtype=torch.float64) - 0.5
    cz, sz, cy, sy = torch.cos(turn / 2), torch.sin(turn / 2), torch.cos(tilt / 2), torch.sin(tilt / 2)
    # about z after about y
    quats = torch.stack([cz * cy, -sz * sy, cz * sy, sz * cy], 1)
    long = length / focal / torch.cos(tilt)
    thin = torch.full_like(long, 1e-3 / focal)
    means = torch.tensor([0.01, -0.02, 1.0], dtype=torch.float64).expand(count, 3)
    K = torch.tensor([[focal, 0, SIDE / 2 + 0.3], [0, focal, SIDE / 2 - 0.4], [0, 0, 1]])
    logits = torch.full((count,), math.log(OPACITY / (1 - OPACITY)))
    sh = torch.zeros(count, 1, 3)
    return Inputs(
        means.float(), quats.float(), torch.log(torch.stack([long, thin, thin], 1)).float(), logits, sh,
        torch.eye(4), K, torch.zeros(3),
    )  # fmt: skip


def _only(inputs: Inputs, i: int) -> Inputs:
    """Return one of the needles."""
    return Inputs(*(t[i : i + 1] for t in inputs[:5]), *inputs[5:])


def _frame() -> Frame:
    return Frame(SIDE, SIDE, 0, (0, 0, SIDE, SIDE))


def _figures(errors: list[torch.Tensor] | torch.Tensor) -> dict[str, float]:
    flat = torch.stack(list(errors)).flatten().double().cpu()
    return {"max": float(flat.max()), "mean": float(flat.mean())}


def _record(inputs: Inputs, device: torch.device) -> torch.Tensor:
    """Return means [N, 2] and factors [N, 3] as the kernels store them, [N, 5]."""
    there = [t.detach().to(device) for t in inputs]
    projected, _ = project(*there[:5], there[5][None], there[6][None], width=SIDE, height=SIDE, degree=0, rule=FREE)
    return projected[0, :, :5]


def _powers(record: torch.Tensor, dx: torch.Tensor, dy: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the squared Mahalanobis distance in both forms, in the type and on the device of the record; dx, dy [N, P]."""
    u11, u12, u22 = (record[:, k, None] for k in (2, 3, 4))
    e1, e2 = u11 * dx + u12 * dy, u22 * dy
    xx, xy, yy = u11 * u11, u11 * u12, u12 * u12 + u22 * u22
    return {"factor": e1 * e1 + e2 * e2, "conic": xx * dx * dx + 2 * (xy * dx * dy) + yy * dy * dy}


def _plain_power(projected: ProjectedGaussians, dx: torch.Tensor, dy: torch.Tensor) -> torch.Tensor:
    xx, xy, yy = (projected.conics[:, k, None] for k in range(3))
    return xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy


def _weight(power: torch.Tensor) -> torch.Tensor:
    # a negative power is rounding's, and programs skip it
    return torch.where(power >= 0, torch.exp(-0.5 * power), torch.zeros_like(power)).double().cpu()


def weight_errors(length: float, device: torch.device) -> dict[str, dict[str, float]]:
    """Return the error of the weight at 40 places of each of 400 needles."""
    inputs = needles(length, ANGLES)
    exact_projection = projected_of(inputs.to(torch.float64), _frame(), FREE)
    plain = projected_of(inputs.to(torch.float32), _frame(), FREE)
    xx, xy, yy = exact_projection.conics.unbind(1)
    inverse = torch.stack([xx, xy, xy, yy], -1).view(-1, 2, 2)
    strengths, axes = torch.linalg.eigh(inverse.detach())  # the long axis first
    sigmas = strengths.rsqrt()
    along = torch.tensor([-2.0, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 2.0], dtype=torch.float64)
    across = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0], dtype=torch.float64)
    t, s = (g.flatten() for g in torch.meshgrid(along, across, indexing="ij"))
    long, short = ((sigmas[:, k, None] * axes[:, :, k])[:, None] for k in range(2))
    d = t[None, :, None] * long + s[None, :, None] * short
    dx, dy = d.float().unbind(-1)
    exact = _weight(_plain_power(exact_projection, dx.double(), dy.double()).detach())
    record = _record(inputs, device)[exact_projection.ids.to(device)]
    found = {n: _weight(p) for n, p in _powers(record, dx.to(device), dy.to(device)).items()}
    # where rounding left no inverse covariance, nothing is drawn
    kept = torch.isin(exact_projection.ids, plain.ids)
    found["plain"] = torch.zeros_like(exact)
    found["plain"][kept] = _weight(_plain_power(plain, dx[kept], dy[kept]).detach())
    return {n: _figures((w - exact).abs()) for n, w in found.items()}


def _twin(inputs: Inputs, upstream: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return alpha [P] and the gradient of the projected mean [2], in the inputs' precision; zero if nothing is rendered."""
    projected = ProjectedGaussians(*(t.detach() for t in projected_of(inputs, _frame(), FREE)))
    if len(projected.ids) == 0:
        return torch.zeros_like(upstream), torch.zeros(2, dtype=torch.float64)
    means = projected.means.clone().requires_grad_()
    projected = projected._replace(means=means)
    pixels = pixel_centers(_frame(), means.dtype)
    alpha = layers(pixels, None, projected, FREE).alpha[0]
    (alpha * upstream.to(alpha)).sum().backward()
    return alpha.detach().double(), means.grad[0].double()


def image_errors(length: float, device: torch.device) -> tuple[dict, dict]:
    """Return the error of alpha in images of one needle each, and the relative error of the gradient of the projected mean."""
    inputs = needles(length, IMAGES)
    upstream = torch.randn(SIDE * SIDE, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    images: dict[str, list[torch.Tensor]] = {"factor": [], "conic": [], "plain": []}
    gradients: dict[str, list[torch.Tensor]] = {"factor": [], "plain": []}
    pixels = pixel_centers(_frame(), torch.float32).to(device)
    for i in range(IMAGES):
        one = _only(inputs, i)
        exact, v_exact = _twin(one.to(torch.float64), upstream)
        plain, v_plain = _twin(one.to(torch.float32), upstream)
        there = [t.detach().to(device) for t in one]
        there[0].requires_grad_()
        r = rasterize(Gaussians(*there[:5]), Camera(there[5], there[6], SIDE, SIDE), RasterizeOptions(rule=FREE))
        r.projected.retain_grad()
        (r.alpha.flatten() * upstream.to(r.alpha)).sum().backward()
        record = r.projected.detach()[0, :, :5]
        power = _powers(record, pixels[None, :, 0] - record[:, :1], pixels[None, :, 1] - record[:, 1:2])["conic"]
        drawn = {"factor": r.alpha.detach().flatten().double().cpu(), "conic": OPACITY * _weight(power)[0], "plain": plain}
        for name, alpha in drawn.items():
            images[name].append((alpha - exact).abs())
        for name, v in (("factor", r.projected.grad[0, 0, :2].double().cpu()), ("plain", v_plain)):
            gradients[name].append((v - v_exact).norm() / v_exact.norm())
    return {n: _figures(e) for n, e in images.items()}, {n: _figures(e) for n, e in gradients.items()}


def measure(device: torch.device, lengths=LENGTHS) -> list[dict]:
    """Return a row for each length."""
    rows = []
    for length in lengths:
        image, gradient = image_errors(length, device)
        rows.append({"sigma": length, "weight": weight_errors(length, device), "image": image, "gradient": gradient})
    return rows
