"""Settings of a fit: their classes, changes by name, and what views and time choose."""

from __future__ import annotations

import copy
import dataclasses
import functools
import hashlib
import json
import math
import numbers
import statistics
import time
import types
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import torch

from warpgs.constants import rule_named
from warpgs.device import parse_bytes
from warpgs.errors import UsageError, did_you_mean
from warpgs.kernels.sh import MAX_DEGREE
from warpgs.pipeline.model.limits import LimitConfig
from warpgs.pipeline.model.start import InitConfig, extrapolates
from warpgs.pipeline.train.loss import LOSS_TERMS, SSIM_WEIGHT, LossConfig, LossTerm, check_outputs, photometric_loss
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig, color_of, plan_phases
from warpgs.pipeline.train.stopping import StoppingConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES, Settings, find_strategy
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.sampling import AVERAGE_LAST, MAX_VIEWS, MAX_WEIGHED, MethodConfig, removals
from warpgs.pipeline.train.view_modules import VIEW_MODULES, ViewModule
from warpgs.plugins import Registry, flag_group, own_code
from warpgs.priors.views import PriorConfig
from warpgs.process import Detail
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians, View
from warpgs.schema import Checked, SchemaError, Within, anything, mapping, of_type


@dataclasses.dataclass(frozen=True)
class FitConfig(Checked):
    """All settings of a fit."""

    preset: str = "3dgs"
    """Preset that the other settings start from: a name, a .toml file of settings, or your own FitConfig or mapping as
    module:NAME or path/to/file.py:NAME."""
    steps: Annotated[int | None, Within(1)] = 7000
    """Number of optimisation steps; early stopping may end the fit sooner. None: chosen by the views."""
    max_steps: Annotated[int, Within(1)] = 30_000
    """Largest number of steps that is chosen by the views."""
    batch: Annotated[int, Within(1)] = 1
    """Number of views that each step renders; their gradients are averaged. Learning rates are multiplied by the square root of
    this number (docs/many-gpus.md). Several GPUs share the views of a step."""
    cpu_limit: bool = True
    """Limit steps and Gaussians on a CPU, if --steps is None: at most as many as two cores finish in 10 s to 20 minutes,
    depending on the number of views and on --max-steps."""
    seed: Annotated[int, Within(0, 2**31 - 1)] = 0
    """Seed of all random numbers; the same seed, data and kind of device give the same bytes."""
    rule: str = "exact"
    """Cut-offs of the rasterizer: exact, balanced, fast, gsplat-1.6, gsplat-1.5 or inria."""
    antialiased: bool = False
    """Antialiased model, for renders at other sizes than the photos (Mip-Splatting, Yu et al. 2024). Gaussians smaller than a
    pixel get a lower opacity, and no axis is smaller than the training cameras resolve (docs/rasterizer.md). Renders of the run
    are antialiased, too; other programs need their antialiased mode."""
    half_resolution: Annotated[float | None, Within(0, 1)] = 0.0
    """Fraction of the steps, from the first step on, that use views of half size (docs/numerics.md). None: chosen by the number
    of views."""
    sh_degree: Annotated[int | None, Within(0, MAX_DEGREE)] = 3
    """Highest spherical-harmonics degree of the colours, 0 to 4; only PLY files store degree 4. None: chosen by the number of
    views."""
    sh_every: Annotated[int, Within(1)] = 1000
    """Number of steps after which the spherical-harmonics degree rises by one."""
    dropout: Annotated[float, Within(0, 1, ")")] = 0.0
    """Dropout: probability that a Gaussian is hidden in a step. It grows linearly from 0 to this value at the last step
    (DropGaussian, Park et al. 2025), and falls in proportion to the number of training views above 3."""
    checkpoint_every: Annotated[int, Within(1)] = 1000
    """Number of steps between checkpoints; the last step always writes a checkpoint. Because writing takes time, checkpoints at
    every 1000 steps or more are also at least 20 s apart."""
    memory_limit: Annotated[int | None, Within(1)] = None
    """Memory limit for the tensors of the fit on its device during steps [bytes]; None for no limit. Densification stops before
    a step would exceed the limit, and images are rendered in chunks if a whole image would exceed the limit."""
    cuda_graph: bool = True
    """CUDA graphs: steps are captured once and replayed, which is faster and gives the same bytes."""
    max_gaussians: Annotated[int, Within(1)] = 1_000_000
    """Largest number of Gaussians at any step, including the start; --cpu-limit may lower it."""
    background: str = "scene"
    """Background colour, behind all Gaussians: mean (mean colour of the training views), scene (colour of the files: white for
    Blender, else black), auto (mean if the training views are opaque and show no object on black, else scene), black, white,
    #rrggbb, or r,g,b in [0, 1]."""
    strategy: str = "clone_split"
    """Density strategy, which adds and removes Gaussians: a name, or your own as module:Class or path/to/file.py:Class."""
    strategy_config: Any = None
    """Settings of the strategy, an instance of its ``Config``; None for the defaults. Settings of clone_split and
    sampling are the groups ``density`` and ``method``."""
    loss_terms: tuple[LossTerm, ...] = ()
    """Additional loss terms, besides those of ``loss``; each class is registered by a name."""
    view_modules: tuple[ViewModule, ...] = ()
    """View modules, which learn parameters of each training view together with the Gaussians (docs/your-photos.md); each class
    is registered by a name. A built-in module also has a flag of its name."""
    stopping: StoppingConfig = dataclasses.field(default_factory=StoppingConfig)
    """Early stopping by left-out blocks of the training views, with any strategy (docs/decisions/020)."""
    init: InitConfig = dataclasses.field(default_factory=InitConfig)
    """Source and initial values of the Gaussians."""
    loss: LossConfig = dataclasses.field(default_factory=LossConfig)
    """Weights of the built-in loss terms."""
    optimizer: OptimizerConfig = dataclasses.field(default_factory=OptimizerConfig)
    """Learning rates."""
    density: DensityConfig = dataclasses.field(default_factory=DensityConfig)
    """Settings of cloning, splitting and pruning (strategies clone_split, sampling and paper)."""
    limits: LimitConfig = dataclasses.field(default_factory=LimitConfig)
    """Limits of the size and the shape of every Gaussian."""
    phases: PhaseConfig = dataclasses.field(default_factory=PhaseConfig)
    """Lengths of the three phases."""
    method: MethodConfig = dataclasses.field(default_factory=MethodConfig)
    """Settings of strategies sampling and paper."""
    priors: PriorConfig = dataclasses.field(default_factory=PriorConfig)
    """Networks that compute the priors of the views."""

    def __post_init__(self) -> None:
        super().__post_init__()
        rule_named(self.rule)
        color_of(self.background)
        for field, registry in PARTS.items():
            for part in getattr(self, field):
                if not isinstance(part, registry.base):
                    kind, base = registry.kind, registry.base.__name__
                    raise UsageError(f"{part!r} is not a {kind}: give an instance of a class that derives from warpgs.{base}")
                if not registry.has(type(part)):
                    raise UsageError(registry.unnamed(type(part)))
        check_outputs(self.loss_terms)
        names = [m.name for m in self.view_modules]
        if twice := [n for n in names if names.count(n) > 1]:
            raise UsageError(f"the view module {twice[0]!r} is given twice; remove one")
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
        return [*strategy, *(type(part) for name in PARTS for part in getattr(self, name))]

    def to_json(self) -> dict[str, Any]:
        """Return nested plain values, as stored in a run folder."""
        parts = {n: [{"name": p.name, **dataclasses.asdict(p)} for p in getattr(self, n)] for n in PARTS}
        return dataclasses.asdict(dataclasses.replace(self, loss_terms=(), view_modules=())) | parts

    @staticmethod
    def from_json(values: dict[str, Any]) -> FitConfig:
        """Return the configuration that `to_json` stored; SchemaError for a wrong type, UsageError for other faults."""
        mapping(anything)(values, "config")
        try:
            values, lost = upgraded(values)
            if lost:
                raise UsageError(f"this version does not have the settings {', '.join(lost)}")
            parts = {}
            for field, registry in PARTS.items():
                stored = [(registry.find(p["name"]), {n: v for n, v in p.items() if n != "name"}) for p in values.pop(field)]
                parts[field] = tuple(_compose(kind, own, field) for kind, own in stored)
            own = values.pop("strategy_config")
            kind = find_strategy(values["strategy"]).Config
            if own is not None and kind is None:
                raise SchemaError(f"strategy_config must be null for strategy {values['strategy']}")
            own = own if kind is None or own is None else _compose(kind, own, "strategy_config")
            return _compose(FitConfig, values | parts | {"strategy_config": own}, "config")
        except (TypeError, KeyError) as e:
            raise UsageError(f"the configuration was stored by another version of warpgs ({e})") from e

    def fingerprint(self) -> str:
        """Return the first 12 hexadecimal digits of the SHA-256 of the settings."""
        return fingerprint(self.to_json())


