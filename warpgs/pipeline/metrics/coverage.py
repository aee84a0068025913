"""Scores by coverage: how many training views saw the surface of each pixel."""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs.constants import NEAR
from warpgs.device import in_background
from warpgs.files import make_folder, read_file, write_bytes
from warpgs.geometry import check_pinhole, evenly_spaced, pinhole_of, resized
from warpgs.io.image_files import decode
from warpgs.io.images import without_masked
from warpgs.kernels.ssim import ssim
from warpgs.mesh.views import MIN_ALPHA, TOLERANCE, depth_difference, seen_from
from warpgs.pipeline.metrics.scores import Renders, psnr_of, scored_pair
from warpgs.priors.given_depth import pinhole_view
from warpgs.process import Say, counted, silent
from warpgs.report.images import COVERAGE_LEGEND, channel_mean, coverage_image, png, webp
from warpgs.report.page import Section
from warpgs.scene import Camera, View

GRID = 32
"""Number of points along the longer side of an image that `fraction_outside` checks."""
MAX_PIXELS = 2**26
"""Largest total number of pixels of all depth maps, 256 MiB; above it, maps are rendered at a smaller size."""


DepthView = tuple[Camera, torch.Tensor]
"""A training view's pinhole camera (numpy) at the size of the depth, and the model's expected z-depth [u], float32, shape
[H, W]; 0 where the model shows no surface, or the mask of the view hides it."""


@torch.no_grad()
def depth_views(
    renders: Renders, cameras: Sequence[Camera], masks: Sequence[np.ndarray | None] | None = None
) -> list[DepthView]:
    """Render the depth of every training view once, 0 outside ``masks`` [H, W]; smaller if all maps exceed `MAX_PIXELS`."""
    factor = min(1.0, (MAX_PIXELS / max(1, sum(c.width * c.height for c in cameras))) ** 0.5)
    views = []
    for camera, mask in zip(cameras, masks or [None] * len(cameras)):
        small = resized(pinhole_of(camera), factor)
        _, depth, alpha = (torch.from_numpy(a).to(renders.gaussians.means.device) for a in renders(small))
        depth = torch.where(alpha >= MIN_ALPHA, depth, 0)
        if mask is not None:
            counts = torch.as_tensor(mask, dtype=torch.float32, device=depth.device)[None, None]
            depth = torch.where(torch.nn.functional.interpolate(counts, depth.shape, mode="area")[0, 0] > 0.5, depth, 0)
        views.append((small, depth))
    return views


def coverage_map(depth: torch.Tensor, camera: Camera, training: Sequence[DepthView]) -> tuple[torch.Tensor, torch.Tensor]:
    """Count the training views that saw the point at each pixel of a render with depth [H, W] [u], 0 for no surface.

    Returns the counts, int32, and the least difference of depths to a training view, infinite in no training image; [H, W].
    """
    # A view saw a point that is in its image, inside its mask, and on its rendered surface: neither behind the surface
    # (occluded) nor in front of it (the view looks through). Counts use the model's depth, so they are as accurate as the
    # model's geometry.
    check_pinhole(camera)
    counts, least = torch.zeros_like(depth, dtype=torch.int32), torch.full_like(depth, torch.inf)
    for view in training:
        _, _, difference = depth_difference(depth, camera, *view)
        counts += difference <= TOLERANCE
        least = torch.minimum(least, difference)
    return counts, least


def fraction_outside(depth: torch.Tensor, camera: Camera, photographs: Sequence[Camera], empty: bool = True) -> float:
    """Return the fraction of a render's pixels, on a grid, that show a point outside the images of all photographs."""
    small = resized(camera, min(1.0, GRID / max(camera.width, camera.height)))
    rows, columns = (
        ((torch.arange(few, device=depth.device) + 0.5) * (many / few)).long()
        for few, many in ((small.height, camera.height), (small.width, camera.width))
    )
    points = depth[rows][:, columns].cpu()
    if not (shown := points > 0).any():
        return 0.0
    outside = torch.ones_like(shown) if empty else shown
    points = torch.where(shown, points, points[shown].median())
    for other in sorted(photographs, key=lambda c: float(np.linalg.norm(c.center - camera.center))):
        u, v, z = seen_from(points, small, pinhole_of(other))
        outside = outside & ~((z > NEAR) & (u >= 0) & (u < other.width) & (v >= 0) & (v < other.height))
        if not outside.any():  # mostly after the nearest few
            break
    return float(outside.float().mean())


CLASSES = {"0": "seen by no training view", "1": "seen by one", "2+": "seen by two or more", "background": "transparent, empty"}
"""Classes of pixels, with a description of each for the user. If no view of a scene has an alpha channel, no pixel is
background."""
BINS = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, np.inf)
"""Upper bounds of the classes of depth difference, each with its expected error; the last class has no bound."""
PROBED = 6
"""Largest number of training views that are compared with each other, evenly spaced: 6 give 30 ordered pairs."""


