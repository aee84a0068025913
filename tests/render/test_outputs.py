"""What a call gives: every output with its gradients, channels, projected means, torch's transforms."""

import copy
import dataclasses
import functools
import gc
import itertools
import pickle
import subprocess
import sys

import numpy as np
import pytest
import torch

from tests.gaussians import LENSES, SMOOTH, camera, cloud, hand_placed, leaves, lens_camera, of_kind
from tests.tolerances import close
from warpgs.compat import gsplat
from warpgs.errors import UsageError
from warpgs.render.graphed import MIN_CALLS
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Render

OUTPUTS = [f.name for f in dataclasses.fields(Render) if f.name not in ("absgrad", "overflow")]
DIFFERENTIABLE = ("rgb", "alpha", "depth", "features", "projected")
WHOLE_NUMBERS = ("tile_counts", "heaviest_ids", "blend_counts")


@pytest.mark.parametrize("most", [None, 60], ids=["whole", "chunks"])
@pytest.mark.parametrize("name", [*OUTPUTS, "means2d"])
def test_a_gradient_reaches_the_gaussians_or_is_refused(device, name, most):
    """Alone, and beside an image that has one; what has none can be detached, and is plain where autograd is off."""
    gaussians, cam = leaves(cloud(60, device=device)), camera(40, 24, dtype=torch.float32, device=device)
    options = RasterizeOptions(
        features=torch.ones(60, 2, device=device), contributions=True, median_depth=True, heaviest=2, error_bound=True,
        max_instances=most,
    )  # fmt: skip
    render = rasterize(gaussians, cam, options)
    values = getattr(render, name)
    if name in WHOLE_NUMBERS:
        assert values.dtype == torch.int32
        return
    assert values.requires_grad and bool(values.any())
    if name in DIFFERENTIABLE:
        values.sum().backward()
        assert bool(gaussians.means.grad.any())
        return
    with pytest.raises(RuntimeError if name == "means2d" else UsageError, match=rf"{name} (has|passes) no gradient"):
        (render.rgb.sum() + values.sum()).backward()
    (render.rgb.sum() * values.detach().sum()).backward()
    assert bool(gaussians.means.grad.any())
    with torch.no_grad():
        plain = getattr(rasterize(gaussians, cam, options), name)
    assert not plain.requires_grad and torch.equal(plain, values)


SIZE = (75, 53)  # no multiple of a tile


def random(*shape, seed=0, dtype=torch.float32, device="cpu"):
    return (3 * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)).to(device, dtype)


def scene(dtype, device, channels):
    how = {"dtype": dtype, "device": device}
    values, behind = random(400, channels, **how), random(2, channels, seed=1, **how)
    return cloud(400, dtype, device), camera(*SIZE, cameras=2, **how), values, behind


def test_features_beside_colors_change_nothing_of_them(device):
    """Colours keep their bits, features are the image of a call with them as colours, and gradients are the sum of both."""
    gaussians, cam, values, behind = scene(torch.float32, device, 5)
    plain = rasterize(gaussians, cam)
    alone = rasterize(gaussians, cam, RasterizeOptions(colors=values, background=behind))
    options = RasterizeOptions(features=values, feature_background=behind)
    both = rasterize(gaussians, cam, options)
    assert plain.features is None and alone.rgb.shape == both.features.shape == (2, *SIZE[::-1], 5)
    for name in ("rgb", "alpha", "depth"):
        assert torch.equal(getattr(both, name), getattr(plain, name)), name
    assert torch.equal(both.features, alone.rgb) and bool((alone.rgb < 0).any())
    gradients = []
    for use in ((True, False), (False, True), (True, True)):
        g = leaves(gaussians)
        r = rasterize(g, cam, options)
        images = [image for image, used in zip((r.rgb, r.features), use) if used]
        gradients.append(torch.autograd.grad(sum(i.square().sum() for i in images), list(g.tensors().values())))
    for a, b, whole in zip(*gradients):
        assert float((a + b - whole).norm()) <= 1e-5 * float(whole.norm())


