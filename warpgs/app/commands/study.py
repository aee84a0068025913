"""`warpgs compare` and `warpgs ablate`: their common part. Parses, calls, prints; no logic."""

from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import Annotated

from warpgs.runtime.terminal import say


def study_flags() -> type:
    """Return the dataclass of the flags that `compare` and `ablate` share."""
    import tyro

    from warpgs.app.scene_flags import scene_flags

    reading, unread = scene_flags(positional=False)

    @dataclass(frozen=True, kw_only=True)
    class Study:
        scenes: tyro.conf.Positional[tuple[Path, ...]]
        """Scene folders."""
        out: Path
        """Folder of the study; repeat the command to continue an interrupted study."""
        seeds: int = 5
        """Number of runs of each setting on each scene; seeds count from 0."""
        steps: int | None = None
        """Optimisation steps of every run. Default: as in `warpgs fit`."""
        device: str = "auto"
        """auto, cpu or cuda."""
        slots: int | None = None
        """Number of concurrent runs, each in its own process. If neither --slots nor --per-gpu is given, runs follow each other
        in one process."""
        per_gpu: int | None = None
        """Runs that share a GPU."""
        lpips_weights: Path | None = None
        """File of `warpgs convert-lpips`; without it LPIPS is not measured."""

    hint = Annotated[reading, tyro.conf.arg(name="")]
    return make_dataclass("Study", [("reading", hint, field(default=unread))], bases=(Study,), frozen=True, kw_only=True)


def run_study_of(a, variants: dict, marks: dict) -> int:
    """Run the study of parsed flags."""
    from warpgs.app.scene_flags import scene_of
    from warpgs.pipeline.farm.run import EngineRequest
    from warpgs.pipeline.study.compare import run_study
    from warpgs.pipeline.study.study import StudyRequest

    scenes = tuple(scene_of(a.reading, str(s)) for s in a.scenes)
    farm = (
        None
        if a.slots is None and a.per_gpu is None
        else EngineRequest(slots=a.slots, per_gpu=1 if a.per_gpu is None else a.per_gpu)
    )
    for line in run_study(StudyRequest(scenes, variants, a.seeds, a.out, a.device, a.lpips_weights, farm, marks)):
        say(line)
    return 0
