"""Images: decoded whole or not at all, upright, undistorted and resized with their cameras; formats that cannot be read."""

import dataclasses
import io
import struct
import warnings
import zlib
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest
from PIL import Image, ImageFile, ImageOps

from tests.faults.image_targets import big_tiled, chunk, gray_png, interlaced
from tests.io import scenes
from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.io import image_files
from warpgs.io.image_files import decode
from warpgs.io.images import Lens, ReadOptions, list_images, load_image
from warpgs.io.load import fingerprint, load_scene
from warpgs.poses.photographs import prepare, write_copy

# Decoding, orientation, masks, undistortion and resizing, each with the camera in step.


MASK = np.tile(np.array([0, *[255] * 3], np.uint8).repeat(4), (12, 1))
"""A mask of the test image whose left quarter is black."""


def lens(width, height, focal=20.0, distortion=(), model="PINHOLE"):
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Lens(K, width, height, distortion, model)


def smooth(x, y):
    return np.stack([0.5 + 0.4 * np.sin(x / 9), 0.5 + 0.4 * np.cos(y / 7), 0.5 + 0.3 * np.sin((x + y) / 11)], axis=-1)


def grid(width, height):
    return np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA", "P", "1", "I;16"])
def test_every_kind_of_png_is_decoded(mode, tmp_path):
    rgb = scenes.image(1)
    if mode == "I;16":
        image = Image.fromarray(rgb[..., 0].astype(np.uint16) * 257)
    else:
        image = Image.fromarray(rgb).quantize(256) if mode == "P" else Image.fromarray(rgb).convert(mode)
    path = tmp_path / "ä.png"
    image.save(path)
    color, alpha = decode(path)
    assert color.shape == (12, 16, 3) and color.dtype == np.float32
    assert (alpha is not None) == (mode in ("RGBA", "LA"))
    expected = rgb[..., :1].repeat(3, 2) / 255 if mode == "I;16" else np.array(image.convert("RGB")) / 255
    np.testing.assert_allclose(color, expected, atol=1e-6)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "BMP", "TIFF", "WEBP", "AVIF"])
def test_truncated_images_are_named(kind, tmp_path):
    path, data = tmp_path / f"a.{kind.lower()}", encoded(kind)
    for kept in (0.0, 0.02, 0.5, 0.9, 0.999):
        path.write_bytes(data[: int(kept * len(data))])
        with pytest.raises(DataError, match=rf"{path.name}: the image cannot be decoded: \w.*Restore"):
            decode(path)
    Image.fromarray(np.full((8, 8), np.nan, np.float32)).save(tmp_path / "nan.tiff")
    for name, words in (("gone.png", "the image cannot be read .*; restore"), ("nan.tiff", "some pixels are not finite")):
        with pytest.raises(DataError, match=f"{name}: {words}"):
            decode(tmp_path / name)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_turns_only_what_fits_turned(orientation, tmp_path):
    """A raster that fits its camera as it is stored is never turned."""
    exif = Image.Exif()
    exif[0x112] = orientation
    path = tmp_path / "a.png"
    Image.fromarray(scenes.image(0)).save(path, exif=exif)
    loaded = load_image(path, lens(16, 12), ReadOptions())
    np.testing.assert_allclose(loaded.image, scenes.image(0) / 255, atol=1e-6)
    assert loaded.done == ()
    mask = np.arange(12 * 16).reshape(12, 16) % 3 > 0
    if orientation < 5:
        with pytest.raises(DataError, match=r"a.png: the image is 16 x 12 px, its camera 12 x 16.*Give the images"):
            load_image(path, lens(12, 16), ReadOptions())
        return
    loaded = load_image(path, lens(12, 16), ReadOptions(), mask=mask)
    np.testing.assert_allclose(loaded.image, np.array(ImageOps.exif_transpose(Image.open(path))) / 255, atol=1e-6)
    stored = Image.fromarray(mask.astype(np.uint8) * 255)
    stored.getexif()[0x112] = orientation
    assert (loaded.mask == (np.array(ImageOps.exif_transpose(stored)) > 0)).all()
    assert "rotated by the EXIF orientation" in loaded.done


