"""Arms of the comparisons: rivals under one rule, and the steps of the ladder from plain 3DGS to the method."""

from __future__ import annotations

import re
import statistics
from collections import defaultdict
from dataclasses import dataclass, replace

from warpgs.errors import UsageError
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.settings import OPAQUE_STEPS

ONE_RULE = "background=auto,sh_degree=null,init.source=sweep,init.merge_px=8,init.fill_px=32"
"""Start, background and degree of `default`, without its extrapolated points; the degree follows from the number of views."""
NO_EXTRAPOLATION = "init.extrapolate=false"
STEPS = (125, 250, 500, 1000, 2000)
"""Numbers of steps, of which one is chosen by scores on left-out training views."""
SCORES = "method.s_render=true,method.s_semantic=true,method.s_geometry=true"
NO_GROWTH = "density.gradient=1e9"


@dataclass(frozen=True)
class Arm:
    """One row of a table."""

    words: str
    """Name on the page."""
    preset: str
    """Preset with its settings, as `bench.lib.one_fit.Fit` takes it, without steps that are chosen."""
    steps: tuple[int, ...] = ()
    """Numbers of steps to choose from; empty for those of the preset."""

    def with_steps(self, steps: int) -> str:
        """Return the preset with a number of steps."""
        return f"{self.preset}{',' if ':' in self.preset else ':'}steps={steps}"


def _paper(words: str, rule: str = ONE_RULE) -> Arm:
    """Return the arm of a method in `examples/rivals`, of the file and preset with the method's name in small letters."""
    name = words.lower()
    return Arm(words, f"examples/rivals/{name}.py:{name}:{rule}", PAPER_STEPS)


PAPER_STEPS = (500, 1500, 4000)
"""Numbers of steps of the papers' methods."""
FEW_STEPS = (250, 500, 1000)
"""Numbers of steps of `3dgs` and gsplat beside the papers' methods: of `STEPS`, those that rows of three views choose."""
OWN_START = "background=auto,sh_degree=null"
"""Rule for a method that is mostly its start."""
COR_GS = f"3dgs:strategy=examples/11_cor_gs.py:CorGS,density.gradient=0.0005,{ONE_RULE}"
GSPLAT = "gsplat:sh_degree=auto,background=mean"
NETWORK = "SEGMENTATION"
"""Environment variable with the path of a segmentation network, an ONNX file of 21 classes."""
OURS = (
    Arm("`default` without extrapolated points", f"default:{NO_EXTRAPOLATION}"),
    Arm("`default`", "default"),
)
RIVALS = (
    *OURS,
    Arm("`3dgs`", f"3dgs:{ONE_RULE}", STEPS),
    Arm("CoR-GS", COR_GS, (750, 1500, 3000, 6000)),
    Arm("gsplat", GSPLAT, STEPS),
    Arm("gsplat, as many steps as `default`", f"{GSPLAT},steps={OPAQUE_STEPS}"),
    Arm("gsplat, 7,000 steps", f"{GSPLAT},steps=7000"),
    Arm("gsplat, 30,000 steps", f"{GSPLAT},steps=30000"),
)
"""Methods under one rule: start (but for extrapolated points), background, degree and scores are those of `default`."""
PAPERS = (
    *OURS,
    replace(RIVALS[2], steps=FEW_STEPS),
    replace(RIVALS[3], steps=(500, 1000, 2000)),
    _paper("NexusGS", OWN_START),
    _paper("FSGS"),
    _paper("DNGaussian"),
    _paper("DropGaussian"),
    _paper("Binocular3DGS"),
    replace(RIVALS[4], steps=FEW_STEPS),
    Arm("`paper-literal`", "paper-literal"),
    Arm("`paper-literal`, segmentation by a network", f"paper-literal:priors.segmentation_model=${NETWORK}"),
)
"""Methods of papers as plug-ins with the start of `ONE_RULE`, but NexusGS; and the paper's own settings and steps."""
RERUNS = {
    "CoR-GS": {"fern": (22.29, 0.745), "horns": (19.02, 0.689)},
    "FSGS": {"fern": (21.90, 0.721), "horns": (20.19, 0.716)},
    "DNGaussian": {"fern": (20.51, 0.654), "horns": (19.25, 0.639)},
    "Binocular3DGS": {"fern": (22.58, 0.758), "horns": (20.61, 0.751)},
}
"""PSNR [dB] and SSIM that the authors' code reached at our size and split, one run each: docs/ablation of myduynn04/ReDI-GS."""
DTU = tuple(PAPERS[n] for n in (1, 2, 3, 4, 9))
"""Methods on an object of DTU."""
LADDER = (
    Arm("`3dgs`, random points", "3dgs:background=auto,sh_degree=null", STEPS),
    Arm("`3dgs`, start from the depth sweep", f"3dgs:{ONE_RULE}", STEPS),
    Arm(
        "learning rates, opacity decay and schedule of `default`",
        f"default:dropout=0,method.events=false,{NO_GROWTH},{NO_EXTRAPOLATION}",
    ),
    Arm("+ dropout", f"default:method.events=false,{NO_GROWTH},{NO_EXTRAPOLATION}"),
    Arm("+ placement at consistent depth", f"default:{NO_GROWTH},{NO_EXTRAPOLATION}"),
    Arm("+ refinement by gradients", f"default:{NO_EXTRAPOLATION}"),
    Arm("+ extrapolated points: `default`", "default"),
    Arm("+ importance: all three scores", f"default:{SCORES}"),
)
"""Steps of the method, each beside the one above it; the last is off in `default`."""
ABLATION = (
    Arm("`default`", "default"),
    Arm("pixels without consistent depth too", "default:method.ra=false"),
    Arm("two layers", "default:method.hier=true"),
    Arm("residual in the importance", "default:method.s_render=true"),
    Arm("residual and semantics", "default:method.s_render=true,method.s_semantic=true"),
    Arm("residual, semantics and geometry", f"default:{SCORES}"),
    Arm("all three, pixels of highest importance", f"default:{SCORES},method.agp=false"),
    Arm("no sampling events", "default:method.events=false"),
    Arm("no extrapolated points", f"default:{NO_EXTRAPOLATION}"),
    Arm("no opacity decay", "default:optimizer.opacities_decay=0"),
    Arm("no dropout", "default:dropout=0"),
)
"""One part of `default` changed."""
ARMS = {"rivals": RIVALS, "papers": PAPERS, "dtu": DTU, "ladder": LADDER, "ablation": ABLATION}


def steps_in(preset: str) -> int:
    """Return the steps that a preset sets, else those of `default` for few views."""
    if match := re.search(r"[:,]steps=(\d+)", preset):
        return int(match[1])
    named = PRESETS.get(preset.partition(":")[0])
    return (named.steps if named else None) or OPAQUE_STEPS


def chosen_steps(rows: list[dict], row: str, arm: Arm) -> int:
    """Return the number of steps with the best mean PSNR over the left-out training views of a row.

    If the tuning was cut short, only the numbers that were tried on the most views are compared.
    """
    found = defaultdict(list)
    for r in rows:
        if r["row"] == row and r["left_out"] and "error" not in r:
            found[r["preset"]].append(r["psnr"])
    scores = {n: found[arm.with_steps(n)] for n in arm.steps}
    most = max(map(len, scores.values()))
    if not most:
        raise UsageError(f"{row}, {arm.words}: no number of steps was tried on training views left out")
    return max((n for n in arm.steps if len(scores[n]) == most), key=lambda n: statistics.mean(scores[n]))
