"""Scenes as Metashape and RealityScan export them: a file of cameras, the photographs, and a PLY file of points beside it."""

import abc
import contextlib
import csv
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import ClassVar
from xml.etree import ElementTree

import numpy as np

from warpgs.errors import DataError
from warpgs.files import read_file, read_start
from warpgs.geometry import matmul, seen_pixels
from warpgs.io import colmap, folder as scenes
from warpgs.io.colmap import Posed
from warpgs.io.folder import Probe, Reader, SceneFolder, ViewList, register
from warpgs.io.images import Lens, ReadOptions
from warpgs.scene import PointCloud, Scene, View

HEAD_BYTES = 4096
"""First bytes of a file that tell whether it is one of cameras."""
MAX_BYTES = 2**24
"""Largest file of cameras [bytes]; ten thousand cameras of Metashape take about ten million bytes."""
MAX_PARTS = 2**19
"""Largest number of tags, and of attributes, of an XML file; a camera has about twenty."""
MAX_SKEW = 1e-3
"""Largest skew b2 as a fraction of the focal length: it moves no pixel by more than a thousandth of the image."""
MIN_SHARE, COMPARED_POINTS = 0.05, 2000
"""Fraction of the points that some view must see, and number of points that are tried."""


@contextmanager
def _understood(where: str) -> Iterator[None]:
    """Turn errors of parsing into a DataError that names the place."""
    try:
        yield
    except (ValueError, OverflowError, KeyError, csv.Error, ElementTree.ParseError) as e:
        raise DataError(f"{where}: cannot be understood ({str(e)[:120]}); export the cameras again") from e


class CaptureReader(Reader):
    """What the readers of this file share: the choice of the file, the photographs and the points."""

    suffix: ClassVar[str]
    """Suffix of the file of cameras."""

    @abc.abstractmethod
    def begins(self, head: str) -> bool:
        """Return whether a file of cameras begins so."""

    @abc.abstractmethod
    def rows(self, path: Path) -> list[Posed]:
        """Return the cameras of a file, in file units."""

    def files(self, folder: Path) -> list[Path]:
        """Return the files of cameras of a folder, sorted."""
        found = []
        for path in sorted(folder.glob("[!.]*")):
            if path.suffix.lower() == self.suffix:
                with contextlib.suppress(OSError):  # a pipe, a folder: none
                    found += [path] * self.begins(read_start(path, HEAD_BYTES).decode("utf-8-sig", "replace"))
        return found

    def probe(self, folder: Path) -> Probe | None:
        """See `Reader.probe`."""
        files = self.files(folder)
        if not files:
            return None
        return Probe(files[0].name, "" if colmap.image_base(folder, folder) else "its photographs, beside it or in images")

    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """See `Reader.read`."""
        path, *others = self.files(folder)
        notes = [f"cameras taken from {path.name}; {', '.join(p.name for p in others)} ignored"] if others else []
        scene, views = SceneFolder(folder, options), ViewList(options)
        rows = self.rows(scene.inside(path))
        base = colmap.image_base(folder, folder) or "images"
        _, found = colmap.add_views(scene, views, base, path, [name for name, *_ in rows], rows)
        points, said = _points(scene, path, views.views)
        pixels = scene.pixel_source(by_folder=True)
        return self.scene(folder, views.views, notes + found + said, points=points, pixels=pixels)


