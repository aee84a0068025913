"""`warpgs export`: write a run's Gaussians, or its cameras, to a file. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.report.progress import waiting
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    from warpgs.app.format_flags import chosen_formats, filters_of, format_flags, format_lines

    base = format_flags(arguments)

    @dataclass(frozen=True, kw_only=True)
    class Export(base):
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`."""
        to: Path
        """File to write; its suffix chooses the format. For cameras: cameras.json, transforms.json, or sparse (COLMAP)."""

    page = "  .html: a page that shows the model in any browser"
    a = parse_flags(Export, arguments, "warpgs export", f"{about}\n\n{format_lines()}\n{page}")
    formats, filters = chosen_formats(a, a.to), filters_of(a)
    waiting()(f"writing {a.to.name}")
    if a.to.suffix.lower() == ".html" and not formats:
        from warpgs.viewer.html import export_html

        lines = export_html(a.run, a.to, filters)
    else:
        from warpgs.pipeline.runs.export_model import export

        lines = export(a.run, a.to, filters, formats[0] if formats else None)
    for line in lines:
        say(line)
    return 0
