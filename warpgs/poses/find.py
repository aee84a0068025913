"""`find_poses`: photographs become a scene folder, with a record of how, and advice where it fails."""

import contextlib
import hashlib
import math
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from warpgs import files, schema
from warpgs.errors import DataError, UsageError, explained, listed
from warpgs.io.folder import all_readers, loaders
from warpgs.io.image_files import MAX_PIXELS, unread_note
from warpgs.poses import photographs as photos
from warpgs.poses.mapping import EXHAUSTIVE, LEARNED, Mapping, camera_groups, cameras_of, check_installed, find_model
from warpgs.poses.matching import Matcher, write_matches
from warpgs.process import Say, counted, silent

MIN_KEYPOINTS = 100
"""Keypoints below which a photograph shows too little to match: a blank wall, darkness, blur."""
MIN_MATCHES = 15
"""Number of matches that a pair needs, all in agreement with one motion of the camera."""
WEAK_MATCHES = 60
"""Matches below which the link between two photographs is called weak: a few wrong matches bend the poses."""
WIDE_ANGLE = 30.0
"""Angle between the optical axes of neighbours [degrees] beyond which SIFT finds few matches."""
MAX_ADVICE = 8
"""Number of pieces of advice that are given, the most urgent first."""


def reason(found: Mapping, i: int, names: Sequence[str]) -> str:
    """Return why a photograph has no pose, in words that follow its name."""
    if (keypoints := found.keypoints[i]) < MIN_KEYPOINTS:
        return f"has {keypoints} keypoints, too few to match: a blank wall, darkness or blur"
    if not (best := found.links[i]):
        return f"has {keypoints:,} keypoints and matches no other photograph"
    j, n = best[0]
    matched = f"has {keypoints:,} keypoints and {n} matches with {names[j]}"
    if j in found.views:
        return f"{matched}, too few of them at places of known depth"
    together = next((f", in a separate group of {len(group)}" for group in found.groups[1:] if i in group), "")
    return f"{matched}, which has no pose either{together}"


def neighbours(found: Mapping) -> list[tuple[int, int, float]]:
    """Return the pairs of views that connect all views by the smallest angles (a minimum spanning tree), with their angles."""
    last, *left = list(found.views) or [-1]
    nearest: dict[int, tuple[float, int]] = dict.fromkeys(left, (math.inf, -1))
    tree = []
    while nearest:
        for j, best in nearest.items():
            cosine = float((found.views[last][0][2] * found.views[j][0][2]).sum())  # of the optical axes
            nearest[j] = min(best, (float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))), last))
        (angle, i), last = min((best, j) for j, best in nearest.items())
        del nearest[last]
        tree.append((min(i, last), max(i, last), angle))
    return sorted(tree)


def advice(found: Mapping, names: Sequence[str]) -> list[str]:
    """Return what to photograph next, a sentence each, the most urgent first; empty if nothing is missing."""
    said = []
    lost = {i for i in range(len(names)) if i not in found.views}
    groups = [group for members in found.groups[1:] if len(group := sorted(lost.intersection(members))) > 1]
    for group in groups:  # one bridge joins a separate group as a whole
        links = [(n, i, j) for i in group for j, n in found.links[i] if j in found.views]
        _, i, j = max(links, default=(0, group[0], -1))
        way = f"between {names[i]} and {names[j]}" if links else f"from {names[i]} to the photographs outside its group"
        apart = f"{len(group)} form a separate group, {names[group[0]]} to {names[group[-1]]}"
        said.append(f"take photographs {way}, each overlapping the previous one by two thirds: {apart}")
    for i in sorted(lost.difference(*groups)):
        # pairs that match well need no photograph between
        weak = [names[j] for j, n in found.links[i] if n < WEAK_MATCHES and j in found.views]
        if found.keypoints[i] < MIN_KEYPOINTS:
            said.append(f"take {names[i]} again: sharp, in good light, with a textured object in view")
        elif weak:
            said.append(f"take two or three photographs between {names[i]} and {weak[0]}, in small steps")
        else:
            said.append(f"take photographs from {names[i]} to the others, each overlapping the previous one by two thirds")
    for i, j, angle in sorted(neighbours(found), key=lambda t: -t[2]):
        if angle > WIDE_ANGLE and dict(found.links[i]).get(j, 0) < WEAK_MATCHES:
            said.append(f"take one or two photographs between {names[i]} and {names[j]}, {angle:.0f} degrees apart")
    for i in found.views:
        j, n = next((link for link in found.links[i] if link[0] in found.views), (i, WEAK_MATCHES))
        if n < WEAK_MATCHES:
            said.append(f"take a photograph between {names[i]} and {names[j]}, which share only {n} matches")
    more = len(said) - MAX_ADVICE
    return said[:MAX_ADVICE] + ([f"and {more} more; begin with those above"] if more > 0 else [])


