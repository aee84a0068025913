"""Real sizes: scale, upward direction and geographic place of a run's files, by picked points, poses or GPS."""

import contextlib
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from warpgs import schema
from warpgs.errors import DataError, ResourceError, UsageError, WarpgsError, did_you_mean, similar_folder
from warpgs.export.ply import write_ply
from warpgs.files import write_json
from warpgs.geometry import back_project, convert_points, matmul, project_points
from warpgs.io.image_files import BRANDS_END, brand, format_of, header_size, read_gps, read_image_file
from warpgs.locks import hold_folder
from warpgs.mesh.views import CONTRIBUTORS, MIN_ALPHA, surface_depth
from warpgs.pipeline.model.edit import drop_unused_sh, levelling, numbers_of
from warpgs.pipeline.model.table import FittedModel, similarity_values
from warpgs.pipeline.run.commands import scene_of
from warpgs.pipeline.run.folder import CONFIG, StoredRun, open_run, read_record
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Normalization

Place = tuple[np.ndarray, np.ndarray, str]
"""Point of the scene [3] [u], the covariance of its error [3, 3] [u²], and its source: of `ERRORS`, "edge" or "given"."""
Levelled = tuple[Normalization, str]
"""New similarity, and a line for the user."""
HIDDEN = 0.1
"""Another camera does not see a point that is behind its rendered depth by more than this fraction."""
AROUND, SAME, EDGE, TRIMS = 0.025, 0.04, 2, 5
"""Half the window around a pick, relative to the longer side; relative difference of depth of one surface; distance [px] within
which another surface makes an edge; rounds of the fit.
At 1,500 random picks of the demo, depths are within 0.32 (median) and 1.5 % (95 %); those of single pixels 0.28 and 2.0 %."""
ERRORS = {"matched": 0.005, "shown": 0.04, "alone": 0.2}
"""Least relative error of a pick's depth: matched in photographs, or of the model, if another camera shows the place, and if
none does. Of 1,500 random picks on a quick fit of the demo, it holds for 93 % (within 8 px of an edge, 91 %), and the error
of a length that follows for 95 % of lengths over 1 u. The numbers were chosen on these picks; on another demo, 95 and 96 %."""
SEARCH, STEPS, PATCH, NEAR, ALIKE, FLAT = 0.04, 81, 5, 4, 0.98, 0.01
"""Largest relative change of a pick's inverse depth by photographs; number of candidates; half the side of the compared patch
[px]; number of nearest photographs beside the first; least correlation with each of them; and least standard deviation of a
patch with texture. Of 1,500 random picks on a quick fit of the demo, 75 % are matched (within 8 px of an edge, 46 %): error of
their depth 0.10 % (median), 0.38 % (90 %), below 1 % for 99.3 % (within 8 px of an edge, 98.0 %). They chose these numbers; on
another demo, 76 % are matched, and 99.1 % of them are within 1 % (97.5 %)."""
EXACT = "the given coordinates count as exact"
LEAST = 1e-6
"""Least distance of picked points [u]."""
TIPPED = 45.0
"""Median angle [deg] between the ground's normal and the photographs' upward axes above which the points may be on a wall."""
UNSURE = 2.0
"""Uncertainty of the ground's tilt above which more points are asked for [deg]. On a quick fit of a demo that chose no number,
of 3,000 grounds by 3, 5 and 8 of 102 matched picks 70, 95 and 99.7 % are within 1 degree; below this bound, 92 % or more."""
LEANING = math.radians(3)
"""Angle from level at which the weight of a photograph is halved."""
SURE = 1.0
"""Distance between GPS and pose at which a photograph is no outlier [m]: phones are off by metres."""
EARTH, SQUARED = 6378137.0, 0.00669437999014
"""Equatorial radius [m] and squared eccentricity of WGS 84."""


