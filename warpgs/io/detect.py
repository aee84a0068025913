"""Which dataset format is this folder?"""

from __future__ import annotations

from pathlib import Path

from warpgs.errors import DataError
from warpgs.io import colmap, dtu, middlebury, transforms

LOOKED_FOR = (
    "sparse/0, sparse or the folder itself with cameras and images .bin/.txt (COLMAP), transforms.json or "
    "transforms_train.json (nerfstudio, instant-ngp, Blender), poses_bounds.npy with images or images_N (LLFF), cameras.npz "
    "or cameras_sphere.npz with image or images (DTU), *_par.txt (Middlebury)"
)


def _has_images(root: Path, *patterns: str) -> bool:
    return any(p.is_dir() for pattern in patterns for p in root.glob(pattern))


def candidates(root: Path) -> tuple[list[str], list[tuple[str, str]]]:
    """The complete formats of a folder, best first; and the broken ones with what they lack."""
    complete, broken = [], []
    folder = colmap.model_folder(root)
    if folder is not None:
        if missing := colmap.missing_parts(folder):
            where = folder.relative_to(root).as_posix()
            broken.append(("colmap", f"the COLMAP reconstruction in {where} lacks {' and '.join(missing)}"))
        elif not _has_images(root, "images", "images_*"):
            broken.append(("colmap", "the COLMAP reconstruction lacks its photographs, a folder images"))
        else:
            complete.append("colmap")
    if transforms.files_of(root):
        complete.append("transforms")
    if (root / "poses_bounds.npy").is_file():
        if _has_images(root, "images", "images_*"):
            complete.append("llff")
        else:
            broken.append(("llff", "poses_bounds.npy lacks its photographs, a folder images or images_N"))
    if found := [f for f in dtu.FILES if (root / f).is_file()]:
        if _has_images(root, *dtu.FOLDERS):
            complete.append("dtu")
        else:
            broken.append(("dtu", f"{found[0]} lacks its photographs, a folder {' or '.join(dtu.FOLDERS)}"))
    if middlebury.files_of(root):
        complete.append("middlebury")
    return complete, broken


def detect(root: Path) -> tuple[str, list[str]]:
    """Name the complete format of a scene folder.

    Args:
        root: The scene folder.

    Returns:
        colmap, transforms, llff, dtu or middlebury; and notes on formats passed over.

    Raises:
        DataError: The folder does not exist, or holds no format, or only a broken one; the message lists what was looked for.
    """
    if root.is_file():
        raise DataError(f"{root}: is a file; give the folder that holds the photographs and their cameras")
    if not root.is_dir():
        raise DataError(f"{root}: there is no such folder; give the folder that holds the photographs and their cameras")
    complete, broken = candidates(root)
    if not complete and broken:
        raise DataError(f"{root}: {broken[0][1]}, and there is no other format. Copy the whole reconstruction")
    if not complete:
        raise DataError(f"{root}: no scene format found. Looked for: {LOOKED_FOR}")
    taken, *others = complete
    notes = [f"{lack}; passed over, {taken} is complete" for _, lack in broken]
    if others:
        notes.append(f"the folder also holds {' and '.join(others)}: {taken} is taken")
    return taken, notes