JSON, TEXT = "poses.json", "poses.txt"
FORMAT = 1
"""Number of the format of poses.json."""
SHOWN_PARTNERS = 5
"""Largest number of matched photographs that the record names for a photograph."""
FEW = 5
"""Largest number of photographs for which a focal length without EXIF is called uncertain (decision 017)."""
_PHOTOGRAPH = schema.fields({
    "name": schema.text, "registered": schema.flag, "keypoints": schema.whole(0), "points": schema.whole(0),
    "matches": schema.mapping(schema.whole(1)), "reason": schema.or_null(schema.text),
})  # fmt: skip
_RECORD = schema.fields({
    "format": schema.one_of(FORMAT), "source_sha256": schema.text, "photographs": schema.items(_PHOTOGRAPH),
    "notes": schema.items(schema.text), "advice": schema.items(schema.text),
}, {"source": schema.text})  # fmt: skip
"""Schema of poses.json, for the fields that are read."""


USUAL = (0.4, 2.5)
"""Focal lengths relative to the longer side: of ultra-wide lenses without correction, and of a phone's telephoto lens."""


def record_of(found: Mapping, photographs: Sequence[photos.Photograph], digest: str, notes: Sequence[str]) -> dict[str, Any]:
    """Return the contents of poses.json; ``digest`` is the hash of the source, ``notes`` are choices made for the user."""
    names = [p.name for p in photographs]
    rows = []
    for i, p in enumerate(photographs):
        registered = i in found.views
        rows.append({
            "name": p.name, "sha256": p.digest, "registered": registered, "keypoints": found.keypoints[i],
            "points": found.views[i][1] if registered else 0,
            "matches": {names[j]: n for j, n in found.links[i][:SHOWN_PARTNERS]},
            "reason": None if registered else reason(found, i, names),
        })  # fmt: skip
    focal = ", ".join(f"{c['focal']:.0f} px of {max(c['width'], c['height'])}" for c in found.cameras)
    count = f"{len(found.views)} photographs"
    estimate = f"an estimate from {count} is often 5 % off, at worst 20 % or more"
    how = f"{found.points:,} points, mean reprojection error {found.error:.2f} px, {found.method} mapping, focal length {focal}"
    remarks = [f"poses found for {len(found.views)} of {len(names)} photographs: {how}"]
    if found.kept_focal:
        remarks.append(f"the focal length is taken from EXIF, because {count} cannot improve it")
    elif found.kept_focal is False:
        remarks.append(f"the EXIF focal length does not fit the {count}, which may be cropped; {estimate}")
    elif len(found.views) <= FEW and any(photographs[i].focal is None for i in found.views):
        remarks.append(f"EXIF holds no focal length; {estimate}, and so is depth. Add photographs from more directions")
    for c in found.cameras:
        width, height, times = c["width"], c["height"], c["focal"] / max(c["width"], c["height"])
        if not USUAL[0] < times < USUAL[1]:
            seen = f"photographs of {width:.0f} x {height:.0f} px have a focal length of {times:.2g} times their longer side"
            remarks.append(f"{seen}, usual are 0.7 to 1.5: leave them out if they are cropped or stretched")
    if found.method == "global":
        remarks.append("global mapping joined more photographs than incremental mapping; results differ a little between runs")
    return {
        "format": FORMAT, "source_sha256": digest, "photographs": rows, "notes": [*notes, *remarks],
        "advice": advice(found, names), "mean_reprojection_error_px": found.error, "points": found.points,
        "method": found.method, "pairs_tried": found.tried, "pairs_matched": sum(n > 0 for n in found.matches.values()),
        "cameras": list(found.cameras), "pycolmap": found.version,
    }  # fmt: skip