def test_wrong_channels_are_named():
    gaussians, cam, values, behind = scene(torch.float32, "cpu", 8)
    for kind, words, options in [
        (TypeError, "features must be a torch tensor, not ndarray", {"features": np.zeros((400, 8))}),
        (TypeError, r"colors is torch\.float64 but means is torch\.float32", {"colors": values.double()}),
        (ValueError, r"colors must have shape \[N, D\] \(N=400, C=2, D=8\), not \[399, 8\]", {"colors": values[1:]}),
        (ValueError, r"features must have shape \[C, N, D\]", {"features": values.expand(3, -1, -1)}),
        (ValueError, "features must have at least one channel", {"features": values[:, :0]}),
        (
            ValueError,
            r"background must have shape \[8\] or \[C, 8\], C=2, not \[3\]",
            {"colors": values, "background": behind[0, :3]},
        ),
        (ValueError, r"background must have shape \[3\] .*, not \[2, 8\]", {"features": values, "background": behind}),
        (ValueError, r"feature_background .*\[8\]", {"features": values, "feature_background": behind[:, :3]}),
    ]:
        with pytest.raises(kind, match=words):
            rasterize(gaussians, cam, RasterizeOptions(**options))


@pytest.mark.parametrize("what", ["colors", "background", "features", "feature_background"])
def test_leaves_render_where_autograd_is_off(what, device):
    """A learned background or feature shows the same image under no_grad, without a gradient."""
    gaussians, cam, values, behind = scene(torch.float32, device, 5)
    given = {"colors": values, "background": behind, "features": values, "feature_background": behind}
    wanted = rasterize(gaussians, cam, RasterizeOptions(**given))
    given[what] = given[what].clone().requires_grad_()
    with torch.no_grad():
        found = rasterize(gaussians, cam, RasterizeOptions(**given))
    assert torch.equal(found.rgb, wanted.rgb) and torch.equal(found.features, wanted.features)
    assert not found.rgb.requires_grad


def scalar(render):
    return render.rgb.square().sum() + render.alpha.square().sum() + 0.1 * render.depth.square().sum()


@pytest.mark.parametrize("colors", [None, 5], ids=["harmonics", "channels"])
def test_absgrad_sums_the_magnitude_of_each_pixels_gradient(device, colors):
    """Against one backward pass for each pixel, in float64; gradients stay the same."""
    gaussians, cam = leaves(hand_placed(device=device, degree=1)), camera(13, 11, cameras=2, device=device)
    values = None if colors is None else torch.randn(6, colors, generator=torch.Generator().manual_seed(0)).to(gaussians.means)
    found = []
    for absgrad in (False, True):
        r = rasterize(gaussians, cam, RasterizeOptions(absgrad=absgrad, colors=values))
        means2d = r.means2d
        v = torch.autograd.grad(scalar(r), list(gaussians.tensors().values()), retain_graph=True, allow_unused=True)
        found.append((means2d.grad, *(t for t in v if t is not None)))
    # on CUDA float64 takes five channels in two passes, magnitudes one: 143 pixels round by 2e-14 of the largest value at most
    error = 1e-13 if device.type == "cuda" and colors else 0.0
    assert all(float((a - b).abs().max()) <= error * float(a.abs().max()) for a, b in zip(*found))
    absgrad, images = means2d.absgrad, [r.rgb, r.alpha, r.depth]  # before further passes add to it
    upstream = torch.autograd.grad(scalar(r), images, retain_graph=True)
    total = torch.zeros_like(means2d)
    for y in range(11):
        for x in range(13):
            one = [torch.zeros_like(v) for v in upstream]
            for v, whole in zip(one, upstream):
                v[:, y, x] = whole[:, y, x]
            total += torch.autograd.grad(images, r.projected, one, retain_graph=True)[0][..., :2].abs()
    assert float((absgrad - total).norm()) <= 1e-12 * float(total.norm())  # measured: 3e-16
    assert bool((absgrad > 1.5 * found[1][0].abs()).any())  # signs cancel in the plain sum


@pytest.mark.parametrize(
    "options", [{"max_instances": 60}, {"tile_size": 8}, {"deterministic": False}], ids=lambda o: next(iter(o))
)
def test_absgrad_does_not_depend_on_how_it_is_rendered(device, options):
    """In chunks, by other tiles, and by atomic sums on CUDA."""
    gaussians, cam = cloud(200, device=device), camera(75, 53, dtype=torch.float32, device=device)
    found = []
    for more in ({}, options):
        r = rasterize(leaves(gaussians), cam, RasterizeOptions(absgrad=True, **more))
        means2d = r.means2d
        scalar(r).backward()
        found.append(means2d.absgrad)
    assert float((found[0] - found[1]).norm()) <= 1e-5 * float(found[0].norm())


