"""`warpgs export`: write a run's Gaussians, or its cameras, to a file. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import either, parse_flags
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
        page that shows the model in any browser. Its cameras instead: cameras.json, transforms.json, or sparse (COLMAP)."""
        crop: str | None = None
        """Box to keep, in units of the scene's files: x,y,z,X,Y,Z, or a .json file such as the one that the viewer saves."""
        clean: tyro.conf.FlagCreatePairsOff[bool] = False
        """Remove what only disturbs: Gaussians that no training view sees, larger than the scene, and long needles. Done
        unless the file is a .ply."""
        no_clean: tyro.conf.FlagCreatePairsOff[bool] = False
        """Keep these, too."""
        sh_degree: int | None = None
        """Highest degree of harmonics; 0 for colours that are the same from all sides. All where not given."""
        rotate: str | None = None
        """Turn the model about the origin: x,y,z,degrees, or level (up as the cameras say)."""

    a = parse_flags(Export, arguments, "warpgs export", about)
    from warpgs.pipeline.runs.export_filters import Filters

    filters = Filters(a.crop, either(a, "clean"), a.sh_degree, a.rotate)
    if a.to.suffix.lower() == ".html":
        from warpgs.viewer.html import export_html

        lines = export_html(a.run, a.to, filters)
    else:
        from warpgs.pipeline.runs.export_model import export

        lines = export(a.run, a.to, filters)
    for line in lines:
        say(line)
    return 0