def report_lines(record: dict[str, Any]) -> list[str]:
    """Return a record as lines of text: the choices, each photograph, and what to photograph next."""
    rows = record["photographs"]
    width = max((len(p["name"]) for p in rows), default=0)
    lines = [*record["notes"], ""]
    for p in rows:
        best = ", ".join(f"{name} ({n})" for name, n in list(p["matches"].items())[:2])
        pose = f"pose    {p['keypoints']:>6,} keypoints, {p['points']:>5,} points, matches {best}"
        lines.append(f"{p['name']:<{width}}  {pose if p['registered'] else 'NO POSE: it ' + str(p['reason'])}")
    next_step = "What to photograph next:" if record["advice"] else "Nothing more is needed: all photographs are well linked."
    return [*lines, "", next_step, *(f"- {a}" for a in record["advice"])]


def read_poses_record(folder: Path) -> dict[str, Any]:
    """Read poses.json of a scene whose poses were found."""
    path = folder / JSON
    with explained(f"{path}: cannot be read", "find the poses again with `warpgs poses`", (OSError, schema.SchemaError)):
        return schema.read(path, folder, _RECORD)


MIN_PHOTOGRAPHS = 3
"""Fewest photographs: with two, nothing checks the focal length and the depths."""
FRAMES = 60
"""Default number of frames from a video."""
MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")
"""Files of a COLMAP model; the first three make a scene."""


def needs_poses(path: Path) -> bool:
    """Return whether a path is a video, or a folder of images that holds no scene format."""
    with contextlib.suppress(OSError):  # the scene reader reports the error
        if photos.is_video(path):
            return True
        return path.is_dir() and all(r.probe(path) is None for r in all_readers()) and bool(photos.find_photographs(path)[0])
    return False


def source_digest(source: Path, allow_outside: bool = False) -> str:
    """Return the SHA-256 over the names and contents of a source's photographs, or of a video."""
    if photos.is_video(source):
        return files.input_digest(source)
    root, total = photos.image_root(source), hashlib.sha256()
    for path in photos.photographs_inside(source, allow_outside):
        name = path.relative_to(root).as_posix().encode("utf-8", "surrogateescape")
        total.update(name + b"\0" + bytes.fromhex(files.input_digest(path)))
    return total.hexdigest()


def find_poses(
    source: str | Path,
    out: str | Path,
    *,
    frames: int = FRAMES,
    threads: int = 0,
    max_pixels: int = MAX_PIXELS,
    allow_outside: bool = False,
    matcher: str | Path | None = None,
    progress: Say = silent,
) -> dict[str, Any]:
    """Find the poses of photographs or of a video's sharpest frames; write a scene folder, whole or not at all."""
    source, out = Path(source), Path(out)
    _check(source, out, allow_outside)
    check_installed()
    network = None if matcher is None else Matcher(matcher, threads)
    with files.filling(out) as scene:
        work, kind = scene / "work", "video" if photos.is_video(source) else "photographs"
        digest = source_digest(source, allow_outside)  # before anything is written, which may be below the source
        files.make_folder(work / "small")
        photographs, names, notes = _prepared(source, work, frames, max_pixels, progress)
        found = find_model(photographs, names, kind, work, progress, threads)
        if network is not None:
            found, more = _with_network(network, found, photographs, names, kind, work, progress, threads)
            notes += more
        _check_found(source, found, photographs)
        record = record_of(found, photographs, digest, notes) | {"source": source.resolve().name}
        for i in counted(tuple(found.views), progress, "writing images", "photographs"):
            photos.write_copy(photographs[i], scene / "images", max_pixels)
        files.make_folder(scene / "sparse" / "0")
        for name in MODEL_FILES:
            if (work / "model" / name).is_file():
                files.write_bytes(scene / "sparse" / "0" / name, (work / "model" / name).read_bytes())
        files.write_json(scene / JSON, record)
        files.write_text(scene / TEXT, "\n".join(report_lines(record)) + "\n")
        shutil.rmtree(work)
    return record


