"""The process that calls pycolmap: features, matches, poses. It reads one job and prints lines of JSON.

It is a separate process for three reasons: pycolmap may end its own process on an internal error, it cannot be interrupted,
and its wheels contain code under the GPL (decision 017). No other module of warpgs imports pycolmap.

A line holds ``progress``, a text for the user; the last line holds ``result``.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.files import write_text
from warpgs.poses.pairs import choose_pairs
from warpgs.runtime.subprocesses import end_with_parent
from warpgs.runtime.terminal import answer

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


def import_photographs(pycolmap: Any, job: dict[str, Any]) -> None:
    """Write cameras and photographs into a new database; numbers follow the order of the job."""
    pycolmap.Database.open(job["database"]).close()
    arguments = (job["database"], job["images"])
    for number, camera in enumerate(job["cameras"]):
        names = [n for n, c in zip(job["names"], job["camera_of"], strict=True) if c == number]
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = CAMERA_MODEL
        if camera["focal"] is not None:
            reader.camera_params = ",".join(map(repr, (camera["focal"], camera["width"] / 2, camera["height"] / 2, 0.0)))
        pycolmap.import_images(*arguments, pycolmap.CameraMode.SINGLE, names, reader)


def extract(pycolmap: Any, job: dict[str, Any]) -> None:
    """Write the SIFT features of the photographs into the database."""
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads, options.use_gpu, options.sift.peak_threshold = job["threads"], False, PEAK
    arguments = (job["database"], job["images"])
    step = max(job["threads"], len(job["names"]) // 20)  # each thread processes one photograph
    for begin in range(0, len(job["names"]), step):
        _say(progress=f"finding features: photograph {begin + 1} of {len(job['names'])}")
        mode, reader = pycolmap.CameraMode.AUTO, pycolmap.ImageReaderOptions()
        names = job["names"][begin : begin + step]
        pycolmap.extract_features(*arguments, names, mode, reader, options, pycolmap.Device.cpu)


def numbers_of(database: Any, job: dict[str, Any]) -> list[int]:
    """Return the database's id of each photograph, in the order of the job."""
    numbers = {image.name: image.image_id for image in database.read_all_images()}
    return [numbers[name] for name in job["names"]]


def verification_options(pycolmap: Any) -> Any:
    """Return the options by which matches are checked to agree with one motion of the camera."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed, options.min_num_inliers = SEED, MIN_INLIERS
    return options


def verify_learned(pycolmap: Any, job: dict[str, Any]) -> dict[str, Any]:
    """Write the keypoints and matches of a network into the database and verify them; return the result of `matched`."""
    with np.load(job["learned"], allow_pickle=False) as learned:
        pairs, ends = learned["pairs"], np.cumsum(learned["counts"])
        matches = np.split(learned["matches"], ends[:-1])
        keypoints = np.split(learned["keypoints"], np.cumsum(learned["per_photograph"])[:-1])
    with pycolmap.Database.open(job["database"]) as database:
        order = numbers_of(database, job)
        for number, positions in zip(order, keypoints, strict=True):
            database.write_keypoints(number, positions)
        for (i, j), rows in zip(pairs, matches, strict=True):
            if len(rows):
                database.write_matches(order[i], order[j], rows)
    step = max(1, len(pairs) // 20)
    for begin in range(0, len(pairs), step):
        _say(progress=f"verifying matches: pair {begin + 1} of {len(pairs)}")
        names = [(job["names"][i], job["names"][j]) for i, j in pairs[begin : begin + step]]
        write_text(Path(job["pairs"]), "".join(f"{a} {b}\n" for a, b in names))
        pycolmap.verify_matches(job["database"], job["pairs"], verification_options(pycolmap))
    with pycolmap.Database.open(job["database"]) as database:
        for (i, j), rows in zip(pairs, matches, strict=True):
            numbers = order[i], order[j]
            if database.exists_two_view_geometry(*numbers):
                agreed = database.read_two_view_geometry(*numbers).inlier_matches
                if not len(agreed) >= MIN_RATIO * len(rows):
                    database.delete_two_view_geometry(*numbers)
    return matched(pycolmap, job, len(pairs))


def match(pycolmap: Any, job: dict[str, Any]) -> dict[str, Any]:
    """Match pairs of photographs; return the result of `matched`."""
    with pycolmap.Database.open(job["database"]) as database:
        order = numbers_of(database, job)
        few = len(order) <= job["exhaustive"]
        found = [] if few else [database.read_descriptors(i).data for i in order]
    pairs = choose_pairs(found, job["kind"], SEED) if found else [(i, j) for j in range(len(order)) for i in range(j)]
    matching, verification = pycolmap.FeatureMatchingOptions(), verification_options(pycolmap)
    matching.num_threads, matching.use_gpu = job["threads"], False
    listed, chosen = Path(job["pairs"]), pycolmap.ImportedPairingOptions()
    chosen.match_list_path = str(listed)
    step = max(1, len(pairs) // 20)
    for begin in range(0, len(pairs), step):
        _say(progress=f"matching: pair {begin + 1} of {len(pairs)}")
        write_text(listed, "".join(f"{job['names'][i]} {job['names'][j]}\n" for i, j in pairs[begin : begin + step]))
        pycolmap.match_image_pairs(job["database"], matching, chosen, verification, pycolmap.Device.cpu)
    return matched(pycolmap, job, len(pairs))


def matched(pycolmap: Any, job: dict[str, Any], tried: int) -> dict[str, Any]:
    """Return the number of keypoints of each photograph, and for each pair the number of matches that agree with one motion."""
    with pycolmap.Database.open(job["database"]) as database:
        order = numbers_of(database, job)
        keypoints = [database.num_keypoints_for_image(i) for i in order]
        ids, geometries = database.read_two_view_geometries()
    index = {number: i for i, number in enumerate(order)}
    agreed = []
    for pair, geometry in zip(ids, geometries, strict=True):
        i, j = sorted(index[k] for k in pycolmap.pair_id_to_image_pair(pair))
        agreed.append([i, j, len(geometry.inlier_matches)])
    return {"keypoints": keypoints, "pairs": sorted(agreed), "tried": tried}


def map_incrementally(pycolmap: Any, job: dict[str, Any], keep_focal: bool = False) -> list[Any]:
    """Return the models that grow photograph by photograph from a good pair; ``keep_focal`` keeps EXIF's focal lengths."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1  # else the rounding depends on which thread finishes first
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = SEED
    options.min_model_size, options.min_num_matches = 2, MIN_INLIERS
    options.mapper.abs_pose_min_num_inliers = MIN_INLIERS
    options.triangulation.ignore_two_view_tracks = False  # with few photographs most points are seen by only two
    options.ba_refine_focal_length = options.ba_refine_extra_params = not keep_focal
    registered = [2]

    def on_next() -> None:
        registered[0] += 1
        _say(progress=f"finding poses: photograph {min(registered[0], len(job['names']))} of {len(job['names'])}")

    folder = Path(job["models"]) / ("kept_focal" if keep_focal else "incremental")
    folder.mkdir()
    arguments = job["database"], job["images"], str(folder)
    return list(pycolmap.incremental_mapping(*arguments, options, next_image_callback=on_next).values())


