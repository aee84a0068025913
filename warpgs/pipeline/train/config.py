"""All settings of a fit, composed of the dataclasses of its modules."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import typing
from dataclasses import dataclass, field
from typing import Any

from warpgs.errors import UsageError
from warpgs.kernels.sh import MAX_DEGREE
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.model.scale_limits import LimitConfig
from warpgs.pipeline.train.background import color_of
from warpgs.pipeline.train.context import Settings
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm, check_terms
from warpgs.pipeline.train.loss_terms.built_in import LossConfig
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.stopping import StoppingConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES, find_strategy
from warpgs.pipeline.train.strategies.gradient_growth import DensityConfig
from warpgs.pipeline.train.strategies.sampling_event import MethodConfig
from warpgs.pipeline.train.view_modules.base import VIEW_MODULES, ViewModule, check_modules
from warpgs.plugins import Registry, own_code
from warpgs.priors.view_prior import PriorConfig
from warpgs.rules import rule_named
from warpgs.schema import SchemaError, anything, mapping, of_type


@dataclass(frozen=True)
class FitConfig:
    """All settings of a fit."""

    preset: str = "3dgs"
    """Preset that the other settings start from: a name, a .toml file of settings, or your own FitConfig or mapping as
    module:NAME or path/to/file.py:NAME."""
    steps: int | None = 7000
    """Number of optimisation steps; early stopping may end the fit sooner. None: chosen by the number of views."""
    max_steps: int = 30_000
    """Largest number of steps that is chosen by the number of views."""
    batch: int = 1
    """Number of views that each step renders; their gradients are averaged. Learning rates are multiplied by the square root of
    this number (docs/many-gpus.md). Several GPUs share the views of a step."""
    cpu_limit: bool = True
    """Limit the steps on a CPU, if --steps is None: at most as many as two cores finish in 1 to 20 minutes, depending on the
    number of views."""
    seed: int = 0
    """Seed of all random numbers; the same seed, data and kind of device give the same bytes."""
    rule: str = "exact"
    """Cut-offs of the rasterizer: exact, balanced, fast, gsplat-1.6, gsplat-1.5 or inria."""
    antialiased: bool = False
    """Antialiased model, for renders at other sizes than the photos (Mip-Splatting, Yu et al. 2024). Gaussians smaller than a
    pixel get a lower opacity, and no axis is smaller than the training cameras resolve (docs/rasterizer.md). Renders of the run
    are antialiased, too; other programs need their antialiased mode."""
    half_resolution: float | None = 0.0
    """Fraction of the steps, from the first step on, that use views of half size (docs/trade.md). None: chosen by the number of
    views."""
    sh_degree: int | None = 3
    """Highest spherical-harmonics degree of the colours, 0 to 4; only PLY files store degree 4. None: chosen by the number of
    views."""
    sh_every: int = 1000
    """Number of steps after which the spherical-harmonics degree rises by one."""
    dropout: float = 0.0
    """Dropout: probability that a Gaussian is hidden in a step. It grows linearly from 0 to this value at the last step
    (DropGaussian, Park et al. 2025)."""
    dropout_views: int = 3
    """Number of training views up to which dropout has its full probability; with more views it falls in proportion."""
    checkpoint_every: int = 1000
    """Number of steps between checkpoints; the last step always writes a checkpoint."""
    checkpoint_seconds: float = 20.0
    """Least time between checkpoints [s], because writing takes time. This setting does not affect results."""
    memory_limit: int | None = None
    """Memory limit for the tensors of the fit on its device during steps [bytes]; None for no limit. Densification stops before
    a step would exceed the limit, and images are rendered in chunks if a whole image would exceed the limit."""
    cuda_graph: bool = True
    """CUDA graphs: steps are captured once and replayed, which is faster and gives the same bytes."""
    max_gaussians: int = 1_000_000
    """Largest number of Gaussians at any step, including the start."""
    background: str = "scene"
    """Background colour, behind all Gaussians: mean (mean colour of the training views), scene (colour of the files: white for
    Blender, else black), auto (mean if the training views are opaque and show no object on black, else scene), black, white,
    #rrggbb, or r,g,b in [0, 1]."""
    strategy: str = "clone_split"
    """Density strategy, which adds and removes Gaussians: a name, or your own as module:Class or path/to/file.py:Class."""
    strategy_config: Any = None
    """Settings of the strategy, an instance of its ``Config``; None for the defaults. Settings of clone_split and
    importance_sampling are the groups ``density`` and ``method``."""
    loss_terms: tuple[LossTerm, ...] = ()
    """Additional loss terms, besides those of ``loss``; each class is registered by a name."""
    view_modules: tuple[ViewModule, ...] = ()
    """View modules, which learn parameters of each training view together with the Gaussians (docs/your-photos.md); each class
    is registered by a name. A built-in module also has a flag of its name."""
    stopping: StoppingConfig = field(default_factory=StoppingConfig)
    """Early stopping by left-out blocks of the training views, with any strategy (docs/decisions/020)."""
    init: InitConfig = field(default_factory=InitConfig)
    """Source and initial values of the Gaussians."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Weights of the built-in loss terms."""
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    """Learning rates."""
    density: DensityConfig = field(default_factory=DensityConfig)
    """Settings of cloning, splitting and pruning (strategies clone_split and importance_sampling)."""
    limits: LimitConfig = field(default_factory=LimitConfig)
    """Limits of the size and the shape of every Gaussian."""
    phases: PhaseConfig = field(default_factory=PhaseConfig)
    """Lengths of the three phases, and times of sampling."""
    method: MethodConfig = field(default_factory=MethodConfig)
    """Settings of strategy importance_sampling."""
    priors: PriorConfig = field(default_factory=PriorConfig)
    """Networks that compute the priors of the views."""

    def __post_init__(self) -> None:
        for name in ("steps", "max_steps", "batch", "sh_every", "checkpoint_every", "dropout_views", "max_gaussians"):
            if getattr(self, name) is not None and getattr(self, name) < 1:
                raise UsageError(f"{name.replace('_', '-')} must be at least 1, not {getattr(self, name)}")
        if not 0 <= self.seed < 2**31:
            raise UsageError(f"seed must be a whole number from 0 to 2^31 - 1, not {self.seed}")
        if self.memory_limit is not None and not self.memory_limit >= 1:
            raise UsageError(f"memory-limit must be at least one byte, not {self.memory_limit}")
        if not self.checkpoint_seconds >= 0:
            raise UsageError(f"checkpoint-seconds must be at least 0, not {self.checkpoint_seconds}")
        if self.half_resolution is not None and not 0 <= self.half_resolution <= 1:
            raise UsageError(f"half-resolution must be in [0, 1], not {self.half_resolution}")
        if self.sh_degree is not None and not 0 <= self.sh_degree <= MAX_DEGREE:
            raise UsageError(f"sh-degree must be in [0, {MAX_DEGREE}], not {self.sh_degree}")
        if not 0 <= self.dropout < 1:
            raise UsageError(f"dropout must be in [0, 1), not {self.dropout}")
        rule_named(self.rule)
        color_of(self.background)
        check_terms(self.loss_terms)
        check_modules(self.view_modules)
        if isinstance(self.strategy, type):
            object.__setattr__(self, "strategy", STRATEGIES.name_of(self.strategy))
        own = find_strategy(self.strategy).Config if STRATEGIES.knows(self.strategy) else None
        if own is not None and self.strategy_config is None:
            object.__setattr__(self, "strategy_config", own())
        self.own_code()  # the file as it is now: the user may edit it while a study runs

    def groups(self) -> Settings:
        """Return the groups of settings by their class."""
        return Settings(value for value in vars(self).values() if dataclasses.is_dataclass(value))

    def own_code(self) -> dict[str, str]:
        """Return the SHA-256 of each user-defined class's source file, by class name."""
        return own_code(self.plugged_in())

    def plugged_in(self) -> list[type]:
        """Return the classes of the strategy (if this process has loaded it), loss terms and view modules."""
        strategy = [find_strategy(self.strategy)] if STRATEGIES.knows(self.strategy) else []
        return [*strategy, *(type(part) for name in _PARTS for part in getattr(self, name))]

    def to_json(self) -> dict[str, Any]:
        """Return nested plain values, as stored in a run folder."""
        parts = {n: [{"name": p.name, **dataclasses.asdict(p)} for p in getattr(self, n)] for n in _PARTS}
        return dataclasses.asdict(dataclasses.replace(self, loss_terms=(), view_modules=())) | parts

    @staticmethod
    def from_json(values: dict[str, Any]) -> FitConfig:
        """Return the configuration that `to_json` stored.

        Raises:
            SchemaError: A value has the wrong type for its field.
            UsageError: A field is unknown, a value is out of range, or a user-defined class is not loaded.
        """
        mapping(anything)(values, "config")
        try:
            values = dict(values)
            parts = {n: tuple(_part(registry, dict(p), n) for p in values.pop(n)) for n, registry in _PARTS.items()}
            own = values.pop("strategy_config")
            if isinstance(loss := values["loss"], dict):
                values["loss"] = {n: v for n, v in loss.items() if n != "exposure_weight"}  # stored earlier, without effect
            kind = find_strategy(values["strategy"]).Config
            if own is not None and kind is None:
                raise SchemaError(f"strategy_config must be null for strategy {values['strategy']}")
            own = own if kind is None or own is None else _compose(kind, own, "strategy_config")
            config: FitConfig = _compose(FitConfig, values | parts | {"strategy_config": own}, "config")
            return config
        except (TypeError, KeyError) as e:
            raise UsageError(f"the configuration was stored by another version of warpgs ({e})") from e

    def fingerprint(self) -> str:
        """Return the first 12 hexadecimal digits of the SHA-256 of the settings."""
        return hashlib.sha256(json.dumps(self.to_json(), sort_keys=True).encode()).hexdigest()[:12]


