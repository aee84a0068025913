"""AVIF: decoded whole or not at all, with what EXIF says of the lens and nothing of it in the copy."""

import io

import numpy as np
import pytest
from PIL import Image

from warpgs.errors import DataError
from warpgs.io.image_files import decode
from warpgs.io.images import list_images
from warpgs.poses.photographs import prepare, write_copy

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


def test_colours_are_those_of_the_photograph(tmp_path):
    (tmp_path / "a.jpg").write_bytes(avif())  # the first bytes decide
    color, alpha = decode(tmp_path / "a.jpg")
    assert color.shape == (64, 96, 3) and color.dtype == np.float32 and alpha is None
    np.testing.assert_allclose(color[4:28, 4:44].mean((0, 1)), RED, atol=0.04)
    np.testing.assert_allclose(color[36:, 4:44].mean((0, 1)), GRAY, atol=0.04)
    np.testing.assert_allclose(color[4:28, 52:].mean((0, 1)), GRAY, atol=0.04)


def test_alpha_is_straight(tmp_path):
    (tmp_path / "a.avif").write_bytes(avif(alpha=128))
    color, alpha = decode(tmp_path / "a.avif")
    np.testing.assert_allclose(alpha, 128 / 255, atol=0.01)
    np.testing.assert_allclose(color[4:28, 4:44].mean((0, 1)), RED, atol=0.04)


@pytest.mark.parametrize("part", [0.02, 0.1, 0.5, 0.999])
def test_a_file_that_ends_early_is_refused(tmp_path, part):
    whole = avif()
    (tmp_path / "a.avif").write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(DataError, match=r"a\.avif: the image cannot be decoded: \w.*Restore it"):
        decode(tmp_path / "a.avif")


def test_too_many_pixels_are_refused_by_the_header(tmp_path):
    (tmp_path / "a.avif").write_bytes(avif())
    with pytest.raises(DataError, match=r"96 x 64 px, more than the limit of 100 pixels"):
        decode(tmp_path / "a.avif", 100)


def test_a_photograph_is_copied_upright_without_what_it_says_of_its_owner(tmp_path):
    """Its lens is known by EXIF: 26 mm of film whose diagonal is 43.3 mm."""
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