def test_a_render_prints_shapes():
    text = repr(rasterize(cloud(5), camera(40, 24, dtype=torch.float32)))
    assert text.startswith("Render(rgb=[24, 40, 3], alpha=[24, 40]") and len(text) < 200


def native_call(device, **options):
    render = rasterize(
        leaves(cloud(50, device=device)), camera(40, 24, dtype=torch.float32, device=device), RasterizeOptions(**options)
    )
    return [render.rgb, render.means2d, *(getattr(render, name) for name in OUTPUTS)]


def gsplat_call(device, **arguments):
    given, cam = leaves(cloud(50, device=device)), camera(40, 24, dtype=torch.float32, device=device)
    tensors = given.means, given.quats, given.log_scales.exp(), given.logit_opacities.sigmoid(), given.sh
    poses = (torch.as_tensor(t, device=device)[None] for t in (cam.viewmat, cam.K))
    images, alphas, meta = gsplat.rasterization(*tensors, *poses, cam.width, cam.height, sh_degree=0, **arguments)
    meta["means2d"].retain_grad()
    return [images, alphas, *(meta[name] for name in meta)]


@pytest.mark.parametrize("backward", [True, False], ids=["backward", "dropped"])
@pytest.mark.parametrize(
    "call",
    [
        native_call,
        functools.partial(native_call, absgrad=True, max_instances=60),
        functools.partial(native_call, median_depth=True, contributions=True, heaviest=2, error_bound=True),
        functools.partial(gsplat_call, packed=True, render_mode="RGB+ED"),
        functools.partial(gsplat_call, packed=False, absgrad=True),
        functools.partial(gsplat_call, packed=False, radius_clip=1.0),
    ],
    ids=["native", "chunks", "outputs", "gsplat-packed", "gsplat", "gsplat-clip"],
)
def test_a_call_leaves_no_tensor_behind(call, backward, device):
    """Memory of a loop does not grow: a hook or a node that held its own graph would never be freed."""

    def tensors():
        gc.collect()
        return [t for t in gc.get_objects() if issubclass(type(t), torch.Tensor)]

    def run():
        results = call(device)
        if backward:
            results[0].sum().backward()

    for _ in range(MIN_CALLS + 2):  # caches fill, and CUDA captures its graphs
        run()
    before = tensors()
    known = {id(t) for t in before}
    for _ in range(3):
        run()
    assert [t.shape for t in tensors() if id(t) not in known] == []