@torch.no_grad()
def photo_errors(train: Sequence[View], training: Sequence[DepthView]) -> np.ndarray | None:
    """Return the mean squared colour difference of two photographs of a point by class of `BINS`, [8]; None without pixels."""
    # Each photograph is warped to another view by the model's depth and compared with the photograph there, pixel by pixel. The
    # result estimates the error of a pixel from its least depth difference to a training view. The estimate uses the data that
    # the model was fitted to. It includes differences between the photographs, such as reflections and exposure.
    chosen = evenly_spaced(range(len(train)), PROBED)
    photos = {i: _photo(train[i], training[i][1]) for i in chosen}

    def compared() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        for i, j in itertools.permutations(chosen, 2):
            u, v, difference = (t.flatten() for t in depth_difference(training[i][1], training[i][0], *training[j]))
            at = torch.isfinite(difference).nonzero()[:, 0]
            error = (_sampled(photos[j], u[at], v[at]) - photos[i].reshape(-1, 3).index_select(0, at)).double().square().mean(1)
            yield _bin(difference[at]), error.cpu().numpy()

    def sums(index: np.ndarray, error: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(index, error, len(BINS)), np.bincount(index, minlength=len(BINS))])

    total, count = sum(in_background(sums, compared()), np.zeros((2, len(BINS))))
    if not count.any():
        return None
    errors = np.divide(total, count, out=np.full(len(BINS), np.nan), where=count > 0)
    known = np.flatnonzero(count)
    return errors[known[np.maximum(np.searchsorted(known, np.arange(len(BINS)), "right") - 1, 0)]]


def _bin(difference: torch.Tensor) -> np.ndarray:
    """Return the class of `BINS` of each difference, uint8."""
    bounds = torch.tensor(BINS, dtype=torch.float32, device=difference.device)
    return torch.bucketize(difference, bounds, out_int32=True).to(torch.uint8).cpu().numpy()


def _photo(view: View, depth: torch.Tensor) -> torch.Tensor:
    """Return the image of a view at the size and on the device of its depth, shape [H, W, 3]."""
    image = torch.as_tensor(without_masked(view).image, dtype=torch.float32, device=depth.device)
    if image.shape[:2] == depth.shape:
        return image
    return torch.nn.functional.interpolate(image.permute(2, 0, 1)[None], depth.shape, mode="area")[0].permute(1, 2, 0)