def test_sizes_within_a_pixel_lenses_that_fold_back_and_alpha_of_a_lens(tmp_path):
    path = tmp_path / "a.png"
    scenes.save(path, scenes.image(0, 33, 25))  # a half of 65 x 49, rounded up
    K = load_image(path, lens(65, 49, 40.0), ReadOptions()).K
    np.testing.assert_allclose(K[[0, 1, 0, 1], [0, 1, 2, 2]], [40 * 33 / 65, 40 * 25 / 49, 16.5, 12.5])
    with pytest.raises(DataError, match=r"a.png: the image is 33 x 25 px, its camera 60 x 60: the aspects differ"):
        load_image(path, lens(60, 60), ReadOptions())
    # a lens that folds back is masked there
    scenes.save(tmp_path / "a.png", scenes.image(0, 64, 48))
    loaded = load_image(tmp_path / "a.png", lens(64, 48, 30.0, (-0.5, 0.0, 0.0, 0.0), "RADIAL"), ReadOptions())
    x, y = grid(64, 48)
    radius2 = ((x - 32) / 30) ** 2 + ((y - 24) / 30) ** 2
    assert not loaded.mask[radius2 > 1 / 1.5].any() and loaded.mask[radius2 < 0.6].all()
    # alpha is freed of distortion with its image: white where opaque, so that over black every channel is the alpha
    image = np.full((48, 64, 4), 255, np.uint8)
    image[..., 3] = np.tile((np.arange(64) % 8 < 4) * 255, (48, 1))
    scenes.save(tmp_path / "a.png", image)
    loaded = load_image(tmp_path / "a.png", lens(64, 48, 60.0, (0.3, 0.0, 0.0, 0.0)), ReadOptions(downscale=2))
    np.testing.assert_allclose(loaded.image, loaded.alpha[..., None].repeat(3, 2), atol=1e-6)
    straight = load_image(tmp_path / "a.png", lens(64, 48, 60.0), ReadOptions(downscale=2))
    assert np.abs(straight.alpha - loaded.alpha)[0].max() > 0.5 and loaded.mask is not None


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_resampling_is_an_area_mean_with_exact_intrinsics(factor, tmp_path):
    path = tmp_path / "a.png"
    rgb = np.random.default_rng(1).integers(0, 256, (24, 36, 3), np.uint8)
    scenes.save(path, rgb)
    loaded = load_image(path, lens(36, 24, 30.0), ReadOptions(downscale=factor))
    mean = rgb.reshape(24 // factor, factor, 36 // factor, factor, 3).mean(axis=(1, 3)) / 255
    np.testing.assert_allclose(loaded.image, mean, atol=1e-5)
    np.testing.assert_allclose(loaded.K[[0, 1, 0, 1], [0, 1, 2, 2]], np.array([30, 30, 18, 12]) / factor)


@pytest.mark.parametrize(
    "downscale,side,size", [(1, 17, (17, 13)), (2, 17, (17, 13)), (2, 18, (18, 13)), (3, 0, (12, 9)), (1, 0, (35, 26))]
)
def test_a_factor_and_a_longest_side_scale_each_axis_of_the_camera(downscale, side, size, tmp_path):
    """The side holds after the factor; an image within it is untouched by it, and nothing is said."""
    scenes.save(tmp_path / "a.png", scenes.image(0, 35, 26))
    loaded = load_image(tmp_path / "a.png", lens(35, 26), ReadOptions(downscale=downscale, max_side=side))
    assert loaded.image.shape == (*size[::-1], 3)
    np.testing.assert_allclose(
        loaded.K[[0, 1, 0, 1], [0, 1, 2, 2]], [20 * size[0] / 35, 20 * size[1] / 26, *np.array(size) / 2]
    )
    assert any("17 px on the longer side; change it with --max-side" in d for d in loaded.done) == (side == 17)
    for wrong, flag in (({"max_side": 4}, "--max-side 4 leaves 4 x 3"), ({"downscale": 9}, "--downscale 9 leaves 4 x 3")):
        with pytest.raises(UsageError, match=rf"{flag} px of .*a\.png.*keep at least 4 px of both"):
            load_image(tmp_path / "a.png", lens(35, 26), ReadOptions(**wrong))


def distort(x, y, k1, k2, p1, p2, k3=0.0):
    """Apply OpenCV's model, written anew, from image plane to image plane."""
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@pytest.mark.parametrize("terms", [(0.1, 0, 0, 0), (-0.15, 0.04, 0, 0), (0.05, -0.02, 0.004, -0.006), (0.1, 0.02, 0, 0, 0.05)])
def test_undistortion_agrees_with_the_analytic_image(terms, tmp_path):
    width, height, f, cx, cy = 64, 48, 50.0, 30.0, 26.0
    K = np.array([[f, 0, cx], [0, f, cy], [0, 0, 1.0]])
    # invert the model by fixed-point iteration: the image shows at its pixel what a pinhole shows at the ideal one
    u, v = grid(width, height)
    xd, yd = (u - cx) / f, (v - cy) / f
    x, y = xd, yd
    for _ in range(100):
        dx, dy = distort(x, y, *terms)
        x, y = x - (dx - xd), y - (dy - yd)
    path = tmp_path / "a.png"
    scenes.save(path, np.round(65535 * smooth(f * x + cx, f * y + cy)).astype(np.uint16))
    loaded = load_image(path, Lens(K, width, height, tuple(terms), "OPENCV"), ReadOptions())
    mask = np.ones((height, width), bool) if loaded.mask is None else loaded.mask
    du, dv = distort((u - cx) / f, (v - cy) / f, *terms)
    du, dv = f * du + cx, f * dv + cy
    np.testing.assert_array_equal(mask, (du >= 0) & (du <= width) & (dv >= 0) & (dv <= height))
    # in the outer half pixel the image can only be continued; elsewhere interpolation costs 0.003, and half a pixel of a
    # wrong convention would cost 0.02
    inner = (du >= 0.5) & (du <= width - 0.5) & (dv >= 0.5) & (dv <= height - 0.5)
    assert np.abs(loaded.image - smooth(u, v))[inner].max() < 0.004
    np.testing.assert_array_equal(loaded.K, K)
    assert loaded.done == ("undistorted (OPENCV)",)
    if terms[0] > 0.08:  # pincushion: the corners of the pinhole lie outside the loaded
        assert not mask[0, 0] and mask[24, 32]


@pytest.mark.parametrize("name", ["photo0.png", "photo0.png.png"])
@pytest.mark.parametrize("keeps", ["white", "black"])
def test_masks_folder(name, keeps, tmp_path):
    scenes.write_colmap(tmp_path)
    scenes.save(tmp_path / "masks" / name, MASK)
    scene = load_scene(tmp_path, mask_keeps=keeps)
    assert (scene.views[0].mask == ((MASK > 0) == (keeps == "white"))).all() and scene.views[1].mask is None
    assert "1 image masked by a mask file" in scene.notes
    kept = f"masks keep {'75.0%' if keeps == 'white' else '25.0%'} of the pixels, the {keeps} ones (--mask-keeps {keeps})"
    assert f"{kept}; the others are ignored (--masks ignore)" in scene.notes
    half = load_scene(tmp_path, downscale=2, mask_keeps=keeps).views[0].mask
    assert (half == ((MASK[::2, ::2] > 0) == (keeps == "white"))).all()


ENDS = [".jpg", "_mask.png", ".mask.png", ".png.mask.png", "-mask.tif", ".JPG_mask.png"]


@pytest.mark.parametrize("name", ["PHOTO0.PNG", *(f"photo0{end}" for end in ENDS)])
def test_masks_by_the_names_of_other_programs(name, tmp_path):
    """An exact name comes first, two files for one image are none, and an image may itself be called a mask."""
    scenes.write_colmap(tmp_path, names=("photo0.png", "face_mask.png", "c.png", "d.png", "e.png"))
    scenes.save(tmp_path / "masks" / name, MASK)
    views = {v.name: v for v in load_scene(tmp_path).views}
    kept = views["photo0.png"].mask
    assert kept is not None and np.abs(kept.astype(int) - (MASK > 0)).sum() <= 12 and views["face_mask.png"].mask is None
    for other in ("face_mask.PNG", "c.tif", "c_mask.png"):
        scenes.save(tmp_path / "masks" / other, MASK)
    scenes.save(tmp_path / "masks" / "photo0.png", np.full_like(MASK, 255))
    scene = load_scene(tmp_path)
    assert [v.name for v in scene.views if v.mask is not None and not v.mask.all()] == ["face_mask.png"]
    assert [n for n in scene.notes if "masks" in n and "match" in n] == [
        "2 of 5 files in masks, such as c.tif, match no image or several; name a mask like its image: c.png"
    ]


@pytest.mark.parametrize("folder", ["Masks", "mask", "images/masks"])
@pytest.mark.parametrize("write", [scenes.write_colmap, scenes.write_transforms, scenes.write_llff])
def test_masks_that_are_not_read_are_a_note(write, folder, tmp_path):
    write(tmp_path)
    notes = load_scene(tmp_path).notes
    assert not any("mask" in n for n in notes)
    scenes.save(tmp_path / folder / "photo0.png", np.full((12, 16), 255, np.uint8))
    if write is not scenes.write_llff or folder != "images/masks":  # there it is one image too many
        assert f"the folder {folder} is not read; masks are read from masks" in load_scene(tmp_path).notes
    if folder == "Masks":  # two spellings of one folder, as on macOS
        scenes.link(tmp_path / "masks", tmp_path / "Masks")
        assert not any("is not read" in n for n in load_scene(tmp_path).notes)


def test_a_mask_with_the_suffix_of_its_photograph_is_of_no_other(tmp_path):
    scenes.write_colmap(tmp_path, names=("a.png", "a.jpg", "b.png", "b.JPG", "c.png"))
    for name, gray in (("a.jpg.png", 0), ("a.png", 255), ("B.jpg_mask.png", 0), ("c.jpg.png", 0)):
        scenes.save(tmp_path / "masks" / name, np.tile(np.array([gray, 255], np.uint8).repeat(8), (12, 1)))
    scene = load_scene(tmp_path)
    kept = {v.name: v.mask is not None and not v.mask.all() for v in scene.views}
    assert kept == {"a.jpg": True, "a.png": False, "b.JPG": True, "b.png": False, "c.png": True}
    assert not any("match no image" in n for n in scene.notes)
    scenes.write_middlebury(tmp_path / "scene")  # whose masks lie in its own folder
    scenes.save(tmp_path / "scene" / "masks" / "photo1.png", MASK)
    scenes.save(tmp_path / "masks" / "photo0.png", MASK)  # of the scene beside it
    views = load_scene(tmp_path / "scene").views
    assert views[0].mask is None and not views[1].mask[:, 0].any()


@pytest.mark.parametrize(
    "focal, distortion, downscale", [(20.0, (), 2), (60.0, (0.3, 0.0, 0.0, 0.0), 1), (60.0, (0.3, 0.0, 0.0, 0.0), 2)]
)
@pytest.mark.parametrize("alpha", [False, True])
def test_masked_pixels_do_not_run_into_others(focal, distortion, downscale, alpha, tmp_path):
    """Where an image is resampled, a pixel that is kept has the colours of unmasked pixels alone."""
    mask = np.ones((48, 64), bool)
    mask[9:30, 21:44] = False
    for name, junk in (("black", 0), ("noise", np.random.default_rng(0).integers(0, 256, (48, 64, 4)))):
        pixels = np.where(mask[..., None], np.full(4, 153), junk).astype(np.uint8)
        Image.fromarray(pixels if alpha else pixels[..., :3].copy()).save(tmp_path / f"{name}.png")
    options, of_lens = ReadOptions(downscale=downscale), lens(64, 48, focal, distortion)
    black, noise = (load_image(tmp_path / f"{n}.png", of_lens, options, mask=mask) for n in ("black", "noise"))
    assert black.mask is not None and np.array_equal(black.mask, noise.mask) and not black.mask.all()
    assert np.array_equal(black.image[black.mask], noise.image[black.mask])
    assert np.ptp(black.image[black.mask]) < 1e-6
    assert (black.alpha is not None) is alpha and (
        not alpha or np.array_equal(black.alpha[black.mask], noise.alpha[black.mask])
    )


def rgba(i, alpha):
    return np.concatenate([scenes.image(i), alpha[..., None]], axis=2)


@pytest.mark.parametrize("write", [scenes.write_colmap, scenes.write_transforms, scenes.write_llff])
def test_alpha_arrives_in_every_format(write, tmp_path):
    """Straight colours come multiplied, over black; an alpha of one everywhere is an opaque image."""
    write(tmp_path)
    alpha = np.full((12, 16), 255, np.uint8)
    scenes.save(tmp_path / "images" / "photo1.png", rgba(1, alpha))
    alpha[:, :4], alpha[0] = 100, 0
    for i in (0, 2, 3):
        scenes.save(tmp_path / "images" / f"photo{i}.png", rgba(i, alpha))
    scene = load_scene(tmp_path)
    first, second, *_ = scene.views
    np.testing.assert_allclose(first.alpha, alpha / 255, atol=1e-6)
    np.testing.assert_allclose(first.image, scenes.image(0) / 255 * (alpha / 255)[..., None], atol=1e-6)
    assert first.alpha.dtype == np.float32 and first.mask is None and scene.background == (0, 0, 0)
    assert second.alpha is None and "3 images transparent in part, by the alpha channel" in scene.notes
    opaque = f"{len(scene.views) - 3} of {len(scene.views)} images have no transparent pixel, and count as opaque everywhere"
    assert opaque in scene.notes
    other = first.alpha.copy()
    other[3, 3] = 0.25
    assert fingerprint([first]) != fingerprint([dataclasses.replace(first, alpha=other)])


@pytest.mark.parametrize(("count", "clear", "object_"), [(1, 6, False), (5, 1, False), (5, 6, True), (2, 10, False)])
def test_a_few_transparent_pixels_are_masked_and_make_no_object(count, clear, object_, tmp_path):
    """A speck in one photograph, or one cut-out photograph among others, does not change how the scene is fitted."""
    scenes.write_transforms(tmp_path)
    alpha = np.full((12, 16), 255, np.uint8)
    alpha[2 : 2 + clear, 1], alpha[2, 2] = 0, 128
    for i in range(count):
        scenes.save(tmp_path / "images" / f"photo{i}.png", rgba(i, alpha))
    scene = load_scene(tmp_path)
    first, share = scene.views[0], count / len(scene.views) * (clear + 127 / 255) / 192
    note = f"without a cut-out object: transparent pixels, {share:.2%} of all, do not count, like masked ones"
    assert len(scene.views) == 5 and (first.alpha is not None) is object_ and any(note in n for n in scene.notes) is not object_
    if not object_:
        np.testing.assert_array_equal(first.mask, alpha == 255)
        np.testing.assert_allclose(first.image[first.mask], scenes.image(0)[first.mask] / 255, atol=1e-6)
        assert not any("count as opaque" in note for note in scene.notes)


def test_images_that_are_hardly_transparent_keep_their_pixels(tmp_path):
    """As a lossy encoder leaves an alpha of 253 everywhere; one that is wholly transparent among opaque ones is left out."""
    scenes.write_transforms(tmp_path)
    for i in range(4):
        scenes.save(tmp_path / "images" / f"photo{i}.png", rgba(i, np.full((12, 16), 253, np.uint8)))
    scene = load_scene(tmp_path)
    assert len(scene.views) == 5 and all(v.alpha is None and (v.mask is None or v.mask.all()) for v in scene.views)
    for i in range(4):
        scenes.save(tmp_path / "images" / f"photo{i}.png", rgba(i, np.full((12, 16), 255 * (i > 0), np.uint8)))
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4 and all(v.alpha is None and v.mask is None for v in scene.views)
    assert "1 image wholly transparent, showing nothing" in scene.notes


@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 0.5, 0.25)])
def test_transparent_colours_do_not_run_into_others(background, tmp_path):
    """Resampling is a mean over what can be seen: the red of transparent pixels leaves no trace."""
    image = np.zeros((8, 12, 4), np.uint8)
    image[...] = 255, 0, 0, 0
    image[:, 5:] = 40, 80, 120, 255
    scenes.save(tmp_path / "a.png", image)
    loaded = load_image(tmp_path / "a.png", lens(12, 8), ReadOptions(downscale=2), background=background)
    alpha = np.tile(np.float32([0, 0, 0.5, 1, 1, 1]), (4, 1))
    np.testing.assert_allclose(loaded.alpha, alpha, atol=1e-6)
    expected = alpha[..., None] * np.array([40, 80, 120]) / 255 + (1 - alpha[..., None]) * background
    np.testing.assert_allclose(loaded.image, expected, atol=1e-6)


