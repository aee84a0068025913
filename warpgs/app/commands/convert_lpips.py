"""`warpgs convert-lpips`: join published LPIPS weights. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.runtime.terminal import say


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""

    @dataclass(frozen=True)
    class ConvertLpips:
        backbone: Path
        """torchvision's state dict of vgg16 or alexnet (.pth)."""
        heads: Path
        """vgg.pth or alex.pth of PerceptualSimilarity, folder lpips/weights/v0.1."""
        out: Path
        """File to write (.safetensors)."""

    a = parse_flags(ConvertLpips, arguments, "warpgs convert-lpips", about)
    from warpgs.pipeline.metrics.lpips_weights import convert_lpips as convert

    for line in convert(a.backbone, a.heads, a.out):
        say(line)
    return 0
