"""`warpgs fit`: flags derived from `FitConfig`: names, defaults and help texts are those of its fields.

Defaults depend on the preset; a strategy and loss terms bring settings of their own. So the few flags that decide which others
there are, are looked up first. Parses, calls, prints; no logic.
"""

import dataclasses
import os
import re
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from warpgs.app.flags import MAX_THREADS, check_range, flags_of, parse_flags, settings_of, word_after
from warpgs.errors import UsageError, WarpgsError
from warpgs.io.decoding import MAX_PIXELS
from warpgs.io.readers import READERS
from warpgs.pipeline.runs.request import FitRequest, SceneRequest
from warpgs.pipeline.train.config import DEFAULT_PRESET, PRESET_NOTES, PRESETS, FitConfig
from warpgs.pipeline.train.loss import LOSS_TERMS
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.pipeline.train.time_budget import check_budget
from warpgs.plugins import Registry
from warpgs.render.rule_costs import select_rule
from warpgs.runtime.byte_units import parse_bytes
from warpgs.runtime.imports import fast_imports
from warpgs.runtime.interop import set_threads
from warpgs.runtime.ranks import join, place
from warpgs.runtime.terminal import be_quiet, say

CONTINUING = {"--out": 1, "--resume": 0, "--device": 1, "--threads": 1, "--view": 0, "--view-port": 1, "--lpips-weights": 1}
"""Flags that go with --resume where all else is as the run was started, and how many values each has."""


def _request_type() -> type:
    """Return the dataclass of the flags that are no settings of a fit: its input, output and machine."""
    import tyro

    @dataclass(frozen=True, kw_only=True)
    class Request:
        scene: tyro.conf.Positional[Path]
        """Scene folder: COLMAP, transforms.json, LLFF, DTU or Middlebury; or photographs or a video without cameras."""
        out: Path
        """Run folder to fill; must not exist yet."""
        split: str | None = None
        """Views to hold out for scores: llff:K, mip360:K, dtu:3|6|9, blender:8, every:N, all (trains on all, as without this
        flag), or train=NAMES;test=NAMES."""
        downscale: int | None = None
        """Factor by which both image sides shrink; with it, images keep what it leaves of them."""
        max_side: int | None = None
        """Longest side that an image keeps [px], 0 for no limit; without this and --downscale 1600, or 800 on a CPU."""
        reader: str | None = None
        """Name of the scene's format, or a reader of your own: module:Class or path/to/file.py:Class."""
        device: str = "auto"
        """auto, cpu or cuda."""
        threads: int = 0
        """CPU threads; 0 for as many as there are cores."""
        resume: bool = False
        """Continue the run in --out from its last checkpoint; `warpgs fit --out RUN --resume` takes all else but
        --lpips-weights from the run."""
        strict: bool = False
        """A frame without an image file is an error."""
        allow_outside: bool = False
        """Let names and links of the scene lead to images and masks outside its folder."""
        masks: str = "ignore"
        """Fate of pixels that a mask file does not keep: ignore (they do not count) or cutout (they are transparent)."""
        mask_keeps: str = "white"
        """Colour of a mask file that keeps a pixel: white or black."""
        black_is_empty: bool = True
        """Dark pixels around an object are transparent, where every image shows one on black."""
        max_pixels: int = MAX_PIXELS
        """Largest number of pixels that an image or a mask may have as stored."""
        score_masks: Path | None = None
        """Folder of object masks for scoring, matched by image id; the scene's idrmasks where not given."""
        lpips_weights: Path | None = None
        """File of `warpgs convert-lpips`; without it LPIPS is not measured."""
        max_error: float | None = None
        """Choose the fastest rule whose images are off exact by at most this on average, in [0, 1]; not with --rule."""
        time_budget: float | None = None
        """Choose the number of steps so that the fit is done in this time [s]; not with --steps or --max-error."""
        view: bool = False
        """Show the model in a browser while it trains, at the printed address; the result is the same to the byte."""
        view_port: int = 8080
        """PORT of --view; 0 for any free one."""

    return Request


def _load(registry: Registry[Any], name: str) -> type[Any]:
    """Return the class of a plug-in, importing code of the user's own where it is named by module or file.

    Raises:
        UsageError: There is no such class, or its code does not run; the message names the line.
    """
    try:
        return registry.load(name)
    except WarpgsError:
        raise
    except Exception as e:  # whatever a user's module raises
        last = traceback.extract_tb(e.__traceback__)[-1]
        where = f"{e.filename}, line {e.lineno}" if isinstance(e, SyntaxError) else f"{last.filename}, line {last.lineno}"
        raise UsageError(
            f"the {registry.kind} {name!r} cannot be loaded: {type(e).__name__}: {e} ({where}); fix that code, or leave it out"
        ) from e


