"""Which dataset format is this folder?"""

from __future__ import annotations

from pathlib import Path

from warpgs.errors import DataError
from warpgs.io import colmap, dtu, transforms

LOOKED_FOR = (
    "sparse/0 or sparse with cameras and images .bin/.txt (COLMAP), transforms.json or transforms_train.json "
    "(nerfstudio, instant-ngp, Blender), poses_bounds.npy (LLFF), cameras.npz (DTU), *_par.txt (Middlebury)"
)


def detect(root: Path) -> tuple[str, list[str]]:
    """Name the complete format of a scene folder.

    Args:
        root: The scene folder.

    Returns:
        colmap, transforms, llff, dtu or middlebury; and notes on broken formats passed over.

    Raises:
        DataError: The folder does not exist, or holds no format, or only a broken one; the message lists what was looked for.
    """
    if not root.is_dir():
        raise DataError(f"{root}: there is no such folder; give the folder that holds the photographs and their cameras")
    broken = []
    folder = colmap.model_folder(root)
    if folder is not None:
        missing = colmap.missing_parts(folder)
        if not missing:
            return "colmap", []
        broken.append(f"the COLMAP reconstruction in {folder.relative_to(root).as_posix()} lacks {' and '.join(missing)}")
    if transforms.files_of(root):
        found = "transforms"
    elif (root / "poses_bounds.npy").is_file():
        found = "llff"
    elif any((root / f).is_file() for f in dtu.FILES):
        found = "dtu"
    elif any(root.glob("*_par.txt")):
        found = "middlebury"
    elif broken:
        raise DataError(f"{root}: {broken[0]}, and there is no other format. Copy the whole reconstruction")
    else:
        raise DataError(f"{root}: no scene format found. Looked for: {LOOKED_FOR}")
    return found, [f"{b}; passed over, {found} is complete" for b in broken]
