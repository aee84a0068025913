"""diff-gaussian-rasterization's arguments and results: values, gradients and errors."""

import math

import pytest
import torch

import warpgs
from tests.reference.project import rotations
from warpgs.compat.inria import GaussianRasterizationSettings, GaussianRasterizer, _camera

WIDTH, HEIGHT, COUNT = 40, 30, 50
FOCAL, CENTER = (32.0, 30.0), (22.0, 14.0)
FIELDS = {"2023": {"debug": False}, "2024": {"debug": False, "antialiasing": True}, "w-depth": {}}
"""Fields that a version has beyond those of all versions."""


def pose():
    turned = torch.eye(4)
    turned[:3, :3] = rotations(torch.tensor([[1.0, 0.1, -0.2, 0.05]]))[0]
    turned[:3, 3] = torch.tensor([0.1, -0.2, 0.3])
    return turned


def settings(version="2023", center=CENTER, **others):
    """Settings of a version; matrices as its callers make them, with a principal point."""
    view, (fx, fy), (cx, cy), near, far = pose().T, FOCAL, center, 0.01, 100.0
    lens = torch.tensor([
        [2 * fx / WIDTH, 0, 2 * cx / WIDTH - 1, 0], [0, 2 * fy / HEIGHT, 2 * cy / HEIGHT - 1, 0],
        [0, 0, far / (far - near), -far * near / (far - near)], [0, 0, 1, 0],
    ])  # fmt: skip
    given = {
        "image_height": HEIGHT, "image_width": WIDTH, "tanfovx": WIDTH / (2 * fx), "tanfovy": HEIGHT / (2 * fy),
        "bg": torch.tensor([0.1, 0.2, 0.3]), "scale_modifier": 1.0, "viewmatrix": view, "projmatrix": view @ lens.T,
        "sh_degree": 2, "campos": torch.linalg.inv(view)[3, :3], "prefiltered": False,
    }  # fmt: skip
    return GaussianRasterizationSettings(**given | FIELDS[version] | others)


def scene(form="harmonics"):
    """Arguments of a call: Gaussians in front of the camera, some of them outside of the image."""
    generator = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(COUNT, *shape, generator=generator)

    means = 3 * rand(3) + torch.tensor([-1.5, -1.5, 0.5])
    quats, scales = torch.nn.functional.normalize(rand(4) - 0.5, dim=-1), 0.2 * rand(3) + 0.02
    given = {"means3D": means, "means2D": torch.zeros(COUNT, 3), "opacities": 0.9 * rand(1) + 0.05}
    shape = {"scales": scales, "rotations": quats}
    if form == "precomputed":
        axes = rotations(quats) * scales[:, None]
        shape = {"cov3D_precomp": (axes @ axes.mT).flatten(1)[:, [0, 1, 2, 4, 5, 8]]}
    given |= shape | ({"colors_precomp": rand(3)} if form == "precomputed" else {"shs": rand(16, 3) - 0.5})
    return {name: value.clone().requires_grad_() for name, value in given.items()}


def on(device, values):
    return {n: v.detach().to(device).requires_grad_(v.requires_grad) if isinstance(v, torch.Tensor) else v for n, v in values}


