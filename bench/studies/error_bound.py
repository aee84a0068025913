"""The bound of a render's error against its true error, in adversarial scenes for each cut-off.

The true error is the distance from `reference_image`, in float64 and without the kernels. A violation is a pixel whose error
exceeds its bound. Tightness is bound divided by error, for pixels with an error above 1e-6.
"""

from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.bound_scenes import HEIGHT, KINDS, WIDTH, bound_scene
from warpgs.constants import RULES
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.render.reference import reference_image

CPU = torch.device("cpu")
QUANTILES = (0.5, 0.9, 0.99, 1.0)


def measure(scenes: range) -> list[dict]:
    """Return a row for each rule, and one for each kind of scene."""
    pixels: dict[str, list[torch.Tensor]] = {name: [] for name in (*RULES, *KINDS)}
    for number in scenes:
        kind, g, camera, background = bound_scene(number)
        truth = reference_image(g, camera, (0, 0, WIDTH, HEIGHT), background, 1)
        for rule in RULES:
            r = rasterize(g, camera, RasterizeOptions(rule=rule, background=background, error_bound=True))
            found = torch.stack([(r.rgb.double() - truth).abs().amax(-1).view(-1), r.error_bound.double().view(-1)], 1)
            pixels[rule].append(found)
            pixels[kind].append(found)
    return [{"of": name} | _row(torch.cat(found)) for name, found in pixels.items() if found]


def _row(pixels: torch.Tensor) -> dict:
    """Return the figures of pixels [N, 2] of error and bound."""
    error, bound = pixels.T
    seen = error > 1e-6
    ratios = (bound[seen] / error[seen]).sort().values
    at = {f"tightness_{q:g}": ratios[int(q * (len(ratios) - 1))].item() for q in QUANTILES if len(ratios)}
    excess = (bound - error)[~seen].max().item() if bool((~seen).any()) else 0.0
    means = {"error_mean": error.mean().item(), "error_max": error.max().item(), "bound_mean": bound.mean().item()}
    return {"pixels": len(pixels), "violations": int((error > bound).sum()), **means, **at, "excess_elsewhere_max": excess}


def main() -> int:
    """Print a row for each rule and kind of scene; exit 1 if a bound is below its error."""
    a = parse(__doc__, scenes=1000, out=Path)
    rows = measure(range(a.scenes))
    for row in rows:
        print(" ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    result_file.keep(a.out, "bound of the error of a render against its true error", CPU, rows, scenes=a.scenes)
    return int(any(row["violations"] for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
