"""Options and rules: checked where they are made, named after other programs, chosen by error, with a true bound."""

import dataclasses
import inspect
import math
import re

import numpy as np
import pytest
import torch

import warpgs
from tests.gaussians import LENSES, camera, cloud, lens_camera
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference
from tools.run_docs import ROOT
from warpgs import RasterizeOptions, Rule, rasterize
from warpgs.compat.gsplat import rasterization
from warpgs.constants import RULES
from warpgs.errors import UsageError
from warpgs.render.options import SWITCHES, WHOLE_NUMBERS
from warpgs.render.rasterize import FASTEST_FIRST, select_rule
from warpgs.render.reference import reference_image
from warpgs.scene import C0, Camera, Gaussians


@pytest.mark.parametrize(
    "field, values",
    {
        "alpha_cut": (-1, 1, math.nan, "0.1"),
        "alpha_max": (0, 1, 1 - 2.0**-25, 1.01, 2, math.nan, None),
        "transmittance_stop": (-0.1, 1, 2, math.nan),
        "low_pass": (-1, math.nan, math.inf, "0.1"),
        "square_sigma": (-1, math.nan, math.inf),
        "inclusive_stop": ("no", 1),
        "near": ("0.1",),
        "far": ("10",),
    }.items(),
)
def test_a_rule_checks_its_cut_offs(field, values):
    for value in values:
        with pytest.raises(UsageError, match=rf"Rule .*{field} must be .*{value}"):
            Rule("own", **{field: value})
    assert Rule("own", alpha_cut=0, transmittance_stop=0.0, low_pass=np.float32(0)).low_pass == 0


def test_options_are_checked_where_they_are_made():
    """Types, ranges, and options that exclude each other; numpy's numbers are numbers."""
    pixels = torch.zeros(1, 2, dtype=torch.int64)
    wrong = [
        *((f"{n} must be True or False, not {v!r}", {n: v}) for n in SWITCHES for v in ("no", 1, None)),
        *((f"{n} must be a whole number, not {v!r}", {n: v}) for n in WHOLE_NUMBERS for v in ("1", 1.5, True)),
        *((f"{n} must be a whole number, not None", {n: None}) for n in ("tile_size", "heaviest")),
        *((f"{n} must be at least 0, not -1", {n: -1}) for n in ("sh_degree", "memory_budget", "capacity", "heaviest")),
        *((f"{n} must be a number, not {v!r}", {n: v}) for n in ("near", "far") for v in ("1", True, [1.0])),
        *((f"window must be four whole numbers, not {v!r}", {"window": v}) for v in ((0, 0, 16), (0.0, 0, 16, 16), "0 0", 16)),
        ("unknown rule 'best': choose one of exact, balanced, fast, gsplat-1", {"rule": "best"}),
        ("tile size 12 is not one of 8, 16", {"tile_size": 12}),
        ("max_instances must be at least 1", {"max_instances": 0}),
        ("max_instances must be at least 1", {"max_instances": 10, "capacity": 100}),
        ("capacity must be at most 1,073,741,823, not 1,073,741,824", {"capacity": 2**30}),
        ("error_bound and capacity exclude each other", {"error_bound": True, "capacity": 1000}),
        ("feature_background requires features", {"feature_background": torch.zeros(8)}),
        *(
            ("pixels cannot be combined", {"pixels": pixels, n: v})
            for n, v in (("window", (0, 0, 16, 16)), ("contributions", True), ("capacity", 100))
        ),
    ]
    for words, options in wrong:
        with pytest.raises(UsageError, match=re.escape(words)):
            RasterizeOptions(**options)
    RasterizeOptions(near=np.float32(1), far=2, window=[np.int64(0), 0, 16, 16], capacity=2**30 - 1, absgrad=np.bool_(True))