@torch.no_grad()
def pixel_depth(model: FittedModel, camera: Camera, x: float, y: float, what: str = "the point") -> tuple:
    """Return depths [H, W] [u], infinite on background, and what `plane_depth` does at a pixel; UsageError on background."""
    if not (0 <= x < camera.width and 0 <= y < camera.height):
        raise UsageError(f"{what}: outside of the image, which has {camera.width} x {camera.height} px in this run, as fitted")
    r = rasterize(model.gaussians(), camera, replace(model.options(), heaviest=CONTRIBUTORS * (camera.model == "pinhole")))
    depth, alpha, row, column = r.depth, r.alpha.cpu().numpy(), int(y), int(x)
    if camera.model == "pinhole":  # as in meshes: the mean depth makes steps on slanted surfaces
        depth, _ = surface_depth(model.gaussians(), camera, r.heaviest_ids, r.heaviest_weights)
    if not alpha[row, column] >= MIN_ALPHA:
        raise UsageError(f"{what}: shows empty background (opacity {alpha[row, column]:.2f}); pick a point on a surface")
    depths = np.where(alpha >= MIN_ALPHA, depth.cpu().numpy().astype(np.float64), np.inf)
    return depths, *plane_depth(depths, row, column)


def plane_depth(depth: np.ndarray, row: int, column: int) -> tuple[float, ...]:
    """Return the depth at a pixel of the plane through its neighbours [H, W], their spread about it [u], and its slopes.

    At an edge, the spread is the step to the other surface: at least `SAME` of the depth. Slopes are those of the inverse depth
    over that at the pixel, to the right and down [1/px].
    """
    # a surface that was fitted to photographs is wavy, and the inverse depth of a plane is linear in pixels; neighbours of
    # another depth are of another surface, and those far off the plane are trimmed
    half, here = max(EDGE, round(AROUND * max(depth.shape))), 1 / depth[row, column]
    rows, columns = (np.s_[max(0, at - half) : at + half + 1] for at in (row, column))
    inverse = 1 / depth[rows, columns]
    y, x = np.indices(inverse.shape).reshape(2, -1) + np.array([[rows.start - row], [columns.start - column]])
    terms, inverse = np.column_stack([np.ones(len(x)), x, y]), inverse.ravel()
    kept = same = np.abs(inverse / here - 1) < SAME
    for _ in range(TRIMS):
        plane = np.linalg.lstsq(terms[kept], inverse[kept], rcond=None)[0]
        off = np.abs(terms @ plane - inverse)
        kept = same & (off <= 2.5 * 1.4826 * np.median(off[kept]) + 1e-9 * here)  # of normal errors, 99 % stay
    near = np.maximum(abs(x), abs(y)) <= EDGE
    step = np.divide(off, inverse, out=np.full(len(off), SAME), where=inverse > 0)[near].max()  # background has no depth
    spread = np.sqrt(np.square(off[kept]).mean()) / here**2 if step < SAME else step / plane[0]
    return tuple(map(float, (1 / plane[0], spread, plane[1] / plane[0], plane[2] / plane[0])))


