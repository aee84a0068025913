"""Commands around measuring: `compare`, `ablate`, `convert-lpips`. Parse, call, print; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.app.flags import parse_flags
from warpgs.runtime.terminal import say


def _parse(kind: type, name: str, arguments: list[str], description: str):
    return parse_flags(kind, arguments, f"warpgs {name}", description)


def _flags() -> type:
    """The flags that `compare` and `ablate` share."""
    import tyro

    from warpgs.io.decoding import MAX_PIXELS

    @dataclass(frozen=True, kw_only=True)
    class Study:
        scenes: tyro.conf.Positional[tuple[Path, ...]]
        """Scene folders."""
        out: Path
        """Folder of the study; the same command on it goes on where it stopped."""
        seeds: int = 5
        """Runs of each setting on each scene, seeds 0, 1, ..."""
        split: str | None = None
        """As in `warpgs fit`, for all scenes."""
        downscale: int = 1
        """Factor by which both image sides shrink."""
        allow_outside: bool = False
        """Let names and links of the scenes lead to images and masks outside their folders."""
        max_pixels: int = MAX_PIXELS
        """Largest number of pixels that an image or a mask may have as stored."""
        steps: int | None = None
        """Optimisation steps of every run; as in `warpgs fit` where not given."""
        device: str = "auto"
        """auto, cpu or cuda."""
        lpips_weights: Path | None = None
        """File of `warpgs convert-lpips`; without it LPIPS is not measured."""

    return Study


def _study(a, variants: dict, marks: dict) -> int:
    from warpgs.pipeline.runs.request import SceneRequest
    from warpgs.pipeline.study.compare import run_study
    from warpgs.pipeline.study.study import StudyRequest

    options = {"allow_outside": a.allow_outside, "max_pixels": a.max_pixels}
    scenes = tuple(SceneRequest(str(s), a.split, a.downscale, **options) for s in a.scenes)
    for line in run_study(StudyRequest(scenes, variants, a.seeds, a.out, a.device, a.lpips_weights, marks)):
        say(line)
    return 0


def compare(arguments: list[str], description: str) -> int:
    """Run `warpgs compare`: presets against each other."""
    from warpgs.pipeline.train.config import PRESETS

    base = _flags()

    @dataclass(frozen=True, kw_only=True)
    class Compare(base):
        presets: str = ",".join(PRESETS)
        """Names of presets with commas between; the others are compared with the first."""

    a = _parse(Compare, "compare", arguments, description)
    from warpgs.pipeline.study.compare import preset_variants

    names = [n.strip() for n in a.presets.split(",") if n.strip()]
    return _study(a, preset_variants(names, a.steps), {})


def ablate(arguments: list[str], description: str) -> int:
    """Run `warpgs ablate`: one preset with its parts off one at a time."""
    from warpgs.pipeline.train.config import DEFAULT_PRESET

    base = _flags()

    @dataclass(frozen=True, kw_only=True)
    class Ablate(base):
        preset: str = DEFAULT_PRESET
        """Preset whose parts are switched off one at a time."""

    a = _parse(Ablate, "ablate", arguments, description)
    from warpgs.pipeline.study.compare import ablation_variants, preset_variants

    (config,) = preset_variants([a.preset], a.steps).values()
    return _study(a, *ablation_variants(config))


def convert_lpips(arguments: list[str], description: str) -> int:
    """Join published LPIPS weights into one file."""

    @dataclass(frozen=True)
    class ConvertLpips:
        backbone: Path
        """torchvision's state dict of vgg16 or alexnet (.pth)."""
        heads: Path
        """vgg.pth or alex.pth of PerceptualSimilarity, folder lpips/weights/v0.1."""
        out: Path
        """File to write (.safetensors)."""

    a = _parse(ConvertLpips, "convert-lpips", arguments, description)
    from warpgs.pipeline.metrics.lpips_weights import convert_lpips as convert

    for line in convert(a.backbone, a.heads, a.out):
        say(line)
    return 0
