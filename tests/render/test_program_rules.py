"""Rules with the name of another program, against that program's documented constants in float64."""

from typing import NamedTuple

import pytest
import torch

from tests.gaussians import camera, cloud
from tests.reference.project import project_reference
from warpgs.constants import RULES
from warpgs.errors import UsageError
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians


class Program(NamedTuple):
    """Constants of a program, copied here as numbers so that a change of `RULES` is noticed."""

    alpha_max: float
    near: float
    sigmas: float
    """Half side of the square around a Gaussian that is tiled, in standard deviations; above 3.33 it never binds."""


PROGRAMS = {
    "gsplat-1.6": Program(0.99, 0.01, 3.33),  # include/Common.h: MAX_ALPHA, GAUSSIAN_EXTEND; rendering.py: near_plane
    "gsplat-1.5": Program(0.999, 0.01, 3.33),  # csrc/RasterizeToPixels3DGSFwd.cu, csrc/ProjectionEWA3DGSFused.cu
    "inria": Program(0.99, 0.2, 3.0),  # forward.cu, auxiliary.h of diff-gaussian-rasterization
}


def image_of(gaussians: Gaussians, cam, program: Program) -> torch.Tensor:
    """Return the image [H, W, 3] over black: 1/255 cuts, a Gaussian that leaves less than 1e-4 ends the pixel unblended."""
    tensors = [t.double() for t in gaussians.tensors().values()]
    size = {"width": cam.width, "height": cam.height}
    means, covs, colors, depths, opacities = project_reference(
        *tensors, cam.viewmat[None], cam.K[None], **size, degree=1, low_pass=0.3
    )
    xs, ys = (torch.arange(count, dtype=torch.float64) + 0.5 for count in (cam.width, cam.height))
    image = torch.zeros(cam.height, cam.width, 3, dtype=torch.float64)
    left = torch.ones(cam.height, cam.width, dtype=torch.float64)
    done = torch.zeros_like(left, dtype=torch.bool)
    for n in torch.argsort(depths[0], stable=True).tolist():
        if depths[0, n] < program.near:
            continue
        A, dx, dy = torch.linalg.inv(covs[0, n]), xs - means[0, n, 0], (ys - means[0, n, 1])[:, None]
        alpha = opacities[n] * torch.exp(-0.5 * (A[0, 0] * dx**2 + 2 * A[0, 1] * dx * dy + A[1, 1] * dy**2))
        radius = torch.ceil(program.sigmas * torch.linalg.eigvalsh(covs[0, n])[-1].sqrt())
        columns, rows = ((d.abs() <= radius).view(-1) for d in (dx, dy))
        tiled = [torch.stack([part.any().expand(len(part)) for part in inside.split(16)]) for inside in (columns, rows)]
        hit = (alpha >= 1 / 255) & tiled[0].view(-1) & tiled[1].view(-1, 1) & ~done
        after = left * (1 - alpha.clamp_max(program.alpha_max))
        done |= hit & (after < 1e-4)
        hit &= ~done
        image += torch.where(hit, left - after, 0.0)[..., None] * colors[0, n]
        left = torch.where(hit, after, left)
    return image


def crowd() -> Gaussians:
    """Opaque layers at every depth from 0.05 u on, so that clamp, stop and near plane all decide."""
    g = cloud(250, torch.float64, seed=5)
    depths = torch.linspace(0.05, 6, len(g), dtype=torch.float64)
    means = g.means * depths[:, None] / g.means[:, 2:]
    return Gaussians(means, g.quats, g.log_scales + (depths / 4).log()[:, None], 3 * g.logit_opacities + 3, g.sh)


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_rule_has_the_constants_of_its_program(name, device):
    """In float64 to rounding; the constants of every other program give another image."""
    g, cam = crowd(), camera(64, 48)
    on_device = Gaussians(**{n: t.to(device) for n, t in g.tensors().items()})
    found = rasterize(on_device, cam, RasterizeOptions(rule=name)).rgb.cpu()
    # sums of 250 terms below 3, each within some ulp: 1e-12 is a hundred times that
    assert float((found - image_of(g, cam, PROGRAMS[name])).abs().max()) < 1e-12
    for other in PROGRAMS.keys() - {name}:
        assert float((found - image_of(g, cam, PROGRAMS[other])).abs().max()) > 1e-3


def test_a_program_is_named_with_its_version():
    """The name without one is refused with the names that there are."""
    with pytest.raises(UsageError, match=r"'gsplat' needs a version.*choose gsplat-1\.6 or gsplat-1\.5$"):
        rasterize(cloud(1), camera(), RasterizeOptions(rule="gsplat"))
    assert {n for n in RULES if n.startswith("gsplat")} == {n for n in PROGRAMS if n.startswith("gsplat")}