def test_a_strategy_holds_the_projected_means():
    """``retain_grad`` and ``grad`` work as in the graph; two backward passes add up; ``absgrad`` is there only on request."""
    r = rasterize(leaves(cloud(50)), camera(dtype=torch.float32))
    means2d = r.means2d
    means2d.retain_grad()
    r.projected.retain_grad()
    assert means2d.shape == (1, 50, 2) and means2d is r.means2d and means2d.grad is None
    r.rgb.sum().backward(retain_graph=True)
    once = means2d.grad.clone()
    r.rgb.sum().backward()
    assert bool(once.any()) and torch.equal(means2d.grad, 2 * once) and torch.equal(means2d.grad, r.projected.grad[..., :2])
    assert not hasattr(means2d, "absgrad")
    assert torch.equal(means2d.detach(), r.projected.detach()[..., :2])
    # a render that was not read yet may be read after a pass through another one
    gaussians, cam = leaves(cloud(50)), camera(dtype=torch.float32)
    r, other = rasterize(gaussians, cam), rasterize(gaussians, cam)
    r.rgb.sum().backward()
    for _ in range(2):
        with pytest.raises(UsageError, match=r"read render\.means2d before the backward pass"):
            _ = r.means2d
    means2d = other.means2d
    other.rgb.sum().backward()
    assert bool(means2d.grad.any()) and other.means2d is means2d
    # means are plain tensors in other operations
    for options in (RasterizeOptions(), RasterizeOptions(absgrad=True)):
        means2d = rasterize(leaves(cloud(5)), camera(dtype=torch.float32), options).means2d
        with pytest.raises(AttributeError, match=r"RasterizeOptions\(absgrad=True\) and a backward pass"):
            _ = means2d.absgrad
        with pytest.raises(AttributeError, match="has no attribute 'other'"):
            _ = means2d.other
        assert type(means2d + 1) is type(means2d.detach()) is torch.Tensor
    # magnitudes of several passes do not add up to that of their sum
    gaussians, cam = cloud(5), camera(dtype=torch.float32)
    for options in ({"features": torch.ones(5, 2)}, {"colors": torch.ones(5, 12)}):
        with pytest.raises(UsageError, match="absgrad takes at most 11 channels of colors and no features"):
            rasterize(gaussians, cam, RasterizeOptions(absgrad=True, **options))


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.filterwarnings("error")
def test_means_can_be_copied_and_pickled(absgrad):
    """Before and after the backward pass. A copy has memory of its own; like any tensor, a pickled one leaves out ``grad``."""
    gaussians, cam = leaves(hand_placed()), camera(13, 11)
    render = rasterize(gaussians, cam, RasterizeOptions(absgrad=absgrad))
    means2d = render.means2d
    for backward in (False, True):
        if backward:
            render.rgb.sum().backward()
        copied, loaded = copy.deepcopy(means2d), pickle.loads(pickle.dumps(means2d))
        for other in (copied, loaded):
            assert type(other) is type(means2d) and torch.equal(other, means2d) and other.data_ptr() != means2d.data_ptr()
            assert not other.requires_grad
            if absgrad and backward:
                assert torch.equal(other.absgrad, means2d.absgrad) and other.absgrad.data_ptr() != means2d.absgrad.data_ptr()
            else:
                with pytest.raises(AttributeError, match="absgrad"):
                    other.absgrad  # noqa: B018
        assert (copied.grad is not None) == backward
        assert not backward or (torch.equal(copied.grad, means2d.grad) and copied.grad.data_ptr() != means2d.grad.data_ptr())
    both = copy.deepcopy([means2d, means2d])
    assert both[0] is both[1]


def transforms_scene():
    gaussians, cam = leaves(cloud(30)), camera(dtype=torch.float32)

    def loss(means, options=None, linear=False):
        rgb = rasterize(dataclasses.replace(gaussians, means=means), cam, options or RasterizeOptions()).rgb
        return (rgb if linear else rgb.square()).mean()

    return gaussians, loss


@pytest.mark.parametrize("most", [None, 40], ids=["whole", "chunked"])
def test_tensors_of_another_shape_in_the_backward_pass_are_refused(most):
    """Autograd does not see ``.data`` replaced: the kernels would read and write beside the tensors."""
    for name in leaves(cloud(30)).tensors():
        gaussians = leaves(cloud(30))
        render = rasterize(gaussians, camera(dtype=torch.float32), RasterizeOptions(max_instances=most))
        tensor = getattr(gaussians, name)
        tensor.data = torch.rand(7, *tensor.shape[1:])
        with pytest.raises(RuntimeError, match=r"replaced between .*\[30.*, now .*\[7"):
            render.rgb.sum().backward()


@pytest.mark.parametrize(
    "options",
    [RasterizeOptions(), RasterizeOptions(max_instances=40), RasterizeOptions(colors=torch.ones(30, 4))],
    ids=["blend", "chunked", "channels"],
)
def test_a_second_derivative_is_refused(options):
    """A gradient penalty raises, whichever way it is taken, and never gives zero."""
    gaussians, loss = transforms_scene()
    ways = (lambda p: p.backward(), lambda p: torch.autograd.grad(p, gaussians.means))
    for second, linear in itertools.product(
        ways, (True, False)
    ):  # a linear loss has a gradient that does not depend on the image
        value = loss(gaussians.means, options, linear)
        (v,) = torch.autograd.grad(value, gaussians.means, create_graph=True)
        with pytest.raises(UsageError, match="no second derivatives: leave out create_graph=True"):
            second(v.square().sum())