def fingerprint(config: Mapping[str, Any]) -> str:
    """Return the first 12 hexadecimal digits of the SHA-256 of settings as plain values."""
    return hashlib.sha256(json.dumps(config, sort_keys=True).encode()).hexdigest()[:12]


PARTS: dict[str, Registry[Any]] = {"loss_terms": LOSS_TERMS, "view_modules": VIEW_MODULES}
"""Fields of `FitConfig` that hold parts of a registry, each with settings of its own."""


def _compose(kind: type, values: dict[str, Any], place: str) -> Any:
    """Return a settings dataclass from nested plain values; its fields that are dataclasses are composed in turn."""
    mapping(anything)(values, place)
    kinds, composed = get_type_hints(kind), {}
    for name, value in values.items():
        where, of = f"{place}.{name}", kinds.get(name, Any)
        if isinstance(of, type) and dataclasses.is_dataclass(of):
            composed[name] = _compose(of, value, where)
        elif name not in (*PARTS, "strategy_config"):  # these are composed before
            of_type(of)(list(value) if isinstance(value, tuple) else value, where)
            listed = any(get_origin(part) is tuple for part in (of, *get_args(of)))
            composed[name] = tuple(value) if listed and isinstance(value, list) else value
        else:
            composed[name] = value
    return kind(**composed)


