"""Structure from motion in a process of its own: what pycolmap is asked, and what it answers."""

import contextlib
import importlib.util
import itertools
import json
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.device import usable_cores
from warpgs.errors import ResourceError, UsageError, install_extras
from warpgs.files import disk_is_full, write_json, write_text
from warpgs.poses.matching import choose_pairs
from warpgs.poses.photographs import MATCHING_SIDE, Photograph
from warpgs.process import ProcessFailed, Say, answer, end_with_parent, python_lines

EXHAUSTIVE = 60
"""Largest number of photographs of which all pairs are matched; for more photographs, pairs are chosen."""
JOB, LEARNED = "job.json", "learned.npz"
"""Names of the files with the worker's input, and with keypoints and matches of a network."""
IMAGES, DATABASE, PAIRS, MODELS, MODEL = "small", "matches.db", "pairs.txt", "models", "model"
"""Names in the folder that the worker runs in: relative, since pycolmap takes names in UTF-8 alone."""
PROGRESS_INTERVAL = 2.0
"""Time between two lines of progress on matching [s]."""
LAST_WORDS = 500
"""Number of letters of pycolmap's last message that an error shows."""
Json = dict[str, Any]


@dataclass(frozen=True)
class Mapping:
    """Result of structure from motion; photographs are indexed in the order of their names."""

    keypoints: tuple[int, ...]
    """Number of keypoints of each photograph."""
    matches: dict[tuple[int, int], int]
    """Number of matches that agree with one motion of the camera, by pair, the smaller index first."""
    tried: int
    """Number of pairs that were matched."""
    views: dict[int, tuple[np.ndarray, int]]
    """Views of the largest model: rotation of camera_from_world, shape [3, 3], and the number of points that the view sees."""
    cameras: tuple[dict[str, float], ...]
    """Cameras of ``views``: focal length [px of the photograph], distortion (coefficient of the radius squared, on the plane at
    distance 1), width and height [px]."""
    groups: tuple[tuple[int, ...], ...]
    """Photographs of each model, the largest first: photographs of different models share too little."""
    points: int
    """Number of points of the largest model."""
    error: float
    """Mean reprojection error of the largest model's points [px of the photograph]; 0 without a model."""
    method: str
    """Mapper that made the model: incremental or global."""
    version: str
    """Version of pycolmap."""
    kept_focal: bool | None = None
    """True if the focal length of EXIF is kept, because so few photographs cannot improve it; False if it does not fit them;
    None if this was not tested."""

    @cached_property
    def links(self) -> dict[int, list[tuple[int, int]]]:
        """Photographs that each photograph matches, each with the number of matches, most matches first."""
        links: dict[int, list[tuple[int, int]]] = {i: [] for i in range(len(self.keypoints))}
        for (a, b), n in self.matches.items():
            if n > 0:
                links[a].append((b, n))
                links[b].append((a, n))
        return {i: sorted(some, key=lambda link: (-link[1], link[0])) for i, some in links.items()}


def check_installed() -> None:
    """Raise a UsageError if pycolmap is not installed."""
    if importlib.util.find_spec("pycolmap") is None:
        raise UsageError(f"finding poses needs pycolmap, which is not installed; {install_extras('poses')}")


def camera_groups(photographs: list[Photograph]) -> list[int]:
    """Return each photograph's camera number; photographs of one device, focal length and image size share a camera."""
    numbers: dict[tuple[str, float | None, int, int], int] = {}
    return [numbers.setdefault((p.device, p.focal, p.width, p.height), len(numbers)) for p in photographs]


def cameras_of(photographs: list[Photograph], groups: list[int]) -> list[Photograph]:
    """Return the first photograph of each camera, in the order of the camera numbers (``groups``, from `camera_groups`)."""
    first = dict(zip(groups[::-1], photographs[::-1]))
    return [first[number] for number in range(len(first))]