def matched_depth(
    photographs: Mapping[str, np.ndarray], cameras: Mapping[str, Camera], camera: Camera, pixel: tuple[int, int], depth: float,
    slopes: Sequence[float], depths: np.ndarray,
) -> float | None:  # fmt: skip
    """Return the depth [u] at a camera's pixel (column, row) at which patches of at least three photographs look alike.

    The nearest of the ``photographs`` [H, W, 3], by name, that shows the place is compared with others. Only pixels whose
    ``depths`` [H, W] [u] in the camera belong to the surface of the pixel count. None without texture, with fewer than two
    others that look alike, or if these disagree.
    """
    import cv2

    center = np.add(pixel, 0.5)
    place, seen = back_project(camera, center[None], np.array([depth])), []
    for name in sorted(photographs, key=lambda n: (float(np.linalg.norm(cameras[n].center - camera.center)), n)):
        (at,), (ahead,) = project_points(cameras[name], place)
        if ahead > 0 and (at >= PATCH).all() and (at <= np.array(photographs[name].shape[1::-1]) - PATCH).all():
            seen.append((name, cameras[name].K[0, 0] / ahead))
    if len(seen) < 3 or camera.model != "pinhole":
        return None
    side = PATCH + EDGE  # of the pixels that are compared, all within EDGE show the picked surface
    down, right = np.mgrid[-side : side + 1, -side : side + 1] * (camera.K[0, 0] / depth / seen[0][1])
    x, y = np.float32(right + pixel[0]), np.float32(down + pixel[1])
    steps = (1 + slopes[0] * right + slopes[1] * down) / depth * cv2.remap(np.float32(depths), x, y, cv2.INTER_NEAREST) - 1
    kept = cv2.erode(np.uint8(np.abs(steps) < SAME / 2), np.ones([2 * EDGE + 1] * 2), borderType=0, borderValue=0) > 0
    if kept.sum() < (2 * PATCH + 1) ** 2 / 2:
        return None
    down, right, changes = down[kept], right[kept], np.linspace(-SEARCH, SEARCH, STEPS)
    inverse = (1 + slopes[0] * right + slopes[1] * down) / depth * (1 + changes[:, None])
    points = back_project(camera, np.tile(np.column_stack([right, down]) + center, (STEPS, 1)), 1 / inverse.ravel())
    patches = []
    for name, _ in seen[: NEAR + 1]:
        places, ahead = project_points(cameras[name], points)
        x, y = np.where(ahead > 0, places.T - 0.5, -1).astype(np.float32)
        grey = photographs[name].mean(-1, dtype=np.float32)
        shown = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=np.nan)
        patch = shown.reshape(STEPS, -1) - shown.reshape(STEPS, -1).mean(1, keepdims=True)
        length = np.linalg.norm(patch, axis=1, keepdims=True)
        patches.append(patch / np.where(length > FLAT * math.sqrt(patch.shape[1]), length, np.nan))
    found = []
    for patch in patches[1:]:
        alike = (patches[0] * patch).sum(1)
        best = int(np.argmax(np.where(np.isfinite(alike), alike, -1)))
        around = alike[best - 1 : best + 2]
        if len(around) == 3 and around[1] >= ALIKE and (bend := 2 * around[1] - around[0] - around[2]) > 0:  # false for NaN
            found.append(changes[best] + (around[2] - around[0]) / (2 * bend) * (changes[1] - changes[0]))
    sure = len(found) > 1 and np.std(found) <= ERRORS["matched"]
    return float(depth / (1 + np.mean(found))) if sure else None


def place_at(
    model: FittedModel, camera: Camera, x: float, y: float, photographs: Mapping[str, np.ndarray], what: str = "the point"
) -> Place:
    """Return the surface point at a pixel; its errors are half a pixel, and the depth's spread or at least that of `ERRORS`.

    Where ``photographs`` [H, W, 3], by name, match, the depth is theirs.
    """
    depths, z, spread, *slopes = pixel_depth(model, camera, x, y, what)
    edge = spread >= SAME * z
    matched = None if edge else matched_depth(photographs, model.scene_cameras, camera, (int(x), int(y)), z, slopes, depths)
    z, spread = (matched, 0.0) if matched else (z, spread)
    pixels = np.array([[0.5, 0.5], [0.5, 0.5], [1, 0.5], [0.5, 1]]) + np.floor([x, y])
    point, ahead, *others = back_project(camera, pixels, np.array([z, 2 * z, z, z]))
    aside = [(float(np.linalg.norm(c.center - camera.center)), c) for c in map(model.scene_cameras.get, model.train)]
    near = [c for far, c in sorted(aside, key=lambda pair: pair[0]) if far > 1e-3 * z][: 0 if matched else 4]
    shown = not model.train or any(_shows(model, c, point) for c in near)  # a file of Gaussians has no cameras to ask
    certain = "matched" if matched else "shown" if shown else "alone"
    moves = np.array([max(spread / z, ERRORS[certain]) * (ahead - point), *(other - point for other in others)])
    return point, matmul(moves.T, moves), "edge" if edge else certain


def _shows(model: FittedModel, camera: Camera, point: np.ndarray) -> bool:
    """Return whether a point [3] [u] is in a camera's image and not behind what that shows."""
    pixel, (ahead,) = project_points(camera, point[None])
    with contextlib.suppress(UsageError):
        return bool(ahead > 0 and pixel_depth(model, camera, *pixel[0])[1] >= (1 - HIDDEN) * ahead)
    return False


