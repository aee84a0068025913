"""Scenes made in Python and by readers: every wrong field is named with its fix, by `fit`, `evaluate` and `load_scene`."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
import torch

import warpgs
from tests.io import scenes
from tests.scenes import ring, three_gaussians
from warpgs.errors import DataError, UsageError
from warpgs.io.folder import Probe, Reader
from warpgs.io.load import load_scene
from warpgs.scene import Camera, GivenDepth, Normalization, PointCloud, Scene, View, checked_scene, checked_views

W, H = 20, 12
RNG = np.random.default_rng(0)
MASK = np.ones((H, W), bool)
MASK[:2] = False
FACING = np.tile(np.float32([0, 0, -1]), (H, W, 1))
PIXELS = RNG.random((H, W, 3)).astype(np.float32)
POINTS = RNG.standard_normal((6, 3)) / 4
FLAT = np.ones((H, W), np.float32)


def right() -> Scene:
    views = [View(f"{n}.png", c, (PIXELS + i / 4) / 2) for i, (n, c) in enumerate(zip("abcd", ring(4, W, H)))]
    maps = {"score_mask": MASK, "alpha": FLAT, "depth": GivenDepth(2 * FLAT, confidence=FLAT), "normals": FACING}
    views[1] = dataclasses.replace(views[1], mask=MASK, **maps)
    points = PointCloud(POINTS, np.full((6, 3), 0.5, np.float32), (frozenset(["b.png", "c.png"]),) * 6)
    return Scene("memory", "made", tuple(views), points)


def changed(place: str, **fields) -> Scene:
    scene, replace = right(), dataclasses.replace
    if place == "scene":
        return replace(scene, **fields)
    if place == "points":
        return replace(scene, points=replace(scene.points, **fields))
    view = scene.views[1]
    if place == "view":
        view = replace(view, **fields)
    else:
        view = replace(view, **{place: replace(getattr(view, place), **fields)})
    return replace(scene, views=(scene.views[0], view, *scene.views[2:]))


def edited(matrix: str, at: object, value: object) -> Scene:
    array = getattr(right().views[1].camera, matrix).copy()
    array[at] = value
    return changed("camera", **{matrix: array})


def at_corner(array: np.ndarray, value: float) -> np.ndarray:
    array = array.copy()
    array.flat[0] = value
    return array


B = "view 'b.png': "
IN_VIEWS = {
    "image uint8": (changed("view", image=(255 * PIXELS).astype(np.uint8)), "image", "image.astype(np.float32) / 255"),
    "image uint16": (changed("view", image=(65535 * PIXELS).astype(np.uint16)), "image", "/ 65535"),
    "image 0..255": (changed("view", image=255 * PIXELS), "image", "/ 255"),
    "image overshoots": (changed("view", image=1.2 * PIXELS), "image", "np.clip(image, 0, 1)"),
    "image from -1 to 1": (changed("view", image=2 * PIXELS - 1), "image", "(image + 1) / 2"),
    "image with infinity": (changed("view", image=at_corner(PIXELS, np.inf)), "image", "np.nan_to_num(image"),
    "image of 4 channels": (changed("view", image=np.ones((H, W, 4), np.float32)), "image", "put channels last"),
    "image channels first": (changed("view", image=np.moveaxis(PIXELS, -1, 0)), "image", "put channels last"),
    "image gray": (changed("view", image=FLAT), "image", "put channels last"),
    "image batch": (changed("view", image=PIXELS[None]), "image", "without further axes"),
    "image of another size": (changed("view", image=PIXELS[:-2]), "image", f"resize it to the camera's {W} x {H} px"),
    "image bfloat16": (changed("view", image=torch.from_numpy(PIXELS).bfloat16()), "image", ".float()"),
    "image masked": (changed("view", image=np.ma.masked_array(PIXELS)), "image", "image.data, and its mask as View.mask"),
    "image None": (changed("view", image=None), "image", "give an array"),
    "mask of floats": (changed("view", mask=FLAT), "mask", "give mask > 0"),
    "mask of another size": (changed("view", mask=MASK[1:]), "mask", f"resize it to the camera's {W} x {H} px"),
    "mask empty": (changed("view", mask=~MASK & MASK), "mask", "give ~mask if it is inverted"),
    "alpha_estimated a map": (changed("view", alpha_estimated=FLAT), "alpha_estimated", "give True or False"),
    "depth an array": (changed("view", depth=FLAT), "depth", "give GivenDepth(depth)"),
    "depth in millimetres": (changed("depth", values=(1000 * FLAT).astype(np.uint16)), "depth.values", "in the unit"),
    "depth negative": (changed("depth", values=-FLAT), "depth.values", "np.maximum(depth.values, 0)"),
    "depth kind": (changed("depth", kind="inverse"), "depth.kind", "give metric, relative, disparity"),
    "normals as colours": (changed("view", normals=np.full((H, W, 3), 0.9, np.float32)), "normals", "decode colours first"),
    "normals in OpenGL axes": (changed("view", normals=-FACING), "normals", "np.float32([1, -1, -1])"),
    "normals uint8": (changed("view", normals=np.zeros((H, W, 3), np.uint8)), "normals", "give floats"),
    "camera None": (changed("view", camera=None), "camera", "Camera(viewmat, K, width, height)"),
    "width a float": (changed("camera", width=20.0), "camera.width", "give int(width)"),
    "height 0": (changed("camera", height=0), "camera.height", "at least 1"),
    "viewmat 3 x 4": (changed("camera", viewmat=np.eye(4)[:3]), "camera.viewmat", "above the row 0, 0, 0, 1"),
    "viewmat with NaN": (edited("viewmat", (0, 3), np.nan), "camera.viewmat", "estimate it again"),
    "viewmat transposed": (edited("viewmat", (3, 0), 2.2), "camera.viewmat", "viewmat.T"),
    "viewmat scaled": (edited("viewmat", slice(3), np.eye(4)[:3] * 3), "camera.viewmat", "divide its scale out"),
    "viewmat mirrored": (edited("viewmat", slice(3), np.diag([1, -1, 1, 1])[:3]), "camera.viewmat", "negate rows y and z"),
    "K with skew": (edited("K", (0, 1), 3), "camera.K", "[[fx, 0, cx], [0, fy, cy]"),
    "K normalised": (edited("K", (slice(2), slice(2)), np.eye(2) * 0.1), "camera.K", "by width (first row)"),
    "distortion of a pinhole": (changed("camera", distortion=np.zeros(4)), "camera.distortion", "model='opencv'"),
    "distortion too short": (changed("camera", model="opencv", distortion=np.zeros(4)), "camera.distortion", "np.zeros(8)"),
    "model None": (changed("camera", model=None), "camera.model", "'pinhole'"),
}  # fmt: skip
UNNAMED = {
    "name a number": (changed("view", name=3), "views[1].name", "give str(name)"),
    "name empty": (changed("view", name=""), "views[1].name", "such as 'a.png'"),
    "view an image": (changed("scene", views=(PIXELS,)), "views[0]", "give View(name, camera, image)"),
}
IN_SCENE = {
    "name twice": (changed("view", name="a.png"), "view 'a.png': name", "rename or remove one"),
    "views a dict": (changed("scene", views={"a": 1}), "scene.views", "give a tuple, (view, ...)"),
    "notes a text": (changed("scene", notes="made by hand"), "scene.notes", "give a tuple, (note, ...)"),
    "path None": (changed("scene", path=None), "scene.path", "give a str"),
    "points an array": (changed("scene", points=np.zeros((6, 3))), "scene.points", "give PointCloud(points, colors)"),
    "points with infinity": (changed("points", points=at_corner(POINTS, np.inf)), "scene.points.points", "not finite"),
    "colors too few": (changed("points", colors=np.ones((5, 3), np.float32)), "scene.points.colors", "for each point"),
    "tracks of stems": (changed("points", tracks=(frozenset(["a"]),) * 6), "scene.points.tracks", "a frozenset of view names"),
    "tracks of numbers": (changed("points", tracks=(1, 2, 3, 4, 5, 6)), "scene.points.tracks", "a frozenset of view names"),
    "background a name": (changed("scene", background="white"), "scene.background", "np.asarray(scene.background"),
    "normalization None": (changed("scene", normalization=None), "scene.normalization", "Normalization(offset, scale)"),
    "scale 0": (changed("scene", normalization=Normalization(scale=0.0)), "scene.normalization.scale", "or 1.0"),
    "offset a point": (changed("scene", normalization=Normalization(POINTS)), "scene.normalization.offset", "three numbers"),
}  # fmt: skip
WRONG = {k: (s, B + f, fix) for k, (s, f, fix) in IN_VIEWS.items()} | UNNAMED | IN_SCENE


class Given(Reader):
    """A reader of one's own that returns a given scene."""

    def __init__(self, scene: Scene):
        self.given = scene

    def probe(self, folder):
        return Probe("a scene")

    def read(self, folder, options):
        return self.given


