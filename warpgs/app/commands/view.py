"""`warpgs view`: look at a model in a browser. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import check_range, parse_flags


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    @dataclass(frozen=True)
    class View:
        run: tyro.conf.Positional[Path]
        """Run folder of `warpgs fit`, also during the fit; or a file of Gaussians, in a format of `warpgs convert`."""
        port: int = 8080
        """Port of the viewer on this machine; 0 for any free one."""
        device: str = "auto"
        """Device that renders depth, coverage and error: auto, cpu or cuda."""
        reader: str | None = None
        """User-defined reader, as for `warpgs fit --reader`."""

    a = parse_flags(View, arguments, "warpgs view", about)
    check_range("--port", a.port, 0, 65535)
    from warpgs.viewer.watch import view

    view(a.run, a.port, a.device, a.reader)
    return 0