SIDE_FILE = "give it in FILE.onnx.json, beside the network (docs/priors.md)"
PAPER = "--strategy paper --paper.{}"
REMOVED: dict[str, tuple[Any, str]] = {
    "checkpoint_seconds": (20.0, "--checkpoint-every below 1000 writes each checkpoint"),
    "dropout_views": (3, ""),
    "stopping.fraction": (0.03, ""), "stopping.measurements": (12, ""), "stopping.noise": (1.0, ""),
    "init.near_views": (4, ""), "init.max_residual": (1.0, ""), "init.blend": ("least_sensitive", ""),
    "init.flow_range": ("255", "export the flow network with inputs of 0 to 255"),
    "loss.random_background": (True, ""), "loss.ssim_weight": (0.2, ""),
    "optimizer.means_lr_final": (1.6e-6, ""), "optimizer.quats_lr": (1e-3, ""), "optimizer.sh_rest_factor": (0.05, ""),
    "density.clone_size": (0.01, ""), "density.prune_opacity": (0.005, ""), "density.morton_order": (True, ""),
    "limits.min_pixels": (0.2**0.5, ""), "limits.ratio_from": (0.7, ""),
    "phases.every": (100.0, ""), "phases.growth": (4.0, ""),
    "method.keep": (1.0, "use `warpgs prune` on the finished run"),
    "method.events": (True, "use --strategy clone_split for a fit without sampling events"),
    **{f"method.{n}": (v, f"use {PAPER.format(n.replace('_', '-'))}") for n, v in {
        "s_render": False, "s_semantic": False, "s_geometry": False, "ra": True, "agp": True, "pm": True}.items()},
    "method.coarse_lr_factor": (0.1, ""),
    "method.importance.render": (0.4, ""), "method.importance.semantic": (0.2, ""), "method.importance.geometry": (0.4, ""),
    "method.importance.residual": ("length", f"use {PAPER.format('residual')}"), "method.importance.curvature": (0.5, ""),
    "method.sampler.depth": ("consistent", f"use {PAPER.format('depth')}"),
    "method.sampler.gate_quantile": (0.0, f"use {PAPER.format('gate-quantile')}"),
    "method.sampler.min_alpha": (0.5, ""), "method.sampler.border": (2, ""), "method.sampler.opacity": (0.1, ""),
    "method.protect.steps": (500, ""), "method.protect.opacity": (0.05, ""),
    "priors.depth_output": ("auto", SIDE_FILE),
    **{f"priors.{kind}_{n}": (v, SIDE_FILE) for kind in ("depth", "segmentation")
       for n, v in {"size": 0, "multiple": 0, "mean": None, "std": None}.items()},
    "priors.cache": (True, "set the environment variable WARPGS_CACHE to a folder of your own"),
}  # fmt: skip
"""Settings of earlier versions: the value that every fit has now, and what replaces the setting; empty for a constant."""
OLD_STRATEGY = "importance_sampling"
"""Earlier name of the strategies sampling and paper."""


def removed_note(name: str) -> str:
    """Return what replaces a removed setting, given as flag, key or keyword; empty for another name."""
    words = name.replace("-", "_").replace(".no_", ".").removeprefix("no_")
    for full, (value, instead) in REMOVED.items():
        short = full.removeprefix(f"{WITHOUT_PREFIX}.")
        if words in (short, keyword(short)):
            return f"the setting {flag(short)} was removed: {instead or f'every fit uses {value}'}"
    return ""