def _points(scene: SceneFolder, path: Path, views: list[View]) -> tuple[PointCloud | None, list[str]]:
    """Return the points of the PLY file beside a file of cameras, and notes; None if they lie outside all views."""
    files = sorted(p for p in scene.root.glob("[!.]*") if p.suffix.lower() == ".ply" and p.is_file())
    if not files:
        return None, [f"no PLY file is beside {path.name}, so there are no points to start from"]
    ply = next((p for p in files if p.stem == path.stem), files[0])
    bad = None if scene.options.strict else list[str]()
    points = colmap.read_ply_points(scene.inside(ply), bad)
    some = points.points[:: max(1, len(points) // COMPARED_POINTS)]
    seen = np.zeros(len(some), bool)
    for view in views:
        seen[seen_pixels(view.camera, some)[0]] = True
    if not seen.mean() >= MIN_SHARE:
        where = "export cameras and points in the same coordinate system"
        return None, [f"the points of {ply.name} are left out: {seen.mean():.0%} of them are in some view; {where}"]
    return points, [f"points taken from {ply.name}", *(bad or [])]


# Metashape: File > Export > Export Cameras, Agisoft XML.


class _Builder(ElementTree.TreeBuilder):
    def doctype(self, *_: object) -> None:
        """Refuse a DTD, and with it all entities."""
        raise ValueError("it has a DOCTYPE, which Metashape does not write")


def _xml(path: Path) -> ElementTree.Element:
    """Return the root of an XML file of bounded size, without a DTD."""
    data = read_file(path, None, MAX_BYTES, "export the cameras again")
    with _understood(str(path)):
        if max(data.count(b"<"), data.count(b"=")) > MAX_PARTS:
            raise ValueError(f"it has more than {MAX_PARTS:,} parts")
        return ElementTree.fromstring(data, ElementTree.XMLParser(target=_Builder()))


def _numbers(element: ElementTree.Element | None, count: int) -> np.ndarray:
    """Return the numbers of an element, float64 [count]; ValueError if there are others."""
    if element is None:
        raise ValueError(f"it has no element with {count} numbers")
    values = np.array([float(word) for word in (element.text or "").split()])
    if len(values) != count or not np.isfinite(values).all():
        raise ValueError(f"<{element.tag[:40]}> needs {count} finite numbers")
    return values


def _similarity(transform: ElementTree.Element | None) -> tuple[np.ndarray, float, np.ndarray]:
    """Return rotation [3, 3], scale and translation [3] from the coordinates of a component to those of the file."""
    parts = {} if transform is None else {part.tag: part for part in transform}
    rotation = _numbers(parts["rotation"], 9).reshape(3, 3) if "rotation" in parts else np.eye(3)
    scale = float(_numbers(parts["scale"], 1)[0]) if "scale" in parts else 1.0
    if not scale > 0:
        raise ValueError(f"its scale is {scale}, not above 0")
    return rotation, scale, _numbers(parts["translation"], 3) if "translation" in parts else np.zeros(3)


def _sensor_lens(sensor: ElementTree.Element | None, where: str) -> Lens:
    """Return the lens of a sensor: u = width / 2 + cx + (f + b1) x' + b2 y', v = height / 2 + cy + f y'."""
    with _understood(where):
        found = {} if sensor is None else {c.get("class", "adjusted"): c for c in sensor.findall("calibration")}
        if not found:
            raise ValueError("it has no calibration; align the photographs")
        calibration = found.get("adjusted", next(iter(found.values())))
        size = calibration.find("resolution")
        if size is None:
            raise ValueError("its calibration has no resolution")
        width, height = int(size.get("width", "")), int(size.get("height", ""))
        terms = {
            term.tag: float(_numbers(term, 1)[0]) for term in calibration if term is not size and (term.text or "").strip()
        }
        f, b1 = terms["f"], terms.get("b1", 0.0)
    kind = calibration.get("type", "frame")
    fisheye = kind in ("fisheye", "equidistant_fisheye")
    if kind != "frame" and not fisheye:
        raise DataError(f"{where}: {kind[:40]} cameras are not supported; export frame cameras")
    lacking = [t for t in (("p1", "p2") if fisheye else ("k4",)) + ("p3", "p4") if terms.get(t)]
    if lacking or not abs(terms.get("b2", 0.0)) <= MAX_SKEW * abs(f):
        named = f"{lacking[0]} of a {kind} camera" if lacking else "the skew b2"
        fix = "fix it to 0 in Tools > Camera Calibration and optimize the cameras, or export undistorted photographs"
        raise DataError(f"{where}: {named} is not supported; {fix}")
    # Metashape's p1 is OpenCV's p2
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p2", "p1", "k3")
    center = width / 2 + terms.get("cx", 0.0), height / 2 + terms.get("cy", 0.0)
    return _lens((f + b1, f), center, (width, height), [terms.get(t, 0.0) for t in order], kind, fisheye, where)


def _lens(
    focal: tuple[float, float], center: tuple[float, float], size: tuple[int, int], distortion: list[float], model: str,
    fisheye: bool, where: str,
) -> Lens:  # fmt: skip
    """Return a checked lens, without zeros for coefficients."""
    K = np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1.0]])
    return Lens(K, *size, tuple(distortion) if any(distortion) or fisheye else (), model, fisheye).checked(where)