def test_a_background_is_numbers_and_a_full_device_no_wrong_background(monkeypatch):
    """Words of the command line are no numbers; what fails on the device keeps its own error."""
    for value in ("white", ["a", "b", "c"], None.__class__, np.uint8([255, 255, 255])):
        with pytest.raises(TypeError, match=r"background must be numbers, 1.0 for white: \[3\] or \[C, 3\], not"):
            rasterize(cloud(1), camera(37, 30), RasterizeOptions(background=value))

    def full(*_, **__):
        raise torch.OutOfMemoryError("out of memory")

    g, cam = cloud(1), camera(37, 30)
    monkeypatch.setattr(torch.Tensor, "new_zeros", full)
    with pytest.raises(torch.OutOfMemoryError):
        rasterize(g, cam, RasterizeOptions())


BACKGROUND = torch.tensor([1.0, 0.5, 0.0])


def cameras(device) -> list[Camera]:
    both = camera(50, 34, cameras=2, dtype=torch.float32, device=device)
    return [dataclasses.replace(both, viewmat=v, K=k) for v, k in zip(both.viewmat, both.K)]


@pytest.mark.parametrize(("measure", "reduce"), [("mean", torch.mean), ("max", torch.amax)])
def test_the_fastest_rule_within_the_error(device, measure, reduce):
    """At the largest error over the views a rule is chosen, just below it the next one; below float32 none is."""
    g, views = cloud(300, device=device), cameras(device)
    for number, rule in enumerate(FASTEST_FIRST):
        options = RasterizeOptions(rule=rule, background=BACKGROUND, error_bound=True)
        error = max(float(reduce(rasterize(g, c, options).error_bound)) for c in views)
        given = {"measure": measure, "options": RasterizeOptions(background=BACKGROUND)}
        assert select_rule(g, iter(views), max_error=error, **given) == (rule, error)
        if number < 2:
            slower, less = select_rule(g, views, max_error=0.99 * error, **given)
            assert slower == FASTEST_FIRST[number + 1] and 0 < less < error
        else:
            with pytest.raises(UsageError, match=rf"rounding alone gives a {measure} error of"):
                select_rule(g, views, max_error=0.99 * error, **given)


def test_haze_keeps_the_exact_rule(device):
    """Layers of 1.9/255 are seen under `exact` alone, so an error that a usual scene keeps with `fast` chooses `exact`."""
    g = cloud(300, device=device)
    haze = dataclasses.replace(
        g, log_scales=g.log_scales + 5, logit_opacities=torch.logit(torch.full_like(g.logit_opacities, 1.9 / 255))
    )
    assert warpgs.select_rule(g, cameras(device), max_error=0.05)[0] == "fast"
    assert warpgs.select_rule(haze, cameras(device), max_error=0.05)[0] == "exact"


@pytest.mark.parametrize("error", [0.0, -1.0, float("nan"), float("inf"), "0.1"])
def test_wrong_arguments(error):
    g, views = cloud(1), cameras("cpu")
    with pytest.raises(UsageError, match="positive number"):
        select_rule(g, views, max_error=error)
    with pytest.raises(UsageError, match="measure 'median' is not one of mean, max"):
        select_rule(g, views, max_error=0.1, measure="median")
    with pytest.raises(UsageError, match="at least one camera"):
        select_rule(g, [], max_error=0.1)
    with pytest.raises(UsageError, match=r"list of at least one camera: \[camera\]"):
        select_rule(g, views[0], max_error=0.1)


USUAL = {"alpha_cut": 1 / 255, "transmittance_stop": 1e-4, "inclusive_stop": False, "low_pass": 0.3}
PROGRAMS = {
    # include/Common.h: MAX_ALPHA, GAUSSIAN_EXTEND, of 3.33 sigma, which never binds; rendering.py: near_plane
    "gsplat-1.6": Rule("own", alpha_max=0.99, near=0.01, **USUAL),
    # csrc/RasterizeToPixels3DGSFwd.cu, csrc/ProjectionEWA3DGSFused.cu
    "gsplat-1.5": Rule("own", alpha_max=0.999, near=0.01, **USUAL),
    # forward.cu, auxiliary.h of diff-gaussian-rasterization
    "inria": Rule("own", alpha_max=0.99, near=0.2, square_sigma=3.0, **USUAL),
}
"""Constants of programs, copied here as numbers so that a change of `RULES` is noticed."""