def test_create_graph_changes_no_gradient_and_transforms_of_functions_are_refused():
    """torch.func cannot see into kernels; the error names the way that works."""
    gaussians, loss = transforms_scene()
    plain, graph = (torch.autograd.grad(loss(gaussians.means), gaussians.means, create_graph=c)[0] for c in (False, True))
    assert torch.equal(plain, graph.detach()) and bool(plain.any()) and graph.requires_grad
    means = gaussians.means.detach()
    calls = {
        "grad": lambda: torch.func.grad(loss)(means),
        "vmap": lambda: torch.func.vmap(loss)(means.expand(2, -1, -1)),
        "jacrev": lambda: torch.func.jacrev(loss)(means),
        "jvp": lambda: torch.func.jvp(loss, (means,), (means,)),
    }
    for call in calls.values():
        with pytest.raises(UsageError, match=r"torch\.func: use torch\.autograd.*a batch of cameras"):
            call()
    jacobian = torch.autograd.functional.jacobian(loss, means)  # the way that works
    assert torch.equal(jacobian, torch.autograd.grad(loss(gaussians.means), gaussians.means)[0])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of torch's own modules as they load
def test_compiled_functions_break_around_it():
    """torch.compile gives the same loss and gradient by a graph break; fullgraph is refused with the reason."""
    gaussians, loss = transforms_scene()
    plain = torch.autograd.grad(loss(2 * gaussians.means) * 3, gaussians.means)[0]
    compiled = torch.compile(lambda means: loss(2 * means) * 3, backend="eager")
    assert torch.equal(torch.autograd.grad(compiled(gaussians.means), gaussians.means)[0], plain)
    torch._dynamo.reset()
    whole = torch.compile(lambda means: loss(2 * means) * 3, backend="eager", fullgraph=True)
    with pytest.raises(torch._dynamo.exc.Unsupported, match="outside of compiled graphs: leave out fullgraph=True"):
        whole(gaussians.means)


@pytest.mark.slow
def test_the_compiler_is_not_loaded():
    """To load torch's compiler takes a second, which commands must not pay for it."""
    code = "import sys, warpgs.render.rasterize; sys.exit('torch._dynamo' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


MODELS = ["pinhole", *LENSES]
KINDS = ["stored", "activated", "covariances"]
EVERYTHING = {"contributions": True, "median_depth": True, "heaviest": 3, "error_bound": True}
"""Requests for all outputs that are not always there, but features."""
COMBINATIONS_DIFFERENTIABLE = ("rgb", "alpha", "depth", "features")
IMAGES = (*COMBINATIONS_DIFFERENTIABLE, "median_depth", "error_bound", "heaviest_ids", "heaviest_weights", "blend_counts")
COMBINATIONS_SIZE = (50, 37)


def tensors_of(gaussians) -> list[torch.Tensor]:
    return [getattr(gaussians, f.name) for f in dataclasses.fields(gaussians)]


def seen_by(model: str, width: int, height: int, **options) -> Camera:
    size = {"width": width, "height": height}
    return camera(**size, **options) if model == "pinhole" else lens_camera(model, **size, **options)


