"""`warpgs fit`: flags, one call, lines; no logic."""

import dataclasses
import inspect
import itertools
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro  # noqa: TID253 - only a command imports this file

from warpgs.app import flags
from warpgs.clock import Clock, section, since_start, timed
from warpgs.device import parse_bytes
from warpgs.errors import UsageError
from warpgs.io.folder import READERS
from warpgs.io.maps import NONE
from warpgs.kernels.cameras import CAMERA_MODELS
from warpgs.kernels.launch import set_threads
from warpgs.pipeline.run.request import FitRequest, SceneRequest
from warpgs.pipeline.train.loss import LOSS_TERMS
from warpgs.pipeline.train.presets import PRESETS, origin_note, preset_settings
from warpgs.pipeline.train.settings import FitConfig, check_budget, parts_named
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.pipeline.train.view_modules import VIEW_MODULES
from warpgs.plugins import Registry, flag_group
from warpgs.process import be_quiet, fast_imports, say
from warpgs.ranks import join, place
from warpgs.schema import Checked


def scene_flags(*, positional: bool) -> tuple[type, Any]:
    """Return the dataclass of the flags, and their defaults."""
    shown = (tyro.conf.Positional, tyro.conf.arg(metavar="SCENE")) if positional else (tyro.conf.Fixed, tyro.conf.Suppress)
    return flags.flags_of(SceneRequest, SceneRequest(tyro.MISSING if positional else ""), {"path": shown})


def scene_of(a: Any, path: str) -> SceneRequest:
    """Return the request for a scene folder from parsed flags; a user-defined reader is loaded."""
    asked = flags.settings_of(SceneRequest, a)
    if asked.downscale is not None and not 1 <= asked.downscale < 2**31:
        raise UsageError(f"--downscale must be at least 1, and below 2^31, not {asked.downscale}")
    if asked.reader is not None:
        READERS.load(asked.reader)
    named = {n: getattr(asked, n) for n in ("score_masks", "matcher", "depths", "normals")}
    found = {n: p if p is None or (p == NONE and n in ("depths", "normals")) else os.path.realpath(p) for n, p in named.items()}
    return dataclasses.replace(asked, path=path, **found)


# `warpgs fit`: flags derived from `FitConfig`: names, defaults and help texts are those of its fields.
#
# Defaults depend on the preset; a strategy and loss terms have their own settings. So the flags that determine other
# flags are looked up first. Parses, calls, prints; no logic.

CONTINUING = {"--out": 1, "--resume": 0, "--device": 1, "--threads": 1, "--view": 0, "--view-port": 1, "--lpips-weights": 1}
"""Flags that may accompany --resume when a run keeps its settings, and the number of values of each."""


@dataclass(frozen=True, kw_only=True)
class Request(Checked, group="--"):
    """Flags that are not settings of a fit: its input, output and machine."""

    out: Path
    """Run folder to fill; new or empty."""
    device: str = "auto"
    """auto, cpu or cuda."""
    threads: flags.Threads = 0
    """CPU threads; 0 for as many as there are cores."""
    resume: bool = False
    """Continue the run in --out from its last checkpoint; `warpgs fit --out RUN --resume` takes the scene, the device and
    all settings from the run."""
    lpips_weights: Path | None = None
    """File of `warpgs convert-lpips`; without it LPIPS is not measured."""
    time_budget: float | None = None
    """Choose the number of steps so that set-up and steps take about this time [s]; not if --steps or --resume is given."""
    view: bool = False
    """Show the model in a browser while it trains, at the printed address; this changes no byte of the result."""
    view_port: flags.Port = 8080
    """Port of --view; 0 for any free one."""


Parts = dict[str, Any]
"""Loss terms or view modules by the name of their flags."""


def _parts(registry: Registry[Any], flag: str, arguments: list[str], base: tuple[Any, ...]) -> Parts:
    """Return the parts of a registry that a flag names, with default settings; ``base`` if the flag is not given."""
    given, parts = flags.word_after(arguments, flag), Parts()
    for part in base if given is None else parts_named(registry, flag, given, True):
        if (group := flag_group(part.name)) in parts:
            raise UsageError(f"{flag} {given}: two of these names define the flags --{group}; leave one out")
        parts[group] = part
    return parts


