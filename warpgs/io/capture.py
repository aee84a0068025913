"""Scenes as Metashape and RealityScan export them: a file of cameras, the photographs, and a PLY file of points beside it."""

import abc
import contextlib
import csv
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import ClassVar
from xml.etree import ElementTree

import numpy as np

from warpgs.errors import DataError, expect
from warpgs.files import read_file, read_start
from warpgs.geometry import matmul, seen_pixels
from warpgs.io import colmap, folder as scenes
from warpgs.io.colmap import Posed, understood
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
FIX = "export the cameras again"


class CaptureReader(Reader):
    """What the readers of this file share: the choice of the file, the photographs and the points."""

    suffix: ClassVar[str]
    """Suffix of the file of cameras."""
    marks: ClassVar[tuple[str, ...]]
    """Words that are at the beginning of such a file."""

    @abc.abstractmethod
    def rows(self, path: Path) -> list[Posed]:
        """Return the cameras of a file, in file units."""

    def files(self, folder: Path) -> list[Path]:
        """Return the files of cameras of a folder, sorted."""
        found = []
        for path in (p for p in sorted(folder.glob("[!.]*")) if p.suffix.lower() == self.suffix):
            with contextlib.suppress(OSError):  # a pipe, a folder: none
                head = read_start(path, HEAD_BYTES)
                found += [path] * all(mark.encode() in head for mark in self.marks)
        return found

    def probe(self, folder: Path) -> Probe | None:
        """See `Reader.probe`."""
        if not (files := self.files(folder)):
            return None
        return Probe(files[0].name, "" if colmap.image_base(folder, folder) else "its photographs, beside it or in images")

    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """See `Reader.read`."""
        path, *others = self.files(folder)
        notes = [f"cameras taken from {path.name}; {', '.join(p.name for p in others)} ignored"] if others else []
        scene, views = SceneFolder(folder, options), ViewList(options)
        rows = self.rows(scene.inside(path))
        base = colmap.image_base(folder, folder) or "images"
        _, found = colmap.add_views(scene, views, base, path, [name for name, *_ in rows], rows, labels=True)
        points, said = _points(scene, path, views.views)
        return self.scene(folder, views.views, notes + found + said, points=points, pixels=scene.pixel_source(by_folder=True))


