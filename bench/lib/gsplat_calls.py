"""Calls of gsplat's `rasterization` by name, their random inputs, and how images, gradients and meta of two programs differ."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from torch import Tensor

from bench.lib.timing import measure_in_turn
from warpgs.geometry import rotation_matrices

OURS, GSPLAT = "warpgs", "gsplat"
PACKED, TWO = {"packed": True}, {"cameras": 2}
BEHIND, COVARS, CLIP, ABSGRAD = {"behind": True}, {"covariances": True}, {"radius_clip": 4.0}, {"absgrad": True}
ORTHO, FISHEYE = {"camera_model": "ortho", "focal": 0.12}, {"camera_model": "fisheye", "focal": 0.4}
MEAN, SMOOTH, TRAINER = {"render_mode": "RGB+ED"}, {"rasterize_mode": "antialiased"}, {"sh_degree": 3, "render_mode": "RGB+ED"}
CALLS: dict[str, dict] = {
    **{f"{count} channels": {"channels": count} for count in (1, 2, 3, 4, 6, 9, 32)},
    **{f"{mode}, {form}": {"render_mode": mode, "packed": form == "packed"}
       for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED") for form in ("dense", "packed")},
    **{f"degree {degree}": {"sh_degree": degree} for degree in range(4)}, "degree 1 of 3": {"sh_degree": 1, "stored": 3},
    "absgrad": ABSGRAD, "absgrad, packed": ABSGRAD | PACKED | TWO, "absgrad, 9 channels": ABSGRAD | {"channels": 9},
    "batch 2": {"batch": (2,)} | TWO, "batch 1 x 2, packed": {"batch": (1, 2)} | PACKED,
    "colours by camera": {"by_camera": True} | TWO, "backgrounds": BEHIND | TWO,
    "backgrounds, RGB+D": BEHIND | {"channels": 5, "render_mode": "RGB+D"},
    "tiles 16": {"tile_size": 16}, "tiles 4": {"tile_size": 4}, "near 3, far 6": {"near_plane": 3.0, "far_plane": 6.0},
    "radius_clip 4": CLIP, "radius_clip 4, packed": CLIP | PACKED | TWO, "eps2d 0.1": {"eps2d": 0.1},
    "antialiased": SMOOTH, "antialiased, packed": SMOOTH | PACKED | MEAN,
    "covars": COVARS, "covars, packed": COVARS | PACKED | {"sh_degree": 2},
    "ortho": ORTHO, "ortho, packed": ORTHO | PACKED | MEAN, "fisheye": FISHEYE,
    "fisheye, packed": FISHEYE | PACKED, "sparse_grad": {"sparse_grad": True} | PACKED,
    "like simple_trainer": TRAINER | ABSGRAD, "like simple_trainer, packed": TRAINER | ABSGRAD | PACKED,
    "like AnySplat": BEHIND | COVARS | {"sh_degree": 4, "render_mode": "RGB+D", "near_plane": 1e-10, "radius_clip": 0.1},
    "like SplaTAM": {"isotropic": True, "channels": 6},
}  # fmt: skip
"""Keys of `inputs`, and arguments of `rasterization`; packed is False if left out."""
ROWS = ("radii", "means2d", "depths", "conics", "opacities", "tiles_per_gauss")
"""Entries of ``meta`` with a row for each Gaussian of a view."""


def inputs(
    count: int, width: int, height: int, *, channels: int = 3, cameras: int = 1, batch: tuple[int, ...] = (),
    focal: float = 0.8, stored: int = 0, by_camera: bool = False, behind: bool = False, covariances: bool = False,
    isotropic: bool = False, **options,
) -> tuple[dict[str, Tensor], dict]:  # fmt: skip
    """Return the tensors that get gradients, and the other arguments; the focal length is in widths, ``stored`` a degree."""
    rand, degree = functools.partial(torch.rand, generator=torch.Generator().manual_seed(55)), options.get("sh_degree")
    z = 1 + 8 * rand(*batch, count, 1)
    means = torch.cat([(2 * rand(*batch, count, 2) - 1) * torch.tensor([0.7, 0.7 * height / width]) * z, z], -1)
    quats, opacities = 2 * rand(*batch, count, 4) - 1, 0.05 + 0.9 * rand(*batch, count)
    scales = 0.005 * 12 ** rand(*batch, count, 1 if isotropic else 3).expand(*batch, count, 3)
    axes = rotation_matrices(torch.nn.functional.normalize(quats, dim=-1)) * scales[..., None, :]
    shape = {"covars": axes @ axes.mT} if covariances else {"quats": quats, "scales": scales}
    if degree is None:
        colors = rand(*batch, *([cameras] if by_camera else []), count, channels)
    else:
        colors = rand(count, (1 + max(degree, stored)) ** 2, 3) - 0.5
    viewmats = torch.eye(4).repeat(*batch, cameras, 1, 1)
    viewmats[..., :3, 3] += 0.2 * rand(*batch, cameras, 3)
    leaves = {"means": means, **shape, "opacities": opacities, "colors": colors, "viewmats": viewmats}
    leaves |= {"backgrounds": rand(*batch, cameras, colors.shape[-1])} if behind else {}
    f, device = focal * width, "cuda" if torch.cuda.is_available() else "cpu"
    Ks = torch.tensor([[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]], device=device).repeat(*batch, cameras, 1, 1)
    leaves = {name: t.to(device).contiguous().requires_grad_() for name, t in leaves.items()}
    absent = dict.fromkeys({"quats", "scales"} - leaves.keys())
    return leaves, absent | {"Ks": Ks, "width": width, "height": height, "packed": False} | options


@functools.lru_cache(maxsize=2)
def upstream(shape: torch.Size, device: torch.device) -> Tensor:
    """Return a fixed random gradient of an image or its alphas."""
    return torch.rand(shape, device=device, generator=torch.Generator(device).manual_seed(1)) - 0.5


def drawn(rasterization: Callable, leaves: dict[str, Tensor], arguments: dict) -> tuple[Tensor, Tensor, dict]:
    """Return image, alphas and ``meta`` after the backward pass, whose gradients are in the leaves."""
    for leaf in leaves.values():
        leaf.grad = None
    image, alphas, meta = rasterization(**leaves, **arguments)
    meta["means2d"].retain_grad()
    torch.autograd.backward([image, alphas], [upstream(t.shape, t.device) for t in (image, alphas)])
    return image.detach(), alphas.detach(), meta


def difference(ours: Tensor | None, theirs: Tensor | None, unit: float | None = None) -> list[float] | str | None:
    """Return the largest and the median difference in a unit, by default gsplat's largest value; None if both are None."""
    if ours is None or theirs is None or ours.shape != theirs.shape:
        shapes = [None if t is None else list(t.shape) for t in (ours, theirs)]
        return None if ours is theirs else f"shapes {shapes[0]} and {shapes[1]}"
    ours, theirs = (t.detach().to_dense().double() for t in (ours, theirs))
    off, scale = (ours - theirs).abs().flatten(), unit or float(theirs.abs().amax() if theirs.numel() else 0) or 1.0
    return [float(off.max()) / scale, float(off.median()) / scale] if len(off) else [0.0, 0.0]