def fitted(scene: Scene, **settings) -> warpgs.FitResult:
    settings = {"steps": 2, "init": {"source": "points"}, "device": "cpu", "verbose": False} | settings
    return warpgs.fit(scene, "3dgs", **settings)


WAYS = {
    "fit": lambda scene, folder: fitted(scene, out=folder / "run"),
    "evaluate": lambda scene, folder: warpgs.evaluate(three_gaussians(), scene.views),
    "reader": lambda scene, folder: load_scene(folder, reader=Given(scene)),
}
CASES = [(c, "fit") for c in WRONG] + [(c, way) for way in WAYS for c in ("image uint8", "K with skew", "view an image")]


@pytest.mark.parametrize("case,way", CASES, ids=lambda x: x)
def test_a_wrong_field_is_named_with_its_fix(case, way, tmp_path):
    scene, field, fix = WRONG[case]
    with pytest.raises(DataError) as e:
        WAYS[way](scene, tmp_path)
    assert f"{field} must be " in str(e.value) and fix in str(e.value).rpartition("; got ")[2]
    assert str(e.value).startswith(f"{tmp_path}, " if way == "reader" else field) and not (tmp_path / "run").exists()


@pytest.mark.parametrize("write", scenes.WRITERS.values(), ids=scenes.WRITERS)
def test_scenes_of_files_pass_as_the_same_object(write, tmp_path):
    scene = load_scene(write(tmp_path))
    assert checked_scene(scene) is scene


