"""`warpgs compare` and `warpgs ablate`: what they share. Parses, calls, prints; no logic."""

from dataclasses import dataclass
from pathlib import Path

from warpgs.runtime.terminal import say


def study_flags() -> type:
    """Return the dataclass of the flags that `compare` and `ablate` share."""
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
        """As in `warpgs fit`, for all scenes; where not given, every 8th view or the middle one is held out."""
        downscale: int | None = None
        """Factor by which both image sides shrink; with it, images keep what it leaves of them."""
        max_side: int | None = None
        """Longest side that an image keeps [px], 0 for no limit; without this and --downscale 1600, or 800 on a CPU."""
        allow_outside: bool = False
        """Let names and links of the scenes lead to images and masks outside their folders."""
        max_pixels: int = MAX_PIXELS
        """Largest number of pixels that an image or a mask may have as stored."""
        steps: int | None = None
        """Optimisation steps of every run; as in `warpgs fit` where not given."""
        device: str = "auto"
        """auto, cpu or cuda."""
        slots: int | None = None
        """Runs at a time, each in a process of its own as `warpgs farm` has it; where neither this nor --per-gpu is given, they
        run one after another in this one."""
        per_gpu: int | None = None
        """Runs that share a GPU."""
        lpips_weights: Path | None = None
        """File of `warpgs convert-lpips`; without it LPIPS is not measured."""

    return Study


def run_study_of(a, variants: dict, marks: dict) -> int:
    """Run the study that parsed flags ask for."""
    from warpgs.pipeline.farm.run import EngineRequest
    from warpgs.pipeline.runs.request import SceneRequest
    from warpgs.pipeline.study.compare import run_study
    from warpgs.pipeline.study.study import StudyRequest

    options = {"allow_outside": a.allow_outside, "max_pixels": a.max_pixels, "max_side": a.max_side}
    scenes = tuple(SceneRequest(str(s), a.split, a.downscale, **options) for s in a.scenes)
    farm = (
        None
        if a.slots is None and a.per_gpu is None
        else EngineRequest(slots=a.slots, per_gpu=1 if a.per_gpu is None else a.per_gpu)
    )
    for line in run_study(StudyRequest(scenes, variants, a.seeds, a.out, a.device, a.lpips_weights, farm, marks)):
        say(line)
    return 0
