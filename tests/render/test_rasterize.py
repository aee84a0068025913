"""The public op: shapes, gradients through everything, options, errors, antialiasing, near and far plane."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch

import warpgs
from tests.gaussians import LENSES, SMOOTH, camera, cloud, hand_placed, leaves, lens_camera
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference
from tests.scenes import ring, three_gaussians
from tests.tolerances import close
from warpgs.constants import ALPHA_CUT, FAR, LARGEST_ALPHA, RULES, Rule
from warpgs.errors import ResourceError, UsageError
from warpgs.kernels.tiles import BYTES_PER_INSTANCE
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.render.reference import reference_image
from warpgs.scene import ActivatedGaussians, Camera, CovarianceGaussians, Gaussians


def test_capacity_changes_nothing_but_says_when_it_is_too_small(device):
    """A larger capacity gives the same bits of images and gradients; one too small sets overflow, and nothing else breaks."""
    gaussians, cam = leaves(cloud(200, device=device)), camera(70, 50, dtype=torch.float32, device=device)
    results = []
    for capacity in (None, 5000):
        r = rasterize(gaussians, cam, RasterizeOptions(capacity=capacity))
        gradients = torch.autograd.grad(r.rgb.square().sum() + r.depth.sum(), list(gaussians.tensors().values()))
        results.append((r.rgb, r.depth, *gradients))
        assert (r.overflow is None) if capacity is None else int(r.overflow) == 0
    assert all(torch.equal(a, b) for a, b in zip(*results))
    cut = rasterize(gaussians, cam, RasterizeOptions(capacity=40))
    assert int(cut.overflow) == 1
    torch.autograd.grad(cut.rgb.sum(), list(gaussians.tensors().values()))


@pytest.mark.cuda
@pytest.mark.parametrize("size", [(96, 80), (1100, 1000)], ids=["small chunks", "large chunks"])
def test_native_kernels_agree_with_generic_ones(size):
    """Float32 bodies in CUDA against the generic kernels in float64, which pass gradcheck: each gradient within 1e-5."""
    device = torch.device("cuda", 0)
    gaussians, cam = leaves(cloud(2000, device=device)), camera(*size, dtype=torch.float32, device=device)
    weights = torch.rand(size[1], size[0], 5, generator=torch.Generator().manual_seed(1)).to(device)
    results = []
    for dtype in (torch.float32, torch.float64):
        tensors = {n: t.detach().to(dtype).requires_grad_() for n, t in gaussians.tensors().items()}
        view = Camera(cam.viewmat.to(dtype), cam.K.to(dtype), *size)
        r = rasterize(warpgs.Gaussians(**tensors), view, RasterizeOptions(rule=SMOOTH))
        images = torch.cat([r.rgb, r.alpha[..., None], r.depth[..., None]], -1)
        results.append((images.detach(), *torch.autograd.grad((images * weights).sum(), list(tensors.values()))))
    for a, b in zip(*results):
        assert float((a.double() - b).norm()) <= 1e-5 * float(b.norm())


def test_one_camera_has_no_leading_axis_and_errors_name_the_cause(device):
    gaussians, cam = cloud(50, device=device), camera(20, 12, dtype=torch.float32, device=device)
    single = rasterize(gaussians, cam)
    batch = rasterize(gaussians, dataclasses.replace(cam, viewmat=cam.viewmat[None], K=cam.K[None]))
    assert single.rgb.shape == (12, 20, 3) and single.alpha.shape == single.depth.shape == (12, 20)
    assert torch.equal(single.rgb, batch.rgb[0]) and single.visible.shape == (1, 50)
    plain = Camera(cam.viewmat.cpu().double().numpy(), cam.K.cpu().double().numpy(), 20, 12)
    assert isinstance(plain.viewmat, np.ndarray) and torch.equal(rasterize(gaussians, plain).rgb, single.rgb)
    with pytest.raises(ResourceError, match="raise the memory budget"):
        rasterize(gaussians, cam, RasterizeOptions(memory_budget=1))
    with pytest.raises(ValueError, match="at least 1 x 1"):
        rasterize(gaussians, Camera(cam.viewmat, cam.K, 0, 12))


def test_arguments_of_another_type_or_shape_are_named():
    """Before any work, on the CPU and on CUDA alike: nothing of it is read from the device."""
    gaussians, cam = cloud(3), camera(8, 8, dtype=torch.float32)
    skewed, large = np.array([[9.0, 0.1, 4], [0, 9, 4], [0, 0, 1]]), dataclasses.replace(cam, width=10**6, height=10**6)
    learned = RasterizeOptions(opacity_factors=torch.ones(3, requires_grad=True))
    fisheye = dataclasses.replace(cam, model="fisheye", distortion=torch.tensor(0.0))
    others, uncoloured = (torch.ones(1, 4), torch.ones(1, 3), torch.ones(1)), RasterizeOptions(colors=torch.ones(1, 3))

    def seen(camera=cam, **change):
        return gaussians, dataclasses.replace(camera, **change)

    def scene(**change):
        return dataclasses.replace(gaussians, **change), cam

    def of(dtype):
        return {n: t.to(dtype) for n, t in gaussians.tensors().items()}

    def asked(**options):
        return gaussians, cam, RasterizeOptions(**options)

    sparse = {"viewmat": torch.eye(4).to_sparse(), "K": torch.eye(3).to_sparse(), "distortion": torch.zeros(4).to_sparse()}
    two = dataclasses.replace(camera(8, 8, cameras=2, dtype=torch.float32), model="fisheye", distortion=torch.zeros(4))
    no_number = cam.K * torch.tensor([[torch.nan, 1, 1], [1, 1, 1], [1, 1, 1]])
    wrong = [
        (TypeError, "gaussians must be an instance of Gaussians, .* or CovarianceGaussians, not Camera", (cam, gaussians)),
        (TypeError, "options must be an instance of RasterizeOptions, not str", (gaussians, cam, "fast")),
        (TypeError, "means must be a tensor, not ndarray", scene(means=np.zeros((3, 3)))),
        (ValueError, r"camera.K must have shape \[3, 3\] or", seen(K=torch.eye(4))),
        (ValueError, r"camera.viewmat .*not \[3, 4\]", seen(viewmat=cam.viewmat[:3])),
        (ValueError, "camera.K must have the last row 0, 0, 1, not 0, 0, 2;", seen(K=2 * cam.K)),
        (ValueError, "camera.K has a skew of 0.1 px, which is not", seen(K=skewed)),
        (ValueError, "focal lengths other than 0, not 0 and 9", seen(K=skewed * [[0], [1], [1]])),
        (TypeError, "camera.K must be float32 or float64, not torch.float16", seen(K=cam.K.half())),
        (TypeError, "camera.viewmat must be a numpy array or a tensor, not list", seen(viewmat=[[1.0]])),
        (TypeError, "camera.K must be .*, not NoneType", seen(K=None)),
        (TypeError, "camera.distortion must be .*, not list", seen(distortion=[0.0])),
        (TypeError, "camera.K must be float32 or float64, not complex128", seen(K=1j * np.eye(3))),
        (ValueError, "camera.viewmat has non-finite values", seen(viewmat=np.full((4, 4), np.nan))),
        (UsageError, "unknown camera model None", seen(model=None)),
        *((TypeError, f"camera.{n} must be dense, not torch.sparse_coo", seen(**{n: t})) for n, t in sparse.items()),
        (ValueError, r"camera.distortion must have shape \[P\] or \[C, P\], not \[\]", (gaussians, fisheye)),
        (ValueError, r"camera\.K must .* \[2, 3, 3\].*, not \[3, 3, 3\]", seen(two, K=torch.eye(3).repeat(3, 1, 1))),
        (ValueError, r"camera\.K must .* \[1, 3, 3\].*viewmat.*, not \[2, 3, 3\]", seen(two, viewmat=torch.eye(4))),
        (ValueError, r"camera\.distortion must .* \[2, 4\].*, not \[3, 4\]", seen(two, distortion=torch.zeros(3, 4))),
        (TypeError, "background must be dense", asked(background=torch.ones(3).to_sparse())),
        (TypeError, "background must be numbers", asked(background=1j * torch.ones(3))),
        (TypeError, "pixels must be dense", asked(pixels=torch.tensor([[1, 2]]).to_sparse())),
        (TypeError, "colors must be a torch tensor, not list", asked(colors=[[1.0]])),
        (ValueError, r"colors must have shape \[N, D\]", asked(colors=torch.tensor(1.0))),
        (TypeError, "means must be a tensor, not list", (ActivatedGaussians([[0.0]], *others), cam, uncoloured)),
        (TypeError, "means must be a tensor, not list", (CovarianceGaussians([[0.0]], *others[1:]), cam, uncoloured)),
        (TypeError, "quats must be dense, not torch.sparse", scene(quats=gaussians.quats.to_sparse())),
        (ValueError, "camera.K has non-finite values", seen(K=no_number)),
        (ValueError, r"background must have shape \[3\] or \[C, 3\], C=1, not \[2, 3\]", asked(background=torch.zeros(2, 3))),
        (ValueError, r"colors \[3, 4, 3\] .* harmonics need sh_degree", asked(colors=torch.zeros(3, 4, 3))),
        *(
            (TypeError, f"means must be float32 or float64, not {t}; means.float", scene(**of(t)))
            for t in (torch.half, torch.int64)
        ),
        (UsageError, "give opacity_factors.detach", (gaussians, cam, learned)),
        (ResourceError, r"need 28,000,000,000,000 bytes, and [\d,]+ are free on cpu", (gaussians, large)),
        (TypeError, "camera.width must be a whole number of pixels, not 8.0", seen(width=8.0)),
        (ValueError, r"background .*not \[4\]", asked(background=torch.zeros(4))),
        (ValueError, r"K is 1, 4, 9, 16 or 25, not \[3, 5, 3\]", scene(sh=torch.zeros(3, 5, 3))),
    ]
    for kind, words, arguments in wrong:
        with pytest.raises(kind, match=words):
            rasterize(*arguments)


def test_opacity_factors_multiply_opacities_and_hide():
    gaussians, camera = three_gaussians(), ring(3)[0]
    factors = torch.tensor([0.5, 0.0, 1.0])
    opacities = gaussians.logit_opacities.sigmoid() * factors
    lower = dataclasses.replace(gaussians, logit_opacities=torch.logit(opacities))
    leaves = [t.clone().requires_grad_() for t in gaussians.tensors().values()]
    for most in (None, 4):
        options = RasterizeOptions(opacity_factors=factors, max_instances=most)
        render = rasterize(Gaussians(*leaves), camera, options)
        assert torch.allclose(render.rgb, rasterize(lower, camera).rgb, atol=1e-6)
        gradients = torch.autograd.grad(render.rgb.sum(), leaves)
        assert all(bool(v[0].any()) and not bool(v[1].any()) for v in gradients if v.shape != (3, 4))
    with pytest.raises(ValueError, match="opacity_factors"):
        rasterize(gaussians, camera, RasterizeOptions(opacity_factors=torch.ones(2)))


def test_a_pose_that_scales_or_shears_is_refused():
    """Also one camera of a batch, one that is not finite, and another last row. Rounding and a mirrored camera pass."""
    gaussians, cam = three_gaussians(), ring(3)[0]
    rotation, eye = cam.viewmat, np.eye(4)
    scaled, sheared, moved, unknown = 1.01 * rotation, rotation.copy(), rotation.copy(), rotation.copy()
    huge = 1e200 * rotation
    scaled[3, 3] = huge[3, 3] = 1
    sheared[0] += 0.01 * sheared[1]
    moved[3, 0] = 0.1
    unknown[1, 1] = np.nan
    for wrong, words in (
        (scaled, r"camera.viewmat\S* scales or shears: R R\^T is off by 0.02"), (sheared, "off by 0.01"),
        (moved, "last row 0, 0, 0, 1"),
        (unknown, r"camera.viewmat\S* has non-finite values"), (huge, "R R.* off by inf"),
    ):  # fmt: skip
        for viewmat in (wrong, torch.from_numpy(wrong), np.stack([rotation, wrong])):
            with pytest.raises(ValueError, match=words):
                rasterize(gaussians, dataclasses.replace(cam, viewmat=viewmat))
    many = functools.reduce(lambda a, b: a @ b, [torch.from_numpy(rotation).float()] * 1000)
    many[:, 3] = torch.from_numpy(rotation[:, 3])
    rasterize(gaussians, dataclasses.replace(cam, viewmat=many))
    K = cam.K.copy()
    K[0, 2] = cam.width - K[0, 2]
    eye[0, 0] = -1
    mirrored = rasterize(gaussians, dataclasses.replace(cam, viewmat=eye @ rotation, K=K)).rgb
    image = rasterize(gaussians, cam).rgb
    assert torch.allclose(mirrored.flip(1), image, atol=1e-5)
    assert torch.equal(
        rasterize(gaussians, dataclasses.replace(cam, width=np.int64(cam.width), height=np.int32(cam.height))).rgb, image
    )


ANTIALIASED = RasterizeOptions(antialiased=True)


def small(dtype=torch.float64, device="cpu"):
    g = hand_placed(dtype, device)
    return leaves(Gaussians(**{**g.tensors(), "log_scales": g.log_scales - 2}))


def reference(tensors, cam, rule):
    means, covs, colors, depths, opacities = project_reference(
        *tensors, width=cam.width, height=cam.height, degree=3, low_pass=rule.low_pass
    )
    bare = covs - rule.low_pass * torch.eye(2, dtype=covs.dtype)
    opacities = opacities * torch.sqrt(torch.linalg.det(bare) / torch.linalg.det(covs))
    background, size = torch.zeros(3, dtype=covs.dtype), (cam.width, cam.height)
    found = [blend_reference(*p, background, *size, rule) for p in zip(means, covs, opacities, colors, depths)]
    return opacities, [torch.stack(t) for t in zip(*found)][:3]


@pytest.mark.parametrize("rule", [SMOOTH, RULES["exact"]], ids=lambda rule: rule.name)
def test_opacities_images_and_gradients_equal_reference(device, dtype, rule):
    gaussians, cam = small(dtype, device), camera(cameras=2, dtype=dtype, device=device)
    views, Ks = cam.viewmat.clone().requires_grad_(), cam.K.clone().requires_grad_()
    r = rasterize(gaussians, dataclasses.replace(cam, viewmat=views, K=Ks), dataclasses.replace(ANTIALIASED, rule=rule))
    own = [*gaussians.tensors().values(), views, Ks]
    other = [t.detach().cpu().double().requires_grad_() for t in own]
    opacities, images = reference(other, cam, rule)
    assert bool((opacities < 0.5 * torch.sigmoid(other[3])).any())  # the factor matters
    seen = r.visible.cpu()
    close("projection", r.projected[..., 5].cpu()[seen], opacities[seen])
    found = (r.rgb, r.alpha, r.depth)
    for a, b in zip(found, images):
        close("image", a, b)
    upstream = [torch.randn(b.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64) for b in images]
    sum((a * v.to(a)).sum() for a, v in zip(found, upstream)).backward()
    sum((b * v).sum() for b, v in zip(images, upstream)).backward()
    other[6].grad[:, 0, 1] = other[6].grad[:, 1, 0] = 0
    for a, b in zip(own, other):
        close("gradient", a.grad, b.grad)


def spots(sigmas, dtype=torch.float32, device="cpu"):
    """Gaussians at the centre of pixel (16, 16), one for each row of standard deviations [N, 3] in px."""
    sigmas = torch.as_tensor(sigmas, dtype=torch.float64)
    n = len(sigmas)
    tensors = {
        "means": torch.tensor([[0.05, 0.05, 10.0]]).expand(n, 3), "quats": torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4),
        "log_scales": torch.log(sigmas / 10), "logit_opacities": torch.zeros(n), "sh": torch.zeros(n, 1, 3),
    }  # fmt: skip
    K = torch.tensor([[100.0, 0, 16], [0, 100, 16], [0, 0, 1]], dtype=dtype, device=device)
    cam = Camera(torch.eye(4, dtype=dtype, device=device), K, 32, 32)
    return Gaussians(**{k: t.to(device, dtype).contiguous().requires_grad_() for k, t in tensors.items()}), cam


def test_the_total_is_that_of_the_gaussian_at_any_size(device, dtype):
    """Alphas sum to opacity x 2 pi sigma^2 from a hundredth of a pixel on; without the option small ones are too bright."""
    for sigma in (0.01, 0.1, 0.5, 2.0):
        g, cam = spots([[sigma] * 3], dtype, device)
        totals = [
            float(rasterize(g, cam, RasterizeOptions(rule=SMOOTH, antialiased=a)).alpha.detach().sum()) / (math.pi * sigma**2)
            for a in (True, False)
        ]  # alpha sums, over those of one Gaussian at opacity 1/2
        # Pixels sample a Gaussian of variance v >= 0.3: their sum is off by at most 2 exp(-2 pi^2 v) = 0.54 % an axis
        assert abs(totals[0] - 1) < 0.012
        assert totals[1] == pytest.approx(1 + 0.3 / sigma**2, rel=0.012)


def test_tiles_follow_from_the_reduced_opacity(device):
    """A Gaussian below the cut is culled, and one just above it gets the box of that opacity."""
    sigma = math.sqrt(0.3 / (0.5 / ALPHA_CUT - 1))  # sigma^2 / (sigma^2 + 0.3) times 1/2 is the cut
    g, cam = spots([[0.99 * sigma] * 3, [1.01 * sigma] * 3], device=device)
    r = rasterize(g, cam, ANTIALIASED)
    assert r.visible[0].tolist() == [False, True] and r.tile_counts[0].tolist() == [0, 1]
    half_widths = [float(found.projected[0, 1, 10].detach()) for found in (r, rasterize(g, cam))]
    assert half_widths[0] < 0.2 < 1 < half_widths[1]
    assert float(r.alpha.detach().max()) >= ALPHA_CUT


def test_float32_keeps_the_digits_of_needles(device):
    """Axes from 1e-4 to 1e4 px in any direction: opacity and gradients beside float64."""
    generator = torch.Generator().manual_seed(5)
    sigmas = 10 ** (8 * torch.rand(400, 3, generator=generator, dtype=torch.float64) - 4)
    turns = torch.randn(400, 4, generator=generator, dtype=torch.float64)
    found = []
    for dtype in (torch.float32, torch.float64):
        g, cam = spots(sigmas.float().double(), dtype, device)
        with torch.no_grad():
            g.log_scales.copy_(g.log_scales.float())
            g.quats.copy_(turns.float())
        r = rasterize(g, cam, dataclasses.replace(ANTIALIASED, rule=SMOOTH))
        r.projected[..., 5].sum().backward()
        found.append((r.projected[0, :, 5].detach(), g.log_scales.grad, g.quats.grad))
    for name, a, b in zip(("opacity", "log_scales", "quats"), *found):
        assert float((a - b).norm() / b.norm()) < 1e-5, name  # measured: 1e-7, 3e-7, 2e-6


@pytest.mark.parametrize("low_pass", [0.3, 0.0])
def test_extremes_are_finite(device, dtype, low_pass):
    sizes = (0.0, 1e-30, 1e-12, 1e-3, 1.0, 1e3, 1e9, 1e20)
    g, cam = spots([(a, b, c) for a in sizes for b in sizes for c in (0.0, 1.0, 1e9)], dtype, device)
    for rule in (SMOOTH, RULES["exact"]):
        r = rasterize(g, cam, RasterizeOptions(rule=dataclasses.replace(rule, low_pass=low_pass), antialiased=True))
        opacity = r.projected[0, :, 5].detach()
        assert bool((opacity <= 0.5).all()) and bool(r.visible.any())
        (r.rgb.square().sum() + r.alpha.square().sum() + r.depth.sum()).backward()
        assert all(bool(torch.isfinite(t).all()) for t in (r.rgb, r.alpha, r.depth))
        assert all(bool(torch.isfinite(t.grad).all()) for t in g.tensors().values())
    flat = (g.log_scales[:, :2] == -math.inf).any(1) & (g.log_scales[:, 2] == -math.inf)
    assert not bool(r.visible[0, flat.to(r.visible.device)].any())
    if low_pass == 0:  # nothing is added, so nothing is taken back
        plain = rasterize(g, cam, RasterizeOptions(rule=dataclasses.replace(RULES["exact"], low_pass=0.0)))
        assert torch.equal(plain.visible, r.visible)
        close("projection", opacity, plain.projected[0, :, 5])


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
    g, cam = cloud(200, dtype, device), lens_camera(model, width=64, height=48, dtype=dtype, device=device)
    depths = g.means.norm(dim=1) if model == "fisheye" else g.means[:, 2]
    inside = (depths >= PLANES["near"]) & (depths <= PLANES["far"])
    seen = rasterize(g, cam).tile_counts[0] > 0
    assert bool((seen & ~inside).any()) and bool((seen & inside).any())
    assert torch.equal(rasterize(g, cam, RasterizeOptions(**PLANES)).tile_counts[0] > 0, seen & inside)


def test_planes_are_inclusive(device, dtype):
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


@pytest.mark.parametrize("layers", [1, 40])
def test_gradients_at_the_largest_alpha_are_finite(device, layers):
    """Opaque Gaussians one behind the other, at the largest alpha that a rule may have."""
    g = cloud(layers).to(device)
    g = dataclasses.replace(g, means=torch.zeros_like(g.means), logit_opacities=torch.full_like(g.logit_opacities, 30.0))
    g.means[:, 2] = torch.linspace(2, 3, layers)
    g.log_scales.fill_(12.0)  # far wider than the image: an alpha of 1 before it is limited
    inputs = {n: t.detach().clone().requires_grad_() for n, t in g.tensors().items()}
    rule = Rule("own", alpha_max=LARGEST_ALPHA, transmittance_stop=0.0)
    render = rasterize(type(g)(**inputs), camera(), RasterizeOptions(rule=rule))
    (render.rgb.square().sum() + render.depth.sum()).backward()
    assert float(render.alpha.detach().max()) > 0.999
    assert all(bool(t.grad.isfinite().all()) for t in inputs.values())


@pytest.mark.parametrize("name", ["viewmat", "K", "background", "distortion"])
def test_an_array_edited_before_the_backward_pass_changes_no_gradient(device, name):
    """Cameras and backgrounds as numpy arrays of the Gaussians' own type, which torch would share."""
    lens = {"model": "opencv", "distortion": np.zeros(8)} if name == "distortion" else {}
    gradients = []
    for edited in (False, True):
        cam = camera()
        cam = Camera(cam.viewmat.double().numpy().copy(), cam.K.double().numpy().copy(), cam.width, cam.height, **lens)
        if lens:
            cam = dataclasses.replace(cam, distortion=np.full(8, 0.01))
        background = np.full(3, 0.5)
        inputs = {n: t.double().to(device).requires_grad_() for n, t in cloud(20).tensors().items()}
        render = rasterize(Gaussians(**inputs), cam, RasterizeOptions(background=background))
        if edited:
            array = background if name == "background" else getattr(cam, name)
            array *= 1.1
        (render.rgb.square().sum() + render.alpha.sum()).backward()
        gradients.append({n: t.grad for n, t in inputs.items()})
    assert all(torch.equal(t, gradients[1][n]) for n, t in gradients[0].items())
    assert bool(gradients[0]["means"].any())