def image_of(gaussians: Gaussians, cam, program: Rule) -> torch.Tensor:
    """Return the image [H, W, 3] over black."""
    tensors = [t.double() for t in gaussians.tensors().values()]
    size = {"width": cam.width, "height": cam.height}
    projected = project_reference(*tensors, cam.viewmat[None], cam.K[None], **size, degree=1, low_pass=program.low_pass)
    means, covs, colors, depths, opacities = (t[0] if t.ndim > 1 else t for t in projected)
    return blend_reference(means, covs, opacities, colors, depths, torch.zeros(3).double(), *size.values(), program)[0]


def crowd() -> Gaussians:
    """Opaque layers at every depth from 0.05 u on, so that clamp, stop and near plane all decide."""
    g = cloud(250, torch.float64, seed=5)
    depths = torch.linspace(0.05, 6, len(g), dtype=torch.float64)
    means = g.means * depths[:, None] / g.means[:, 2:]
    return Gaussians(means, g.quats, g.log_scales + 0.5 + (depths / 4).log()[:, None], 3 * g.logit_opacities + 3, g.sh)


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
    with pytest.raises(UsageError, match=r"'gsplat' needs a version.*choose gsplat-1\.6 or gsplat-1\.5$"):
        rasterize(cloud(1), camera(), RasterizeOptions(rule="gsplat"))
    assert {n for n in RULES if n.startswith("gsplat")} == {n for n in PROGRAMS if n.startswith("gsplat")}


KINDS = ("random", "haze", "needles", "far", "huge", "opaque", "close", "at cuts", "bright", "displaced")
"""Kinds of scenes; scene n has kind n modulo their count."""
WIDTH, HEIGHT = 24, 20


def bound_scene(number: int) -> tuple[str, Gaussians, Camera, torch.Tensor]:
    """Return kind, Gaussians, camera and background of a scene in float32; up to 200 Gaussians, 24 x 20 px."""
    kind, generator = KINDS[number % len(KINDS)], torch.Generator().manual_seed(number)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator)

    count = int(200 ** float(rand(1))) if kind != "haze" else 200
    depths = 1 + 5 * rand(count)
    means = torch.cat([(rand(count, 2) - 0.5) * depths[:, None], depths[:, None]], 1)
    log_scales, opacities = torch.log(0.02 + 0.3 * rand(count, 3)), 0.02 + 0.97 * rand(count)
    sh = rand(count, 4, 3) - 0.5
    viewmat = torch.eye(4)
    if kind == "haze":  # layers that every pixel has hundreds of, each near the cut of a rule
        log_scales, opacities = torch.full((count, 3), 2.0), (0.9 + 3.2 * rand(1)) / 255 * (1 + 0.05 * rand(count))
    elif kind == "needles":
        log_scales = torch.log(torch.tensor([2.0, 1e-4, 1e-4]) * (0.1 + rand(count, 3)))
    elif kind == "far":
        means, log_scales = means * 1000, log_scales + 6
    elif kind == "huge":
        log_scales = log_scales + 8
    elif kind == "opaque":
        opacities = 1 - 1e-3 * rand(count) ** 3
    elif kind == "close":  # about the near planes of the rules
        near = 0.005 + 0.3 * rand(count, 1)
        means, log_scales = means / means[:, 2:] * near, log_scales - 3
    elif kind == "at cuts":  # within rounding of one, two and four 255ths at their centres
        steps = 2.0 ** torch.randint(3, (count,), generator=generator)
        log_scales, opacities = log_scales + 1, steps / 255 * (1 + 4e-7 * (rand(count) - 0.5))
    elif kind == "bright":
        sh = 30 * sh
    elif kind == "displaced":  # what float32 stores of a place 1000 u from the origin
        means, viewmat[:3, 3] = means + 1000, -1000.0
    gaussians = Gaussians(means, rand(count, 4) - 0.5, log_scales, torch.logit(opacities).clamp_max(16), sh)
    K = torch.tensor([[WIDTH, 0, WIDTH / 2], [0, WIDTH, HEIGHT / 2], [0, 0, 1.0]])
    return kind, gaussians, Camera(viewmat, K, WIDTH, HEIGHT), rand(3)


