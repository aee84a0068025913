"""A job of a farm: a fit and the folder of its results, and the conversion to text for another process."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from dataclasses import dataclass
from pathlib import Path

from warpgs import schema
from warpgs.errors import UsageError
from warpgs.io.readers import READERS
from warpgs.pipeline.runs.request import FitRequest, SceneRequest
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loss import LOSS_TERMS
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.pipeline.train.view_modules.base import VIEW_MODULES
from warpgs.plugins import module_of, own_places


@dataclass(frozen=True)
class FarmJob:
    """A fit that an engine runs."""

    name: str
    """Name, unique in the farm."""
    request: FitRequest
    """The fit; ``out`` is its run folder."""
    folder: Path
    """Folder of the job's record, log and thumbnail, which is locked while a farm works on it."""
    results: Path | None = None
    """Folder of all results, which contains ``folder``; links below it are not followed. None if it is ``folder`` itself."""

    def identity(self) -> str:
        """Return an identifier of all inputs except the images: the first 16 hexadecimal digits of their SHA-256."""
        r = self.request
        weights = None if r.lpips_weights is None else str(r.lpips_weights)
        values = [dataclasses.asdict(r.scene), r.config.to_json(), weights, r.device]
        if own := r.config.own_code():
            values.append(own)
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def job_text(job: FarmJob) -> str:
    """Return a job as one line of JSON."""
    r = job.request
    request = {
        "scene": dataclasses.asdict(r.scene), "out": str(r.out.absolute()), "config": r.config.to_json(), "device": r.device,
        "lpips_weights": None if r.lpips_weights is None else str(r.lpips_weights.resolve()), "notes": r.notes,
        "own_code": own_places(r.config.plugged_in()),
    }  # fmt: skip
    places = {"folder": str(job.folder.absolute()), "results": None if job.results is None else str(job.results.absolute())}
    return json.dumps({"name": job.name, **places, "request": request})


def job_of(text: str) -> FarmJob:
    """Return the job of `job_text`; user code that the job names is imported, as in the process that wrote the text.

    Raises:
        UsageError: The user code cannot be imported.
    """
    values = schema.parse(text)
    r = values["request"]
    scene, config = SceneRequest(**r["scene"]), r["config"]
    if scene.reader is not None:
        READERS.load(scene.reader)
    for place in r["own_code"]:  # a class of a preset's file cannot be imported by its name
        try:
            module_of(place)
        except (ImportError, OSError) as e:
            raise UsageError(f"your code {place} cannot be imported ({e}); put it where all processes can import it") from e
    STRATEGIES.load(config["strategy"])
    for term in config["loss_terms"]:
        LOSS_TERMS.load(term["name"])
    for module in config["view_modules"]:
        VIEW_MODULES.load(module["name"])
    weights = None if r["lpips_weights"] is None else Path(r["lpips_weights"])
    request = FitRequest(
        scene, Path(r["out"]), FitConfig.from_json(config), r["device"], lpips_weights=weights, notes=tuple(r["notes"])
    )
    results = None if values["results"] is None else Path(values["results"])
    return FarmJob(values["name"], request, Path(values["folder"]), results)
