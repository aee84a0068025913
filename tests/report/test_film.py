"""Films: VP9 and animated images hold what they were given, and what is not whole never takes the place of what was there."""

import os
import sys
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from PIL import Image

from warpgs.errors import ResourceError, UsageError
from warpgs.report import film as film_files
from warpgs.report.film import MAX_FPS, _with_one_palette, write_film

encoder = film_files.h264_encoder.__wrapped__  # as it is without a cache


@pytest.fixture(autouse=True)
def without_ffmpeg(monkeypatch):
    """As on a machine without ffmpeg, except in the test of ffmpeg."""
    monkeypatch.setattr(film_files, "h264_encoder", lambda: None)


FFMPEG = """#!{python}
import sys, cv2, numpy as np
words = sys.argv[1:]
assert words[words.index("-c:v") + 1] == "h264", words
if "lavfi" in words:
    sys.exit({code})
width, height = map(int, words[words.index("-s") + 1].split("x"))
film = cv2.VideoWriter(words[-1], cv2.VideoWriter_fourcc(*"vp09"), float(words[words.index("-r") + 1]), (width, height))
while data := sys.stdin.buffer.read(3 * width * height):
    film.write(np.frombuffer(data, np.uint8).reshape(height, width, 3)[..., ::-1])
    {more}
film.release()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="scripts have no #! line")
@pytest.mark.parametrize(("code", "more", "used"), [(0, "pass", True), (1, "pass", False), (0, "sys.exit()", True)])
def test_ffmpeg_encodes_if_it_can(tmp_path, monkeypatch, code, more, used):
    monkeypatch.setattr(film_files, "h264_encoder", encoder)
    program, path = tmp_path / "bin" / "ffmpeg", tmp_path / "out" / "a.mp4"
    for folder in (program.parent, path.parent):
        folder.mkdir()
    program.write_text(FFMPEG.format(python=sys.executable, code=code, more=more))
    program.chmod(0o755)
    path.write_bytes(b"old")
    monkeypatch.setenv("PATH", str(program.parent))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    assert encoder() == (str(program) if used else None)
    frames = (np.broadcast_to(np.eye(3)[i // 4], (48, 65, 3)) for i in range(12))
    if more != "pass":
        with pytest.raises(ResourceError, match="only 1 of 12 frames"):
            write_film(path, frames)
        assert path.read_bytes() == b"old"
    else:
        assert write_film(path, frames, fps=24) == 12
        film = cv2.VideoCapture(str(path))
        colors = [film.read()[1][..., ::-1].mean((0, 1)).argmax() for _ in range(12)]
        assert colors == [i // 4 for i in range(12)] and not film.read()[0]
    assert list(path.parent.iterdir()) == [path]
    monkeypatch.chdir(program.parent)
    assert encoder() is None, "a program in the current folder is not run"


@pytest.mark.parametrize(("name", "shape"), [("a.mp4", (48, 64)), ("a.webm", (49, 65))])
def test_video_holds_all_frames_in_colour_and_time(tmp_path, capfd, name, shape):
    """VP9, all frames of two parts in order, odd sides cut, and not a word of the encoder's on the terminal."""
    path = tmp_path / name
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    frames = (np.broadcast_to(colors[i // 12], (*shape, 3)) for i in range(36))
    assert write_film(path, frames, fps=24) == 36 and capfd.readouterr().err == ""
    film = cv2.VideoCapture(str(path))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 36 and film.get(cv2.CAP_PROP_FPS) == pytest.approx(24)
    assert int(film.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").lower() in (b"vp09", b"vp90")
    read = []
    while (got := film.read())[0]:
        read.append(got[1][..., ::-1])
    film.release()
    assert len(read) == 36 and read[0].shape == (48, 64, 3)
    assert [int(f.mean((0, 1)).argmax()) for f in read] == [i // 12 for i in range(36)]
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["a.mp4", "a.gif"])
def test_frames_that_make_no_film_leave_the_old_one(tmp_path, name):
    path = tmp_path / name
    path.write_bytes(b"old")

    def frames():
        yield np.zeros((16, 16, 3))
        raise RuntimeError("renderer")

    with pytest.raises(RuntimeError, match="renderer"):
        write_film(path, frames())
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    with pytest.raises(ResourceError, match="cannot be written"):
        write_film(tmp_path / "no" / name, [np.zeros((16, 16, 3))])


def test_a_film_that_did_not_fit_on_the_disk_leaves_the_old_one(tmp_path):
    """The encoder reports nothing when a write fails; a limit on the size of files stands for a full disk."""
    resource = pytest.importorskip("resource", reason="Windows has no limit on the size of files")
    path, noise = tmp_path / "a.mp4", np.random.default_rng(0).uniform(size=(20, 64, 64, 3))
    write_film(path, np.zeros((3, 16, 16, 3)))
    old, limits = path.read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
    try:
        with pytest.raises(ResourceError, match=r"a\.mp4: cannot be written.* of 20 frames"):
            write_film(path, noise)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.read_bytes() == old and list(tmp_path.iterdir()) == [path]
    assert write_film(path, noise) == 20 and path.read_bytes() != old


def test_few_frames_wait_if_they_are_large(tmp_path, monkeypatch):
    """Frames of all threads, and of the part that waits for one, take no more memory than an animated image."""
    run, waiting = film_files.in_background, []

    def recorded(encode, parts, threads):
        return run(lambda name, part: waiting.append((threads + 1) * len(part)) or encode(name, part), parts, threads)

    monkeypatch.setattr(film_files, "in_background", recorded)
    monkeypatch.setattr(film_files, "MAX_BYTES", 15 * 16 * 16 * 3)
    assert write_film(tmp_path / "a.mp4", np.zeros((12, 16, 16, 3))) == 12 and max(waiting) <= 15


def test_an_encoder_that_drops_frames_is_noticed(tmp_path, monkeypatch):
    """A frame that never reaches the encoder, or the file, is missed when the film is read back."""
    path, made = tmp_path / "a.mp4", cv2.VideoWriter
    path.write_bytes(b"old")

    def forgetful(*arguments):
        writer, seen = made(*arguments), []
        write = lambda frame: seen.append(1) or len(seen) == 2 or writer.write(frame)  # noqa: E731
        return SimpleNamespace(isOpened=writer.isOpened, release=writer.release, write=write)

    monkeypatch.setattr(cv2, "VideoWriter", forgetful)
    with pytest.raises(ResourceError, match="2 of 4 frames"):
        write_film(path, np.zeros((4, 16, 16, 3)))
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_animation_holds_all_frames_in_colour_and_time(tmp_path, suffix):
    """It loops for ever, lasts as long as it should, and its colours are near; odd sides stay."""
    path, ramp = tmp_path / f"a{suffix}", np.linspace(0.2, 0.9, 65, dtype=np.float32)
    frames = [np.stack([ramp * (i + 1) / 7, ramp[::-1], np.full(65, 0.3)], 1)[None].repeat(49, 0) for i in range(7)]
    assert write_film(path, iter(frames), fps=24) == 7
    with Image.open(path) as image:
        assert image.n_frames == 7 and image.size == (65, 49) and image.info["loop"] == 0
        lasts = 0
        for i, frame in enumerate(frames):
            image.seek(i)
            got = np.asarray(image.convert("RGB"), np.float32) / 255
            lasts += image.info["duration"]
            assert np.abs(got.mean((0, 1)) - frame.mean((0, 1))).max() < 0.02
        assert abs(lasts - 7000 / 24) <= 10
    assert list(tmp_path.iterdir()) == [path]
    assert write_film(path, np.zeros((3, 8, 8, 3))) == 3  # which do not move


def test_films_that_cannot_be_are_refused_and_gifs_have_one_palette(tmp_path, monkeypatch):
    """What an encoder breaks off leaves the old film; all frames of a GIF have one palette, so that nothing flickers."""
    with pytest.raises(UsageError, match=f"at most {MAX_FPS} frames per second"):
        write_film(tmp_path / "a.gif", np.zeros((2, 8, 8, 3)), fps=MAX_FPS + 1)
    monkeypatch.setattr("warpgs.report.film.MAX_BYTES", 500)
    with pytest.raises(UsageError, match="at most 2 frames of this size"):
        write_film(tmp_path / "a.gif", np.zeros((9, 8, 8, 3)))
    assert not list(tmp_path.iterdir())
    monkeypatch.undo()
    monkeypatch.setattr(film_files, "h264_encoder", lambda: None)
    path = tmp_path / "a.webp"
    path.write_bytes(b"old")

    def broken(self, target, **options):
        target.write(b"half")
        raise OSError("encoder")

    monkeypatch.setattr(Image.Image, "save", broken)
    with pytest.raises(OSError, match="encoder"):
        write_film(path, np.zeros((2, 8, 8, 3)))
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]
    frames = [np.full((6, 6, 3), 40 * i, np.uint8) for i in range(5)]
    assert len({bytes(image.getpalette()) for image in _with_one_palette(frames)}) == 1