def _view_modules(arguments: list[str], base: FitConfig) -> Parts:
    """Return the view modules that a command line names; built-in modules also have a flag each."""
    modules = _parts(VIEW_MODULES, "--view-modules", arguments, base.view_modules)
    for name in VIEW_MODULES.names():
        flag = name.replace("_", "-")
        words = [w for w in (a.replace("_", "-") for a in arguments) if w in (f"--{flag}", f"--no-{flag}")]
        if words and words[-1] == f"--{flag}":
            modules.setdefault(name, VIEW_MODULES.find(name)())
        elif words:
            modules.pop(name, None)
    return modules


def _preset(arguments: list[str]) -> tuple[FitConfig, str]:
    """Return the settings that the flags start from, and a description of their source."""
    base, origin = preset_settings(flags.word_after(arguments, "--preset"))
    strategy = flags.word_after(arguments, "--strategy")
    if strategy is None or strategy == base.strategy:
        return base, origin
    own = STRATEGIES.load(strategy).Config
    return dataclasses.replace(base, strategy=strategy, strategy_config=None if own is None else own()), origin


def _choices() -> str:
    """Return the names that can be chosen, as text for the user."""
    kinds: dict[str, Any] = {
        "presets": PRESETS, "strategies": STRATEGIES, "loss terms": LOSS_TERMS, "readers": READERS,
        "camera models": CAMERA_MODELS, "view modules": VIEW_MODULES,
    }  # fmt: skip
    return "\n\n".join(flags.listed(title, kind.described()) for title, kind in kinds.items())


def _names(parts: Parts) -> Any:
    """Return the rule of a flag that names parts of a registry; their settings are flags of their own."""
    return flags.read_by("NAME,...", lambda _: tuple(parts.values()), tuple, lambda v: ",".join(t.name for t in v) or "none")


def _flags(base: FitConfig, terms: Parts, modules: Parts) -> type:
    """Return the dataclass of all flags: the request, ``base``, the settings of strategy, loss terms and view modules."""
    size = flags.read_by("SIZE", parse_bytes, int, lambda v: "none" if v is None else f"{v}B")
    special = {
        "memory_limit": (size,), "loss_terms": (_names(terms),), "view_modules": (_names(modules),),
        "priors": (tyro.conf.OmitArgPrefixes,), "strategy_config": (tyro.conf.Fixed, tyro.conf.Suppress),
    }  # fmt: skip
    chosen = dataclasses.replace(base, loss_terms=tuple(terms.values()), view_modules=tuple(modules.values()))
    kind, default = flags.flags_of(FitConfig, chosen, special)
    fields: list[tuple[str, Any, Any]] = [("config", Annotated[kind, tyro.conf.arg(name="")], field(default=default))]
    own = {} if base.strategy_config is None else {flag_group(base.strategy): base.strategy_config}
    reading, unread = scene_flags(positional=True)
    fields.append(("reading", Annotated[reading, tyro.conf.arg(name="")], field(default=unread)))
    taken = {f.name for kind in (FitConfig, SceneRequest, Request) for f in dataclasses.fields(kind)} | {"config", "reading"}
    for name, settings in [*own.items(), *terms.items(), *modules.items()]:
        if name in taken:
            raise UsageError(f"the plug-in name {name} is taken by a flag of warpgs; rename the plug-in")
        taken.add(name)
        group, default = flags.flags_of(type(settings), settings)
        fields.append((f"{name}_settings", Annotated[group, tyro.conf.arg(name=name)], field(default=default)))
    for name in VIEW_MODULES.names():
        about = (inspect.getdoc(VIEW_MODULES.find(name)) or "").partition("\n\n")[0]
        fields.append((name, Annotated[bool, tyro.conf.arg(help=about)], field(default=name in modules)))
    return dataclasses.make_dataclass("Fit", fields, bases=(Request,), frozen=True, kw_only=True)