def _job(photographs: list[Photograph], names: list[str], kind: str, folder: Path, threads: int, learned: bool) -> Json:
    """Return the worker's input."""
    of = camera_groups(photographs)
    cameras = []
    for p in cameras_of(photographs, of):
        scale = min(1.0, MATCHING_SIDE / max(p.width, p.height))
        width, height = round(scale * p.width), round(scale * p.height)
        cameras.append({"focal": None if p.focal is None else p.focal * max(width, height), "width": width, "height": height})
    (folder / MODELS).mkdir()
    return {
        "names": names, "camera_of": of, "cameras": cameras, "kind": kind, "threads": threads, "exhaustive": EXHAUSTIVE,
        "sizes": [(p.width, p.height) for p in photographs], "scene_names": [p.name for p in photographs], "learned": learned,
        "interval": PROGRESS_INTERVAL,
    }  # fmt: skip


def _lines(job: Json, folder: Path) -> Iterator[Json]:
    """Yield the worker's messages; end the worker when the reader stops."""
    write_json(folder / JOB, job)
    try:
        for line in python_lines("warpgs.poses.mapping", JOB, folder=folder, environment={"GLOG_logtostderr": "1"}):
            if line.startswith("{"):
                yield json.loads(line)
    except ProcessFailed as e:
        if disk_is_full(folder, e.errors):
            # the work folder is temporary, and its name means nothing to the user
            raise ResourceError(f"{folder.parents[1]}: its disk is full; free some space, or choose another --out") from e
        why = f"pycolmap ended with code {e.code}; it may have had too little memory"
        raise ResourceError(f"{why}. Its last message: {e.errors[-LAST_WORDS:].replace(chr(10), ' ')}") from e


def find_model(
    photographs: list[Photograph], names: list[str], kind: str, folder: Path, progress: Say, threads: int = 0,
    learned: bool = False,
) -> Mapping:  # fmt: skip
    """Find poses of photographs and write the model of those that fit together into ``folder``/model, in COLMAP's files."""
    result: Json | None = None
    for said in _lines(_job(photographs, names, kind, folder, threads or usable_cores(), learned), folder):
        if "progress" in said:
            progress(said["progress"])
        result = said.get("result", result)
    if result is None:
        raise ResourceError("pycolmap ended without a result; try again, with fewer photographs if memory is short")
    index = {n: i for i, n in enumerate(names)}
    model = result["model"] or {"views": {}, "cameras": {}, "points": 0, "error": 0.0}
    views = {int(i): (np.array(v["rotation"]), v["points"]) for i, v in model["views"].items()}
    p = photographs[min(views, default=0)]
    scale = max(1.0, max(p.width, p.height) / MATCHING_SIDE)
    return Mapping(
        tuple(result["keypoints"]), {(i, j): n for i, j, n in result["pairs"]}, result["tried"], dict(sorted(views.items())),
        tuple(model["cameras"].values()),
        tuple(tuple(sorted(index[n] for n in group)) for group in result["groups"]),
        model["points"], scale * model["error"], result["method"], result["version"], result["kept_focal"],
    )  # fmt: skip


# The process that calls pycolmap: features, matches, poses. It reads one job and prints lines of JSON.
#
# It is a separate process for three reasons: pycolmap may end its own process on an internal error, it cannot be
# interrupted, and its wheels contain code under the GPL (decision 017). No other module of warpgs imports pycolmap.
#
# A line holds ``progress``, a text for the user; the last line holds ``result``.

SEED = 0
"""Seed of everything that is sampled."""
MIN_INLIERS = 15
"""Smallest number of a pair's matches that agree with one camera motion; also of points that a new photograph must see."""
MIN_RATIO = 0.6
"""Fraction of a network's matches of a pair that must agree with one motion: for most places that only look alike it
is smaller (decision 017)."""
PEAK = 0.003
"""Contrast that a SIFT keypoint needs, half of pycolmap's: few photographs need more points. Chosen on the scenes temple and
fern."""
CAMERA_MODEL = "SIMPLE_RADIAL"
"""One focal length and one coefficient of distortion, which a few photographs can determine."""