def _sampled(image: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Return the colours [S, 3] of an image [H, W, 3] at columns and rows [S] [px], linear between pixels."""
    height, width = image.shape[:2]
    x, y = (u - 0.5).clamp(0, width - 1), (v - 0.5).clamp(0, height - 1)
    left, top = x.long(), y.long()
    right, bottom = (left + 1).clamp(max=width - 1), (top + 1).clamp(max=height - 1)
    a, b = (x - left)[:, None], (y - top)[:, None]
    flat, top, bottom = image.reshape(-1, 3), top * width, bottom * width
    above = (1 - a) * flat.index_select(0, top + left) + a * flat.index_select(0, top + right)
    below = (1 - a) * flat.index_select(0, bottom + left) + a * flat.index_select(0, bottom + right)
    return (1 - b) * above + b * below


def classes_of(counts: torch.Tensor, empty: torch.Tensor) -> dict[str, np.ndarray]:
    """Return the pixels of each class of `CLASSES`, bool [H, W]; those of ``empty`` are background."""
    counts, empty = counts.cpu().numpy(), empty.cpu().numpy()
    return {"0": (counts == 0) & ~empty, "1": counts == 1, "2+": counts >= 2, "background": empty}


def _sums(view: View, image: np.ndarray, classes: dict[str, np.ndarray], expected: np.ndarray | None) -> dict[str, np.ndarray]:
    """Return for each class the number of scored pixels and the sums over them of squared error, SSIM and expected error."""
    image, target, region, _ = scored_pair(view, image)
    error = channel_mean(np.square(image.astype(np.float64) - target))
    similarity = channel_mean(ssim(torch.from_numpy(image), torch.from_numpy(target)).numpy().astype(np.float64))
    maps = [error, similarity, *([] if expected is None else [expected])]
    inside = {c: np.flatnonzero(m if region is None else m & region) for c, m in classes.items()}
    return {c: np.array([len(at), *(m.take(at).sum() for m in maps), *([0.0] * (3 - len(maps)))]) for c, at in inside.items()}


def _row(sums: dict[str, np.ndarray], expected: bool) -> dict[str, dict[str, Any]]:
    """Return the figures of each class that has pixels."""
    pixels, error = (sum(s[i] for s in sums.values()) for i in (0, 1))
    rows = {}
    for name, (count, squares, similarity, foretold) in sums.items():
        if count:
            rows[name] = {
                "pixels": int(count), "share_of_pixels": float(count / pixels),
                "share_of_error": float(squares / error) if error else 0.0,
                "psnr": psnr_of(float(squares / count)), "ssim": float(similarity / count),
                "expected_psnr": psnr_of(float(foretold / count)) if expected else None,
            }  # fmt: skip
    return rows


FOLDER = "coverage"
"""Folder in a run folder with an image of each held-out view."""
EXPECTED = (
    "The expected PSNR is an estimate from training data, not a bound. It is the PSNR between training photographs where the "
    "depths of two views differ as much as at the scored pixels."
)
"""Meaning of the expected PSNR, as text for the user."""


def coverage_of_run(
    out: Path | None, renders: Renders, train: list[View], test: list[View], *, names: Mapping[str, str], tell: Say = silent
) -> dict[str, Any]:
    """Split the scores of held-out views by coverage, and save an image of each view in ``out``, if any."""
    tell("checking coverage")
    if out is not None:
        make_folder(out / FOLDER)
    train, test = ([pinhole_view(v) for v in views] for views in (train, test))
    training = depth_views(renders, [v.camera for v in train], [v.mask for v in train])
    errors = photo_errors(train, training)
    transparent = any(v.alpha is not None for v in (*train, *test))

    def covered() -> Iterator[tuple[View, np.ndarray, torch.Tensor, torch.Tensor, np.ndarray]]:
        for view in counted(test, tell, "checking coverage", "views"):
            image, depth, alpha = renders(view.camera)
            surface = torch.from_numpy(np.where(alpha >= MIN_ALPHA, depth, 0)).to(renders.gaussians.means.device)
            counts, difference = coverage_map(surface, view.camera, training)
            yield view, image, counts.cpu(), ((surface <= 0) & transparent).cpu(), _bin(difference)

    def finish(view: View, image: np.ndarray, counts: torch.Tensor, empty: torch.Tensor, index: np.ndarray) -> dict[str, Any]:
        classes = classes_of(counts, empty)
        if out is not None:
            write_bytes(out / FOLDER / f"{names[view.name]}.png", png(coverage_image(image, classes["0"], classes["1"])))
        return _sums(view, image, classes, None if errors is None else errors.take(index))

    sums = in_background(finish, covered())
    views = [{"name": v.name, "classes": _row(own, errors is not None)} for v, own in zip(test, sums)]
    pooled = _row({c: sum((own[c] for own in sums), np.zeros(4)) for c in CLASSES}, errors is not None)
    unseen = pooled.get("0")
    summary = "every held-out pixel was seen by a training view"
    if unseen:
        pixels, loss = (f"{100 * unseen[f'share_of_{what}']:.3g} %" for what in ("pixels", "error"))
        summary = f"{pixels} of the held-out pixels were seen by no training view; they account for {loss} of the squared error"
    return {
        "classes": pooled, "views": views, "tolerance": TOLERANCE, "depth_differences": list(BINS[:-1]),
        "photo_psnr": None if errors is None else [psnr_of(e) for e in errors.tolist()], "summary": summary,
    }  # fmt: skip


def coverage_table(coverage: dict[str, Any]) -> list[list[str]]:
    """Return a header row and a row for each class of pixels of each view, then of all views together, as texts."""
    rows = [["view", "pixels", "share", "squared error", "PSNR [dB]", "SSIM", "expected PSNR [dB]"]]
    for name, classes in [*((v["name"], v["classes"]) for v in coverage["views"]), ("all views", coverage["classes"])]:
        for key, r in classes.items():
            expected = "-" if r["expected_psnr"] is None else f"{r['expected_psnr']:.2f}"
            shares = (f"{100 * r[f'share_of_{what}']:.1f} %" for what in ("pixels", "error"))
            rows.append([name, CLASSES[key], *shares, f"{r['psnr']:.2f}", f"{r['ssim']:.3f}", expected])
    return rows


def coverage_lines(coverage: dict[str, Any]) -> list[str]:
    """Return the table as lines for the user, then a summary, and a legend of the images."""
    rows = coverage_table(coverage)
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = ["  ".join(c.ljust(w) if i < 2 else c.rjust(w) for i, (c, w) in enumerate(zip(r, widths))) for r in rows]
    return [*lines, coverage["summary"], EXPECTED, f"images in {FOLDER}/: {COVERAGE_LEGEND}"]


def coverage_section(out: Path, coverage: dict[str, Any], shown: list[str], names: Mapping[str, str]) -> Section:
    """Return the section of the report page, with the images of the views ``shown``."""
    files = {n: f for n in shown if (f := out / FOLDER / f"{names[n]}.png").is_file()}
    images = in_background(lambda f: webp(decode(f, data=read_file(f, out))[0], 640), ((f,) for f in files.values()))
    head, *rows = coverage_table(coverage)
    return (
        f"{coverage['summary'][0].upper()}{coverage['summary'][1:]}. {EXPECTED}",
        list(zip(files, images)),
        [head[1:], *(r[1:] for r in rows if r[0] == "all views")],
        f"{COVERAGE_LEGEND[0].upper()}{COVERAGE_LEGEND[1:]}.",
    )