def test_masks_cut_out(tmp_path):
    """Gray is transparent in part; an alpha channel counts too; masks that keep nothing or everything are named."""
    scenes.write_colmap(tmp_path)
    mask = np.full((12, 16), 255, np.uint8)
    mask[:, :4], mask[:, 4] = 0, 51
    scenes.save(tmp_path / "masks" / "photo0.png", mask)
    for i, value in ((1, 0), (2, 255)):
        scenes.save(tmp_path / "masks" / f"photo{i}.png", np.full((12, 16), value, np.uint8))
    scenes.save(tmp_path / "images" / "photo0.png", rgba(0, np.full((12, 16), 204, np.uint8)))
    scene = load_scene(tmp_path, masks="cutout")
    first, second, third, *_ = scene.views
    alpha = 0.8 * mask / 255
    np.testing.assert_allclose(first.alpha, alpha, atol=1e-6)
    np.testing.assert_allclose(first.image, alpha[..., None] * scenes.image(0) / 255, atol=1e-6)
    assert first.mask is None and not second.alpha.any() and third.alpha is None
    assert {
        "3 images cut out by a mask file", "1 image wholly transparent, showing nothing",
        "masks that keep no pixel: photo1.png (1)", "masks that keep every pixel: photo2.png (1)",
    } <= set(scene.notes)  # fmt: skip
    assert any("the white ones (--mask-keeps white); the others are transparent (--masks cutout)" in n for n in scene.notes)
    half = load_scene(tmp_path, masks="cutout", downscale=2).views[0].alpha
    np.testing.assert_allclose(half, alpha.reshape(6, 2, 8, 2).mean((1, 3)), atol=1e-6)