@pytest.mark.parametrize("version", FIELDS)
@pytest.mark.parametrize("form", ["harmonics", "precomputed"])
@pytest.mark.parametrize("center", [CENTER, (WIDTH / 2, HEIGHT / 2)])
def test_a_call_is_that_of_rasterize(version, form, center, device):
    """Images, radii, depths and gradients to the bit; of the screen in units of half the image, and over two passes."""
    given, modifier = on(device, scene(form).items()), 0.5 if form == "harmonics" else 1.0
    own = settings(version, center, scale_modifier=modifier)
    own = GaussianRasterizationSettings(**on(device, own._asdict().items()))
    rasterizer = GaussianRasterizer(raster_settings=own)
    image, radii, *further = rasterizer(**given)

    (fx, fy), (cx, cy), same = FOCAL, center, on(device, scene(form).items())
    camera = warpgs.Camera(pose(), torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), WIDTH, HEIGHT)
    depths = same["means3D"] @ own.viewmatrix[:3, 2] + own.viewmatrix[3, 2]
    options = warpgs.RasterizeOptions(
        rule="inria", background=own.bg, sh_degree=2 if form == "harmonics" else None, antialiased=version == "2024",
        median_depth=version == "w-depth", colors=same.get("colors_precomp"),
        features=1 / depths.clamp_min(0.2)[:, None] if version == "2024" else None,
    )  # fmt: skip
    if form == "harmonics":
        kinds = same["rotations"], same["scales"] * modifier, same["opacities"].squeeze(1), same["shs"]
        gaussians = warpgs.ActivatedGaussians(same["means3D"], *kinds)
    else:
        full = same["cov3D_precomp"][:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]
        gaussians = warpgs.CovarianceGaussians(same["means3D"], full, same["opacities"].squeeze(1))
    render = warpgs.rasterize(gaussians, camera, options)
    assert torch.equal(image, render.rgb.movedim(-1, 0)) and image.is_contiguous() and bool(image.detach().std() > 0.05)
    assert torch.equal(radii > 0, render.visible[0]) and radii.dtype == torch.int32 and 5 < int((radii > 0).sum()) < COUNT
    a, b, c = torch.unbind(render.projected.detach()[0, radii > 0, 2:5], -1)  # of the factor U of the inverse covariance
    inverse = torch.stack([torch.stack([a * a, a * b], -1), torch.stack([a * b, b * b + c * c], -1)], -1).double()
    longest = torch.linalg.eigvalsh(inverse)[:, 0].rsqrt()
    assert bool((radii[radii > 0] >= 3 * longest * (1 - 1e-5)).all() and (radii[radii > 0] < 3 * longest + 1.001).all())
    wanted = {"2024": render.features, "w-depth": render.median_depth, "2023": None}[version]
    assert len(further) == (wanted is not None)
    if version == "w-depth":
        reached = wanted > 0
        assert torch.equal(further[0][0], torch.where(reached, wanted, 15)) and 0 < int(reached.sum()) < reached.numel()
        assert not further[0].requires_grad
    if version == "2024":
        assert torch.equal(further[0], wanted.movedim(-1, 0))

    clip = same["means3D"].detach() @ own.projmatrix[:3] + own.projmatrix[3]
    places = (clip[:, :2] / clip[:, 3:] + 1) / 2 * torch.tensor([WIDTH, HEIGHT], device=device)
    torch.testing.assert_close(render.means2d.detach()[0, radii > 0], places[radii > 0], rtol=1e-5, atol=1e-3)
    means2d, weights = render.means2d, torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1)).to(device)
    for first, more in ((image, further), (render.rgb.movedim(-1, 0), [wanted.movedim(-1, 0)] if version == "2024" else [])):
        loss = (first * weights).sum() + sum(m.sum() for m in more if m.requires_grad)
        torch.autograd.grad(loss, given["opacities"] if first is image else same["opacities"], retain_graph=True)
        loss.backward(retain_graph=True)
        (2 * loss).backward()
    half = torch.tensor([WIDTH / 2, HEIGHT / 2], device=device)
    pixels = means2d.grad[0] * 3 / 4  # the first pass, a fourth, went to the opacities alone
    torch.testing.assert_close(given["means2D"].grad[:, :2], pixels * half, rtol=1e-6, atol=0)
    assert not given["means2D"].grad[:, 2].any() and bool(given["means2D"].grad[:, :2].any())
    for name in given.keys() - {"means2D"}:
        assert torch.equal(given[name].grad, same[name].grad) and bool(given[name].grad.any()), name


def test_a_pose_a_plane_and_a_middle():
    """A pose gets gradients, and images may be edited; depth 0 is culled; the middle of a large image is exact."""
    own, given = settings(), {name: value.detach() for name, value in scene().items()}
    view = own.viewmatrix.clone().requires_grad_()
    image, _ = GaussianRasterizer(own._replace(viewmatrix=view))(**given)
    image[:, :5] = 0
    image.square().sum().backward()
    assert bool(view.grad[:, :3].any())
    depths = torch.tensor([0.0, 0.19, 0.21, math.nan])
    points = (torch.stack([torch.zeros(4), torch.zeros(4), depths], -1) - own.viewmatrix[3, :3]) @ own.viewmatrix[:3, :3].T
    assert GaussianRasterizer(own).markVisible(points).tolist() == [False, False, True, False]
    front = {"viewmatrix": torch.eye(4), "projmatrix": torch.linalg.inv(own.viewmatrix) @ own.projmatrix}
    given["means3D"] = (given["means3D"] * (torch.arange(COUNT) > 0)[:, None]).requires_grad_()
    _, _, inverse = GaussianRasterizer(settings("2024", **front))(**given)
    inverse.sum().backward()
    assert bool(given["means3D"].grad.isfinite().all()) and bool(given["means3D"].grad.any())
    large = settings(center=(WIDTH / 2, HEIGHT / 2), image_width=50 * WIDTH, image_height=50 * HEIGHT)
    assert _camera(large).K[:2, 2].tolist() == [25 * WIDTH, 25 * HEIGHT]