def error_and_bound(number: int, device, rule) -> tuple[torch.Tensor, torch.Tensor]:
    _, g, cam, background = bound_scene(number)
    truth = reference_image(g, cam, (0, 0, WIDTH, HEIGHT), background, 1)
    on_device = Gaussians(**{n: t.to(device) for n, t in g.tensors().items()})
    r = rasterize(on_device, cam, RasterizeOptions(rule=rule, background=background, error_bound=True))
    return (r.rgb.double().cpu() - truth).abs().amax(-1), r.error_bound.double().cpu()


def bounds(number: int, device) -> None:
    """Assert that the bounds of all rules hold in a scene, and are close where the cut-offs cost something."""
    for rule in (*RULES, Rule("own", alpha_cut=0.02, alpha_max=0.9, transmittance_stop=0.1, near=0.4, low_pass=0.5)):
        error, bound = error_and_bound(number, device, rule)
        assert bool((error <= bound).all()), (number, rule)
        # the rounding of float64 is 2e-9 of the largest colour, here at most 30, and float32 rounds a bound of 1 by 1.2e-7
        assert bool((bound <= error * (1 + 3e-7) + 6e-8).all()), (number, rule)


def test_the_bound_holds_and_is_tight(device):
    """Two scenes of each kind, under every rule and one that differs in everything."""
    for number in range(2 * len(KINDS)):
        bounds(number, device)


def test_channels_have_a_bound_too(device):
    """Of a scene with everything that a bound may go with, and of none."""
    g, cam = cloud(300, device=device), camera(50, 34, cameras=2, dtype=torch.float32, device=device)
    g.means.requires_grad_()
    colors = torch.rand(300, 5, device=device)
    options = RasterizeOptions(
        rule="fast", error_bound=True, colors=colors, features=colors, background=colors[0], opacity_factors=colors[:, 0]
    )
    found = rasterize(g, cam, options)
    exact = rasterize(g, cam, dataclasses.replace(options, rule="exact", error_bound=False))
    off = (found.rgb - exact.rgb).detach().abs().amax(-1)
    # the reference is float64, this exact render float32: measured 4e-8 on average
    assert float(off.max()) > 1e-3 and float((found.error_bound.detach() - off).abs().mean()) < 1e-6
    none = Gaussians(**{n: t[:0] for n, t in g.tensors().items()})
    assert float(rasterize(none, cam, RasterizeOptions(error_bound=True)).error_bound.detach().max()) < 1e-30
    assert not options.repeatable() and exact.error_bound is None


IMAGE_RULES = ("exact", "balanced", "fast")
"""Rules under which images may have a largest error."""


def stacked(opacities, colors, device, dtype=torch.float32) -> tuple[Gaussians, Camera]:
    """Flat layers [L] over a whole image of 50 x 34 px, front to back, with grey colours."""
    count, how = len(opacities), {"dtype": dtype, "device": device}
    means = torch.tensor([[0.0, 0.0, 2.0 + i] for i in range(count)], **how)
    sh = ((torch.tensor(colors, **how) - 0.5) / C0)[:, None, None].expand(count, 1, 3).contiguous()
    quats = torch.tensor([[1.0, 0, 0, 0]], **how).expand(count, 4).contiguous()
    flat = torch.full((count, 3), 6.0, **how)
    gaussians = Gaussians(means, quats, flat, torch.logit(torch.tensor(opacities, **how)), sh)
    return gaussians, camera(50, 34, dtype=dtype, device=device)


def off_and_bound(g, cam, options, error):
    """Return the error of an image with ``max_error`` and its bound, shape [..., H, W] each, after checks of its form."""
    fine, coarse = rasterize(g, cam, options), rasterize(g, cam, dataclasses.replace(options, max_error=error))
    off, bound = (coarse.rgb - fine.rgb).abs().amax(-1), coarse.error_bound
    assert fine.error_bound is None and bound.shape == coarse.alpha.shape and bool((off <= bound).all())
    return off, bound