def test_chunks_keep_to_the_memory_budget_too(device):
    """The smaller of both limits divides the image, with the same bits; a budget below one tile is an error."""
    g, cam = cloud(60).to(device), camera(80, 64)
    whole = rasterize(g, cam)
    instances = int(whole.tile_counts.sum())
    budget = instances // 3 * BYTES_PER_INSTANCE
    with pytest.raises(ResourceError, match="instances need"):
        rasterize(g, cam, RasterizeOptions(memory_budget=budget))
    for most in (instances // 2, instances, 10 * instances):
        found = rasterize(g, cam, RasterizeOptions(memory_budget=budget, max_instances=most, median_depth=True))
        assert torch.equal(found.rgb, whole.rgb) and torch.equal(found.depth, whole.depth)
        with pytest.raises(ResourceError, match="instances need"):
            rasterize(g, cam, RasterizeOptions(memory_budget=1, max_instances=most))


# The float64 image against the tests' reference, the float64 kernels, and with a Gaussian in the way.

BACKGROUND = torch.tensor([0.2, 0.5, 0.7], dtype=torch.float64)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_equals_the_reference(degree):
    """The image is that of the loop over Gaussians, in another structure; two of the Gaussians are clamped at the frustum."""
    g, cam, rule = hand_placed(), camera(), RULES["exact"]
    projected = project_reference(
        *g.tensors().values(), cam.viewmat[None], cam.K[None], width=18, height=17, degree=degree, low_pass=rule.low_pass
    )
    means, covs, colors, depths, opacities = (t[0] if t.ndim > 1 else t for t in projected)
    wanted = blend_reference(means, covs, opacities, colors, depths, BACKGROUND, 18, 17, rule)[0]
    found = reference_image(g, cam, (0, 0, 18, 17), BACKGROUND, degree)
    assert float((found - wanted).abs().max()) < 1e-13 and float((wanted - BACKGROUND).abs().max()) > 0.1
    crop = reference_image(g, cam, (5, 3, 9, 8), BACKGROUND, degree)
    assert float((crop - wanted[3:11, 5:14]).abs().max()) < 1e-13


def test_the_reference_equals_the_kernels_and_draws_nothing_hidden(device):
    """A cloud dense enough that pixels stop early; Gaussians behind the camera, or fainter than the cut, do not show."""
    g, cam = cloud(600, torch.float64, device), camera(75, 53, device=device)
    g = dataclasses.replace(g, logit_opacities=g.logit_opacities + 4)
    wanted = rasterize(g, cam, RasterizeOptions(background=BACKGROUND))
    found = reference_image(g, cam, (16, 0, 59, 53), BACKGROUND.to(device), 1)
    assert float((found - wanted.rgb[:, 16:]).abs().max()) < 1e-12
    assert float((1 - wanted.alpha).min()) < 1e-4  # some pixels stopped
    g, cam = cloud(20, torch.float64, device), camera(device=device)
    for hidden in (
        dataclasses.replace(g, means=-g.means),
        dataclasses.replace(g, logit_opacities=torch.full_like(g.logit_opacities, -6)),
    ):
        found = reference_image(hidden, cam, (0, 0, 18, 17), BACKGROUND.to(device), 1)
        assert torch.equal(found, BACKGROUND.to(device).expand_as(found))
