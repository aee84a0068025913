"""Rendering of single pixels instead of an image: their window, their tiles and their values."""

from __future__ import annotations

import torch

from warpgs.kernels.tiles import grid
from warpgs.render.settings import RenderSettings, Window
from warpgs.scene import Camera

INTEGERS = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)
"""Types of pixel coordinates."""


def checked_pixels(pixels: torch.Tensor, cameras: int, device: torch.device) -> torch.Tensor:
    """Return pixels [P, 2] or [C, P, 2] of C cameras as int64 on a device, shape [1, P, 2] or [C, P, 2].

    Raises:
        TypeError: The pixels are not a dense tensor of integers.
        ValueError: The shape is wrong.
    """
    if not isinstance(pixels, torch.Tensor) or pixels.dtype not in INTEGERS:
        found = pixels.dtype if isinstance(pixels, torch.Tensor) else type(pixels).__name__
        raise TypeError(f"pixels must be a tensor of whole numbers, not {found}: columns and rows, from 0 at the upper left")
    if pixels.layout != torch.strided:
        raise TypeError(f"pixels must be dense, not {pixels.layout}; pixels.to_dense() converts them")
    if pixels.ndim not in (2, 3) or pixels.shape[-1] != 2 or (pixels.ndim == 3 and len(pixels) != cameras):
        raise ValueError(f"pixels must have shape [P, 2] or [{cameras}, P, 2], not {list(pixels.shape)}")
    found = pixels.to(device, torch.int64)
    return found if found.ndim == 3 else found[None]


def window_of(pixels: torch.Tensor, camera: Camera, tile_size: int) -> Window:
    """Return the smallest window of whole tiles that holds pixels [..., P, 2]; the pixels are read from the device.

    Raises:
        ValueError: A pixel is outside the image.
    """
    if not pixels.shape[-2]:
        return 0, 0, min(tile_size, camera.width), min(tile_size, camera.height)
    flat = pixels.reshape(-1, 2)
    (left, top), (right, bottom) = torch.stack([flat.amin(0), flat.amax(0)]).tolist()
    if left < 0 or top < 0 or right >= camera.width or bottom >= camera.height:
        raise ValueError(
            f"pixels reach from column {left} to {right} and from row {top} to {bottom}, beyond the image of "
            f"{camera.width} x {camera.height} px"
        )
    x, y = left // tile_size * tile_size, top // tile_size * tile_size
    width = min((right // tile_size + 1) * tile_size, camera.width) - x
    height = min((bottom // tile_size + 1) * tile_size, camera.height) - y
    return x, y, width, height


def listed_tiles(pixels: torch.Tensor, settings: RenderSettings, cameras: int) -> torch.Tensor:
    """Return a mask [T] over the tiles of C cameras, for `bin_tiles`: True where one of ``pixels`` [1 or C, P, 2] is inside."""
    (x, y, width, height), size = settings.window, settings.tile_size
    columns, rows = grid(width, height, size)
    places = (pixels[..., 1] - y) // size * columns + (pixels[..., 0] - x) // size  # windows begin at edges of tiles
    places = places + columns * rows * torch.arange(cameras, device=pixels.device)[:, None]
    listed = torch.zeros(cameras * columns * rows, dtype=torch.bool, device=pixels.device)
    listed[places.reshape(-1)] = True
    return listed


def at_pixels(image: torch.Tensor, pixels: torch.Tensor, window: Window) -> torch.Tensor:
    """Read a window's images [C, H, W, ...] at pixels [1, P, 2] or [C, P, 2]; return values [C, P, ...]. Differentiable."""
    cameras = torch.arange(len(image), device=image.device)[:, None]
    return image[cameras, pixels[..., 1] - window[1], pixels[..., 0] - window[0]]
