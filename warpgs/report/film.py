"""Files of films: MP4 and animated images."""

import contextlib
import functools
import io
import itertools
import os
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from warpgs.device import in_background, usable_cores
from warpgs.errors import ResourceError, UsageError
from warpgs.files import replacing, write_bytes
from warpgs.folders import open_folder, temporary_folder
from warpgs.process import fed_program, hidden_stderr, run_program, utf8_name

ANIMATIONS = (".webp", ".gif")
MAX_BYTES = 2**30
"""Largest size of all frames together, uncompressed: Pillow holds them all."""
MAX_FPS = 50
"""Frames per second above which browsers slow an animated image down to 10."""
QUALITY = 80
"""Quality of WebP, from 0 to 100."""
PALETTE_PIXELS = 2**18
"""Number of pixels, taken from all frames, from which a GIF's palette is chosen."""


def _bytes_of(frame: np.ndarray) -> np.ndarray:
    return np.round(np.clip(frame, 0, 1) * 255).astype(np.uint8)


def _pixels(path: Path, frames: Iterable[np.ndarray]) -> list[np.ndarray]:
    """Return frames as 8-bit values, after checking their size in memory."""
    result: list[np.ndarray] = []
    for pixels in map(_bytes_of, frames):
        result.append(pixels)
        if len(result) * pixels.nbytes > MAX_BYTES:
            fix = "write .mp4 or .webm, or fewer or smaller frames"
            raise UsageError(f"{path}: an animated image takes at most {MAX_BYTES // pixels.nbytes} frames of this size; {fix}")
    return result


def _with_one_palette(pixels: list[np.ndarray]) -> list:
    """Return frames as Pillow images with one palette, so that colours do not flicker, and with dithering against banding."""
    step = max(1, round((sum(p.shape[0] * p.shape[1] for p in pixels) / PALETTE_PIXELS) ** 0.5))
    sample = np.concatenate([p[::step, ::step].reshape(-1, 3) for p in pixels])
    palette = Image.fromarray(sample[None]).quantize(256, Image.Quantize.MEDIANCUT)
    return [Image.fromarray(p).quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for p in pixels]


def write_animation(path: Path, frames: Iterable[np.ndarray], fps: int) -> int:
    """Write frames [H, W, 3] in [0, 1], at least one and all of one size, as an animated WebP or GIF; returns their number."""
    # Equal frames in a row become one frame that is shown longer.
    if fps > MAX_FPS:
        raise UsageError(f"{path}: browsers show at most {MAX_FPS} frames per second of an animated image, not {fps}")
    pixels, gif = _pixels(path, frames), path.suffix.lower() == ".gif"
    images = _with_one_palette(pixels) if gif else [Image.fromarray(p) for p in pixels]
    unit = 10 if gif else 1  # [ms]; the sum of the durations is right to half a unit
    durations = [int(d) for d in np.diff(np.round(np.arange(len(images) + 1) * 1000 / (fps * unit)).astype(int) * unit)]
    kind, choices = ("GIF", {"optimize": False}) if gif else ("WEBP", {"quality": QUALITY, "method": 4})
    data = io.BytesIO()
    images[0].save(data, format=kind, save_all=True, append_images=images[1:], duration=durations, loop=0, **choices)
    write_bytes(path, data.getbuffer())
    return len(pixels)


VIDEOS = (".mp4", ".webm")
SUFFIXES = (*VIDEOS, *ANIMATIONS)
"""Formats of films."""


def write_film(path: Path, frames: Iterable[np.ndarray], fps: int = 30) -> int:
    """Write frames [H, W, 3] in [0, 1], at least one and all of one size, as a film of the format that the suffix names."""
    # A video is VP9, which OpenCV's wheels bring and current browsers play; .mp4 is H.264 if this machine has an encoder.
    # An odd height loses a row, an odd width a column. An animated image (.webp, .gif) runs in a loop. The film is decoded
    # before it replaces an older one, because the encoder does not report a full disk.
    if (suffix := path.suffix.lower()) in ANIMATIONS:
        return write_animation(path, frames, fps)
    sizes: list[tuple[int, int]] = []

    def check(film: Path) -> None:
        if (found := _decoded_sizes(film)) != sizes:
            read = f"only {sum(f == s for f, s in zip(found, sizes))} of {len(sizes)} frames could be read back"
            fix = "Disk full, or the encoder failed; the old file is untouched. Free disk space, or write elsewhere"
            raise ResourceError(f"{path}: cannot be written; {read}. {fix}")

    with replacing(path, check, suffix=suffix) as (_, temporary):
        name = utf8_name(temporary)
        if suffix == ".mp4" and (program := h264_encoder()):
            _encode_h264(program, name, _even(frames, sizes), fps)
        else:
            _encode_vp9(path, name, _even(frames, sizes), fps)
    return len(sizes)


