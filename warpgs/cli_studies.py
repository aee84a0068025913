"""Commands around measuring: `convert-lpips`, `compare`, `ablate`. Parse, call, print; no logic."""

from dataclasses import dataclass
from pathlib import Path


def convert_lpips(arguments: list[str], description: str) -> int:
    """Join published LPIPS weights into one file."""
    import tyro

    @dataclass(frozen=True)
    class ConvertLpips:
        backbone: Path
        """torchvision's state dict of vgg16 or alexnet (.pth)."""
        heads: Path
        """vgg.pth or alex.pth of PerceptualSimilarity, folder lpips/weights/v0.1."""
        out: Path
        """File to write (.safetensors)."""

    a = tyro.cli(ConvertLpips, args=arguments, prog="warpgs convert-lpips", description=description)
    from warpgs.pipeline.lpips_weights import convert_lpips as convert

    for line in convert(a.backbone, a.heads, a.out):
        print(line)
    return 0