KEEP_FOCAL = 4
"""Largest number of photographs with which EXIF's focal length is kept: estimating it is less accurate (decision 017)."""
MAX_RATIO = 1.05
"""EXIF's focal length is kept if its mean reprojection error is at most this many times that of an estimated focal length
(decision 017)."""


def _say(**values: Any) -> None:
    answer(json.dumps(values))


def _in_steps(items: list, words: str) -> Iterator[list]:
    """Yield a list in about twenty parts, each after a line of progress."""
    step = max(1, len(items) // 20)
    for begin in range(0, len(items), step):
        _say(progress=f"{words} {begin + 1} of {len(items)}")
        yield items[begin : begin + step]


def _write_pairs(pairs: list[tuple[int, int]], job: Json) -> None:
    """Write the list of pairs of photographs that pycolmap reads."""
    write_text(Path(PAIRS), "".join(f"{job['names'][i]} {job['names'][j]}\n" for i, j in pairs))


def import_photographs(pycolmap: Any, job: Json) -> None:
    """Write cameras and photographs into a new database; numbers follow the order of the job."""
    pycolmap.Database.open(DATABASE).close()
    for number, camera in enumerate(job["cameras"]):
        names = [n for n, c in zip(job["names"], job["camera_of"], strict=True) if c == number]
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = CAMERA_MODEL
        if camera["focal"] is not None:
            reader.camera_params = ",".join(map(repr, (camera["focal"], camera["width"] / 2, camera["height"] / 2, 0.0)))
        pycolmap.import_images(DATABASE, IMAGES, pycolmap.CameraMode.SINGLE, names, reader)


def extract(pycolmap: Any, job: Json) -> None:
    """Write the SIFT features of the photographs into the database."""
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu, options.sift.peak_threshold = job["threads"], False, PEAK
    mode, reader, names = pycolmap.CameraMode.AUTO, pycolmap.ImageReaderOptions(), job["names"]
    with pycolmap.Database.open(DATABASE) as database:
        order = numbers_of(database, job)
        _watched(
            lambda: pycolmap.extract_features(DATABASE, IMAGES, names, mode, reader, options, pycolmap.Device.cpu),
            lambda: f"finding features: {sum(map(database.exists_keypoints, order))} of {len(names)} photographs", job,
        )  # fmt: skip


def _watched(call: Callable[[], object], progress: Callable[[], str], job: Json) -> None:
    """Run a call of pycolmap, and tell meanwhile how far it is by the rows of its results."""
    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(call)
        while not running.done():
            with contextlib.suppress(Exception):  # progress alone: the call itself raises its errors below
                _say(progress=progress())
            wait([running], job["interval"])
        running.result()


def numbers_of(database: Any, job: Json) -> list[int]:
    """Return the database's id of each photograph, in the order of the job."""
    numbers = {image.name: image.image_id for image in database.read_all_images()}
    return [numbers[name] for name in job["names"]]


def verification_options(pycolmap: Any) -> Any:
    """Return the options by which matches are checked to agree with one motion of the camera."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed, options.min_num_inliers = SEED, MIN_INLIERS
    return options


def verify_learned(pycolmap: Any, job: Json) -> Json:
    """Write the keypoints and matches of a network into the database and verify them; return the result of `matched`."""
    with np.load(LEARNED, allow_pickle=False) as learned:
        pairs, ends = learned["pairs"], np.cumsum(learned["counts"])
        matches = np.split(learned["matches"], ends[:-1])
        keypoints = np.split(learned["keypoints"], np.cumsum(learned["per_photograph"])[:-1])
    with pycolmap.Database.open(DATABASE) as database:
        order = numbers_of(database, job)
        for number, positions in zip(order, keypoints, strict=True):
            database.write_keypoints(number, positions)
        for (i, j), rows in zip(pairs, matches, strict=True):
            if len(rows):
                database.write_matches(order[i], order[j], rows)
    for some in _in_steps(pairs, "verifying matches: pair"):
        _write_pairs(some, job)
        pycolmap.verify_matches(DATABASE, PAIRS, verification_options(pycolmap))
    with pycolmap.Database.open(DATABASE) as database:
        for (i, j), rows in zip(pairs, matches, strict=True):
            numbers = order[i], order[j]
            if database.exists_two_view_geometry(*numbers):
                if not len(database.read_two_view_geometry(*numbers).inlier_matches) >= MIN_RATIO * len(rows):
                    database.delete_two_view_geometry(*numbers)
    return matched(pycolmap, job, len(pairs))


def match(pycolmap: Any, job: Json) -> Json:
    """Match pairs of photographs; return the result of `matched`."""
    with pycolmap.Database.open(DATABASE) as database:
        order = numbers_of(database, job)
        found = [] if len(order) <= job["exhaustive"] else [database.read_descriptors(i).data for i in order]
    pairs = choose_pairs(found, job["kind"], SEED) if found else [(i, j) for j in range(len(order)) for i in range(j)]
    matching, verification = pycolmap.FeatureMatchingOptions(), verification_options(pycolmap)
    matching.num_threads, matching.use_gpu = job["threads"], False
    chosen = pycolmap.ImportedPairingOptions()
    chosen.match_list_path = PAIRS
    _write_pairs(pairs, job)
    # one call, since each call indexes the descriptors of its photographs anew
    with pycolmap.Database.open(DATABASE) as database:
        _watched(
            lambda: pycolmap.match_image_pairs(DATABASE, matching, chosen, verification, pycolmap.Device.cpu),
            lambda: f"matching: {database.num_matched_image_pairs()} of {len(pairs)} pairs", job,
        )  # fmt: skip
    return matched(pycolmap, job, len(pairs))


def matched(pycolmap: Any, job: Json, tried: int) -> Json:
    """Return the number of keypoints of each photograph, and for each pair the number of matches that agree with one motion."""
    with pycolmap.Database.open(DATABASE) as database:
        order = numbers_of(database, job)
        keypoints = [database.num_keypoints_for_image(i) for i in order]
        ids, geometries = database.read_two_view_geometries()
    index = {number: i for i, number in enumerate(order)}
    pairs = [sorted(index[k] for k in pycolmap.pair_id_to_image_pair(pair)) for pair in ids]
    agreed = sorted([*pair, len(g.inlier_matches)] for pair, g in zip(pairs, geometries, strict=True))
    return {"keypoints": keypoints, "pairs": agreed, "tried": tried}


def map_incrementally(pycolmap: Any, job: Json, keep_focal: bool = False) -> list[Any]:
    """Return the models that grow photograph by photograph from a good pair; ``keep_focal`` keeps EXIF's focal lengths."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1  # else the rounding depends on which thread finishes first
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.min_model_size, options.min_num_matches = 2, MIN_INLIERS
    options.mapper.abs_pose_min_num_inliers = MIN_INLIERS
    options.triangulation.ignore_two_view_tracks = False  # with few photographs most points are seen by only two
    options.ba_refine_focal_length = options.ba_refine_extra_params = not keep_focal
    registered, count = itertools.count(3), len(job["names"])

    def on_next() -> None:
        _say(progress=f"finding poses: photograph {min(next(registered), count)} of {count}")

    folder = Path(MODELS) / ("kept_focal" if keep_focal else "incremental")
    folder.mkdir()
    return list(pycolmap.incremental_mapping(DATABASE, IMAGES, str(folder), options, next_image_callback=on_next).values())


def believes_exif(kept: list[Any], free: list[Any]) -> bool:
    """Return whether EXIF's focal length is kept: models ``kept`` have it, for models ``free`` it was estimated."""
    # as many photographs, and not much more error; without one of the lists, whether there are ``kept`` models
    if not kept or not free:
        return bool(kept)
    best, other = (max(m, key=lambda r: (r.num_reg_images(), r.num_points3D())) for m in (kept, free))
    as_well = best.compute_mean_reprojection_error() <= MAX_RATIO * other.compute_mean_reprojection_error()
    return bool(best.num_reg_images() >= other.num_reg_images() and as_well)


def map_globally(pycolmap: Any, job: Json) -> list[Any]:
    """Return the models in which all poses are found at once."""
    _say(progress="finding poses: all photographs at once")
    if not pycolmap.calibrate_view_graph(DATABASE):
        return []
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = options.mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    mapper = options.mapper
    for part in (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        part.random_seed = SEED
    folder = Path(MODELS) / "global"
    folder.mkdir()
    return list(pycolmap.global_mapping(DATABASE, IMAGES, str(folder), options).values())


def finish(model: Any, job: Json) -> Json:
    """Give a model the names and sizes of the scene's images and write it; return its description."""
    error, index = model.compute_mean_reprojection_error(), {name: i for i, name in enumerate(job["names"])}
    views = {}
    for number in model.reg_image_ids():
        image = model.image(number)
        i = index[image.name]
        rotation = image.cam_from_world().rotation.matrix().tolist()
        views[i] = {"rotation": rotation, "points": image.num_points3D, "camera": image.camera_id}
        small, (width, height) = image.camera, job["sizes"][i]
        scale = [width / small.width, height / small.height]
        for point in image.points2D:
            point.xy = point.xy * scale
        image.name = job["scene_names"][i]
    for camera in model.cameras.values():
        if used := [i for i, v in views.items() if v["camera"] == camera.camera_id]:
            camera.rescale(*job["sizes"][used[0]])
    Path(MODEL).mkdir(parents=True)
    model.write_binary(MODEL)
    cameras = {c.camera_id: {"focal": c.mean_focal_length(), "distortion": c.params[-1], "width": c.width, "height": c.height}
               for c in model.cameras.values() if any(v["camera"] == c.camera_id for v in views.values())}  # fmt: skip
    return {"views": views, "cameras": cameras, "points": model.num_points3D(), "error": error}


def main(path: str) -> None:
    """Run the job in a file."""
    import pycolmap

    pycolmap.logging.minloglevel = 2  # errors
    job = json.loads(Path(path).read_text("utf-8"))
    pycolmap.set_random_seed(SEED)
    import_photographs(pycolmap, job)
    if job["learned"]:
        result = verify_learned(pycolmap, job)
    else:
        extract(pycolmap, job)
        result = match(pycolmap, job)
    models: list[Any] = map_incrementally(pycolmap, job) if result["pairs"] else []
    kept_focal = None
    if result["pairs"] and len(job["names"]) <= KEEP_FOCAL and all(c["focal"] is not None for c in job["cameras"]):
        kept = map_incrementally(pycolmap, job, keep_focal=True)
        if kept_focal := believes_exif(kept, models):
            models = kept
    largest = max((m.num_reg_images() for m in models), default=0)
    method = "incremental"
    if result["pairs"] and largest < len(job["names"]):
        others = map_globally(pycolmap, job)
        if max((m.num_reg_images() for m in others), default=0) > largest:
            models, method, kept_focal = others, "global", None
    models.sort(key=lambda m: (-m.num_reg_images(), -m.num_points3D()))
    groups = [sorted(m.image(i).name for i in m.reg_image_ids()) for m in models]
    result |= {"version": pycolmap.__version__, "method": method, "kept_focal": kept_focal, "groups": groups}
    _say(result=result | {"model": finish(models[0], job) if models else None})


if __name__ == "__main__":
    end_with_parent()
    main(sys.argv[1])