def believes_exif(kept: list[Any], free: list[Any]) -> bool:
    """Return whether EXIF's focal length is kept: models ``kept`` have it, for models ``free`` it was estimated.

    The best of ``kept`` must have at least as many photographs as the best of ``free``, and at most `MAX_RATIO` times its
    error. If a list is empty, return whether ``kept`` has models.
    """
    if not kept or not free:
        return bool(kept)
    best, other = (max(m, key=lambda r: (r.num_reg_images(), r.num_points3D())) for m in (kept, free))
    as_well = best.compute_mean_reprojection_error() <= MAX_RATIO * other.compute_mean_reprojection_error()
    return bool(best.num_reg_images() >= other.num_reg_images() and as_well)


def map_globally(pycolmap: Any, job: dict[str, Any]) -> list[Any]:
    """Return the models in which all poses are found at once."""
    _say(progress="finding poses: all photographs at once")
    if not pycolmap.calibrate_view_graph(job["database"]):
        return []
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = options.mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    mapper = options.mapper
    for part in (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        part.random_seed = SEED
    folder = Path(job["models"]) / "global"
    folder.mkdir()
    return list(pycolmap.global_mapping(job["database"], job["images"], str(folder), options).values())


def finish(model: Any, job: dict[str, Any]) -> dict[str, Any]:
    """Give a model the names and sizes of the scene's images and write it; return its description."""
    error, index = model.compute_mean_reprojection_error(), {name: i for i, name in enumerate(job["names"])}
    views = {}
    for number in model.reg_image_ids():
        image = model.image(number)
        i = index[image.name]
        pose = image.cam_from_world()
        views[i] = {"rotation": pose.rotation.matrix().tolist(), "center": image.projection_center().tolist(),
                    "points": image.num_points3D, "camera": image.camera_id}  # fmt: skip
        small, (width, height) = image.camera, job["sizes"][i]
        scale = [width / small.width, height / small.height]
        for point in image.points2D:
            point.xy = point.xy * scale
        image.name = job["scene_names"][i]
    for camera in model.cameras.values():
        used = [i for i, v in views.items() if v["camera"] == camera.camera_id]
        if used:
            camera.rescale(*job["sizes"][used[0]])
    Path(job["model"]).mkdir(parents=True)
    model.write_binary(job["model"])
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
    if job["learned"] is None:
        extract(pycolmap, job)
        result = match(pycolmap, job)
    else:
        result = verify_learned(pycolmap, job)
    result |= {"version": pycolmap.__version__}
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
    result |= {"method": method, "kept_focal": kept_focal, "groups": groups}
    _say(result=result | {"model": finish(models[0], job) if models else None})


if __name__ == "__main__":
    end_with_parent()
    main(sys.argv[1])
