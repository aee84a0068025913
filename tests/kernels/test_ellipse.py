"""The functions for rows, columns and strips that a Gaussian touches, against a fine search."""

import functools
import math

import pytest
import torch
import warp as wp

from warpgs.kernels import ellipse, falloff, launch

COUNT = 4000


@functools.cache
def make_probe():
    s, f = ellipse.make_spans(wp.float64), falloff.make_functions(wp.float64)
    vec3 = wp.types.vector(3, wp.float64)

    @wp.kernel(enable_backward=False)
    def probe(
        begin: int, cases: wp.array2d(dtype=wp.float64), whole_tiles: int, origin: int, size: int, tile_size: int,
        # outputs
        spans: wp.array2d(dtype=int),
    ):  # fmt: skip
        i = begin + wp.tid()
        factor = vec3(cases[i, 2], cases[i, 3], cases[i, 4])
        rows = s.tile_rows(cases[i, 1], cases[i, 7], origin, size, tile_size)
        columns = s.tile_columns(
            cases[i, 0], cases[i, 1], factor, cases[i, 5], cases[i, 6], cases[i, 7], int(cases[i, 8]), origin, size, tile_size
        )
        bounds = f.bounds_of(
            cases[i, 0], cases[i, 1], cases[i, 2], cases[i, 4], cases[i, 6], cases[i, 7], whole_tiles
        )  # fmt: skip
        dx = wp.float64(origin) + wp.float64(0.5) - cases[i, 0]
        dy = wp.float64(origin) + wp.float64(0.5) - cases[i, 1]
        start, e2 = cases[i, 2] * dx + cases[i, 3] * dy, cases[i, 4] * dy
        for k in range(2):
            spans[i, k] = rows[k]
            spans[i, 2 + k] = columns[k]
        spans[i, 4] = int(f.reaches(start, cases[i, 2], e2 * e2, bounds[0], bounds[1]))

    return probe


def probe(cases: torch.Tensor, device, whole_tiles=0, origin=16, size=53, tile_size=16) -> torch.Tensor:
    spans = torch.zeros(len(cases), 5, dtype=torch.int32, device=device)
    inputs = [cases.to(device), whole_tiles, origin, size, tile_size, spans]
    launch.launch(make_probe(), len(cases), inputs, device)
    return spans.cpu()


def ellipses(origin=16, size=53, tile_size=16, far=1.0) -> torch.Tensor:
    """Random ellipses about a window: mean, factor, reach, half sides, row of tiles. ``far`` stretches all of it."""
    generator = torch.Generator().manual_seed(int(far))

    def rand(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    angle, axes = rand(COUNT) * math.pi, torch.exp(rand(COUNT, 2) * 4.5 - 1.5) * far
    turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], -1).view(-1, 2, 2)
    cov = turn @ torch.diag_embed(axes**2) @ turn.transpose(1, 2)
    inverse = torch.linalg.inv(cov)
    u11 = inverse[:, 0, 0].sqrt()
    u12 = inverse[:, 0, 1] / u11
    u22 = (inverse[:, 1, 1] - u12**2).sqrt()
    reach = 0.5 + 2.8 * rand(COUNT)
    half = reach[:, None] * torch.stack([cov[:, 0, 0], cov[:, 1, 1]], -1).sqrt()
    means = origin + size * (rand(COUNT, 2) * 1.6 - 0.3) + (half - 1) * (torch.sign(rand(COUNT, 2) - 0.5)) * (far > 1)
    row = torch.floor((origin + size * rand(COUNT)) / tile_size)
    return torch.stack([*means.unbind(-1), u11, u12, u22, reach, *half.unbind(-1), row], -1)


def margin_of(center, half):
    return 0.01 + 2e-6 * (center.abs() + half)