def spread(meta: dict, values: Tensor | None, count: int) -> Tensor | None:
    """Return values of ``meta`` with a row for each Gaussian of each view [views, N, ...], whether packed or not."""
    views, owners = meta["n_batches"] * meta["n_cameras"], meta["gaussian_ids"]
    if values is None or owners is None:
        return None if values is None else values.reshape(views, count, -1)
    view = meta["camera_ids"].long() + (0 if meta["batch_ids"] is None else meta["batch_ids"].long() * meta["n_cameras"])
    dense, values = values.new_zeros(views * count, *values.shape[1:]), values.to_dense()
    dense[view * count + owners.long()] = values
    return dense.reshape(views, count, -1)


def meta_row(ours: dict, theirs: dict, count: int) -> dict:
    """Return the entries that are equal, the differences of others, those that one program lacks, and how many are visible."""
    by_ours, by_theirs = ((spread(m, m["radii"], count) > 0).all(-1) for m in (ours, theirs))
    seen = by_ours & by_theirs
    row: dict = {"equal": [], "differ": {}, "absent": sorted(ours.keys() ^ theirs.keys())}
    row["visible"] = {OURS: int(by_ours.sum()), GSPLAT: int(by_theirs.sum()), "both": int(seen.sum())}
    for name in sorted(ours.keys() & theirs.keys()):
        a, b = ours[name], theirs[name]
        if not isinstance(a, Tensor) or not isinstance(b, Tensor):
            off = None if a == b else f"{a!r:.40} and {b!r:.40}"
        elif a.dtype != b.dtype:
            off = f"{a.dtype} and {b.dtype}"
        else:
            whole = [spread(m, t, count)[seen] if name in ROWS else t for m, t in ((ours, a), (theirs, b))]
            off = None if torch.equal(a, b) else difference(*whole)
        row["differ"] |= {} if off is None else {name: off}
        row["equal"] += [name] if off is None else []
    for name in ("grad", "absgrad"):
        pair = [spread(m, getattr(m["means2d"], name, None), count) for m in (ours, theirs)]
        row[f"means2d.{name}"] = difference(*pair)
    return row


def row_of(options: dict, programs: dict[str, Callable], count: int, width: int, height: int, repeats: int) -> dict:
    """Return the differences of a call between two programs and the times of both, or why a program refuses it."""
    leaves, arguments = inputs(count, width, height, **options)
    made, gradients, refused = [], [], {}
    for who, rasterization in programs.items():
        try:
            made.append(drawn(rasterization, leaves, arguments))
            gradients.append({name: leaf.grad for name, leaf in leaves.items()})
        except Exception as e:  # whatever a program refuses a call with, the other calls follow
            refused[who] = " ".join(f"{type(e).__name__}: {e}".split())[:200]
    if refused:
        return {"refused": refused}
    (image, alphas, ours), (other, opaque, theirs) = made
    colors = image.shape[-1] - ((mode := options.get("render_mode", "RGB")) != "RGB")
    row = {"alpha_levels": difference(alphas, opaque, 1 / 255), "meta": meta_row(ours, theirs, count)}
    if colors:
        row["image_levels"] = difference(image[..., :colors], other[..., :colors], 1 / 255)
    if mode != "RGB":
        row["depth"] = difference(image[..., colors:], other[..., colors:])
    row["gradients"] = {name: difference(*(g[name] for g in gradients)) for name in leaves}
    works = [functools.partial(drawn, rasterization, leaves, arguments) for rasterization in programs.values()]
    times = measure_in_turn(works, image.device, repeats)
    return row | {"ms": {who: t["median_ms"] for who, t in zip(programs, times, strict=True)}}