def upgraded(config: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return stored settings by their present names, and each removed setting with a value that fits no longer have."""
    values = copy.deepcopy(dict(config))
    method, importance, sampler = (_group(values, n) for n in ("method", "method.importance", "method.sampler"))
    _group(values, "loss").pop("exposure_weight", None)  # had no effect
    values.pop("checkpoint_seconds", None)  # affected no result
    homes = dict.fromkeys(("s_render", "s_semantic", "s_geometry", "ra", "agp", "pm"), method)
    homes |= {"residual": importance, "depth": sampler, "gate_quantile": sampler}
    if "events" in method and all(n in home for n, home in homes.items()):
        events, parts = method.pop("events"), {n: home.pop(n) for n, home in homes.items()}
        if values.get("strategy") == OLD_STRATEGY:
            plain = {n: REMOVED[f"method.{n}"][0] for n, home in homes.items() if home is method}
            plain |= {"residual": parts["residual"], "depth": "consistent", "gate_quantile": 0.0}
            values["strategy"] = ("sampling" if parts == plain else "paper") if events else "clone_split"
            values["strategy_config"] = parts if values["strategy"] == "paper" else None
    lost = []
    for name, (value, _) in REMOVED.items():
        place, _, last = name.rpartition(".")
        group = _group(values, place)
        if last in group and (stored := group.pop(last)) != value:
            lost.append(f"{flag(name.removeprefix(f'{WITHOUT_PREFIX}.'))} {str(stored)[:60]}")
    for name in ("importance", "protect"):
        if method.get(name) == {}:
            del method[name]
    return values, lost


def _group(values: dict[str, Any], name: str) -> dict[str, Any]:
    """Return a group of stored settings; an empty one if it is missing or no mapping, which `FitConfig.from_json` refuses."""
    for part in filter(None, name.split(".")):
        inner = values.get(part)
        values = inner if isinstance(inner, dict) else {}
    return values


Path = tuple[str, ...]
"""Path from a `FitConfig` to a setting, as names of fields; a number is the index of a loss term or a view module."""
WITHOUT_PREFIX = "priors"
"""Group without a prefix in its flags."""
OTHERS = ("preset", "strategy", "strategy_config", *PARTS)
"""Fields whose values are converted in their own way, such as by looking up a name."""


def setting_names(config: FitConfig) -> list[str]:
    """Return the names of all settings, such as ``init.opacity``, including those of strategy, loss terms and view modules."""
    return ["strategy", *PARTS, *VIEW_MODULES.names(), *_leaves(config)]


def keyword(name: str) -> str:
    """Return the keyword of a setting: ``init_opacity`` for ``init.opacity``."""
    return name.replace(".", "_")


def flag(name: str) -> str:
    """Return the flag of a setting without its leading dashes: ``init.random-count`` for ``init.random_count``."""
    return name.replace("_", "-")


def with_settings(config: FitConfig, values: Mapping[str, Any], place: str, *, keywords: bool = False) -> FitConfig:
    """Return settings with some of them replaced; messages name ``place``, a file or the function that was called.

    Values are given by name of the flag (``init.opacity``), by names in nested mappings, or by keyword (``init_opacity``).
    Only in ``keywords`` of a call in Python may ``strategy``, ``loss_terms`` and ``view_modules`` name ``module:Class`` or
    ``file.py:Class``, which is imported.
    """
    try:
        given = {name.replace("-", "_"): value for name, value in _flat(values)}
        config = _with_parts(config, given, keywords)
        leaves = _leaves(config)
        names = {keyword(n): n for n in leaves} | {n: n for n in leaves}
        changes: dict[str, Any] = {}
        for name, value in given.items():
            if name in ("strategy", *PARTS, *VIEW_MODULES.names()):
                continue
            if name not in names:
                raise UsageError(_unknown(name if keywords else flag(name), config, keywords))
            path, hint = leaves[names[name]]
            inner = changes
            for part in path[:-1]:
                inner = inner.setdefault(part, {})
            inner[path[-1]] = _typed(value, hint, name)
        return _replaced(config, changes)
    except (UsageError, SchemaError) as e:
        raise UsageError(f"{place}: {e}") from e


def changed_settings(before: FitConfig, after: FitConfig) -> list[str]:
    """Return the names of the settings in which two configurations differ, in the form of flags."""
    old, new = (dict(_values(c)) for c in (before, after))
    return [flag(n) for n, value in new.items() if n not in old or old[n] != value]


def _values(config: FitConfig) -> Iterator[tuple[str, Any]]:
    yield "strategy", config.strategy
    for field in PARTS:
        yield field, [part.name for part in getattr(config, field)]
    for name, (path, _) in _leaves(config).items():
        value: Any = config
        for part in path:
            value = value[int(part)] if isinstance(value, tuple) else getattr(value, part)
        yield name, value


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield values by their dotted names."""
    for name, value in values.items():
        if not isinstance(name, str):
            raise UsageError(f"{name!r} is not a setting's name; write names as text")
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif dataclasses.is_dataclass(value) and not isinstance(value, (type, LossTerm, ViewModule)):
            yield from _flat({f.name: getattr(value, f.name) for f in dataclasses.fields(value)}, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def _with_parts(config: FitConfig, given: Mapping[str, Any], own_code: bool) -> FitConfig:
    """Return settings with the named strategy, loss terms and view modules, which have their default settings."""
    strategy = given.get("strategy")
    if strategy is not None and strategy != config.strategy:
        kind = _found(STRATEGIES, strategy, own_code)
        own = None if kind.Config is None else kind.Config()
        config = dataclasses.replace(config, strategy=STRATEGIES.name_of(kind), strategy_config=own)
    for field, registry in PARTS.items():
        if field in given:
            changes: dict[str, Any] = {field: parts_named(registry, field, given[field], own_code)}
            config = dataclasses.replace(config, **changes)
    for name in VIEW_MODULES.names():
        if name in given:
            of_type(bool)(given[name], name)
            others = tuple(m for m in config.view_modules if m.name != name)
            own = tuple(m for m in config.view_modules if m.name == name) or (VIEW_MODULES.find(name)(),)
            config = dataclasses.replace(config, view_modules=(*others, *own) if given[name] else others)
    return config


def parts_named(registry: Registry[Any], field: str, names: Any, own_code: bool) -> tuple[Any, ...]:
    """Return the given parts: objects unchanged, names as parts with default settings."""
    if isinstance(names, str):
        names = [n.strip() for n in names.split(",") if n.strip() not in ("", "none")]
    if not isinstance(names, (list, tuple)):
        raise UsageError(f"{field} must be names separated by commas, not {names!r}")
    return tuple(p if isinstance(p, registry.base) else _by_default(_found(registry, p, own_code), p) for p in names)


def _by_default(kind: type[Any], name: Any) -> Any:
    try:
        return kind()
    except TypeError as e:
        raise UsageError(f"{name} has a setting without a default ({e}); give every field a default") from e


def _found(registry: Registry[Any], name: Any, own_code: bool) -> type[Any]:
    if name == OLD_STRATEGY:
        raise UsageError(f"strategy {name} is now sampling, or paper, which samples by the paper's scores")
    if not isinstance(name, (str, type)):
        raise UsageError(f"{name!r} is not a {registry.kind}; give one of {', '.join(registry.names())}")
    return registry.load(name) if own_code and isinstance(name, str) else registry.find(name)


def _leaves(config: FitConfig) -> dict[str, tuple[Path, Any]]:
    """Return path and type hint of each setting by the name of its flag, with underscores."""
    found = dict(_below(FitConfig, "", ()))
    if config.strategy_config is not None:
        found |= _below(type(config.strategy_config), f"{flag_group(config.strategy)}.", ("strategy_config",))
    for field in PARTS:
        for i, part in enumerate(getattr(config, field)):
            found |= _below(type(part), f"{flag_group(part.name)}.", (field, str(i)))
    return found


def _below(kind: type, prefix: str, path: Path) -> Iterator[tuple[str, tuple[Path, Any]]]:
    hints = get_type_hints(kind)
    for f in dataclasses.fields(kind):
        hint, here = hints[f.name], (*path, f.name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            yield from _below(hint, prefix if f.name == WITHOUT_PREFIX else f"{prefix}{f.name}.", here)
        elif path or f.name not in OTHERS:
            yield prefix + f.name, (here, hint)


def _replaced(part: Any, changes: dict[str, Any]) -> Any:
    """Return a dataclass, or a tuple of dataclasses, with fields replaced; each is built once, with all its changes."""
    if isinstance(part, tuple):
        return tuple(_replaced(p, changes.get(str(i), {})) for i, p in enumerate(part))
    new = {n: _replaced(getattr(part, n), v) if isinstance(v, dict) else v for n, v in changes.items()}
    return dataclasses.replace(part, **new) if new else part


def _typed(value: Any, hint: Any, name: str) -> Any:
    """Return a value converted to the type of its field; SchemaError if the type does not match."""
    if name == "memory_limit" and isinstance(value, str) and value.lower() != "none":
        return parse_bytes(value)
    parts = get_args(hint)
    if get_origin(hint) in (Union, types.UnionType) and type(None) in parts:
        if value is None or (isinstance(value, str) and value.lower() == "none"):
            return None
        (hint,) = (p for p in parts if p is not type(None))
    if isinstance(value, numbers.Integral) and not isinstance(value, bool):
        value = int(value)
    elif isinstance(value, numbers.Real) and not isinstance(value, (bool, int)):
        value = float(value)
    if get_origin(hint) is tuple:
        of_type(hint)(list(value) if isinstance(value, tuple) else value, name)
        return tuple(_typed(v, get_args(hint)[0], name) for v in value)
    of_type(hint)(value, name)
    return float(value) if hint is float else value


def _unknown(name: str, config: FitConfig, keywords: bool) -> str:
    """Return the message on an unknown setting, with the most similar name in the user's spelling."""
    known = {keyword(n) if keywords else flag(n): n for n in setting_names(config)}
    groups = {n.partition(".")[0] for n in known.values() if "." in n}
    if note := removed_note(name):
        return note
    if name.replace("-", "_") in groups:
        return f"{name} is a group of settings; give a mapping such as {{{name}: {{...}}}}, or name one of its settings"
    last = [k for k, n in known.items() if n.rpartition(".")[2] == name.replace("-", "_")]  # `opacity` for `init.opacity`
    hint = f"did you mean {last[0]}?" if last else did_you_mean(name, known) or "`warpgs fit --help-all` lists all"
    return f"unknown setting {name[:60]!r}; {hint}"


# Settings that follow from the number of training views and their size: one rule from 3 photographs to 300, on any
# device.
#
# The constants were chosen by leaving training views out (docs/decisions/013-any-capture.md); docs/results.md lists
# exceptions.

MIN_STEPS, OPAQUE_STEPS, ALPHA_STEPS = 3000, 4500, 6000
"""Steps of a fit of up to `FEW` views: objects on black, opaque views, and views with an alpha channel
(docs/decisions/034-objects-on-black.md)."""
FEW, STEPS_POWER, MANY, MANY_POWER, MAX_STEPS = 4, 0.75, 12, 0.4, 30_000
"""Number of views above which steps exceed `MIN_STEPS`, and exponent of this growth; number of views above which they grow
more slowly, and exponent; and largest number of steps."""
SCALES_LR, SCALES_VIEWS, SCALES_POWER = 0.1, 8, 0.6
"""Learning rate of the log scales for up to `SCALES_VIEWS` views, and exponent with which it falls for more views."""
OPACITIES_LR, MAX_OPACITIES_LR = 0.0125, 0.05
"""Learning rate of the opacities for 3 views, which rises with the square root of the number of views; and its largest
value."""
HALF_RESOLUTION, HALF_VIEWS, LEAST_HALF = 0.5, 4, 0.2
"""Fraction of the steps at half size for up to `HALF_VIEWS` views; for more views it is inversely proportional to their
number, down to `LEAST_HALF` unless the time limit on a CPU shortens the fit (docs/decisions/013-any-capture.md)."""
DEGREES = (5, 9, 12)
"""Fewest training views for spherical harmonics of degree 1, 2 and 3. With fewer, colours do not depend on the view: four
photographs cannot distinguish a view-dependent colour from an error of the shape."""
OPACITIES_DECAY, ONE_LAYER_VIEWS = 0.001, 54
"""Fraction by which a step lowers every opacity, and the largest number of views with this decay and one layer. More views
were not measured: they have no decay, and two layers (docs/decisions/023-opacity-decay.md)."""
SMOOTH_STEPS, SMOOTH_WEIGHT, SMOOTH_VIEWS = 3000, 1.0, 4
"""Fewest planned steps of a fit with the roughness of rendered depth in its loss; the weight of this term for opaque
views; and the largest number of such views. The term does not help in 480 steps, and lowers PSNR with 9 opaque views
(docs/decisions/024-smooth-depth.md)."""
ALPHA_SMOOTH_WEIGHT, ALPHA_SMOOTH_VIEWS = 0.5, 8
"""Weight of the roughness for views with alpha, and the largest number of such views (docs/decisions/024-smooth-depth.md)."""
EXTRAPOLATED_VIEWS, EXTRAPOLATED_DECAY = 4, 0.0015
"""Largest number of opaque views for a start with extrapolated points, in fits of at least `SMOOTH_STEPS` steps; and the decay
of opacities with such points. Fits with more views or fewer steps were not measured
(docs/decisions/026-extrapolated-points.md)."""
AVERAGED_VIEWS = 20
"""Fewest training views without alpha channel that have the mean of the last steps. With 12 views the gain is at most 0.04 dB
(docs/decisions/029-mean-of-the-last-steps.md)."""
MIN_GAIN_DB = 0.1
"""Gain of held-out blocks below which growth ends [dB]. Nothing is held out if the time limit on a CPU shortens the fit: it is
too short to end earlier, and a measurement renders every view (docs/decisions/025-time-on-a-cpu.md); nor if views have half
size until growth ends. Blocks of objects on black are mostly empty, so none are held out."""
CPU_SECONDS = 3.0, 5.0, 1200.0
"""Default time limit of a fit on a CPU [s]: constant part, part for each view, and upper bound of the sum."""
CPU_TIMES = 0.002, 6.8e-8, 3.3e-7, 1.3e-8
"""Time of a step on two idle cores of 2.5 GHz: its constant part, for a pixel, for a Gaussian, and for each coefficient of the
harmonics of a Gaussian [s] (docs/decisions/025-time-on-a-cpu.md)."""
GAUSSIANS_SHARE = 0.75
"""Largest fraction of the mean step that Gaussians take where the time limit on a CPU shortens a fit."""
EVENT_TIMES = 0.2, 0.6, 0.8
"""Time of an event, in steps: for each view that is sampled, for each view that ranks Gaussians for eviction, and for each view
that shows which Gaussians to remove."""
GROWN, SATURATED = 25.0, 0.2
"""Gaussians that growth by gradients adds in a step, and their largest number for each pixel of all views while it adds to them
(docs/decisions/025-time-on-a-cpu.md). The printed time allows for them."""
WHOLE_FIT = 1.15
"""Printed time of all steps over the sum of `step_times`: ten captures took 0.98 to 1.37 times the sum
(docs/decisions/025-time-on-a-cpu.md)."""
FIRST_POINTS, FIRST_POWER, SWEPT_VIEWS = 2.4, 0.64, 30
"""Number of first points over that of the merged cells of one view, for one view; exponent of its growth with the number of
views; and number of views above which it does not grow."""
FIRST_LOOK = 0.1
"""Upper bound of the time limit on a CPU for each of ``max_steps`` [s]: half a minute for the 300 of preset `quick`."""
MEANS_LR, SH_LR, RATES_VIEWS, MAX_RATES, CPU_RATES = 1.6e-4, 2.5e-3, 9, 3.0, 2.5
"""Learning rates of the means and of the constant colour for up to `RATES_VIEWS` views. For more views, both rise in proportion
to their number, up to a factor of `MAX_RATES` (docs/decisions/013-any-capture.md); `CPU_RATES` is their factor where the time
limit on a CPU shortens the fit (docs/decisions/025-time-on-a-cpu.md)."""
GAIN_DB, NEARLY_ALL = "0.3 to 1.6 dB on five scenes of 3 to 43 views", 0.9
"""Gain of PSNR by all steps over those within the time limit of a CPU (docs/decisions/025-time-on-a-cpu.md); and the fraction
of the steps from which nothing of it is left."""


def steps_by_views(views: int, opaque: bool = True, cutout: bool = False) -> int:
    """Return the largest number of steps for a number of views: 4500 up to 4 opaque views, 5511 for 9, 12,481 for 54."""
    if opaque and views <= FEW:
        return OPAQUE_STEPS
    growth = max(1.0, min(views, MANY) / FEW) ** STEPS_POWER * max(1.0, views / MANY) ** MANY_POWER
    return min(MAX_STEPS, round((ALPHA_STEPS if cutout else MIN_STEPS) * growth))


def is_cutout(views: list[View]) -> bool:
    """Return whether views have an alpha channel, or masks that cut an object out; not if a black background was estimated."""
    return any(v.alpha is not None and not v.alpha_estimated for v in views)


def step_times(
    config: FitConfig, views: int, pixels: float, start: int, growing: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return the expected time of each step on two cores [s], and the expected number of Gaussians in it, shape [steps] each.

    There are ``start`` Gaussians at first; sampling events add more up to the limits, and gradients, too, if ``growing``.
    ``pixels`` are those of a view.
    """
    assert config.steps is not None and config.half_resolution is not None  # `settings_by_views` has chosen
    assert config.sh_degree is not None
    (constant, of_pixel, of_gaussian, of_coefficient), sampler = CPU_TIMES, config.method.sampler
    steps = np.arange(1, config.steps + 1)
    phases, samples = plan_phases(config.phases, config.steps), find_strategy(config.strategy).samples
    due = np.isin(steps, phases.events) & samples
    removed = np.isin(steps, list(removals(phases, views))) & samples
    wanted = start + sampler.fraction * pixels * min(views, MAX_VIEWS) * np.cumsum(due)
    most = max(start, min(config.max_gaussians, (1 + sampler.max_fraction) * start))
    counts = np.minimum(wanted, most)
    if growing:
        adding = samples & (steps > phases.refine) & (steps <= phases.stable_start)
        room = max(most, min(config.max_gaussians, SATURATED * views * pixels))
        counts = np.clip(counts + GROWN * np.cumsum(adding), counts, room)
    weighed = np.where(wanted > most, len(range(0, views, -(-views // MAX_WEIGHED))), 0)
    full = constant + of_pixel * pixels + (of_gaussian + of_coefficient * (config.sh_degree + 1) ** 2) * counts
    half = 0.75 * of_pixel * pixels * (steps <= config.half_resolution * config.steps)
    events_in_steps = due * (EVENT_TIMES[0] * min(views, MAX_VIEWS) + EVENT_TIMES[1] * weighed)
    events_in_steps += removed * (EVENT_TIMES[2] * views)
    return config.batch * (full - half) + events_in_steps * full, counts


def first_points(config: FitConfig, views: int, pixels: float) -> int:
    """Return the expected number of first points of a sweep; fewer are found on an object before an empty background."""
    return round(FIRST_POINTS * min(views, SWEPT_VIEWS) ** FIRST_POWER * pixels / max(1.0, config.init.merge_px) ** 2)


def limited_on_cpu(config: FitConfig, views: int, pixels: float) -> tuple[int, int, str]:
    """Return how many steps and Gaussians fit into the time limit on a CPU, and a sentence for the user, empty if all fit.

    ``pixels`` are those of a view.
    """
    assert config.steps is not None and config.half_resolution is not None and config.sh_degree is not None
    least, each, upper = CPU_SECONDS
    limit = min(least + each * views, upper, FIRST_LOOK * config.max_steps)
    start = first_points(config, views, pixels)

    def seconds(steps: int, most: int) -> float:
        fit = dataclasses.replace(config, steps=steps, max_gaussians=most)
        return float(step_times(fit, views, pixels, min(start, most))[0].sum())

    steps, most, all_steps = config.steps, config.max_gaussians, seconds(config.steps, config.max_gaussians)
    if all_steps > limit:
        constant, of_pixel, of_gaussian, of_coefficient = CPU_TIMES
        alike = constant + of_pixel * pixels * (1 - 0.75 * config.half_resolution)  # half the size is a quarter of the pixels
        alike /= of_gaussian + of_coefficient * (config.sh_degree + 1) ** 2
        share = 1000 * max(1, round(GAUSSIANS_SHARE / (1 - GAUSSIANS_SHARE) * alike / 1000))
        fewest = min(most, share) if share < (1 + config.method.sampler.max_fraction) * start else most
        steps = max(1, bisect_right(range(1, steps + 1), limit, key=lambda n: seconds(n, fewest)))
        every = 1000 * bisect_right(range(1000, most, 1000), limit, key=lambda n: seconds(steps, n))
        most = max(fewest, every) if steps == config.steps else fewest
    if (steps, most) == (config.steps, config.max_gaussians):
        return steps, most, ""
    limits = [f"takes {steps:,} of {config.steps:,} steps"] * (steps < config.steps)
    limits += [f"has at most {most:,} Gaussians"] * (most < config.max_gaussians)
    whole = float(step_times(config, views, pixels, start, growing=True)[0].sum())
    return steps, most, (
        f"to save time on a CPU, the fit {' and '.join(limits)}; --no-cpu-limit lifts this, takes about "
        f"{max(1, round(whole / 60))} min" + f", and raised PSNR by {GAIN_DB}" * (steps < NEARLY_ALL * config.steps)
    )  # fmt: skip


def settings_by_views(config: FitConfig, train: list[View], device: str) -> tuple[FitConfig, list[str]]:
    """Return the settings with all automatic ones (None) chosen, and sentences on the choices.

    On a ``device`` of kind cpu the steps are limited to a time, unless ``cpu_limit`` is off.
    """

    def given(value: Any, other: Any) -> Any:
        return other if value is None else value

    views, opaque, cutout = len(train), all(v.alpha is None for v in train), is_cutout(train)
    one_layer = views <= ONE_LAYER_VIEWS
    hier = given(config.method.hier, not one_layer)
    degree = given(config.sh_degree, sum(views >= n for n in DEGREES))
    half = given(config.half_resolution, float(f"{HALF_RESOLUTION * min(1.0, HALF_VIEWS / views):.2g}"))
    wanted = given(config.steps, min(steps_by_views(views, opaque, cutout), config.max_steps))
    limit, sh_every, most, steps = "", config.sh_every, config.max_gaussians, wanted
    if config.steps is None and config.cpu_limit and device == "cpu":
        pixels = max(v.camera.width * v.camera.height for v in train)
        method = dataclasses.replace(config.method, hier=hier)
        asked = dataclasses.replace(config, steps=wanted, half_resolution=half, sh_degree=degree, method=method)
        steps, most, limit = limited_on_cpu(asked, views, pixels)
    limited = steps < wanted
    half = half if limited else given(config.half_resolution, max(LEAST_HALF, half))
    phases = plan_phases(config.phases, steps)
    black = any(v.alpha_estimated for v in train)
    whole = limited or black or half * steps >= phases.stable_start  # a fit that nothing can end early holds nothing out
    init, stopping = config.init, config.stopping
    if init.extrapolate is None:
        init = dataclasses.replace(init, extrapolate=opaque and views <= EXTRAPOLATED_VIEWS and steps >= SMOOTH_STEPS)
        init = dataclasses.replace(init, extrapolate=extrapolates(init, train))
    decay = EXTRAPOLATED_DECAY if extrapolates(init, train) else OPACITIES_DECAY
    factor = CPU_RATES if limited and views > RATES_VIEWS else min(MAX_RATES, max(1.0, views / RATES_VIEWS))
    rates = {
        "scales_lr": SCALES_LR * min(1.0, SCALES_VIEWS / views) ** SCALES_POWER,
        "opacities_lr": min(MAX_OPACITIES_LR, OPACITIES_LR * math.sqrt(views / 3)),
        "means_lr": factor * MEANS_LR, "sh_lr": factor * SH_LR, "opacities_decay": decay if one_layer else 0.0,
        "average_last": AVERAGE_LAST if cutout or views >= AVERAGED_VIEWS else 0.0,
    }  # fmt: skip
    rates = {n: given(getattr(config.optimizer, n), float(f"{v:.3g}")) for n, v in rates.items()}
    if whole and degree and stopping.min_gain_db is None:
        # as with held-out blocks, all degrees are in use when growth begins
        sh_every = min(sh_every, max(1, phases.refine // degree))
    smooth, few = (SMOOTH_WEIGHT, SMOOTH_VIEWS) if opaque else (ALPHA_SMOOTH_WEIGHT, ALPHA_SMOOTH_VIEWS)
    smooth = given(config.loss.smooth_weight, smooth if views <= few and steps >= SMOOTH_STEPS else 0.0)
    made = dataclasses.replace(
        config, steps=steps, max_gaussians=most, sh_degree=degree, sh_every=sh_every, half_resolution=half, init=init,
        optimizer=dataclasses.replace(config.optimizer, **rates), method=dataclasses.replace(config.method, hier=hier),
        loss=dataclasses.replace(config.loss, smooth_weight=smooth),
        stopping=dataclasses.replace(stopping, min_gain_db=given(stopping.min_gain_db, 0.0 if whole else MIN_GAIN_DB)),
    )  # fmt: skip
    before = dict(_values(config))
    words = [f"{flag(n)} {value}" for n, value in _values(made) if value is not None and before[n] is None]
    named = Detail(f"settings for {views} views: {', '.join(words)}") if words else ""
    return made, [note for note in (named, limit) if note]


PIXELS_PER_GAUSSIAN = 4
"""Ratio of pixels to Gaussians in the probe's render, about the mean over a fit of preset `quick`."""
REPEATS = 5
"""Timed renders of a probe, after a first render that compiles and loads kernels."""
STEP, SETUP = 1.6, 11.0
"""Mean time of a step of a fit, and set-up time for each training view, in units of a probe's time (`probe_seconds`). Measured
on a CPU on fern with preset `quick`: 1.54 and 11.2 at 126 x 94 px, 1.56 and 10.8 at 168 x 126 px. On CUDA, where
steps are captured but probes are not, a step takes less, so the prediction is an upper limit."""
MIN_TIMED_STEPS = 100
"""Fewest steps that are chosen: fewer give no usable scene. `steps_by_views` gives the upper limit."""


def probe_seconds(width: int, height: int, device: torch.device) -> float:
    """Measure the time of a render, its loss and gradients on this machine, for a fixed set of Gaussians [s].

    Returns the median of `REPEATS`; takes some hundred milliseconds.
    """
    count = max(1, width * height // PIXELS_PER_GAUSSIAN)
    real, generator = {"dtype": torch.float32, "device": "cpu"}, torch.Generator().manual_seed(0)
    rand, randn = (functools.partial(f, generator=generator, **real) for f in (torch.rand, torch.randn))
    depth = 2 + 4 * rand(count, 1)
    means = torch.cat([(rand(count, 2) - 0.5) * depth * torch.tensor([1.0, height / width], **real), depth], 1)
    log_scales = torch.log(depth / width * (1 + 2 * rand(count, 3)))
    tensors = means, randn(count, 4), log_scales, randn(count), 0.3 * randn(count, 4, 3)
    gaussians = Gaussians(*(t.to(device).requires_grad_() for t in tensors))
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]], **real)
    camera = Camera(torch.eye(4, **real).to(device), K.to(device), width, height)
    target = rand(height, width, 3).to(device)
    seconds = []
    for _ in range(REPEATS + 1):
        began = time.perf_counter()
        loss = photometric_loss(rasterize(gaussians, camera).rgb, target, None, SSIM_WEIGHT)
        torch.autograd.grad(loss, list(gaussians.tensors().values()))
        loss.item()  # waits for the gradients of the render before
        seconds.append(time.perf_counter() - began)
    return statistics.median(seconds[1:])


def within_budget(config: FitConfig, seconds: float, views: list[View], device: torch.device) -> tuple[FitConfig, str]:
    """Return settings with the largest number of steps predicted to fit into a time [s], set-up included, and a note on it."""
    check_budget(seconds)
    largest = max((v.camera for v in views), key=lambda c: c.width * c.height)
    probe = probe_seconds(largest.width, largest.height, device)
    setup, step = probe * SETUP * len(views), probe * STEP * config.batch
    most = steps_by_views(len(views), all(v.alpha is None for v in views), is_cutout(views))
    steps = min(int((seconds - setup) / step), most)
    if steps < MIN_TIMED_STEPS:
        raise UsageError(
            f"time-budget {seconds:g} s is too short: {MIN_TIMED_STEPS} steps would take {setup + MIN_TIMED_STEPS * step:.0f} "
            f"s here ({1000 * probe:.0f} ms for an image with gradients); give more time, or --downscale"
        )
    return dataclasses.replace(config, steps=steps), (
        f"time-budget {seconds:g} s: chose --steps {steps} for preset {config.preset}, predicted to take "
        f"{setup + steps * step:.0f} s ({1000 * probe:.0f} ms for an image with gradients)"
        + (f"; {len(views)} views need no more steps" if steps == most else "")
        + "; poses, start, scores and report take additional time"
    )


def check_budget(seconds: float) -> None:
    """Check that a time budget [s] is a positive, finite number."""
    if not 0 < seconds < float("inf"):
        raise UsageError(f"time-budget must be a positive number of seconds, not {seconds}")