def tiles_of(low, high, origin, size, tile_size):
    """First tile and one past the last that has a pixel centre in [low, high]; 0, 0 for none."""
    first = torch.ceil(low - 0.5).clamp(origin, origin + size)
    last = torch.floor(high - 0.5).clamp(origin - 1, origin + size - 1)
    spans = torch.stack([first // tile_size, last // tile_size + 1], -1)
    return torch.where((last < first)[:, None], torch.zeros(()), spans).int()


@pytest.mark.parametrize("far", [1.0, 1e5])
@pytest.mark.parametrize("tile_size", [1, 16])
def test_rows_of_tiles_are_those_of_the_box(device, tile_size, far):
    cases = ellipses(far=far)
    found = probe(cases, device, tile_size=tile_size)[:, :2]
    low, high = cases[:, 1] - cases[:, 7], cases[:, 1] + cases[:, 7]
    margin = margin_of(cases[:, 1], cases[:, 7])
    assert torch.equal(found, tiles_of(low - margin, high + margin, 16, 53, tile_size))
    assert 0 < int((found[:, 1] > found[:, 0]).sum()) < COUNT


@pytest.mark.parametrize("far", [1.0, 1e4])
def test_strips_are_those_of_the_ellipse(device, far):
    """Eight pixels in a row, widened by the margins: reached where the ellipse touches them, and all where tiles are whole."""
    cases = ellipses(far=far)
    mx, my, u11, u12, u22, _, half_width, half_height, _ = (t[:, None] for t in cases.unbind(-1))
    if far > 1:  # beside the ellipse, at a height of it
        fraction = torch.linspace(-1, 1, COUNT, dtype=torch.float64)[:, None]
        my[:] = 16.5 - fraction * half_height
        mx[:] = 20.0 + u12 / u11 * fraction * half_height
        mx[::2] += (u22 * half_height / u11 * (1 - fraction**2).sqrt())[::2] + 8 * fraction[::2].flip(0)
    radius, dy = u22 * (half_height + margin_of(my, half_height)), 16.5 - my
    side = 3.5 + margin_of(mx, half_width)
    dx = 20.0 - mx + side * torch.linspace(-1, 1, 4001, dtype=torch.float64)
    least = ((u11 * dx + u12 * dy) ** 2).amin(1, True) + (u22 * dy) ** 2
    # the search itself is coarse: what lies nearer to the edge than its step is left out
    step = (2 * u11 * side / 4000 * (radius + u11 * side / 4000)).clamp_min(1e-9)
    sure = ((least - radius**2).abs() > step)[:, 0]
    found = probe(cases, device)[:, 4].bool()
    assert torch.equal(found[sure], (least <= radius**2)[sure, 0])
    assert float(sure.double().mean()) > 0.9 and 0.02 < float(found.double().mean()) < 0.98
    assert bool(probe(cases, device, whole_tiles=1)[:, 4].all())


@pytest.mark.parametrize("far", [1.0, 1e4])
@pytest.mark.parametrize("tile_size", [1, 16])
def test_columns_of_tiles_are_those_of_the_ellipse(device, tile_size, far):
    cases = ellipses(far=far, tile_size=tile_size)
    mx, my, u11, u12, u22, reach, half_width, half_height, row = (t[:, None] for t in cases.unbind(-1))
    slack = margin_of(my, half_height)
    top = (row * tile_size + 0.5 - my - slack).maximum(-half_height)
    bottom = (row * tile_size + tile_size - 0.5 - my + slack).minimum(half_height)
    dy = top + (bottom - top) * torch.linspace(0, 1, 3001, dtype=torch.float64)
    width = (reach**2 - (u22 * dy) ** 2).clamp_min(0).sqrt()
    left, right = ((-width - u12 * dy) / u11).amin(1, True), ((width - u12 * dy) / u11).amax(1, True)
    if far > 1:  # one end or the other in the window
        mx[::2], mx[1::2] = (mx - left)[::2].remainder(60) + 13 - left[::2], (mx - right)[1::2].remainder(60) + 13 - right[1::2]
    found = probe(cases, device, tile_size=tile_size)[:, 2:4]
    margin = margin_of(mx, half_width)
    within = (top < bottom)[:, 0]  # other rows are never asked for
    # the search itself is coarse: what it finds to within its step must agree
    step = 1e-3 if far == 1.0 else 2e-2
    low, high = (mx + left - margin)[:, 0], (mx + right + margin)[:, 0]
    least, most = (tiles_of(low + e, high - e, 16, 53, tile_size)[within] for e in (step, -step))
    sure = (least == most).all(1)
    assert torch.equal(found[within][sure], least[sure])
    ends = (least[:, 1] > least[:, 0]) & ((least[:, 0] * tile_size > 16) | (least[:, 1] * tile_size < 69))
    assert int((sure & ends).sum()) > 0.2 * len(sure)


@pytest.mark.parametrize("far", [1.0, 1e5])
def test_columns_of_the_box_where_there_is_no_reach(device, far):
    """Reach 0 asks for the box; so does a factor that has lost its range."""
    cases = ellipses(far=far)
    margin = margin_of(cases[:, 0], cases[:, 6])
    wanted = tiles_of(cases[:, 0] - cases[:, 6] - margin, cases[:, 0] + cases[:, 6] + margin, 16, 53, 16)
    for column, value in ((5, 0.0), (2, 1e-7), (4, 1e-7), (2, 1e-6), (4, 1e-6)):
        changed = cases.clone()
        changed[:, column] = value
        assert torch.equal(probe(changed, device)[:, 2:4], wanted), column


@functools.cache
def make_reach():
    s = ellipse.make_spans(wp.float64)
    single = falloff.make_falloff(wp.float32)

    @wp.kernel(enable_backward=False)
    def reaches(
        begin: int, opacities: wp.array(dtype=wp.float64), cut: wp.float64, square_sigma: wp.float64,
        xs: wp.array(dtype=wp.float32),
        # outputs
        found: wp.array(dtype=wp.float64), falls: wp.array(dtype=wp.float32),
    ):  # fmt: skip
        i = begin + wp.tid()
        found[i] = s.reach_of(opacities[i], cut, square_sigma)
        falls[i] = single(xs[i])

    return reaches


def reaches(opacities, cut, square_sigma, xs):
    found, falls = torch.zeros_like(opacities), torch.zeros_like(xs)
    launch.launch(make_reach(), len(opacities), [opacities, cut, square_sigma, xs, found, falls], torch.device("cpu"))
    return found, falls


def test_reach_is_where_alpha_is_the_cut_and_the_falloff_is_the_exponential():
    """At the reach alpha is a little below the cut; 0 stands for the whole box."""
    opacities, cut = torch.linspace(0.004, 1.0, 500, dtype=torch.float64), 1 / 255
    found, _ = reaches(opacities, cut, 0.0, torch.zeros(500))
    alpha = opacities * torch.exp(-0.5 * found**2)
    assert bool((alpha < cut).all()) and bool((alpha > cut * (1 - 3e-4)).all())
    wanted = (2 * torch.log(opacities / cut) + 1e-5).sqrt()
    assert bool(((found / wanted - 1).abs() < 2e-5).all()) and bool((found > wanted).all())
    for no_cut, sigma in ((0.0, 0.0), (cut, 3.0), (0.0, 3.0)):
        assert not bool(reaches(opacities, no_cut, sigma, torch.zeros(500))[0].any())
    assert bool(reaches(opacities.clamp_min(0.6), 0.5, 0.0, torch.zeros(500))[0].all())
    # the error of the falloff is the polynomial's 3e-7 where x is small, then that of rounding x, down to the bound
    x = torch.cat([torch.linspace(0, 152, 400_001), torch.tensor([153.0, 200.0, 1e4, 1e30])])
    _, found = reaches(torch.ones(len(x), dtype=torch.float64), 0.5, 0.0, x)
    error = (found.double() / torch.exp(-0.5 * x.double()).clamp_min(2.0**-110) - 1).abs()
    # measured 1.9e-7, 5.2e-7 where alpha can still reach the cut, 3.8e-6
    assert float(error[x < 3].max()) < 3e-7 and float(error[x < 12].max()) < 6e-7 and float(error.max()) < 1e-5
    assert bool((found[x > 152.5].double() == 2.0**-110).all())
