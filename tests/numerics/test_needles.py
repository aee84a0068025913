"""The weight of long Gaussians from the kernels' triangular factor, beside an inverse covariance and textbook formulas."""

import dataclasses
import math

import torch

from bench.lib.kernel_calls import project
from tests.reference.low_precision import Frame, Inputs, projected_of
from warpgs.constants import RULES

SIDE = 256
"""Width and height of the image [px]."""
FREE = dataclasses.replace(RULES["exact"], name="free", alpha_cut=0.0, transmittance_stop=0.0)
"""No cut-off, so that no pixel is decided by rounding."""


def needles(length: float, count: int) -> Inputs:
    """Return needles through the middle of the image, at many angles and tilted, with a standard deviation of ``length`` px."""
    focal = 1.2 * SIDE
    generator = torch.Generator().manual_seed(int(length))
    turn = math.pi * (torch.arange(count, dtype=torch.float64) + torch.rand(count, generator=generator)) / count
    tilt = torch.rand(count, generator=generator, dtype=torch.float64) - 0.5
    cz, sz, cy, sy = torch.cos(turn / 2), torch.sin(turn / 2), torch.cos(tilt / 2), torch.sin(tilt / 2)
    quats = torch.stack([cz * cy, -sz * sy, cz * sy, sz * cy], 1)  # about z after about y
    long = length / focal / torch.cos(tilt)
    thin = torch.full_like(long, 1e-3 / focal)
    means = torch.tensor([0.01, -0.02, 1.0], dtype=torch.float64).expand(count, 3)
    K = torch.tensor([[focal, 0, SIDE / 2 + 0.3], [0, focal, SIDE / 2 - 0.4], [0, 0, 1]])
    scales = torch.log(torch.stack([long, thin, thin], 1))
    logits, sh = torch.full((count,), math.log(9.0)), torch.zeros(count, 1, 3)
    return Inputs(means.float(), quats.float(), scales.float(), logits, sh, torch.eye(4), K, torch.zeros(3))


def conic_power(conics: torch.Tensor, dx: torch.Tensor, dy: torch.Tensor) -> torch.Tensor:
    """Return the squared Mahalanobis distances [N, P] by inverse covariances [N, 3]."""
    xx, xy, yy = (conics[:, k, None] for k in range(3))
    return xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy


def weight(power: torch.Tensor) -> torch.Tensor:
    """Return exp(-power / 2), and 0 for a negative power, which is rounding's."""
    return torch.where(power >= 0, torch.exp(-0.5 * power), torch.zeros_like(power)).double().cpu()


def largest_errors(length: float, device: torch.device) -> dict[str, float]:
    """Return the largest error of the weight, up to two standard deviations away from each of 400 needles, by program."""
    inputs, frame = needles(length, 400), Frame(SIDE, SIDE, 0, (0, 0, SIDE, SIDE))
    exact, plain = (projected_of(inputs.to(dtype), frame, FREE) for dtype in (torch.float64, torch.float32))
    xx, xy, yy = exact.conics.detach().unbind(1)
    strengths, axes = torch.linalg.eigh(torch.stack([xx, xy, xy, yy], -1).view(-1, 2, 2))  # the long axis first
    along = torch.tensor([-2.0, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 2.0], dtype=torch.float64)
    across = torch.tensor([-1.0, -0.5, 0.0, 0.5, 1.0], dtype=torch.float64)
    t, s = (g.flatten() for g in torch.meshgrid(along, across, indexing="ij"))
    long, short = ((strengths[:, k, None].rsqrt() * axes[:, :, k])[:, None] for k in range(2))
    dx, dy = (t[None, :, None] * long + s[None, :, None] * short).float().unbind(-1)
    wanted = weight(conic_power(exact.conics, dx.double(), dy.double()).detach())
    there = [v.detach().to(device) for v in inputs]
    projected, _ = project(*there[:5], there[5][None], there[6][None], width=SIDE, height=SIDE, degree=0, rule=FREE)
    u11, u12, u22 = projected[0, exact.ids.to(device), 2:5, None].unbind(1)
    e1, e2 = u11 * dx.to(device) + u12 * dy.to(device), u22 * dy.to(device)
    multiplied = torch.cat([u11 * u11, u11 * u12, u12 * u12 + u22 * u22], 1)
    found = {
        "factor": weight(e1 * e1 + e2 * e2),
        "conic": weight(conic_power(multiplied, dx.to(device), dy.to(device))),
        "plain": torch.zeros_like(wanted),
    }
    kept = torch.isin(exact.ids, plain.ids)  # where rounding left no inverse covariance, nothing is drawn
    found["plain"][kept] = weight(conic_power(plain.conics, dx[kept], dy[kept]).detach())
    return {name: float((w - wanted).abs().max()) for name, w in found.items()}


def test_needles_err_less_in_the_factor_form(device):
    """At 300 px the largest error of the weight is a hundredth of the conic's, also of the one with the same factor."""
    errors = largest_errors(300, device)
    assert all(errors[name] >= 100 * errors["factor"] for name in ("conic", "plain")), errors
    assert errors["factor"] < 1e-4  # measured 3.0e-5