def test_masks_that_cannot_be_used(tmp_path):
    """Nor can words that are none; cutting out without masks gives a note."""
    scenes.write_colmap(tmp_path)
    path = tmp_path / "masks" / "photo0.png"
    for i in range(scenes.VIEWS):
        scenes.save(path.with_name(f"photo{i}.png"), np.zeros((12, 16), np.uint8))
    scenes.refused(tmp_path, r"has 0 usable views, not at least 2 \(.*masks that keep no pixel.*--mask-keeps.*photo0.png")
    for i in range(1, scenes.VIEWS):
        path.with_name(f"photo{i}.png").unlink()
    scenes.save(path, np.full((12, 30), 255, np.uint8))
    scenes.refused(tmp_path, r"photo0.png: its mask is 30 x 12 px, of another aspect")
    path.write_bytes(b"no image")
    scenes.refused(tmp_path, r"masks/photo0.png: the image cannot be decoded")
    scenes.save(path, np.full((24, 32), 255, np.uint8))  # twice the size is the same mask
    assert load_scene(tmp_path).views[0].mask.all()
    path.unlink()
    assert "--masks cutout changes nothing: no image has a mask file" in load_scene(tmp_path, masks="cutout").notes
    wrong = [({"masks": "cut"}, "--masks must be one of ignore, cutout, not 'cut'")]
    wrong += [({"mask_keeps": "gray"}, "--mask-keeps must be one of white, black, not 'gray'")]
    wrong += [({"downscale": d}, "--downscale must be a whole number of at least 1") for d in (0, -1, 2.0, True, "2")]
    for options, words in wrong:
        with pytest.raises(UsageError, match=words):
            load_scene(tmp_path, **options)