@register("metashape")
class MetashapeReader(CaptureReader):
    """Cameras as Agisoft XML; those that are not aligned, or disabled, are left out.

    Source: Agisoft Metashape Professional 2 User Manual, appendix "Camera models": x right, y down, z forward; the centre of
    the first pixel is (0.5, 0.5). A camera's transform leads to the coordinates of its component (of the chunk in older files),
    whose transform leads to those in which Metashape exports points.
    """

    description = "*.xml with photographs beside it or in images (Metashape)"
    priority = 60
    suffix = ".xml"

    def begins(self, head: str) -> bool:
        """See `CaptureReader.begins`."""
        return "<document" in head and "<chunk" in head

    def rows(self, path: Path) -> list[Posed]:
        """See `CaptureReader.rows`."""
        chunk = _xml(path).find("chunk")
        if chunk is None:
            raise DataError(f"{path}: has no chunk; export the cameras again, as Agisoft XML")
        sensors = {s.get("id"): s for s in chunk.iterfind("sensors/sensor")}
        places = {c.get("id"): c.find("transform") for c in chunk.iterfind("components/component")}
        lenses, moves, rows = dict[str | None, Lens](), dict[str | None, tuple](), list[Posed]()
        for camera in (c for part in chunk.iterfind("cameras") for c in part.iter("camera")):
            pose, sensor, component = camera.find("transform"), camera.get("sensor_id"), camera.get("component_id")
            if pose is None or camera.get("enabled", "1") in ("0", "false"):
                continue
            name = camera.get("label", "")
            where = f"{path}, camera {name[:80]!r}"
            if sensor not in lenses:
                lenses[sensor] = _sensor_lens(sensors.get(sensor), f"{path}, sensor {str(sensor)[:20]}")
            with _understood(where):
                if component not in moves:
                    place = places.get(component)
                    moves[component] = _similarity(chunk.find("transform") if place is None else place)
                matrix = _numbers(pose, 16).reshape(4, 4)
            rotation, scale, translation = moves[component]
            matrix[:3, 3] = scale * matmul(rotation, matrix[:3, 3]) + translation
            matrix[:3, :3] = matmul(rotation, matrix[:3, :3])
            rows.append((name, lenses[sensor], scenes.from_camera_to_world(matrix, where, opengl=False)))
        return rows


# RealityScan (RealityCapture): Export > Registration > Internal/External camera parameters, CSV.

COLUMNS = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
"""Columns that a file must have; the principal point and the distortion may be missing."""


def _header(cells: list[str]) -> list[str]:
    """Return the names of the columns in a line; [] for another line."""
    names = [cell.strip().lstrip("#").lower() for cell in cells]
    return names if set(COLUMNS) <= set(names) else []


def _film_lens(values: Mapping[str, float], where: str, width: int, height: int) -> Lens:
    """Return the lens of a row for an image of a size [px]; lengths are relative to the longer side."""
    side, focal = max(width, height), values["f"] * max(width, height) / 36
    center = width / 2 + side * values.get("px", 0.0), height / 2 + side * values.get("py", 0.0)
    # t1 is OpenCV's p2
    distortion = [values.get(t, 0.0) for t in ("k1", "k2", "t2", "t1", "k3")]
    return _lens((focal, focal), center, (width, height), distortion, "Brown", False, where)


def _turn(angle: float, axis: int) -> np.ndarray:
    """Return the rotation [3, 3] by an angle [deg] about a coordinate axis."""
    c, s, (i, j) = math.cos(math.radians(angle)), math.sin(math.radians(angle)), [(1, 2), (2, 0), (0, 1)][axis]
    R = np.eye(3)
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


@register("realityscan")
class RealityScanReader(CaptureReader):
    """Cameras as CSV "Internal/External camera parameters": position, angles [deg], focal length of 35 mm film [mm], lens.

    Sources: "RealityCapture XMP Camera Math" (Epic Games): lengths in the image are relative to its longer side, which is 36
    mm. Angles as in the readers of nerfstudio, Brush and Camera Painter: camera to world, x right, y up, z back, is
    Rz(-heading) Rx(pitch) Ry(roll), which agrees with the rotation in the XMP file of the same export. Order of t1 and t2 as in
    the importers of AliceVision and camorph: x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + t1 (r^2 + 2 x^2) + 2 t2 x y.
    """

    description = "*.csv with photographs beside it or in images (RealityScan, RealityCapture)"
    priority = 70
    suffix = ".csv"

    def begins(self, head: str) -> bool:
        """See `CaptureReader.begins`."""
        return any(_header(line.split(",")) for line in head.splitlines())

    def rows(self, path: Path) -> list[Posed]:
        """See `CaptureReader.rows`."""
        text = read_file(path, None, MAX_BYTES, "export the cameras again").decode("utf-8-sig", "surrogateescape")
        reader, header, rows = csv.reader(text.splitlines()), list[str](), list[Posed]()
        while True:
            where = f"{path}, line {reader.line_num + 1}"
            with _understood(where):
                cells = next(reader, None)
                if cells is None:
                    return rows
                if not header or not any(cells):
                    header = header or _header(cells)
                    continue
                row = dict(zip(header, cells, strict=True))
                name = row.pop("name").strip()
                values = {
                    key: float(row[key]) for key in row if key in (*COLUMNS, "px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
                }
                if not np.isfinite([*values.values()]).all():
                    raise ValueError("a number is not finite")
                R = matmul(_turn(-values["heading"], 2), matmul(_turn(values["pitch"], 0), _turn(values["roll"], 1)))
            if values.get("k4"):
                fix = "align with the distortion model Brown3 or Brown3 with tangential2, or export undistorted images"
                raise DataError(f"{where}: k4 is not supported; {fix}")
            pose = np.column_stack([R, [values["x"], values["y"], values["alt"]]])
            viewmat = scenes.from_camera_to_world(pose, where, opengl=True)
            rows.append((name, partial(_film_lens, values, f"{where}, image {name[:80]!r}"), viewmat))
