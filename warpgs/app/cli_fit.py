"""The flags of `warpgs fit`, whose defaults depend on the preset, and that on the device. Parse and print; no logic."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

from warpgs.errors import UsageError
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.runs.folder import FitRequest, SceneRequest, choose_device
from warpgs.pipeline.train.config import DEFAULT_PRESET, PRESETS, FitConfig
from warpgs.pipeline.train.loss import LossConfig
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.holdout_blocks import HoldoutConfig
from warpgs.pipeline.train.strategies.importance_sampling import MethodConfig
from warpgs.pipeline.train.time_budget import check_budget
from warpgs.priors.view_prior import PriorConfig
from warpgs.render.rule_costs import select_rule
from warpgs.runtime.byte_units import parse_bytes
from warpgs.runtime.interop import set_threads


def _word(arguments: list[str], flag: str) -> str | None:
    """What follows a flag, which is needed before the others can be described; None where it is not given."""
    for i, word in enumerate(arguments):
        if word == flag and i + 1 < len(arguments):
            return arguments[i + 1]
        if word.startswith(f"{flag}="):
            return word.removeprefix(f"{flag}=")
    return None


def _flags(base: FitConfig) -> type:
    import tyro

    @dataclass(frozen=True)
    class Fit:
        scene: tyro.conf.Positional[Path]
        """Scene folder: COLMAP, transforms.json, LLFF, DTU or Middlebury."""
        out: Path
        """Run folder to fill; must not exist yet."""
        split: str | None = None
        """llff:K, mip360:K, dtu:3|6|9, blender:8, every:N, all, or train=NAMES;test=NAMES."""
        downscale: int = 1
        """Factor by which both image sides shrink."""
        steps: int = base.steps
        """Optimisation steps."""
        preset: str = base.preset
        """Named settings that the flags below start from."""
        device: str = "auto"
        """auto, cpu or cuda."""
        threads: int = 0
        """CPU threads; 0 for as many as there are cores."""
        seed: int = 0
        """Decides every random choice."""
        resume: bool = False
        """Continue the run in --out from its last checkpoint."""
        strict: bool = False
        """A frame without an image file is an error."""
        allow_outside: bool = False
        """Let transforms.json name files outside the scene folder."""
        invert_masks: bool = False
        """White in a mask removes a pixel."""
        score_masks: Path | None = None
        """Folder of object masks for scoring, matched by image id; the scene's idrmasks where not given."""
        lpips_weights: Path | None = None
        """File of `warpgs convert-lpips`; without it LPIPS is not measured."""
        rule: str = base.rule
        """Cut-offs of the rasterizer: exact, balanced, fast, gsplat or inria."""
        max_error: float | None = None
        """Have the fastest rule chosen whose pictures are off exact by at most this on average, in [0, 1]; not with --rule."""
        time_budget: float | None = None
        """Have the number of steps chosen so that the fit is done in this time [s]; not with --steps or --max-error."""
        half_resolution: float = base.half_resolution
        """Share of the steps, from the first, in which views are fitted at half their size."""
        sh_every: int = base.sh_every
        """Steps after which the spherical-harmonics degree rises by one."""
        dropout: float = base.dropout
        """Probability, at the last step, that a Gaussian is hidden for a step; it grows linearly from 0."""
        dropout_views: int = base.dropout_views
        """With more training views than this the probability is lower in proportion."""
        checkpoint_every: int = base.checkpoint_every
        """A checkpoint may be written at multiples of this step."""
        checkpoint_seconds: float = base.checkpoint_seconds
        """Time from one checkpoint to the next at the least [s]."""
        memory_limit: str | None = None
        """Most memory that the fit's tensors may take on its device while it takes steps, such as 2GiB or 800MB."""
        cuda_graph: bool = base.cuda_graph
        """On CUDA, record a step once and replay it: the same bytes in less time."""
        strategy: str = base.strategy
        """Where Gaussians are added and removed."""
        max_gaussians: int = base.max_gaussians
        """No more Gaussians than this, from the start on."""
        holdout: HoldoutConfig = field(default_factory=lambda: base.holdout)
        init: InitConfig = field(default_factory=lambda: base.init)
        loss: LossConfig = field(default_factory=lambda: base.loss)
        optimizer: OptimizerConfig = field(default_factory=lambda: base.optimizer)
        density: DensityConfig = field(default_factory=lambda: base.density)
        phases: PhaseConfig = field(default_factory=lambda: base.phases)
        method: MethodConfig = field(default_factory=lambda: base.method)
        priors: tyro.conf.OmitArgPrefixes[PriorConfig] = field(default_factory=lambda: base.priors)

    return Fit


def _choose(a, arguments: list[str], rooms: dict) -> tuple[str, ...]:
    """Let the measured prices choose where the user asked for it; notes that say what was chosen. Settings change in place."""
    if a.max_error is not None and a.time_budget is not None:
        raise UsageError("--max-error and --time-budget choose knobs by different prices: give one of them")
    if a.time_budget is not None:
        if a.resume or _word(arguments, "--steps"):
            raise UsageError(
                "--time-budget chooses the number of steps: leave out --steps, and to continue such a run give --resume with "
                "the --steps that it chose instead of --time-budget"
            )
        check_budget(a.time_budget)
    if a.max_error is None:
        return ()
    if _word(arguments, "--rule"):
        raise UsageError("--max-error chooses the rule: leave out --rule")
    rooms["rule"], note = select_rule(max_error=a.max_error)
    return (note,)


def fit(arguments: list[str], description: str) -> FitRequest:
    """The request that the words of a command line make.

    Raises:
        ResourceError: The device is not there.
        UsageError: A flag is wrong.
    """
    import tyro

    named, device = _word(arguments, "--preset"), _word(arguments, "--device") or "auto"
    kind = "cpu" if {"-h", "--help"} & set(arguments) and device == "auto" else choose_device(device)[0].type
    name = named or DEFAULT_PRESET[kind]
    if name not in PRESETS:
        raise UsageError(f"preset {name!r} is not one of {', '.join(PRESETS)}")
    base = PRESETS[name]
    a = tyro.cli(_flags(base), args=arguments, prog="warpgs fit", description=description)
    if a.threads < 0:
        raise UsageError(f"--threads must be 0 or more, not {a.threads}")
    if a.threads:
        set_threads(a.threads)
    rooms = {f.name: getattr(a, f.name, getattr(base, f.name)) for f in dataclasses.fields(base)}
    notes = _choose(a, arguments, rooms)
    rooms["memory_limit"] = None if a.memory_limit is None else parse_bytes(a.memory_limit)
    if named is None:
        steps = "as many steps as the time allows" if a.time_budget else f"{a.steps} steps"
        print(f"preset {name}, as usual on {kind}, {steps}; the time left stands in the line of progress")
    masks = None if a.score_masks is None else str(a.score_masks.resolve())
    scene = SceneRequest(str(a.scene), a.split, a.downscale, a.strict, a.allow_outside, a.invert_masks, masks)
    return FitRequest(scene, a.out, FitConfig(**rooms), a.device, a.resume, a.lpips_weights, a.time_budget, notes)