# Images are taken whole or not at all: damage that a checksum, a decoder or the sizes in the file show is refused.


def photo(width=96, height=64) -> Image.Image:
    rng = np.random.default_rng(0)
    values = scenes.image(3, width, height).astype(float) + rng.normal(0, 6, (height, width, 3))
    return Image.fromarray(np.clip(values, 0, 255).astype(np.uint8))


def encoded(kind: str, image: Image.Image | None = None, **options) -> bytes:
    out = io.BytesIO()
    (image or photo()).save(out, kind, **options)
    return out.getvalue()


def zeroed(data: bytes, start: float, end: float) -> bytes:
    a, b = int(start * len(data)), int(end * len(data))
    return data[:a] + bytes(b - a) + data[b:]


def refused(tmp_path, data: bytes, reason: str, **options) -> None:
    path = tmp_path / "photo.img"
    path.write_bytes(data)
    with pytest.raises(DataError, match=f"photo.img: the image .*{reason}"):
        decode(path, **options)


def tiff(width: int, height: int, strips: list[tuple[int, int]], pixels: bytes, compression: int = 1, rows: int = 0) -> bytes:
    """Return a gray TIFF of 8 bits whose strips, pairs (offset into the pixels, length), are of ``rows`` rows each."""
    count = len(strips)
    tags = [(256, width), (257, height), (258, 8), (259, compression), (262, 1), (277, 1), (278, rows or height)]
    place = 8 + 2 + 12 * (len(tags) + 2) + 4
    body = place + 8 * count
    offsets, lengths = [body + o for o, _ in strips], [n for _, n in strips]
    entries = [struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags[:5]]
    for tag, values, where in ((273, offsets, place), (279, lengths, place + 4 * count)):
        entries.append(struct.pack("<HHII", tag, 4, count, values[0] if count == 1 else where))
    entries[6:6] = [struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags[5:]]
    directory = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
    return b"II*\0" + struct.pack("<I", 8) + directory + struct.pack(f"<{2 * count}I", *offsets, *lengths) + pixels