def _with_network(
    network: Matcher, found: Mapping, photographs: list[photos.Photograph], names: list[str], kind: str, work: Path,
    progress: Say, threads: int,
) -> tuple[Mapping, list[str]]:  # fmt: skip
    """Return the model from the network's matches if it has more photographs than SIFT's, and notes."""
    # the network, which is less accurate, runs only if SIFT leaves photographs without a pose
    if (count := len(found.views)) == len(photographs):
        return found, [f"{network.title} is not used: SIFT finds the poses of all photographs, and is more accurate"]
    small, second = [work / "small" / n for n in names], work / "network"
    files.make_folder(second)
    turned = write_matches(network, small, second / LEARNED, kind, EXHAUSTIVE, progress)
    (work / "small").rename(second / "small")
    other = find_model(photographs, names, kind, second, progress, threads, learned=True)
    if len(other.views) <= count:
        return found, [f"{network.title} is not used: it finds {len(other.views)} poses, and SIFT {count}"]
    shutil.rmtree(work / "model", ignore_errors=True)
    (second / "model").rename(work / "model")
    notes = [f"keypoints and matches by {network.title}: {len(other.views)} poses; SIFT, which is more accurate, finds {count}"]
    if turned:
        notes.append(f"matched after rotation by 90 or 180 degrees: {', '.join(photographs[i].name for i in turned)}")
    return other, notes


def _something_else(folder: Path) -> str:
    """Return a message on a folder of a run or of scenes, with the fix; empty for a folder that may hold photographs."""
    if (folder / "config.json").is_file() and (folder / "renders").is_dir():
        return "is the folder of a run; give the scene that it was fitted to"
    probes = {d.name: [p for r in all_readers() if (p := r.probe(d))] for d in sorted(folder.iterdir()) if d.is_dir()}
    scenes = [name for name, found in probes.items() if found]
    if model := next((m for m in photos.models_below(folder) if all(p.missing for p in probes[m.parts[0]])), None):
        return f"holds poses: use `warpgs fit {folder} --reconstruction {model.as_posix()}`, or move them away to find new ones"
    if scenes:
        return f"holds scenes, such as {scenes[0]}; give one scene, or only photographs, or use `warpgs farm` for all"
    return ""


def _check(source: Path, out: Path, allow_outside: bool) -> None:
    """Raise an error for an unusable source or target, before any work."""
    with explained(f"{source} or {out}: cannot be read", "choose other folders", kind=UsageError):
        if not photos.is_video(source):
            if not source.is_dir():
                there = files.NOT_REGULAR if source.exists() else "does not exist"
                what = "is not a supported video (mp4, mov, m4v, avi, mkv, webm)" if source.is_file() else there
                raise DataError(f"{source}: {what}; give a folder of photographs, or a video")
            if other := _something_else(source):
                raise UsageError(f"{source}: {other}")
            if not photos.photographs_inside(source, allow_outside):
                none = "holds no supported image (JPEG, PNG, BMP, TIFF, WebP, AVIF or HEIC); give the folder of photographs"
                raise DataError(f"{source}: {unread_note(source) or none}")
        if out.exists() and not (out.is_dir() and files.is_empty(out)):
            raise UsageError(f"{out} exists already; choose another --out, or remove it")


def _distinct(paths: Sequence[Path], root: Path) -> tuple[list[Path], str]:
    """Return image files without copies of others, and a note on the copies; held out, they would score too well."""
    equal: dict[str, list[Path]] = {}
    for path in paths:
        equal.setdefault(files.input_digest(path), []).append(path)
    # the shortest name is the first: systems add " (1)" or "copy"
    first = {path: min(group, key=lambda p: len(str(p))) for group in equal.values() for path in group}
    copies = [" is a copy of ".join(f.relative_to(root).as_posix() for f in (p, first[p])) for p in paths if first[p] != p]
    return [p for p in paths if first[p] == p], listed(copies, photos.SHOWN_FOLDERS)