def fitted_size(run: StoredRun, name: str) -> str:
    """Return the size of a view, in words, and that of its photograph if its file is found and has another size."""
    home, camera, more = Path(run.record["scene"]["path"] or run.folder), run.scene_cameras[name], ""
    with contextlib.suppress(StopIteration, ValueError, WarpgsError):
        data = read_image_file(next(f for f in (home / "images" / name, home / name) if f.is_file()))
        size = header_size(format_of(data), data)
        more = "; the file has {} x {}".format(*size) * (sorted(size) != sorted((camera.width, camera.height)))
    return f"{camera.width} x {camera.height} px as fitted{more}"


def photographs_of(run: StoredRun) -> tuple[dict[str, np.ndarray], str]:
    """Return the training photographs of a run [H, W, 3] by name, and an empty text; else none, and why."""
    try:
        return {v.name: v.image for v in scene_of(run)[1]}, ""
    except WarpgsError as e:
        return {}, f": they cannot be read: {e}"


def matches(places: Sequence[Place], why: str = "") -> str:
    """Return the part of a line for the user on how the depths of picked places were found, and which are at edges."""
    sources = [source for *_, source in places]
    matched, picks = sources.count("matched"), len(sources) - sources.count("given")
    edges = [f"point {i}" for i, source in enumerate(sources, 1) if source == "edge"]
    line = f"; {matched} of {picks} picks were matched in training photographs{why}"
    other = "pick other places for a smaller error" * (matched < picks and not why)
    return line + (f"; at an edge: {', '.join(edges)}; pick places away from edges" if edges else f"; {other}" * bool(other))


def picked(run: StoredRun, text: str, photographs: Mapping[str, np.ndarray]) -> Place:
    """Return the place of VIEW:x,y, a pixel of a photograph, or of x,y,z in file units, which counts as exact."""
    name, colon, words = text.rpartition(":")
    numbers = numbers_of(words.split(","), (2 if colon else 3,), f"{text[:80]}: a point, VIEW:x,y or x,y,z,")
    if not colon:
        return convert_points(numbers[None], run.normalization, "file", "scene")[0], np.zeros((3, 3)), "given"
    if name not in run.scene_cameras:
        near = did_you_mean(name, run.scene_cameras) or f"give a name such as {run.train[0]}"
        raise UsageError(f"{text[:80]}: the run has no view {name[:80]!r}; {near}")
    return place_at(run, run.scene_cameras[name], *numbers, photographs, text)


def distance(n: Normalization, first: Place, second: Place) -> tuple[float, float]:
    """Return the distance of two places [file units] and its relative standard deviation; UsageError for equal places."""
    apart = second[0] - first[0]
    if not (length := float(np.linalg.norm(apart))) > LEAST:
        raise UsageError("the two points are equal; pick two that are apart")
    return length / n.scale, math.sqrt((matmul(first[1] + second[1], apart) * apart).sum()) / length**2


def metres(text: str) -> float:
    """Return the length [m] of a text such as 1.2, 1.2m, 20cm or 35mm."""
    unit = next((u for u in ("mm", "cm", "m") if text.endswith(u)), "")
    number = numbers_of(text.removesuffix(unit), (), f"--scale {text[:40]}: a length, such as 1.2 (metres), 20cm or 35mm,")
    return float(number) * {"mm": 1e-3, "cm": 1e-2}.get(unit, 1.0)


