"""Near and far plane: Gaussians outside are not there, on every way to render (graphed calls: `test_graphed.py`)."""

import dataclasses
import math

import pytest
import torch

from tests.gaussians import camera, cloud, leaves
from tests.lens_cameras import LENSES, lens_camera
from warpgs.constants import FAR, RULES
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize

PLANES = {"near": 3.5, "far": 4.5}
"""Depths between which about half of `cloud` lies, whose depths are 3 to 5 u."""
PATHS = {
    "whole": {}, "chunked": {"max_instances": 50}, "window": {"window": (16, 0, 16, 48)}, "capacity": {"capacity": 100_000},
    "channels": {"features": torch.ones(200, 5)}, "rule": {"rule": dataclasses.replace(RULES["exact"], name="own", **PLANES)},
}  # fmt: skip
"""Ways to render, by their options."""


def cast(options: dict, dtype, device) -> dict:
    return {n: v.to(device, dtype) if isinstance(v, torch.Tensor) else v for n, v in options.items()}


@pytest.mark.parametrize("path", PATHS)
def test_gaussians_outside_are_not_there(path, device, dtype):
    """To the bit, the images and gradients are those without them, whose gradients are zero."""
    cam, planes = camera(64, 48, dtype=dtype, device=device), {} if path == "rule" else PLANES
    g = cloud(200, dtype, device)
    inside = (g.means[:, 2] >= PLANES["near"]) & (g.means[:, 2] <= PLANES["far"])
    assert 50 < int(inside.sum()) < 150
    some = type(g)(**{n: t[inside] for n, t in g.tensors().items()})
    options = cast(PATHS[path], dtype, device)
    found, expected = leaves(g), leaves(some)
    rendered = rasterize(found, cam, RasterizeOptions(**options, **planes))
    alone = rasterize(
        expected,
        cam,
        RasterizeOptions(**{n: v[inside] if n == "features" else v for n, v in options.items()} | {"rule": "exact"}),
    )
    assert torch.equal(rendered.rgb, alone.rgb) and torch.equal(rendered.depth, alone.depth)
    assert float(rendered.alpha.detach().max()) > 0.5
    for r in (rendered, alone):
        (r.rgb.square().sum() + r.depth.sum()).backward()
    for name, tensor in found.tensors().items():
        assert torch.equal(tensor.grad[inside], expected.tensors()[name].grad)
        assert not bool(tensor.grad[~inside].any())


@pytest.mark.parametrize("model", LENSES)
def test_the_depth_of_a_lens(model, dtype, device):
    """Along the z axis, or the distance from a fisheye."""
    g, cam = cloud(200, dtype, device), lens_camera(model, width=64, height=48, dtype=dtype, device=device)
    depths = g.means.norm(dim=1) if model == "fisheye" else g.means[:, 2]
    inside = (depths >= PLANES["near"]) & (depths <= PLANES["far"])
    seen = rasterize(g, cam).tile_counts[0] > 0
    assert bool((seen & ~inside).any()) and bool((seen & inside).any())
    assert torch.equal(rasterize(g, cam, RasterizeOptions(**PLANES)).tile_counts[0] > 0, seen & inside)


def test_planes_are_inclusive(device, dtype):
    """A mean on a plane is rendered, one float beyond is not."""
    g, cam = cloud(6, dtype, device), camera(dtype=dtype, device=device)
    near, far = (torch.tensor(p, dtype=dtype) for p in PLANES.values())
    inf = torch.tensor(math.inf, dtype=dtype)
    depths = [torch.nextafter(p, side) if side else p for p in (near, far) for side in (-inf, None, inf)]
    g.means[:] = torch.stack([torch.zeros(6, dtype=dtype), torch.zeros(6, dtype=dtype), torch.stack(depths)], 1)
    counts = rasterize(g, cam, RasterizeOptions(**PLANES)).tile_counts[0]
    assert (counts > 0).tolist() == [False, True, True, True, True, False]


@pytest.mark.parametrize(
    "planes",
    [(2.0, 1.0), (1.0, 1.0), (-1.0, None), (math.nan, None), (None, math.nan), (None, math.inf), (None, 0.001), (1.0, 2 * FAR)],
)
def test_planes_that_bound_nothing_are_refused(planes):
    """By a message with both values and the range, wherever they come from."""
    near, far = planes
    own = dataclasses.replace(RULES["exact"], **{n: v for n, v in zip(("near", "far"), planes) if v is not None})
    for options in ({"near": near, "far": far}, {"rule": own}):
        with pytest.raises(ValueError, match=r"near .* and far .*: give 0 <= near < far <= 1e\+10"):
            RasterizeOptions(**options)
