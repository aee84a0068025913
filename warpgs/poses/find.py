"""Poses of photographs or of a video: from files without cameras to a scene folder that a fit reads."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warpgs.errors import DataError, UsageError
from warpgs.files import filling, is_empty, make_folder, write_bytes
from warpgs.input_files import NOT_REGULAR, input_digest, unread_reason
from warpgs.io.decoding import MAX_PIXELS
from warpgs.io.readers import all_readers
from warpgs.io.unread_formats import unread_note
from warpgs.poses.advice import MIN_KEYPOINTS, partners
from warpgs.poses.heic import is_heic, to_jpeg
from warpgs.poses.mapping import EXHAUSTIVE, LEARNED, Mapping, camera_groups, cameras_of, check_installed, find_model
from warpgs.poses.matcher import Matcher, open_matcher, write_matches
from warpgs.poses.photographs import (
    Photograph,
    find_photographs,
    folder_notes,
    image_root,
    photographs_inside,
    prepare,
    write_copy,
)
from warpgs.poses.record import record_of, write_record
from warpgs.poses.video import is_video, write_frames

MIN_PHOTOGRAPHS = 3
"""Fewest photographs: with two, nothing checks the focal length and the depths."""
FRAMES = 60
"""Default number of frames from a video."""
LINKS = 6
"""Number of pairs of photographs to report if no poses are found; pairs with the fewest matches come first."""
MODEL_FILES = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")
"""Files of a COLMAP model; the first three make a scene."""


def needs_poses(path: Path) -> bool:
    """Return whether a path is a video, or a folder of images that holds no scene format."""
    try:
        if is_video(path):
            return True
        return path.is_dir() and all(r.probe(path) is None for r in all_readers()) and bool(find_photographs(path))
    except OSError:  # the scene reader reports the error
        return False


def source_digest(source: Path, allow_outside: bool = False) -> str:
    """Return the SHA-256 over the names and contents of a source's photographs, or of a video.

    Raises:
        DataError: A file cannot be read, or a link points outside the folder and that is not allowed.
    """
    total = hashlib.sha256()
    if is_video(source):
        return _digest(source)
    root = image_root(source)
    for path in photographs_inside(source, allow_outside):
        name = path.relative_to(root).as_posix().encode("utf-8", "surrogateescape")
        total.update(name + b"\0" + bytes.fromhex(_digest(path)))
    return total.hexdigest()


def _digest(path: Path) -> str:
    try:
        return input_digest(path)
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({unread_reason(e)}); fix its permissions or copy it again") from e


def find_poses(
    source: str | Path,
    out: str | Path,
    *,
    frames: int = FRAMES,
    threads: int = 0,
    max_pixels: int = MAX_PIXELS,
    allow_outside: bool = False,
    matcher: str | Path | None = None,
    progress: Callable[[str], object] = lambda line: None,
) -> dict[str, Any]:
    """Find the poses of photographs or of a video's sharpest frames, and write a scene folder with the registered ones.

    The folder appears whole or not at all. It contains ``images``, upright and without metadata; ``sparse/0``, a COLMAP model;
    and a record of which photographs have a pose, with reasons (poses.json, poses.txt).

    Args:
        source: Folder of images, or a video file.
        out: Scene folder to make; new or empty.
        frames: Number of frames to take from a video.
        threads: CPU threads; 0 for as many as there are cores.
        max_pixels: Largest number of pixels that an image may have.
        allow_outside: True to allow links to photographs outside the folder.
        matcher: ONNX file of `warpgs priors export --model xfeat`, which is used if SIFT leaves photographs without a pose;
            None for SIFT only.
        progress: Called with lines for the user.

    Returns:
        The record, as poses.json holds it.

    Raises:
        DataError: There are too few photographs, one is outside the folder or cannot be decoded, fewer than three match, or the
            matcher is invalid.
        ResourceError: pycolmap failed, or the folder cannot be written.
        UsageError: pycolmap, or pi-heif for HEIC, is not installed; ``source`` is a run or holds scenes; or ``out`` is not
            empty.
    """
    source, out = Path(source), Path(out)
    _check(source, out, allow_outside)
    check_installed()
    network = None if matcher is None else open_matcher(matcher, threads)
    with filling(out) as scene:
        work, kind = scene / "work", "video" if is_video(source) else "photographs"
        digest = source_digest(source, allow_outside)  # before anything is written, which may be below the source
        make_folder(work / "small")
        photographs, names, notes = _prepared(source, work, frames, max_pixels, progress)
        found = find_model(photographs, names, kind, work, progress, threads)
        if network is not None:
            found, more = _with_network(network, found, photographs, names, kind, work, progress, threads)
            notes += more
        _check_found(source, found, photographs)
        record = record_of(found, photographs, digest, notes)
        for done, i in enumerate(found.views):
            progress(f"writing images: {done + 1} of {len(found.views)}")
            write_copy(photographs[i], scene / "images", max_pixels)
        make_folder(scene / "sparse" / "0")
        for name in MODEL_FILES:
            if (work / "model" / name).is_file():
                write_bytes(scene / "sparse" / "0" / name, (work / "model" / name).read_bytes())
        write_record(scene, record)
        shutil.rmtree(work)
    return record


def _with_network(
    network: Matcher, found: Mapping, photographs: list[Photograph], names: list[str], kind: str, work: Path,
    progress: Callable[[str], object], threads: int,
) -> tuple[Mapping, list[str]]:  # fmt: skip
    """Return the model from the network's matches if it has more photographs than SIFT's, and notes.

    The network runs only if SIFT leaves photographs without a pose. The model lies in ``work``/model. Arguments are those of
    `find_model`.
    """
    count = len(found.views)
    if count == len(photographs):
        return found, [f"{network.title} is not used: SIFT finds the poses of all photographs, and is more accurate"]
    small, second = [work / "small" / n for n in names], work / "network"
    make_folder(second)
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
    scenes = [d.name for d in sorted(folder.iterdir()) if d.is_dir() and any(r.probe(d) is not None for r in all_readers())]
    if scenes:
        return f"holds scenes, such as {scenes[0]}; give one scene, or only photographs, or use `warpgs farm` for all"
    return ""


def _check(source: Path, out: Path, allow_outside: bool) -> None:
    """Raise an error for an unusable source or target, before any work."""
    try:
        if not is_video(source) and not source.is_dir():
            there = NOT_REGULAR if source.exists() else "does not exist"
            what = "is not a supported video (mp4, mov, m4v, avi, mkv, webm)" if source.is_file() else there
            raise DataError(f"{source}: {what}; give a folder of photographs, or a video")
        if not is_video(source) and (other := _something_else(source)):
            raise UsageError(f"{source}: {other}")
        if not is_video(source) and not photographs_inside(source, allow_outside):
            none = "holds no supported image (JPEG, PNG, BMP, TIFF, WebP, AVIF or HEIC); give the folder of photographs"
            raise DataError(f"{source}: {unread_note(source) or none}")
        if out.exists() and not (out.is_dir() and is_empty(out)):
            raise UsageError(f"{out} exists already; choose another --out, or remove it")
    except OSError as e:
        raise UsageError(f"{e.filename or out}: cannot be read ({e.strerror or e}); choose another folder") from e


def _prepared(
    source: Path, work: Path, frames: int, max_pixels: int, progress: Callable[[str], object]
) -> tuple[list[Photograph], list[str], list[str]]:
    """Return the photographs of a source, the names of their copies in ``work``/small, and notes for the user."""
    notes, root = [], source
    if is_video(source):
        root = work / "frames"
        make_folder(root)
        total = write_frames(source, root, frames, progress)
        taken = min(frames, total)
        notes.append(f"{taken} of {total} frames are used: the sharpest frame of each of {taken} equal parts of the video")
    root = image_root(root)
    paths, unread = find_photographs(root), unread_note(root)
    notes += folder_notes(root)
    if unread:
        notes.append(f"left out: {unread}")
    if len(paths) < MIN_PHOTOGRAPHS:
        what = "frame" if is_video(source) else "photograph"
        raise DataError(
            f"{source}: has {len(paths)} {what}{'s' if len(paths) != 1 else ''}; poses need at least {MIN_PHOTOGRAPHS}, "
            f"better 8 to 20 that overlap by two thirds{'; left out: ' + unread if unread else ''}"
        )
    photographs, names = [], []
    copies = to_jpeg([p for p in paths if is_heic(p)], root, work / "heic", max_pixels, progress)
    if copies:
        notes.append(f"{len(copies)} HEIC photograph{'s' if len(copies) != 1 else ''} converted to JPEG")
    for i, path in enumerate(paths):
        progress(f"reading photographs: {i + 1} of {len(paths)}")
        names.append(f"{i:06d}.png")
        file, below = (copies[path], work / "heic") if path in copies else (path, root)
        photographs.append(prepare(file, below, work / "small" / names[-1], max_pixels))
    taken: dict[str, Path] = {}
    for p, path in zip(photographs, paths):
        if (same := taken.setdefault(p.name, path)) is not path:
            raise DataError(f"{source}: {same.name} and {path.name} would both be {p.name!r} in the scene; rename one of them")
    return photographs, names, [*notes, *_notes(photographs)]


def _notes(photographs: list[Photograph]) -> list[str]:
    """Return notes on assumptions about the photographs."""
    cameras = cameras_of(photographs, camera_groups(photographs))
    known = sum(c.focal is not None for c in cameras)
    source = "from EXIF" if known == len(cameras) else "not in EXIF" if not known else f"from EXIF for {known} of them"
    many = "one camera is" if len(cameras) == 1 else f"{len(cameras)} cameras, one for each device, lens and image size, are"
    notes = [f"{many} assumed, focal length {source}"]
    turned = sum(p.orientation != 1 for p in photographs)
    if turned:
        notes.append(f"{turned} photograph{'s' if turned != 1 else ''} turned upright by EXIF")
    return notes


def _links(found: Mapping, photographs: list[Photograph]) -> str:
    """Return which pairs match best, and which photographs match none; fewest matches first."""
    pairs: dict[tuple[int, ...], int] = {}
    for i in range(len(photographs)):
        best = partners(found, i)[:1]
        pairs[tuple(sorted((i, best[0][0]))) if best else (i,)] = best[0][1] if best else 0
    order = sorted(pairs, key=lambda pair: (pairs[pair], pair))
    words = []
    for pair in order[:LINKS]:
        names = " and ".join(photographs[i].name for i in pair)
        words.append(f"{names} share {pairs[pair]} matches" if pairs[pair] else f"{names} matches no other")
    more = len(order) - LINKS
    return "; ".join([*words, *([f"{more} more pairs"] if more > 0 else [])])


def _check_found(source: Path, found: Mapping, photographs: list[Photograph]) -> None:
    """Raise a DataError where too few photographs fit together, with the reason that most of them have."""
    if len(found.views) >= MIN_PHOTOGRAPHS:
        return
    count, blank = len(photographs), sum(k < MIN_KEYPOINTS for k in found.keypoints)
    largest = max(found.matches.values(), default=0)
    if 2 * blank >= count:
        most = max(found.keypoints)
        why = (
            f"{blank} of {count} photographs show almost nothing that can be matched (fewer than {MIN_KEYPOINTS} keypoints; "
            f"the best one has {most:,}): a blank wall, darkness or blur. Take sharp photographs of textured things, in good "
            "light"
        )
    elif not largest:
        why = f"no two of {count} photographs could be matched. Take photographs that overlap by two thirds, in small steps"
    else:
        why = (
            f"at most {len(found.views)} of {count} photographs fit together, and {MIN_PHOTOGRAPHS} are needed. Take "
            f"photographs that overlap by two thirds, moving the camera, not only turning it. "
            f"So far {_links(found, photographs)}"
        )
    raise DataError(f"{source}: no poses: {why}")
