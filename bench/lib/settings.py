"""The settings of the rasterizer that speed and accuracy are weighed for, and the renderer of each."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch

from warpgs.constants import RULES, Rule
from warpgs.kernels.blend import blend
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.scene import Camera, Gaussians

EXACT = RULES["exact"]
UNCUT = dataclasses.replace(EXACT, name="uncut", alpha_cut=0.0, transmittance_stop=0.0)
"""Nothing left out: in float64 the reference of the model."""
CUTS = (0.0, 0.25, 2.0, 4.0, 8.0)
"""Values of the alpha cut beside 1 [1/255]."""
STOPS = (1e-5, 1e-3, 1e-2, 1e-1)
"""Values of the transmittance stop beside 1e-4."""
PAIRS = ((0.25, 1e-3), (2.0, 1e-2), (4.0, 1e-2), (8.0, 1e-3))
"""Cut and stop together."""
STALE = (1.6e-4, 1.6e-3)
"""Errors of the depth that Gaussians are sorted by [u]: a step at the highest rate of positions, and ten of them."""


@dataclass(frozen=True)
class Setting:
    """One way to draw."""

    name: str
    knob: str
    rule: Rule = EXACT
    tile_size: int = 16
    degree: int | None = None
    deterministic: bool = True
    half: bool = False
    """Colour coefficients rounded to float16. A simulation: the rounding is not part of the time."""
    stale: float = 0.0
    """Depth by which instances are sorted is off by this [u]. A simulation: what not sorting saves is not in the time."""
    preset: bool = False

    @property
    def simulated(self) -> bool:
        """True where the error is real and the time is not."""
        return self.half or self.stale > 0

    def instances(self, gaussians: Gaussians, camera: Camera) -> int:
        """(Gaussian, tile) instances of an image."""
        like, size = gaussians.means, {"width": camera.width, "height": camera.height}
        view, K = (torch.as_tensor(t, dtype=like.dtype, device=like.device)[None] for t in (camera.viewmat, camera.K))
        with torch.no_grad():
            tensors = gaussians.tensors().values()
            counts = project(*tensors, view, K, **size, degree=0, rule=self.rule, tile_size=self.tile_size)[1]
        return int(counts.sum())

    def render(
        self, gaussians: Gaussians, camera: Camera, max_instances: int | None = None, capacity: int | None = None
    ) -> torch.Tensor:
        """Colours, shape [H, W, 3]; bounds as in `RasterizeOptions`."""
        if self.half:
            sh = gaussians.sh  # its gradient is passed straight through the rounding
            gaussians = dataclasses.replace(gaussians, sh=sh + (sh.half().to(sh.dtype) - sh).detach())
        if self.stale > 0:
            return self._render_stale(gaussians, camera)
        options = RasterizeOptions(
            rule=self.rule, tile_size=self.tile_size, sh_degree=self.degree, deterministic=self.deterministic,
            max_instances=max_instances, capacity=capacity,
        )  # fmt: skip
        return rasterize(gaussians, camera, options).rgb

    def _render_stale(self, gaussians: Gaussians, camera: Camera) -> torch.Tensor:
        """Instances listed by depths that are off, blended with the true ones."""
        like, size = gaussians.means, {"width": camera.width, "height": camera.height}
        view, K = (torch.as_tensor(t, dtype=like.dtype, device=like.device)[None] for t in (camera.viewmat, camera.K))
        projected, counts = project(*gaussians.tensors().values(), view, K, **size, degree=gaussians.sh_degree, rule=self.rule)
        off = projected.detach().clone()
        noise = torch.randn(off.shape[:2], generator=torch.Generator().manual_seed(0))
        off[..., 9] += self.stale * noise.to(off)
        tiles = bin_tiles(off, counts, **size, rule=self.rule)
        return blend(projected, tiles, like.new_zeros(1, 3), **size, rule=self.rule)[0][0]


def cut_and_stop(cut: float, stop: float, name: str = "") -> Rule:
    """`exact` with another alpha cut [1/255] and transmittance stop."""
    return dataclasses.replace(
        EXACT, name=name or f"cut {cut:g}/255, stop {stop:g}", alpha_cut=cut / 255, transmittance_stop=stop
    )


def settings(degree: int, cuda: bool) -> list[Setting]:
    """Every knob by itself from `exact`, then pairs, then the presets, for a scene of that degree."""
    made = [Setting("exact", "preset", preset=True)]
    made += [Setting(f"cut {c:g}/255", "alpha cut", cut_and_stop(c, 1e-4)) for c in CUTS]
    made += [Setting(f"stop {s:g}", "transmittance stop", cut_and_stop(1, s)) for s in STOPS]
    made += [Setting("tile 8", "tile size", tile_size=8)]
    made += [Setting(f"degree {d}", "SH degree", degree=d) for d in range(degree)]
    made += [Setting(r, "foreign rule", RULES[r]) for r in ("gsplat", "inria")]
    made += [Setting("half SH", "half SH", half=True)]
    made += [Setting(f"order off {s:g}", "stale order", stale=s) for s in STALE]
    if cuda:
        made += [Setting("atomic", "atomic sums", deterministic=False)]
    made += [Setting(f"cut {c:g}, stop {s:g}", "cut and stop", cut_and_stop(c, s)) for c, s in PAIRS]
    made += [Setting(n, "preset", RULES[n], preset=True) for n in ("balanced", "fast")]
    return made
