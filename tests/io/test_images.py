"""Decoding, orientation, masks, undistortion and resizing, each with the camera in step."""

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image

from tests.io import scenes
from warpgs.errors import DataError, UsageError
from warpgs.io.image_files import decode
from warpgs.io.images import Lens, ReadOptions, load_image
from warpgs.io.load import fingerprint, load_scene


def lens(width, height, focal=20.0, distortion=(), model="PINHOLE"):
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return Lens(K, width, height, distortion, model)


def smooth(x, y):
    """Return an analytic image over pixel coordinates (centres at +0.5), three channels in [0, 1]."""
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


@pytest.mark.parametrize("suffix", ["JPEG", "PNG", "BMP", "TIFF", "WEBP"])
@pytest.mark.parametrize("kept", [0.0, 0.02, 0.5, 0.9])
def test_truncated_images_are_named(suffix, kept, tmp_path):
    data = io.BytesIO()
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)).save(data, suffix)
    path = tmp_path / f"a.{suffix.lower()}"
    path.write_bytes(data.getvalue()[: int(kept * len(data.getvalue()))])
    with pytest.raises(DataError, match=rf"{path.name}: the image cannot be decoded.*Restore"):
        decode(path)


def test_missing_and_non_finite_images(tmp_path):
    with pytest.raises(DataError, match=r"gone.png: the image file is missing; restore"):
        decode(tmp_path / "gone.png")
    Image.fromarray(np.full((8, 8), np.nan, np.float32)).save(tmp_path / "nan.tiff")
    with pytest.raises(DataError, match=r"nan.tiff: some pixels are not finite"):
        decode(tmp_path / "nan.tiff")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_never_turns_a_raster_that_fits(orientation, tmp_path):
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.fromarray(scenes.image(0)).save(tmp_path / "a.png", exif=exif)
    loaded = load_image(tmp_path / "a.png", lens(16, 12), ReadOptions())
    np.testing.assert_allclose(loaded.image, scenes.image(0) / 255, atol=1e-6)
    assert loaded.done == ()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_turns_only_what_fits_turned(orientation, tmp_path):
    from PIL import ImageOps

    exif = Image.Exif()
    exif[0x112] = orientation
    path = tmp_path / "a.png"
    Image.fromarray(scenes.image(0)).save(path, exif=exif)
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