def composited(projected, background, rule, width, height) -> torch.Tensor:
    """Return the image [H, W, 3] of projected Gaussians [N, 12] with the cut-offs of a rule."""
    seen = projected[projected[:, 5] > 0]
    factors = torch.stack([seen[:, 2], seen[:, 3], torch.zeros_like(seen[:, 2]), seen[:, 4]], -1).view(-1, 2, 2)
    covs = torch.linalg.inv(factors.mT @ factors)
    return blend_reference(seen[:, :2], covs, seen[:, 5], seen[:, 6:9], seen[:, 9], background, width, height, rule)[0]


@pytest.mark.parametrize("rule", IMAGE_RULES)
def test_images_within_an_error_keep_their_bound(device, rule):
    """Every pixel of hard scenes: layers without number, needles, opaque fronts, alphas at the cuts, colours up to 30."""
    for number in range(2 * len(KINDS)):
        kind, g, cam, background = bound_scene(number)
        g = Gaussians(**{n: t.to(device) for n, t in g.tensors().items()})
        for error in (1e-5, 1 / 255, 0.05):
            _, bound = off_and_bound(g, cam, RasterizeOptions(rule=rule, background=background), error)
            least = 5e-3 if rule == "fast" else 2e-3 if rule == "balanced" else 1e-3  # rounding, and four stops
            assert kind == "bright" or float(bound.max()) <= max(error, 3 * least), (number, error)


def test_images_within_an_error_beside_a_reference():
    """In float64, pixel by pixel, with two cameras, each lens, antialiasing and empty pixels before wild backgrounds."""
    behind = torch.tensor([[-0.5, 2.0, 0.0], [1.0, 0.0, 0.3]], dtype=torch.float64)
    g, worst = cloud(150, torch.float64), 0.0
    places = g.means * torch.tensor([0.3, 0.3, 1.0])
    g = dataclasses.replace(g, means=places, log_scales=g.log_scales + 0.5, logit_opacities=g.logit_opacities + 3)
    for model in ("pinhole", *LENSES):
        size = {"width": 37, "height": 35, "cameras": 2}  # three tiles a row, whose borders cut Gaussians
        cam = camera(**size) if model == "pinhole" else lens_camera(model, **size)
        for rule in IMAGE_RULES:
            given = RasterizeOptions(rule=rule, background=behind, antialiased=True, max_error=0.02)
            r = rasterize(g, cam, given)
            for i in range(2):
                truth = composited(r.projected[i], behind[i], RULES[rule], 37, 35)
                off = (r.rgb[i] - truth).abs().amax(-1)
                assert bool((off <= r.error_bound[i]).all()) and bool((r.alpha[i] == 0).any())
                worst = max(worst, float((off / r.error_bound[i]).max()))
    assert worst > 0.3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_error_is_used_up(device, dtype):
    """A black front just opaque enough, and white behind; a finished pixel may not count what lies far behind it."""
    opacities, colors = (0.5, 0.5, 0.5, 0.224, *[0.99] * 4), (*[0.0] * 4, *[1.0] * 4)  # CUDA tests every fourth layer
    g, cam = stacked(opacities, colors, device, dtype)
    off, bound = off_and_bound(g, cam, RasterizeOptions(), 0.05)
    assert 0.95 * float(bound.min()) <= float(off.min()) and float(bound.max()) <= 0.05
    dark = rasterize(*stacked([0.3] * 8, [0.0] * 8, device, dtype), RasterizeOptions(max_error=1.0))
    assert float(dark.alpha.min()) >= 0.5
    # in front of the stop of `exact` by a hair, then white, in the colours that halves round most, and colours that none holds
    for opacities, rule in (((0.99, 0.95, 0.82, 0.99, 0.99), "exact"), ((0.9, 0.9, 0.91, 0.99, 0.99), "fast")):
        for scale in (1.0, 3000.0, 1e5):
            colors = tuple(scale * c for c in (0.99976, 0.99976, 0.99976, 1.0, 1.0))
            off_and_bound(*stacked(opacities, colors, device, dtype), RasterizeOptions(rule=rule), 1e-5)


