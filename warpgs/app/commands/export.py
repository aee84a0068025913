"""`warpgs export`: write a run's Gaussians to a file. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` heads its help.

    Raises:
        UsageError: A filter is asked for that the format does not have.
    """
    import tyro

    @dataclass(frozen=True)
    class Export:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`."""
        to: Path
        """File to write; its suffix says the format: .ply, .compressed.ply, .splat, .spz, .sog, .glb, .gltf, or .html for a
        page that shows the model in any browser."""
        crop: str | None = None
        """Box to keep, in units of the scene's files: six numbers (least x,y,z and largest), or JSON with center, size and
        perhaps rotation."""
        clean: bool | None = None
        """Remove what only disturbs: Gaussians that no training view sees, larger than the scene, and long needles. On where
        not given, but for .ply."""
        sh_degree: int | None = None
        """Highest degree of harmonics; 0 for colours that are the same from all sides. All where not given."""
        rotate: str | None = None
        """Turn the model about the origin: x,y,z,degrees, or level (up as the cameras say)."""

    a = parse_flags(Export, arguments, "warpgs export", about)
    if a.to.suffix.lower() == ".html":
        from warpgs.errors import UsageError
        from warpgs.viewer.html import export_html

        if any(v is not None for v in (a.crop, a.clean, a.sh_degree, a.rotate)):
            raise UsageError("--crop, --clean, --sh-degree and --rotate are not for .html; export a .ply, and view that")
        lines = export_html(a.run, a.to)
    else:
        from warpgs.pipeline.runs.share import Filters, export

        lines = export(a.run, a.to, Filters(a.crop, a.clean, a.sh_degree, a.rotate))
    for line in lines:
        say(line)
    return 0