def test_size_within_a_pixel_is_rescaled_and_others_are_refused(tmp_path):
    path = tmp_path / "a.png"
    scenes.save(path, scenes.image(0, 33, 25))  # a half of 65 x 49, rounded up
    K = load_image(path, lens(65, 49, 40.0), ReadOptions()).K
    np.testing.assert_allclose(K[[0, 1, 0, 1], [0, 1, 2, 2]], [40 * 33 / 65, 40 * 25 / 49, 16.5, 12.5])
    with pytest.raises(DataError, match=r"a.png: the image is 33 x 25 px, its camera 60 x 60: the aspects differ"):
        load_image(path, lens(60, 60), ReadOptions())


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_resampling_is_an_area_mean_with_exact_intrinsics(factor, tmp_path):
    path = tmp_path / "a.png"
    rgb = np.random.default_rng(1).integers(0, 256, (24, 36, 3), np.uint8)
    scenes.save(path, rgb)
    loaded = load_image(path, lens(36, 24, 30.0), ReadOptions(downscale=factor))
    mean = rgb.reshape(24 // factor, factor, 36 // factor, factor, 3).mean(axis=(1, 3)) / 255
    np.testing.assert_allclose(loaded.image, mean, atol=1e-5)
    np.testing.assert_allclose(loaded.K[[0, 1, 0, 1], [0, 1, 2, 2]], np.array([30, 30, 18, 12]) / factor)


def test_uneven_resampling_scales_each_axis_by_itself(tmp_path):
    scenes.save(tmp_path / "a.png", scenes.image(0, 35, 26))
    loaded = load_image(tmp_path / "a.png", lens(35, 26), ReadOptions(downscale=3))
    assert loaded.image.shape == (9, 12, 3)
    np.testing.assert_allclose(loaded.K[[0, 1], [0, 1]], [20 * 12 / 35, 20 * 9 / 26])


@pytest.mark.parametrize("downscale,side,size", [(1, 17, (17, 13)), (2, 17, (17, 13)), (2, 18, (18, 13)), (1, 0, (35, 26))])
def test_a_longest_side_bounds_an_image_and_scales_each_axis_of_its_camera(downscale, side, size, tmp_path):
    """It holds after the factor; an image within it is untouched by it, and nothing is said."""
    scenes.save(tmp_path / "a.png", scenes.image(0, 35, 26))
    loaded = load_image(tmp_path / "a.png", lens(35, 26), ReadOptions(downscale=downscale, max_side=side))
    assert loaded.image.shape == (*size[::-1], 3)
    np.testing.assert_allclose(
        loaded.K[[0, 1, 0, 1], [0, 1, 2, 2]], [20 * size[0] / 35, 20 * size[1] / 26, *np.array(size) / 2]
    )
    assert any("17 px on the longer side; change it with --max-side" in d for d in loaded.done) == (side == 17)


def test_a_longest_side_that_leaves_nothing_is_refused(tmp_path):
    scenes.save(tmp_path / "a.png", scenes.image(0, 35, 26))
    with pytest.raises(UsageError, match=r"--max-side 4 leaves 4 x 3 px of .*a\.png"):
        load_image(tmp_path / "a.png", lens(35, 26), ReadOptions(max_side=4))


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


def test_a_lens_that_folds_back_is_masked_there(tmp_path):
    scenes.save(tmp_path / "a.png", scenes.image(0, 64, 48))
    loaded = load_image(tmp_path / "a.png", lens(64, 48, 30.0, (-0.5, 0.0, 0.0, 0.0), "RADIAL"), ReadOptions())
    x, y = grid(64, 48)
    radius2 = ((x - 32) / 30) ** 2 + ((y - 24) / 30) ** 2
    assert not loaded.mask[radius2 > 1 / 1.5].any() and loaded.mask[radius2 < 0.6].all()


@pytest.mark.parametrize(
    "model,parameters,terms",
    [
        ("SIMPLE_PINHOLE", (20, 8, 6), ()),
        ("PINHOLE", (20, 21, 8, 6), ()),
        ("SIMPLE_RADIAL", (20, 8, 6, 0.1), (0.1, 0, 0, 0)),
        ("RADIAL", (20, 8, 6, 0.1, 0.2), (0.1, 0.2, 0, 0)),
        ("OPENCV", (20, 21, 8, 6, 0.1, 0.2, 0.01, 0.02), (0.1, 0.2, 0.01, 0.02)),
    ],
)
@pytest.mark.parametrize("files", [scenes.colmap_bin, scenes.colmap_txt])
def test_colmap_models(model, parameters, terms, files, tmp_path):
    from warpgs.io.colmap import read_cameras

    scenes.write_files(tmp_path, files(model, parameters))
    (found,) = read_cameras(next(tmp_path.glob("cameras.*"))).values()
    fy = 21.0 if model in ("PINHOLE", "OPENCV") else 20.0
    np.testing.assert_array_equal(found.K, [[20, 0, 8], [0, fy, 6], [0, 0, 1]])
    assert (found.distortion, found.width, found.height) == (terms, 16, 12)


def test_distortion_is_noted_once_per_model(tmp_path):
    scene = load_scene(scenes.write_colmap(tmp_path, model="SIMPLE_RADIAL", parameters=(20, 8, 6, 0.5)))
    assert "5 images undistorted (SIMPLE_RADIAL)" in scene.notes
    assert scene.views[0].mask is not None


@pytest.mark.parametrize("name", ["photo0.png", "photo0.png.png"])
@pytest.mark.parametrize("keeps", ["white", "black"])
def test_masks_folder(name, keeps, tmp_path):
    scenes.write_colmap(tmp_path)
    mask = np.zeros((12, 16), np.uint8)
    mask[:, 4:] = 255
    scenes.save(tmp_path / "masks" / name, mask)
    scene = load_scene(tmp_path, mask_keeps=keeps)
    assert (scene.views[0].mask == ((mask > 0) == (keeps == "white"))).all() and scene.views[1].mask is None
    assert "1 image masked by a mask file" in scene.notes
    kept = "75.0%" if keeps == "white" else "25.0%"
    assert (
        f"masks keep {kept} of the pixels, the {keeps} ones (--mask-keeps {keeps}); the others are ignored (--masks ignore)"
        in (scene.notes)
    )
    half = load_scene(tmp_path, downscale=2, mask_keeps=keeps).views[0].mask
    assert (half == ((mask[::2, ::2] > 0) == (keeps == "white"))).all()


def test_masks_of_middlebury_lie_in_the_scene_folder(tmp_path):
    scenes.write_middlebury(tmp_path / "scene")
    mask = np.full((12, 16), 255, np.uint8)
    mask[0] = 0
    scenes.save(tmp_path / "scene" / "masks" / "photo1.png", mask)
    scenes.save(tmp_path / "masks" / "photo0.png", mask)  # of another scene beside it
    views = load_scene(tmp_path / "scene").views
    assert views[0].mask is None and not views[1].mask[0].any()


def rgba(i, alpha):
    """Return the test image [12, 16, 4] with an alpha channel [12, 16]."""
    return np.concatenate([scenes.image(i), alpha[..., None]], axis=2)


@pytest.mark.parametrize("write", [scenes.write_colmap, scenes.write_transforms, scenes.write_llff])
def test_alpha_arrives_in_every_format(write, tmp_path):
    """Straight colours come multiplied, over black; an alpha of one everywhere is an opaque image."""
    write(tmp_path)
    alpha = np.full((12, 16), 255, np.uint8)
    scenes.save(tmp_path / "images" / "photo1.png", rgba(1, alpha))
    alpha[:, :4], alpha[0] = 100, 0
    scenes.save(tmp_path / "images" / "photo0.png", rgba(0, alpha))
    scene = load_scene(tmp_path)
    first, second, *_ = scene.views
    np.testing.assert_allclose(first.alpha, alpha / 255, atol=1e-6)
    np.testing.assert_allclose(first.image, scenes.image(0) / 255 * (alpha / 255)[..., None], atol=1e-6)
    assert first.alpha.dtype == np.float32 and first.mask is None and scene.background == (0, 0, 0)
    assert second.alpha is None and "1 image transparent in part, by the alpha channel" in scene.notes
    other = first.alpha.copy()
    other[3, 3] = 0.25
    assert fingerprint([first]) != fingerprint([dataclasses.replace(first, alpha=other)])


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


def test_alpha_is_freed_of_distortion_with_its_image(tmp_path):
    """White where opaque, so that over black every channel is the alpha."""
    image = np.full((48, 64, 4), 255, np.uint8)
    image[..., 3] = np.tile((np.arange(64) % 8 < 4) * 255, (48, 1))
    scenes.save(tmp_path / "a.png", image)
    loaded = load_image(tmp_path / "a.png", lens(64, 48, 60.0, (0.3, 0.0, 0.0, 0.0)), ReadOptions(downscale=2))
    np.testing.assert_allclose(loaded.image, loaded.alpha[..., None].repeat(3, 2), atol=1e-6)
    straight = load_image(tmp_path / "a.png", lens(64, 48, 60.0), ReadOptions(downscale=2))
    assert np.abs(straight.alpha - loaded.alpha)[0].max() > 0.5 and loaded.mask is not None


def test_an_image_that_shows_nothing_is_named(tmp_path):
    scenes.write_colmap(tmp_path)
    scenes.save(tmp_path / "images" / "photo0.png", rgba(0, np.zeros((12, 16), np.uint8)))
    assert "1 image wholly transparent, showing nothing" in load_scene(tmp_path).notes


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


def test_cutting_out_without_masks_is_said_and_words_are_checked(tmp_path):
    scenes.write_colmap(tmp_path)
    assert "--masks cutout changes nothing: no image has a mask file" in load_scene(tmp_path, masks="cutout").notes
    with pytest.raises(UsageError, match="--masks must be ignore or cutout, not 'cut'"):
        load_scene(tmp_path, masks="cut")
    with pytest.raises(UsageError, match="--mask-keeps must be white or black, not 'gray'"):
        load_scene(tmp_path, mask_keeps="gray")


def test_masks_that_cannot_be_used(tmp_path):
    scenes.write_colmap(tmp_path)
    path = tmp_path / "masks" / "photo0.png"
    scenes.save(path, np.zeros((12, 16), np.uint8))
    with pytest.raises(DataError, match=r"photo0.png: its mask leaves no pixel.*--mask-keeps"):
        load_scene(tmp_path)
    scenes.save(path, np.full((12, 30), 255, np.uint8))
    with pytest.raises(DataError, match=r"photo0.png: its mask is 30 x 12 px, the image 16 x 12"):
        load_scene(tmp_path)
    path.write_bytes(b"no image")
    with pytest.raises(DataError, match=r"masks/photo0.png: the image cannot be decoded"):
        load_scene(tmp_path)
    scenes.save(path, np.full((24, 32), 255, np.uint8))  # twice the size is the same mask
    assert load_scene(tmp_path).views[0].mask.all()


@pytest.mark.parametrize("downscale", [0, -1, 2.0, True, "2"])
def test_downscale_must_be_a_positive_whole_number(downscale, tmp_path):
    with pytest.raises(UsageError, match="--downscale must be a whole number of at least 1"):
        load_scene(scenes.write_colmap(tmp_path), downscale=downscale)


def test_downscale_that_leaves_nothing(tmp_path):
    with pytest.raises(UsageError, match=r"--downscale 8 leaves 2 x 2 px of .*photo0.png.*Choose a smaller factor"):
        load_scene(scenes.write_colmap(tmp_path), downscale=8)
