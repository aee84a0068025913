"""`warpgs poses`: find the poses of photographs or of a video. Parses, calls, prints; no logic."""

import shlex
from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import MAX_THREADS, check_range, parse_flags
from warpgs.io.decoding import MAX_PIXELS
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    from warpgs.poses.find import FRAMES, find_poses

    @dataclass(frozen=True)
    class Poses:
        photographs: tyro.conf.Positional[Path]
        """Folder of photographs, or a video file."""
        out: Path
        """Scene folder to write; new or empty."""
        frames: int = FRAMES
        """Frames to take from a video, evenly spaced and sharp."""
        threads: int = 0
        """CPU threads; 0 for as many as there are cores."""
        max_pixels: int = MAX_PIXELS
        """Largest number of pixels that an image may have."""
        allow_outside: bool = False
        """Allow links to photographs outside the folder."""

        matcher: Path | None = None
        """ONNX file of `warpgs priors export --model xfeat`; finds matches where SIFT leaves photographs without a pose."""

    a = parse_flags(Poses, arguments, "warpgs poses", about)
    check_range("--frames", a.frames, 3, 1000)
    check_range("--threads", a.threads, 0, MAX_THREADS)
    check_range("--max-pixels", a.max_pixels, 1, 2**40)
    from warpgs.poses.record import TEXT, report_lines
    from warpgs.report.progress import Stages

    record = find_poses(
        a.photographs, a.out, frames=a.frames, threads=a.threads, max_pixels=a.max_pixels, allow_outside=a.allow_outside,
        matcher=a.matcher, progress=Stages(),
    )  # fmt: skip
    for line in report_lines(record):
        say(line)
    say(f"{a.out}: a COLMAP scene; the lines above are also in {a.out / TEXT}")
    say(f"next: warpgs fit {shlex.quote(str(a.out))} --out run")
    return 0
