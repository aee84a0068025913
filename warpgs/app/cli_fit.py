"""Flags of `warpgs fit`, derived from `FitConfig`: names, defaults and help texts are those of its fields.

Defaults depend on the preset, and the preset on the device; a strategy and loss terms bring settings of their own. So the few
flags that decide which others there are, are looked up first. This module parses and prints; it holds no logic of a fit.
"""

import ast
import dataclasses
import inspect
import itertools
import textwrap
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

from warpgs.errors import UsageError
from warpgs.pipeline.runs.request import FitRequest, SceneRequest, choose_device
from warpgs.pipeline.train.config import DEFAULT_PRESET, PRESETS, FitConfig
from warpgs.pipeline.train.time_budget import check_budget
from warpgs.render.rule_costs import select_rule
from warpgs.runtime.byte_units import parse_bytes
from warpgs.runtime.interop import set_threads

Settings = TypeVar("Settings")
BYTES = ("memory_limit",)
"""Fields of FitConfig in bytes, which people write with a unit."""
UNPREFIXED = ("priors",)
"""Groups of FitConfig whose flags need no prefix."""


def _word(arguments: list[str], flag: str) -> str | None:
    """Return the word after a flag that must be known before the others can be described; None where it is not given."""
    for i, word in enumerate(arguments):
        if word == flag and i + 1 < len(arguments):
            return arguments[i + 1]
        if word.startswith(f"{flag}="):
            return word.removeprefix(f"{flag}=")
    return None


def _request_type() -> type:
    """Return the dataclass of the flags that are no settings of a fit: its input, output and machine."""
    import tyro

    @dataclass(frozen=True, kw_only=True)
    class Request:
        scene: tyro.conf.Positional[Path]
        """Scene folder: COLMAP, transforms.json, LLFF, DTU or Middlebury."""
        out: Path
        """Run folder to fill; must not exist yet."""
        split: str | None = None
        """llff:K, mip360:K, dtu:3|6|9, blender:8, every:N, all, or train=NAMES;test=NAMES."""
        downscale: int = 1
        """Factor by which both image sides shrink."""
        device: str = "auto"
        """auto, cpu or cuda."""
        threads: int = 0
        """CPU threads; 0 for as many as there are cores."""
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
        max_error: float | None = None
        """Choose the fastest rule whose images are off exact by at most this on average, in [0, 1]; not with --rule."""
        time_budget: float | None = None
        """Choose the number of steps so that the fit is done in this time [s]; not with --steps or --max-error."""

    return Request


def field_docs(kind: type) -> dict[str, str]:
    """Return the docstrings of the fields of a dataclass by name, each on one line; those of its bases included."""
    docs: dict[str, str] = {}
    for cls in reversed(kind.__mro__):
        if not dataclasses.is_dataclass(cls):
            continue
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
        body = tree.body if isinstance(tree, ast.ClassDef) else []
        for statement, after in itertools.pairwise(body):
            match statement, after:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str() as text)):
                    docs[name] = " ".join(text.split())
    return docs


def flags_of(kind: type, default: Any) -> tuple[type, Any]:
    """Derive the flags of a settings dataclass; returns a subclass that tyro can parse, and its default.

    Every field becomes a flag with the field's docstring as its help, those of nested settings under the field's name.
    """
    import tyro

    hints, docs, fields, values = typing.get_type_hints(kind), field_docs(kind), [], {}
    for f in dataclasses.fields(kind):
        hint, value = hints[f.name], getattr(default, f.name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint):
            hint, value = flags_of(hint, value)
            hint = tyro.conf.OmitArgPrefixes[hint] if f.name in UNPREFIXED else hint  # type: ignore[valid-type,misc]
        else:
            extra = [_size()] if f.name in BYTES else []
            hint = Annotated[hint, tyro.conf.arg(help=docs.get(f.name, "")), *extra]
        values[f.name] = value
        fields.append((f.name, hint, field(default=value)))
    flags = dataclasses.make_dataclass(kind.__name__, fields, bases=(kind,), frozen=True, namespace={"__doc__": kind.__doc__})
    return flags, flags(**values)


