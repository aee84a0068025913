"""Flags for reading a scene, made from `SceneRequest`; every command that reads a scene has them."""

import dataclasses
import os
from typing import Any

from warpgs.app.flags import flags_of, settings_of
from warpgs.app.own_code import load_own
from warpgs.io.map_files import NONE
from warpgs.io.readers import READERS
from warpgs.pipeline.runs.request import SceneRequest


def scene_flags(*, positional: bool) -> tuple[type, Any]:
    """Return the dataclass of the flags, and their defaults.

    Args:
        positional: True if the scene folder is a positional argument; False if the command has its own argument for scenes.
    """
    import tyro

    if positional:
        path, shown = tyro.MISSING, (tyro.conf.Positional, tyro.conf.arg(metavar="SCENE"))
    else:
        path, shown = "", (tyro.conf.Fixed, tyro.conf.Suppress)
    return flags_of(SceneRequest, SceneRequest(path), {"path": shown})


def scene_of(flags: Any, path: str) -> SceneRequest:
    """Return the request for a scene folder from parsed flags; a user-defined reader is loaded.

    Raises:
        UsageError: There is no such reader.
    """
    asked = settings_of(SceneRequest, flags)
    if asked.reader is not None:
        reader = asked.reader
        load_own(READERS.kind, reader, lambda: READERS.load(reader))
    named = {n: getattr(asked, n) for n in ("score_masks", "matcher", "depths", "normals")}
    found = {n: p if p is None or (p == NONE and n in ("depths", "normals")) else os.path.realpath(p) for n, p in named.items()}
    return dataclasses.replace(asked, path=path, **found)
