"""gsplat's arguments and results: values, gradients, meta and errors."""

import dataclasses

import pytest
import torch

import warpgs
from tests.reference.blend import blend_channels_reference
from tests.reference.project import project_reference, rotations
from tests.reference.sh import colors_reference
from tests.reference.tiles import touched_reference
from warpgs.compat import gsplat
from warpgs.constants import rule_named

WIDTH, HEIGHT, COUNT, VIEWS = 40, 30, 40, 2


def scene(batch=(), dtype=torch.float32, seed=0):
    """Arguments of `rasterization`: Gaussians in front of two cameras, some of them outside of the images."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*batch, *shape, generator=generator, dtype=dtype)

    turned = torch.eye(4, dtype=dtype)
    turned[0, 3] = 0.2
    K = torch.tensor([[32.0, 0, 20], [0, 32, 15], [0, 0, 1]], dtype=dtype)
    return {
        "means": 3.6 * rand(COUNT, 3) + torch.tensor([-1.8, -1.8, 1.0], dtype=dtype),
        "quats": rand(COUNT, 4) - 0.5,
        "scales": 0.1 * rand(COUNT, 3) + 0.02,
        "opacities": 0.9 * rand(COUNT) + 0.05,
        "colors": rand(COUNT, 3),
        "viewmats": torch.stack([torch.eye(4, dtype=dtype), turned]).expand(*batch, VIEWS, 4, 4),
        "Ks": K.expand(*batch, VIEWS, 3, 3),
        "width": WIDTH,
        "height": HEIGHT,
    }


def on(device, values):
    return {name: value.to(device) if isinstance(value, torch.Tensor) else value for name, value in values.items()}


def dense(given, i, colors, degree):
    """Projected scene ``i`` of a flattened batch: means, covariances, depths, opacities, and colours of coefficients."""
    means, quats, scales, opacities = (given[n].flatten(0, 1)[i] for n in ("means", "quats", "scales", "opacities"))
    sh = colors.new_zeros(COUNT, 1, 3) if degree is None else colors
    size = {"width": WIDTH, "height": HEIGHT, "degree": degree or 0, "low_pass": 0.3}
    poses = given["viewmats"].flatten(0, 1)[i], given["Ks"].flatten(0, 1)[i]
    projected = project_reference(means, quats, scales.log(), torch.logit(opacities), sh, *poses, **size)
    return projected[0], projected[1], projected[3], projected[4], projected[2]


@pytest.mark.parametrize(
    ("mode", "form"),
    [("RGB", "views"), ("RGB+D", "extra"), ("RGB+ED", "harmonics"), ("D", "none"), ("ED", "covars"), ("RGB", "covars")],
)
def test_batches_equal_the_dense_reference(mode, form):
    given, degree = scene((2, 1), torch.float64), 2 if form == "harmonics" else None
    shape = {"views": (2, 1, VIEWS, COUNT, 5), "harmonics": (COUNT, 9, 3)}.get(form, (2, 1, COUNT, 3))
    generator = torch.Generator().manual_seed(1)
    given["colors"] = colors = torch.rand(shape, generator=generator, dtype=torch.float64)
    behind = torch.rand(2, 1, VIEWS, shape[-1] + 2 * (form == "extra"), generator=generator, dtype=torch.float64)
    extra = torch.rand(COUNT, 4, 2, generator=generator, dtype=torch.float64)
    names = ["means", "quats", "scales", "opacities"] + ["colors"] * ("RGB" in mode)
    leaves = [given[n].requires_grad_() for n in names] + [behind.requires_grad_()] * ("RGB" in mode) + [extra.requires_grad_()]
    call = given | {"render_mode": mode, "sh_degree": degree, "backgrounds": behind, "packed": form != "none"}
    if form == "covars":
        axes = rotations(given["quats"].flatten(0, -2)) * given["scales"].flatten(0, -2)[:, None]
        call |= {"quats": None, "scales": None, "covars": (axes @ axes.mT).view(2, 1, COUNT, 3, 3)}
    if form == "none":
        call["colors"] = None
    if form == "extra":
        call |= {"extra_signals": extra, "extra_signals_sh_degree": 1}
    images, alphas, meta = gsplat.rasterization(**call)
    found = [images, alphas, *([meta["render_extra_signals"]] if form == "extra" else [])]

    rule, wanted = rule_named("gsplat-1.6"), [[], [], []]
    for i in range(2):
        means2d, covs, depths, opacities, evaluated = dense(given, i, colors, degree)
        centers = torch.linalg.inv(given["viewmats"].flatten(0, 1)[i])[:, :3, 3]
        for c in range(VIEWS):
            own = evaluated[c] if degree is not None else colors.flatten(0, 1)[i]
            away = given["means"].flatten(0, 1)[i] - centers[c]
            harmonics = torch.stack([extra[..., 0], extra[..., 1], extra[..., 0]], -1)
            signals = colors_reference(harmonics, away / away.norm(dim=-1, keepdim=True), 1)[:, :2] + 0.5
            channels = torch.cat([own[c] if form == "views" else own, signals], -1)
            ground = behind.flatten(0, 1)[i, c]
            ground = ground if form == "extra" else torch.cat([ground, ground.new_zeros(2)])
            image, alpha, depth = blend_channels_reference(
                means2d[c], covs[c], opacities, channels, depths[c], ground, WIDTH, HEIGHT, rule
            )
            depth = depth[..., None] * (1 if "E" in mode else alpha[..., None])
            parts = [image[..., :-2]] * ("RGB" in mode) + [depth] * (mode != "RGB")
            for values, rows in zip((torch.cat(parts, -1), alpha[..., None], image[..., -2:]), wanted):
                rows.append(values)
    wanted = [torch.stack(rows).view(2, 1, VIEWS, HEIGHT, WIDTH, -1) for rows in wanted][: len(found)]
    weights = [torch.randn(f.shape, generator=generator, dtype=f.dtype) for f in found]
    gradients = []
    for results in (found, wanted):
        total = sum((w * r).sum() for w, r in zip(weights, results))
        gradients.append(torch.autograd.grad(total, leaves, allow_unused=True))
    torch.testing.assert_close(found, wanted, rtol=1e-10, atol=1e-10)
    for name, ours, theirs in zip([*names, "behind", "extra"], *gradients):
        assert (ours is None) == (theirs is None) or not bool((ours if theirs is None else theirs).any()), name
        if ours is not None and theirs is not None:
            torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=1e-9, msg=lambda text, name=name: f"{name}: {text}")
    assert sum(bool(g is not None and g.any()) for g in gradients[0]) >= 4


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("antialiased", [True, False])
def test_meta_is_what_the_reference_projects(packed, antialiased, device):
    """Conics, opacities, radii and depths; tiles by a look at every pixel; ids decode to view, tile and depth."""
    given, bits = scene((2, 1), torch.float64), 3  # 3 x 2 tiles
    mode = "antialiased" if antialiased else "classic"
    _, _, lazy = gsplat.rasterization(**on(device, given), packed=packed, rasterize_mode=mode)
    assert dict(lazy).keys() == lazy.keys() and not any(callable(v) for v in dict(lazy).values())
    meta = on("cpu", lazy)
    wanted = {n: [] for n in ("means2d", "conics", "depths", "opacities", "touched")}
    for i in range(2):
        means2d, covs, depths, opacities, _ = dense(given, i, given["colors"], None)
        for c in range(VIEWS):
            inverse, blur = torch.linalg.inv(covs[c]), 0.3 * torch.eye(2, dtype=torch.float64)
            factors = (torch.linalg.det(covs[c] - blur) / torch.linalg.det(covs[c])).sqrt() if antialiased else 1.0
            conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
            touched = touched_reference(means2d[c], covs[c], opacities * factors, WIDTH, HEIGHT, 16, 1 / 255)
            for name, values in zip(wanted, (means2d[c], conics, depths[c], opacities * factors, touched)):
                wanted[name].append(values)
    touched = [tiles for rows in wanted.pop("touched") for tiles in rows]  # by view and Gaussian
    seen = torch.tensor([bool(tiles) for tiles in touched])
    rows = seen.nonzero().squeeze(1)
    assert 0 < len(rows) < len(touched)

    def of_seen(name):
        return meta[name] if packed else meta[name].flatten(0, 3)[rows]

    for name, values in wanted.items():
        torch.testing.assert_close(of_seen(name).detach(), torch.cat(values)[rows], rtol=1e-9, atol=1e-9)
    assert meta["radii"].dtype == torch.int32 and of_seen("tiles_per_gauss").tolist() == [len(touched[r]) for r in rows]
    assert bool((of_seen("radii") > 0).all())
    if packed:
        assert torch.equal(meta["batch_ids"] * VIEWS * COUNT + meta["camera_ids"] * COUNT + meta["gaussian_ids"], rows)
    else:
        assert torch.equal((meta["radii"] > 0).all(-1).flatten(), seen) and meta["gaussian_ids"] is None
        assert meta["means2d"].shape == (2, 1, VIEWS, COUNT, 2) and meta["conics"].shape == (2, 1, VIEWS, COUNT, 3)

    keys, owners = meta["isect_ids"], meta["flatten_ids"].long()
    flat = rows[owners] if packed else owners
    view, tile = keys >> (32 + bits), (keys >> 32) & (2**bits - 1)
    listed = {(v, r, divmod(t, 3)) for v, r, t in zip(view.tolist(), flat.tolist(), tile.tolist())}
    assert listed == {(r // COUNT, r, place) for r in range(len(touched)) for place in touched[r]}
    assert len(listed) == len(keys) and bool((keys[1:] >= keys[:-1]).all())
    depth = (keys & (2**32 - 1)).int().view(torch.float32)
    torch.testing.assert_close(depth, torch.cat(wanted["depths"])[flat].float())
    starts = torch.searchsorted(view * 6 + tile, torch.arange(2 * VIEWS * 6))
    assert torch.equal(meta["isect_offsets"].flatten().long(), starts) and meta["isect_offsets"].shape == (2, 1, VIEWS, 2, 3)
    sizes = ("width", "height", "tile_size", "tile_width", "tile_height", "n_batches", "n_cameras")
    assert [meta[name] for name in sizes] == [WIDTH, HEIGHT, 16, 3, 2, 2, VIEWS]


@pytest.mark.parametrize("packed", [True, False])
def test_means_hold_gradients_of_every_scene(packed, device):
    """Grad and absgrad of a batch add up over backward passes; a clip leaves small Gaussians out of each view."""
    given, clip = on(device, scene((3,))), 4.0
    given["means"].requires_grad_()
    images, _, meta = gsplat.rasterization(**given, packed=packed, absgrad=True, radius_clip=clip)
    assert meta["means2d"].grad is None
    meta["means2d"].retain_grad()
    for _ in range(2):
        images.square().sum().backward(retain_graph=True)
    kept, total = [], 0
    for i in range(3):
        own = {n: v[i] if isinstance(v, torch.Tensor) else v for n, v in given.items()}
        for c in range(VIEWS):
            gaussians = warpgs.ActivatedGaussians(*(own[n].detach() for n in ("means", "quats", "scales", "opacities")))
            gaussians.means.requires_grad_()
            camera = warpgs.Camera(own["viewmats"][c], own["Ks"][c], WIDTH, HEIGHT)
            options = warpgs.RasterizeOptions(colors=own["colors"], rule="gsplat-1.6", absgrad=True)
            radii = warpgs.rasterize(gaussians, camera, options).projected[0, :, 10:12].ceil()
            large = (radii > clip).any(-1)
            total += int((~large & (radii > 0).all(-1)).sum())
            render = warpgs.rasterize(gaussians, camera, dataclasses.replace(options, opacity_factors=large.float()))
            assert torch.equal(images[i, c], render.rgb)
            means2d = render.means2d
            render.rgb.square().sum().backward()
            kept.append((2 * means2d.grad[0], 2 * means2d.absgrad[0], render.projected.detach()[0, :, 10:12].ceil().int()))
    assert total > 10
    wanted = [torch.stack(rows).view(3, VIEWS, COUNT, -1) for rows in zip(*kept)]
    seen = (wanted[2] > 0).all(-1)
    wanted = [values[seen] if packed else values for values in wanted]
    for name, found in zip(("grad", "absgrad"), wanted):
        torch.testing.assert_close(getattr(meta["means2d"], name), found)
    assert torch.equal(meta["radii"], wanted[2]) and bool(wanted[1].any())


@pytest.mark.parametrize(
    ("arguments", "camera_options", "options"),
    [
        ({"radius_clip": 0.0, "channel_chunk": 32, "renderer_config": gsplat.RendererConfig_MixedBatch()}, {}, {}),
        ({"eps2d": 0.1}, {}, {"rule": dataclasses.replace(rule_named("gsplat-1.6"), low_pass=0.1)}),
        ({"near_plane": 2.6, "far_plane": 3.8, "tile_size": 8}, {}, {"near": 2.6, "far": 3.8, "tile_size": 8}),
        ({"backgrounds": torch.eye(2, 3)}, {}, {"background": torch.eye(2, 3)}),
        ({"rasterize_mode": "antialiased"}, {}, {"antialiased": True}),
        ({"colors": torch.ones(COUNT, 5, 3), "sh_degree": 0}, {}, {"colors": None, "sh_degree": 0}),
        ({"camera_model": "ortho"}, {"model": "orthographic"}, {}),
        ({"camera_model": "fisheye", "global_z_order": False}, {"model": "fisheye", "distortion": torch.zeros(4)}, {}),
        ({"camera_model": "fisheye", "global_z_order": False, "radial_coeffs": torch.full((2, 4), 0.1)},
         {"model": "fisheye", "distortion": torch.full((4,), 0.1)}, {}),
        ({"radial_coeffs": torch.tensor([[0.01, 0.02, 0.05, 0.06, 0.07, 0.08]] * 2),
          "tangential_coeffs": torch.tensor([[0.03, 0.04]] * 2)},
         {"model": "opencv", "distortion": torch.tensor([0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08])}, {}),
        ({"tangential_coeffs": torch.full((2, 2), 0.01)},
         {"model": "opencv", "distortion": torch.tensor([0, 0, 0.01, 0.01, 0, 0, 0, 0])}, {}),
    ],
)  # fmt: skip
def test_arguments_of_gsplat_become_ours(arguments, camera_options, options):
    """Images, depths and alphas equal those of `warpgs.rasterize`, bit for bit; near and far also by position."""
    given = scene() | arguments
    camera = warpgs.Camera(given["viewmats"], given["Ks"], WIDTH, HEIGHT, **camera_options)
    options = warpgs.RasterizeOptions(**{"rule": "gsplat-1.6", "colors": given["colors"]} | options)
    sh = given["colors"][:, :1] if "sh_degree" in arguments else None
    kinds = (given[name] for name in ("means", "quats", "scales", "opacities"))
    wanted = warpgs.rasterize(warpgs.ActivatedGaussians(*kinds, sh), camera, options)
    first = [given.pop(name) for name in scene()] + [given.pop("near_plane", 0.01), given.pop("far_plane", 1e10)]
    images, alphas, meta = gsplat.rasterization(*first, render_mode="RGB+ED", packed=False, **given)
    assert torch.equal(images, torch.cat([wanted.rgb, wanted.depth[..., None]], -1)) and bool(images.any())
    assert torch.equal(alphas, wanted.alpha[..., None]) and torch.equal(meta["means2d"], wanted.means2d)
    assert torch.equal(meta["depths"], wanted.projected[..., 9])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"with_ut": True, "sparse_grad": True}, r"sparse_grad=True: gradients are dense\n.*with_ut=True: "),
        ({"global_z_order": False}, "global_z_order=False: only fisheyes"),
        ({"camera_model": "fisheye", "render_mode": "ED"}, "give global_z_order=False"),
        ({"rolling_shutter": gsplat.RollingShutterType.ROLLING_LEFT_TO_RIGHT}, "rolling_shutter=1: an image has one pose"),
        ({"rays": torch.zeros(2, 30, 40, 6)}, "does not support rays: "),
        ({"renderer_config": gsplat.RendererConfig_ParallelBatch()}, "renderer_config=RendererConfig_ParallelBatch"),
        ({"render_mode": "d"}, r"render_mode='d': it must be one of RGB, D, ED, RGB\+D, RGB\+ED"),
        ({"rasterize_mode": "smooth"}, "rasterize_mode='smooth': it must be one of classic, antialiased"),
        ({"camera_model": "ftheta"}, "camera_model='ftheta': it must be one of pinhole, ortho, fisheye"),
        ({"camera_model": "ortho", "radial_coeffs": torch.zeros(2, 4)}, "radial_coeffs with camera_model='ortho'"),
        ({"camera_model": "fisheye", "tangential_coeffs": torch.zeros(2, 2)}, "tangential_coeffs with camera_model='fisheye'"),
        ({"colors": None}, "colors must be given in render_mode 'RGB'"),
        ({"means": torch.zeros(2, COUNT, 3)}, r"quats must have the batch axes \[2\] of means, not shape \[40, 4\]"),
        ({"backgrounds": torch.zeros(2, 4)}, "background must have shape"),
        ({"opacities": torch.full((COUNT,), -4.0)}, r"opacities are from -4 to -4, .*; torch.sigmoid makes them from logits"),
        ({"scales": torch.full((COUNT, 3), -4.0)}, "scales are from -4 to -4, .*; torch.exp makes them from log scales"),
    ],
)
def test_other_arguments_are_refused_by_name(arguments, message):
    with pytest.raises(ValueError, match=message) as caught:
        gsplat.rasterization(**scene() | arguments)
    if "does not support" in str(caught.value):
        assert isinstance(caught.value, warpgs.UsageError) and isinstance(caught.value, RuntimeError)
    with pytest.raises(TypeError, match=r"means must be a tensor, not an array; torch\.as_tensor\(means\) makes one"):
        gsplat.rasterization(**scene() | {"means": scene()["means"].numpy()})
    with pytest.raises(TypeError, match=r"use RendererConfig_MixedBatch\(\)"):
        gsplat.RendererConfig()
    with pytest.raises(TypeError, match="renderer_config must be"):
        gsplat.rasterization(**scene(), renderer_config=1)


@pytest.mark.parametrize("mode", ["RGB", "ED", "RGB+D"])
def test_results_may_be_edited_in_place(mode):
    """The backward pass then has the gradients of a product with the mask, and sets absgrad."""
    given = scene()
    mask, gradients = torch.rand(2, 30, 40, generator=torch.Generator().manual_seed(1)) > 0.5, []
    for in_place in (True, False):
        means = given["means"].clone().requires_grad_()
        images, alphas, info = gsplat.rasterization(**given | {"means": means}, render_mode=mode, absgrad=True)
        if in_place:
            images[~mask] = 0
            alphas[~mask] = 0
        else:
            images, alphas = images * mask[..., None], alphas * mask[..., None]
        (images.square().sum() + alphas.square().sum()).backward()
        gradients.append((means.grad, info["means2d"].absgrad))
    for edited, multiplied in zip(*gradients, strict=True):
        assert torch.equal(edited, multiplied) and bool(edited.any())


def test_harmonics_and_rotations():
    """Of any channels, degrees, batch axes, packed rows and masks; as colours of two channels they are clamped."""
    given, generator = scene((2,), torch.float64), torch.Generator().manual_seed(2)
    given["viewmats"] = given["viewmats"].clone()
    given["viewmats"][..., :3, :3] = rotations(torch.randn(4, 4, generator=generator, dtype=torch.float64)).view(2, 2, 3, 3)
    means, poses = given["means"], given["viewmats"]
    coeffs = torch.randn(COUNT, 16, 3, generator=generator, dtype=torch.float64)
    centers = torch.linalg.inv(poses)[..., :3, 3]
    away = (means[:, None] - centers[:, :, None]).flatten(0, 2)
    wanted = colors_reference(coeffs.repeat(4, 1, 1), away / away.norm(dim=-1, keepdim=True), 2).view(2, 2, COUNT, 3)
    found = gsplat.spherical_harmonics(2, means, poses, coeffs)
    torch.testing.assert_close(found, wanted)
    mask = torch.rand(2, 2, COUNT, generator=generator) > 0.5
    b, c, g = mask.nonzero().T
    torch.testing.assert_close(gsplat.spherical_harmonics(2, means, poses, coeffs, mask), wanted * mask[..., None])
    packed = gsplat.spherical_harmonics(2, means, poses, coeffs[g], None, b, c, g)
    torch.testing.assert_close(packed, wanted[mask])
    between = gsplat.spherical_harmonics(2, means, poses, coeffs, viewmats_rs=poses.flip(1))
    torch.testing.assert_close(between[:, 0], between[:, 1])
    with pytest.raises(ValueError, match=r"viewmats must have shape \[..., C, 4, 4\], not \[4, 4\]; viewmats\[None\]"):
        gsplat.rasterization(**scene() | {"viewmats": torch.eye(4)})
    with pytest.raises(ValueError, match="at least 25 rows"):
        gsplat.spherical_harmonics(4, means, poses, coeffs)
    two = gsplat.rasterization(**scene((2,)) | {"colors": coeffs[..., :2].float()}, sh_degree=2)[0]
    values = gsplat.spherical_harmonics(2, scene((2,))["means"], scene((2,))["viewmats"], coeffs[..., :2].float())
    given = scene((2,)) | {"colors": (values + 0.5).clamp_min(0)}
    assert torch.equal(two, gsplat.rasterization(**given)[0]) and bool((values < -0.5).any())
    quats = given["quats"].double()
    torch.testing.assert_close(gsplat.quat_to_rotmat(3 * quats)[1], rotations(quats[1]))
    # a fisheye that is sorted by z has distances alone: a key that would be wrong is absent
    meta = gsplat.rasterization(**scene(), camera_model="fisheye")[2]
    assert "depths" not in meta and "conics" in meta


def test_a_decoder_of_anysplat_changes_its_import_alone():
    """Covariances beside shapes, a near plane of almost 0, a clip, and depth as fourth channel, which is split off."""
    given, coeffs = scene(), torch.rand(COUNT, 16, 3, generator=torch.Generator().manual_seed(3)) - 0.5
    axes = rotations(given["quats"]) * given["scales"][:, None]
    covars = (axes @ axes.mT).requires_grad_()
    shapes = [given[n] for n in ("means", "quats", "scales", "opacities")]
    options = {"sh_degree": 3, "render_mode": "RGB+D", "packed": False, "near_plane": 1e-10, "radius_clip": 0.1}
    options |= {"backgrounds": torch.ones(1, 3), "rasterize_mode": "classic"}
    images, depths = [], []
    for i in range(VIEWS):
        camera = given["viewmats"].inverse()[i : i + 1].inverse(), given["Ks"][i : i + 1], WIDTH, HEIGHT
        render, alpha, _ = gsplat.rasterization(*shapes, coeffs, *camera, covars=covars, **options)
        image, depth = torch.split(render, [3, 1], dim=-1)
        wanted, opacity, _ = gsplat.rasterization(*shapes, coeffs, *camera, **options)
        torch.testing.assert_close((render, alpha), (wanted, opacity), atol=1e-4, rtol=1e-4)
        images.append(image.clamp(0, 1).permute(0, 3, 1, 2))
        depths.append(depth)
    (torch.cat(images).mean() + torch.cat(depths).mean()).backward()
    assert torch.cat(images).shape == (VIEWS, 3, HEIGHT, WIDTH) and bool(alpha.any())
    # gsplat reads the upper triangle, which has the whole gradient
    assert bool(covars.grad.triu(1).any()) and not bool(covars.grad.tril(-1).any())
