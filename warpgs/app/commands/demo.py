"""`warpgs demo`: write a synthetic scene. Parses, calls, prints; no logic."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import check_range, parse_flags, word_after
from warpgs.errors import UsageError
from warpgs.report.progress import waiting
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help.

    Raises:
        UsageError: Flags exclude each other, or a value is invalid.
    """
    import tyro

    @dataclass(frozen=True)
    class Demo:
        folder: tyro.conf.Positional[Path]
        """Folder to write; new or empty."""
        views: int = 24
        """Number of photographs."""
        width: int = 320
        """Image width [px]."""
        height: int = 240
        """Image height [px]."""
        seed: int = 0
        """Seed of the textures, and of the shape of an object."""
        object: bool = False
        """Write a single object instead of a still life; eight of the views are for training."""
        format: str = "transforms"
        """Format of --object: transforms (transforms.json with RGBA images) or colmap (RGB images with cut-out masks)."""

    a = parse_flags(Demo, arguments, "warpgs demo", about)
    check_range("--views", a.views, 8, 10_000)
    check_range("--width", a.width, 32, 8192)
    check_range("--height", a.height, 32, 8192)
    check_range("--seed", a.seed, 0, 2**31 - 1)
    if a.format not in ("transforms", "colmap"):
        raise UsageError(f"--format must be transforms or colmap, not {a.format!r}")
    if a.format != "colmap" and not a.object and word_after(arguments, "--format") is not None:
        raise UsageError("--format requires --object: the still life is always written as COLMAP")
    size = {"views": a.views, "width": a.width, "height": a.height, "seed": a.seed}
    if a.object:
        from warpgs.synthetic.cut_out import write_object

        write_object(a.folder, form=a.format, **size, tell=waiting())
        flags = "--split llff:8" + (" --masks cutout" if a.format == "colmap" else "")
    else:
        from warpgs.synthetic.demo import write_demo

        write_demo(a.folder, **size, tell=waiting())
        flags = "--split every:8"
    form = "transforms.json" if a.object and a.format == "transforms" else "COLMAP"
    say(f"{a.folder}: {a.views} views of {a.width} x {a.height} px as a {form} folder")
    say(f"next: warpgs fit {shlex.quote(str(a.folder))} {flags} --out run")
    return 0