_PARTS: dict[str, Registry[Any]] = {"loss_terms": LOSS_TERMS, "view_modules": VIEW_MODULES}
"""Fields of `FitConfig` that hold parts of a registry, each with its settings."""


def _part(registry: Registry[Any], values: dict[str, Any], field: str) -> Any:
    """Return a part of a registry from its stored name and settings."""
    return _compose(registry.find(values.pop("name")), values, field)


def _compose(kind: type, values: dict[str, Any], place: str) -> Any:
    """Return a settings dataclass from nested plain values; its fields that are dataclasses are composed in turn.

    Raises:
        SchemaError: A value has the wrong type for its field.
    """
    mapping(anything)(values, place)
    kinds, composed = typing.get_type_hints(kind), {}
    for name, value in values.items():
        where, of = f"{place}.{name}", kinds.get(name, Any)
        if isinstance(of, type) and dataclasses.is_dataclass(of):
            composed[name] = _compose(of, value, where)
        elif name not in (*_PARTS, "strategy_config"):  # these are composed before
            of_type(of)(list(value) if isinstance(value, tuple) else value, where)
            listed = any(typing.get_origin(part) is tuple for part in (of, *typing.get_args(of)))
            composed[name] = tuple(value) if listed and isinstance(value, list) else value
        else:
            composed[name] = value
    return kind(**composed)