def _group(name: str) -> str:
    """Return the name of the flags of a plug-in's own settings: ``my.module:MyStrategy`` has the group ``my_strategy``."""
    word = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.rpartition(":")[2])
    return re.sub(r"\W", "_", word).lower()


def _terms(arguments: list[str], base: FitConfig) -> dict[str, Any]:
    """Return the loss terms that a command line names, with default settings, by the name of their flags."""
    given = word_after(arguments, "--loss-terms")
    if given is None:
        return {_group(t.name): t for t in base.loss_terms}
    terms: dict[str, Any] = {}
    for name in filter(None, (n.strip() for n in ("" if given == "none" else given).split(","))):
        if _group(name) in terms:
            raise UsageError(f"--loss-terms {given}: two terms have the flags --{_group(name)}; leave one out")
        kind = _load(LOSS_TERMS, name)
        try:
            terms[_group(name)] = kind()
        except TypeError as e:
            raise UsageError(f"the loss term {name!r} has a setting without a default ({e}); give every field one") from e
    return terms


def _preset(arguments: list[str]) -> FitConfig:
    """Return the settings that the flags start from."""
    name = word_after(arguments, "--preset") or DEFAULT_PRESET
    if name not in PRESETS:
        raise UsageError(f"preset {name!r} is not one of {', '.join(PRESETS)}")
    base = PRESETS[name]
    strategy = word_after(arguments, "--strategy")
    if strategy is None or strategy == base.strategy:
        return base
    own = _load(STRATEGIES, strategy).Config
    return dataclasses.replace(base, strategy=strategy, strategy_config=None if own is None else own())


def _presets() -> str:
    """Return the presets and what they are, for people."""
    return "presets:\n" + "\n".join(f"  {name}: {note}" for name, note in PRESET_NOTES.items())


def _size() -> Any:
    """Return the specification of a flag for a size in bytes, such as 2GiB."""
    import tyro

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1, metavar="SIZE", instance_from_str=lambda words: parse_bytes(words[0]),
        is_instance=lambda value: value is None or isinstance(value, int),
        str_from_instance=lambda value: ["none" if value is None else f"{value}B"],
    )  # fmt: skip


def _names(terms: dict[str, Any]) -> Any:
    """Return the specification of the flag that names loss terms; their settings are flags of their own."""
    import tyro

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1, metavar="NAME,...", instance_from_str=lambda words: tuple(terms.values()),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [",".join(t.name for t in value) or "none"],
    )  # fmt: skip


def _flags(base: FitConfig, terms: dict[str, Any]) -> type:
    """Return the dataclass of all flags: the request, the settings ``base``, and those of the strategy and of loss terms."""
    import tyro

    special = {
        "memory_limit": (_size(),), "loss_terms": (_names(terms),), "priors": (tyro.conf.OmitArgPrefixes,),
        "strategy_config": (tyro.conf.Fixed, tyro.conf.Suppress),
    }  # fmt: skip
    kind, default = flags_of(FitConfig, dataclasses.replace(base, loss_terms=tuple(terms.values())), special)
    fields: list[tuple[str, Any, Any]] = [("config", Annotated[kind, tyro.conf.arg(name="")], field(default=default))]
    own = {} if base.strategy_config is None else {_group(base.strategy): base.strategy_config}
    taken = {f.name for kind in (FitConfig, _request_type()) for f in dataclasses.fields(kind)} | {"config"}
    for name, settings in [*own.items(), *terms.items()]:
        if name in taken:
            raise UsageError(f"a plug-in has the name {name}, whose flags --{name} there are already; call it something else")
        taken.add(name)
        group, default = flags_of(type(settings), settings)
        fields.append((name, group, field(default=default)))
    return dataclasses.make_dataclass("Fit", fields, bases=(_request_type(),), frozen=True, kw_only=True)


def _config(a: Any, base: FitConfig, terms: dict[str, Any]) -> FitConfig:
    """Return the settings that parsed flags stand for."""
    config, own = settings_of(FitConfig, a.config), base.strategy_config
    if own is not None:
        config = dataclasses.replace(config, strategy_config=settings_of(type(own), getattr(a, _group(base.strategy))))
    return dataclasses.replace(config, loss_terms=tuple(settings_of(type(t), getattr(a, n)) for n, t in terms.items()))