def some(*shape, like: torch.Tensor, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(like)


QUICK = {*itertools.product(["pinhole"], KINDS, (False, True)), *((model, "stored", False) for model in MODELS)}
CASES = [
    pytest.param(*case, marks=() if case in QUICK else pytest.mark.slow)
    for case in itertools.product(MODELS, KINDS, (False, True))
]


@pytest.mark.parametrize(("model", "kind", "antialiased"), CASES)
def test_gradcheck(device, model, kind, antialiased):
    given, cam = of_kind(kind, hand_placed(device=device, degree=1)), seen_by(model, 12, 11, device=device)
    own = tensors_of(given)
    others = [cam.viewmat, cam.K, some(3, like=cam.K), some(6, 2, like=cam.K, seed=1), some(2, like=cam.K, seed=2)]
    inputs = [*own, *(t.detach().clone().requires_grad_() for t in others)]

    def outputs(*tensors):
        viewmat, K, behind, features, behind_features = tensors[len(own) :]
        options = RasterizeOptions(
            rule=SMOOTH, antialiased=antialiased, background=behind, features=features, feature_background=behind_features
        )
        r = rasterize(type(given)(*tensors[: len(own)]), dataclasses.replace(cam, viewmat=viewmat, K=K), options)
        return r.rgb, r.alpha, r.depth, r.features, r.projected[..., :10]

    assert torch.autograd.gradcheck(outputs, inputs, eps=1e-6, atol=1e-6, rtol=1e-5, nondet_tol=0.0, fast_mode=True)


@pytest.mark.parametrize(
    ("model", "kind", "antialiased", "rule"),
    [
        *((m, "stored", False, "exact") for m in MODELS),
        *(("pinhole", k, True, rule) for k, rule in zip(KINDS, ("fast", "inria", "exact"))),
    ],
)
def test_windows_and_chunks_have_the_bits_of_every_output(device, dtype, model, kind, antialiased, rule):
    """In every image. Gradients are those of the whole image; in chunks, sums have another order."""
    given = of_kind(kind, cloud(200, dtype, device))
    cam = seen_by(model, *COMBINATIONS_SIZE, cameras=2, dtype=dtype, device=device)
    own = [some(200, 2, like=given.means), some(2, like=given.means, seed=1), torch.linspace(0.5, 1, 200).to(given.means)]
    options = RasterizeOptions(
        rule=rule, antialiased=antialiased, features=own[0].requires_grad_(), feature_background=own[1].requires_grad_(),
        opacity_factors=own[2], **EVERYTHING,
    )  # fmt: skip
    x, y, w, h = window = (16, 16, 34, 21)
    ways = {}, {"window": window}, {"max_instances": 60 if kind == "stored" else 1}, {"tile_size": 8}
    whole, part, chunked, small = (rasterize(given, cam, dataclasses.replace(options, **how)) for how in ways)
    assert int(whole.tile_counts.sum()) > 120 and (rule == "fast" or float(whole.error_bound.detach().median()) < 1e-5)
    for name in IMAGES:
        crop = getattr(whole, name)[:, y : y + h, x : x + w]
        assert torch.equal(getattr(part, name), crop) and bool(crop.any()), name
        assert torch.equal(getattr(chunked, name), getattr(whole, name)), name
        assert rule == "inria" or torch.equal(getattr(small, name), getattr(whole, name)), name
    assert torch.equal(chunked.weight_maxima, whole.weight_maxima)
    close("image", chunked.weight_sums, whole.weight_sums)
    leaves_of = [*tensors_of(given), *own[:2]]
    gradients = []
    for r, (i, j) in ((whole, (y, x)), (part, (0, 0)), (chunked, (y, x))):
        crops = [getattr(r, n)[:, i : i + h, j : j + w] for n in COMBINATIONS_DIFFERENTIABLE]
        loss = sum((c * some(*c.shape, like=c)).sum() for c in crops)
        gradients.append(torch.autograd.grad(loss, leaves_of))
    for a, b, c in zip(*gradients):
        close("gradient", b, a)
        close("gradient", c, a)


@pytest.mark.cuda
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("model", MODELS)
def test_cpu_equals_cuda(model, kind):
    """Every output and gradient in float32 on CUDA against float64 on the CPU, where no threshold is near."""
    found = []
    for device, dtype in (("cpu", torch.float64), ("cuda:0", torch.float32)):
        given = of_kind(kind, hand_placed(dtype, device, degree=1))
        cam = seen_by(model, 33, 21, cameras=2, dtype=dtype, device=device)
        features = some(6, 5, like=given.means).requires_grad_()
        options = RasterizeOptions(rule=SMOOTH, features=features, antialiased=True, **(EVERYTHING | {"error_bound": False}))
        r = rasterize(given, cam, options)
        loss = sum((i * some(*i.shape, like=i)).sum() for i in (getattr(r, n) for n in COMBINATIONS_DIFFERENTIABLE))
        named = {n: getattr(r, n).detach().cpu().double() for n in IMAGES if n != "error_bound"}
        named |= {n: getattr(r, n).detach().cpu().double() for n in ("weight_sums", "weight_maxima")}
        found.append((named, [v.cpu().double() for v in torch.autograd.grad(loss, [*tensors_of(given), features])]))
    for name, wanted in found[0][0].items():
        other = found[1][0][name]
        if name in ("median_depth", "heaviest_ids", "heaviest_weights", "blend_counts"):  # rounding may decide a pixel
            assert float(((other - wanted).abs() > 1e-4).double().mean()) < 5e-3, name
        else:
            assert float((other - wanted).norm()) < 1e-5 * float(wanted.norm()), name
    for a, b in zip(found[0][1], found[1][1]):
        assert float((a - b).norm()) < 1e-4 * float(a.norm())