def _points(scene: SceneFolder, path: Path, views: list[View]) -> tuple[PointCloud | None, list[str]]:
    """Return the points of the PLY file beside a file of cameras, and notes; None if they lie outside all views."""
    files = sorted(p for p in scene.root.glob("[!.]*") if p.suffix.lower() == ".ply" and p.is_file())
    if not files:
        return None, [f"no PLY file is beside {path.name}, so there are no points to start from"]
    ply = next((p for p in files if p.stem == path.stem), files[0])
    bad = None if scene.options.strict else list[str]()
    points = colmap.read_ply_points(scene.inside(ply), bad)
    some = points.points[:: max(1, len(points) // COMPARED_POINTS)]
    seen = {i for view in views for i in seen_pixels(view.camera, some)[0].tolist()}
    if len(seen) < MIN_SHARE * len(some):
        return None, [f"the points of {ply.name} are left out, as few are in a view; export both in one coordinate system"]
    return points, [f"points taken from {ply.name}", *(bad or [])]


def _lens(
    focal: float, wider: float, center: list[float], size: tuple[int, int], terms: list[float], model: str, where: str
) -> Lens:
    """Return a lens of focal lengths ``focal + wider`` and ``focal``, and a principal point from the middle [px]."""
    (cx, cy), (width, height), fisheye = center, size, model == "fisheye"
    K = np.array([[focal + wider, 0, width / 2 + cx], [0, focal, height / 2 + cy], [0, 0, 1.0]])
    return Lens(K, width, height, tuple(terms) if any(terms) or fisheye else (), model, fisheye).checked(where)


# Metashape: File > Export > Export Cameras, Agisoft XML.


class _Builder(ElementTree.TreeBuilder):
    def doctype(self, *_: object) -> None:
        """Refuse a DTD, and with it all entities."""
        raise ValueError("it has a DOCTYPE, which Metashape does not write")


def _xml(path: Path) -> ElementTree.Element:
    """Return the root of an XML file of bounded size, without a DTD."""
    data = read_file(path, None, MAX_BYTES, FIX)
    with understood(str(path), ElementTree.ParseError):
        expect(max(data.count(b"<"), data.count(b"=")) <= MAX_PARTS, f"it has more than {MAX_PARTS:,} parts")
        return ElementTree.fromstring(data, ElementTree.XMLParser(target=_Builder()))


def _numbers(parent: ElementTree.Element | None, tag: str, default: list[float]) -> np.ndarray:
    """Return the numbers of the part with this tag, float64, as many as the ``default``, which stands for a missing part."""
    values = np.array([float(word) for word in (parent.findtext(tag) or "").split()] if parent is not None else [])
    values = values if len(values) else np.array(default)
    expect(len(values) == len(default) and np.isfinite(values).all(), f"<{tag}> needs {len(default)} finite numbers")
    return values


def _sensor_lens(sensor: ElementTree.Element | None, where: str) -> Lens:
    """Return the lens of a sensor: u = width / 2 + cx + (f + b1) x' + b2 y', v = height / 2 + cy + f y'."""
    with understood(where):
        found = {} if sensor is None else {c.get("class", "adjusted"): c for c in sensor.findall("calibration")}
        expect(found, "it has no calibration; align the photographs")
        calibration = found.get("adjusted", next(iter(found.values())))
        side = {} if (size := calibration.find("resolution")) is None else size.attrib
        names = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
        terms = {name: float(_numbers(calibration, name, [0.0])[0]) for name in names}
        resolution = int(side["width"]), int(side["height"])
    kind = calibration.get("type", "frame").removeprefix("equidistant_")
    others = {"frame": ("k4", "p3", "p4"), "fisheye": ("p1", "p2", "p3", "p4")}.get(kind)
    if others is None:
        raise DataError(f"{where}: {kind[:40]} cameras are not supported; export frame cameras")
    if lacking := [t for t in others if terms[t]] + ["b2"] * (not abs(terms["b2"]) <= MAX_SKEW * abs(terms["f"])):
        raise DataError(f"{where}: {lacking[0]} of a {kind} camera is not supported; fix it to 0, or export undistorted images")
    # Metashape's p1 is OpenCV's p2
    order = ("k1", "k2", "k3", "k4") if kind == "fisheye" else ("k1", "k2", "p2", "p1", "k3")
    return _lens(terms["f"], terms["b1"], [terms["cx"], terms["cy"]], resolution, [terms[t] for t in order], kind, where)


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
    marks = ("<document", "<chunk")

    def rows(self, path: Path) -> list[Posed]:
        """See `CaptureReader.rows`."""
        chunks = [c for c in _xml(path).iterfind("chunk") if c.find("cameras//transform") is not None]
        if len(chunks) != 1:
            raise DataError(f"{path}: has {len(chunks)} chunks with aligned cameras, not one; {FIX}, as Agisoft XML")
        chunk = chunks[0]
        sensors = {s.get("id"): s for s in chunk.iterfind("sensors/sensor")}
        places = {c.get("id"): c.find("transform") for c in chunk.iterfind("components/component")}
        lenses, rows = dict[str | None, Lens](), list[Posed]()
        for camera in (c for part in chunk.iterfind("cameras") for c in part.iter("camera")):
            name, sensor = camera.get("label", ""), camera.get("sensor_id")
            if camera.find("transform") is None or camera.get("enabled", "1") in ("0", "false"):
                continue
            if sensor not in lenses:
                lenses[sensor] = _sensor_lens(sensors.get(sensor), f"{path}, sensor {str(sensor)[:20]}")
            where = f"{path}, camera {name[:80]!r}"
            with understood(where):
                pose = _numbers(camera, "transform", [np.nan] * 16).reshape(4, 4)
                place = places.get(camera.get("component_id"))
                place = chunk.find("transform") if place is None else place
                rotation = _numbers(place, "rotation", [1, 0, 0, 0, 1, 0, 0, 0, 1]).reshape(3, 3)
                scale, translation = _numbers(place, "scale", [1])[0], _numbers(place, "translation", [0, 0, 0])
                expect(scale > 0, f"its scale is {scale}, not above 0")
            pose[:3, 3] = scale * matmul(rotation, pose[:3, 3]) + translation
            pose[:3, :3] = matmul(rotation, pose[:3, :3])
            rows.append((name, lenses[sensor], scenes.from_camera_to_world(pose, where, opengl=False)))
        return rows


# RealityScan (RealityCapture): Export > Registration > Internal/External camera parameters, CSV.

COLUMNS = ("x", "y", "alt", "heading", "pitch", "roll", "f")
"""Columns of numbers that a file must have."""
LENS = ("px", "py", "k1", "k2", "t2", "t1", "k3")
"""Columns that may be missing: the principal point, then the coefficients in OpenCV's order, in which t1 is p2."""


def _film_lens(values: Mapping[str, float], where: str, width: int, height: int) -> Lens:
    """Return the lens of a row for an image of a size [px]; lengths are relative to the longer side."""
    side = max(width, height)
    x, y, *terms = (values.get(name, 0.0) for name in LENS)
    return _lens(values["f"] * side / 36, 0, [side * x, side * y], (width, height), terms, "Brown", where)


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
    marks = ("name,", *(f",{name}" for name in COLUMNS))

    def rows(self, path: Path) -> list[Posed]:
        """See `CaptureReader.rows`."""
        from scipy.spatial.transform import Rotation

        text = read_file(path, None, MAX_BYTES, FIX).decode("utf-8-sig", "surrogateescape")
        reader, header, rows = csv.reader(text.splitlines()), list[str](), list[Posed]()
        while True:
            where = f"{path}, line {reader.line_num + 1}"
            with understood(where, csv.Error):
                if (cells := next(reader, None)) is None:
                    return rows
                if not (header and any(cells)) or cells[0].startswith("#"):  # "#cameras 5", then the names of the columns
                    header = [cell.strip().lstrip("#") for cell in cells]
                    continue
                row = dict(zip(header, cells, strict=True))
                values = {key: float(row[key]) for key in (*COLUMNS, *LENS, "k4") if key in row or key in COLUMNS}
                angles = -values["heading"], values["pitch"], values["roll"]
                name, R = row["name"].strip(), Rotation.from_euler("ZXY", angles, degrees=True).as_matrix()
            if values.get("k4"):
                raise DataError(f"{where}: k4 is not supported; align with the model Brown3, or export undistorted images")
            pose = np.column_stack([R, [values["x"], values["y"], values["alt"]]])
            viewmat = scenes.from_camera_to_world(pose, where, opengl=True)
            rows.append((name, partial(_film_lens, values, f"{where}, image {name[:80]!r}"), viewmat))