def _chosen(a: Any, arguments: list[str], config: FitConfig) -> tuple[FitConfig, tuple[str, ...]]:
    """Let measured costs choose settings where the user asked for it; returns the settings and notes on the choice."""
    if a.max_error is not None and a.time_budget is not None:
        raise UsageError("--max-error and --time-budget choose settings by different costs: give one of them")
    if a.time_budget is not None:
        if a.resume or word_after(arguments, "--steps"):
            raise UsageError(
                "--time-budget chooses the number of steps: leave out --steps, and to continue such a run give --resume with "
                "the --steps that it chose instead of --time-budget"
            )
        check_budget(a.time_budget)
    if a.max_error is None:
        return config, ()
    if word_after(arguments, "--rule"):
        raise UsageError("--max-error chooses the rule: leave out --rule")
    rule, note = select_rule(max_error=a.max_error)
    return dataclasses.replace(config, rule=rule), (note,)


def _names_a_run_alone(arguments: list[str]) -> bool:
    """Return whether words ask to continue a run, and give nothing that it was started with."""
    words = [w for a in arguments for w in a.split("=", 1)]
    while words:
        if words[0] not in CONTINUING:
            return False
        words = words[1 + CONTINUING[words[0]] :]
    return "--resume" in arguments


def _continued(arguments: list[str], about: str) -> FitRequest:
    """Return the request that continues a run as it was started."""
    from warpgs.pipeline.runs.folder import stored_request

    @dataclass(frozen=True, kw_only=True)
    class Continue:
        out: Path
        """Run folder."""
        resume: bool = False
        """Continue it."""
        device: str | None = None
        """That of the run where not given."""
        threads: int = 0
        """CPU threads; 0 for as many as there are cores."""
        view: bool = False
        """Show the model in a browser while it trains."""
        view_port: int = 8080
        """Port of --view; 0 for any free one."""
        lpips_weights: Path | None = None
        """File of `warpgs convert-lpips`; a run does not remember it, and without it LPIPS is not measured."""

    a = parse_flags(Continue, arguments, "warpgs fit", about)
    check_range("--threads", a.threads, 0, MAX_THREADS)
    check_range("--view-port", a.view_port, 0, 65535)
    if a.threads:
        set_threads(a.threads)
    request = stored_request(a.out)
    say(f"continued as it was started: preset {request.config.preset}, {request.config.steps:,} steps, {request.scene.path}")
    device, view_port = a.device or request.device, a.view_port if a.view else None
    return dataclasses.replace(request, device=device, view_port=view_port, lpips_weights=a.lpips_weights)


def request_of(arguments: list[str], about: str) -> FitRequest:
    """Return the request that the words of a command line make.

    Raises:
        UsageError: A flag is wrong, or a plug-in cannot be loaded.
    """
    if _names_a_run_alone(arguments):
        return _continued(arguments, about)
    arguments = ["--help" if word == "--help-all" else word for word in arguments]  # tyro has one help, that of all flags
    base = _preset(arguments)
    terms = _terms(arguments, base)
    a: Any = parse_flags(_flags(base, terms), arguments, "warpgs fit", f"{about}\n\n{_presets()}")
    if a.reader is not None:
        _load(READERS, a.reader)
    check_range("--threads", a.threads, 0, MAX_THREADS)
    check_range("--view-port", a.view_port, 0, 65535)
    if a.threads:
        set_threads(a.threads)
    config, notes = _chosen(a, arguments, _config(a, base, terms))
    if word_after(arguments, "--preset") is None:
        say(f"preset {base.preset}: {PRESET_NOTES[base.preset]}")
    masks = None if a.score_masks is None else os.path.realpath(a.score_masks)
    scene = SceneRequest(
        str(a.scene), a.split, a.downscale, a.strict, a.allow_outside, a.masks, a.mask_keeps, a.black_is_empty, masks, a.reader,
        a.max_pixels, a.max_side,
    )  # fmt: skip
    view_port = a.view_port if a.view else None
    return FitRequest(scene, a.out, config, a.device, a.resume, a.lpips_weights, a.time_budget, notes, view_port)


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` heads its help."""
    if place()[0] > 0:
        be_quiet()
    request = request_of(arguments, about)
    with fast_imports():
        from warpgs.pipeline.runs.fit import fit_request
    ranks = join(request.device)
    if request.view_port is None or not ranks.first:
        fit_request(request, ranks=ranks)
        return 0
    from warpgs.viewer.watch import live_view

    with live_view(request.out, request.view_port) as live:
        fit_request(request, on_model=live.look, ranks=ranks)
    return 0