@pytest.mark.parametrize(
    ("fields", "arguments", "message"),
    [
        ({"prefiltered": True}, {}, "prefiltered=True is not supported: .*give False"),
        ({"debug": True}, {}, "debug=True is not supported: .*give False"),
        ({"tanfovx": 0.5}, {}, "projmatrix is not viewmatrix times"),
        ({"viewmatrix": pose()}, {}, "give both matrices transposed"),
        ({"viewmatrix": pose().to("meta")}, {}, "viewmatrix is on meta, projmatrix on cpu; move both"),
        ({"projmatrix": torch.full((4, 4), math.nan)}, {}, "projmatrix is not viewmatrix times"),
        ({}, {"colors_precomp": torch.ones(COUNT, 3)}, "give either shs or colors_precomp"),
        ({}, {"shs": None}, "give either shs or colors_precomp"),
        ({}, {"cov3D_precomp": torch.ones(COUNT, 6)}, "give either scales and rotations, or cov3D_precomp"),
        ({}, {"scales": None}, "give either scales and rotations, or cov3D_precomp"),
        ({}, {"scales": None, "rotations": None}, "give either scales and rotations, or cov3D_precomp"),
        ({}, {"opacities": torch.randn(COUNT, 1) * 5}, r"opacities are from .*; torch.sigmoid makes them from logits"),
        ({}, {"scales": torch.full((COUNT, 3), -4.0)}, "scales are from -4 to -4, .*; torch.exp makes them from log scales"),
        ({}, {"means2D": torch.zeros(COUNT, 2)}, r"means2D must have the shape of means3D, \[50, 3\], not \[50, 2\]"),
    ],
)
def test_what_is_wrong_is_named(fields, arguments, message):
    kind = ValueError if "means2D" in arguments or "torch" in message else warpgs.UsageError
    with pytest.raises(kind, match=message):
        GaussianRasterizer(settings(**fields))(**scene() | arguments)


def test_a_trainer_of_3dgs_changes_its_import_alone():
    """Points of the screen are no leaf, and hold their gradient for the growth; the loss falls."""
    given, target, losses = scene(), torch.full((3, HEIGHT, WIDTH), 0.7), []
    parameters = {name: value for name, value in given.items() if name != "means2D"}
    optimizer = torch.optim.Adam(list(parameters.values()), lr=0.01)
    growth, largest = torch.zeros(COUNT, 1), torch.zeros(COUNT)
    for _ in range(15):
        screen = torch.zeros_like(parameters["means3D"], requires_grad=True) + 0
        screen.retain_grad()
        image, radii, inverse = GaussianRasterizer(settings("2024"))(means2D=screen, **parameters)
        seen = radii > 0
        loss = (image.clamp(0, 1) - target).abs().mean() + 0.1 * (inverse - 0.5).abs().mean()
        loss.backward()
        largest[seen] = torch.max(largest[seen], radii[seen])
        growth[seen] += screen.grad[seen, :2].norm(dim=-1, keepdim=True)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0] and bool(growth.any()) and bool(largest.any())


def test_a_mapper_of_splatam_changes_its_import_alone():
    """Matrices have a leading axis; a second call renders depth, opacity and squared depth as colours."""
    own = settings("w-depth", bg=torch.zeros(3))
    camera = own._replace(viewmatrix=own.viewmatrix[None], projmatrix=own.projmatrix[None])
    given = {name: value for name, value in scene().items() if name != "shs"}
    z = given["means3D"] @ own.viewmatrix[:3, 2] + own.viewmatrix[3, 2]
    given["means2D"] = torch.zeros(COUNT, 3, requires_grad=True) + 0
    given["means2D"].retain_grad()
    image, radii, _ = GaussianRasterizer(raster_settings=camera)(**given, colors_precomp=torch.rand(COUNT, 3))
    values = torch.stack([z, torch.ones(COUNT), z**2], -1)
    screen = {"means2D": torch.zeros(COUNT, 3, requires_grad=True) + 0}
    (depth, opacity, _), _, median = GaussianRasterizer(raster_settings=camera)(**given | screen, colors_precomp=values)
    ((depth - 2) * (opacity > 0.5)).abs().sum().backward(retain_graph=True)
    assert given["means2D"].grad is None and bool(given["means3D"].grad.any())
    image.sum().backward()
    assert bool(given["means2D"].grad[radii > 0, :2].any())
    covered = opacity > 0.7
    assert bool(covered.any()) and float((depth / opacity - median[0]).detach()[covered].abs().median()) < 0.5
