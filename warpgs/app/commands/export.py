"""`warpgs export`: write a run's Gaussians to a file. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` heads its help."""
    import tyro

    @dataclass(frozen=True)
    class Export:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`."""
        to: Path
        """File to write; its suffix says the format: .ply, .compressed.ply, .splat, .spz, .sog, .glb, .gltf, or .html for a
        page that shows the model in any browser."""

    a = parse_flags(Export, arguments, "warpgs export", about)
    if a.to.suffix.lower() == ".html":
        from warpgs.viewer.html import export_html as export
    else:
        from warpgs.pipeline.runs.commands import export
    for line in export(a.run, a.to):
        say(line)
    return 0