@pytest.mark.parametrize(
    "mode,options",
    [
        *(("RGB", {"subsampling": s, "progressive": p}) for s in ("4:4:4", "4:2:2", "4:2:0", "4:1:1") for p in (False, True)),
        ("RGB", {"quality": 20, "restart_marker_blocks": 3, "optimize": True}), ("RGB", {"keep_rgb": True}),
        ("L", {}), ("L", {"progressive": True}), ("CMYK", {}), ("CMYK", {"progressive": True}),
    ],
)  # fmt: skip
def test_pixels_of_a_jpeg_are_those_of_opencv(mode, options, tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(encoded("JPEG", photo(97, 63).convert(mode), **options) + b"a film follows some photographs")
    raster = np.atleast_3d(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
    expected = raster[..., ::-1].astype(np.float32) / 255
    assert (decode(path)[0] == expected).all()


@pytest.mark.parametrize("order", ["<", ">"])
def test_big_tiff_and_tiles_are_read(order, tmp_path):
    gray, path = 99 * np.arange(32 * 16).reshape(16, 32), tmp_path / "a.tif"
    path.write_bytes(big_tiled(gray, order))
    assert (decode(path)[0][..., 0] == gray.astype(np.float32) / 65535).all()
    refused(tmp_path, path.read_bytes()[:-1], "lie outside of the file")


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"restart_marker_blocks": 8}])
def test_a_jpeg_whose_coded_data_is_zeroed_or_ends_early_or_is_of_another_size(options, tmp_path):
    data = encoded("JPEG", **options)
    for part in ((0.4, 0.6), (0.5, 0.99)):
        refused(tmp_path, zeroed(data[:-2], *part) + data[-2:], "decoded")
    if "restart_marker_blocks" in options:
        return
    for kept in (0.5, 0.9, 0.99):
        refused(tmp_path, data[: int(kept * len(data))] + data[-2:], "decoded")
    at = data.index(b"\xff\xc2" if options else b"\xff\xc0") + 5
    for height, width in ((72, 96), (48, 96), (64, 128), (64, 80)):
        refused(tmp_path, data[:at] + struct.pack(">HH", height, width) + data[at + 4 :], "decoded")


def test_files_that_lack_a_part_or_have_a_wrong_bit_or_checksum(tmp_path):
    rows = bytes(13) * 8
    good = gray_png(12, 8, rows)
    (tmp_path / "a.png").write_bytes(good)
    assert decode(tmp_path / "a.png")[0].shape == (8, 12, 3)
    packed = zlib.compress(rows)
    whole = chunk(b"IDAT", packed)
    refused(tmp_path, good.replace(whole, b""), "pixels are damaged")
    refused(tmp_path, good.replace(whole, chunk(b"IDAT", packed[:-5])), "decoded")
    refused(tmp_path, good.replace(whole, chunk(b"IDAT", packed[:-1] + b"\x77")), "decoded")
    refused(tmp_path, good.replace(whole, whole[:-1] + b"\x77"), "decoded")
    refused(tmp_path, gray_png(12, 9, rows), "decoded")
    refused(tmp_path, good[:-12], "decoded")
    for at in (0.1, 0.3, 0.5, 0.7, 0.9):
        data = bytearray(encoded("PNG"))
        data[int(at * len(data))] ^= 4
        refused(tmp_path, bytes(data), "decoded")
    # a BMP or WebP that is shorter than its header says
    refused(tmp_path, encoded("BMP")[:-9], "truncated")
    refused(tmp_path, encoded("WEBP")[:-9], "it ends early")
    refused(tmp_path, b"RIFF" + struct.pack("<I", 4) + b"WEBP" + bytes(8), "its header is broken")
    data = bytearray(encoded("BMP"))
    data[22:26] = struct.pack("<i", 80)
    refused(tmp_path, bytes(data), "truncated")
    data[22:26], data[30:34] = struct.pack("<i", 64), struct.pack("<I", 1)
    refused(tmp_path, bytes(data), "compressed, so damage would not be detected")
    # a progressive JPEG that lacks scans
    data = encoded("JPEG", progressive=True)
    scans = [i for i in range(len(data)) if data[i : i + 2] == b"\xff\xda"]
    assert len(scans) > 3
    for at in scans[1:]:
        refused(tmp_path, data[:at] + b"\xff\xd9", "some of its scans are missing")
    # a compressed TIFF with a zeroed middle
    for compression in ("tiff_lzw", "tiff_adobe_deflate", "tiff_deflate"):
        refused(tmp_path, zeroed(encoded("TIFF", compression=compression), 0.4, 0.6), "damaged")
    ok, data = cv2.imencode(".tif", np.asarray(photo()).astype(np.uint16) * 257, [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    assert ok
    refused(tmp_path, zeroed(data.tobytes(), 0.4, 0.6), "decoded")
    # strips that hold too little
    pixels = bytes(range(64)) * 2
    (tmp_path / "a.tif").write_bytes(tiff(16, 8, [(0, 64), (64, 64)], pixels, rows=4))
    assert decode(tmp_path / "a.tif")[0].shape == (8, 16, 3)
    refused(tmp_path, tiff(2000, 2000, [(0, 100)], bytes(100)), "truncated")  # 222 bytes
    refused(tmp_path, tiff(16, 8, [(0, 64), (64, 65)], pixels, rows=4), "lie outside of the file")
    refused(tmp_path, tiff(16, 8, [(0, 64)], pixels, rows=4), "decoded")
    packed = zlib.compress(pixels)
    (tmp_path / "a.tif").write_bytes(tiff(16, 8, [(0, len(packed))], packed, 8))
    assert decode(tmp_path / "a.tif")[0].shape == (8, 16, 3)
    refused(tmp_path, tiff(16, 9, [(0, len(packed))], packed, 8), "decoded")
    refused(tmp_path, tiff(16, 8, [(0, len(packed))], packed[:-1] + b"\x77", 8), "incorrect data check")


def announcing(kind: str, width: int, height: int) -> bytes:
    if kind == "PNG":
        return gray_png(width, height, bytes(100))
    if kind == "TIFF":
        return tiff(width, height, [(0, 100)], bytes(100))
    data = bytearray(encoded(kind))
    if kind == "JPEG":
        at = data.index(b"\xff\xc0") + 5
        data[at : at + 4] = struct.pack(">HH", height, width)
    elif kind == "BMP":
        data[18:26] = struct.pack("<ii", width, height)
    else:
        data[26:30] = struct.pack("<HH", width & 0x3FFF, height & 0x3FFF)
    return bytes(data)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "BMP", "WEBP"])