def frozen(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


def test_a_right_scene_passes_and_arguments_that_are_none_are_named():
    scene = right()
    camera = dataclasses.replace(scene.views[0].camera, K=np.float32(scene.views[0].camera.K), width=np.int64(W))
    lens = dataclasses.replace(camera, model="fisheye", distortion=np.zeros(4))
    fields = ({"image": frozen(PIXELS.copy())}, {"image": at_corner(PIXELS, 1.0005)}, {"camera": camera}, {"camera": lens})
    views = (*scene.views, *(dataclasses.replace(scene.views[0], name=f"{i}.png", **f) for i, f in enumerate(fields)))
    scene = dataclasses.replace(scene, views=views, background=(1, 1, 1))
    assert checked_scene(scene) is scene and all(map(lambda a, b: a is b, checked_views(views), views))
    scene = right()
    for views, fix in ((scene, "or scene.views"), (scene.views[0], r"give \[view\]"), (PIXELS, r"give \[view\]")):
        with pytest.raises(DataError, match=f"views must be a list of View; got .*{fix}"):
            warpgs.evaluate(three_gaussians(), views)
    assert warpgs.evaluate(three_gaussians(), []) == []
    with pytest.raises(UsageError, match=r"scene must be a Scene or a folder, not tuple; give Scene\("):
        warpgs.fit(scene.views)
    c = scene.views[1].camera  # of tensors, and views in another order
    camera = Camera(torch.from_numpy(c.viewmat).requires_grad_(), torch.from_numpy(c.K), W, H)
    views = (scene.views[3], dataclasses.replace(scene.views[1], camera=camera), scene.views[0], scene.views[2])
    other = dataclasses.replace(scene, views=views)
    assert fitted(other, split="every:4").metrics["test"]["psnr"] == fitted(scene, split="every:4").metrics["test"]["psnr"]


CONVERTED = {
    "float64": lambda a: a.astype(np.float64),
    "big-endian": lambda a: a.astype(a.dtype.newbyteorder(">")),
    "flipped": lambda a: a[::-1, ::-1].copy()[::-1, ::-1],
    "columns first": np.asfortranarray,
    "tensor": torch.from_numpy,
    "tensor with gradient": lambda a: torch.from_numpy(a.copy()).requires_grad_(),
}


@pytest.mark.parametrize("convert", CONVERTED.values(), ids=CONVERTED)
def test_other_arrays_of_the_same_values_score_and_fit_the_same(convert):
    scene = right()
    b, cloud, floats = scene.views[1], scene.points, ("image", "alpha", "normals")
    depth = GivenDepth(convert(b.depth.values), confidence=convert(b.depth.confidence))
    masks = {"mask": MASK[::-1].copy()[::-1], "score_mask": torch.from_numpy(MASK)}
    view = dataclasses.replace(b, **{n: convert(getattr(b, n)) for n in floats}, depth=depth, **masks)
    points = PointCloud(convert(cloud.points), convert(cloud.colors), cloud.tracks)
    other = dataclasses.replace(scene, views=[scene.views[0], view, *scene.views[2:]], points=points, background=np.zeros(3))
    assert repr(warpgs.evaluate(three_gaussians(), other.views)) == repr(warpgs.evaluate(three_gaussians(), scene.views))
    new = checked_scene(other)
    assert new.views[0] is scene.views[0] and isinstance(new.views, tuple) and new.background == scene.background
    for name in ("image", "mask", "score_mask", "alpha", "normals"):
        array, wanted = getattr(new.views[1], name), getattr(b, name)
        assert array.dtype == wanted.dtype and array.flags.c_contiguous and np.array_equal(array, wanted), name
    results = [fitted(s, split="every:4").gaussians().tensors() for s in (other, scene)]
    assert all(torch.equal(t, results[1][name]) for name, t in results[0].items())


DOUBTS = {
    "lens": (r"leaves few", r"leaves few pixels of 5 images, \d+% of images/photo"),
    "principal point": ("principal point", r"principal points of 5 views, as of .*photo0.png, are outside the image"),
    "size": ("size of their camera", r"5 images of 0.25 times the size of their camera"),
    "rotation": ("all cameras", r"all cameras are within .* units of one place, without depth"),
    "binary masks": ("0 and 1", r"1 image with a mask of the values 0 and 1, read as 0 and 255"),
    "empty mask": ("keep no", r"masks that keep no pixel, so that their views are left out .*--mask-keeps.*photo1.png \(1\)"),
    "equal": ("equal pixels", r"2 of 5 photographs have equal pixels, as .*photo0.png and .*photo1.png"),
    "blank": ("single colour", r"1 of 5 photographs have a single colour, such as .*photo1.png; --exclude them"),
    "one other pixel": ("no such words", ""),
    "none": ("no such words", ""),
}
"""Words of the note of each case that no other case has, and the whole note."""


def doubtful(case: str, root) -> Scene:
    values = scenes.transforms_json()
    if case == "lens":
        values |= {"k1": -9.0, "k2": 0.0}
    elif case == "principal point":
        values |= {"cx": 40.0}
    elif case == "size":
        values |= {key: 4 * values[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    elif case == "rotation":
        for frame in values["frames"]:
            frame["transform_matrix"] = [[*row[:3], 1.0] for row in frame["transform_matrix"][:3]] + [[0, 0, 0, 1.0]]
    scenes.write_transforms(root, values)
    mask = np.zeros((scenes.HEIGHT, scenes.WIDTH), np.uint8)
    mask[:, :8] = case == "binary masks"
    if "mask" in case:
        scenes.save(root / "masks" / "photo1.png", mask)
    if case == "blank":
        scenes.save(root / "images" / scenes.NAMES[1], np.full_like(scenes.image(0), (200, 30, 10)))
    if case in ("equal", "one other pixel"):
        pixels = scenes.image(0)
        pixels[5, 7] ^= case != "equal"
        scenes.save(root / "images" / scenes.NAMES[1], pixels)
    return load_scene(root)


@pytest.mark.parametrize("case", DOUBTS)
def test_doubtful_data_are_a_note_with_the_number(case, tmp_path):
    scene = doubtful(case, tmp_path)
    assert any(re.search(DOUBTS[case][1], n) for n in (*scene.notes, "")), scene.notes
    assert not any(own in n for n in scene.notes for name, (own, _) in DOUBTS.items() if name != case), scene.notes
    assert len(scene.views) == (4 if case == "empty mask" else 5)
    assert case != "binary masks" or next(v for v in scene.views if v.name.endswith("photo1.png")).mask.mean() == 0.5
