"""Images of the priors of a scene's training views, to inspect before a fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.files import write_bytes
from warpgs.pipeline.metrics.region import counted_region
from warpgs.pipeline.model.init import InitConfig, consistent_depths, seen_points
from warpgs.pipeline.runs.request import NO_SCORES, SceneRequest, read_scene
from warpgs.pipeline.train.strategies.importance import ImportanceConfig, geometry_score, semantic_score
from warpgs.priors.cache import cache_folder
from warpgs.priors.view_prior import PriorConfig, view_priors
from warpgs.report.contact_sheet import Tile, contact_sheet
from warpgs.report.image_names import image_names, renaming_notes
from warpgs.report.images import png
from warpgs.runtime.folder_lock import hold_folder
from warpgs.scene import Prior, View

SOURCES = ("sweep", "flow")


def prior_sheet(view: View, prior: Prior) -> np.ndarray:
    """Return one sheet, [rows, columns, 3] in [0, 1]: image, the four maps, and the two scores computed from them."""
    curvature = ImportanceConfig().curvature
    disparity, *semantics = map(torch.from_numpy, (prior.disparity, prior.confidence, prior.boundary, prior.foreground))
    tiles = [
        Tile("image", view.image),
        Tile("disparity, near is 1", prior.disparity, "TURBO"),
        Tile("confidence of the likeliest class", prior.confidence, "VIRIDIS"),
        Tile("foreground", prior.foreground, "VIRIDIS"),
        Tile("boundary", prior.boundary),
        Tile("S_semantic = confidence (boundary + foreground)", semantic_score(*semantics).numpy()),
        Tile(f"S_geometry = |grad D| + {curvature:g} kappa", geometry_score(disparity, curvature).numpy()),
    ]
    size = f"{view.camera.width} x {view.camera.height} px"
    lines = [
        f"{size}. Scores are scaled to the 2nd and 98th percentile of the view.",
        f"Depth: {prior.depth_source}.",
        f"Semantics: {prior.semantics_source}. Mean foreground {prior.foreground.mean():.1%}.",
    ]
    return contact_sheet(view.name, lines, tiles)


def show_priors(request: SceneRequest, config: PriorConfig, source: str, out: Path, threads: int = 0) -> list[str]:
    """Write a sheet per training view as PNG; returns lines for the user.

    Args:
        request: The scene and its split.
        config: Networks for the priors.
        source: Method to find depth from other views if no depth network is given: sweep or flow.
        out: Folder for the sheets.
        threads: CPU threads of the networks; 0 for as many as there are cores.

    Raises:
        DataError: The scene or a network's file is invalid.
        ResourceError: The folder cannot be written, or another process writes into it.
        UsageError: The source or the split is unknown.
    """
    if source not in SOURCES:
        raise UsageError(f"source {source!r} is not one of {', '.join(SOURCES)}")
    scene, split, notes = read_scene(request)
    views = [scene.view(name) for name in split.train]
    names = image_names(v.name for v in scene.views)
    with hold_folder(out) as held:
        regions = [counted_region(v)[0] for v in views]
        depths = None
        if config.depth_model is None and len(views) > 1:
            depths = consistent_depths(views, seen_points(views, scene.points), InitConfig(source=source))
        cache = cache_folder()
        priors, found = view_priors(views, config, depths=lambda: depths, regions=regions, threads=threads, cache=cache)
        for view, prior in zip(views, priors):
            write_bytes(out / f"{names[view.name]}.png", png(prior_sheet(view, prior)))
        notes = [n for n in notes if n != NO_SCORES]
        return [*notes, *held, *renaming_notes(names), *found, f"{len(views)} sheets in {out}"]
