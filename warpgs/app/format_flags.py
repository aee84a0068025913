"""Flags of the commands that write Gaussians: the filters, the format, and the options of each format."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro  # noqa: TID253 - only a command imports this file

from warpgs.app.flags import flags_of, listed, settings_of, word_after
from warpgs.errors import UsageError
from warpgs.export.base import Format, all_formats, find_format
from warpgs.pipeline.run.export import Filters
from warpgs.plugins import flag_group


def format_lines() -> str:
    """Return the formats by suffix, each with a description for the user."""
    return listed("formats", {f.suffix: f.description for f in all_formats()})


def format_flags(arguments: list[str]) -> type:
    """Return the dataclass of the flags that `export` and `convert` share, including options of the format of --format."""

    @dataclass(frozen=True, kw_only=True)
    class Shared:
        format: str | None = None
        """Format of your own, as module:Class or path/to/file.py:Class. Default: chosen by the suffix."""
        crop: str | None = None
        """Box to keep, in units of the scene's files: x,y,z,X,Y,Z, or a .json file such as the one that the viewer saves."""
        clean: tyro.conf.FlagCreatePairsOff[bool] = False
        """Remove floaters and needles: Gaussians that no training view of a run sees, that are larger than the scene, or that
        are long and thin. On without this flag, except for .ply files."""
        no_clean: tyro.conf.FlagCreatePairsOff[bool] = False
        """Keep floaters and needles."""
        sh_degree: int | None = None
        """Highest degree of harmonics; 0 for colours without view dependence. Default: all."""
        rotate: str | None = None
        """Rotate the model about the origin: x,y,z,degrees (axis and angle); or level, for a run only (turns the cameras' up to
        -y)."""

    fields: list[tuple[str, Any, Any]] = []
    for name, kind in _with_options(word_after(arguments, "--format")).items():
        flags, default = flags_of(kind, kind())
        fields.append((name, Annotated[flags, tyro.conf.arg(name=name)], field(default=default)))
    return dataclasses.make_dataclass("Formatted", fields, bases=(Shared,), frozen=True, kw_only=True)


def _with_options(own: str | None) -> dict[str, type]:
    """Return the options of formats by the group of their flags, including the user's ``own`` format."""
    kinds = [type(f) for f in all_formats()]
    if own is not None and (kind := type(find_format(own))) not in kinds:
        kinds.append(kind)
    return {flag_group(k.name): k.Config for k in kinds if k.Config is not None}


def chosen_formats(a: Any, target: Path) -> list[Format]:
    """Return formats to prefer: the target file's format if it has options, then the format of --format if given."""
    named = [] if a.format is None else [find_format(a.format)]
    written = next((type(f) for f in [*named, *all_formats()] if f.fits(target)), Format)
    for group, config in _with_options(a.format).items():
        if settings_of(config, getattr(a, group)) != config() and config is not written.Config:
            flag = group.replace("_", "-")
            raise UsageError(f"--{flag}.* are not options of the format of {target}; leave them out")
    if written.Config is None:
        return named
    made = written(settings_of(written.Config, getattr(a, flag_group(written.name))))
    return [made, *(f for f in named if type(f) is not written)]


def filters_of(a: Any) -> Filters:
    """Return the filters of parsed flags of `format_flags`."""
    if a.clean and a.no_clean:
        raise UsageError("--clean and --no-clean exclude each other; give one of them")
    return Filters(a.crop, a.clean or (False if a.no_clean else None), a.sh_degree, a.rotate)