def test_the_header_alone_decides_what_is_too_large(kind, tmp_path):
    width, height = (30000, 30000) if kind != "WEBP" else (16000, 16000)
    limit = rf"more than the limit of 100,000,000 .*--max-pixels {width * height}"
    refused(tmp_path, announcing(kind, width, height), f"is {width} x {height} px, {limit}")
    refused(tmp_path, announcing(kind, 0, 64), "decoded")


def test_the_limit_holds_for_images_masks_and_score_masks_and_threads_leave_warnings(tmp_path):
    scenes.write_colmap(tmp_path)
    size = scenes.WIDTH * scenes.HEIGHT
    assert len(load_scene(tmp_path, max_pixels=size).views) == scenes.VIEWS
    scenes.refused(tmp_path, "photo0.png: the image is 16 x 12 px, more than the limit of 191 pixels", max_pixels=size - 1)
    for folder, names in (("idrmasks", [f"{i}.png" for i in range(scenes.VIEWS)]), ("masks", ["photo0.png"])):
        for name in names:
            scenes.save(tmp_path / folder / name, np.full((24, 32), 255, np.uint8))
        assert len(load_scene(tmp_path, max_pixels=4 * size).views) == scenes.VIEWS
        scenes.refused(tmp_path, rf"{folder}.*: the image is 32 x 24 px, more than the limit of 192 pixels", max_pixels=size)
    # of two threads that put the filters of warnings back, the later could put back the other's
    (tmp_path / "a.jpg").write_bytes(encoded("JPEG"))
    before = [*warnings.filters]
    with ThreadPoolExecutor(4) as pool:
        assert len([*pool.map(decode, [tmp_path / "a.jpg"] * 200)]) == 200
    assert warnings.filters == before
    gray, path = np.arange(11 * 9, dtype=np.uint8).reshape(9, 11), tmp_path / "a.png"
    path.write_bytes(interlaced(gray))
    assert (decode(path)[0][..., 0] == gray / np.float32(255)).all()
    refused(tmp_path, interlaced(gray, -1), "decoded")


def test_a_second_size_or_a_chunk_beyond_the_file_is_refused_before_any_pixel_is_decoded(tmp_path, monkeypatch):
    """Pillow and OpenCV would take the memory that these announce: 4 GB for a file of 100 bytes."""
    good, strip = gray_png(12, 8, bytes(13) * 8), tiff(16, 8, [(0, 128)], bytes(128))
    entry = struct.Struct("<HHII")
    wide, header = entry.pack(256, 4, 1, 12000), chunk(b"IHDR", struct.pack(">IIBBBBB", 12000, 12000, 8, 0, 0, 0, 0))
    for name in ("imdecode", "imread"):
        monkeypatch.setattr(cv2, name, lambda *_: pytest.fail("decoded"))
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda *_: pytest.fail("decoded"))
    refused(tmp_path, good[:33] + header + good[33:], "it has two headers")
    refused(tmp_path, strip.replace(entry.pack(277, 4, 1, 1), wide), "it has two values of a tag")
    for length in (bytes(4), struct.pack(">I", 2**32 - 1)):
        refused(tmp_path, good[:-12] + length + b"IEND", "it ends within a chunk")
    at = good.index(b"IDAT") - 4
    refused(tmp_path, good[:at] + struct.pack(">I", 2**31 - 1) + good[at + 4 :], "it ends within a chunk")