@functools.cache
def h264_encoder() -> str | None:
    """Return the ffmpeg on this machine's PATH if it encodes H.264, else None: OpenCV's wheels have no encoder for it."""
    program = shutil.which("ffmpeg")
    if program is None or Path(program).resolve().parent == Path.cwd().resolve():  # no file of the current folder is run
        return None
    probe = "-v quiet -f lavfi -i color=s=64x64:d=0.1 -c:v h264 -f null -"
    return program if run_program(program, *probe.split(), timeout=5)[0] == 0 else None


def _even(frames: Iterable[np.ndarray], sizes: list[tuple[int, int]]) -> Iterator[np.ndarray]:
    """Yield frames as 8-bit values with even sides, and write the size of each, [width, height], to a list."""
    for pixels in map(_bytes_of, frames):
        height, width = (s // 2 * 2 for s in pixels.shape[:2])
        sizes.append((width, height))
        yield np.ascontiguousarray(pixels[:height, :width])


def _vp9(path: Path, name: str, fps: int, frame: np.ndarray, properties: tuple[int, ...] = ()):
    """Return OpenCV's writer of VP9 for frames as large as ``frame``."""
    import cv2

    # for .webm OpenCV warns on stderr of an unknown tag, but writes VP9
    with hidden_stderr() if name.endswith(".webm") else contextlib.nullcontext():
        codec, (height, width) = cv2.VideoWriter_fourcc(*"vp09"), frame.shape[:2]
        writer = cv2.VideoWriter(name, cv2.CAP_FFMPEG, codec, fps, (width, height), properties)
    if not writer.isOpened():
        fix = "disk full, folder not writable, or OpenCV lacks a VP9 encoder. Free disk space, or write elsewhere"
        raise ResourceError(f"{path}: cannot be written; {fix}")
    return writer


def _encode_h264(program: str, temporary: str, frames: Iterator[np.ndarray], fps: int) -> None:
    """Write 8-bit frames to a temporary file by ffmpeg."""
    first = next(frames)
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{first.shape[1]}x{first.shape[0]}", "-r", str(fps), "-i", "-"]
    colors = "scale=out_color_matrix=bt709:out_range=tv,setparams=colorspace=bt709:color_primaries=bt709:color_trc=bt709"
    codec = ["-vf", colors, "-c:v", "h264", "-pix_fmt", "yuv420p", "-movflags", "+faststart"]
    folder, name = os.path.split(temporary)  # the folder may be a descriptor of this process
    write, end = fed_program(program, "-v", "quiet", "-y", *given, *codec, name, folder=folder)
    try:
        for pixels in itertools.chain((first,), frames):
            with contextlib.suppress(BrokenPipeError):  # frames are missing then, which is noticed afterwards
                write(pixels)
    finally:
        end()


PART = 15
"""Most frames between key frames. libvpx needs .05 to .2 s for a frame of 504 x 378 px: each thread encodes a part. Parts of 30
frames make files a third larger, 0.5 dB nearer to the frames."""


def _encode_vp9(path: Path, temporary: str, frames: Iterator[np.ndarray], fps: int) -> None:
    """Write 8-bit frames to a temporary file: threads encode parts, whose packets are then put into one file."""
    import cv2

    first = next(frames)
    frames = itertools.chain((first,), frames)
    threads = max(2, min(usable_cores(), MAX_BYTES // (PART * first.nbytes)))
    size = max(1, min(PART, MAX_BYTES // ((threads + 1) * first.nbytes)))  # one part for each thread, and one that waits
    packets_as_they_are = (cv2.VIDEOWRITER_PROP_RAW_VIDEO, 1, cv2.VIDEOWRITER_PROP_KEY_INTERVAL, size)
    film = _vp9(path, temporary, fps, first, packets_as_they_are)

    def encode(name: str, part: list[np.ndarray]) -> str:
        encoder = _vp9(Path(name), name, fps, first)
        for pixels in part:
            encoder.write(np.ascontiguousarray(pixels[..., ::-1]))
        encoder.release()
        return name

    with temporary_folder() as made, open_folder(made.path) as opened:
        folder = utf8_name(opened.reachable())
        parts = iter(lambda: list(itertools.islice(frames, size)), [])
        for name in in_background(encode, ((f"{folder}/{i}.mp4", p) for i, p in enumerate(parts)), threads):
            packets = cv2.VideoCapture(name, cv2.CAP_FFMPEG, (cv2.CAP_PROP_FORMAT, -1))
            while (read := packets.read())[0]:
                film.write(read[1])
            packets.release()
    film.release()


def _decoded_sizes(path: Path) -> list[tuple[int, int]]:
    """Return the size of each frame, [width, height], that can be decoded."""
    import cv2

    film, sizes = cv2.VideoCapture(utf8_name(path)), []
    try:
        while (read := film.read())[0]:
            sizes.append((read[1].shape[1], read[1].shape[0]))
    finally:
        film.release()
    return sizes