def _config(a: Any, base: FitConfig, terms: Parts, modules: Parts) -> FitConfig:
    """Return the settings of parsed flags."""

    def settings(name: str, part: Any) -> Any:
        return flags.settings_of(type(part), getattr(a, f"{name}_settings"))

    config, own = flags.settings_of(FitConfig, a.config), base.strategy_config
    if own is not None:
        config = dataclasses.replace(config, strategy_config=settings(flag_group(base.strategy), own))
    found, learned = (tuple(settings(n, p) for n, p in parts.items()) for parts in (terms, modules))
    return dataclasses.replace(config, loss_terms=found, view_modules=learned)


def _continuing(arguments: list[str]) -> tuple[list[str], list[str]] | None:
    """Return flags and scene of arguments that continue a run without giving its settings; None for others."""
    words = iter([w for a in arguments for w in (a.split("=", 1) if a.startswith("--") else [a])])
    kept, scene = list[str](), list[str]()
    for word in words:
        if word in CONTINUING:
            kept += [word, *itertools.islice(words, CONTINUING[word])]
        elif word.startswith("-") or scene:
            return None
        else:
            scene.append(word)
    # beside a scene, --out may hold only the poses of a fit that ended before its first step
    begun = not scene or os.path.isfile(os.path.join(flags.word_after(kept, "--out") or "", "config.json"))
    return (kept, scene) if "--resume" in kept and begun else None


def _continued(arguments: list[str], scene: list[str], about: str) -> FitRequest:
    """Return the request that continues a run with its original settings."""
    from warpgs.pipeline.run.folder import stored_request

    a = flags.parse_flags(Request, arguments, "warpgs fit", about)
    view_port = _machine(a)
    request = stored_request(a.out, scene[0] if scene else None)
    say(f"continuing the run: preset {request.config.preset}, {request.config.steps:,} steps, {request.scene.path}")
    device = request.device if flags.word_after(arguments, "--device") is None else a.device
    return dataclasses.replace(request, device=device, view_port=view_port, lpips_weights=a.lpips_weights)


def _machine(a: Any) -> int | None:
    """Set the number of threads; return the port of the viewer, None for no viewer."""
    if a.threads:
        set_threads(a.threads)
    return a.view_port if a.view else None


def request_of(arguments: list[str], about: str) -> FitRequest:
    """Return the request for the arguments of a command line."""
    if (run := _continuing(arguments)) is not None:
        return _continued(*run, about)
    base, origin = _preset(arguments)
    parts = _parts(LOSS_TERMS, "--loss-terms", arguments, base.loss_terms), _view_modules(arguments, base)
    a: Any = flags.parse_flags(_flags(base, *parts), arguments, "warpgs fit", f"{about}\n\n{_choices()}")
    scene = scene_of(a.reading, a.reading.path)
    view_port = _machine(a)
    config = dataclasses.replace(_config(a, base, *parts), preset=base.preset)
    if config.steps is not None and config.steps >= 2**31:
        raise UsageError(f"--steps must be below 2^31, not {config.steps}")
    if a.time_budget is not None:
        if a.resume or flags.word_after(arguments, "--steps"):
            raise UsageError("--time-budget chooses the steps; leave out --steps. To continue, give only --out RUN --resume")
        check_budget(a.time_budget)
    notes = (origin_note(origin, base, config),)
    return FitRequest(scene, a.out, config, a.device, a.resume, a.lpips_weights, a.time_budget, notes, view_port)


def tell_preset(arguments: list[str], config: FitConfig) -> None:
    """Say which preset is used where the arguments name none."""
    if flags.word_after(arguments, "--preset") is None:
        say(f"preset {config.preset}: {PRESETS.described()[config.preset]}")


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    if place()[0] > 0:
        be_quiet()
    with timed(Clock(since_start())):
        with section("import"):
            request = request_of(arguments, about)
            if not request.resume:
                tell_preset(arguments, request.config)
            with fast_imports():
                from warpgs.pipeline.run.fit import fit_request
        ranks = join(request.device)
        if request.view_port is None or not ranks.first:
            fit_request(request, ranks=ranks)
            return 0
        from warpgs.viewer.watch import live_view

        with live_view(request.out, request.view_port) as live:
            fit_request(request, on_model=live.look, ranks=ranks)
    return 0