def _prepared(
    source: Path, work: Path, frames: int, max_pixels: int, progress: Say
) -> tuple[list[photos.Photograph], list[str], list[str]]:
    """Return the photographs of a source, the names of their copies in ``work``/small, and notes for the user."""
    notes, root = [], source
    if photos.is_video(source):
        root = work / "frames"
        files.make_folder(root)
        total = photos.write_frames(source, root, frames, progress)
        taken = min(frames, total)
        notes.append(f"{taken} of {total} frames are used: the sharpest frame of each of {taken} equal parts of the video")
    root = photos.image_root(root)
    (paths, about), unread = photos.find_photographs(root), unread_note(root)
    notes += about
    paths, copies = _distinct(paths, root)
    if unread := "; ".join(filter(None, (unread, copies))):
        notes.append(f"left out: {unread}")
    if len(paths) < MIN_PHOTOGRAPHS:
        what = "frame" if photos.is_video(source) else "photograph"
        few = f"{len(paths)} {what}{'s' if len(paths) != 1 else ''}{'; left out: ' + unread if unread else ''}"
        raise DataError(f"{source}: has {few}; poses need at least {MIN_PHOTOGRAPHS}, better 8 to 20 that overlap")
    photographs, names = [], [f"{i:06d}.png" for i in range(len(paths))]
    if copies := photos.to_jpeg([p for p in paths if photos.is_heic(p)], root, work / "heic", max_pixels, progress):
        notes.append(f"{len(copies)} HEIC photograph{'s' if len(copies) != 1 else ''} converted to JPEG")

    def prepared(path: Path, name: str) -> photos.Photograph:
        file, below = (copies[path], work / "heic") if path in copies else (path, root)
        return photos.prepare(file, below, work / "small" / name, max_pixels)

    with ThreadPoolExecutor(loaders()) as pool:
        for photograph in pool.map(prepared, paths, names):
            photographs.append(photograph)
            progress(f"reading photographs: {len(photographs)} of {len(paths)}")
    taken: dict[str, Path] = {}
    for p, path in zip(photographs, paths):
        if (same := taken.setdefault(p.name, path)) is not path:
            raise DataError(f"{source}: {same.name} and {path.name} would both be {p.name!r} in the scene; rename one of them")
    return photographs, names, [*notes, *_notes(photographs)]


def _notes(photographs: list[photos.Photograph]) -> list[str]:
    """Return notes on assumptions about the photographs."""
    cameras = cameras_of(photographs, camera_groups(photographs))
    known = sum(c.focal is not None for c in cameras)
    source = "from EXIF" if known == len(cameras) else "not in EXIF" if not known else f"from EXIF for {known} of them"
    many = "one camera is" if len(cameras) == 1 else f"{len(cameras)} cameras, one for each device, lens and image size, are"
    notes = [f"{many} assumed, focal length {source}"]
    if turned := sum(p.orientation != 1 for p in photographs):
        notes.append(f"{turned} photograph{'s' if turned != 1 else ''} turned upright by EXIF")
    return notes


def _check_found(source: Path, found: Mapping, photographs: list[photos.Photograph]) -> None:
    """Raise a DataError where too few photographs fit together, with the reason that most of them have."""
    if len(found.views) >= MIN_PHOTOGRAPHS:
        return
    count, blank = len(photographs), sum(k < MIN_KEYPOINTS for k in found.keypoints)
    if 2 * blank >= count:
        why = f"{blank} of {count} photographs have fewer than {MIN_KEYPOINTS} keypoints: is it a blank wall? Take other ones"
    elif not max(found.matches.values(), default=0):
        why = f"no two of {count} photographs could be matched. Take photographs that overlap by two thirds, in small steps"
    else:
        few = f"at most {len(found.views)} of {count} photographs fit together, and {MIN_PHOTOGRAPHS} are needed"
        why = f"{few}. Move the camera, do not only turn it. First, {advice(found, [p.name for p in photographs])[0]}"
    raise DataError(f"{source}: no poses: {why}")
