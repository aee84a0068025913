"""Settings of the rasterizer for which speed and accuracy are compared, and the renderer of each."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch

from warpgs.constants import RULES, Rule
from warpgs.kernels.project import project
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

EXACT = RULES["exact"]
UNCUT = dataclasses.replace(EXACT, name="uncut", alpha_cut=0.0, transmittance_stop=0.0)
"""No cut-offs: in float64 the reference of the model."""
CUTS = (0.0, 0.25, 2.0, 4.0, 8.0)
"""Values of the alpha cut, in addition to 1 [1/255]."""
STOPS = (1e-5, 1e-3, 1e-2, 1e-1)
"""Values of the transmittance stop, in addition to 1e-4."""
PAIRS = ((0.25, 1e-3), (2.0, 1e-2), (4.0, 1e-2), (8.0, 1e-3))
"""Cut and stop together."""


@dataclass(frozen=True)
class Setting:
    """One way to render."""

    name: str
    knob: str
    rule: Rule = EXACT
    tile_size: int = 16
    degree: int | None = None
    deterministic: bool = True
    preset: bool = False

    def instances(self, gaussians: Gaussians, camera: Camera) -> int:
        """Return the number of (Gaussian, tile) instances of an image."""
        like, size = gaussians.means, {"width": camera.width, "height": camera.height}
        view, K = (torch.as_tensor(t, dtype=like.dtype, device=like.device)[None] for t in (camera.viewmat, camera.K))
        with torch.no_grad():
            tensors = gaussians.tensors().values()
            counts = project(*tensors, view, K, **size, degree=0, rule=self.rule, tile_size=self.tile_size)[1]
        return int(counts.sum())

    def render(
        self, gaussians: Gaussians, camera: Camera, max_instances: int | None = None, capacity: int | None = None
    ) -> torch.Tensor:
        """Return the colours, shape [H, W, 3]; bounds as in `RasterizeOptions`."""
        options = RasterizeOptions(
            rule=self.rule, tile_size=self.tile_size, sh_degree=self.degree, deterministic=self.deterministic,
            max_instances=max_instances, capacity=capacity,
        )  # fmt: skip
        return rasterize(gaussians, camera, options).rgb


def cut_and_stop(cut: float, stop: float, name: str = "") -> Rule:
    """Return `exact` with another alpha cut [1/255] and transmittance stop."""
    return dataclasses.replace(
        EXACT, name=name or f"cut {cut:g}/255, stop {stop:g}", alpha_cut=cut / 255, transmittance_stop=stop
    )


def settings(degree: int, cuda: bool) -> list[Setting]:
    """Return every setting changed alone from `exact`, then pairs, then the presets, for a scene of that degree."""
    made = [Setting("exact", "preset", preset=True)]
    made += [Setting(f"cut {c:g}/255", "alpha cut", cut_and_stop(c, 1e-4)) for c in CUTS]
    made += [Setting(f"stop {s:g}", "transmittance stop", cut_and_stop(1, s)) for s in STOPS]
    made += [Setting("tile 8", "tile size", tile_size=8)]
    made += [Setting(f"degree {d}", "SH degree", degree=d) for d in range(degree)]
    made += [Setting(r, "foreign rule", RULES[r]) for r in ("gsplat-1.5", "inria")]
    if cuda:
        made += [Setting("atomic", "atomic sums", deterministic=False)]
    made += [Setting(f"cut {c:g}, stop {s:g}", "cut and stop", cut_and_stop(c, s)) for c, s in PAIRS]
    made += [Setting(n, "preset", RULES[n], preset=True) for n in ("balanced", "fast")]
    return made