def test_an_error_is_for_images_alone(device):
    for value in (0, -1.0, math.nan, math.inf, True, "0.1"):
        with pytest.raises(UsageError, match="max_error must be a positive number"):
            RasterizeOptions(max_error=value)
    given = dict.fromkeys(("contributions", "median_depth", "error_bound", "absgrad"), True)
    given |= {"heaviest": 2, "max_instances": 9, "colors": torch.zeros(3, 2), "features": torch.zeros(3, 2)}
    for name, value in given.items():
        with pytest.raises(UsageError, match=f"max_error and {name} exclude each other"):
            RasterizeOptions(max_error=0.01, **{name: value})
    for rule in ("gsplat-1.6", "inria", Rule("own", alpha_cut=0.0), Rule("own", transmittance_stop=0.01)):
        with pytest.raises(UsageError, match=r"max_error does not support rule .*: choose exact, balanced or fast"):
            RasterizeOptions(max_error=0.01, rule=rule)
    g, cam = cloud(30, device=device), camera(dtype=torch.float32, device=device)
    options = RasterizeOptions(max_error=1 / 255, background=torch.zeros(3, device=device))
    for holder, name in ((g, "means"), (cam, "viewmat"), (options, "background")):
        learned = dataclasses.replace(holder, **{name: getattr(holder, name).clone().requires_grad_()})
        given = [learned if own is holder else own for own in (g, cam, options)]
        with pytest.raises(UsageError, match=r"max_error renders without gradients: call rasterize under torch\.no_grad"):
            rasterize(*given)
        with torch.no_grad():
            r = rasterize(*given)
        assert not r.rgb.requires_grad and r.error_bound is not None
    shown = RasterizeOptions().for_display(g)
    assert shown.max_error == (1 / 255 if device.type == "cuda" else None)
    none = Gaussians(**{n: t[:0] for n, t in g.tensors().items()})
    r = rasterize(none, cam, dataclasses.replace(options, background=torch.ones(3, device=device)))
    assert bool((r.rgb == 1).all()) and float(r.error_bound.max()) <= 1 / 255


@pytest.mark.cuda
def test_large_images_within_an_error():
    """Tiles of 32 px, windows that cut them, a batch, and calls by graphs; alphas keep the bits of a stop that is as late."""
    g = cloud(3000, device="cuda", seed=2)
    cam = camera(2432, 1900, cameras=2, dtype=torch.float32, device="cuda")
    behind = torch.tensor([[0.2, 1.5, 0.0], [1.0, 0.0, 0.7]], device="cuda")
    for window in (None, (32, 64, 2368, 1824), (16, 48, 2400, 1824)):
        options = RasterizeOptions(background=behind, window=window, record=False)
        off, bound = off_and_bound(g, cam, options, 1 / 255)
        assert float(off.max()) > 1e-3 and float(bound.max()) <= 1 / 255
        eager = rasterize(g, cam, dataclasses.replace(options, max_error=1 / 255)).rgb
        for _ in range(6):
            graphed = rasterize(g, cam, dataclasses.replace(options, max_error=1 / 255, record=True))
            assert torch.equal(graphed.rgb, eager) and torch.equal(graphed.error_bound, bound)
            del graphed


ARGUMENTS = """means quats scales opacities colors viewmats Ks width height near_plane far_plane radius_clip eps2d sh_degree
packed tile_size backgrounds render_mode sparse_grad absgrad rasterize_mode channel_chunk distributed camera_model segmented
covars
with_ut with_eval3d return_normals global_z_order rays radial_coeffs tangential_coeffs thin_prism_coeffs ftheta_coeffs
lidar_coeffs external_distortion_coeffs rolling_shutter viewmats_rs ut_params extra_signals extra_signals_sh_degree
renderer_config""".split()
"""Arguments of gsplat 1.6.0's rasterization, in its order."""


def test_the_page_on_gsplat_has_every_argument():
    table = (ROOT / "docs/coming-from-gsplat.md").read_text("utf-8").split("## Arguments")[1].split("## Results")[0]
    named = [name for row in table.splitlines()[4:] for name in re.findall(r"`(\w+)`", row.split("|")[1] if "|" in row else "")]
    assert set(named) == set(ARGUMENTS) and list(inspect.signature(rasterization).parameters) == ARGUMENTS