def test_any_error_of_a_decoder_is_damage_of_the_file(tmp_path, monkeypatch):
    """Pillow raises an OverflowError at a width of 2**31, and types that no list of ours has foreseen."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 2**31, 1, 8, 0, 0, 0, 0))
    with pytest.raises(ValueError, match="its pixels are damaged"):
        image_files._loaded(image_files._opened("PNG", gray_png(1, 1, bytes(2))[:33] + header + chunk(b"IDAT", b"")))
    for error in (OverflowError, ZeroDivisionError, Image.DecompressionBombError, cv2.error):

        def fails(*_, error=error):
            raise error("signed integer is greater than maximum")

        monkeypatch.setattr(ImageFile.ImageFile, "load", fails)
        refused(tmp_path, encoded("PNG"), "its pixels are damaged .signed integer is greater than maximum")


def test_no_memory_for_an_image_is_no_damage(tmp_path, monkeypatch):
    (tmp_path / "photo.img").write_bytes(encoded("PNG"))

    def full(*_):
        error = cv2.error("Failed to allocate 4 bytes")
        error.code = cv2.Error.StsNoMem
        raise error

    for owner, name, wrong in ((cv2, "imdecode", full), (ImageFile.ImageFile, "load", lambda *_: np.empty(2**50))):
        monkeypatch.setattr(owner, name, wrong)
        with pytest.raises(ResourceError, match=r"photo.img: decoding the image needs 0.0 GiB; shrink it"):
            decode(tmp_path / "photo.img")


# AVIF: decoded whole or not at all, with what EXIF says of the lens and nothing of it in the copy.

MAKE, MODEL, EXIF, FOCAL_35MM, ORIENTATION = 0x010F, 0x0110, 0x8769, 0xA405, 0x0112
RED, GRAY = np.array([230, 40, 40]) / 255, np.array([60, 60, 60]) / 255


def avif(orientation: int = 1, alpha: int | None = None) -> bytes:
    """Return an AVIF file of 96 x 64 px, gray, the upper left quarter red."""
    pixels = np.full((64, 96, 3), 60, np.uint8)
    pixels[:32, :48] = 230, 40, 40
    image, exif, out = Image.fromarray(pixels), Image.Exif(), io.BytesIO()
    if alpha is not None:
        image.putalpha(alpha)
    exif[MAKE], exif[MODEL], exif[ORIENTATION] = "Maker", "Phone", orientation
    exif.get_ifd(EXIF)[FOCAL_35MM] = 26
    image.save(out, "AVIF", quality=90, exif=exif)
    return out.getvalue()


def test_an_avif_has_its_colours_and_straight_alpha_and_is_bounded(tmp_path):
    path = tmp_path / "a.jpg"  # the first bytes decide
    for given in (None, 128):
        path.write_bytes(avif(alpha=given))
        color, alpha = decode(path)
        assert color.shape == (64, 96, 3) and color.dtype == np.float32 and (alpha is None) == (given is None)
        assert alpha is None or np.abs(alpha - 128 / 255).max() < 0.01
        for part, wanted in ((color[4:28, 4:44], RED), (color[36:, 4:44], GRAY), (color[4:28, 52:], GRAY)):
            np.testing.assert_allclose(part.mean((0, 1)), wanted, atol=0.04)
    with pytest.raises(DataError, match=r"96 x 64 px, more than the limit of 100 pixels"):
        decode(path, 100)
    # a photograph is copied upright without what it says of its owner; its lens is known by EXIF: 26 mm of 43.3 mm film
    source = tmp_path / "in" / "a.avif"
    source.parent.mkdir()
    source.write_bytes(avif(orientation=6))
    assert list_images(source.parent) == [source]
    photograph = prepare(source, source.parent, tmp_path / "small.png")
    assert (photograph.name, photograph.width, photograph.height) == ("a.avif.png", 64, 96)
    assert photograph.device == "Maker Phone 26 mm"
    np.testing.assert_allclose(photograph.focal, 26 / np.hypot(36, 24) * np.hypot(64, 96) / 96)
    write_copy(photograph, tmp_path / "scene")
    copy = Image.open(tmp_path / "scene" / "a.avif.png")
    assert copy.format == "PNG" and not copy.getexif()
    for image in (copy, Image.open(tmp_path / "small.png")):
        pixels = np.asarray(image) / 255
        assert pixels.shape == (96, 64, 3)
        np.testing.assert_allclose(pixels[24, 48], RED, atol=0.04)
        np.testing.assert_allclose(pixels[24, 16], GRAY, atol=0.04)


# Photographs in formats that are known and cannot be read here: one sentence with the format and the remedy.

FTYP = b"\0\0\0\x1cftyp"


def test_the_format_and_its_remedy_are_named(tmp_path):
    """A folder of RAW files is told from an empty one; other files are no images."""
    for name, data, words in (
        ("a.heic", FTYP + b"heic\0\0\0\0mif1heic" + bytes(40), "a HEIC photograph, .* only for finding poses.*JPEG"),
        ("a.jpg", FTYP + b"mif1", "a HEIC photograph"),  # truncated, under another name
        ("a.DNG", b"II*\0" + bytes(60), "a RAW file.*convert"),
        ("a.cr3", FTYP + b"crx ", "a RAW file"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(DataError, match=rf"{name}: is {words}"):
            decode(tmp_path / name)
    scenes.write_llff(tmp_path / "raw")
    for file in (tmp_path / "raw" / "images").iterdir():
        file.rename(file.with_suffix(".NEF"))
    scenes.refused(tmp_path / "raw", r"images: .*\.NEF is a RAW file, which is not supported; convert")
    for data in (b"", b"P5 2 2 255 abcd", b"GIF89a" + bytes(20)):
        refused(tmp_path, data, "it is (empty|not a JPEG, PNG, BMP, TIFF, WebP or AVIF file)")