def settings_of(kind: type[Settings], flags: Any) -> Settings:
    """Return the settings that parsed flags stand for: the inverse of `flags_of`."""
    hints = typing.get_type_hints(kind)
    values = {f.name: getattr(flags, f.name) for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    return kind(**{n: settings_of(hints[n], v) if dataclasses.is_dataclass(hints[n]) else v for n, v in values.items()})


def _size() -> Any:
    """Return the specification of a flag for a size in bytes, such as 2GiB."""
    import tyro

    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1, metavar="SIZE", instance_from_str=lambda words: parse_bytes(words[0]),
        is_instance=lambda value: value is None or isinstance(value, int),
        str_from_instance=lambda value: ["none" if value is None else f"{value}B"],
    )  # fmt: skip


def _flags(base: FitConfig) -> type:
    """Return the dataclass of all flags, whose defaults are the settings ``base``."""
    import tyro

    kind, default = flags_of(FitConfig, base)
    config = ("config", Annotated[kind, tyro.conf.arg(name="")], field(default=default))
    return dataclasses.make_dataclass("Fit", [config], bases=(_request_type(),), frozen=True, kw_only=True)


def _chosen(a: Any, arguments: list[str], config: FitConfig) -> tuple[FitConfig, tuple[str, ...]]:
    """Let measured costs choose settings where the user asked for it; returns the settings and notes on the choice."""
    if a.max_error is not None and a.time_budget is not None:
        raise UsageError("--max-error and --time-budget choose settings by different costs: give one of them")
    if a.time_budget is not None:
        if a.resume or _word(arguments, "--steps"):
            raise UsageError(
                "--time-budget chooses the number of steps: leave out --steps, and to continue such a run give --resume with "
                "the --steps that it chose instead of --time-budget"
            )
        check_budget(a.time_budget)
    if a.max_error is None:
        return config, ()
    if _word(arguments, "--rule"):
        raise UsageError("--max-error chooses the rule: leave out --rule")
    rule, note = select_rule(max_error=a.max_error)
    return dataclasses.replace(config, rule=rule), (note,)


def _base(arguments: list[str]) -> tuple[FitConfig, str]:
    """Return the preset that the flags start from, and the kind of device that it goes with."""
    named, device = _word(arguments, "--preset"), _word(arguments, "--device") or "auto"
    kind = "cpu" if {"-h", "--help"} & set(arguments) and device == "auto" else choose_device(device)[0].type
    name = named or DEFAULT_PRESET[kind]
    if name not in PRESETS:
        raise UsageError(f"preset {name!r} is not one of {', '.join(PRESETS)}")
    return PRESETS[name], kind


def fit(arguments: list[str], description: str) -> FitRequest:
    """Return the request that the words of a command line make.

    Raises:
        ResourceError: The device is not there.
        UsageError: A flag is wrong.
    """
    import tyro

    if "max_gaussians" not in FitConfig.__dataclass_fields__:
        arguments = [w.replace("--max-gaussians", "--density.max-gaussians", 1) for w in arguments]
    base, kind = _base(arguments)
    a: Any = tyro.cli(_flags(base), args=arguments, prog="warpgs fit", description=description)
    if a.threads < 0:
        raise UsageError(f"--threads must be 0 or more, not {a.threads}")
    if a.threads:
        set_threads(a.threads)
    config, notes = _chosen(a, arguments, settings_of(FitConfig, a.config))
    if _word(arguments, "--preset") is None:
        steps = "as many steps as the time allows" if a.time_budget else f"{config.steps} steps"
        print(f"preset {base.preset}, as usual on {kind}, {steps}; the time left stands in the line of progress")
    masks = None if a.score_masks is None else str(a.score_masks.resolve())
    scene = SceneRequest(str(a.scene), a.split, a.downscale, a.strict, a.allow_outside, a.invert_masks, masks)
    return FitRequest(scene, a.out, config, a.device, a.resume, a.lpips_weights, a.time_budget, notes)
