from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from warpgs.errors import DataError, ResourceError
from warpgs.files import write_bytes
from warpgs.report.film import write_mp4
from warpgs.report.images import GRAY, depth_map, error_map, png, side_by_side


def decode(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def test_png_decodes_to_the_rounded_pixels_in_rgb_order():
    image = np.random.default_rng(0).uniform(-0.2, 1.2, (9, 13, 3)).astype(np.float32)
    data = png(image)
    assert data.startswith(b"\x89PNG")
    np.testing.assert_array_equal(decode(data), np.round(np.clip(image, 0, 1) * 255).astype(np.uint8))
    assert decode(png(np.array([[[1.0, 0.5, 0.0]]])))[0, 0].tolist() == [255, 128, 0]


def test_error_map_is_black_without_error_and_brighter_with_more():
    reference = np.full((1, 5, 3), 0.4, np.float32)
    image = reference + np.array([0, 0.05, 0.15, 0.3, 0.5], np.float32)[None, :, None]
    brightness = error_map(image, reference).sum(-1)[0]
    assert brightness[0] < 0.1 and (np.diff(brightness[:4]) > 0).all() and brightness[4] == brightness[3]
    np.testing.assert_array_equal(error_map(reference - 0.15, reference), error_map(reference + 0.15, reference))


def test_depth_map_is_warm_near_cold_far_and_gray_where_nothing_is():
    depth = np.linspace(1, 5, 50, dtype=np.float32)[None].repeat(2, 0)
    alpha = np.ones_like(depth)
    alpha[1, 10:20] = 0.2
    depth[1, 30] = 0
    colors = depth_map(depth, alpha)
    near, far = colors[0, 0], colors[0, -1]
    assert near[0] > near[2] and far[2] > far[0]
    assert (colors[1, 10:20] == GRAY).all() and (colors[1, 30] == GRAY).all() and not (colors[0] == GRAY).all(-1).any()


def test_depth_map_of_nothing_and_of_a_wall():
    assert (depth_map(np.zeros((3, 4)), np.zeros((3, 4))) == GRAY).all()
    wall = depth_map(np.full((3, 4), 2.0), np.ones((3, 4)))
    assert np.isfinite(wall).all() and (wall == wall[0, 0]).all()


def test_side_by_side_keeps_every_pixel():
    images = [np.full((5, w, 3), v, np.float32) for w, v in ((4, 0.1), (6, 0.2), (3, 0.3))]
    row = side_by_side(images, gap=2)
    assert row.shape == (5, 17, 3)
    assert (row[:, :4] == images[0]).all() and (row[:, 6:12] == images[1]).all() and (row[:, 14:] == images[2]).all()
    assert (row[:, 4:6] == 1).all()


@pytest.mark.parametrize("shape", [(48, 64), (49, 65)])
def test_film_holds_all_frames_in_colour_and_time(tmp_path, shape):
    path = tmp_path / "orbit.mp4"
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    frames = (np.broadcast_to(colors[i // 4], (*shape, 3)) for i in range(12))
    assert write_mp4(path, frames, fps=24) == 12
    film = cv2.VideoCapture(str(path))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 12 and film.get(cv2.CAP_PROP_FPS) == pytest.approx(24)
    read = []
    while (got := film.read())[0]:
        read.append(got[1][..., ::-1])
    film.release()
    assert len(read) == 12 and read[0].shape == (48, 64, 3)
    assert [int(f.mean((0, 1)).argmax()) for f in read] == [i // 4 for i in range(12)]
    assert list(tmp_path.iterdir()) == [path]


def test_film_without_frames_or_folder_says_so(tmp_path):
    with pytest.raises(DataError, match="no frames"):
        write_mp4(tmp_path / "a.mp4", [])
    with pytest.raises(ResourceError, match="cannot be written"):
        write_mp4(tmp_path / "no" / "a.mp4", [np.zeros((16, 16, 3))])


def test_a_film_that_breaks_off_leaves_the_old_one(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")

    def frames():
        yield np.zeros((16, 16, 3))
        raise RuntimeError("renderer")

    with pytest.raises(RuntimeError, match="renderer"):
        write_mp4(path, frames())
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_frames_of_two_sizes_are_refused(tmp_path):
    with pytest.raises(DataError, match="frame 1 is 32 x 32 px, the first 16 x 16 px"):
        write_mp4(tmp_path / "a.mp4", [np.zeros((16, 16, 3)), np.zeros((32, 32, 3))])
    assert not list(tmp_path.iterdir())


def test_a_film_that_did_not_fit_on_the_disk_leaves_the_old_one(tmp_path):
    """The encoder reports nothing when a write fails; a limit on the size of files stands for a full disk."""
    resource = pytest.importorskip("resource", reason="Windows has no limit on the size of files")
    path, noise = tmp_path / "a.mp4", np.random.default_rng(0).uniform(size=(20, 64, 64, 3))
    write_mp4(path, np.zeros((3, 16, 16, 3)))
    old, limits = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(ResourceError, match=r"a\.mp4: cannot be written.* of 20 frames"):
            write_mp4(path, noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == old and list(tmp_path.iterdir()) == [path]
    assert write_mp4(path, noise) == 20 and path.read_bytes() != old


def test_an_encoder_that_drops_frames_is_noticed(tmp_path, monkeypatch):
    """A frame that never reaches the file is missed when the film is read back."""
    path, made = tmp_path / "a.mp4", cv2.VideoWriter
    path.write_bytes(b"old")

    def forgetful(*arguments):
        writer, seen = made(*arguments), []
        write = lambda frame: seen.append(1) or len(seen) == 2 or writer.write(frame)  # noqa: E731
        return SimpleNamespace(isOpened=writer.isOpened, release=writer.release, write=write)

    monkeypatch.setattr(cv2, "VideoWriter", forgetful)
    with pytest.raises(ResourceError, match="3 of 4 frames"):
        write_mp4(path, np.zeros((4, 16, 16, 3)))
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


def test_threads_may_write_one_file(tmp_path):
    """The file is one of those written, complete, and no other file is left."""
    contents = [bytes([i]) * 50_000 for i in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda c: [write_bytes(tmp_path / "a.png", c) for _ in range(20)], contents))
    assert (tmp_path / "a.png").read_bytes() in contents and len(list(tmp_path.iterdir())) == 1