def least_squares(terms: np.ndarray, values: np.ndarray, variances: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the coefficients [K] of terms [N, K] that explain values [N] best, their covariance [K, K], and what is left [N].

    Weights are those of errors with the given variances [N] and a heavy tail, so that a wrong value among many counts little.
    """
    left = np.zeros(len(values))
    for _ in range(20):
        weights = 1 / (variances + left**2 + LEAST**2)
        covariance = np.linalg.inv(matmul((weights[:, None] * terms).T, terms))
        found = matmul(covariance, matmul(terms.T, weights * values))
        left = values - matmul(terms, found)
    return found, covariance, left


def scaled(n: Normalization, places: Sequence[Place], lengths: Sequence[float]) -> Levelled:
    """Give files the scale at which the first two of ``places`` [2 N], and so on, are ``lengths`` [N] apart [m]."""
    if not all(0 < length < math.inf for length in lengths):
        raise UsageError(f"a length must be above 0 m, not {', '.join(f'{length:g}' for length in lengths)}")
    units, errors = np.array([distance(n, *pair) for pair in zip(places[::2], places[1::2])]).T
    (found,), ((variance,),), left = least_squares(np.ones((len(units), 1)), np.log(lengths / units), errors**2)
    factor = math.exp(found)
    n = replace(n, offset=n.origin + (n.offset - n.origin) * factor, scale=n.scale / factor, unit="m")
    line = f"scale: files are {factor:.6g} times as large, in metres; "
    line += f"uncertain by {100 * math.sqrt(variance):.2g} %" if errors.any() else EXACT
    return n, line + f"; in them, lengths are {', '.join(f'{100 * math.expm1(-x):+.2f}' for x in left)} % off" * (len(left) > 1)


def upright(n: Normalization, up: np.ndarray, ground: np.ndarray | None = None) -> Levelled:
    """Turn files so that ``up`` [3] of the scene is up: -y, or z after GPS. Off maps, ``ground`` [3] [u] gets height 0."""
    wanted, own = (np.array([0.0, -1, 0]) if v is None else matmul(n.rotation.T, v) for v in (n.up, up))
    turn, degrees = matmul(levelling(wanted).T, levelling(own)), np.degrees(np.arccos(np.clip((wanted * own).sum(), -1, 1)))
    offset, again = n.origin + matmul(turn, n.offset - n.origin), n.up is not None and not np.allclose(n.up, up, atol=1e-6)
    n = replace(n, rotation=matmul(n.rotation, turn.T), offset=offset, up=up)
    if ground is not None and n.place is None and not n.origin.any():
        n = replace(n, offset=offset - wanted * (convert_points(ground[None], n, "scene", "file") * wanted).sum())
    more = "; this replaces the earlier level" * again
    return n, f"{'z' if wanted[2] > 0.5 else '-y'} is up in files, which were turned by {degrees:.1f} degrees{more}"


def grounded(run: StoredRun, places: Sequence[Place]) -> Levelled:
    """Turn files so that three or more places lie on the ground, below the cameras; more than three by least squares."""
    corners, errors = np.array([point for point, *_ in places]), np.array([error for _, error, _ in places])
    middle = corners.mean(0)
    _, sizes, axes = np.linalg.svd(corners - middle)
    if not sizes[1] > max(LEAST, 0.01 * sizes[0]):
        raise UsageError("--ground: the points are equal or nearly on a line; pick some that span the ground")
    along, heights = np.split(matmul(corners - middle, axes.T), [2], axis=1)
    variances = (matmul(errors, axes[2]) * axes[2]).sum(1)
    terms = np.column_stack([np.ones(len(along)), along])
    (height, *slopes), covariance, left = least_squares(terms, heights[:, 0], variances)
    normal = axes[2] - matmul(np.array(slopes), axes[:2])
    center = np.mean([run.scene_cameras[name].center for name in run.train], axis=0)
    normal *= np.sign(((center - middle) * normal).sum()) / np.linalg.norm(normal)
    n, line = upright(run.normalization, normal, middle + height * axes[2])
    cosines = [-(run.scene_cameras[name].viewmat[1, :3] * normal).sum() for name in run.train]
    tipped = math.degrees(math.acos(np.clip(np.median(cosines), -1, 1)))
    if tipped > TIPPED:
        line += f"; this tips the photographs by {tipped:.0f} degrees: are the points on a wall? "
        line += f"`warpgs level {shlex.quote(str(run.folder))} --up photographs` undoes it"
    tilt = math.degrees(math.sqrt(covariance[1:, 1:].trace()))
    line += f"; the ground's tilt is uncertain by {tilt:.2g} degrees" if errors.any() else f"; {EXACT}"
    worst = int(abs(left).argmax())
    line += f"; point {worst + 1} is farthest off it, by {abs(left[worst]) / n.scale:.2g} {n.unit}" * (len(left) > 3)
    return n, line + "; pick more points, farther apart" * (tilt > UNSURE)


def photographed(run: StoredRun) -> Levelled:
    """Turn files by the photographs: upward is the mean of their upward axes, moved until their horizontal axes are level."""
    rights, downs = (np.array([run.scene_cameras[name].viewmat[i, :3] for name in run.train]) for i in (0, 1))
    weights = np.ones((len(rights), 1))
    for _ in range(20):  # photographs that lean, such as portraits, get small weights
        mean, second = -(weights * downs).sum(0) / weights.sum(), matmul((weights * rights).T, rights) / weights.sum()
        if not np.linalg.norm(mean) > 0.5:
            raise DataError(f"{run.folder}: the photographs have no common upward direction; use --ground")
        up = np.linalg.solve(second + 0.01 * np.eye(3), mean)  # least squares; the mean decides where no axis points
        up /= np.linalg.norm(up)
        leaning = np.arcsin(np.clip(matmul(rights, up), -1, 1))
        weights = 1 / (1 + (leaning[:, None] / LEANING) ** 2)
    n, line = upright(run.normalization, up)
    more = "; all look one way, so their tilt forwards remains: --ground is better" * int(np.linalg.eigvalsh(second)[1] < 0.03)
    return n, f"{line}; {len(rights)} photographs lean by {np.degrees(np.median(abs(leaning))):.2g} degrees (median){more}"


def metres_about(coordinates: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return metres to east, north and up [N, 3] of coordinates [N, 3]: latitude, longitude [deg] and height [m].

    The meridian and the parallel of ``place`` [3] count as straight, which is exact to 1e-4 within a kilometre.
    """
    (north, east), latitude = np.radians((coordinates - place)[:, :2].T), math.radians(place[0])
    narrowed = 1 - SQUARED * math.sin(latitude) ** 2
    along, across = EARTH * (1 - SQUARED) / narrowed**1.5 + place[2], EARTH / math.sqrt(narrowed) + place[2]
    return np.stack([across * math.cos(latitude) * east, along * north, coordinates[:, 2] - place[2]], 1)


def similarity(points: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> tuple[float | np.ndarray, ...]:
    """Return scale, rotation [3, 3] and translation [3] from points to targets [N, 3], distances [N], and if all is sure.

    Weighted least squares (Umeyama 1991); points that leave a line by at most a twentieth of its length leave a rotation open.
    """
    parts = weights[:, None] / weights.sum()
    middle, aim = (parts * points).sum(0), (parts * targets).sum(0)
    left, sizes, right = np.linalg.svd(matmul((parts * (targets - aim)).T, points - middle))
    signs = np.array([1, 1, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = matmul(left * signs, right)
    scale = float((sizes * signs).sum() / max((parts * (points - middle) ** 2).sum(), 1e-300))
    offs = np.linalg.norm(scale * matmul(points - middle, rotation.T) + aim - targets, axis=1)
    return scale, rotation, aim - scale * matmul(rotation, middle), offs, bool(sizes[1] > sizes[0] / 400)


def located(run: StoredRun, folder: Path | None) -> Levelled:
    """Give files metres to east, north and up of the middle of the photographs, by their EXIF; those far off do not count."""
    home = Path(run.record["scene"]["path"] or run.folder)
    source, below = (home, [home / "images", home]) if folder is None else (folder, [folder])
    if not source.is_dir():
        raise DataError(f"--gps: {source}: no such folder; {similar_folder(source) or 'give the folder of the originals'}")
    # a.HEIC.jpg is the copy of a.HEIC
    paths = {name: [f / n for n in (name, name.removesuffix(".jpg")) for f in below] for name in run.scene_cameras}
    files = {name: p for name, some in paths.items() if (p := next((p for p in some if p.is_file()), None))}
    if not files:
        raise DataError(f"--gps: {source}: no file has the name of a photograph, such as {run.train[0]}; give the originals")
    rows = {name: gps for name, file in files.items() if (gps := read_gps(read_image_file(file)))}
    remedy = "Copies often lose EXIF: --gps FOLDER reads originals with the names of the views"
    heic = [n for n, p in files.items() if n not in rows and brand(read_image_file(p, start=BRANDS_END)) == "HEIC"]
    if heic:
        remedy = f"EXIF of HEIC is not read: convert the originals to JPEG with their metadata, with names such as {heic[0]}"
    if not rows:
        raise DataError(f"--gps: none of the {len(files)} photographs found in {source} has GPS in EXIF. {remedy}")
    centers, coordinates = np.array([run.scene_cameras[name].center for name in rows]), np.array([*rows.values()])
    count, sure, weights = len(rows), False, np.ones(len(rows))
    if count > 2:
        place = np.median(coordinates, axis=0)
        targets = metres_about(coordinates, place)
        for _ in range(50):  # least absolute distances, which few outliers do not move
            *_, offs, _ = similarity(centers, targets, weights)
            weights = 1 / np.maximum(offs, 0.01 * SURE)
        agree = (offs <= max(SURE, 3 * float(np.median(offs)))).astype(float)
        scale, rotation, translation, offs, sure = similarity(centers, targets, agree)
        count, offs = int(agree.sum()), offs[agree > 0]
    if count < 3 or not sure:
        raise DataError(f"--gps: {count} of {len(paths)} photographs have GPS that fits; 3 not on a line are needed. " + remedy)
    line = f"GPS of {len(offs)} of {len(rows)} photographs is {np.median(offs):.2f} m (median), at most {offs.max():.2f} m off"
    line += "; x is east, y north, z up [m] from latitude {:.7f}, longitude {:.7f}, height {:.1f} m".format(*place)
    return Normalization(translation, 1 / scale, rotation.T, rotation[2], "m", place), line


def store(folder: Path, device_name: str, change: Callable[[StoredRun], Levelled]) -> list[str]:
    """Replace the similarity of a run, and its PLY, by what ``change`` returns for it; returns lines for the user."""
    read_record(folder)  # before a lock is made: it may be no run
    with hold_folder(folder) as held:
        run, ply = open_run(folder, device_name), folder / "point_cloud.ply"
        n, line = change(run)
        record = schema.read(folder / CONFIG, folder) | {"normalization": similarity_values(n)}
        try:
            if ply.is_file():  # before config.json: as long as that has the old state, the command can be repeated
                write_ply(ply, drop_unused_sh(run.gaussians()), n, antialiased=run.antialiased)
            write_json(folder / CONFIG, record)
        except ResourceError as e:
            raise ResourceError(f"{e}; then repeat the command, because {ply.name} and {CONFIG} may disagree") from e
    old = [folder / name for name in ("crop.json", "path.json") if (folder / name).is_file()]
    return [*run.notes(), *held, line, *(f"{path} has the old coordinates; save it again" for path in old)]


def level(
    folder: Path, device_name: str, scale: tuple[str, ...] | None = None, ground: tuple[str, ...] | None = None,
    photographs: bool = False, gps: tuple[Path, ...] | None = None,
) -> list[str]:  # fmt: skip
    """Set scale, upward direction or place of a run's files, with the options of `warpgs level`; returns lines for the user."""
    if [scale is not None, ground is not None, photographs, gps is not None].count(True) != 1 or len(gps or ()) > 1:
        raise UsageError("give one of --scale, --ground, --up and --gps, with at most one folder")
    if (scale is not None and (not scale or len(scale) % 3)) or (ground is not None and len(ground) < 3):
        raise UsageError(
            "--scale takes two points and a length, such as a.jpg:41,22 b.jpg:95,31 1.2, once or several times, and --ground "
            "at least three points, such as a.jpg:30,59 a.jpg:20,56 b.jpg:40,58"
        )

    def change(run: StoredRun) -> Levelled:
        if photographs or gps is not None:
            return photographed(run) if photographs else located(run, *(gps or [None]))
        texts = ground or [text for i, text in enumerate(scale) if i % 3 < 2]
        photos, why = photographs_of(run) if any(":" in text for text in texts) else ({}, "")
        places = [picked(run, text, photos) for text in texts]
        n, line = grounded(run, places) if ground else scaled(run.normalization, places, [*map(metres, scale[2::3])])
        if names := dict.fromkeys(text.rpartition(":")[0] for text in texts if ":" in text):
            line += f"; pixels refer to photographs of {' and '.join(dict.fromkeys(fitted_size(run, name) for name in names))}"
            line += matches(places, why)
        if all(":" in text for text in texts):  # pixels stay where they are; coordinates move with the files
            return n, line
        points = np.round(convert_points(np.array([point for point, *_ in places]), n, "scene", "file"), 9) + 0.0
        now = " ".join(",".join(f"{v:.12g}" for v in point) for point in points)
        return n, f"{line}; the points are now at {now} (give these to repeat the command)"

    return store(folder, device_name, change)
